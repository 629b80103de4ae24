"""The pages hold: what they show is what comes out, and their links lead somewhere."""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Iterator
from html import unescape
from pathlib import Path

import pytest

from bevviz.cli import main, make_parser
from tests.support.recordings import Recording
from tools import make_reference

ROOT = Path(__file__).resolve().parents[1]
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
Capture = pytest.CaptureFixture[str]


def examples(page: str) -> Iterator[tuple[str, str]]:
    """Commands of a page, and what it shows of their output."""
    text = (ROOT / page).read_text()
    for block in re.findall(r"^```console\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        yield from re.findall(r"^\$ (.*)\n((?:(?!\$ ).*\n)*)", block, re.MULTILINE)


def project_on(page: str) -> str:
    """Return the project file that a page shows."""
    found = re.search(r"^```toml\n(.*?)^```$", (ROOT / page).read_text(), re.MULTILINE | re.DOTALL)
    assert found is not None
    return found[1]


def same(shown: str, said: str) -> bool:
    """Word for word; numbers may differ a little where another processor adds up in another order."""
    texts = [" ".join(text.split()) for text in (shown, said)]
    words, numbers = ([find(text) for text in texts] for find in (NUMBER.split, NUMBER.findall))
    return words[0] == words[1] and [float(n) for n in numbers[0]] == pytest.approx(
        [float(n) for n in numbers[1]], rel=0.02, abs=0.02
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("tutorial")


@pytest.mark.long
def test_the_tutorial_and_the_page_of_why_show_what_comes_out(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    """In one folder, one after the other, as a reader would; what a page opens for the eye is left out."""
    monkeypatch.chdir(folder)
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BEVVIZ_MODEL", "NO_COLOR", "FORCE_COLOR"):
        monkeypatch.delenv(name, raising=False)
    done: list[str] = []
    why = [e for e in examples("docs/why.md") if e[1]]
    for command, shown in [*examples("docs/index.md"), *why]:
        program, *arguments = shlex.split(command)
        if program == "printf":
            Path("bevviz.toml").write_text(arguments[0].replace("\\n", "\n"))
            continue
        assert program == "bevviz", command
        if command == "bevviz drive.mcap" or command in done:
            continue
        assert main(arguments) == 0, command
        out = capsys.readouterr().out
        first = out if shown.count("\n") > 1 else out[: out.find("\n") + 1]
        assert not shown or same(shown, first), f"{command}:\n{first}"
        done.append(command)
    assert len(done) >= 6
    assert {path.name for path in folder.iterdir()} >= {"bug.rrd", "bug.html", "bug.mcap", "compare.rrd"}
    check_report(Path("bug.rrd"))
    Path("bevviz.toml").write_text(project_on("docs/index.md"))
    assert main(["why", "drive.mcap", "--at-frame", "30", "--box", "479,229"]) == 0
    assert "The car at 10.1 m was reported" in capsys.readouterr().out


def check_report(rrd: Path) -> None:
    """Check that page and recording open on the cause, and that the subject is marked in its frame alone."""
    text = unescape(re.sub(r"<[^>]*>", " ", rrd.with_suffix(".html").read_text()))
    parts = (
        "Missed: the car at 10.1 m",
        "because it was taken for ground",
        "in frame 30 of the drive",
        "ground.distance_threshold=0.3",
    )
    places = [text.index(part) for part in (*parts, "The whole frame")]
    assert places == sorted(places)
    recording = Recording(rrd)
    document = recording.static["/report"]["TextDocument:text"][0]
    assert all(part in document.replace("\\", "") for part in parts)
    for entity in ("/explain/why/place", "/explain/why/points", "/explain/why/zed/place", "/bev/overlay/why"):
        drawn = {
            name: frames for name, frames in recording.at[entity].items() if not name.startswith("Clear")
        }
        assert drawn and all(set(frames) == {1} for frames in drawn.values()), entity
    assert max(row["report"] for row in recording.rows["/explain"] if row.get("report") is not None) == 1
    assert {row["StateChange:state"][0] for row in recording.rows["/explain/states/report"]} == {
        "the car at 10.1 m: ground",
        "",
    }


def test_the_page_of_projects_explains_as_the_command_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bevviz.toml").write_text("[clustering]\neps = 0.6\n")
    (command, shown), refused, trusted = examples("docs/project.md")
    assert main(shlex.split(command)[1:]) == 0
    assert capsys.readouterr().out == shown
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    Path("bevviz.toml").write_text('[clustering]\nmethod = "tools:cells"\n')
    Path("tools.py").touch()
    assert main(shlex.split(refused[0])[1:]) == 2
    assert capsys.readouterr().err == refused[1]
    assert main(shlex.split(trusted[0])[1:]) == 0
    assert capsys.readouterr().out == trusted[1]


def test_the_project_file_that_is_shown_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from bevviz.config import load
    from bevviz.config.project import read_project_layers

    monkeypatch.chdir(tmp_path)
    Path("bevviz.toml").write_text(project_on("docs/project.md"))
    Path("robot.yaml").write_text("bev: {range_x: 20}\n")
    config = load(layers=read_project_layers(tmp_path, {}))
    assert (config.detector.model, config.clustering.eps) == ("models/yolo11n.onnx", 0.6)
    assert config.bev.range_x == 20


def test_links_of_the_pages_that_are_no_part_of_the_site() -> None:
    """Those of the site are checked by 'make check', which builds it."""
    for page in ("README.md", "CONTRIBUTING.md", "tests/README.md"):
        path = ROOT / page
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", path.read_text()):
            assert "://" in target or (path.parent / target).exists(), f"{page}: {target}"


def test_every_command_is_on_a_page() -> None:
    text = "\n".join(
        path.read_text() for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    )
    assert not [name for name in make_parser()[1] if not re.search(rf"bevviz {name}\b", text)]


def test_every_command_and_option_on_a_page_exists() -> None:
    """So that a page cannot tell of an option that was renamed."""
    from bevviz.cli.parser import Parser

    program, _ = make_parser()
    (commands,) = (a.choices for a in program._actions if isinstance(a, argparse._SubParsersAction))
    wrong = []
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        for command, _ in examples(str(path.relative_to(ROOT))):
            words = command.split(" #")[0].split()
            if words[0] != "bevviz" or len(words) < 2 or words[1].startswith("-"):
                continue
            parser = commands.get(words[1], commands["open"])
            assert isinstance(parser, Parser)
            known = parser._option_string_actions
            options = [w.partition("=")[0] for w in words[1:] if re.match(r"--[a-z]", w)]
            wrong += [f"{path.name}: {command}: {o}" for o in options if o not in known]
    assert not wrong


def test_the_page_of_the_reference_is_that_of_the_code() -> None:
    kept = make_reference.PAGE.read_text(encoding="utf-8")
    assert kept == make_reference.text(), "run: python -m tools.make_reference"
