"""Who is let in: every server listens on this machine alone, unless --bind says otherwise."""

from __future__ import annotations

import socket
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from bevviz.errors import UserError
from bevviz.recording import rerun_cli
from bevviz.recording.ports import allowed_origins, host_for, is_listening, own_address
from tests.support import bags, replay
from tests.support.waiting import PATIENCE, until

LOOPBACK = "0100007F"  # as /proc/net/tcp has it
OTHER = "127.0.0.2"  # of this machine, too, and another address: whoever listens on one does not hear it

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).resolve().parents[1]))
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)


def a_port() -> int:
    with socket.socket() as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


def family(pid: int) -> list[int]:
    """Return the process and its descendants."""
    with suppress(OSError):
        tasks = Path(f"/proc/{pid}/task").glob("*/children")
        children = [int(child) for task in tasks for child in task.read_text().split()]
        return [pid, *(p for child in children for p in family(child))]
    return [pid]


def listening(pid: int) -> dict[int, str]:
    """Port -> address in hexadecimal, of the sockets that a process and its children listen at."""
    inodes = set()
    for process in family(pid):
        with suppress(OSError):
            for handle in Path(f"/proc/{process}/fd").iterdir():
                with suppress(OSError):
                    inodes.add(str(handle.readlink()).removeprefix("socket:[").rstrip("]"))
    found = {}
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and fields[9] in inodes:
                address, _, port = fields[1].partition(":")
                found[int(port, 16)] = address
    return found


BEVVIZ = ("-m", "bevviz.cli")


@contextmanager
def running(
    *arguments: str, program: Sequence[str] = ("-m", "bevviz.cli")
) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command and kill it at the end."""
    with subprocess.Popen([sys.executable, *program, *arguments]) as process:
        try:
            yield process
        finally:
            process.kill()


COMMANDS: dict[str, list[str]] = {  # one for each way in which commands open their outputs
    "demo": ["demo", "--frames", "2"],
    "sweep": ["sweep", "drive", "--set", "clustering.eps=0.5,0.6"],
    "live": ["live"],  # with two scans in place of a robot
}


def is_let_in(port: int, origin: str) -> bool:
    """Whether a browser gives a page from there the data: not, if it only happens to use the same port."""
    request = urllib.request.Request(f"http://127.0.0.1:{port}/proxy", headers={"Origin": origin})
    with pytest.raises(urllib.error.HTTPError) as answer:
        urllib.request.urlopen(request, timeout=PATIENCE)
    return bool(answer.value.headers.get("access-control-allow-origin") == origin)


@pytest.mark.parametrize(
    "name", [name if name == "sweep" else pytest.param(name, marks=pytest.mark.long) for name in COMMANDS]
)
def test_a_command_that_serves_is_for_this_machine(name: str) -> None:
    bags.write(Path("drive"), bags.small_items(scans=2))
    port = a_port()
    program = (replay.__file__, "2") if name == "live" else BEVVIZ
    with running(*COMMANDS[name], "--serve", str(port), program=program) as process:
        until(lambda: port in listening(process.pid) and len(listening(process.pid)) >= 2)
        found = listening(process.pid)
        assert set(found.values()) == {LOOPBACK}
        with urllib.request.urlopen(f"http://localhost:{port}/", timeout=PATIENCE) as page:
            assert b"rerun" in page.read().lower()
        for other in found:
            assert is_listening("127.0.0.1", other)
            assert not is_listening(OTHER, other)
        if name == "demo":
            (data,) = set(found) - {port}
            assert is_let_in(data, f"http://localhost:{port}")
            assert not is_let_in(data, f"http://evil.example:{port}")
    until(lambda: not any(is_listening("127.0.0.1", p) for p in found))  # nothing outlives a kill


@pytest.mark.long
def test_a_catalog_is_for_this_machine() -> None:
    pytest.importorskip("datafusion", reason="needs 'bevviz[catalog]'")
    from bevviz.cli import main

    bags.write(Path("drive"), bags.small_items(scans=2))
    assert main(["batch", "drive", "-o", "runs", "--jobs", "1"]) == 0
    port = a_port()
    with running("batch", "-o", "runs", "--serve-catalog", str(port)) as process:
        until(lambda: len(listening(process.pid)) >= 2)
        found = listening(process.pid)
        assert port in found and set(found.values()) == {LOOPBACK}
        assert not any(is_listening(OTHER, p) for p in found)


@pytest.mark.long
def test_bind_opens_it_at_one_address() -> None:
    port = a_port()
    with running("demo", "--frames", "2", "--serve", str(port), "--bind", OTHER) as process:
        until(lambda: len(listening(process.pid)) >= 2)
        found = listening(process.pid)
        assert set(found.values()) == {"0200007F"}
        assert all(is_listening(OTHER, p) and not is_listening("127.0.0.1", p) for p in found)


def test_an_address_of_another_machine_is_refused() -> None:
    with pytest.raises(UserError, match=r"--bind 203\.0\.113\.7: no address of this machine"):
        own_address("203.0.113.7")
    assert own_address("localhost") in ("127.0.0.1", "::1")


def test_only_local_pages_may_read_the_data() -> None:
    """A page of somebody else that happens to use the same port is none of them."""
    assert allowed_origins("127.0.0.1", 9090) == []
    assert allowed_origins("192.0.2.1", 9090) == ["http://192.0.2.1:9090"]
    assert host_for("fd00::1") == "[fd00::1]"


# --- the viewer on this machine ----------------------------------------------------------------


@pytest.mark.parametrize("start", ["run", "live"])
def test_the_window_is_for_this_machine(start: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rerun's program, told to draw nowhere since there is no display here."""
    script = tmp_path / "rerun"
    script.write_text(f'#!/bin/sh\nexec "{rerun_cli.rerun_program()}" --headless "$@"\n')
    script.chmod(0o755)
    monkeypatch.setattr(rerun_cli, "rerun_program", lambda: str(script))
    if start == "run":
        arguments: list[str] = []
        monkeypatch.setattr(rerun_cli, "start", lambda given, *_, **__: arguments.extend(given))
        from bevviz.recording.sinks import _start_viewer

        _start_viewer()
        command = [rerun_cli.rerun_program(), *arguments]
    else:
        from bevviz.live.outputs import window

        command = list(window().command)
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        try:
            found = until(lambda: listening(process.pid))
        finally:
            process.kill()
    assert set(found.values()) == {LOOPBACK}


# --- what libraries store ----------------------------------------------------------------------


def stored(home: Path) -> list[str]:
    return sorted(str(path.relative_to(home)) for path in home.rglob("*") if path.is_file())


@pytest.mark.long
def test_libraries_neither_store_nor_send_who_uses_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))
    for name in ("ORT_DISABLE_TELEMETRY", "FORCE_RERUN_ANALYTICS", "CI", "XDG_CACHE_HOME", "XDG_CONFIG_HOME"):
        monkeypatch.delenv(name, raising=False)
    script = f"""
import time
from bevviz.config import load
from bevviz.model.frame import Scene
from bevviz.recording.sinks import open_recording
import bevviz.stages.detector
with open_recording(Scene("drive", "lidar"), load(), serve={a_port()}):
    time.sleep(1)
"""
    subprocess.run([sys.executable, "-c", script], check=True, timeout=PATIENCE)
    assert stored(home) == []
