"""Stages that an installed package registers for files: how their files travel, and what is kept of them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from bevviz.config import load, stage_files, with_stage_files
from bevviz.config.project import read_project_layers
from bevviz.errors import UserError
from bevviz.model.reasons import owner_of
from bevviz.pipeline.stage_loader import StageLoader
from bevviz.recording.provenance import dependencies_of
from bevviz.support import extensions

MODULE = """
from pathlib import Path
import numpy as np
from pydantic import BaseModel, Field

runs = []

class Params(BaseModel):
    count: int = Field(description="number of boxes")
    table: Path | None = None

class Boxes:
    def __init__(self, params, *, file, provider, threads):
        self.count, self.provider = params.count, f"text on {provider}"
        self.size = float(Path(file).read_text())
        self.identity = str(params.count)

    def __call__(self, points):
        runs.append(len(points))
        boxes = np.tile([0, 0, 0, self.size, 1, 1, 0], (self.count, 1))
        return boxes, [0.5] * self.count, ["car"] * self.count
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Install a package that registers a stage for files that end in .boxes."""
    site = tmp_path / "site"
    (metadata := site / "boxed-1.0.dist-info").mkdir(parents=True)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: boxed\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("[bevviz.stages]\nobjects.boxes = boxed:Boxes\n")
    (metadata / "top_level.txt").write_text("boxed\n")
    (site / "boxed.py").write_text(MODULE)
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.setenv("BEVVIZ_STORE", str(tmp_path / "store"))
    project = tmp_path / "project"
    project.mkdir()
    (project / "a.boxes").write_text("4")
    (project / "table.txt").write_text("1")
    extensions.registered.cache_clear()
    yield project
    extensions.registered.cache_clear()


def test_a_file_is_read_by_the_stage_of_its_suffix(folder: Path) -> None:
    """Its result is kept, since the stage has an identity, as long as the file does not change."""
    config = load(settings=[f"objects.method={folder / 'a.boxes'}", "objects.count=2"])
    assert owner_of(config, "objects").name == "a.boxes"
    cloud = np.zeros((3, 4), np.float32)

    def run() -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
        stage = StageLoader().load(config).objects
        assert stage is not None and stage.provider == "text on auto"
        boxes, _, names = stage(cloud, 0, 0, "lidar")
        assert list(names) == ["car", "car"]
        return np.asarray(boxes)

    import boxed  # type: ignore[import-not-found]

    assert run()[:, 3].tolist() == run()[:, 3].tolist() == [4, 4] and boxed.runs == [3]
    (folder / "a.boxes").write_text("5")
    assert run()[:, 3].tolist() == [5, 5] and boxed.runs == [3, 3]


def test_files_of_a_stage_are_named_wherever_files_are(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "bevviz.toml").write_text('[objects]\nmethod = "a.boxes"\ncount = 1\ntable = "table.txt"\n')
    (deep := folder / "deep").mkdir()
    monkeypatch.chdir(deep)
    config = load(layers=read_project_layers(deep, {}))
    keys = {"objects.method": "../a.boxes", "objects.params.table": "../table.txt"}
    assert stage_files(config) == keys
    dependencies = dependencies_of(config)
    assert [dependencies[key].file for key in keys] == ["a.boxes", "table.txt"]
    assert dependencies["boxed:Boxes"].version == "boxed 1.0"
    shared = with_stage_files(config, lambda file: Path(file).name)
    assert stage_files(shared) == {key: Path(file).name for key, file in keys.items()}
    assert shared.objects.params["count"] == 1


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("objects.method=none.boxes", "objects.method=none.boxes: no such file"),
        ("objects.method={}", "it needs objects.params.count, in a YAML file or by --set"),
        ("objects.method=a.other", "FILE.boxes, "),
        ("ground.method={}", "ground.method must be one of polar, plane, module:function"),
    ],
)
def test_a_missing_file_or_parameter_is_one_line(folder: Path, setting: str, said: str) -> None:
    with pytest.raises(UserError) as caught:
        load(settings=[setting.format(folder / "a.boxes")])
    assert said in str(caught.value) and "\n" not in str(caught.value)
