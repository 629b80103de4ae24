"""Batches: lock the output folder, find unfinished jobs and damaged results."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TypeVar, cast

from bevviz.errors import UserError
from bevviz.fleet.jobs import PARTIAL, Job
from bevviz.fleet.summary import NAME
from bevviz.fleet.table import RunInfo, find_damage, read_info
from bevviz.support import cleanup, progress

T = TypeVar("T")


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Lock the folder for one batch. Delete the unfinished files of an interrupted batch before and after.

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
            pass  # Some network file systems cannot lock folders.
        remove = partial(shutil.rmtree, folder / PARTIAL, ignore_errors=True)
        remove()
        cleanup.register(folder, remove)
        try:
            yield
        finally:
            remove()
            cleanup.unregister(folder)
    finally:
        os.close(handle)


def unfinished_jobs(
    jobs: Sequence[Job], force: bool, warn: Callable[[str], None] = lambda _: None
) -> list[Job]:
    """Return the jobs without a complete, up-to-date result. The largest bags come first.

    The order keeps a worker from running a large bag alone at the end. The table of a damaged result is
    deleted, so that the result counts as missing.

    Args:
        jobs: all jobs of the batch.
        force: return all jobs.
        warn: gets one line for each damaged result.
    """
    for job in jobs:
        if force:
            job.table.unlink(missing_ok=True)
    _delete_damaged([job for job in jobs if job.table.exists()], warn)
    return sorted((job for job in jobs if not job.complete()), key=lambda job: -job.size)


def intact_results(folder: Path, warn: Callable[[str], None]) -> list[tuple[Path, RunInfo]]:
    """Return table and description of each result in a folder. Leave out damaged ones and warn of them."""
    results: list[tuple[Path, RunInfo]] = []
    unchecked = 0
    for table in _with_bar([path for path in sorted(folder.glob("*.parquet")) if path.stem != NAME]):
        info = read_info(table)
        if damage := find_damage(table, table.with_suffix(".rrd")):
            warn(f"{table.stem}: {damage}; it is left out until its bag is run again")
        elif info is not None:
            results.append((table, info))
            unchecked += not info.recording_sha256
    if unchecked:
        warn(f"{unchecked} tables of an older version hold no checksum: their recordings are not checked")
    return results


def _delete_damaged(jobs: Sequence[Job], warn: Callable[[str], None]) -> None:
    """Delete the tables of damaged results, and those of an older version, which hold no checksum.

    Args:
        jobs: that have a table.
        warn: gets a line for each damaged result, and one for all tables of an older version.
    """
    older = 0
    for job in _with_bar(jobs):
        info = read_info(job.table)
        if info is not None and info.key != job.key:
            continue  # It is out of date anyway.
        if damage := find_damage(job.table, job.recording):
            warn(f"{job.name}: {damage}; its bag is run again")
        elif info is not None and info.recording_sha256:
            continue
        else:
            older += 1
        job.table.unlink()
    if older:
        warn(f"{older} tables of an older version hold no checksum of a recording; their bags are run again")


def _with_bar(results: Iterable[T]) -> Iterable[T]:
    """Show a bar, as recordings are read from end to end."""
    return cast(Iterable[T], progress.bar(results, desc="check", unit="bag", delay=1, leave=False))
