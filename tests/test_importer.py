"""What Rerun's viewer runs on the files that it opens."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from bevviz.cli import importer
from bevviz.cli.importer import NOT_OURS, run
from tests.support import bags
from tests.support.recordings import Recording, verify
from tests.support.waiting import PATIENCE

COMMAND = [sys.executable, "-c", "from bevviz.cli.importer import main; main()"]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("importer") / "drive"
    return bags.write(folder, bags.small_items(scans=3), form="sqlite3")


@pytest.mark.long
def test_a_bag_is_a_recording_on_standard_output(drive: Path, tmp_path: Path) -> None:
    (bag,) = drive.glob("*.db3")
    about = [
        "--application-id",
        "drive",
        "--recording-id",
        "one",
        "--opened-recording-id",
        "other",
        "--static",
    ]
    done = subprocess.run([*COMMAND, str(bag), *about], capture_output=True, check=False, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr.decode()
    saved = tmp_path / "out.rrd"
    saved.write_bytes(done.stdout)
    verify(saved)
    recording = Recording(saved)
    assert sorted(recording.at["/world/velodyne/points"]["Points3D:positions"]) == [0, 1, 2]
    assert recording.blueprints == 1


def test_foreign_files_are_declined(drive: Path, tmp_path: Path) -> None:
    other = tmp_path / "picture.png"
    other.touch()
    assert run([str(other)]) == NOT_OURS
    assert run([str(tmp_path)]) == NOT_OURS
    loaded = "import sys; from bevviz.cli.importer import run; run(['x.png']); print('numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", loaded], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_a_closed_viewer_ends_the_importer_silently(drive: Path) -> None:
    (bag,) = drive.glob("*.db3")
    with subprocess.Popen([*COMMAND, str(bag)], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as importing:
        assert importing.stdout is not None and importing.stderr is not None
        importing.stdout.close()
        said = importing.stderr.read().decode()
        assert importing.wait(PATIENCE) == 1
    assert "Traceback" not in said


def asked(*paths: Path, monkeypatch: pytest.MonkeyPatch) -> list[tuple[Path, str, str | None]]:
    """Return the imports, as application and recording, when Rerun opens a folder with all its files."""
    imported: list[tuple[Path, str, str | None]] = []
    monkeypatch.setattr(importer, "_import", lambda *asked: imported.append(asked))
    codes = [run([str(p), "--application-id", paths[0].stem, "--recording-id", "proposed"]) for p in paths]
    assert not any(codes[1:])  # else Rerun says that it cannot load them
    return imported


def test_each_bag_of_an_opened_folder_comes_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "drive"
    folder.mkdir()
    about, first, second = (folder / name for name in ("metadata.yaml", "drive.db3", "drive_1.db3"))
    about.touch()
    first.touch()
    assert asked(folder, about, first, monkeypatch=monkeypatch) == [(first, "drive", "proposed")]
    moved = first.rename(folder / "drive_0.db3")
    second.touch()
    assert asked(folder, about, moved, second, monkeypatch=monkeypatch) == [(folder, "drive", "proposed")]
    imported = asked(second, monkeypatch=monkeypatch)  # by itself: its own name is proposed
    assert [path for path, *_ in imported] == [second]
    assert run([str(about), "--application-id", about.stem]) == NOT_OURS


def test_bags_of_a_folder_are_not_laid_over_each_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bags = [tmp_path / "one.db3", tmp_path / "two.bag"]
    for bag in bags:
        bag.touch()
    assert asked(tmp_path, *bags, monkeypatch=monkeypatch) == [(bags[0], "one", None), (bags[1], "two", None)]


def test_a_bag_that_cannot_be_read_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = tmp_path / "drive.db3"
    bag.write_bytes(b"")
    assert run([str(bag)]) == 1
    assert "drive.db3: the file is empty" in capsys.readouterr().err


@pytest.mark.long
def test_reruns_own_command_finds_it(drive: Path, tmp_path: Path) -> None:
    (bag,) = drive.glob("*.db3")
    saved = tmp_path / "out.rrd"
    scripts = sysconfig.get_path("scripts")
    if not shutil.which("rerun-importer-bevviz", path=scripts):
        pytest.skip("bevviz is not installed where Python is")
    command = [
        sys.executable,
        "-m",
        "rerun",
        str(bag),
        "--save",
        str(saved),
        "--bind",
        "127.0.0.1",
        "--port",
        "0",
    ]
    found = {**os.environ, "PATH": os.pathsep.join([scripts, os.environ["PATH"]])}
    subprocess.run(command, capture_output=True, check=True, timeout=PATIENCE, env=found)
    assert "/world/velodyne/points" in Recording(saved).at
