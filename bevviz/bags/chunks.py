"""Readers of files that consist of chunks: MCAP and ROS 1 bags.

rosbags reads a sound file. An index or a scan of the whole file leads to the messages of others.
"""

from __future__ import annotations

import heapq
from array import array
from collections import Counter
from collections.abc import Callable, Collection, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path

import numpy as np
import rosbags.rosbag1
import rosbags.rosbag2
from rosbags.interfaces import Connection

from bevviz.bags.reader import (
    LAST_TIME,
    DamageError,
    FileBytes,
    Message,
    Reader,
    as_damage,
    megabytes,
    public_messages,
)
from bevviz.model.frame import I64
from bevviz.support import progress
from bevviz.support.loggers import logger

_log = logger(__name__)

LISTED_TOPICS = 3  # topics listed in a warning
RosbagsReader = rosbags.rosbag1.Reader | rosbags.rosbag2.Reader


@dataclass(slots=True)
class Chunk:
    """Position and content of a chunk, by the index of the file or by a scan."""

    start: int  # log time of the first message
    end: int  # log time of the last message
    data: int  # offset of the packed content
    packed: int  # packed size in bytes
    size: int  # unpacked size in bytes
    compression: str
    counts: Mapping[int, int]  # messages by connection
    crc: int | None = None  # checksum of the content; 0: none; None: not read yet
    times: Mapping[int, I64] | None = None  # log times by connection; None: read them by ``index``
    index: Mapping[int, int] = field(default_factory=dict)  # offset of the index record by connection
    cut: bool = False  # the end of the chunk is missing
    damage: str = ""  # damage of the content that a scan found; empty: none

    def fill(self, times: Mapping[int, array[int]]) -> None:
        """Set the log times, counts and span from the messages that a scan found."""
        self.times = {number: np.frombuffer(values, np.int64) for number, values in times.items()}
        self.counts = {number: len(values) for number, values in times.items()}
        if times:
            self.start = min(map(min, times.values()))
            self.end = max(map(max, times.values()))


@dataclass(slots=True)
class FileIndex:
    """Chunks and connections of a file."""

    chunks: list[Chunk]
    connections: list[Connection]
    outside: I64 = field(default_factory=lambda: np.zeros((0, 4), np.int64))
    """(N, 4) messages outside chunks: log time, connection, offset and size of the data."""
    corrected: Mapping[int, str] = field(default_factory=dict)
    """Topics as the index had them, by connection, where the data describes the connection in another way."""

    @property
    def span(self) -> tuple[int, int]:
        """Log time of the first message, and log time of the last message plus one nanosecond."""
        times = self.outside[:, 0].tolist()
        filled = [c for c in self.chunks if c.counts]
        first = min([c.start for c in filled] + times, default=LAST_TIME)
        return first, max([c.end for c in filled] + times, default=-1) + 1


