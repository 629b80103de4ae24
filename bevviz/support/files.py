"""Write files atomically, by one process at a time. Read files from unknown sources with limits."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import random
import re
import secrets
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from io import TextIOWrapper
from pathlib import Path
from typing import BinaryIO

from bevviz.errors import UserError
from bevviz.support import cleanup
from bevviz.support.limits import LINE_LIMIT, TEXT_LIMIT

# Beginning of a file that Git LFS has not fetched, and the hint for the user.
LFS_POINTER = b"version https://git-lfs.github.com/"
LFS_HINT = "a Git LFS pointer, not the file itself: 'git lfs pull' fetches it"


# End of the stem of an unfinished file. It is random, so that no attacker can plant a link under that name.
MARK = re.compile(r"\.partial-[0-9a-f]{8}$")
ATTEMPTS = 5  # attempts to become the only writer if several processes begin at the same moment
PAUSE = 0.1  # longest pause between two attempts, in seconds


@dataclass(frozen=True, slots=True)
class UnfinishedFile:
    """A file that is being written, under a temporary name beside its target.

    Attributes:
        path: temporary path.
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
    files_by_age: list[tuple[float, Path]] = []
    with suppress(OSError):
        for path in target.parent.iterdir():
            if path.suffix != target.suffix or not pattern.fullmatch(path.stem):
                continue
            with suppress(FileNotFoundError):  # Its process has just renamed it.
                status = path.lstat()
                if stat.S_ISREG(status.st_mode):
                    files_by_age.append((status.st_mtime, path))
    return [path for _, path in sorted(files_by_age)]


def is_locked(path: Path) -> bool:
    """Return whether a process is writing an unfinished file."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        pass  # A network file system may have no locks.
    finally:
        os.close(descriptor)
    return False


def data_folder(what: str) -> Path:
    """Return the folder of a user's data. A relative XDG_DATA_HOME does not count, as its specification says.

    Args:
        what: content, for the message.

    Raises:
        UserError: the user has no home folder.
    """
    data_home = Path(os.environ.get("XDG_DATA_HOME", ""))
    try:
        data = data_home if data_home.is_absolute() else Path.home() / ".local" / "share"
    except RuntimeError:
        raise UserError(f"there is no folder for {what}: set XDG_DATA_HOME") from None
    return data / "bevviz"


def create_file(path: Path) -> int:
    """Create a file for writing and return its descriptor. Fail if the name exists, even as a link."""
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)


@contextmanager
def atomic_write(target: Path, what: str, *, keep: bool = True) -> Iterator[UnfinishedFile]:
    """Yield an unfinished file beside ``target``, locked for this process. At the end it replaces ``target``.

    An interrupt also replaces ``target``. After an error or a kill, the data stays in the unfinished file,
    and ``target`` is unchanged.

    Args:
        target: the file. A link is followed.
        what: kind of file, for error messages.
        keep: whether the data stays after an error.

    Raises:
        UserError: the target cannot be written, is no file, is a link to a file of another kind, or another
            process is writing it. An error inside the block names the unfinished file.
    """
    resolved = target.resolve()
    if resolved.suffix != target.suffix:
        raise UserError(f"{target}: cannot write the {what}: it is a link to {resolved}")
    with cleanup.must_finish():
        unfinished = claim_target(resolved, what)
        path, handle = unfinished.path, unfinished.handle
        try:
            try:
                yield unfinished
            except KeyboardInterrupt:
                _finish(path, resolved, what)
                raise
            except BaseException as error:
                if not keep or not os.fstat(handle).st_size:
                    path.unlink(missing_ok=True)
                elif isinstance(error, UserError):
                    raise UserError(f"{error}; what was made until then is in {path.name}") from error
                raise
            _finish(path, resolved, what)
        finally:
            os.close(handle)  # This also releases the lock.


def save_text(target: Path, text: str, option: str) -> None:
    """Write a text file atomically. Write directly into a pipe or a file in /dev (stdout).

    Args:
        target: the file.
        text: its content.
        option: option that named the file, for error messages.

    Raises:
        UserError: the file cannot be written.
    """
    try:
        if target.absolute().is_relative_to("/dev") or (target.exists() and not target.is_file()):
            target.write_text(text, encoding="utf-8", newline="")
            return
        with atomic_write(target, "file") as file:
            try:
                file.path.write_text(text, encoding="utf-8", newline="")
            except OSError:
                os.ftruncate(file.handle, 0)  # An incomplete text is useless and must not be kept.
                raise
    except OSError as error:
        raise UserError(f"{option} {target}: cannot write the file: {error.strerror}") from None
    except UserError as error:
        raise UserError(f"{option} {error}") from None


def claim_target(target: Path, what: str) -> UnfinishedFile:
    """Create an unfinished file for a target that no other process is writing.

    The name is new: no existing file or link is opened. The process takes its lock before it looks for locks
    of others. So at most one of two processes that begin together goes on.

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
            handle = create_file(path)
        except OSError as error:
            raise UserError(f"{target}: cannot write the {what}: {error.strerror}") from None
        with suppress(UserError):
            lock_file(handle, taken)
            others = tuple(other for other in unfinished_files(target) if other != path)
            if not any(is_locked(other) for other in others):
                return UnfinishedFile(path, handle, others)
        UnfinishedFile(path, handle).discard()
        time.sleep(random.uniform(0, PAUSE))
    raise UserError(taken)


