"""The command line itself: what it suggests, how loud it is, in which colours."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from urllib.parse import unquote
from urllib.request import urlopen

import pytest

from bevviz.cli import main, outputs
from bevviz.cli.outputs import join_json_option, program, set_up_notes
from tests.support import bags, documented_json
from tests.support.waiting import PATIENCE, until

Capture = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "NO_COLOR", "FORCE_COLOR", "BEVVIZ_MODEL"):
        monkeypatch.delenv(name, raising=False)


def refused(capsys: Capture, *arguments: str) -> list[str]:
    """Return the two lines about a call that argparse refuses."""
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
def test_a_typo_gets_the_nearest_name_and_the_usage(
    capsys: Capture, given: str, error: str, usage: str
) -> None:
    said, second = refused(capsys, *given.split())
    assert said.endswith(error)
    assert second.startswith(f"usage: {usage}")


def test_a_file_that_is_not_there_is_no_command(capsys: Capture) -> None:
    Path("drive.mcap").touch()
    said, _ = refused(capsys, "drvie.mcap")
    assert said == "bevviz: error: drvie.mcap: no such file or folder; did you mean 'drive.mcap'?"


def test_arguments_for_ros_are_left_alone(capsys: Capture) -> None:
    assert main(["info", "--ros-args", "--remap", "a:=b"]) == 2
    assert "which bag?" in capsys.readouterr().err


def test_without_arguments_the_help_is_shown(capsys: Capture) -> None:
    assert main([]) == 2
    assert "examples:" in capsys.readouterr().out


# --- loud and quiet, in colour and without ----------------------------------------------------------


def test_a_broken_package_costs_its_own_command_only(
    capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = EntryPoint("lost", "no_such_package.command", "bevviz.commands")
    monkeypatch.setattr("bevviz.support.extensions.registered", lambda kind: {"lost": broken})
    with pytest.raises(SystemExit):
        main(["--help"])
    shown = capsys.readouterr()
    assert "recover" in shown.out and "lost" not in shown.out
    assert shown.err.startswith("bevviz: warning: the command 'lost' (no_such_package.command) cannot be")


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
        set_up_notes(quiet=False)


def test_colour_is_asked_for_and_refused(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert main(["bag", "absent.mcap"]) == 2
    assert capsys.readouterr().err.startswith("\x1b[1;31mbevviz: error:\x1b[0m absent.mcap")
    monkeypatch.setenv("NO_COLOR", "1")
    assert main(["bag", "absent.mcap"]) == 2
    assert capsys.readouterr().err.startswith("bevviz: error: absent.mcap")


# --- without a display ---------------------------------------------------------------------------------


def test_a_run_without_a_display_names_the_viewer_command(
    monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    """The line is typed as it stands. Without the workbench, the demo is such a run."""
    monkeypatch.setattr("bevviz.extras.demo.command.find_spec", lambda name: None)
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
        with urlopen(address, timeout=PATIENCE) as page:
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


def test_files_that_are_no_recordings_are_not_shown(capsys: Capture) -> None:
    Path("x.rrd").write_text("nothing")
    assert main(["x.rrd"]) == 2
    assert "x.rrd" in capsys.readouterr().err


# --- for programs ------------------------------------------------------------------------------------


def test_json_on_stdout_or_in_a_file(tmp_path: Path, capsys: Capture) -> None:
    """Of every command the form is held to its page, here of those that are quick on a small bag."""
    bags.write(tmp_path / "drive", bags.small_items(scans=6))
    assert main(["info", "--json", "drive"]) == 0
    info = json.loads(capsys.readouterr().out)
    documented_json.check(info, "bevviz.info/1")
    assert [camera["K"][0][0] for camera in info["cameras"]] == [60.0]
    assert info["transforms"]["velodyne"] == "base_link"

    swept = ["--set", "clustering.eps=0.5,0.6", "--frames", ":1"]
    assert main(["sweep", "drive", *swept, "--json", "sweep.json"]) == 0
    assert "clustering.eps" in capsys.readouterr().out
    sweep = json.loads(Path("sweep.json").read_text())
    documented_json.check(sweep, "bevviz.sweep/1")
    assert [run["values"] for run in sweep["runs"]] == [["0.5"], ["0.6"]]

    assert main(["compare", "drive", "--frames", ":1", "--json", "--save", "c.rrd"]) == 0
    documented_json.check(json.loads(capsys.readouterr().out), "bevviz.compare/1")
    assert main(["why", "drive", "--at-frame", "0", "--point", "5,0,0", "--json"]) == 0
    documented_json.check(json.loads(capsys.readouterr().out), "bevviz.why/1")


def test_json_never_takes_the_bag_for_its_file() -> None:
    assert join_json_option(["why", "--json", "drive.mcap"]) == ["why", "--json=-", "drive.mcap"]
    assert join_json_option(["why", "drive.mcap", "--json", "a.json"]) == [
        "why",
        "drive.mcap",
        "--json",
        "a.json",
    ]
    assert join_json_option(["why", "--json"]) == ["why", "--json"]


def completed(line: str) -> list[str]:
    """Return the completions that a shell offers behind a line."""
    given = {**os.environ, "_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line))}
    given |= {"_ARGCOMPLETE_IFS": "\n", "_ARGCOMPLETE_STDOUT_FILENAME": str(Path("offered").resolve())}
    Path("offered").touch()
    subprocess.run(
        [sys.executable, "-m", "bevviz"], env=given, check=True, capture_output=True, timeout=PATIENCE
    )
    return [word.strip() for word in Path("offered").read_text().split("\n")]


def test_a_shell_completes_names(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).resolve().parents[1]))
    assert set(completed("bevviz co")) == {"compare", "config", "completion"}
    assert completed("bevviz bag drive.mcap --mod") == ["--model"]
    assert completed("bevviz bag d --set clustering.ep") == ["clustering.eps="]
    assert main(["completion", "bash"]) == 0
    assert "bevviz" in capsys.readouterr().out


def test_the_arguments_of_a_browser_hold_no_token(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every user can read them. A private file leads to the page, and is deleted."""
    addresses: list[str] = []
    monkeypatch.setattr("webbrowser.open", addresses.append)
    monkeypatch.setattr(outputs, "BROWSER_START", 0.2)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("DISPLAY", ":0")
    outputs.announce("workbench", "http://127.0.0.1:9880/?token=s3cret#view=bev")
    outputs.announce("viewer", "http://127.0.0.1:9090/")
    first, second = addresses
    assert first.startswith("file://") and second == "http://127.0.0.1:9090/"
    file = Path(unquote(first.removeprefix("file://")))
    assert "s3cret" not in first and "/." not in str(file.relative_to(tmp_path))
    assert (file.stat().st_mode & 0o777, file.parent.stat().st_mode & 0o777) == (0o600, 0o700)
    assert 'content="0; url=http://127.0.0.1:9880/?token=s3cret#view=bev"' in file.read_text()
    until(lambda: not file.parent.exists())


def test_the_browser_of_a_remote_editor_gets_no_token(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("BROWSER", "helper")
    monkeypatch.setattr("webbrowser.open", lambda address: pytest.fail("no browser is started"))
    outputs.announce("workbench", "http://127.0.0.1:9880/?token=s3cret")
    assert "workbench at http://127.0.0.1:9880/?token=s3cret" in capsys.readouterr().err
