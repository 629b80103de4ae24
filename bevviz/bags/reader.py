"""Common interface of bag readers, and the bytes that they read."""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Protocol

import apsw
import rosbags.rosbag2
from backports import zstd
from rosbags.interfaces import Connection

from bevviz.errors import UserError, first_line
from bevviz.model.frame import I64
from bevviz.support.limits import MAX_CONNECTIONS, MAX_NAME

Message = tuple[Connection, int, bytes | memoryview]
"""Where it was recorded, log time in nanoseconds, and the serialised message."""

LAST_TIME = 2**63 - 1  # A later log time is damage: it fits no int64 and no date.
BLOCK = 1 << 14  # bytes of a small read, kept for the next read
STRETCH = 1 << 20  # bytes searched at once for the next record


class DamageError(Exception):
    """Damage of a file. The text ends a sentence."""


class UnindexedError(DamageError):
    """A complete file without an index."""


# Exceptions of rosbags and its libraries for damaged bytes.
_DAMAGE: tuple[type[Exception], ...] = (
    *(rosbags.rosbag2.ReaderError, apsw.Error),
    *(zstd.ZstdError, EOFError, RuntimeError),  # RuntimeError is lz4's.
    *(OSError, ValueError),  # bz2, text that is not UTF-8, disk errors
    *(struct.error, LookupError, TypeError, AssertionError),  # missing fields, references that lead nowhere
    *(OverflowError, MemoryError),  # lengths and times out of range
)


@contextmanager
def as_damage() -> Iterator[None]:
    """Turn the exceptions of rosbags for damaged bytes into a DamageError. Wrap calls of rosbags alone."""
    try:
        yield
    except _DAMAGE as error:
        raise DamageError(f"damaged ({first_line(error)})" if str(error) else "damaged") from error


class Reader(Protocol):
    """Reader of one file. Its ``connections`` have their ``msgcount``.

    Every method of a reader of sound files may raise DamageError.
    """

    @property
    def connections(self) -> Sequence[Connection]:
        """Connections of the file."""

    @property
    def compression(self) -> str:
        """Names of the compressions of the file; empty without compression."""

    @property
    def span(self) -> tuple[int, int]:
        """Log time of the first message, and log time of the last message plus one nanosecond."""

    @property
    def warnings(self) -> Sequence[str]:
        """Missing data met so far, one sentence each."""

    def messages(self, ids: Collection[int], start: int, stop: int) -> Iterator[Message]:
        """Yield messages of the connections ``ids`` with start <= log time < stop, in order of log time."""

    def times(self, ids: Collection[int], start: int = 0, stop: int = LAST_TIME) -> I64:
        """Return the sorted log times of the connections ``ids`` with start <= time < stop.

        The data of the messages is not read.
        """

    def close(self) -> None:
        """Close the file."""


class FileBytes:
    """Bytes of a file by offset. The file is not memory-mapped: if it shrinks meanwhile, reads are short."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb", buffering=0)
        self.size = os.fstat(self._file.fileno()).st_size
        # Offset and bytes of the last block. One tuple, because another thread may read at the same time.
        self._latest = 0, b""

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def read(self, offset: int, size: int) -> bytes:
        """Return ``size`` bytes, or fewer at the end of the file."""
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
        """Yield the offsets from ``start`` on where ``pattern`` matches. It needs at most ``reach`` bytes."""
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


class MemoryBytes(FileBytes):
    """Bytes in memory with the interface of ``FileBytes``, for the unpacked content of a chunk."""

    def __init__(self, data: bytes) -> None:
        self._data, self.size = data, len(data)

    def close(self) -> None:
        """Release the bytes."""
        del self._data

    def read(self, offset: int, size: int) -> bytes:
        """Return ``size`` bytes, or fewer at the end."""
        return self._data[offset : offset + size] if offset >= 0 else b""

    def search(self, pattern: re.Pattern[bytes], start: int, reach: int = 64) -> Iterator[int]:
        """Return the offsets from ``start`` on where ``pattern`` matches."""
        return (match.start() for match in pattern.finditer(self._data, start))


def check_count(path: Path, count: int) -> None:
    """Raise UserError if a file has too many connections."""
    if count > MAX_CONNECTIONS:
        raise UserError(f"{path}: it has {count:,} connections: {MAX_CONNECTIONS:,} at most are read")


def check_names(path: Path, connections: Sequence[Connection]) -> None:
    """Raise UserError if the name of a topic is too long."""
    longest = max((len(connection.topic) for connection in connections), default=0)
    if longest > MAX_NAME:
        raise UserError(
            f"{path}: the name of a topic has {longest:,} characters: {MAX_NAME:,} at most are read"
        )


def megabytes(size: int) -> str:
    """Format a file size for people: ``3.1 MB``."""
    return f"{size / 1e6:.1f} MB" if size >= 100_000 else f"{size / 1e3:.1f} kB"


@cache
def normalized(msgtype: str) -> str:
    """Return a type name as ROS 2 spells it: sensor_msgs/msg/Image."""
    package, _, name = msgtype.rpartition("/")
    if not package and "." in name:  # a protobuf name: foxglove.PointCloud
        return msgtype
    if package.rpartition("/")[2] in ("msg", "action"):
        return msgtype
    return f"{package}/msg/{name}".lstrip("/")