def lock_file(handle: int, taken: str) -> None:
    """Lock a file for this process until its handle is closed.

    Raises:
        UserError: another process has the lock. ``taken`` is the message.
    """
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise UserError(taken) from None
    except OSError:
        pass  # A network file system may have no locks.


def rename_new(path: Path, target: Path) -> None:
    """Rename a file without overwriting another.

    Raises:
        FileExistsError: the new name exists.
    """
    try:
        os.link(path, target, follow_symlinks=False)
    except FileExistsError:
        raise
    except OSError:  # The file system has no hard links, as on USB sticks.
        if os.path.lexists(target):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(target)) from None
        path.rename(target)
    else:
        path.unlink()


def _finish(path: Path, target: Path, what: str) -> None:
    """Rename an unfinished file to its target."""
    try:
        path.replace(target)
    except OSError as error:
        raise UserError(f"{target}: cannot write the {what}: {error.strerror}") from None


def write_all(file: int, data: bytes | memoryview) -> None:
    """Write all data to a descriptor. ``os.write`` writes only a part when a disk fills up."""
    with memoryview(data) as rest:
        done = 0
        while done < len(rest):
            done += os.write(file, rest[done:])


def full_disk_error(error: BaseException) -> UserError | None:
    """Return an error that names the folder whose disk is full, or None if the error has another reason.

    An error without a file name comes from a temporary file, which has no name.
    """
    if not isinstance(error, OSError):
        return None
    if "No usable temporary directory" in str(error):  # from ``tempfile``, which tries each folder
        return UserError(f"{error.strerror}: make room in one of them, or name another with TMPDIR")
    if error.errno not in (errno.ENOSPC, errno.EDQUOT):
        return None
    temporary = Path(tempfile.gettempdir())
    folder = temporary if error.filename is None else Path(os.fsdecode(error.filename)).absolute().parent
    temporary_advice = ", or name another folder for temporary files with TMPDIR"
    advice = temporary_advice if folder.is_relative_to(temporary) else ""
    return UserError(f"{folder}: the disk is full: make room there{advice}")


@contextmanager
def catch_full_disk() -> Iterator[None]:
    """Raise UserError if a full disk ends the block."""
    try:
        yield
    except OSError as error:
        full = full_disk_error(error)
        if full is None:
            raise
        raise full from error


# --- reading -----------------------------------------------------------------------------------


def open_regular(path: Path, *, pipe: bool = False) -> BinaryIO:
    """Open a regular file for reading. Links are followed.

    A FIFO, a device or a socket is not opened, since reading it could wait or go on for ever.

    Args:
        path: the file.
        pipe: whether to open a pipe of the shell, too: ``<(...)`` or ``/dev/stdin``.

    Raises:
        OSError: the file does not exist, is no regular file, or may not be read.
    """
    is_shell_pipe = pipe and path.parts[1:2] in (("dev",), ("proc",))
    is_allowed = is_shell_pipe and (path.is_fifo() or str(path) == os.devnull)
    _check_regular(path.stat(), is_allowed)
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | (0 if is_allowed else os.O_NONBLOCK))
    try:
        _check_regular(os.fstat(handle), is_allowed)  # The file may have been replaced since.
    except OSError:
        os.close(handle)
        raise
    return os.fdopen(handle, "rb")


def _check_regular(status: os.stat_result, is_allowed: bool) -> None:
    """Raise OSError unless a file is regular or allowed."""
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, "it is a folder")
    if not stat.S_ISREG(status.st_mode) and not is_allowed:
        raise OSError(errno.EINVAL, "it is no file")


