"""Find and load viewer layouts: bundled layouts by name, user layouts from a file."""

from __future__ import annotations

import importlib.util
import sys
import uuid
import zlib
from dataclasses import replace
from functools import cache
from pathlib import Path

import pyarrow
import rerun.blueprint as rrb
from rerun.recording_stream import RecordingStream

from bevviz.config import BevConfig, Config
from bevviz.errors import UserError
from bevviz.model.frame import Scene
from bevviz.recording.rerun_cli import check_decodes
from bevviz.recording.retention import keeps_everything
from bevviz.support.text import did_you_mean

PACKAGE = Path(__file__).parents[1]


def _folder() -> Path:
    """Return the folder of the bundled layouts.

    It is inside the package in an installation, and next to the package folder in a checkout.
    """
    installed = PACKAGE / "blueprints"
    return installed if installed.is_dir() else PACKAGE.parent / "blueprints"


def names() -> list[str]:
    """Return the names of the bundled layouts."""
    return sorted(path.stem for path in _folder().glob("*.py") if not path.stem.startswith("_"))


def load(name_or_path: str, scene: Scene, config: Config | None = None) -> rrb.Blueprint:
    """Load a layout for a scene.

    Args:
        name_or_path: one of ``names()``, a .py file with a function ``blueprint(scene)`` that returns an
            ``rrb.Blueprint``, or a .rbl file that was saved in the viewer.
        scene: names of the sensors.
        config: configuration of the run. It decides whether raw clouds are shown, the quantities that colour
            them, and the visible part of the bird's-eye view. None: raw clouds without colours, and the whole
            bird's-eye view.

    Raises:
        UserError: the name is unknown, the file does not exist, or it does not make a layout.
    """
    _arrow_without_pandas()  # A layout makes the first array.
    scene = _configured(scene, config)
    if name_or_path in names():
        if not scene.lidar and scene.cameras:
            name_or_path = "cameras"
        return _from_python(_folder() / f"{name_or_path}.py", scene)
    path = Path(name_or_path)
    if path.suffix not in (".py", ".rbl"):
        hint = did_you_mean(name_or_path, names(), 0.4) or f"; there are {', '.join(names())}"
        raise UserError(f"--blueprint {name_or_path}: unknown{hint} (or give a .py or .rbl file)")
    if not path.is_file():
        raise UserError(f"--blueprint {path}: no such file")
    if path.suffix == ".py":
        return _from_python(path, scene)
    check_decodes(path)
    return SavedBlueprint(path)


def application_id(layout: str | rrb.Blueprint, scene: Scene, config: Config | None = None) -> str:
    """Return the application id of recordings with this layout and these sensors.

    The viewer shows all recordings of an application id in one layout. Recordings of the same layout and
    sensors share what a user changes in it. A layout made for one recording has its own id.
    """
    if not isinstance(layout, str):
        return f"bevviz-{uuid.uuid4().hex[:8]}"
    same = replace(_configured(scene, config), name="", bag=(), topics=())
    return f"bevviz-{Path(layout).stem}-{zlib.crc32(repr((layout, same)).encode()):08x}"


def _configured(scene: Scene, config: Config | None) -> Scene:
    """Return the scene with the fields that depend on the configuration."""
    if config is None:
        return scene
    is_complete, logging = keeps_everything(config), config.logging
    color_by = logging.color_by if is_complete and logging.raw_cloud else ()
    return replace(scene, above=_bounds_ahead(config.bev), raw=is_complete, color_by=color_by)


def _bounds_ahead(config: BevConfig) -> tuple[float, float, float, float]:
    """Return the pixel bounds of the area ahead of the robot and close to its sides."""
    rows, columns = config.range_x / config.resolution, config.range_y / config.resolution
    return 0.5 * columns, 0.1 * rows, 1.5 * columns, 1.25 * rows


def _from_python(path: Path, scene: Scene) -> rrb.Blueprint:
    spec = importlib.util.spec_from_file_location(f"bevviz_blueprint_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise UserError(f"--blueprint {path}: cannot be loaded")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
        layout = module.blueprint(scene)
    except Exception as error:  # a user's file may raise anything
        reason = str(error).splitlines()[0] if str(error) else ""
        raise UserError(f"--blueprint {path}: {type(error).__name__}: {reason}") from error
    if not isinstance(layout, rrb.Blueprint):
        kind = type(layout).__name__
        raise UserError(f"--blueprint {path}: blueprint(scene) must return an rrb.Blueprint, not {kind}")
    return layout


class SavedBlueprint(rrb.Blueprint):
    """Layout that the viewer saved as .rbl. It is sent unchanged."""

    def __init__(self, path: Path) -> None:
        super().__init__(rrb.Grid())
        from rerun.chunk import RrdReader

        try:
            reader = RrdReader(path)
            stores = reader.blueprints()
            self._chunks = reader.stream(store=stores[0]).to_chunks() if stores else []
        except Exception as error:
            raise UserError(f"--blueprint {path}: cannot be read: {str(error).splitlines()[0]}") from None
        if not self._chunks:
            raise UserError(f"--blueprint {path}: holds no blueprint")

    def _log_to_stream(self, stream: RecordingStream) -> None:
        stream.send_chunks(self._chunks)


@cache
def _arrow_without_pandas() -> None:
    """Make pyarrow skip its import of pandas, which takes half a second and is not needed.

    pyarrow looks for pandas at its first array. It looks again when one of its pandas functions is called.
    """
    if "pandas" in sys.modules:
        return
    finder = _NoPandas()
    sys.meta_path.insert(0, finder)
    try:
        pyarrow.array([True])
    finally:
        sys.meta_path.remove(finder)


class _NoPandas:
    """Import finder that hides pandas."""

    @staticmethod
    def find_spec(name: str, *_: object) -> None:
        if name == "pandas":
            raise ModuleNotFoundError(name)
