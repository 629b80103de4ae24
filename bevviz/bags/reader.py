"""What a bag file offers, whatever its format: rosbags reads a sound one, a rescuer what is damaged."""

from __future__ import annotations

import os
import re
import struct
from binascii import crc32
from bz2 import BZ2Decompressor
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import apsw
import rosbags.rosbag1
import rosbags.rosbag2
from backports import zstd
from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
from rosbags.interfaces import Connection

from bevviz.errors import first_line
from bevviz.model.frame import I64
from bevviz.support.loggers import logger

_log = logger(__name__)

Message = tuple[Connection, int, bytes | memoryview]
"""Where it was recorded, log time in nanoseconds, and the serialised message."""

ZSTD = b"\x28\xb5\x2f\xfd"  # what its files and messages begin with
LAST = 2**63 - 1  # a log time beyond it is damage: it fits no int64, and no date
LEAST, LONGEST = 1 << 26, 1 << 30  # bytes that a chunk or a message may be unpacked to, whatever it says
PIECE = 1 << 12  # compressed bytes that are unpacked at once where the next ones may be damaged
BLOCK = 1 << 14  # bytes read at once where few are asked for
STRETCH = 1 << 20  # bytes looked through at once for the next record


class DamageError(Exception):
    """What is wrong with a file, for the end of a sentence."""


class UnindexedError(DamageError):
    """A file that its recorder has ended, without an index."""


# What rosbags and the libraries below it raise when bytes are not what they should be.
_DAMAGE: tuple[type[Exception], ...] = (
    *(rosbags.rosbag1.ReaderError, rosbags.rosbag2.ReaderError, apsw.Error),
    *(zstd.ZstdError, EOFError, RuntimeError),  # the last one is lz4's
    *(OSError, ValueError),  # bz2's, those of text that is no UTF-8, and a disk's
    *(struct.error, LookupError, TypeError, AssertionError),  # what is missing or leads nowhere
    *(OverflowError, MemoryError),  # lengths and times beyond all measure
)


@contextmanager
def as_damage() -> Iterator[None]:
    """Around what rosbags does, and nothing else: what it raises on damage becomes a DamageError."""
    try:
        yield
    except _DAMAGE as error:
        raise DamageError(f"damaged ({first_line(error)})" if str(error) else "damaged") from error


def public_messages(messages: Iterator[Message]) -> Iterator[Message]:
    """The messages that rosbags reads; what it raises on damage becomes a DamageError."""
    with as_damage():
        yield from messages


class Reader(Protocol):
    """The messages of one file. ``connections`` have their ``msgcount``."""

    @property
    def connections(self) -> Sequence[Connection]: ...

    @property
    def compression(self) -> str: ...

    @property
    def span(self) -> tuple[int, int]:
        """Log time of the first message, and just after that of the last one."""
        ...

    @property
    def warnings(self) -> Sequence[str]:
        """What is missing, as far as it was met."""
        ...

    def messages(self, ids: Collection[int], start: int, stop: int) -> Iterator[Message]:
        """Messages of the connections ``ids`` with start <= log time < stop, in order of log time."""
        ...

    def times(self, ids: Collection[int]) -> I64:
        """Log times of all messages of the connections ``ids``, sorted, without their data."""
        ...

    def close(self) -> None: ...


class SoundReader(Reader, Protocol):
    """Any of its methods may raise DamageError."""

    def sums(self, ids: Collection[int], start: int, stop: int) -> tuple[int, int]:
        """How many messages there are as the index has it, and the sum of their log times."""
        ...

    def rescuer(self) -> Reader:
        """Who goes on where this one cannot."""
        ...


