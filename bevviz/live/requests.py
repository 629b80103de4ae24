"""Requests to a running bevviz through its socket (``bevviz snap``) or by a signal."""

from __future__ import annotations

import json
import os
import signal
import socket
import struct
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from io import BufferedIOBase
from pathlib import Path
from socketserver import StreamRequestHandler, ThreadingUnixStreamServer
from typing import Any, BinaryIO

from bevviz.errors import UserError
from bevviz.support.contexts import Closable
from bevviz.support.files import check_owned

ANSWER = 5.0  # seconds that a healthy process needs at most to acknowledge a request
PATIENCE = 120.0  # seconds that saving may take
LOOK = 0.1  # seconds until the server notices that it is closed
LONGEST = 1 << 16  # bytes, longest request or answer
_CREDENTIALS = struct.Struct("3i")  # SO_PEERCRED of a socket: process, user, group


class Control(Closable):
    """Server that answers requests to save until it is closed.

    A request is a line of JSON, ``{"path": "FILE.rrd"}``. The first line of the answer comes at once. The
    second, ``{"saved": ...}`` or ``{"error": ...}``, comes when the saving is done.

    Args:
        save: writes the recording to a path, or to a path of its own choice, and returns the path.
        warn: called with one sentence if no socket can be opened. ``snap`` does not find the process then.
    """

    def __init__(self, save: Callable[[Path | None], Path], warn: Callable[[str], None]) -> None:
        self.save = save  # public, because it may be replaced later
        self._server: ThreadingUnixStreamServer | None = None
        self._saving = threading.Lock()  # held until a request is answered
        reasons: list[str] = []
        for folder in folders():
            try:
                self._server = self._listen(folder)
            except (OSError, UserError) as error:
                reasons.append(str(error))
            else:
                break
        if self._server is None:
            warn(f"'bevviz snap' cannot reach this run, SIGUSR1 can: {'; '.join(reasons)}")
            return
        work = partial(self._server.serve_forever, LOOK)
        self._thread = threading.Thread(target=work, name="control", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Remove the socket and wait a while for a save in progress."""
        if self._server is None:
            return
        Path(str(self._server.server_address)).unlink(missing_ok=True)
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
        if self._saving.acquire(timeout=PATIENCE):
            self._saving.release()

    def _listen(self, folder: Path) -> ThreadingUnixStreamServer:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        check_owned(folder)
        path = folder / f"{os.getpid()}.sock"
        path.unlink(missing_ok=True)
        server = ThreadingUnixStreamServer(str(path), partial(_Conversation, self._answer, self._saving))
        server.daemon_threads = True
        return server

    def _answer(self, request: bytes) -> dict[str, str]:
        try:
            content = json.loads(request)
            path = content.get("path") if isinstance(content, dict) else 0
        except ValueError:
            path = 0
        if not isinstance(path, str | None):
            return {"error": "the request was not understood"}
        try:
            saved = self.save(Path(path) if path else None)
            return {"saved": str(saved.absolute())}
        except UserError as error:
            return {"error": str(error)}
        except Exception as error:  # an error must not end the thread that answers the next request
            return {"error": f"{type(error).__name__}: {error}"}


class _Conversation(StreamRequestHandler):
    """One request and its answer, in a thread of its own: a save takes time."""

    timeout = ANSWER

    def __init__(
        self, answer: Callable[[bytes], dict[str, str]], saving: threading.Lock, *connection: Any
    ) -> None:
        self._answer, self._saving = answer, saving
        super().__init__(*connection)

    def handle(self) -> None:
        """Read one request and answer it."""
        with suppress(OSError):
            request = _line(self.rfile)
            if request is None:  # the client only tested whether a process listens
                return
            self.wfile.write(b'{"heard": true}\n')
            with self._saving:
                self.wfile.write(json.dumps(self._answer(request)).encode() + b"\n")


@contextmanager
def answer_sigusr1(answer: Callable[[], None]) -> Iterator[None]:
    """Call a function at each SIGUSR1. The default action would end the process."""
    before = signal.signal(signal.SIGUSR1, lambda number, stack: answer())
    try:
        yield
    finally:
        signal.signal(signal.SIGUSR1, before)


def snap(path: Path | None = None, pid: int | None = None) -> Path:
    """Make the running process save its flight recorder.

    Args:
        path: .rrd file. None: the process names it by the time, in its own folder.
        pid: process to ask, if several run.

    Raises:
        UserError: no process runs, several run, the process does not answer, or it cannot save.
    """
    running = _running()
    if pid is not None and pid not in running:
        raise UserError(f"no 'bevviz live' of yours with process id {pid} runs on this machine")
    if not running:
        raise UserError("no 'bevviz live' of yours runs on this machine")
    if pid is None and len(running) > 1:
        raise UserError(f"several run; choose one with --pid: {', '.join(map(str, sorted(running)))}")
    process, connection = next((p, c) for p, c in running.items() if pid in (None, p))
    with connection, connection.makefile("rb") as lines:
        try:
            connection.settimeout(ANSWER)
            request = {"path": str(path.absolute())} if path is not None else {}
            connection.sendall(json.dumps(request).encode() + b"\n")
            heard = _line(lines)
        except OSError:
            heard = None
        if heard is None:
            raise UserError(f"process {process} does not answer: it is stopped, or hangs")
        try:
            connection.settimeout(PATIENCE)
            answer = json.loads(_line(lines) or b"{}")
        except (OSError, ValueError):
            answer = {}
    if not isinstance(answer, dict) or "saved" not in answer:
        error = answer.get("error") if isinstance(answer, dict) else None
        raise UserError(str(error or f"process {process} ended before it had saved"))
    return Path(str(answer["saved"]))


def folders() -> Iterator[Path]:
    """Yield the folders that may hold the sockets, the best one first."""
    if runtime_folder := os.environ.get("XDG_RUNTIME_DIR"):
        yield Path(runtime_folder, "bevviz")
    user_folder = Path(f"/run/user/{os.getuid()}")
    if user_folder.is_dir():
        yield user_folder / "bevviz"
    yield Path(tempfile.gettempdir(), f"bevviz-{os.getuid()}")


def _running() -> dict[int, socket.socket]:
    """Return a connection to each listening process of this user. Remove the sockets of ended processes."""
    connections: dict[int, socket.socket] = {}
    for folder in dict.fromkeys(folders()):
        try:
            check_owned(folder)
            paths = sorted(folder.glob("*.sock"))
        except (OSError, UserError):
            continue  # the folder is not safely this user's
        for path in paths:
            connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            connection.settimeout(ANSWER)
            try:
                connection.connect(str(path))
                peer = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
                process, user, _ = _CREDENTIALS.unpack(peer)
            except ConnectionRefusedError:
                path.unlink(missing_ok=True)
                continue
            except OSError:
                continue
            if user == os.getuid():
                connections[process] = connection
    return connections


def _line(lines: BinaryIO | BufferedIOBase) -> bytes | None:
    """Read the next line. Return None if the other side has closed or the line is too long."""
    line = lines.readline(LONGEST)
    return line if line.endswith(b"\n") else None
