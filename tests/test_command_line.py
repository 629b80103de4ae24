"""The command line itself: what it suggests, how loud it is, in which colours."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from urllib.request import urlopen

import pytest

from bevviz.cli import main
from bevviz.cli.outputs import program, speak
from tests import bags

Capture = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "NO_COLOR", "FORCE_COLOR", "BEVVIZ_MODEL"):
        monkeypatch.delenv(name, raising=False)


def refused(capsys: Capture, *arguments: str) -> list[str]:
    """The two lines about a call that argparse refuses."""
    with pytest.raises(SystemExit) as ended:
        main(list(arguments))
    assert ended.value.code == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert lines[0].startswith("bevviz: error: ")
    return lines


# --- what was meant ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "error", "usage"),
    [
        ("inof drive.mcap", "'inof' is no command, nor a file; did you mean 'info'?", "bevviz COMMAND"),
        ("bag drive.mcap --modle y", "unknown option --modle; did you mean '--model'?", "bevviz bag PATH"),
        ("why d --att=3", "unknown option --att; did you mean '--at'?", "bevviz why PATH (--at TIME |"),
        ("config --preset refrence", "did you mean 'reference'?", "bevviz config"),
        ("batch bags", "required: -o/--output", "bevviz batch [BAG] --output DIR"),
        ("--versoin", "unknown option --versoin; did you mean '--version'?", "bevviz COMMAND"),
        ("snap --zebra", "unknown option --zebra", "bevviz snap [FILE.rrd]"),
    ],
)
def test_a_slip_gets_the_nearest_name_and_its_commands_usage(
    capsys: Capture, given: str, error: str, usage: str
) -> None:
    said, second = refused(capsys, *given.split())
    assert said.endswith(error)
    assert second.startswith(f"usage: {usage}")


def test_a_file_that_is_not_there_is_no_command(capsys: Capture) -> None:
    Path("drive.mcap").touch()
    said, _ = refused(capsys, "drvie.mcap")
    assert said == "bevviz: error: drvie.mcap: no such file or folder; did you mean 'drive.mcap'?"


def test_what_is_for_ros_is_left_alone(capsys: Capture) -> None:
    assert main(["info", "--ros-args", "--remap", "a:=b"]) == 2
    assert "which bag?" in capsys.readouterr().err


def test_without_a_word_the_help_is_shown(capsys: Capture) -> None:
    assert main([]) == 2
    assert "examples:" in capsys.readouterr().out


# --- loud and quiet, in colour and without ----------------------------------------------------------


def test_quiet_leaves_results_and_warnings(tmp_path: Path, capsys: Capture) -> None:
    items = [item for item in bags.small_items(scans=4) if item.topic != bags.INFO]
    bags.write(tmp_path / "drive", items)
    run = ["bag", "drive", "--save", "out.rrd"]
    try:
        assert main([*run, "--quiet"]) == 0
        quiet = capsys.readouterr().err.splitlines()
        assert quiet and all(line.startswith("bevviz: warning: ") for line in quiet)
        assert Path("out.rrd").stat().st_size
        assert main(run) == 0
        assert {*quiet, "bevviz: 4 frames in out.rrd"} <= {*capsys.readouterr().err.splitlines()}
    finally:
        speak(quiet=False)


def test_colour_is_asked_for_and_refused(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert main(["bag", "absent.mcap"]) == 2
    assert capsys.readouterr().err.startswith("\x1b[1;31mbevviz: error:\x1b[0m absent.mcap")
    monkeypatch.setenv("NO_COLOR", "1")
    assert main(["bag", "absent.mcap"]) == 2
    assert capsys.readouterr().err.startswith("bevviz: error: absent.mcap")


# --- without a display ---------------------------------------------------------------------------------


def test_a_demo_without_a_display_ends_with_what_shows_it(
    monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    """The line is typed as it stands. A project's network (there is none of that name) is not the demo's."""
    monkeypatch.setenv("BEVVIZ_MODEL", "absent.onnx")
    monkeypatch.delenv("BROWSER", raising=False)
    monkeypatch.setattr("sys.argv", [str(Path(sys.executable).with_name("bevviz"))])
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), prepend=os.pathsep)
    assert main(["demo", "--frames", "1"]) == 0
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == "bevviz: to look at it in a browser: bevviz demo.rrd"

    pages: list[str] = []

    def visit() -> None:
        (address,) = re.findall(r"viewer at (http://\S+)", capsys.readouterr().err)
        with urlopen(address, timeout=60) as page:
            pages.append(page.read().decode())

    monkeypatch.setattr("bevviz.cli.workbench.wait_for_interrupt", visit)
    assert main(["demo.rrd"]) == 0
    assert "rerun" in pages[0].lower()


def test_a_program_that_is_not_on_the_path_is_named_by_its_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.setattr("sys.argv", [".venv/bin/bevviz"])
    assert program() == ".venv/bin/bevviz"
    monkeypatch.setattr("sys.argv", ["/somewhere/bevviz/__main__.py"])
    assert program().endswith(" -m bevviz")


def test_what_is_no_recording_is_not_shown(capsys: Capture) -> None:
    Path("x.rrd").write_text("nothing")
    assert main(["x.rrd"]) == 2
    assert "x.rrd" in capsys.readouterr().err
