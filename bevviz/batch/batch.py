"""A batch: what is left to do, and that nobody else does it at the same time."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from bevviz import remains
from bevviz.batch.jobs import PARTIAL, Job
from bevviz.errors import UserError


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """The folder for one batch alone. What an interrupted one left unfinished is removed, before and after.

    Raises:
        UserError: the folder cannot be made, or another batch works in it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise UserError(f"-o {folder}: {error.strerror}") from None
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UserError(f"-o {folder}: another batch is running in it") from None
        except OSError:
            pass  # a network file system without locks on folders
        remove = partial(shutil.rmtree, folder / PARTIAL, ignore_errors=True)
        remove()
        remains.remember(folder, remove)
        try:
            yield
        finally:
            remove()
            remains.forget(folder)
    finally:
        os.close(handle)


def left_to_do(jobs: Sequence[Job], force: bool) -> list[Job]:
    """Those without a result that is complete and up to date; all of them where ``force`` is set.

    The largest bags go first, so that no worker is left alone with one at the end.
    """
    if force:
        for job in jobs:
            job.table.unlink(missing_ok=True)
    return sorted((job for job in jobs if not job.complete()), key=lambda job: -job.size)
