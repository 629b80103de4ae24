"""Folder that is being written, under a temporary name until it is complete."""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
from contextlib import suppress
from pathlib import Path

from bevviz.errors import UserError
from bevviz.support.files import MARK, lock_file
from bevviz.support.scratch_folder import remove_unlocked


class UnfinishedFolder:
    """A folder beside its target, named NAME.partial-XXXXXXXX, and locked for this process.

    Making it deletes the unfinished folders of the same target that killed processes have left.

    Args:
        target: the folder or file that the content is for. A link is followed.

    Attributes:
        path: temporary path.

    Raises:
        UserError: another process is writing the same target.
        OSError: the folder cannot be made.
    """

    def __init__(self, target: Path) -> None:
        self._target = target.resolve()
        self.path = self._target.with_name(f"{self._target.name}.partial-{secrets.token_hex(4)}")
        self.path.mkdir()
        taken = f"{target}: another process is writing it"
        try:
            self._handle = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
        except FileNotFoundError:  # Another process took it for a leftover.
            raise UserError(taken) from None
        try:
            lock_file(self._handle, taken)
            others = [folder for folder in unfinished_folders(self._target) if folder != self.path]
            if not all(remove_unlocked(folder) for folder in others) or not self.path.exists():
                raise UserError(taken)
        except BaseException:
            self.discard()
            raise

    def finish(self) -> None:
        """Rename the folder to its target, which must not exist or be an empty folder.

        Raises:
            UserError: the target exists.
            OSError: the folder cannot be renamed.
        """
        try:
            self.path.rename(self._target)
        except OSError as error:
            if error.errno not in (errno.EEXIST, errno.ENOTEMPTY, errno.ENOTDIR):
                raise
            raise UserError(f"{self._target}: is there already; give another folder") from None
        finally:
            self.discard()

    def discard(self) -> None:
        """Delete the folder and give up the lock. A second call does nothing."""
        shutil.rmtree(self.path, ignore_errors=True)
        handle, self._handle = self._handle, -1
        if handle >= 0:
            os.close(handle)


def unfinished_folders(target: Path) -> list[Path]:
    """Find the unfinished folders of a target: NAME.partial-XXXXXXXX beside it."""
    pattern = re.compile(re.escape(target.name) + MARK.pattern)
    folders: list[Path] = []
    with suppress(OSError):
        folders += [f for f in target.parent.iterdir() if pattern.fullmatch(f.name) and f.is_dir()]
    return folders