@dataclass
class ScanResult:
    """Result of a scan through a file, with counts of everything lost."""

    index: FileIndex = field(default_factory=lambda: FileIndex([], []))
    missing: int = 0  # messages that the index of a chunk lists and that are lost
    undescribed: int = 0  # messages of connections without a description
    stated: int | None = None  # message count by the statistics of the file
    cut: int = 0  # bytes of the last chunk if its end is missing
    rescued: int = 0  # messages found in this last chunk
    broken: int = 0  # places without a sound record
    passed: int = 0  # bytes passed over in these places
    listed: Counter[int] = field(default_factory=Counter)  # counts by the newest chunk's own index

    @property
    def count(self) -> int:
        """Number of messages found."""
        return sum(c.msgcount for c in self.index.connections)

    def begin(self, chunk: Chunk) -> None:
        """Add a chunk. ``listed`` collects the counts of its own index afterwards."""
        self.end()
        self.index.chunks.append(chunk)

    def end(self) -> None:
        """Count the messages that the index of the newest chunk lists and that the chunk does not have."""
        if self.index.chunks:
            counts = self.index.chunks[-1].counts
            self.missing += sum(
                max(0, listed - counts.get(number, 0)) for number, listed in self.listed.items()
            )
        self.listed.clear()

    def finish(self, known: Container[int], outside: array[int]) -> Counter[int]:
        """Drop messages of unknown connections. Return the counts of the others by connection."""
        counts: Counter[int] = Counter()
        for chunk in self.index.chunks:
            unknown = {number for number in chunk.counts if number not in known}
            self.undescribed += sum(chunk.counts[number] for number in unknown)
            chunk.counts = {number: n for number, n in chunk.counts.items() if number not in unknown}
            counts.update(chunk.counts)
        rows: I64 = np.frombuffer(outside, np.int64).reshape(-1, 4)
        described = np.array([number in known for number in rows[:, 1].tolist()], bool)
        self.undescribed += int((~described).sum())
        self.index.outside = rows[described]
        counts.update(self.index.outside[:, 1].tolist())
        return counts

    def notes(self, repair: str) -> list[str]:
        """Return warnings about rescued and lost messages. ``repair`` says how to get a sound copy."""
        incomplete = (
            f", {self.rescued} of them from the incomplete last {megabytes(self.cut)}" if self.cut else ""
        )
        notes = [f"read {self.count} messages{incomplete}; {repair}"]
        damaged = [chunk for chunk in self.index.chunks if chunk.damage]
        if damaged:
            kept = sum(sum(chunk.counts.values()) for chunk in damaged)
            notes.append(_damage_note([chunk.damage for chunk in damaged], self.missing, kept))
        elif self.missing:
            notes.append(f"{self.missing} messages that the index of a chunk lists are not there: lost")
        if self.undescribed:
            notes.append(f"{self.undescribed} messages are of channels that nothing describes: lost")
        if self.broken:
            notes.append(f"{self.broken} broken place(s), {megabytes(self.passed)}, passed over")
        if self.stated is not None and (lost := self.stated - self.count) > 0:
            notes.append(f"its statistics count {self.stated} messages: {lost} are lost")
        return notes


def _damage_note(damages: Sequence[str], lost: int, kept: int) -> str:
    """Describe damaged chunks and count their lost and kept messages."""
    ((why, _),) = Counter(damages).most_common(1)
    doubt = f", {kept} that were kept may be wrong" if kept else ""
    return f"{len(damages)} damaged chunk(s), {why}: {lost} messages lost{doubt}"


ChunkMessage = tuple[int, int, memoryview]
"""Log time, connection and data."""


@dataclass(frozen=True, slots=True)
class ChunkFormat:
    """Functions of one chunked file format."""

    open_rosbags: Callable[[Path], RosbagsReader]  # reader of rosbags
    read_by_index: bool  # messages are read by our index, see ``ChunkReader``
    read_index: Callable[[Path], FileIndex]  # raises DamageError if the index cannot be right
    read_times: Callable[[FileBytes, Chunk, int], I64]  # log times of a connection by the index
    read_messages: Callable[[FileBytes, Chunk], tuple[list[ChunkMessage], str]]  # and the damage of the chunk
    scan: Callable[
        [FileBytes, ScanResult, Callable[[int], object]], None
    ]  # the last argument gets the offset
    repair: str  # command that writes a sound copy


