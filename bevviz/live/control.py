"""How ``bevviz snap`` asks a running ``bevviz live`` to save: a socket of the user, one for each process."""

from __future__ import annotations

import json
import os
import socket
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from bevviz.closing import Closing
from bevviz.errors import UserError

PATIENCE = 120.0  # seconds that saving may take


class Control(Closing):
    """Answers requests to save until it is closed.

    Args:
        save: writes the recording to a path, or to one of its own choice, and returns it.
    """

    def __init__(self, save: Callable[[Path | None], Path]) -> None:
        self._save = save
        self._path = _folder(create=True) / f"{os.getpid()}.sock"
        self._path.unlink(missing_ok=True)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.bind(str(self._path))
        self._socket.listen()
        self._thread = threading.Thread(target=self._serve, name="control", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._path.unlink(missing_ok=True)
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)  # wakes the thread
        self._socket.close()
        self._thread.join(PATIENCE)  # it may be saving

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._socket.accept()
            except OSError:
                return
            with connection, suppress(OSError, ValueError):
                connection.settimeout(5.0)
                if request := _receive(connection):  # else somebody only looked who is there
                    connection.sendall(json.dumps(self._answer(request)).encode())

    def _answer(self, request: dict[str, Any]) -> dict[str, str]:
        try:
            saved = self._save(Path(request["path"]) if request.get("path") else None)
            return {"saved": str(saved.absolute())}
        except UserError as error:
            return {"error": str(error)}


def snap(path: Path | None = None, pid: int | None = None) -> Path:
    """Have the running process save its flight recorder.

    Args:
        path: .rrd file; None: named by the time, where that process was told to put it.
        pid: which process, where several run.

    Raises:
        UserError: none runs, or several do, or it cannot save.
    """
    running = _running()
    if pid is not None and pid not in running:
        raise UserError(f"no 'bevviz live' of yours with process id {pid} runs on this machine")
    if not running:
        raise UserError("no 'bevviz live' of yours runs on this machine")
    if pid is None and len(running) > 1:
        raise UserError(f"several run; choose one with --pid: {', '.join(map(str, sorted(running)))}")
    connection = running[pid] if pid is not None else next(iter(running.values()))
    connection.settimeout(PATIENCE)
    connection.sendall(json.dumps({"path": str(path.absolute()) if path else ""}).encode())
    connection.shutdown(socket.SHUT_WR)
    answer = _receive(connection)
    if "saved" not in answer:
        raise UserError(answer.get("error", "it ended before it had saved"))
    return Path(answer["saved"])


def _running() -> dict[int, socket.socket]:
    """A connection to each process that answers; what ended ones left behind is removed."""
    found = {}
    for path in _folder().glob("*.sock"):
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            connection.connect(str(path))
            found[int(path.stem)] = connection
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)
        except FileNotFoundError:
            pass
    return found


def _receive(connection: socket.socket) -> dict[str, Any]:
    data = b""
    while part := connection.recv(4096):
        data += part
    return json.loads(data) if data else {}


def _folder(*, create: bool = False) -> Path:
    """Only the user can enter it."""
    given = os.environ.get("XDG_RUNTIME_DIR")
    folder = Path(given, "bevviz") if given else Path(tempfile.gettempdir(), f"bevviz-{os.getuid()}")
    if create:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if folder.stat().st_uid != os.getuid():
            raise UserError(f"{folder} belongs to another user: set XDG_RUNTIME_DIR to a folder of yours")
    return folder
