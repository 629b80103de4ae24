"""Write files atomically, by one process at a time. Read files of strangers with limits."""

from __future__ import annotations

import errno
import fcntl
import os
import random
import re
import secrets
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from io import TextIOWrapper
from pathlib import Path
from typing import BinaryIO

from bevviz.errors import UserError
from bevviz.support import cleanup

# How what stands for a file begins that Git LFS has not fetched; and what is said of it.
LFS_POINTER = b"version https://git-lfs.github.com/"
LFS_HINT = "a Git LFS pointer, not the file itself: 'git lfs pull' fetches it"
# The largest files that are read, in bytes. They keep a damaged or hostile file from taking all memory.
CONFIG_LIMIT = 1 << 20  # a configuration, a project file, a list of names: a few kilobytes as a rule
TEXT_LIMIT = 1 << 24  # a calibration, the labels or the stamps of a drive: a megabyte at most as a rule
TABLE_LIMIT = 1 << 27  # a table with a line for each pose: an hour at 200 Hz is 115 MB
LINE_LIMIT = 1 << 16  # characters of a line of a table
SENSOR_LIMIT = 1 << 30  # a scan or an image: 100 million points without colour
YOUNG = 60.0  # seconds that a temporary folder may be without its lock: it is being made


# What the stem of an unfinished file ends with. Nobody can guess it, and so plant a link under that name.
MARK = re.compile(r"\.partial-[0-9a-f]{8}$")
ATTEMPTS = 5  # to be the only writer, where several processes begin at the same moment
PAUSE = 0.1  # seconds between two attempts, at most


@dataclass(frozen=True, slots=True)
class Unfinished:
    """A file that is being written, under a name of its own beside its target.

    Attributes:
        path: where it is written until it is whole.
        handle: descriptor of the file. It holds the lock until it is closed.
        leftovers: unfinished files of the same target that earlier processes have left.
    """

    path: Path
    handle: int
    leftovers: tuple[Path, ...] = ()

    @property
    def warnings(self) -> list[str]:
        """One sentence about the leftovers, if there are any."""
        if not self.leftovers:
            return []
        names = ", ".join(path.name for path in self.leftovers)
        return [f"{names}: left by a run that did not end; keep or delete it"]

    def discard(self) -> None:
        """Delete the file and give up the lock."""
        self.path.unlink(missing_ok=True)
        os.close(self.handle)


def unfinished_files(target: Path) -> list[Path]:
    """Find the unfinished files of a target: NAME.partial-XXXXXXXX.SUFFIX beside it, in order of age."""
    pattern = re.compile(re.escape(target.stem) + MARK.pattern)
    found: list[tuple[float, Path]] = []
    with suppress(OSError):
        for path in target.parent.iterdir():
            if path.suffix != target.suffix or not pattern.fullmatch(path.stem):
                continue
            with suppress(FileNotFoundError):  # its process has just given it its name
                status = path.lstat()
                if stat.S_ISREG(status.st_mode):
                    found.append((status.st_mtime, path))
    return [path for _, path in sorted(found)]


