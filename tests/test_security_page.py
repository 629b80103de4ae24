"""The page on security is true: a test holds each row of its table of inputs.

To add an input: a row in docs/security.md, and a function of ``INPUTS`` under the first cell. The function
makes an input that names ``FUNCTION``, and lets bevviz read it.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import bevviz
from bevviz.cli import importer, main
from bevviz.config import changed_config, load, plugins
from bevviz.config.project import named_code, read_project_layers
from bevviz.config.reloading import ReloadableConfig
from bevviz.config.trust import grant_trust
from bevviz.errors import UserError
from bevviz.extras.mcp.drives import agent_config
from tests.support import bags
from tests.support.modules import forget_modules

PAGE = Path(__file__).resolve().parents[1] / "docs" / "security.md"
FUNCTION = "clustering.method=page_tools:cells"
TOOLS = """
from pathlib import Path
import numpy as np

(Path(__file__).parent / "ran").touch()

def cells(points):
    return np.zeros(len(points), int)
"""


def rows() -> dict[str, str]:
    """First and second cell of the table."""
    text = PAGE.read_text()
    section = text[text.index("## What runs code") : text.index("## Limits")]
    return dict(re.findall(r"^\| (.+?) \| ((?:yes|no|only after).*?) \|$", section, re.MULTILINE))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a bag, a recording and a report that name the function. Its module is not among them."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "page_tools.py").write_text(TOOLS)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        bags.write(folder / "drive", bags.small_items(scans=3), form="sqlite3")
        assert main(["bag", "drive", "--set", FUNCTION, "--save", "run.rrd"]) == 0
        assert main(["report", "drive", "--set", FUNCTION, "--at", "0.1", "-o", "bug.rrd"]) == 0
    (folder / "ran").unlink()
    _forget()
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Run the test in a copy of the folder, as a recipient has it."""
    place = tmp_path / "received"
    shutil.copytree(made, place)
    monkeypatch.chdir(place)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    for name in ("BEVVIZ_MODEL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    yield place
    _forget()


def _forget() -> None:
    forget_modules("page_tools")


# --- one for each row ----------------------------------------------------------------------------

Input = Callable[[bool], None]  # whether the user trusts the file


def _user(trusts: bool) -> None:
    assert main(["config", "--set", FUNCTION]) == 0
    assert bevviz.simulate(frames=1, set=[FUNCTION]).config.clustering.method == "page_tools:cells"


def _project(trusts: bool) -> None:
    Path("bevviz.toml").write_text('[clustering]\nmethod = "page_tools:cells"\n')
    if trusts:
        grant_trust(named_code(Path("bevviz.toml")))
    main(["info", "drive"])


def _yaml(trusts: bool) -> None:
    Path("robot.yaml").write_text("clustering: {method: 'page_tools:cells'}\n")
    if trusts:
        grant_trust(named_code(Path("robot.yaml")))
    main(["config", "--config", "robot.yaml"])


def _recording(trusts: bool) -> None:
    assert main(["why", "run.rrd", "--at", "0.1", "--point=1,1,0"]) == 2
    assert not Path("ran").exists()
    if trusts:
        assert main(["why", "run.rrd", "--at", "0.1", "--point=1,1,0", "--set", FUNCTION]) == 0


def _report(trusts: bool) -> None:
    assert main(["report", "--check", "bug.rrd"]) == 2
    assert not Path("ran").exists()
    if trusts:
        assert main(["report", "--check", "bug.rrd", "--set", FUNCTION]) == 0


def _bag(trusts: bool) -> None:
    assert main(["info", "drive"]) == 0
    assert main(["bag", "drive", "--save", "again.rrd"]) == 0


def _viewer(trusts: bool) -> None:
    Path("bevviz.toml").write_text('[clustering]\nmethod = "page_tools:cells"\n')
    grant_trust(named_code(Path("bevviz.toml")))
    (bag,) = Path("drive").glob("*.db3")
    assert importer.run([str(bag), "--application-id", bag.stem]) == 1


def _ros(trusts: bool) -> None:
    with pytest.raises(UserError, match="may not run"):
        ReloadableConfig().take([FUNCTION])
    assert not Path("ran").exists()
    if trusts:
        ReloadableConfig(settings=[FUNCTION]).take([FUNCTION])


def _page(trusts: bool) -> None:
    with pytest.raises(UserError, match="may not run"):
        changed_config(load(), [FUNCTION])
    assert not Path("ran").exists()
    if trusts:
        assert (
            changed_config(load(settings=[FUNCTION]), [FUNCTION, "clustering.eps=0.7"]).clustering.eps == 0.7
        )


def _agent(trusts: bool) -> None:
    with pytest.raises(UserError):
        agent_config(load(), [FUNCTION])
    assert not Path("ran").exists()
    if trusts:
        assert agent_config(load(settings=[FUNCTION]), ["clustering.eps=0.7"]).clustering.eps == 0.7


def _registered(trusts: bool) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plugins, "registered", lambda: {"cells": "page_tools:cells"})
        patch.syspath_prepend(Path.cwd())
        Path("bevviz.toml").write_text('[clustering]\nmethod = "cells"\n')
        assert load(layers=read_project_layers(Path.cwd(), {})).clustering.method == "cells"


