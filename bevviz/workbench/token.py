"""The token of a server, kept while it runs, so that pages find one that was killed and started again."""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def kept_token(port: int, drive: str) -> Iterator[str]:
    """A token for the server of a drive at a port.

    It is a new one, unless the last server of the same drive at the same port had no time to forget its own.
    Only this user can read where it is kept; where it cannot be kept it is a new one each time.

    Args:
        port: of the server, which is listening there: nobody else is.
        drive: the paths of the drive.
    """
    path = _folder() / f"workbench-{port}.json"
    token = _left(path, drive) or secrets.token_urlsafe(16)
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
    runtime = os.environ.get("XDG_RUNTIME_DIR") or os.environ.get("XDG_CACHE_HOME")
    return Path(runtime or Path.home() / ".cache") / "bevviz"


def _left(path: Path, drive: str) -> str:
    """What a server that was killed left; empty: nothing that can be used."""
    try:
        about = path.lstat()
        if about.st_uid != os.getuid() or about.st_mode & 0o077:
            return ""
        kept = json.loads(path.read_text())
        return str(kept["token"]) if kept["drive"] == drive and len(kept["token"]) >= 16 else ""
    except (OSError, ValueError, KeyError, TypeError):
        return ""