def is_locked(path: Path) -> bool:
    """Tell whether a process is writing an unfinished file."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        pass  # a network file system without locks
    finally:
        os.close(handle)
    return False


def create(path: Path) -> int:
    """Create a file for writing and return its descriptor. Fail where the name exists, even as a link."""
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)


@contextmanager
def written(target: Path, what: str) -> Iterator[Unfinished]:
    """Give a file beside ``target`` to write to, for this process alone. At the end it replaces ``target``.

    An interrupt is an end like any other. After an error, or a kill, what was written stays under the name
    of the unfinished file, and ``target`` is as it was before.

    Args:
        target: the file; a link is followed.
        what: it is, for errors.

    Raises:
        UserError: it cannot be written, is no file, is a link to a file of another kind, or another process
            is writing it; an error within, with where the unfinished file is.
    """
    whole = target.resolve()
    if whole.suffix != target.suffix:
        raise UserError(f"{target}: cannot write the {what}: it is a link to {whole}")
    with cleanup.unfinished():
        unfinished = claim(whole, what)
        path, handle = unfinished.path, unfinished.handle
        try:
            try:
                yield unfinished
            except KeyboardInterrupt:
                _finish(path, whole, what)
                raise
            except BaseException as error:
                if not os.fstat(handle).st_size:
                    path.unlink(missing_ok=True)
                elif isinstance(error, UserError):
                    raise UserError(f"{error}; what was made until then is in {path.name}") from error
                raise
            _finish(path, whole, what)
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
            try:
                file.path.write_text(text, encoding="utf-8", newline="")
            except OSError:
                os.ftruncate(file.handle, 0)  # half a text is of no use to anybody: it is not kept
                raise
    except OSError as error:
        raise UserError(f"{option} {target}: cannot write the file: {error.strerror}") from None
    except UserError as error:
        raise UserError(f"{option} {error}") from None


def claim(target: Path, what: str) -> Unfinished:
    """Create an unfinished file for a target that no other process is writing.

    The name is new: no existing file or link is opened. The lock is taken before it is looked whether another
    process has one, so that of two that begin together at most one goes on.

    Raises:
        UserError: the target is no file, another process is writing it, or it cannot be written.
    """
    if target.exists() and not target.is_file():
        raise UserError(f"{target}: cannot write the {what}: it is no file")
    taken = f"{target}: another process is writing it"
    for _ in range(ATTEMPTS):
        if any(is_locked(path) for path in unfinished_files(target)):
            break
        path = target.with_name(f"{target.stem}.partial-{secrets.token_hex(4)}{target.suffix}")
        try:
            handle = create(path)
        except OSError as error:
            raise UserError(f"{target}: cannot write the {what}: {error.strerror}") from None
        with suppress(UserError):
            lock(handle, taken)
            others = tuple(other for other in unfinished_files(target) if other != path)
            if not any(is_locked(other) for other in others):
                return Unfinished(path, handle, others)
        Unfinished(path, handle).discard()
        time.sleep(random.uniform(0, PAUSE))
    raise UserError(taken)


def lock(handle: int, taken: str) -> None:
    """For this process alone, until it is closed. Raises UserError(taken) where another one has it."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise UserError(taken) from None
    except OSError:
        pass  # a network file system without locks


def rename_new(path: Path, target: Path) -> None:
    """Rename a file. Raise FileExistsError where the new name exists: nothing is overwritten."""
    try:
        os.link(path, target, follow_symlinks=False)
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links, as on USB sticks
        if os.path.lexists(target):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(target)) from None
        path.rename(target)
    else:
        path.unlink()


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


def full_disk(error: BaseException) -> UserError | None:
    """Name the folder whose disk is full, and what to do. None: the error has another reason.

    An error without a file name came of a temporary file: these have none.
    """
    if not isinstance(error, OSError):
        return None
    if "No usable temporary directory" in str(error):  # of ``tempfile``, which tries to write in each
        return UserError(f"{error.strerror}: make room in one of them, or name another with TMPDIR")
    if error.errno not in (errno.ENOSPC, errno.EDQUOT):
        return None
    temporary = Path(tempfile.gettempdir())
    folder = temporary if error.filename is None else Path(os.fsdecode(error.filename)).absolute().parent
    other = ", or name another folder for temporary files with TMPDIR"
    there = other if folder.is_relative_to(temporary) else ""
    return UserError(f"{folder}: the disk is full: make room there{there}")


@contextmanager
def on_disk() -> Iterator[None]:
    """Raise UserError where a full disk ends what is within."""
    try:
        yield
    except OSError as error:
        full = full_disk(error)
        if full is None:
            raise
        raise full from error


# --- reading -----------------------------------------------------------------------------------


def open_regular(path: Path, *, pipe: bool = False) -> BinaryIO:
    """Open a regular file for reading. Links are followed.

    A FIFO, a device or a socket is not opened: reading it could wait for ever, or never end.

    Args:
        path: of the file.
        pipe: open a pipe of the shell, too: ``<(...)`` or ``/dev/stdin``.

    Raises:
        OSError: it is not there, is no regular file, or may not be read.
    """
    of_shell = pipe and path.parts[1:2] in (("dev",), ("proc",))
    allowed = of_shell and (path.is_fifo() or str(path) == os.devnull)
    _check_regular(path.stat(), allowed)
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | (0 if allowed else os.O_NONBLOCK))
    try:
        _check_regular(os.fstat(handle), allowed)  # it may have been exchanged since
    except OSError:
        os.close(handle)
        raise
    return os.fdopen(handle, "rb")


def _check_regular(about: os.stat_result, allowed: bool) -> None:
    if stat.S_ISDIR(about.st_mode):
        raise IsADirectoryError(errno.EISDIR, "it is a folder")
    if not stat.S_ISREG(about.st_mode) and not allowed:
        raise OSError(errno.EINVAL, "it is no file")


