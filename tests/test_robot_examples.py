"""The package of a ROS workspace: systemd unit, launch file, and the command of ros2."""

from __future__ import annotations

import configparser
import runpy
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import pytest

from bevviz.cli import make_parser
from bevviz.cli.command import make_options
from bevviz.cli.live import LiveOptions
from bevviz.cli.options import collect_settings
from bevviz.config.reloading import ReloadableConfig
from tests.support.ros_graphs import own_graph
from tests.support.waiting import PATIENCE

PACKAGE = Path(__file__).parents[1] / "ros"
CONFIG = PACKAGE / "config" / "robot.yaml"
UNIT = PACKAGE / "config" / "bevviz.service"


def unit() -> configparser.ConfigParser:
    parser = configparser.ConfigParser(interpolation=None)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read_string(UNIT.read_text().replace("\\\n", " "))
    return parser


def settings_of(arguments: list[str]) -> ReloadableConfig:
    """Return the settings of a command line with the configuration file of the example."""
    parser, _ = make_parser()
    options = make_options(LiveOptions, vars(parser.parse_args(arguments)))
    assert options.config.file in (Path("/etc/bevviz/robot.yaml"), CONFIG)
    return ReloadableConfig(CONFIG, collect_settings(options))


def test_the_systemd_unit_is_valid(tmp_path: Path) -> None:
    service = unit()["Service"]
    program, *arguments = shlex.split(service["ExecStart"])
    live = settings_of(arguments).config.live
    assert program.endswith("/bevviz") and arguments[0] == "live"
    assert (live.flight_folder, live.flight_time, live.nice) == (service["WorkingDirectory"], 30.0, 10)
    assert live.triggers == ("one_sensor", "tf", "stage") and live.raw_size == 500
    # A robot reboots: it is started again however it ended, as often as that takes.
    assert (service["Restart"], unit()["Unit"]["StartLimitIntervalSec"]) == ("always", "0")
    if (verify := shutil.which("systemd-analyze")) is not None:
        there = tmp_path / "bevviz.service"
        there.write_text(UNIT.read_text().replace(program, sys.executable))
        done = subprocess.run([verify, "verify", str(there)], capture_output=True, text=True, check=False)
        assert [line for line in done.stderr.splitlines() if "bevviz.service" in line] == []


@pytest.mark.long  # of its own it shows that these arguments are taken; test_live_ros has the run
def test_the_command_of_the_unit_runs_and_ends(tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs rclpy: pip install 'bevviz[ros]'")
    _, *arguments = shlex.split(unit()["Service"]["ExecStart"])
    places = {"/etc/bevviz/robot.yaml": str(CONFIG), "live.flight_folder=/var/lib/bevviz": "live.every=1"}
    command = [sys.executable, "-m", "bevviz", *(places.get(argument, argument) for argument in arguments)]
    with own_graph() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
        patch.setenv("PYTHONPATH", str(PACKAGE.parent))
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=tmp_path) as run:
            assert run.stderr is not None
            try:
                # Before it may come that the stages are compiled, where nothing has done so yet.
                assert any("waiting: nothing is published" in line for line in run.stderr)
            finally:
                run.send_signal(signal.SIGTERM)
                rest = run.stderr.read()
            assert run.wait(PATIENCE) >= 0 and "Traceback" not in rest


def test_the_launch_file_is_valid(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BEVVIZ_PROGRAM", "/robot/bevviz")
    process = launched(monkeypatch)
    program, *arguments = process["cmd"]
    assert program == "/robot/bevviz" and process["respawn"] is True
    assert arguments[-3:] == ["--ros-args", "-r", "__ns:=/"]
    assert "--diagnostics" in arguments and "--publish" not in arguments
    settings = settings_of(arguments)
    assert settings.config.detector.model == "" and settings.config.live.flight_folder == "."


def test_the_launch_file_passes_options_on(monkeypatch: pytest.MonkeyPatch) -> None:
    command = launched(monkeypatch, options="--publish --save 'my drive.mcap'")["cmd"]
    rest = command.index("--ros-args")
    assert command[rest - 3 : rest] == ["--publish", "--save", "my drive.mcap"]


def launched(monkeypatch: pytest.MonkeyPatch, **arguments: str) -> dict[str, Any]:
    """Return the arguments of the process that the launch file starts, without an installed ROS."""
    made: list[tuple[str, dict[str, Any]]] = []

    def noted(kind: str) -> Any:
        def make(name: str = "", value: str = "", **more: Any) -> None:
            made.append((kind, {"name": name, "value": value, **more}))

        return make

    class Value:
        def __init__(self, name: str) -> None:
            self.name = name

        def perform(self, context: dict[str, str]) -> str:
            return context[self.name]

    launch = ModuleType("launch")
    launch.LaunchDescription = list  # type: ignore[attr-defined]
    actions, substitutions = ModuleType("launch.actions"), ModuleType("launch.substitutions")
    for kind in ("DeclareLaunchArgument", "ExecuteProcess", "OpaqueFunction", "SetEnvironmentVariable"):
        setattr(actions, kind, noted(kind))
    substitutions.LaunchConfiguration = Value  # type: ignore[attr-defined]
    for module in (launch, actions, substitutions):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    runpy.run_path(str(PACKAGE / "launch" / "live.launch.py"))["generate_launch_description"]()
    values = {one["name"]: one["default_value"] for kind, one in made if kind == "DeclareLaunchArgument"}
    (start,) = [one["function"] for kind, one in made if kind == "OpaqueFunction"]
    assert arguments.keys() <= values.keys()
    start(values | arguments)
    (process,) = [one for kind, one in made if kind == "ExecuteProcess"]
    return process


def test_the_workspace_installs_what_it_names(monkeypatch: pytest.MonkeyPatch) -> None:
    said: dict[str, Any] = {}
    setuptools = ModuleType("setuptools")
    setuptools.setup = said.update  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "setuptools", setuptools)
    runpy.run_path(str(PACKAGE / "setup.py"))
    files = [file for _, group in said["data_files"] for file in group]
    assert [file for file in files if not (PACKAGE / file).is_file()] == []
    name = ElementTree.parse(PACKAGE / "package.xml").getroot().findtext("name")
    assert (PACKAGE / "resource" / str(name)).is_file() and f"share/{name}/launch" in dict(said["data_files"])


def test_ros2_bevviz_runs_the_program_apart_from_ros(tmp_path: Path) -> None:
    (tmp_path / "ros2cli").mkdir()
    (tmp_path / "ros2cli" / "command.py").write_text("class CommandExtension: pass\n")
    script = (
        "import argparse; from bevviz_ros.command import BevvizCommand as C; p = argparse.ArgumentParser();"
        "c = C(); c.add_arguments(p, 'ros2'); raise SystemExit(c.main(parser=p, args=p.parse_args()))"
    )
    fake = tmp_path / "bevviz"
    fake.write_text('#!/bin/sh\necho "$@" "path: $PYTHONPATH"\n')
    environment = {
        "PYTHONPATH": f"{tmp_path}:{PACKAGE}",
        "BEVVIZ_PROGRAM": str(fake),
        "PATH": "/usr/bin:/bin",
    }

    def typed() -> str:
        command = [sys.executable, "-c", script, "why", "--at", "3"]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=False).stdout

    fake.chmod(0o755)
    assert typed() == "why --at 3 path: \n"
    fake.unlink()
    assert (
        typed() == f"{fake}: No such file or directory: install bevviz there, or name it in BEVVIZ_PROGRAM\n"
    )
