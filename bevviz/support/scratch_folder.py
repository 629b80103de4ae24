"""Temporary folder of a process, which is deleted even when a signal kills the process."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
import time
from contextlib import suppress
from functools import partial
from pathlib import Path

from bevviz.errors import UserError
from bevviz.support import cleanup
from bevviz.support.files import full_disk_error

YOUNG = 60.0  # seconds in which a new temporary folder may have no lock yet


class ScratchFolder:
    """A temporary folder, made on first use. Making it deletes folders that killed processes have left."""

    PREFIX = "bevviz-scratch-"

    def __init__(self) -> None:
        self._folder: Path | None = None
        self._lock = -1

    def new(self) -> Path:
        """Return a new empty folder inside the temporary one.

        Raises:
            UserError: no temporary folder can be made.
        """
        try:
            if self._folder is None:
                self._sweep()
                self._folder = Path(tempfile.mkdtemp(prefix=self.PREFIX))
                cleanup.register(self, partial(shutil.rmtree, self._folder, ignore_errors=True))
                self._lock = os.open(self._folder, os.O_RDONLY | os.O_CLOEXEC)
                with suppress(OSError):
                    fcntl.flock(self._lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
            return Path(tempfile.mkdtemp(dir=self._folder))
        except OSError as error:
            if (full := full_disk_error(error)) is not None:
                raise full from None
            where = tempfile.gettempdir()
            raise UserError(
                f"no temporary folder in {where}: {error.strerror}; TMPDIR names another"
            ) from None

    def close(self) -> None:
        """Delete the temporary folder."""
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            os.close(self._lock)
            self._folder = None
            cleanup.unregister(self)

    def _sweep(self) -> None:
        """Delete this user's temporary folders without a lock. A lock ends with its process."""
        for folder in Path(tempfile.gettempdir()).glob(f"{self.PREFIX}????????"):
            with suppress(OSError):
                if time.time() - folder.lstat().st_mtime >= YOUNG:
                    remove_unlocked(folder)


def remove_unlocked(folder: Path) -> bool:
    """Delete a folder unless a process holds its lock. Return False if one does.

    A folder of another user is left alone, and so is one whose file system has no locks.
    """
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        return True
    try:
        if os.fstat(handle).st_uid == os.getuid():
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(folder, ignore_errors=True)
    except BlockingIOError:
        return False
    except OSError:
        pass
    finally:
        os.close(handle)
    return True