def read_bytes(path: Path, limit: int, *, problem: str = "", pipe: bool = False) -> bytes:
    """Read a whole file that somebody else may have made.

    Args:
        path: of the file.
        limit: bytes that it may have.
        problem: begins the sentence of an error; "": ``PATH: cannot be read``.
        pipe: as of ``open_regular``.

    Raises:
        UserError: it is not there, is no regular file, may not be read, or is larger than the limit.
    """
    problem = problem or f"{path}: cannot be read"
    try:
        with open_regular(path, pipe=pipe) as file:
            about = os.fstat(file.fileno())
            size = about.st_size if stat.S_ISREG(about.st_mode) else None
            # Of a pipe nobody knows how much is to come.
            data = file.read(limit + 1 if size is None else size if size <= limit else 0)
    except (OSError, ValueError) as error:  # the latter: a NUL in the name
        raise UserError(f"{problem}: {getattr(error, 'strerror', None) or error}") from None
    if max(size or 0, len(data)) > limit:
        raise UserError(f"{problem}: it has more than {limit:,} bytes, which are read at most")
    return data


def read_head(path: Path, count: int) -> bytes:
    """Read the first bytes of a regular file. Raises OSError: as ``open_regular``."""
    with open_regular(path) as file:
        return file.read(count) or b""  # None: a file of the system that would wait


def read_text(path: Path, limit: int = TEXT_LIMIT, *, problem: str = "", pipe: bool = False) -> str:
    """Read a UTF-8 text that somebody else may have made; its lines end with ``\\n``.

    Args and errors are those of ``read_bytes``.

    Raises:
        UserError: it cannot be read, is larger than the limit, or is no UTF-8 text.
    """
    data = read_bytes(path, limit, problem=problem, pipe=pipe)
    try:
        return data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        problem = problem or f"{path}: cannot be read"
        raise UserError(f"{problem}: it is no UTF-8 text: {error.reason} at byte {error.start}") from None


def read_lines(path: Path, limit: int) -> Iterator[str]:
    """Read a long UTF-8 text line by line, so that little of it is in memory.

    Raises:
        UserError: as of ``read_text``, or a line has more than ``LINE_LIMIT`` characters.
    """
    problem = f"{path}: cannot be read"
    try:
        with TextIOWrapper(open_regular(path), encoding="utf-8-sig") as file:
            if os.fstat(file.fileno()).st_size > limit:
                raise UserError(f"{problem}: it has more than {limit:,} bytes, which are read at most")
            number = 0
            while line := file.readline(LINE_LIMIT + 1):
                number += 1
                if len(line) > LINE_LIMIT:
                    raise UserError(f"{path}: line {number} has more than {LINE_LIMIT:,} characters")
                yield line
    except OSError as error:
        raise UserError(f"{problem}: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        raise UserError(f"{problem}: it is no UTF-8 text: {error.reason} at byte {error.start}") from None


# --- folders -----------------------------------------------------------------------------------


def check_owned(folder: Path, variable: str = "XDG_RUNTIME_DIR") -> None:
    """Check that nobody else can put a file into a folder.

    Args:
        folder: which one.
        variable: of the environment, which names another folder.

    Raises:
        UserError: it is no folder, it belongs to another user, or others can write there.
    """
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode):
        raise UserError(f"{folder} is not a folder")
    if found.st_uid != os.getuid():
        raise UserError(f"{folder} belongs to another user: set {variable} to a folder of yours")
    if found.st_mode & 0o022:
        raise UserError(f"{folder} can be written by others: chmod 700 it")


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
    files = (Path(where, name) for where, _, names in os.walk(folder) for name in names)
    return [file for file in files if file.is_file()]  # no pipes, and no links to what is not there


def sampled_files(folder: Path) -> tuple[int, list[Path]]:
    """How many files are in a folder and below it, and of each folder its first, middle and last by name."""
    count, chosen = 0, list[Path]()
    for where, folders, names in os.walk(folder):
        folders.sort()
        names.sort()
        count += len(names)
        chosen += [Path(where, names[i]) for i in sorted({0, len(names) // 2, len(names) - 1}) if names]
    return count, [file for file in chosen if file.is_file()]


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
                cleanup.remember(self, partial(shutil.rmtree, self._folder, ignore_errors=True))
                self._lock = os.open(self._folder, os.O_RDONLY | os.O_CLOEXEC)
                with suppress(OSError):
                    fcntl.flock(self._lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
            return Path(tempfile.mkdtemp(dir=self._folder))
        except OSError as error:
            if (full := full_disk(error)) is not None:
                raise full from None
            where = tempfile.gettempdir()
            raise UserError(
                f"no temporary folder in {where}: {error.strerror}; TMPDIR names another"
            ) from None

    def close(self) -> None:
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            os.close(self._lock)
            self._folder = None
            cleanup.forget(self)

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