def _blueprint(trusts: bool) -> None:
    Path("layout.py").write_text("open('ran', 'w').close()\n")
    main(["bag", "drive", "--blueprint", "layout.py", "--save", "x.rrd"])


INPUTS: dict[str, Input] = {
    "`--set`, `--model`, `BEVVIZ_MODEL`, Python": _user,
    "`bevviz.toml`": _project,
    "a YAML file (`--config`, or named by `bevviz.toml`)": _yaml,
    "a recording (`.rrd`) given instead of its bag": _recording,
    "a report (`report --check`)": _report,
    "a bag, a data set": _bag,
    "a bag opened in Rerun's viewer": _viewer,
    "a parameter of ROS (of other nodes, `--ros-args -p`)": _ros,
    "a message of the workbench's page": _page,
    "a value from an agent (`mcp`)": _agent,
    "a name that an installed package registered": _registered,
    "`--blueprint FILE.py`": _blueprint,
}
# Rows about other programs: onnxruntime has no option for custom operators here, dask says so itself.
ELSEWHERE = {"`--model FILE.onnx`", "`batch --dask ADDRESS`"}


def test_each_test_that_the_page_names_exists() -> None:
    named = re.findall(r"`(test_\w+)::(test_\w+)`", PAGE.read_text())
    tests = Path(__file__).parent
    sources = {file: next(tests.rglob(f"{file}.py")).read_text() for file, _ in named}
    assert len(named) > 20
    assert [(file, name) for file, name in named if f"def {name}(" not in sources[file]] == []


@pytest.mark.parametrize("section", ["What listens", "Limits"])
def test_each_row_names_its_test(section: str) -> None:
    text = PAGE.read_text().split(f"## {section}\n")[1].split("\n## ")[0]
    _, _, *table = [line for line in text.splitlines() if line.startswith("|")]
    others = [line for line in table if not re.search(r"`test_\w+::test_\w+`[^|]*\|$", line)]
    assert len(table) > 5
    assert not [line for line in others if not line.endswith("| none: ROS's SROS 2 protects it |")]


def test_each_row_of_the_page_is_checked() -> None:
    assert set(rows()) == set(INPUTS) | ELSEWHERE


@pytest.mark.parametrize("row", INPUTS)
def test_an_input_runs_code_only_as_the_page_says(folder: Path, row: str) -> None:
    says = rows()[row]
    INPUTS[row](False)
    assert (folder / "ran").exists() == says.startswith("yes")


@pytest.mark.parametrize(
    "row", [row for row, says in rows().items() if "only after" in says or "--set" in says]
)
def test_an_input_runs_code_once_the_user_says_so(folder: Path, row: str) -> None:
    INPUTS[row](True)
    assert (folder / "ran").exists()


@pytest.mark.parametrize("row", [row for row, says in rows().items() if "in force" in says])
def test_a_function_in_force_is_kept(folder: Path, row: str) -> None:
    INPUTS[row](True)


def test_networks_take_custom_operators_from_no_file() -> None:
    package = Path(bevviz.__file__).parent
    assert not [path for path in package.rglob("*.py") if "register_custom_ops" in path.read_text()]


def test_the_page_is_right_about_trust(folder: Path) -> None:
    """Where it is kept and for whom, what takes it away, and that links lead to what is meant."""
    _project(True)
    assert (folder / "ran").exists()
    kept = folder.parent / "data" / "bevviz" / "trusted"
    assert kept.stat().st_mode & 0o777 == 0o700 and len(list(kept.iterdir())) == 1
    (folder / "page_tools.py").write_text(TOOLS + "# edited\n")
    _forget()
    with pytest.raises(UserError, match=r"page_tools\.py has changed since you trusted bevviz\.toml"):
        load(layers=read_project_layers(folder, {}))


@pytest.mark.parametrize("function", ["pickle:loads", "os:system", "numpy:load"])
def test_functions_named_as_no_stages_are_refused(function: str) -> None:
    assert f"`{function}`" in PAGE.read_text()
    with pytest.raises(UserError, match="is no stage"):
        load(settings=[f"clustering.method={function}"])
