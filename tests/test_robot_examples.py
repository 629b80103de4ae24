"""The unit and the launch file under examples/robot say what bevviz and systemd take."""

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

import pytest

from bevviz.cli import _parser
from bevviz.config.reloading import ReloadableConfig
from tests.support.ros_graphs import own_graph
from tests.support.waiting import PATIENCE

EXAMPLES = Path(__file__).parents[1] / "examples" / "robot"
CONFIG = EXAMPLES / "robot.yaml"


def unit() -> configparser.ConfigParser:
    parser = configparser.ConfigParser(interpolation=None)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read_string((EXAMPLES / "bevviz.service").read_text().replace("\\\n", " "))
    return parser


def settings_of(arguments: list[str]) -> ReloadableConfig:
    """Return the settings of a command line with the configuration file of the example."""
    options = _parser()[0].parse_args(arguments)
    assert options.config == Path("/etc/bevviz/robot.yaml")
    given = [*options.set, f"live.nice={options.nice}"]
    return ReloadableConfig(
        CONFIG, given if options.flight is None else [*given, f"live.flight_time={options.flight}"]
    )


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
        there.write_text((EXAMPLES / "bevviz.service").read_text().replace(program, sys.executable))
        done = subprocess.run([verify, "verify", str(there)], capture_output=True, text=True, check=False)
        assert [line for line in done.stderr.splitlines() if "bevviz.service" in line] == []


def test_the_command_of_the_unit_runs_and_ends(tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs rclpy: pip install 'bevviz[ros]'")
    _, *arguments = shlex.split(unit()["Service"]["ExecStart"])
    places = {"/etc/bevviz/robot.yaml": str(CONFIG), "live.flight_folder=/var/lib/bevviz": "live.every=1"}
    command = [sys.executable, "-m", "bevviz", *(places.get(argument, argument) for argument in arguments)]
    with own_graph() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
        patch.setenv("PYTHONPATH", str(EXAMPLES.parents[1]))
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
    made = described(monkeypatch)
    (process,) = [args for kind, args in made if kind == "ExecuteProcess"]
    defaults = {args["name"]: args["default_value"] for kind, args in made if kind == "DeclareLaunchArgument"}

    def text(part: Any) -> str:
        if isinstance(part, list):
            return "".join(map(text, part))
        return defaults[part[1]["name"]] if isinstance(part, tuple) else str(part)

    program, *arguments = map(text, process["cmd"])
    assert program == "/opt/bevviz/bin/bevviz" and process["respawn"] is True
    assert arguments[-3:] == ["--ros-args", "-r", "__ns:=/"]
    settings = settings_of(arguments)
    assert settings.config.detector.model == "" and settings.config.live.flight_folder == "/var/lib/bevviz"


def described(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, dict[str, Any]]]:
    """Return the kind and the arguments of each action in the launch file, without an installed ROS."""

    def noted(kind: str) -> Any:
        def make(name: Any = None, value: Any = None, **more: Any) -> tuple[str, dict[str, Any]]:
            return kind, {"name": name, "value": value, **more} if name is not None else more

        return make

    kinds = {
        "launch.actions": ("DeclareLaunchArgument", "ExecuteProcess", "SetEnvironmentVariable"),
        "launch.substitutions": ("LaunchConfiguration",),
    }
    launch = ModuleType("launch")
    launch.LaunchDescription = list  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "launch", launch)
    for name, inside in kinds.items():
        module = ModuleType(name)
        for kind in inside:
            setattr(module, kind, noted(kind))
        monkeypatch.setitem(sys.modules, name, module)
    said: list[tuple[str, dict[str, Any]]] = runpy.run_path(str(EXAMPLES / "bevviz.launch.py"))[
        "generate_launch_description"
    ]()
    return said