class ChunkReader:
    """Reader of a file with a valid index. rosbags opens the file, and reads the messages of ROS 1 bags.

    The messages of an MCAP file are read by our index, as views into its chunks. rosbags copies each message
    twice: 1.2 s per GB instead of 0.5 s with chunks of 4 MB. It also skips broken records in a chunk without
    a checksum. Files that rosbags refuses are read by our index too: ROS 1 messages in MCAP, and files that
    mix ROS 2 messages with others.

    Args:
        path: file.
        form: functions of its format.
        public: the same file with the suffix by which rosbags knows the format.

    Raises:
        DamageError: the file has no index, or the index cannot be right.
    """

    def __init__(self, path: Path, form: ChunkFormat, public_path: Path) -> None:
        self._path, self._form = path, form
        index = form.read_index(path)
        self._public: RosbagsReader | None = None
        reader = form.open_rosbags(public_path)
        try:
            with as_damage():
                reader.open()
        except DamageError as error:
            _log.info("%s: read by its index, for rosbags says: %s", path, error)
        else:
            # rosbags knows the quality of service. Corrected connections differ from those of the index.
            known = {c.id: c for c in reader.connections if c.id not in index.corrected}
            index.connections = [
                known.get(c.id, c)._replace(msgcount=c.msgcount, owner=None) for c in index.connections
            ]
            if form.read_by_index:
                reader.close()
            else:
                self._public = reader
        self._index: FileIndex | None = index
        self._chunks = index.chunks
        self._indexed = IndexedChunkReader(path, form, index)
        self._bytes = FileBytes(path)

    @property
    def connections(self) -> Sequence[Connection]:
        """Connections with their message counts."""
        return self._indexed.connections

    @property
    def compression(self) -> str:
        """Names of the compressions of the chunks."""
        return self._indexed.compression

    @property
    def span(self) -> tuple[int, int]:
        """Log time of the first message, and log time of the last message plus one nanosecond."""
        return self._indexed.span

    @property
    def warnings(self) -> Sequence[str]:
        """Missing data met so far, one sentence each."""
        return self._indexed.warnings

    def messages(self, ids: Collection[int], start: int, stop: int) -> Iterator[Message]:
        """Yield messages of the connections ``ids`` with start <= log time < stop, in order of log time."""
        if self._public is None:
            return self._indexed.messages(ids, start, stop)
        wanted = [c for c in self._public.connections if c.id in ids]
        return public_messages(self._public.messages(wanted, start, stop))

    def times(self, ids: Collection[int]) -> I64:
        """Return the sorted log times of the connections ``ids``."""
        return self._times(ids, 0, LAST_TIME)

    def sums(self, ids: Collection[int], start: int, stop: int) -> tuple[int, int]:
        """Return the number of messages and the sum of their log times, both by the index."""
        times = self._times(ids, start, stop)
        times = times[(times >= start) & (times < stop)]
        # The sum of 64-bit times would overflow an int64; the sums of their halves do not.
        high, low = times >> 32, times & 0xFFFFFFFF
        return len(times), (int(high.sum()) << 32) + int(low.sum())

    def rescuer(self) -> Reader:
        """Return a reader by the index, or by a scan if the index is damaged."""
        if self._index is None:
            return rescue_chunks(self._path, self._form)
        return IndexedChunkReader(self._path, self._form, self._index)

    def close(self) -> None:
        """Close the file."""
        self._bytes.close()
        self._indexed.close()
        if self._public is not None:
            self._public.close()

    def _times(self, ids: Collection[int], start: int, stop: int) -> I64:
        """Return the sorted log times of all chunks that overlap a time span."""
        if self._public is None:
            return self._indexed.times(ids, start, stop)
        parts = [np.zeros(0, np.int64)]
        try:
            for chunk in self._chunks:
                if chunk.start < stop and chunk.end >= start:
                    listed = [number for number in ids if number in chunk.index]
                    parts += [self._form.read_times(self._bytes, chunk, number) for number in listed]
        except DamageError:
            self._index = None
            raise
        return np.sort(np.concatenate(parts))


