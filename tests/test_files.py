"""Files that are written: as a whole or not at all, by one process at a time, never over what is read."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bevviz.cli import main
from bevviz.errors import UserError
from bevviz.files import Scratch, save, unfinished, written
from tests import bags
from tests.recordings import Recording, verify
from tests.test_cli import Capture, environment, error_of
from tests.waiting import PATIENCE

pytestmark = pytest.mark.usefixtures("elsewhere")


# --- whole or not at all -----------------------------------------------------------------------


def test_a_file_gets_its_name_at_the_end() -> None:
    target = Path("a.rrd")
    target.write_text("old")
    with written(target, "recording") as given:
        assert given.path.name == "a.partial.rrd" and not given.leftover
        given.path.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new" and not given.path.exists()


def test_an_error_leaves_the_old_and_says_where_the_new_is() -> None:
    target = Path("a.rrd")
    target.write_text("old")
    half = r"^no more; what was made until then is in a\.partial\.rrd$"
    with pytest.raises(UserError, match=half), written(target, "recording") as given:
        given.path.write_text("half")
        raise UserError("no more")
    assert (target.read_text(), Path("a.partial.rrd").read_text()) == ("old", "half")
    with written(target, "recording") as given:
        assert given.leftover and given.path.read_text() == ""
    with pytest.raises(UserError, match=r"^nothing$"), written(target, "recording"):
        raise UserError("nothing")
    assert not Path("a.partial.rrd").exists()


def test_one_process_at_a_time() -> None:
    with written(Path("a.rrd"), "recording") as given:
        given.path.write_text("first")
        with pytest.raises(UserError, match="another process is writing it"), written(Path("a.rrd"), "x"):
            pass
    assert Path("a.rrd").read_text() == "first"


def test_two_runs_into_one_recording(tmp_path: Path, capsys: Capture) -> None:
    """The second ends at once, the first is what it would have been."""
    bags.write(Path("drive"), bags.small_items(scans=3))
    command = [sys.executable, "-m", "bevviz.cli", "demo", "--frames", "12", "--save", "out.rrd"]
    with subprocess.Popen(command, env=environment(), stderr=subprocess.DEVNULL) as first:
        try:
            deadline = time.monotonic() + 60
            while not Path("out.partial.rrd").exists() and time.monotonic() < deadline:
                time.sleep(0.05)
            said = error_of(capsys, "bag", "drive", "--save", "out.rrd")
            assert "out.rrd: another process is writing it" in said
            assert first.wait(PATIENCE) == 0
        finally:
            first.kill()
    verify(tmp_path / "out.rrd")
    assert len(Recording(tmp_path / "out.rrd").rows["/bev"]) == 12


def test_a_link_and_what_is_no_file() -> None:
    Path("real").mkdir()
    Path("latest.rrd").symlink_to("real/a.rrd")
    with written(Path("latest.rrd"), "recording") as given:
        given.path.write_text("x")
    assert Path("latest.rrd").is_symlink() and Path("real/a.rrd").read_text() == "x"
    os.mkfifo("pipe.rrd")
    with pytest.raises(UserError, match="it is no file"), written(Path("pipe.rrd"), "recording"):
        pass


def test_a_text_is_whole_or_the_old_one(monkeypatch: pytest.MonkeyPatch) -> None:
    target = Path("a.csv")
    save(target, "old\r\n", "--csv")
    assert target.read_bytes() == b"old\r\n"

    def full(self: Path, text: str, **_: object) -> int:
        with self.open("w") as file:
            file.write(text[:2])
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_text", full)
        with pytest.raises(UserError, match=r"^--csv a\.csv: cannot write the file: No space left"):
            save(target, "new", "--csv")
    assert target.read_bytes() == b"old\r\n"
    save(target, "new", "--csv")
    assert [path.name for path in Path().iterdir()] == ["a.csv"]
    with pytest.raises(UserError, match=r"^--csv .*none/a\.csv: cannot write the file: No such file"):
        save(Path("none/a.csv"), "x", "--csv")
    Path("folder").mkdir()
    with pytest.raises(UserError, match="--csv folder: cannot write the file: Is a directory"):
        save(Path("folder"), "x", "--csv")


def test_a_text_goes_into_a_pipe(capfd: Capture) -> None:
    save(Path("/dev/stdout"), "a,b\n", "--csv")
    assert capfd.readouterr().out == "a,b\n"


@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("compare", ["--csv", "a.csv", "--json", "b.json", "--save", "c.rrd", "--set-b", "voxel.size=0.3"]),
        ("sweep", ["--csv", "a.csv", "--save", "c.rrd", "--set", "voxel.size=0.2,0.3"]),
        ("calib", ["--write", "a.yaml", "--save", "c.rrd"]),
        ("report", ["--at", "0", "-o", "c.rrd", "--force"]),
    ],
)
def test_every_output_of_a_command_gets_its_name_when_it_is_whole(
    command: str, options: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is opened for writing under the name that it has in the end."""
    bags.write(Path("drive"), bags.small_items(scans=2))
    here = f"{Path.cwd()}{os.sep}"
    opened: set[str] = set()

    def watch(event: str, given: tuple[object, ...]) -> None:
        if event == "open" and isinstance(given[0], str | Path) and watching:
            path, flags = Path(given[0]).absolute(), given[2]
            if isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR) and str(path).startswith(here):
                opened.add(path.name)

    watching = True
    sys.addaudithook(watch)
    try:
        assert main([command, "drive", *options]) == 0
    finally:
        watching = False
    whole = {path.name for path in Path().rglob("*") if path.is_file()}
    assert len(whole) > 1 and opened
    assert not opened & whole


