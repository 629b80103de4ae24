"""Files that are there as a whole or not at all, each written by one process at a time."""

from __future__ import annotations

import fcntl
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from bevviz import remains
from bevviz.errors import UserError

# How what stands for a file begins that Git LFS has not fetched; and what is said of it.
LFS_POINTER = b"version https://git-lfs.github.com/"
LFS_HINT = "a Git LFS pointer, not the file itself: 'git lfs pull' fetches it"
YOUNG = 60.0  # seconds that a temporary folder may be without its lock: it is being made


@dataclass(frozen=True, slots=True)
class Unfinished:
    """Where a file is written until it is whole. ``leftover``: an earlier run had left something there."""

    path: Path
    leftover: bool = False


def unfinished(target: Path) -> Path:
    """The name of a file while it is written: NAME.partial.SUFFIX, so that what knows the suffix opens it."""
    return target.with_name(f"{target.stem}.partial{target.suffix}")


@contextmanager
def written(target: Path, what: str) -> Iterator[Unfinished]:
    """A name beside ``target``, for this process alone; what is there takes its place at the end.

    An interrupt is an end like any other. After an error, or a kill, what was written stays under the name of
    ``unfinished``, and ``target`` is as it was before.

    Args:
        target: the file; a link is followed.
        what: it is, for errors.

    Raises:
        UserError: it cannot be written, is no file, or another process is writing it; an error within, with
            where the unfinished file is.
    """
    target = target.resolve()
    path = unfinished(target)
    with remains.unfinished():
        handle = claim(target, what)
        try:
            leftover = os.fstat(handle).st_size > 0
            os.ftruncate(handle, 0)
            try:
                yield Unfinished(path, leftover)
            except KeyboardInterrupt:
                _finish(path, target, what)
                raise
            except BaseException as error:
                if not os.fstat(handle).st_size:
                    path.unlink(missing_ok=True)
                elif isinstance(error, UserError):
                    raise UserError(f"{error}; what was made until then is in {path.name}") from error
                raise
            _finish(path, target, what)
        finally:
            os.close(handle)  # and with it the lock


def save(target: Path, text: str, option: str) -> None:
    """Write a text file, whole or not at all; a pipe, or what is in /dev (stdout), as it is.

    Raises:
        UserError: it cannot be written; ``option`` named it.
    """
    try:
        if target.absolute().is_relative_to("/dev") or (target.exists() and not target.is_file()):
            target.write_text(text, encoding="utf-8", newline="")
            return
        with written(target, "file") as file:
            file.path.write_text(text, encoding="utf-8", newline="")
    except OSError as error:
        raise UserError(f"{option} {target}: cannot write the file: {error.strerror}") from None
    except UserError as error:
        raise UserError(f"{option} {error}") from None


def claim(target: Path, what: str) -> int:
    """Open the unfinished file for a target, or make it, for this process alone.

    Returns:
        Its descriptor, which holds the lock. What is in the file stays.

    Raises:
        UserError: the target is no file, another process is writing it, or it cannot be written.
    """
    if target.exists() and not target.is_file():
        raise UserError(f"{target}: cannot write the {what}: it is no file")
    path = unfinished(target)
    while True:
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK, 0o666)
        except OSError as error:
            raise UserError(f"{target}: cannot write the {what}: {error.strerror}") from None
        try:
            lock(handle, f"{target}: another process is writing it")
        except UserError:
            os.close(handle)
            raise
        with suppress(OSError):
            if os.path.samestat(path.stat(), os.fstat(handle)):
                return handle
        os.close(handle)  # who had it before has just given it its name


def lock(handle: int, taken: str) -> None:
    """For this process alone, until it is closed. Raises UserError(taken) where another one has it."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise UserError(taken) from None
    except OSError:
        pass  # a network file system without locks


def _finish(path: Path, target: Path, what: str) -> None:
    try:
        path.replace(target)
    except OSError as error:
        raise UserError(f"{target}: cannot write the {what}: {error.strerror}") from None


def write_all(file: int, data: bytes | memoryview) -> None:
    """``os.write`` until all is written: a disk that fills up takes a part first."""
    with memoryview(data) as rest:
        done = 0
        while done < len(rest):
            done += os.write(file, rest[done:])


# --- folders -----------------------------------------------------------------------------------


def bag_files(folder: Path) -> list[Path]:
    """Bag files of a folder by suffix, compressed ones too."""
    suffixes = {".mcap", ".db3", ".bag", ".active"}
    return sorted(
        file
        for file in folder.iterdir()
        if file.is_file()
        and (file.with_suffix("") if file.suffix in (".zstd", ".zst") else file).suffix in suffixes
    )


def drive_files(folder: Path) -> list[Path]:
    """The bag files of a folder; where there are none, all files in it, as a data set has them."""
    found = bag_files(folder)
    if found:
        return found
    return [Path(where, name) for where, _, names in os.walk(folder) for name in names]


def sampled_files(folder: Path) -> tuple[int, list[Path]]:
    """How many files are in a folder and below it, and of each folder its first, middle and last by name."""
    count, chosen = 0, list[Path]()
    for where, folders, names in os.walk(folder):
        folders.sort()
        names.sort()
        count += len(names)
        chosen += [Path(where, names[i]) for i in sorted({0, len(names) // 2, len(names) - 1}) if names]
    return count, chosen


class Scratch:
    """A temporary folder, made when it is needed; the next one removes what a killed process left."""

    PREFIX = "bevviz-scratch-"

    def __init__(self) -> None:
        self._folder: Path | None = None
        self._lock = -1

    def new(self) -> Path:
        """An empty folder within.

        Raises:
            UserError: there is no place for it.
        """
        try:
            if self._folder is None:
                self._sweep()
                self._folder = Path(tempfile.mkdtemp(prefix=self.PREFIX))
                remains.remember(self, partial(shutil.rmtree, self._folder, ignore_errors=True))
                self._lock = os.open(self._folder, os.O_RDONLY | os.O_CLOEXEC)
                with suppress(OSError):
                    fcntl.flock(self._lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
            return Path(tempfile.mkdtemp(dir=self._folder))
        except OSError as error:
            where = tempfile.gettempdir()
            raise UserError(
                f"no temporary folder in {where}: {error.strerror}; TMPDIR names another"
            ) from None

    def close(self) -> None:
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            os.close(self._lock)
            self._folder = None
            remains.forget(self)

    def _sweep(self) -> None:
        """Of this user, and nobody has it open: its lock ends with the process that held it."""
        for folder in Path(tempfile.gettempdir()).glob(f"{self.PREFIX}????????"):
            with suppress(OSError):
                about = folder.lstat()
                if not stat.S_ISDIR(about.st_mode) or about.st_uid != os.getuid():
                    continue
                if time.time() - about.st_mtime < YOUNG:
                    continue
                handle = os.open(folder, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    shutil.rmtree(folder, ignore_errors=True)
                finally:
                    os.close(handle)
