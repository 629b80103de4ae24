"""``report --check`` on reports that are damaged, or that somebody made to do harm: one clear line each."""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr

from bevviz.cli import main
from bevviz.config import Config, config_yaml
from bevviz.recording import entities, rerun_cli
from tests.support import bags
from tests.support.commands import Capture, error_of
from tests.support.recordings import Recording


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a report of three scans. Tests must not change it."""
    folder = tmp_path_factory.mktemp("report")
    drive = bags.write(folder / "drive", bags.small_items(scans=3))
    call = ["report", str(drive), "--at", "0.1", "--before", "0", "--after", "0.1", "--model", "demo"]
    assert main([*call, "-o", str(folder / "bug.rrd")]) == 0
    return folder


@pytest.fixture(autouse=True)
def report(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Copy the report into the working directory."""
    monkeypatch.chdir(tmp_path)
    for name in ("bug.rrd", "bug.mcap", "bug.html"):
        shutil.copy(made / name, name)
    yield


def about(made: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(Recording(made / "bug.rrd").static["/__properties/report"]["about"][0])
    return found


def forge(info: str, config: str, stages: Any = None, arrays: Any = None) -> None:
    """Replace the report's recording by one with these statements about itself."""
    with rr.RecordingStream("bevviz") as recording:
        recording.save("bug.rrd")
        recording.send_property(entities.PROPERTY, rr.AnyValues(config=config))
        recording.send_property("report", rr.AnyValues(about=info))
        if stages is not None:
            recording.set_time(entities.FRAME, sequence=0)
            recording.log(entities.DIGEST, rr.AnyValues(stages=stages, arrays=arrays))
    Path("bug.html").unlink()


def instead(name: str, make: Callable[[str], object]) -> None:
    Path(name).unlink()
    make(name)


@pytest.mark.long
def test_a_sound_report_passes(capsys: Capture) -> None:
    assert main(["report", "--check", "bug.rrd"]) == 0
    assert "the recording is, byte for byte, the file" in capsys.readouterr().out
    Path("bug.html").unlink()
    assert main(["report", "--check", "bug.rrd"]) == 0
    assert "there is no page beside it" in capsys.readouterr().out


@pytest.mark.long
@pytest.mark.parametrize("name", ["bug.rrd", "bug.mcap"])
def test_every_changed_byte_is_detected(name: str, capsys: Capture) -> None:
    sound, rng = Path(name).read_bytes(), random.Random(0)
    for at in [0, len(sound) - 1, *(rng.randrange(len(sound)) for _ in range(4))]:
        changed = bytearray(sound)
        changed[at] ^= 1 << rng.randrange(8)
        Path(name).write_bytes(changed)
        assert main(["report", "--check", "bug.rrd"]) in (1, 2), at
        out, said = capsys.readouterr()
        told = "not the file that" in out + said or "cannot be read" in said or "no bag" in said
        assert told and "Traceback" not in said and "bevviz itself" not in said, (at, out, said)


@pytest.mark.long
def test_damage_without_a_page_is_detected(capsys: Capture) -> None:
    """Among 600 kB some bytes are only shown: what is compared is found, and nothing breaks."""
    Path("bug.html").unlink()
    sound, rng = Path("bug.rrd").read_bytes(), random.Random(1)
    for _ in range(12):
        changed = bytearray(sound)
        for _ in range(3):
            changed[rng.randrange(len(sound))] ^= 1 << rng.randrange(8)
        Path("bug.rrd").write_bytes(changed)
        status = main(["report", "--check", "bug.rrd"])
        out, said = capsys.readouterr()
        assert status in (0, 1, 2) and "bevviz itself" not in said, said
        assert status == 2 or "may have been changed" in out or "differ" in out


def damage_that_breaks_the_reader(recording: Path) -> None:
    """Change where a buffer lies in a chunk, until Rerun's own program breaks on it."""
    sound = recording.read_bytes()
    for found in re.finditer(rb"\x04\x20\x00", sound):  # of LZ4: the distance between two of these places
        changed = bytearray(sound)
        changed[found.end() - 1] ^= 2
        recording.write_bytes(changed)
        verify = [rerun_cli.rerun_program(), "rrd", "verify", str(recording)]
        if subprocess.run(verify, capture_output=True, check=False).returncode > 100:
            return
    pytest.fail("nothing breaks the reader: is there need of bevviz.recording.rerun_cli.check_decodes?")


@pytest.mark.long
@pytest.mark.parametrize(
    "command",
    [
        ["report", "--check", "bug.rrd"],
        ["why", "bug.rrd", "--at-frame", "0"],
        ["compare", "bug.rrd", "--set-b", "clustering.eps=0.8"],
    ],
    ids=lambda command: str(command[0]),
)
def test_damage_that_breaks_the_reader_is_one_line(
    command: list[str], capfd: pytest.CaptureFixture[str]
) -> None:
    """A panic in a thread of Rerun's reader would end the process that reads."""
    Path("bug.html").unlink()
    damage_that_breaks_the_reader(Path("bug.rrd"))
    assert main(command) == 2
    said = capfd.readouterr().err
    assert "bug.rrd" in said and "it is damaged" in said and "panic" not in said


ZIP = np.frombuffer(b"PK\x03\x04 this is no archive", np.uint8)

FORGED: dict[str, tuple[Callable[[Path], object], str]] = {
    "deep YAML": (lambda made: forge(json.dumps(about(made)), "voxel: " + "[" * 3000), "too deep"),
    "a count of .inf": (
        lambda made: forge(json.dumps(about(made)), "clustering: {min_points: .inf}"),
        "clustering.min_points must be a finite number",
    ),
    "YAML that is none": (lambda made: forge(json.dumps(about(made)), "a: ]["), "bug.rrd"),
    "deep JSON": (lambda made: forge("[" * 100_000, config_yaml(Config())), "another version"),
    "a time that is infinite": (
        lambda made: forge(json.dumps({**about(made), "low": float("inf")}), config_yaml(Config())),
        "another version",
    ),
    "names that are no text": (
        lambda made: forge(json.dumps({**about(made), "names": [1]}), config_yaml(Config())),
        "another version",
    ),
    "versions that are none": (
        lambda made: forge(json.dumps({**about(made), "provenance": 5}), config_yaml(Config())),
        "another version",
    ),
    "fingerprints that are an archive": (
        lambda made: forge(json.dumps(about(made)), config_yaml(Config()), ["00 cloud"], ZIP),
        "cannot be read as a report",
    ),
    "fingerprints that are numbers": (
        lambda made: forge(json.dumps(about(made)), config_yaml(Config()), [1, 2], np.zeros(3, np.uint8)),
        "cannot be read as a report",
    ),
    "no bag": (lambda made: Path("bug.mcap").unlink(), "bug.mcap: the bag of the report is not there"),
    "a folder for a bag": (
        lambda made: instead("bug.mcap", os.mkdir),
        "bug.mcap: the bag of the report is not there",
    ),
    "a pipe for a bag": (
        lambda made: instead("bug.mcap", os.mkfifo),
        "bug.mcap: the bag of the report is not there",
    ),
    "a pipe for a recording": (
        lambda made: instead("bug.rrd", os.mkfifo),
        "bug.rrd: it is no file",
    ),
    "an empty bag": (
        lambda made: Path("bug.mcap").write_bytes(b""),
        "bug.mcap is not the file that the report was made with",
    ),
    "half a recording": (
        lambda made: Path("bug.rrd").write_bytes(Path("bug.rrd").read_bytes()[:9000]),
        "changed or damaged",
    ),
    "an empty recording": (lambda made: Path("bug.rrd").write_bytes(b""), "changed or damaged"),
    "another page": (
        lambda made: (
            Path("bug.html").write_text(f'<p id="seal">SHA-256 of the recording: {"0" * 64}</p>') and None
        ),
        "changed or damaged",
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("name", FORGED)
def test_malicious_reports_are_one_line(name: str, made: Path, capsys: Capture) -> None:
    make, said = FORGED[name]
    make(made)
    assert said in error_of(capsys, "report", "--check", "bug.rrd")


def test_a_report_without_frames_is_not_confirmed(made: Path, capsys: Capture) -> None:
    info = about(made)
    forge(json.dumps({**info, "interrupted": True}), config_yaml(Config()))
    assert main(["report", "--check", "bug.rrd"]) == 1
    assert "the same" not in capsys.readouterr().out