class IndexedChunkReader:
    """Reader of messages by an index, in order of log time. It counts the losses of damaged chunks."""

    def __init__(self, path: Path, form: ChunkFormat, index: FileIndex, notes: Sequence[str] = ()) -> None:
        self._form, self._index, self._notes = form, index, notes
        self._bytes = FileBytes(path)
        # By number of a damaged chunk: lost messages by connection, log times of the kept ones, the damage.
        self._damaged: dict[int, tuple[Counter[int], Mapping[int, I64], str]] = {}
        self.compression = ", ".join(sorted({c.compression for c in index.chunks} - {"", "none"}))

    @property
    def connections(self) -> Sequence[Connection]:
        """Connections with their message counts, without the lost messages."""
        lost = sum((lost for lost, _, _ in self._damaged.values()), Counter[int]())
        return [c._replace(msgcount=c.msgcount - lost[c.id]) for c in self._index.connections]

    @property
    def span(self) -> tuple[int, int]:
        """Log time of the first message, and log time of the last message plus one nanosecond."""
        return self._index.span

    @property
    def warnings(self) -> Sequence[str]:
        """Corrected descriptions and lost messages, one sentence each."""
        notes = list(self._notes)
        if corrected := self._index.corrected:
            topics = {c.topic: corrected[c.id] for c in self._index.connections if c.id in corrected}
            names = [
                topic if topic == former else f"{topic}, not {former}" for topic, former in topics.items()
            ]
            listed = f"{'; '.join(names[:LISTED_TOPICS])}{' ...' if len(names) > LISTED_TOPICS else ''}"
            notes.append(
                f"its index is damaged: it describes {len(corrected)} topic(s) in another way than the data, "
                f"which is believed: {listed}"
            )
        if self._damaged:
            chunks = self._damaged.values()
            lost = sum(lost.total() for lost, _, _ in chunks)
            kept = sum(len(times) for _, by_connection, _ in chunks for times in by_connection.values())
            notes.append(_damage_note([why for _, _, why in chunks], lost, kept))
        return notes

    def messages(self, ids: Collection[int], start: int, stop: int) -> Iterator[Message]:
        """Yield messages of the connections ``ids`` with start <= log time < stop, in order of log time."""
        wanted = {c.id: c for c in self.connections if c.id in ids}
        sources: list[Iterator[tuple[int, Connection | None, bytes | memoryview]]] = [
            self._chunk_messages(number, wanted, start, stop)
            for number, chunk in enumerate(self._index.chunks)
            if chunk.start < stop and chunk.end >= start and chunk.counts.keys() & wanted.keys()
        ]
        if len(self._index.outside):
            sources.append(self._outside(wanted, start, stop))
        for time, connection, data in heapq.merge(*sources, key=itemgetter(0)):
            if connection is not None:
                yield connection, time, data

    def times(self, ids: Collection[int], start: int = 0, stop: int = LAST_TIME) -> I64:
        """Return sorted log times of the connections ``ids``, at least those with start <= time < stop."""
        outside = self._index.outside
        parts = [outside[np.isin(outside[:, 1], list(ids)), 0]]
        reaching = [(n, c) for n, c in enumerate(self._index.chunks) if c.start < stop and c.end >= start]
        for number, chunk in reaching:
            for connection in chunk.counts.keys() & set(ids):
                if number in self._damaged:
                    parts.append(self._damaged[number][1].get(connection, np.zeros(0, np.int64)))
                elif chunk.times is not None:
                    parts.append(chunk.times[connection])
                else:
                    parts.append(self._times_of(number, connection))
        return np.sort(np.concatenate(parts))

    def close(self) -> None:
        """Close the file."""
        self._bytes.close()

    def _times_of(self, number: int, connection: int) -> I64:
        try:
            return self._form.read_times(self._bytes, self._index.chunks[number], connection)
        except DamageError:
            return np.array([t for t, c, _ in self._content(number) if c == connection], np.int64)

    def _chunk_messages(
        self, number: int, wanted: Mapping[int, Connection], start: int, stop: int
    ) -> Iterator[tuple[int, Connection | None, bytes | memoryview]]:
        # The merge draws the first item of every source at once. This empty item needs no reading.
        yield self._index.chunks[number].start, None, b""
        messages = [
            (t, wanted[c], d) for t, c, d in self._content(number) if c in wanted and start <= t < stop
        ]
        messages.sort(key=itemgetter(0))
        yield from messages

    def _content(self, number: int) -> list[ChunkMessage]:
        """Return the messages of a chunk. A damaged chunk gives only the readable ones."""
        chunk = self._index.chunks[number]
        messages, damage = self._form.read_messages(self._bytes, chunk)
        messages = [item for item in messages if chunk.start <= item[0] <= chunk.end]
        if len(messages) < sum(chunk.counts.values()) or (damage and not chunk.damage):
            times = {id_: np.array([t for t, c, _ in messages if c == id_], np.int64) for id_ in chunk.counts}
            lost = Counter({id_: count - len(times[id_]) for id_, count in chunk.counts.items()})
            self._damaged[number] = lost, times, damage or "whose content is not all there"
        return messages

    def _outside(
        self, wanted: Mapping[int, Connection], start: int, stop: int
    ) -> Iterator[tuple[int, Connection | None, bytes | memoryview]]:
        rows = self._index.outside
        time = rows[:, 0]
        chosen = rows[np.isin(rows[:, 1], list(wanted)) & (time >= start) & (time < stop)]
        for t, number, offset, size in chosen[np.argsort(chosen[:, 0], kind="stable")].tolist():
            data = self._bytes.read(offset, size)
            if len(data) == size:
                yield t, wanted[number], data


def rescue_chunks(path: Path, form: ChunkFormat) -> IndexedChunkReader:
    """Scan a file from front to back. Return a reader of the messages found."""
    result, file = ScanResult(), FileBytes(path)
    try:
        bar = progress.bar(total=file.size, unit="B", unit_scale=True, desc=f"rescue {path.name}", delay=1)
        with bar:
            form.scan(file, result, lambda offset: bar.update(offset - bar.n))
    finally:
        file.close()
    return IndexedChunkReader(path, form, result.index, result.notes(form.repair))
