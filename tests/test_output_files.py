"""Files that are written: as a whole or not at all, by one process at a time, never over what is read."""

from __future__ import annotations

import errno
import os
import re
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from backports import zstd
from mcap.reader import make_reader
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat

from bevviz.bags.completion import complete
from bevviz.bags.mcap_writer import McapWriter
from bevviz.cli import main
from bevviz.errors import UserError
from bevviz.support.files import atomic_write, claim_target, save_text, unfinished_files
from bevviz.support.scratch_folder import ScratchFolder
from bevviz.workbench.buffers import RecordingBuffer
from tests.support import bags
from tests.support.commands import Capture, environment, error_of
from tests.support.recordings import Recording, verify
from tests.support.small_disk import small_disk
from tests.support.waiting import PATIENCE

pytestmark = pytest.mark.usefixtures("elsewhere")


# --- whole or not at all -----------------------------------------------------------------------


def test_a_file_gets_its_name_at_the_end() -> None:
    target = Path("a.rrd")
    target.write_text("old")
    with atomic_write(target, "recording") as given:
        assert re.fullmatch(r"a\.partial-[0-9a-f]{8}\.rrd", given.path.name)
        assert unfinished_files(target.resolve()) == [given.path] and not given.leftovers
        given.path.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new" and not given.path.exists()


def test_an_error_keeps_the_old_file_and_names_the_new() -> None:
    target = Path("a.rrd")
    target.write_text("old")
    half = r"^no more; what was made until then is in a\.partial-[0-9a-f]{8}\.rrd$"
    with pytest.raises(UserError, match=half), atomic_write(target, "recording") as given:
        given.path.write_text("half")
        raise UserError("no more")
    (left,) = unfinished_files(target)
    assert (target.read_text(), left.read_text()) == ("old", "half")
    with atomic_write(target, "recording") as given:
        assert given.leftovers == (left.resolve(),) and given.path.read_text() == ""
        assert given.warnings == [f"{left.name}: left by a run that did not end; keep or delete it"]
    assert left.read_text() == "half"
    left.unlink()
    with pytest.raises(UserError, match=r"^nothing$"), atomic_write(target, "recording"):
        raise UserError("nothing")
    assert not unfinished_files(target)


def test_only_one_process_writes_a_file() -> None:
    with atomic_write(Path("a.rrd"), "recording") as given:
        given.path.write_text("first")
        with (
            pytest.raises(UserError, match="another process is writing it"),
            atomic_write(Path("a.rrd"), "x"),
        ):
            pass
    assert Path("a.rrd").read_text() == "first"


@pytest.mark.long
def test_two_runs_cannot_write_one_recording(tmp_path: Path, capsys: Capture) -> None:
    """The second ends at once, the first is what it would have been."""
    bags.write(Path("drive"), bags.small_items(scans=3))
    command = [sys.executable, "-m", "bevviz.cli", "demo", "--frames", "2", "--save", "out.rrd"]
    with subprocess.Popen(command, env=environment(), stderr=subprocess.DEVNULL) as first:
        try:
            deadline = time.monotonic() + 60
            while not unfinished_files(Path("out.rrd")) and time.monotonic() < deadline:
                time.sleep(0.05)
            first.send_signal(signal.SIGSTOP)  # it cannot end before the second is tried
            said = error_of(capsys, "bag", "drive", "--save", "out.rrd")
            assert "out.rrd: another process is writing it" in said
            first.send_signal(signal.SIGCONT)
            assert first.wait(PATIENCE) == 0
        finally:
            first.kill()
    verify(tmp_path / "out.rrd")
    assert len(Recording(tmp_path / "out.rrd").rows["/bev"]) == 2


def test_a_link_is_followed_and_a_pipe_refused() -> None:
    Path("real").mkdir()
    Path("latest.rrd").symlink_to("real/a.rrd")
    with atomic_write(Path("latest.rrd"), "recording") as given:
        given.path.write_text("x")
    assert Path("latest.rrd").is_symlink() and Path("real/a.rrd").read_text() == "x"
    os.mkfifo("pipe.rrd")
    with pytest.raises(UserError, match="it is no file"), atomic_write(Path("pipe.rrd"), "recording"):
        pass


