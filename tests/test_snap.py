"""``bevviz snap`` and who it may talk to: strangers, the hung, the dead, and odd folders."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import textwrap
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest

from bevviz.errors import UserError
from bevviz.live import requests as control
from bevviz.live.requests import Control, snap
from bevviz.support.files import check_owned


@pytest.fixture(autouse=True)
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    (tmp_path / "tmp").mkdir()
    return tmp_path


def saved(path: Path | None) -> Path:
    return path or Path("/chosen.rrd")


def never(text: str) -> None:
    raise AssertionError(text)


def say(path: Path, *lines: bytes) -> bytes:
    """Send lines to the process at a socket and return its answer."""
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(5)
        connection.connect(str(path))
        for line in lines:
            connection.sendall(line)
        connection.shutdown(socket.SHUT_WR)
        answer = b""
        while part := connection.recv(4096):
            answer += part
        return answer


def test_a_request_is_answered_at_once_and_when_it_is_done(runtime: Path) -> None:
    with Control(saved, never):
        assert snap(Path("/x/mine.rrd")) == Path("/x/mine.rrd")
        assert snap() == Path("/chosen.rrd")
        assert snap(pid=os.getpid()) == Path("/chosen.rrd")
    with pytest.raises(UserError, match="no 'bevviz live' of yours runs"):
        snap()
    assert not list(runtime.rglob("*.sock"))


@pytest.mark.parametrize(
    "request_",
    [b"[]\n", b"7\n", b"not json\n", b'{"path": 3}\n', b'{"path": ["a"]}\n', b"\xff\xfe\n", b"null\n"],
)
def test_nonsense_does_not_end_the_thread(runtime: Path, request_: bytes) -> None:
    with Control(saved, never):
        path = next(runtime.rglob("*.sock"))
        answers = say(path, request_).splitlines()
        assert json.loads(answers[0]) == {"heard": True}
        assert "not understood" in json.loads(answers[1])["error"] or request_ == b"null\n"
        with suppress(OSError):  # more than is sane is not read on
            assert say(path, b"x" * 100_000) == b""
        assert say(path) == b"", "one who only looks"
        assert snap() == Path("/chosen.rrd")


def test_an_error_of_saving_is_told(runtime: Path) -> None:
    def full(path: Path | None) -> Path:
        raise OSError(28, "No space left on device")

    with Control(full, never), pytest.raises(UserError, match=r"OSError.*No space left"):
        snap()


def test_a_folder_of_another_is_not_trusted(runtime: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stranger's folder does not stop a run, and nobody who listens there is believed."""
    folder = runtime / "bevviz"
    folder.mkdir(mode=0o700)
    with Control(saved, never):
        assert len(list(folder.glob("*.sock"))) == 1
        monkeypatch.setattr(os, "getuid", lambda: 12345)  # to whom all of this belongs to somebody else
        with pytest.raises(UserError, match="belongs to another user"):
            check_owned(folder)
        with pytest.raises(UserError, match="no 'bevviz live' of yours runs"):
            snap()
    warned: list[str] = []
    monkeypatch.setattr("tempfile.tempdir", str(folder / "none" / "none"))
    (folder / "none").write_text("no folder")
    with Control(saved, warned.append):
        pass
    assert len(warned) == 1
    assert "'bevviz snap' cannot reach this run" in warned[0] and "belongs to another user" in warned[0]


def test_a_folder_that_others_can_write_is_not_used(runtime: Path) -> None:
    (runtime / "bevviz").mkdir()
    (runtime / "bevviz").chmod(0o777)
    with Control(saved, never):
        assert not list((runtime / "bevviz").glob("*.sock")), "another place is taken"
        assert snap() == Path("/chosen.rrd")


def test_a_link_to_elsewhere_is_not_followed(runtime: Path) -> None:
    (runtime / "elsewhere").mkdir(mode=0o700)
    (runtime / "bevviz").symlink_to(runtime / "elsewhere")
    with Control(saved, never):
        assert not list((runtime / "elsewhere").glob("*.sock"))


@pytest.mark.parametrize("odd", ["", "relative", "/proc/none", "/dev/null", "/tmp/" + 120 * "x"])
def test_snap_works_with_odd_runtime_folders(
    odd: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", odd)
    with Control(saved, never):
        assert snap() == Path("/chosen.rrd")


LISTENER = """
import sys, time
from pathlib import Path
from bevviz.live.requests import Control
with Control(lambda path: Path("/x.rrd"), print):
    print("ready", flush=True)
    time.sleep(60)
"""


def test_a_stopped_process_is_told_within_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(LISTENER)], stdout=subprocess.PIPE, text=True, env=environment
    )
    try:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        assert snap(pid=process.pid) == Path("/x.rrd")
        process.send_signal(signal.SIGSTOP)
        os.waitpid(process.pid, os.WUNTRACED)
        assert control.ANSWER <= 5, "nobody waits for longer"
        monkeypatch.setattr(control, "ANSWER", 0.3)
        with pytest.raises(
            UserError, match=f"process {process.pid} does not answer: it is stopped, or hangs"
        ):
            snap()
    finally:
        process.kill()
        process.wait()
    with pytest.raises(UserError, match="no 'bevviz live' of yours runs"):
        snap()


def test_a_request_during_a_save_waits_for_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "ANSWER", 0.3)
    disk = threading.Lock()

    def slow(path: Path | None) -> Path:
        with disk:
            time.sleep(0.5)
            return Path("/slow.rrd")

    saved: list[Path] = []
    with Control(slow, never):
        threads = [threading.Thread(target=lambda: saved.append(snap())) for _ in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert saved == 3 * [Path("/slow.rrd")]


def test_a_save_that_hangs_delays_the_end_of_a_run_for_a_while(
    runtime: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control, "PATIENCE", 0.1)
    saving, goes_on = threading.Event(), threading.Event()

    def hang(path: Path | None) -> Path:
        saving.set()
        goes_on.wait(20)
        return Path("/late.rrd")

    start = time.monotonic()
    with Control(hang, never):
        asker = threading.Thread(target=say, args=(next(runtime.rglob("*.sock")), b"{}\n"))
        asker.start()
        assert saving.wait(20)
    assert time.monotonic() - start < 10
    goes_on.set()
    asker.join()


def test_the_client_imports_little() -> None:
    heavy = "{'numpy', 'rerun', 'numba', 'cv2'}"
    code = f"import bevviz.live.requests, sys; print(sorted({heavy} & sys.modules.keys()))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