class BagFile:
    """One file, whose readers are changed at the first damage.

    Args:
        path: of the file.
        form: name of its format.
        sound: opens the reader of a sound file; raises DamageError.
        rescue: opens the reader of a damaged one; raises UserError where nothing is left of it.
    """

    def __init__(
        self, path: Path, form: str, sound: Callable[[], SoundReader], rescue: Callable[[], Reader]
    ) -> None:
        self.path, self.format = path, form
        self._notes: list[str] = []
        self._sound: SoundReader | None = None
        self._reader: Reader
        try:
            self._reader = self._sound = sound()
        except DamageError as error:
            self._tell(error)
            self._reader = rescue()

    @property
    def connections(self) -> Sequence[Connection]:
        return self._reader.connections

    @property
    def compression(self) -> str:
        return self._reader.compression

    @property
    def span(self) -> tuple[int, int]:
        return self._reader.span

    @property
    def warnings(self) -> list[str]:
        return [f"{self.path.name}: {note}" for note in (*self._notes, *self._reader.warnings)]

    def messages(
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Iterator[Message]:
        """Messages of ``connections`` with start <= log time < stop, in order of log time."""
        known = {c.id: c for c in connections}
        low = max(0, start or 0)
        high = LAST if stop is None else min(stop, LAST)
        given, total, latest = 0, 0, low
        at_latest: list[tuple[int, bytes | memoryview]] = []  # what was given of the latest log time
        if self._sound is None:
            for connection, time, data in self._reader.messages(known, low, high):
                yield known[connection.id], time, data
            return
        resume = low  # where the rescuer begins
        try:
            for connection, time, data in self._sound.messages(known, low, high):
                if time != latest:
                    latest = resume = time
                    at_latest.clear()
                at_latest.append((connection.id, data))
                given += 1
                total += time
                yield known[connection.id], time, data
            latest, resume = LAST, low  # all of it was given, as far as it is known
            self._check(known, low, high, (given, total))
        except DamageError as error:
            self._change(error)
            for connection, time, data in self._reader.messages(known, resume, high):
                if time == latest and (connection.id, data) in at_latest:
                    at_latest.remove((connection.id, data))
                elif time >= latest:
                    given += 1
                    yield known[connection.id], time, data
            times = self._reader.times(known)
            if (late := int(((times >= low) & (times < high)).sum()) - given) > 0:
                self._notes.append(f"{late} message(s) were found too late to be given in order of time")

    def times(self, connections: Collection[Connection]) -> I64:
        """Log times of all messages of ``connections``, sorted, without reading them."""
        ids = [c.id for c in connections]
        if self._sound is not None:
            try:
                return self._sound.times(ids)
            except DamageError as error:
                self._change(error)
        return self._reader.times(ids)

    def close(self) -> None:
        self._reader.close()

    def _check(self, ids: Collection[int], start: int, stop: int, given: tuple[int, int]) -> None:
        """Compare what was given with what the index has.

        Raises:
            DamageError: the index has others.
        """
        assert self._sound is not None
        listed = self._sound.sums(ids, start, stop)
        if listed[0] != given[0]:
            raise DamageError(f"its index lists {listed[0]} messages where {given[0]} are")
        if listed != given:
            raise DamageError("its index has other times than its messages")

    def _change(self, error: DamageError) -> None:
        """From here on the rescuer reads."""
        self._tell(error)
        sound, self._sound = self._sound, None
        assert sound is not None
        self._reader = sound.rescuer()
        sound.close()

    def _tell(self, error: DamageError) -> None:
        _log.info("%s: %s: rescuing what is there", self.path, error, exc_info=error)
        how = (
            "it is read from end to end" if isinstance(error, UnindexedError) else "what is there was rescued"
        )
        self._notes.append(f"{error}: {how}")


class Bytes:
    """The bytes of a file by offset. Not mapped: a file that is cut meanwhile is short, and no fault."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb", buffering=0)
        self.size = os.fstat(self._file.fileno()).st_size
        self._latest = 0, b""  # block that was read last, in one piece for whoever reads in another thread

    def close(self) -> None:
        self._file.close()

    def read(self, offset: int, size: int) -> bytes:
        """``size`` bytes, fewer at the end of the file."""
        start, block = self._latest
        at = offset - start
        if at < 0 or at + size > len(block):
            size = min(size, self.size - offset)
            if size <= 0 or offset < 0:
                return b""
            if size > BLOCK // 4:
                return self._pread(offset, size)
            block, at = self._pread(offset, BLOCK), 0
            self._latest = offset, block
        return block[at : at + size]

    def search(self, pattern: re.Pattern[bytes], start: int, reach: int = 64) -> Iterator[int]:
        """Offsets that ``pattern`` is found at, from ``start`` on; it needs ``reach`` bytes at most."""
        while start < self.size:
            data = self._pread(start, STRETCH + reach)
            for match in pattern.finditer(data):
                if match.start() >= STRETCH:
                    break
                yield start + match.start()
            start += STRETCH

    def _pread(self, offset: int, size: int) -> bytes:
        parts = []
        while size > 0 and (part := os.pread(self._file.fileno(), min(size, 1 << 30), offset)):
            parts.append(part)
            offset, size = offset + len(part), size - len(part)
        return parts[0] if len(parts) == 1 else b"".join(parts)


class Content(Bytes):
    """The same of bytes that are there already: of the content of a chunk."""

    def __init__(self, data: bytes) -> None:
        self._data, self.size = data, len(data)

    def close(self) -> None:
        del self._data

    def read(self, offset: int, size: int) -> bytes:
        return self._data[offset : offset + size] if offset >= 0 else b""

    def search(self, pattern: re.Pattern[bytes], start: int, reach: int = 64) -> Iterator[int]:
        return (match.start() for match in pattern.finditer(self._data, start))


def unpack(
    compression: str, packed: bytes, size: int, crc: int = 0, *, cut: bool = False
) -> tuple[bytes, str]:
    """Unpack the content of a chunk, of a damaged one the part before the damage.

    Args:
        compression: zstd, lz4, bz2, or nothing.
        packed: as it lies in the file.
        size: bytes that it should have.
        crc: its checksum, 0: it has none.
        cut: the end of ``packed`` is missing. That alone is no damage.

    Returns:
        The content, and what is wrong with it. The latter is empty for a sound chunk.
    """
    most, whole = min(max(size, LEAST), LONGEST), True
    if compression in ("", "none"):
        data = packed
    elif compression not in _STREAMS:
        return b"", f"a chunk cannot be unpacked (compression '{compression}' is not known)"
    else:
        stream = _STREAMS[compression]()
        try:
            data = _drawn(stream, packed, most)
            whole = stream.eof
        except _STUMBLES as error:
            data = _before_damage(_STREAMS[compression], packed, most)
            return data, f"a chunk cannot be unpacked ({first_line(error)})"
    if cut:
        return data, ""
    if not whole:
        return data, "a chunk ends early"
    if crc and crc32(data) != crc:
        return data, "the content of a chunk does not fit its checksum"
    return data, ""


_STREAMS: dict[str, Callable[[], Any]] = {
    "zstd": zstd.ZstdDecompressor,
    "lz4": LZ4FrameDecompressor,
    "bz2": BZ2Decompressor,
}
_STUMBLES = (OSError, ValueError, RuntimeError, EOFError, zstd.ZstdError)  # what these raise on damage


def _drawn(stream: Any, packed: bytes, most: int) -> bytes:
    """Return what a decompressor makes of some bytes, ``most`` bytes of it."""
    parts = [stream.decompress(packed, most)]
    most -= len(parts[0])
    while most > 0 and not stream.eof and not stream.needs_input:
        parts.append(stream.decompress(b"", most))
        most -= len(parts[-1])
    return parts[0] if len(parts) == 1 else b"".join(parts)


def _before_damage(new_stream: Callable[[], Any], packed: bytes, most: int) -> bytes:
    """Return the content of all compressed blocks before the damage.

    A decompressor keeps what it made of the piece that it stumbles over. So the first pass finds this
    piece, and the second one feeds it byte by byte.
    """
    data, sound = bytearray(), 0
    for step in (PIECE, 1):
        stream = new_stream()
        try:
            data = bytearray(_drawn(stream, packed[:sound], most)) if sound else bytearray()
            while sound < len(packed) and len(data) < most and not stream.eof:
                data += _drawn(stream, packed[sound : sound + step], most - len(data))
                sound += step
        except _STUMBLES:
            continue
        break
    return bytes(data)


def megabytes(size: int) -> str:
    """A file size for people: ``3.1 MB``."""
    return f"{size / 1e6:.1f} MB" if size >= 100_000 else f"{size / 1e3:.1f} kB"


@cache
def normalized(msgtype: str) -> str:
    """The name of a type as ROS 2 spells it: sensor_msgs/msg/Image."""
    package, _, name = msgtype.rpartition("/")
    if not package and "." in name:  # protobuf's: foxglove.PointCloud
        return msgtype
    if package.rpartition("/")[2] in ("msg", "action"):
        return msgtype
    return f"{package}/msg/{name}".lstrip("/")
