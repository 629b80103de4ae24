"""The access token of a server. A file keeps it while the server runs, so that pages survive a crash."""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def persistent_token(port: int, drive: str) -> Iterator[str]:
    """Yield the token for the server of a drive at a port.

    A token that a killed server of the same drive left at the same port is used again. Otherwise the token is
    new. Only this user can read its file. If the file cannot be written, every start makes a new token.

    Args:
        port: port of the server, which listens there already. So no other server uses the file.
        drive: paths of the drive.
    """
    path = _folder() / f"workbench-{port}.json"
    token = _leftover_token(path, drive) or secrets.token_urlsafe(16)
    with suppress(OSError):
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            json.dump({"drive": drive, "token": token}, file)
    try:
        yield token
    finally:
        with suppress(OSError):
            path.unlink(missing_ok=True)


def _folder() -> Path:
    """Return the folder of the token files."""
    runtime = os.environ.get("XDG_RUNTIME_DIR") or os.environ.get("XDG_CACHE_HOME")
    return Path(runtime or Path.home() / ".cache") / "bevviz"


def _leftover_token(path: Path, drive: str) -> str:
    """Return the token that a killed server left. Empty: there is none that can be used."""
    try:
        status = path.lstat()
        if status.st_uid != os.getuid() or status.st_mode & 0o077:
            return ""
        content = json.loads(path.read_text())
        return str(content["token"]) if content["drive"] == drive and len(content["token"]) >= 16 else ""
    except (OSError, ValueError, KeyError, TypeError):
        return ""