# --- never over what is read -------------------------------------------------------------------


def test_no_output_is_an_input(capsys: Capture) -> None:
    bags.write(Path("drive"), bags.small_items(scans=2))
    (bag,) = Path("drive").glob("*.mcap")
    before = bag.read_bytes()
    Path("link.rrd").symlink_to(bag)
    os.link(bag, "hard.rrd")
    Path("my.yaml").write_text("voxel:\n  size: 0.2\n")
    for output in ("link.rrd", "hard.rrd"):
        assert "is what is read" in error_of(capsys, "bag", "drive", "--save", output)
        assert "is what is read" in error_of(capsys, "report", bag, "--at", "0", "-o", output, "--force")
    assert "is what is read" in error_of(
        capsys, "calib", "drive", "--config", "my.yaml", "--write", "my.yaml"
    )
    assert "is what is read" in error_of(capsys, "compare", "drive", f"--json={bag}")
    assert "there is no folder no" in error_of(capsys, "compare", "drive", "--csv", "no/same.txt")
    both = ("--csv", "same.json", "--json", "same.json")
    assert "--json same.json: --csv writes that file" in error_of(capsys, "compare", "drive", *both)
    assert bag.read_bytes() == before and Path("my.yaml").read_text().startswith("voxel")


def test_a_link_to_another_bag(capsys: Capture) -> None:
    bags.write(Path("drive"), bags.small_items(scans=2))
    Path("other.mcap").write_text("another bag")
    Path("link.rrd").symlink_to("other.mcap")
    assert "it is a link to" in error_of(capsys, "bag", "drive", "--save", "link.rrd")
    assert Path("other.mcap").read_text() == "another bag"


# --- a disk that is full -----------------------------------------------------------------------


def test_a_full_disk_ends_the_run_early(tmp_path: Path) -> None:
    """As on a full disk, writing fails from some megabytes on; what is there can be read."""
    Path("out.rrd").write_text("an older result")
    limit = 12_000_000
    done = subprocess.run(
        [sys.executable, "-m", "bevviz.cli", "demo", "--frames", "1000", "--save", "out.rrd"],
        env=environment(),
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )
    errors = [line for line in done.stderr.splitlines() if line.startswith("bevviz: error")]
    assert done.returncode == 2 and len(errors) == 1, done.stderr[-2000:]
    assert "Traceback" not in done.stderr
    assert "its disk takes no more" in errors[0]
    assert "what was made until then is in out.partial.rrd" in errors[0]
    assert Path("out.rrd").read_text() == "an older result"
    frames = len(Recording(tmp_path / "out.partial.rrd").rows["/bev"])
    assert 0 < frames < 1000


# --- what a killed process leaves --------------------------------------------------------------


def test_a_temporary_folder_does_not_outlive_its_process_for_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    script = (
        "import os, signal, tempfile; tempfile.tempdir = os.getcwd()\n"
        "from bevviz.files import Scratch\n"
        "s = Scratch(); s.new(); os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], env=environment(), timeout=PATIENCE)
    assert done.returncode == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    mine = Scratch()
    mine.new()
    assert left.exists()  # too young: it might be in the making
    old = time.time() - 1000
    for folder in tmp_path.iterdir():
        os.utime(folder, (old, old))
    other = Scratch()
    other.new()
    assert not left.exists()
    assert len(list(tmp_path.iterdir())) == 2  # those that are in use stay
    mine.close()
    other.close()
    assert list(tmp_path.iterdir()) == []


def test_a_bag_that_needs_no_temporary_folder_makes_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bags.write(Path("drive"), bags.small_items(scans=2))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "absent"))
    assert main(["info", "drive"]) == 0


def test_the_name_of_an_unfinished_file_opens_with_what_knows_the_whole() -> None:
    assert unfinished(Path("runs/drive.v2.rrd")) == Path("runs/drive.v2.partial.rrd")
