"""Former names of modules."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import bevviz
from bevviz import renamed
from bevviz.cli import _parser
from bevviz.config import load
from bevviz.model.frame import Scene
from bevviz.recording import blueprints, views

LAYOUT = """
import rerun.blueprint as rrb
from bevviz.frame import Scene
from bevviz.logging import entities, views


def blueprint(scene: Scene) -> rrb.Blueprint:
    return rrb.Blueprint(views.spaces(scene))
"""


@pytest.fixture(autouse=True)
def forget() -> None:
    for name in [name for name in sys.modules if renamed.spec_of(name) is not None]:
        del sys.modules[name]


@pytest.mark.parametrize(("former", "present"), renamed.FORMER.items())
def test_a_former_name_is_the_same_module(former: str, present: str) -> None:
    with pytest.warns(FutureWarning, match=f"{former} is called {present} now"):
        module = importlib.import_module(former)
    assert module is importlib.import_module(present)
    assert module.__spec__ is not None and module.__spec__.name == present


def test_a_module_below_a_former_name_is_loaded_once() -> None:
    with pytest.warns(FutureWarning):
        assert importlib.import_module("bevviz.logging.views") is views


def test_the_import_hook_knows_every_former_name() -> None:
    assert {f"bevviz.{name}" for name in bevviz._FORMER} == set(renamed.FORMER)


def test_a_layout_of_the_last_version_works(tmp_path: Path) -> None:
    path = tmp_path / "layout.py"
    path.write_text(LAYOUT)
    with pytest.warns(FutureWarning):
        assert blueprints.load(str(path), Scene("a", "lidar", ("lidar",)), load()) is not None


@pytest.mark.parametrize(("command", "former"), renamed.FORMER_OPTIONS)
def test_a_former_option_is_the_present_one(command: str, former: str) -> None:
    """It is accepted with its value in either form, and a line names the present option."""
    present = renamed.FORMER_OPTIONS[command, former]
    for given, wanted in (([former, "x"], [present, "x"]), ([f"{former}=x"], [f"{present}=x"])):
        line, said = renamed.present_options([command, "a.mcap", *given])
        assert line == [command, "a.mcap", *wanted]
        assert said == [f"bevviz {command} {former} is called {present} now"]
    parser = _parser()[1][command]
    assert present in parser._option_string_actions
    assert renamed.present_options(["why", "a.mcap", former]) == (["why", "a.mcap", former], [])


def test_a_name_that_never_was_is_not_found() -> None:
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("bevviz.no_such_module")
    code = "import sys, bevviz; sys.exit('bevviz.renamed' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