def read_bytes(path: Path, limit: int, *, problem: str = "", pipe: bool = False) -> bytes:
    """Read a whole file from an unknown source.

    Args:
        path: the file.
        limit: most bytes that the file may have.
        problem: beginning of the error message; "": ``PATH: cannot be read``.
        pipe: whether to read a pipe of the shell, too, see ``open_regular``.

    Raises:
        UserError: the file does not exist, is no regular file, may not be read, or is larger than the limit.
    """
    problem = problem or f"{path}: cannot be read"
    try:
        with open_regular(path, pipe=pipe) as file:
            status = os.fstat(file.fileno())
            size = status.st_size if stat.S_ISREG(status.st_mode) else None
            # The size of a pipe's content is unknown.
            data = file.read(limit + 1 if size is None else size if size <= limit else 0)
    except (OSError, ValueError) as error:  # A ValueError means a NUL in the name.
        raise UserError(f"{problem}: {getattr(error, 'strerror', None) or error}") from None
    if max(size or 0, len(data)) > limit:
        raise UserError(f"{problem}: it has more than {limit:,} bytes, which are read at most")
    return data


def read_head(path: Path, count: int) -> bytes:
    """Read the first bytes of a regular file.

    Raises:
        OSError: as ``open_regular``.
    """
    with open_regular(path) as file:
        return file.read(count) or b""  # None: a system file that would wait


def read_text(path: Path, limit: int = TEXT_LIMIT, *, problem: str = "", pipe: bool = False) -> str:
    r"""Read a UTF-8 text from an unknown source. Its lines end with ``\n``.

    Args:
        path: the file.
        limit: most bytes that the file may have.
        problem: beginning of the error message; "": ``PATH: cannot be read``.
        pipe: whether to read a pipe of the shell, too, see ``open_regular``.

    Raises:
        UserError: the file cannot be read, is larger than the limit, or is no UTF-8 text.
    """
    data = read_bytes(path, limit, problem=problem, pipe=pipe)
    try:
        return data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        problem = problem or f"{path}: cannot be read"
        raise UserError(f"{problem}: it is no UTF-8 text: {error.reason} at byte {error.start}") from None


def read_lines(path: Path, limit: int) -> Iterator[str]:
    """Iterate over the lines of a long UTF-8 text without loading all of it.

    Raises:
        UserError: as ``read_text``, or a line has more than ``LINE_LIMIT`` characters.
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
    """Check that no other user can put a file into a folder.

    Args:
        folder: the folder.
        variable: environment variable that can name another folder.

    Raises:
        UserError: it is no folder, it belongs to another user, or others can write there.
    """
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode):
        raise UserError(f"{folder} is not a folder")
    if status.st_uid != os.getuid():
        raise UserError(f"{folder} belongs to another user: set {variable} to a folder of yours")
    if status.st_mode & 0o022:
        raise UserError(f"{folder} can be written by others: chmod 700 it")


def absolute(text: str) -> str:
    """Return the absolute path of a file. Return a name as it is."""
    return str(Path(text).resolve()) if is_path(text) else text


def is_path(text: str) -> bool:
    """Return whether the text is a path. "debug" and "demo" are names, even if such a file exists."""
    return bool(Path(text).suffix) and Path(text).is_file()


def bag_files(folder: Path) -> list[Path]:
    """Return the bag files of a folder by suffix, including compressed ones."""
    suffixes = {".mcap", ".db3", ".bag", ".active"}
    return sorted(
        file
        for file in folder.iterdir()
        if file.is_file()
        and (file.with_suffix("") if file.suffix in (".zstd", ".zst") else file).suffix in suffixes
    )


def drive_files(folder: Path) -> list[Path]:
    """Return the bag files of a folder. If there are none, return all files in it, as in a data set."""
    bags = bag_files(folder)
    if bags:
        return bags
    files = (Path(where, name) for where, _, names in os.walk(folder) for name in names)
    return [file for file in files if file.is_file()]  # This leaves out pipes and broken links.


def sampled_files(folder: Path) -> tuple[int, list[Path]]:
    """Return the number of files below a folder, and the first, middle and last file of each subfolder."""
    count, chosen = 0, list[Path]()
    for parent, folders, names in os.walk(folder):
        folders.sort()
        names.sort()
        count += len(names)
        chosen += [Path(parent, names[i]) for i in sorted({0, len(names) // 2, len(names) - 1}) if names]
    return count, [file for file in chosen if file.is_file()]


# --- hashes ------------------------------------------------------------------------------------


def file_hash(path: Path) -> str:
    """Return the SHA-256 of a file's content in hexadecimal. The file is read again only if it changed."""
    stat = path.stat()
    return _hash(path, stat.st_size, stat.st_mtime_ns)


@lru_cache
def _hash(path: Path, size: int, mtime: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
