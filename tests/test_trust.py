"""Nothing that was received runs: functions need the user's word, or the user's trust in the file."""

from __future__ import annotations

import ast
import os
import pickle
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bevviz
from bevviz.cli import main
from bevviz.config import Config, Layer, changed_config, config_yaml, load, plugins
from bevviz.config.module_folder import SourceLoader
from bevviz.config.project import named_code, read_project_layers
from bevviz.config.reloading import ReloadableConfig
from bevviz.config.trust import RECEIVED, grant_trust, trust_records
from bevviz.errors import UserError
from bevviz.extras.ros_node.parameters import RosRequests
from bevviz.recording.source_lookup import Origin, RecordingSource
from bevviz.stages.user_stages import load_user_stage
from bevviz.why.changes import with_changes
from tests.support import bags
from tests.support.modules import forget_modules

Capture = pytest.CaptureFixture[str]
PACKAGE = Path(bevviz.__file__).parent

TOOLS = """
from pathlib import Path
import numpy as np

(Path(__file__).parent / "ran").touch()

def segment(points):
    return points[:, 2] < 0

def cluster(points):
    return np.zeros(len(points), int)
"""
PROJECT = '[ground]\nmethod = "drive_tools:segment"\n'


@pytest.fixture(autouse=True)
def received(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Run the test in a downloaded folder with a bag, a project and its module."""
    folder = tmp_path / "received"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    for name in ("BEVVIZ_MODEL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    yield folder
    new_process()


def new_process() -> None:
    forget_modules("drive_tools", "drive_parts", "drive_helper")


def write_project(folder: Path, text: str = PROJECT) -> Path:
    """Put a project file and its module into a folder."""
    (folder / "drive_tools.py").write_text(TOOLS)
    path = folder / "bevviz.toml"
    path.write_text(text)
    return path


def has_run(folder: Path) -> bool:
    return (folder / "ran").exists()


def error_of(capsys: Capture, *arguments: str) -> str:
    """Return the one line of a command that is refused."""
    assert main(list(arguments)) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "error:" in line]
    return line


# --- the four ways -----------------------------------------------------------------------------


class Payload:
    """A pickle that makes a file when it is read."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> Any:
        return Path.touch, (self.target,)


@pytest.mark.long
@pytest.mark.parametrize("through", ["topics", "files", "yaml"])
def test_a_recording_does_not_run_the_pickle_in_its_bag(
    received: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture, through: str
) -> None:
    """The image's pixels are a pickle, and the recording names the function that reads one."""
    loaded = received / "pickle_was_read"
    content = pickle.dumps(Payload(loaded))
    pixels = np.frombuffer(content.ljust(64 * 48 * 3, b"\0"), np.uint8).reshape(48, 64, 3)
    messages = bags.Messages()
    monkeypatch.setattr(bags.Messages, "image", _image_of(pixels))
    bags.write(received / "bug.mcap", bags.small_items(messages, scans=3))
    honest = Origin.of

    def sly(*given: Any, **more: Any) -> Origin | None:
        made = honest(*given, **more)
        assert made is not None
        if through == "topics":
            return replace(made, topics=[*made.topics, "detector.model=pickle:loads"])
        (place,) = made.bag
        return replace(made, files={"detector.model=pickle:loads #": place}) if through == "files" else made

    with monkeypatch.context() as patch:
        patch.setattr(Origin, "of", sly)
        if through == "yaml":
            sly_yaml = 'model: "pickle:loads"'
            patch.setattr(
                "bevviz.recording.frame_logger.config_yaml",
                lambda config: config_yaml(config).replace('model: ""', sly_yaml),
            )
        assert main(["bag", "bug.mcap", "--save", "bug.rrd"]) == 0
    for command in (["why", "bug.rrd", "--at", "0.1"], ["bag", "bug.rrd", "--save", "x.rrd"]):
        status = main(command)
        assert not loaded.exists()
        assert status == 2
    said = capsys.readouterr().err
    assert "bug.rrd: detector.model names the function pickle:loads, which may not run" in said
    assert main(["why", "bug.rrd", "--at", "0.1", "--set", "detector.model=pickle:loads"]) == 2
    assert "module 'pickle' is a part of Python" in capsys.readouterr().err
    assert not loaded.exists()


def _image_of(pixels: np.ndarray[Any, Any]) -> Any:
    original = bags.Messages.image

    def image(self: bags.Messages, stamp: int, bgr: Any, *more: Any, **named: Any) -> Any:
        return original(self, stamp, pixels, *more, **named)

    return image


def test_entering_a_folder_runs_nothing(received: Path, capsys: Capture) -> None:
    write_project(received)
    bags.write(received / "drive", bags.small_items(scans=3))
    for command in (["info", "drive"], ["config"], ["bag", "drive", "--save", "x.rrd"]):
        said = error_of(capsys, *command)
        assert "bevviz.toml: ground.method names the function drive_tools:segment, which may not run" in said
        assert "would load drive_tools:segment (drive_tools.py)" in said
        assert "'bevviz trust bevviz.toml'" in said
    error_of(capsys, "report", "drive", "--at", "0.1", "-o", "bug.rrd")
    assert not has_run(received)


def test_the_importer_runs_nothing_even_of_a_trusted_project(
    received: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    from bevviz.cli.importer import run

    bags.write(received / "drive", bags.small_items(scans=3), form="sqlite3")
    (bag,) = (received / "drive").glob("*.db3")
    grant_trust(named_code(write_project(received)))
    status = run([str(bag), "--application-id", bag.stem])
    assert not has_run(received)
    assert status == 1 and "Rerun's viewer runs none" in capfd.readouterr().err


def test_root_trusts_no_project_of_another_user(received: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor does anybody the records of another user."""
    path = write_project(received)
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    with pytest.raises(UserError, match="is not trusted"):
        load(layers=read_project_layers(received, {}))
    grant_trust(named_code(path))
    owner = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: owner + 1000)
    with pytest.raises(UserError, match="is not trusted"):
        load(layers=read_project_layers(received, {}))
    assert not has_run(received)


# --- trust, edit, revoke -----------------------------------------------------------------------


def test_a_trusted_project_runs_until_it_is_edited(received: Path, tmp_path: Path, capsys: Capture) -> None:
    project = write_project(received)
    assert main(["trust"]) == 0
    assert "bevviz.toml: trusted, with drive_tools:segment (drive_tools.py)" in capsys.readouterr().out
    assert (tmp_path / "data" / "bevviz").stat().st_mode & 0o777 == 0o700
    assert main(["config", "ground.method"]) == 0
    assert has_run(received)
    for file in (project, received / "drive_tools.py"):
        before = file.read_text()
        file.write_text(before + "\n# another line\n")
        new_process()
        said = error_of(capsys, "config")
        assert f"{file.name} has changed since you trusted" in said and "'bevviz trust bevviz.toml'" in said
        file.write_text(before)
        assert main(["config"]) == 0


def test_an_edit_of_a_file_that_is_named_or_imported_asks_again(received: Path, capsys: Capture) -> None:
    write_project(received, 'config = "robot.yaml"\n')
    (received / "robot.yaml").write_text("ground: {method: drive_tools:segment}\n")
    parts = received / "drive_parts"
    parts.mkdir()
    (parts / "__init__.py").write_text("from . import limits\n")
    (parts / "limits.py").write_text("LOW = 0\n")
    (received / "drive_tools.py").write_text(f"from drive_parts.limits import LOW\n{TOOLS}")
    assert main(["trust", "."]) == 0
    said = capsys.readouterr().out
    assert "drive_tools:segment (drive_tools.py), and 2 other Python files that they may import" in said
    assert main(["config"]) == 0
    for file in (received / "robot.yaml", parts / "limits.py"):
        before = file.read_text()
        file.write_text(before + "# another line\n")
        new_process()
        changed = "bevviz.toml" if file.suffix == ".yaml" else "drive_parts/limits.py"
        assert f"{changed} has changed since you trusted" in error_of(capsys, "config")
        file.write_text(before)


def test_trust_is_listed_and_revoked(received: Path, capsys: Capture) -> None:
    project = write_project(received)
    assert main(["trust", "--list"]) == 0
    assert capsys.readouterr().out == "nothing is trusted\n"
    assert main(["trust", "bevviz.toml"]) == 0
    capsys.readouterr()
    assert main(["trust", "--list"]) == 0
    assert capsys.readouterr().out == f"{project}: drive_tools:segment\n"
    project.write_text(PROJECT + "# more\n")
    assert main(["trust", "--list"]) == 0
    assert "changed since" in capsys.readouterr().out
    assert main(["trust", "--revoke"]) == 0
    assert not list(trust_records())
    assert "is not trusted" in error_of(capsys, "config")
    assert "is not trusted" in error_of(capsys, "trust", "--revoke")


def test_a_yaml_file_needs_trust_of_its_own(received: Path, capsys: Capture) -> None:
    """Also where the project beside it is trusted, and where Python names the file."""
    write_project(received)
    assert main(["trust"]) == 0
    Path("night.yaml").write_text("clustering: {method: drive_tools:cluster}\n")
    capsys.readouterr()
    assert "'bevviz trust night.yaml'" in error_of(capsys, "config", "--config", "night.yaml")
    with pytest.raises(UserError, match=r"night\.yaml is not trusted"):
        load("night.yaml")
    assert main(["trust", "night.yaml"]) == 0
    assert main(["config", "--config", "night.yaml"]) == 0
    assert main(["config", "--config", "night.yaml", "--set", "clustering.method=dbscan"]) == 0


def test_a_function_of_a_pipe_is_refused(received: Path) -> None:
    write_project(received)
    reading, writing = os.pipe()
    os.write(writing, b"ground: {method: 'drive_tools:segment'}\n")
    os.close(writing)
    with pytest.raises(UserError, match="is no file that can be trusted: add --set ground"):
        load(f"/dev/fd/{reading}")
    os.close(reading)


def test_a_file_without_functions_needs_no_trust(received: Path, capsys: Capture) -> None:
    write_project(received, "[clustering]\neps = 0.6\n")
    assert main(["config", "clustering.eps"]) == 0
    assert main(["trust"]) == 0
    assert "names no function" in capsys.readouterr().out
    assert not list(trust_records())


def test_a_registered_name_needs_no_trust(received: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The user has installed the package."""
    installed = received.parent / "installed"
    installed.mkdir()
    (installed / "drive_tools.py").write_text(TOOLS)
    monkeypatch.syspath_prepend(installed)
    monkeypatch.setattr(plugins, "registered", lambda: {"flat": "drive_tools:segment"})
    write_project(received, '[ground]\nmethod = "flat"\n')
    assert load(layers=read_project_layers(received, {})).ground.method == "flat"
    assert has_run(installed) and not has_run(received)


# --- where modules are found -------------------------------------------------------------------


def test_modules_of_a_trusted_file_lie_beside_it(received: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not in the working directory, though Python has that on its path; and the same in another process."""
    grant_trust(named_code(write_project(received)))
    below = received / "monday"
    below.mkdir()
    (below / "drive_tools.py").write_text(TOOLS)
    monkeypatch.chdir(below)
    monkeypatch.syspath_prepend(below)
    config = load(layers=read_project_layers(below, {}))
    assert has_run(received) and not has_run(below)
    assert pickle.loads(pickle.dumps(config)).functions == {
        ("ground", "drive_tools:segment"): config.functions["ground", "drive_tools:segment"]
    }
    (received / "drive_tools.py").unlink()
    new_process()
    grant_trust(named_code(received / "bevviz.toml"))
    with pytest.raises(UserError, match="there is no module 'drive_tools' in "):
        load(layers=read_project_layers(below, {}))
    assert not has_run(below)


def test_modules_beside_a_trusted_file_come_first(received: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the trusted module, also if another one of the same name is installed."""
    installed = received.parent / "installed"
    installed.mkdir()
    (installed / "drive_tools.py").write_text(TOOLS)
    monkeypatch.syspath_prepend(installed)
    grant_trust(named_code(write_project(received)))
    load(layers=read_project_layers(received, {}))
    assert has_run(received) and not has_run(installed)
    new_process()
    __import__("drive_tools")
    with pytest.raises(UserError, match=r"another module 'drive_tools' .* is in use already, of "):
        load(layers=read_project_layers(received, {}))


def test_compiled_files_beside_a_trusted_source_do_not_run(received: Path) -> None:
    """A ``__pycache__`` that came with the folder may hold anything."""
    import importlib.util
    import marshal

    grant_trust(named_code(write_project(received)))
    source = received / "drive_tools.py"
    sly = compile("from pathlib import Path\nPath('compiled').touch()\ndef segment(points): ...", "x", "exec")
    cached = Path(importlib.util.cache_from_source(str(source)))
    cached.parent.mkdir()
    unchecked = importlib.util.MAGIC_NUMBER + (1).to_bytes(4, "little") + bytes(8)
    cached.write_bytes(unchecked + marshal.dumps(sly))
    load(layers=read_project_layers(received, {}))
    assert has_run(received) and not (received / "compiled").exists()


def test_a_module_edited_after_the_check_runs_in_no_worker(received: Path) -> None:
    """A worker gets the configuration as a pickle, and imports the module later than the command has."""
    grant_trust(named_code(write_project(received)))
    sent = pickle.dumps(load(layers=read_project_layers(received, {})))
    (received / "ran").unlink()
    source = received / "drive_tools.py"
    for edit in (lambda: source.write_text(TOOLS + "# edited\n"), lambda: os.utime(source, (0, 0))):
        edit()
        new_process()
        with pytest.raises(UserError) as caught:
            load_user_stage(pickle.loads(sent), "ground")
        assert str(caught.value).endswith(
            "drive_tools.py has changed since you trusted bevviz.toml: read it, then run "
            "'bevviz trust bevviz.toml'"
        )
    assert not has_run(received)
    source.write_text(TOOLS)
    assert load_user_stage(pickle.loads(sent), "ground") is not None and has_run(received)


def test_the_bytes_that_are_checked_are_the_bytes_that_run(
    received: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also if the file is edited between: it is read once."""
    grant_trust(named_code(write_project(received)))
    reads = []

    def read(self: Any, path: str) -> bytes:
        reads.append(path)
        content = Path(path).read_bytes()
        Path(path).write_text("raise SystemExit('edited')\n")
        return content

    monkeypatch.setattr(SourceLoader, "get_data", read)
    assert load(layers=read_project_layers(received, {})).functions
    assert reads == [str(received / "drive_tools.py")]


@pytest.mark.parametrize("way", ["new", "imported when called", "of a folder on the path", "of a namespace"])
def test_no_import_of_a_trusted_module_leads_around_the_check(
    received: Path, monkeypatch: pytest.MonkeyPatch, way: str
) -> None:
    """Every import inside the folder is checked, and takes no compiled file."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    lines = {
        "new": "import drive_helper\n",
        "imported when called": "def segment(points):\n    from drive_parts import late\n    return points\n",
        "of a folder on the path": "import sys; sys.path.insert(0, __file__.rpartition('/')[0] + '/lib')\n"
        "import drive_helper\nsys.path.pop(0)\n",
        "of a namespace": "import drive_parts.inner.late\n",
    }
    write_project(received)
    (received / "drive_tools.py").write_text(f"import drive_parts.inner.early\n{TOOLS}{lines[way]}")
    for file in ("lib/drive_helper.py", "drive_parts/late.py", "drive_parts/inner/early.py"):
        (received / file).parent.mkdir(parents=True, exist_ok=True)
        (received / file).write_text("")
    (received / "drive_parts/inner/late.py").write_text("")
    grant_trust(named_code(Path("bevviz.toml")))
    edited = "from pathlib import Path\nPath('edited').touch()\n"
    for file in (
        "drive_helper.py",
        "lib/drive_helper.py",
        "drive_parts/late.py",
        "drive_parts/inner/late.py",
    ):
        (received / file).write_text(edited)
    with pytest.raises(UserError, match=r"(is new|has changed) since you trusted bevviz\.toml: read it"):
        stage = load_user_stage(load(layers=read_project_layers(received, {})), "ground")
        assert stage is not None
        stage(np.zeros((1, 3)), 0, 0, "lidar")
    assert not Path("edited").exists()


def test_installed_modules_are_no_data_of_the_folder(received: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files named like modules of Python, folders of data, and an environment inside of the folder."""
    site = received / "venv" / "lib" / "site"
    (site / "drive_helper").mkdir(parents=True)
    (site / "drive_helper" / "__init__.py").write_text("from . import deep\n")
    (site / "drive_helper" / "deep.py").write_text("")
    monkeypatch.syspath_prepend(site)
    write_project(received)
    (received / "drive_tools.py").write_text(f"import graphlib, yaml, drive_helper\n{TOOLS}")
    (received / "graphlib.py").write_text("raise SystemExit\n")
    (received / "yaml").mkdir()
    (received / "yaml" / "data.txt").write_text("")
    monkeypatch.delitem(sys.modules, "graphlib", raising=False)
    monkeypatch.delitem(sys.modules, "yaml", raising=False)
    grant_trust(named_code(Path("bevviz.toml")))
    (site / "drive_helper" / "deep.py").write_text("CHANGED = True\n")
    assert load(layers=read_project_layers(received, {})).functions and has_run(received)


def test_a_compiled_module_of_a_trusted_folder_is_none(received: Path) -> None:
    from importlib.machinery import EXTENSION_SUFFIXES

    write_project(received)
    (received / "drive_tools.py").write_text(f"import drive_helper\n{TOOLS}")
    for suffix in (*EXTENSION_SUFFIXES, ".pyc"):
        (received / f"drive_helper{suffix}").write_bytes(b"anything")
    grant_trust(named_code(Path("bevviz.toml")))
    with pytest.raises(UserError, match="there is no module 'drive_helper' in "):
        load(layers=read_project_layers(received, {}))


KERNEL = """
import numba
import numpy as np


@numba.njit(cache=True)
def count(n):
    return n + 1


@numba.vectorize(["int64(int64)"], cache=True)
def double(n):
    return 2 * n


def segment(points):
    return np.zeros(count(len(points)) - 1, bool)
"""


@pytest.mark.long
@pytest.mark.parametrize("trusted", [True, False])
def test_compiled_functions_beside_a_module_do_not_run(
    received: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, trusted: bool
) -> None:
    """A cache of numba is a pickle. Functions of users' modules are kept in bevviz's own folder."""
    from bevviz.support import numba_cache

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    numba_cache._user_kernel_folder.cache_clear()
    write_project(received)
    (received / "drive_tools.py").write_text(KERNEL)
    (received / "__pycache__").mkdir()
    loaded = received / "pickle_was_read"
    tag = f"py{sys.version_info[0]}{sys.version_info[1]}"
    for line in range(12):
        for name in ("count", "double"):
            index = received / "__pycache__" / f"drive_tools.{name}-{line}.{tag}.nbi"
            index.write_bytes(pickle.dumps(Payload(loaded)))
    if trusted:
        grant_trust(named_code(Path("bevviz.toml")))
        config = load(layers=read_project_layers(received, {}))
    else:
        config = load(settings=["ground.method=drive_tools:segment"])
    stage = load_user_stage(config, "ground")
    assert stage is not None and len(stage(np.zeros((3, 3)), 0, 0, "lidar")) == 3
    assert not loaded.exists()
    kernels = tmp_path / "cache" / "bevviz" / "kernels"
    assert (
        len(list(kernels.glob("*/drive_tools.count-*.nbi"))) == 1 and kernels.stat().st_mode & 0o777 == 0o700
    )
    kernels.chmod(0o777)  # Others could write there, so that nothing is read from there.
    numba_cache._user_kernel_folder.cache_clear()
    assert numba_cache._user_kernel_folder() != kernels
    numba_cache._user_kernel_folder.cache_clear()


@pytest.mark.long
def test_numba_takes_no_settings_from_the_folder(received: Path) -> None:
    """Its .numba_config.yaml could name a cache, which holds pickles, for the stages of bevviz."""
    (received / ".numba_config.yaml").write_text("cache_dir: cache\ncache_locator_classes: evil.Locator\n")
    program = (
        "from bevviz.support import numba_cache\nfrom numba.core import config\n"
        "config.reload_config()\nprint([config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES])\n"
    )
    environment = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    environment["PYTHONPATH"] = str(PACKAGE.parent)
    ran = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True, env=environment
    )
    assert ran.stdout == "['', '']\n"


@pytest.mark.long
def test_workers_find_no_python_of_the_folder(received: Path) -> None:
    """A new process of Python looks into the working directory first, if nobody tells it not to."""
    for name in ("multiprocessing", "struct", "random", "signal"):
        (received / f"{name}.py").write_text("open('ran', 'w').close()\nraise SystemExit(1)\n")
    path = [str(PACKAGE.parent), *filter(None, sys.path)]
    program = (
        f"import sys; sys.path[:] = {path!r}\n"
        "if __name__ == '__main__':\n"
        "    from bevviz.extras.batch.processes import Processes\n"
        "    workers = Processes(1)\n"
        "    workers._idle[0].process.join(3)\n"
        "    workers.close()\n"
    )
    (received.parent / "program.py").write_text(program)
    subprocess.run([sys.executable, str(received.parent / "program.py")], check=True, timeout=180)
    assert not has_run(received)


# --- what others send --------------------------------------------------------------------------


class Node:
    """A ROS node as far as ``RosRequests`` needs one: parameters that other nodes set."""

    def __init__(self) -> None:
        self.on_set: Any = None

    def declare_parameter(self, name: str, value: Any, descriptor: Any) -> Any:
        return Parameter(name, value)

    def set_descriptor(self, name: str, descriptor: Any) -> None:
        pass

    def add_on_set_parameters_callback(self, callback: Any) -> None:
        self.on_set = callback


class Parameter:
    def __init__(self, name: str, value: Any) -> None:
        self.name, self.value = name, value


def test_a_ros_parameter_names_no_function(received: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from types import SimpleNamespace

    names = ("FloatingPointRange", "IntegerRange", "ParameterDescriptor", "SetParametersResult")
    msg = SimpleNamespace(**dict.fromkeys(names, SimpleNamespace))
    monkeypatch.setitem(sys.modules, "rcl_interfaces", SimpleNamespace(msg=msg))
    monkeypatch.setitem(sys.modules, "rcl_interfaces.msg", msg)
    write_project(received, "")
    settings, node = ReloadableConfig(), Node()
    RosRequests(node, settings)
    told = node.on_set([Parameter("ground.method", "drive_tools:segment")])
    assert not told.successful
    assert "start bevviz with --set ground.method=drive_tools:segment" in told.reason
    assert not has_run(received)
    assert node.on_set([Parameter("clustering.eps", 0.7)]).successful
    assert settings.config.clustering.eps == 0.7


def test_a_page_names_no_function(received: Path) -> None:
    """Every message of the workbench goes by ``changed_config``, or by the settings of a live run."""
    write_project(received, "")
    message = ["ground.method=drive_tools:segment"]
    with pytest.raises(UserError, match="start bevviz with --set ground"):
        changed_config(load(), message)
    with pytest.raises(UserError, match="start bevviz with --set ground"):
        ReloadableConfig().read(message)
    assert not has_run(received)
    opened = load(settings=["ground.method=drive_tools:segment"])
    tried = changed_config(opened, ["ground.method=drive_tools:segment", "clustering.eps=0.7"])
    assert (tried.ground.method, tried.clustering.eps) == ("drive_tools:segment", 0.7)
    assert with_changes(tried, {"clustering.eps": 0.8}).functions == opened.functions


def test_an_edited_file_goes_on_with_the_functions_in_force(received: Path) -> None:
    """While it runs: the same function, not another one."""
    write_project(received, "")
    file = Path("live.yaml")
    file.write_text("ground: {method: 'drive_tools:segment'}\n")
    grant_trust(named_code(file))
    settings = ReloadableConfig(file)
    file.write_text("ground: {method: 'drive_tools:segment'}\nclustering: {eps: 0.7}\n")
    assert settings.read().clustering.eps == 0.7
    file.write_text("ground: {method: 'drive_tools:cluster'}\n")
    with pytest.raises(UserError, match=r"live\.yaml .* would load drive_tools:cluster"):
        settings.read()


def test_a_configuration_that_load_did_not_make_runs_nothing(received: Path) -> None:
    from bevviz.pipeline.session import Session

    write_project(received, "")
    config = Config.model_validate({"ground": {"method": "drive_tools:segment"}})
    with pytest.raises(UserError, match="no function that the user has named"):
        Session(config)
    bytes_of = Layer("sly.yaml", {"ground.method": b"drive_tools:segment"})
    with pytest.raises(UserError):
        Session(load(layers=[bytes_of]))
    assert not has_run(received)


# --- what is a stage ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("function", "said"),
    [
        ("pickle:loads", "module 'pickle' is a part of Python"),
        ("os:system", "module 'os' is a part of Python"),
        ("builtins:exec", "module 'builtins' is a part of Python"),
        ("subprocess:getoutput", "module 'subprocess' is a part of Python"),
        ("antigravity:geohash", "module 'antigravity' is a part of Python"),
        ("numpy:load", "its first parameter is 'file'"),
        ("numpy:frombuffer", "it is no Python function or class"),
        ("cv2:imread", "it is no Python function or class"),
        ("ruamel.yaml:YAML", "a class needs a method __call__(self, points)"),
        ("drive_tools:loads", "it is no Python function or class"),
        ("drive_tools:popen", "a class needs a method __call__(self, points)"),
        ("drive_tools:any_name", "its first parameter is 'data'"),
        ("drive_tools:two", "it needs 'limits', and its module has no model Params"),
        ("drive_tools:none", "it takes no array"),
        ("drive_tools:Made", "it needs 'weights', and"),
    ],
)
def test_what_is_no_stage_is_refused_from_every_origin(received: Path, function: str, said: str) -> None:
    text = (
        "from pickle import loads\nfrom subprocess import Popen as popen\n"
        "def any_name(data): ...\ndef two(points, limits): ...\ndef none(): ...\n"
        "class Made:\n    def __init__(self, weights): ...\n    def __call__(self, image): ...\n"
    )
    (received / "drive_tools.py").write_text(text)
    with pytest.raises(UserError) as caught:
        load(settings=[f"detector.model={function}"])
    assert f"'{function}' is no stage: {said}" in str(caught.value)
    assert "whose first parameter is 'points' or 'image' (docs/stages.md)" in str(caught.value)


@pytest.mark.parametrize("function", ["typed", "with_default", "Made", "decorated", "compiled"])
def test_functions_that_say_what_they_are_for_are_stages(received: Path, function: str) -> None:
    (received / "drive_tools.py").write_text(
        "from __future__ import annotations\nimport functools, numba, numpy as np\n"
        "def typed(data: np.ndarray): ...\ndef with_default(cloud, eps=0.5, *, k=3): ...\n"
        "class Made:\n    def __call__(self, image): ...\n"
        "@functools.lru_cache\ndef decorated(points): ...\n"
        "@numba.njit\ndef compiled(points): return points\n"
    )
    assert load(settings=[f"detector.model=drive_tools:{function}"]).functions


# --- no new way around it ----------------------------------------------------------------------


def calls(name: str) -> Iterator[tuple[str, ast.Call]]:
    """Yield the calls of a function in the package, with the file of each."""
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] == name:
                yield str(path.relative_to(PACKAGE)), node


def names_in(path: Path) -> set[str]:
    """Names that a module uses."""
    return {node.id for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Name)}


@pytest.mark.long
def test_trust_is_granted_in_few_places_only() -> None:
    """Few modules grant trust, and a layer without a stated origin is not trusted."""
    assert Layer("somewhere", {}).trust is RECEIVED and not RECEIVED.granted
    users = {str(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*.py") if "USER" in names_in(path)}
    assert users == {"config/loading.py", "config/project.py", "config/trust.py", "drive.py"}
    assert {file for file, call in calls("Trust") if "granted=True" in ast.unparse(call)} == {
        "config/trust.py"
    }


@pytest.mark.long
def test_settings_that_are_text_come_from_the_user_alone() -> None:
    """Callers of ``load`` that give settings: the command line, Python, or layers with their origin."""
    giving = {
        file
        for file, call in calls("load")
        if isinstance(call.func, ast.Name)
        and (len(call.args) > 1 or any(keyword.arg == "settings" for keyword in call.keywords))
    }
    assert giving == {
        "cli/options.py",
        "config/loading.py",
        "config/reloading.py",
        "drive.py",
        "extras/demo/command.py",
        "why/fix.py",  # its own values of numbers and methods, over a configuration that is loaded
        "recording/source_lookup.py",
        "report/check.py",
    }
    finding = {file for file, call in calls("load_plugin") if ast.unparse(call.func) == "plugins.load_plugin"}
    assert finding == {"config/methods.py"}


def test_a_recorded_detector_is_refused_with_a_preset_too(received: Path) -> None:
    """A file or a preset takes the configuration's place, but not the detector's."""
    write_project(received, "")
    recorded = RecordingSource(received / "bug.rrd", (), (), (), "detector: {model: drive_tools:segment}\n")
    with pytest.raises(UserError, match="add --set detector"):
        recorded.load(preset="reference")
    assert recorded.load(settings=["detector.model="], preset="reference").detector.model == ""
    assert not has_run(received)
