"""Reader of sound files that consist of chunks with an index: MCAP and ROS 1 bags.

The formats' own packages read them, too. This reader is kept because it is faster where a frame is chosen at
random or a drive is long, reads bags at an address by ranges, and compares the index with the data, so that
damage is found. Medians in ms, 2026-11-27, mcap 1.6 and rosbags 0.11:

=============================================================  =====  ====  =======
bag and question                                               here   mcap  rosbags
=============================================================  =====  ====  =======
MCAP of 15.6 GB, 3,414 chunks without compression: its index   116    111
    scan and image of a random frame                           8.0    13.4
    the same, where the index of a chunk leads to messages     0.4    20.0
    two seconds of /tf                                         0.6    149
ROS 1 bag of an hour, 396,000 messages: its index              19           1,361
    0.15 s at a random time                                    22           169
=============================================================  =====  ====  =======
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Collection, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from operator import itemgetter
from pathlib import Path

import numpy as np
from rosbags.interfaces import Connection

from bevviz.bags.compression import unpack
from bevviz.bags.reader import LAST_TIME, DamageError, FileBytes, Message
from bevviz.bags.remote import open_bytes
from bevviz.model.frame import I64
from bevviz.support.limits import MAX_CHUNK

ChunkMessage = tuple[int, int, bytes | memoryview]
"""Log time, connection and data."""

Item = ChunkMessage | tuple[int, None, bytes]
"""Message, or a time from which on messages follow."""


@dataclass(slots=True)
class Chunk:
    """Position and content of a chunk."""

    start: int  # log time of the first message
    end: int  # log time of the last message
    data: int  # offset of the packed content
    packed: int  # packed size in bytes
    size: int  # unpacked size in bytes
    compression: str
    counts: Mapping[int, int]  # messages by connection
    index: Mapping[int, int] = field(default_factory=dict)  # offset of the index record by connection
    checksum: int = 0  # offset of the checksum of the content; 0: none
    cut: bool = False  # the end of the chunk is missing

    def unpack(self, file: FileBytes) -> tuple[bytes, str]:
        """Return the content and its damage: empty for a sound chunk and for one that is cut."""
        crc = int.from_bytes(file.read(self.checksum, 4), "little") if self.checksum else 0
        packed = file.read(self.data, min(self.packed, MAX_CHUNK))
        cut = self.cut or len(packed) < self.packed
        return unpack(self.compression, packed, self.size, crc, cut=cut)


@dataclass(slots=True)
class FileIndex:
    """Chunks and connections of a file."""

    chunks: list[Chunk]
    connections: list[Connection]

    @property
    def span(self) -> tuple[int, int]:
        """Log time of the first message, and log time of the last message plus one nanosecond."""
        filled = [chunk for chunk in self.chunks if chunk.counts]
        first = min((chunk.start for chunk in filled), default=LAST_TIME)
        return first, max((chunk.end for chunk in filled), default=-1) + 1


@dataclass(frozen=True, slots=True)
class ChunkFormat:
    """Functions of one chunked file format."""

    read_index: Callable[[Path], FileIndex]  # raises DamageError if the index cannot be right
    read_times: Callable[[FileBytes, Chunk, int], I64]  # log times of a connection by the index
    parse: Callable[[memoryview, Container[int]], tuple[list[ChunkMessage], bool]]
    """Messages in the content of a chunk, and whether the lengths of its records lead to its end."""
    read_single: Callable[[FileBytes, Chunk, int, int, int], list[ChunkMessage]] | None = None
    """Messages of a connection between two times, without the rest of a chunk that is not packed."""


class ChunkReader:
    """Reader by the index of a file. Messages are views into the unpacked chunks.

    Args:
        path: file.
        form: functions of its format.
        index: index of the file. None: read it.

    Raises:
        DamageError: the file has no index, or the index cannot be right.
    """

    def __init__(self, path: Path, form: ChunkFormat, index: FileIndex | None = None) -> None:
        self._form, self._index = form, index or form.read_index(path)
        self._bytes = open_bytes(path)
        self.compression = ", ".join(sorted({c.compression for c in self._index.chunks} - {"", "none"}))

    @property
    def connections(self) -> list[Connection]:
        """Connections with their message counts."""
        return self._index.connections

    @property
    def span(self) -> tuple[int, int]:
        """Log time of the first message, and log time of the last message plus one nanosecond."""
        return self._index.span

    @property
    def warnings(self) -> Sequence[str]:
        """Warnings: none, for damage is an error."""
        return ()

    def messages(
        self, ids: Collection[int], start: int, stop: int, *, few: bool = False
    ) -> Iterator[Message]:
        """Yield messages of the connections ``ids`` with start <= log time < stop, in order of log time.

        Args:
            ids: connections.
            start: first log time.
            stop: end of the log times.
            few: the messages are a small part of the file. They are read without the checksum of their
                chunk, if it is not packed.
        """
        wanted = {c.id: c for c in self.connections if c.id in ids}
        sources = self._sources(wanted, start, stop, few)
        for time, connection, data in heapq.merge(*sources, key=itemgetter(0)):
            if connection is not None:
                yield wanted[connection], time, data

    def times(self, ids: Collection[int], start: int = 0, stop: int = LAST_TIME) -> I64:
        """Return the sorted log times of the connections ``ids`` with start <= time < stop."""
        parts = [np.zeros(0, np.int64)]
        if start <= 0 and stop >= LAST_TIME:
            return np.sort(np.concatenate([*parts, *(self._times.get(id_, parts[0]) for id_ in ids)]))
        for number in self._between(start, stop):
            known = self._index.chunks[number].counts.keys() & set(ids)
            parts += [self._times_of(number, connection) for connection in known]
        times = np.sort(np.concatenate(parts))
        return times[(times >= start) & (times < stop)]

    @cached_property
    def _times(self) -> Mapping[int, I64]:
        """Log times by connection. One pass over a large file reads the index of each chunk once."""
        parts: dict[int, list[I64]] = {}
        for number, chunk in enumerate(self._index.chunks):
            for connection in chunk.counts:
                parts.setdefault(connection, []).append(self._times_of(number, connection))
        return {connection: np.concatenate(times) for connection, times in parts.items()}

    def close(self) -> None:
        """Close the file."""
        self._bytes.close()

    def _sources(self, wanted: Collection[int], start: int, stop: int, few: bool) -> list[Iterator[Item]]:
        """Return the messages of each chunk in order of log time."""
        return [
            self._ordered(number, wanted, start, stop, few)
            for number in self._between(start, stop)
            if not self._index.chunks[number].counts.keys().isdisjoint(wanted)
        ]

    def _between(self, start: int, stop: int) -> list[int]:
        """Return the numbers of the chunks that may have messages with start <= log time < stop."""
        first, last = self._spans
        numbers: list[int] = np.flatnonzero((first < min(stop, LAST_TIME)) & (last >= start)).tolist()
        return numbers

    @cached_property
    def _spans(self) -> tuple[I64, I64]:
        """Log times of the first and of the last message of each chunk."""
        chunks = self._index.chunks
        return np.array([c.start for c in chunks], np.int64), np.array([c.end for c in chunks], np.int64)

    def _ordered(
        self, number: int, wanted: Collection[int], start: int, stop: int, few: bool
    ) -> Iterator[Item]:
        # The merge draws the first item of every source at once. This empty item needs no reading.
        chunk, read = self._index.chunks[number], self._form.read_single
        yield chunk.start, None, b""
        if few and read is not None and chunk.compression in ("", "none") and not chunk.cut:
            ids = sorted(chunk.counts.keys() & set(wanted))
            messages = [item for id_ in ids for item in read(self._bytes, chunk, id_, start, stop)]
        else:
            content = self._content(number)
            messages = [item for item in content if item[1] in wanted and start <= item[0] < stop]
        messages.sort(key=itemgetter(0))
        yield from messages

    def _content(self, number: int) -> list[ChunkMessage]:
        """Return the messages of a chunk.

        Raises:
            DamageError: the chunk is damaged, or its messages are others than those of the index.
        """
        chunk = self._index.chunks[number]
        content, damage = chunk.unpack(self._bytes)
        messages, is_whole = self._form.parse(memoryview(content), chunk.counts)
        if damage:
            raise DamageError(damage)
        in_span = sum(chunk.start <= item[0] <= chunk.end for item in messages)
        if not is_whole or not in_span == len(messages) == sum(chunk.counts.values()):
            raise DamageError("the content of a chunk disagrees with its index")
        return messages

    def _times_of(self, number: int, connection: int) -> I64:
        """Return the log times of a connection in a chunk."""
        return self._form.read_times(self._bytes, self._index.chunks[number], connection)