def test_a_text_file_is_replaced_atomically(monkeypatch: pytest.MonkeyPatch) -> None:
    target = Path("a.csv")
    save_text(target, "old\r\n", "--csv")
    assert target.read_bytes() == b"old\r\n"

    def full(self: Path, text: str, **_: object) -> int:
        with self.open("w") as file:
            file.write(text[:2])
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_text", full)
        with pytest.raises(UserError, match=r"^--csv a\.csv: cannot write the file: No space left"):
            save_text(target, "new", "--csv")
    assert target.read_bytes() == b"old\r\n"
    save_text(target, "new", "--csv")
    assert [path.name for path in Path().iterdir()] == ["a.csv"]
    with pytest.raises(UserError, match=r"^--csv .*none/a\.csv: cannot write the file: No such file"):
        save_text(Path("none/a.csv"), "x", "--csv")
    Path("folder").mkdir()
    with pytest.raises(UserError, match="--csv folder: cannot write the file: Is a directory"):
        save_text(Path("folder"), "x", "--csv")


def test_a_text_can_be_written_to_a_pipe(capfd: Capture) -> None:
    save_text(Path("/dev/stdout"), "a,b\n", "--csv")
    assert capfd.readouterr().out == "a,b\n"


@pytest.mark.long
@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("compare", ["--csv", "a.csv", "--json", "b.json", "--save", "c.rrd", "--set-b", "voxel.size=0.3"]),
        ("sweep", ["--csv", "a.csv", "--save", "c.rrd", "--set", "voxel.size=0.2,0.3"]),
        ("calib", ["--write", "a.yaml", "--save", "c.rrd"]),
        ("report", ["--at", "0", "-o", "c.rrd", "--force"]),
    ],
)
def test_outputs_get_their_names_when_they_are_complete(
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


def test_an_input_is_never_overwritten(capsys: Capture) -> None:
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
    assert "--csv same.json: --json writes that file" in error_of(capsys, "compare", "drive", *both)
    assert bag.read_bytes() == before and Path("my.yaml").read_text().startswith("voxel")


def test_a_link_to_another_bag_is_not_followed(capsys: Capture) -> None:
    bags.write(Path("drive"), bags.small_items(scans=2))
    Path("other.mcap").write_text("another bag")
    Path("link.rrd").symlink_to("other.mcap")
    assert "it is a link to" in error_of(capsys, "bag", "drive", "--save", "link.rrd")
    assert Path("other.mcap").read_text() == "another bag"


# --- a disk that is full -----------------------------------------------------------------------


@pytest.mark.long
def test_a_full_disk_ends_the_run_early(tmp_path: Path) -> None:
    """As on a full disk, writing fails from some megabytes on; what is there can be read."""
    Path("out.rrd").write_text("an older result")
    limit, scans = 12_000_000, 80
    bags.write(Path("drive"), bags.small_items(scans=scans, points=20_000))
    done = subprocess.run(
        [sys.executable, "-m", "bevviz.cli", "bag", "drive", "--save", "out.rrd"],
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
    (left,) = unfinished_files(tmp_path / "out.rrd")
    assert f"what was made until then is in {left.name}" in errors[0]
    assert Path("out.rrd").read_text() == "an older result"
    readable = len(Recording(left).rows["/world/velodyne/points"])  # Rerun writes small tables later.
    assert 0 < readable < scans


def test_a_full_temporary_disk_names_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    bags.write(Path("drive"), bags.small_items(scans=40))
    (bag,) = Path("drive").glob("*.mcap")
    packed = Path("packed.mcap.zstd")
    packed.write_bytes(zstd.compress(bag.read_bytes()))
    with small_disk(tmp_path / "small", "64k") as small:
        monkeypatch.setattr("tempfile.tempdir", str(small))
        full = f"{small}: the disk is full: make room there, or name another folder for temporary files"
        with RecordingBuffer() as recording:
            recording.add(b"first")
            with pytest.raises(UserError, match=f"^{re.escape(full)} with TMPDIR$"):
                recording.add(bytes(100_000))
            assert recording[0] == b"first" and len(recording) == 1
        within = f"{small}/bevviz-scratch-"
        said = error_of(capsys, "info", packed)
        assert within in said or full in said
        assert "make room there, or name another folder" in said


def test_no_temporary_folder_at_all_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    def full(path: object, *_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)

    bags.write(Path("drive"), bags.small_items(scans=2))
    (bag,) = Path("drive").glob("*.mcap")
    Path("packed.mcap.zstd").write_bytes(zstd.compress(bag.read_bytes()))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.setattr("tempfile._os.open", full)
    said = error_of(capsys, "info", "packed.mcap.zstd")
    assert "No usable temporary directory found" in said and "TMPDIR" in said


# --- what a killed process leaves --------------------------------------------------------------


def test_temporary_folders_are_deleted_after_their_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    script = (
        "import os, signal, tempfile; tempfile.tempdir = os.getcwd()\n"
        "from bevviz.support.scratch_folder import ScratchFolder\n"
        "s = ScratchFolder(); s.new(); os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], env=environment(), timeout=PATIENCE)
    assert done.returncode == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    mine = ScratchFolder()
    mine.new()
    assert left.exists()  # too young: it might be in the making
    old = time.time() - 1000
    for folder in tmp_path.iterdir():
        os.utime(folder, (old, old))
    other = ScratchFolder()
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


def test_unfinished_files_are_known_by_their_names() -> None:
    target = Path("drive.v2.rrd")
    claimed = claim_target(target, "recording")
    for name in ("drive.v2.partial.rrd", "drive.partial-0123abcd.rrd", "drive.v2.partial-0123abcd.mcap"):
        Path(name).write_text("of somebody else")
    Path("drive.v2.partial-00000000.rrd").symlink_to("drive.v2.partial.rrd")
    assert unfinished_files(target) == [claimed.path]
    claimed.discard()
    assert not unfinished_files(target)


# --- planted names -----------------------------------------------------------------------------


def plant(target: Path, bag: Path) -> None:
    """Make links to a bag under names that an unfinished file has, or had."""
    target.with_name(f"{target.stem}.partial{target.suffix}").symlink_to(bag)
    os.link(bag, target.with_name(f"{target.stem}.partial-00000000{target.suffix}"))
    target.with_name(f"{target.stem}.partial-ffffffff{target.suffix}").symlink_to(bag)


@pytest.mark.long
@pytest.mark.parametrize(
    ("command", "options", "outputs"),
    [
        ("bag", ["--save", "o.rrd"], ["o.rrd"]),
        ("compare", ["--csv", "s.csv", "--json", "s.json", "--set-b", "voxel.size=0.3"], ["s.csv", "s.json"]),
        ("calib", ["--write", "a.yaml"], ["a.yaml"]),
        ("report", ["--at", "0", "-o", "o.rrd"], ["o.rrd", "o.html", "o.mcap"]),
    ],
)
def test_planted_links_do_not_reach_the_bag(command: str, options: list[str], outputs: list[str]) -> None:
    bags.write(Path("drive"), bags.small_items(scans=2))
    (bag,) = Path("drive").glob("*.mcap")
    before = bag.read_bytes()
    for name in outputs:
        plant(Path(name), bag)
    assert main([command, "drive", *options]) == 0
    assert bag.read_bytes() == before
    assert all(Path(name).stat().st_size and Path(name).stat().st_nlink == 1 for name in outputs)


def test_an_unfinished_file_is_never_an_existing_one(monkeypatch: pytest.MonkeyPatch) -> None:
    bag = Path("drive.mcap")
    bag.write_text("the bag")
    names = iter(["00000000", "11111111", "22222222"])
    monkeypatch.setattr("secrets.token_hex", lambda size: next(names))
    Path("o.partial-00000000.rrd").symlink_to(bag)
    os.link(bag, "o.partial-11111111.rrd")
    for _ in range(2):
        with pytest.raises(UserError, match=r"o\.rrd: cannot write the recording: File exists"):
            claim_target(Path("o.rrd"), "recording")
    claim_target(Path("o.rrd"), "recording").discard()
    assert bag.read_text() == "the bag" and bag.stat().st_nlink == 2


def test_a_link_to_a_file_of_another_kind_is_refused() -> None:
    bag = Path("drive.mcap")
    bag.write_text("the bag")
    Path("s.csv").symlink_to(bag)
    with pytest.raises(
        UserError, match=r"^--csv s\.csv: cannot write the file: it is a link to .*drive\.mcap"
    ):
        save_text(Path("s.csv"), "a,b\n", "--csv")
    assert bag.read_text() == "the bag"


def test_one_of_two_simultaneous_runs_goes_on() -> None:
    script = (
        "import sys, time; from pathlib import Path; from bevviz.support.files import claim_target\n"
        "from bevviz.errors import UserError\n"
        "sys.stdin.readline()\n"
        "try: claim_target(Path('a.rrd'), 'recording'); print('mine', flush=True); sys.stdin.readline()\n"
        "except UserError as error: print(error, flush=True)\n"
    )
    command = [sys.executable, "-c", script]
    both = [
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment())
        for _ in range(2)
    ]
    for process in both:
        assert process.stdin is not None
        process.stdin.write("go\n")
        process.stdin.flush()
    said = sorted(process.stdout.readline() for process in both if process.stdout is not None)
    for process in both:
        process.communicate(timeout=PATIENCE)
    assert said[1] == "mine\n" and said[0].endswith("a.rrd: another process is writing it\n")


# --- a bag that a killed process leaves --------------------------------------------------------


def little_bag(path: Path, *, compress: bool) -> list[tuple[int, int, bytes]]:
    """Write a bag of three chunks. Return log time, time of publication and data of its messages."""
    nothing = MessageDefinition(MessageDefinitionFormat.NONE, "")
    topics = [
        Connection(i, f"/{i}", "a/msg/X", nothing, "", 0, ConnectionExtRosbag2("cdr", []), None)
        for i in range(2)
    ]
    random_bytes = np.random.default_rng(0).bytes
    messages = [(100 + i, 50 + i, random_bytes(50_000 + i)) for i in range(200)]
    with McapWriter(path, lambda connection: nothing, compress=compress) as bag:
        for i, (received, sent, data) in enumerate(messages):
            bag.write(topics[i % 2], received, data, sent)
    return messages


def read_bag(path: Path) -> list[tuple[int, int, bytes]]:
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        found = [(m.log_time, m.publish_time, m.data) for _, _, m in reader.iter_messages()]
    assert summary is not None and summary.statistics is not None
    assert summary.statistics.message_count == len(found) and summary.statistics.chunk_count
    assert len(summary.channels) == summary.statistics.channel_count == 2
    return found


@pytest.mark.long
@pytest.mark.parametrize("compress", [False, True])
def test_a_bag_cut_anywhere_is_completed(compress: bool) -> None:
    messages = little_bag(Path("whole.mcap"), compress=compress)
    whole, cut = Path("whole.mcap").read_bytes(), Path("cut.mcap")
    assert complete(Path("whole.mcap")) == 0 and Path("whole.mcap").read_bytes() == whole
    second = whole.index(b"\x07", 4_300_000)  # somewhere in the second chunk
    ends = [*range(len(whole) - 1, 9_000_000, -160_000), second, second + 1, 8_600_000, 5_000_000]
    for end in ends:
        cut.write_bytes(whole[:end])
        count = complete(cut)
        assert read_bag(cut) == messages[:count]
        if not compress:  # of a compressed chunk nothing is left
            assert (count + 1) * 50_300 > min(end, 200 * 50_000)
        cut.write_bytes(whole[:end] + bytes(5000))  # as after a power cut, within a message or behind it
        assert complete(cut) in (count, count + 1) and read_bag(cut)[:count] == messages[:count]


def test_a_bag_that_is_damaged_before_its_end_stays_as_it_is() -> None:
    little_bag(Path("whole.mcap"), compress=False)
    whole, cut = Path("whole.mcap").read_bytes(), Path("cut.mcap")
    for at in (100, 4_250_000, 6_000_000):
        data = whole[:at] + b"\x55" * 60_000 + whole[at + 60_000 : -1]
        cut.write_bytes(data)
        with pytest.raises(UserError, match=r"cut\.mcap: cannot be completed"):
            complete(cut)
        assert cut.read_bytes() == data
    os.link("cut.mcap", "other.mcap")
    with pytest.raises(UserError, match="another name"):
        complete(cut)
    Path("link.mcap").symlink_to("whole.mcap")
    with pytest.raises(UserError, match="cannot be completed"):
        complete(Path("link.mcap"))
    assert Path("whole.mcap").read_bytes() == whole
