"""File formats by their first bytes, and the readers of each format."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from rosbags.interfaces import Connection

from bevviz.bags import mcap, ros1, sqlite
from bevviz.bags.chunks import ChunkReader
from bevviz.bags.compression import ZSTD, unpack_file
from bevviz.bags.damage import DamagedReader
from bevviz.bags.reader import (
    LAST_TIME,
    DamageError,
    Message,
    Reader,
    UnindexedError,
    check_count,
    check_names,
    megabytes,
)
from bevviz.bags.remote import address_of, name_of, open_bytes
from bevviz.bags.sqlite import SqliteReader
from bevviz.datasets.cloud_files import CLOUDS
from bevviz.datasets.dataset import IMAGES, UNREAD
from bevviz.errors import UserError
from bevviz.model.frame import I64
from bevviz.support.extensions import load, registered
from bevviz.support.files import LFS_HINT, LFS_POINTER
from bevviz.support.loggers import logger
from bevviz.support.scratch_folder import ScratchFolder

_log = logger(__name__)


@dataclass(frozen=True, slots=True)
class FileFormat:
    """One file format and its reader.

    Attributes:
        name: name for messages to the user.
        magic: first bytes of a file.
        suffix: usual file suffix.
        sound: opens a sound file.
    """

    name: str
    magic: bytes
    suffix: str
    sound: Callable[[Path], Reader]


SQLITE = FileFormat("sqlite3", sqlite.MAGIC, ".db3", SqliteReader)
FORMATS = (
    FileFormat("MCAP", mcap.MAGIC, ".mcap", lambda path: ChunkReader(path, mcap.FORM)),
    FileFormat("ROS 1 bag", ros1.MAGIC, ".bag", lambda path: ChunkReader(path, ros1.FORM)),
    SQLITE,
)
HEAD_SIZE = 16  # bytes read to recognise a format
OTHER_FORMATS = {
    b"RRF": "a Rerun recording: open it with 'rerun'",
    b"PK\x03\x04": "a zip archive: unpack it first",
    b"\x1f\x8b": "a gzip archive: unpack it first",
    b"BZh": "a bzip2 archive: unpack it first",
    b"\xfd7zXZ": "an xz archive: unpack it first",
    LFS_POINTER[:HEAD_SIZE]: LFS_HINT,
    b"#ROSBAG V1": "a bag of ROS before 1.2: 'rosbag fix' converts it",
}


@cache
def _all_formats() -> tuple[FileFormat, ...]:
    """Return the formats of bags, then those that packages register in the entry point group bevviz.files.

    Raises:
        UserError: a registered format cannot be loaded.
    """
    return (*FORMATS, *(form for point in registered("files").values() for form in load(point)))


class BagFile:
    """One bag file. At the first damage its reader is replaced by one of damaged files.

    Args:
        path: file.
        form: name of the format.
        sound: opens the reader of a sound file. Raises DamageError.
        damaged: opens the reader of the damaged file. None: it is not read.

    Attributes:
        rescued: reader of the damaged file; None: no damage met yet.

    Raises:
        UserError: nothing of the file is left.
    """

    def __init__(
        self,
        path: Path,
        form: str,
        sound: Callable[[], Reader],
        damaged: Callable[[], DamagedReader] | None = None,
    ) -> None:
        self.path, self.format, self._damaged = path, form, damaged
        self.rescued: DamagedReader | None = None
        self._notes: list[str] = []
        self._opened: list[Reader] = []
        self._reader: Reader
        try:
            self._reader = sound()
            self._opened.append(self._reader)
        except DamageError as error:
            self._reader = self._rescue_after(error)
        check_count(path, len(self.connections))
        check_names(path, self.connections)

    @property
    def connections(self) -> Sequence[Connection]:
        """Connections of the file with their message counts."""
        return self._reader.connections

    @property
    def compression(self) -> str:
        """Names of the compressions of the file; empty without compression."""
        return self._reader.compression

    @property
    def span(self) -> tuple[int, int]:
        """Log time of the first message, and log time of the last message plus one nanosecond."""
        return self._reader.span

    @property
    def warnings(self) -> list[str]:
        """Missing or damaged data met so far, with the file name."""
        return [f"{self.path.name}: {note}" for note in (*self._notes, *self._reader.warnings)]

    def messages(
        self,
        connections: Collection[Connection],
        start: int | None = None,
        stop: int | None = None,
        few: bool = False,
    ) -> Iterator[Message]:
        """Yield messages of ``connections`` with start <= log time < stop, in order of log time.

        Args:
            connections: connections of the file.
            start: first log time; None: that of the file.
            stop: end of the log times; None: that of the file.
            few: see ``ChunkReader.messages``.
        """
        known = {c.id: c for c in connections}
        low = max(0, start or 0)
        high = LAST_TIME if stop is None else min(stop, LAST_TIME)
        reader = self._reader
        if reader is self.rescued:
            for connection, time, data in reader.messages(known, low, high):
                yield known[connection.id], time, data
            return
        yielded, time_sum, latest = 0, 0, low
        at_latest: list[tuple[int, bytes | memoryview]] = []  # yielded messages of the latest log time
        resume = low  # log time at which the reader of the damaged file begins
        try:
            if few and isinstance(reader, ChunkReader):
                sound = reader.messages(known, low, high, few=True)
            else:
                sound = reader.messages(known, low, high)
            for connection, time, data in sound:
                if time != latest:
                    latest = resume = time
                    at_latest.clear()
                at_latest.append((connection.id, data))
                yielded += 1
                time_sum += time
                yield known[connection.id], time, data
            latest, resume = LAST_TIME, low  # All messages that the index knows are yielded.
            _check_times(reader.times(known, low, high), yielded, time_sum)
        except DamageError as error:
            rescued = self._rescue_after(error)
            for connection, time, data in rescued.messages(known, resume, high):
                if time == latest and (connection.id, data) in at_latest:
                    at_latest.remove((connection.id, data))
                elif time >= latest:
                    yielded += 1
                    yield known[connection.id], time, data
            if (late := len(rescued.times(known, low, high)) - yielded) > 0:
                self._notes.append(f"{late} message(s) were found too late to be given in order of time")

    def times(self, connections: Collection[Connection]) -> I64:
        """Return the sorted log times of all messages of ``connections``. Their data is not read."""
        ids = [c.id for c in connections]
        try:
            return self._reader.times(ids)
        except DamageError as error:
            return self._rescue_after(error).times(ids)

    def close(self) -> None:
        """Close the file."""
        for reader in self._opened:
            reader.close()

    def _rescue_after(self, error: DamageError) -> DamagedReader:
        """Open the damaged file. Messages that are being read from the former reader still come from it."""
        if self.rescued is None:
            _log.info("%s: %s: rescuing what is there", self.path, error, exc_info=error)
            if self._damaged is None:
                raise UserError(
                    f"{self.path}: {error}: download it, then what is there is rescued"
                ) from error
            is_whole = isinstance(error, UnindexedError)
            how = "it is read from end to end" if is_whole else "what is there was rescued"
            self._notes.append(f"{error}: {how}")
            self._reader = self.rescued = self._damaged()
            self._opened.append(self.rescued)
        return self.rescued


def _check_times(listed: I64, count: int, time_sum: int) -> None:
    """Compare the times that an index lists with the count and the time sum of the messages.

    Raises:
        DamageError: they differ.
    """
    if len(listed) != count:
        raise DamageError(f"its index lists {len(listed)} messages where {count} are")
    # The sum of 64-bit times would overflow an int64; the sums of their halves do not.
    if (int((listed >> 32).sum()) << 32) + int((listed & 0xFFFFFFFF).sum()) != time_sum:
        raise DamageError("its index has other times than its messages")


def open_file(path: Path, scratch: ScratchFolder, warn: Callable[[str], object]) -> BagFile:
    """Open a file of a recording by its first bytes. A compressed file is unpacked.

    Args:
        path: file.
        scratch: temporary folders for unpacked files.
        warn: receives a warning if a file cannot be unpacked completely.

    Raises:
        OSError: the file does not exist or cannot be read.
        UserError: the file is no bag or is empty.
    """
    if address_of(path):
        return _open_remote(path)
    if path.exists() and not path.is_file():  # Reading a pipe would block.
        raise UserError(f"{path}: no bag: it is no file")
    with path.open("rb") as file:
        head = file.read(HEAD_SIZE)
    if head.startswith(ZSTD):
        path = _unpack(path, scratch, warn)
        with path.open("rb") as file:
            head = file.read(HEAD_SIZE)
    known = FORMATS if any(head.startswith(kind.magic) for kind in FORMATS) else _all_formats()
    if kind := next((kind for kind in known if head.startswith(kind.magic)), None):
        return _open_as(kind, path)
    problem = next((text for magic, text in OTHER_FORMATS.items() if head.startswith(magic)), None)
    # The first bytes may be damaged. All messages of a database may still lie in its log.
    kind = next((kind for kind in known if path.suffix == kind.suffix), None)
    if not head and not (kind is SQLITE and sqlite.log_path(path).exists()):
        raise UserError(f"{path}: the file is empty")
    if kind and not problem:
        opened = _open_as(kind, path)
        if any(c.msgcount for c in opened.connections):
            return opened
        opened.close()
    if not problem and path.suffix.lower() in (*CLOUDS, *IMAGES):
        problem = f"one cloud or image, no drive: give the folder that it is in ({path.parent})"
    if not problem and (hint := UNREAD.get(path.suffix.lower())):
        problem = f"{path.suffix.lower()} files are not read: {hint}"
    names = ", ".join(dict.fromkeys(kind.name for kind in known))
    raise UserError(f"{path}: {problem or f'not a bag: by its first bytes none of {names}'}")


def _open_remote(path: Path) -> BagFile:
    """Open a bag at an address. It needs an index, and it must not be damaged: it is not read as a whole."""
    file = open_bytes(path)
    head = file.read(0, HEAD_SIZE)
    file.close()
    name = Path(name_of(path))
    kind = next((kind for kind in FORMATS[:2] if head.startswith(kind.magic)), None)
    if kind is None:
        known = " and ".join(kind.name for kind in FORMATS[:2])
        raise UserError(f"{name}: only {known} are read from an address: download it")
    return BagFile(name, kind.name, lambda: kind.sound(path))


def _open_as(kind: FileFormat, path: Path) -> BagFile:
    def damaged() -> DamagedReader:
        rescuer = registered("rescuers").get(kind.suffix.removeprefix("."))
        if rescuer is None:
            raise UserError(f"{path}: it is damaged, and no package is installed that rescues a {kind.name}")
        reader: DamagedReader = load(rescuer)(path)
        return reader

    return BagFile(path, kind.name, lambda: kind.sound(path), damaged)


def _unpack(path: Path, scratch: ScratchFolder, warn: Callable[[str], object]) -> Path:
    target = scratch.new() / path.stem
    damaged, whole = unpack_file(path, target)
    if damaged or not whole:
        damage = f"{damaged} damaged place(s) in it" if damaged else "its end is missing"
        warn(
            f"{path.name}: the compressed file is damaged ({damage}): "
            f"{megabytes(target.stat().st_size)} could be unpacked"
        )
    return target


def find_saved_bag(path: Path) -> Path:
    """Return the bag NAME.mcap next to a recording NAME.rrd. Return any other path unchanged.

    Raises:
        UserError: there is no such bag next to the recording.
    """
    if path.suffix != ".rrd" or not path.is_file():
        return path
    bag = path.with_suffix(".mcap")
    if not bag.is_file():
        raise UserError(
            f"{path}: a recording has no messages that could be run again, and {bag.name}, which "
            f"'bevviz live' saves with it, is not beside it: give the bag that it was made from"
        )
    return bag
