"""Reader of damaged files of chunks: by their index, or by a scan that searches for the next sound record."""

from __future__ import annotations

from abc import ABC, abstractmethod
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping
from operator import itemgetter
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import numpy as np

from bevviz.bags.chunks import Chunk, ChunkFormat, ChunkMessage, ChunkReader, FileIndex, Item
from bevviz.bags.damage import DamageReport
from bevviz.bags.reader import LAST_TIME, DamageError, FileBytes, MemoryBytes
from bevviz.model.frame import I64
from bevviz.support import progress

Times = Mapping[int, I64]
"""Log times by connection."""


class Record(Protocol):
    """Record of a file. The end of a record that is cut lies beyond the end of the file."""

    start: int
    body: int
    end: int

    @property
    def kind(self) -> str:
        """``chunk``, ``message``, ``connection``, ``index``, ``statistics`` or another kind."""


R = TypeVar("R", bound=Record)


class RecordWalker(ABC, Generic[R]):
    """Iterator over the records of a file or of the content of a chunk. It passes over broken records.

    Args:
        source: bytes to walk.
        known: connections. ``note`` adds to them during the walk.
        span: first and last plausible log time of a message found by searching; None: not known yet.

    Attributes:
        broken: number of places without a sound record.
        passed: bytes in these places.
    """

    descriptions: ClassVar[Callable[[], Any]]  # makes the table of connections of a file, empty
    first: ClassVar[int]  # offset of the first record of a file

    def __init__(self, source: FileBytes, known: Any, span: tuple[int, int] | None = None) -> None:
        self._source, self._known, self._span = source, known, span
        self.broken = self.passed = 0

    def __call__(self, offset: int) -> Iterator[R]:
        """Yield the records from ``offset`` on. Only a chunk may be cut: it may end beyond the bytes."""
        size = self._source.size
        record = self._at(offset)
        while offset < size:
            if record is None:
                record = self._skip(offset) or self._search(offset + 1, size)
                self._count_broken((record.start if record else size) - offset)
                if record is None:
                    return
                offset = record.start
            sound, following = self._resolve(record)
            if sound is not None:
                yield sound
                if self._is_last(sound):
                    return
                offset = sound.end
            elif following is not None:
                self._count_broken(following.start - offset)
                offset = following.start
            record = following

    def _resolve(self, record: R) -> tuple[R | None, R | None]:
        """Return a record with its corrected end (None: broken), and the next record (None: unknown)."""
        size, is_chunk = self._source.size, record.kind == "chunk"
        if record.end == size or self._is_last(record):
            return record, None
        following = self._at(record.end) if record.end < size else None
        if following is not None or self._skip(record.end) is not None:
            return record, following
        # The length is wrong and the next record lies within or slightly behind; or the next one is broken.
        nearer = self._search(record.body, min(record.end, size), is_chunk)
        if is_chunk:
            record.end = nearer.start if nearer else record.end
            return record, nearer
        if nearer is None and record.end < size:
            return (None if self._is_doubtful(record) else record), None
        return None, nearer

    def _count_broken(self, size: int) -> None:
        self.broken += 1
        self.passed += size

    @abstractmethod
    def _at(self, offset: int) -> R | None:
        """Return the record at an offset, None if it makes no sense."""

    @abstractmethod
    def _search(self, start: int, stop: int, chunk: bool = False) -> R | None:
        """Return the next sound record, or only the next chunk."""

    def _skip(self, offset: int) -> R | None:
        """Return the record after a broken one if the broken one's length still leads to it."""
        return None

    def _is_last(self, record: R) -> bool:
        """Tell whether a file ends with this record."""
        return False

    def _is_doubtful(self, record: R) -> bool:
        """Tell whether a record before a broken one is broken itself."""
        return False

    @abstractmethod
    def note(self, record: R) -> None:
        """Add the description of a connection."""

    @abstractmethod
    def message(self, record: R) -> tuple[int, int, int, int]:
        """Return log time and connection of a message, and the offset and size of its data."""

    @abstractmethod
    def chunk(self, record: R) -> Chunk:
        """Return the chunk of a record, without messages."""

    @abstractmethod
    def listed(self, record: R) -> tuple[int, int]:
        """Return the connection of an index record, and its number of messages."""

    def stated(self, record: R) -> int | None:
        """Return the number of messages by a record with the statistics of the file."""
        return None


class ChunkScan:
    """Scan of a file from front to back, with the content of every chunk.

    Attributes:
        index: chunks and connections found.
        times: log times of each chunk.
        outside: (N, 4) messages outside chunks: log time, connection, offset and size of the data.
        report: counts of everything read and lost.
    """

    def __init__(self, path: Path, file: FileBytes, new_walker: type[RecordWalker[Any]]) -> None:
        self.index, self.report = FileIndex([], []), DamageReport()
        self.times: dict[int, Times] = {}
        self._file, self._new_walker, self._known = file, new_walker, new_walker.descriptions()
        self._listed: Counter[int] = Counter()  # messages by the newest chunk's own index
        outside = array("q")
        walker = new_walker(file, self._known)
        bar = progress.bar(total=file.size, unit="B", unit_scale=True, desc=f"rescue {path.name}", delay=1)
        with bar:
            for record in walker(new_walker.first):
                bar.update(record.end - bar.n)
                if record.kind == "connection":
                    walker.note(record)
                elif record.kind == "message":
                    outside.extend(walker.message(record))
                elif record.kind == "chunk":
                    self._count_missing()
                    self._add(walker.chunk(record))
                elif record.kind == "index":
                    number, count = walker.listed(record)
                    self._listed[number] += count
                elif record.kind == "statistics":
                    self.report.stated = walker.stated(record)
        self._count_missing()
        self._count_broken(walker)
        self._finish(np.frombuffer(outside, np.int64).reshape(-1, 4))

    def _add(self, chunk: Chunk) -> None:
        """Add a chunk with its messages and connections."""
        number = len(self.index.chunks)
        content_times: dict[int, array[int]] = defaultdict(lambda: array("q"))
        data, damage = chunk.unpack(self._file)
        walker = self._new_walker(MemoryBytes(data), self._known, plausible_span(chunk))
        for record in walker(0):
            if record.kind == "message":
                time, connection, _, _ = walker.message(record)
                content_times[connection].append(time)
            elif record.kind == "connection":
                walker.note(record)
        self.times[number] = {c: np.frombuffer(values, np.int64) for c, values in content_times.items()}
        chunk.counts = {c: len(values) for c, values in content_times.items()}
        if content_times:
            chunk.start = min(map(min, content_times.values()))
            chunk.end = max(map(max, content_times.values()))
        self.index.chunks.append(chunk)
        if damage:
            self.report.chunks[number] = damage
        elif not chunk.cut:
            self._count_broken(walker)
        if chunk.cut:
            self.report.cut, self.report.rescued = chunk.packed, sum(chunk.counts.values())

    def _count_broken(self, walker: RecordWalker[Any]) -> None:
        self.report.broken += walker.broken
        self.report.passed += walker.passed

    def _count_missing(self) -> None:
        """Count the messages that the index of the newest chunk lists and that the chunk does not have."""
        if self.index.chunks:
            self.report.missing += (self._listed - Counter(self.index.chunks[-1].counts)).total()
        self._listed.clear()

    def _finish(self, outside: I64) -> None:
        """Drop messages of unknown connections, and count the others."""
        counts: Counter[int] = Counter()
        for chunk in self.index.chunks:
            total = sum(chunk.counts.values())
            chunk.counts = {number: n for number, n in chunk.counts.items() if number in self._known}
            self.report.undescribed += total - sum(chunk.counts.values())
            counts.update(chunk.counts)
        described = np.array([number in self._known for number in outside[:, 1].tolist()], bool)
        self.report.undescribed += int((~described).sum())
        self.outside: I64 = outside[described]
        counts.update(self.outside[:, 1].tolist())
        self.report.read = counts.total()
        self.report.doubtful = sum(
            sum(self.index.chunks[number].counts.values()) for number in self.report.chunks
        )
        self.index.connections = self._known.connections(counts)


class RescuedChunkReader(ChunkReader):
    """Reader of the messages that are left of a file.

    Args:
        path: file.
        form: functions of its format.
        walker: walker over its records.

    Attributes:
        report: counts of the messages read and lost so far.
    """

    def __init__(self, path: Path, form: ChunkFormat, walker: type[RecordWalker[Any]]) -> None:
        self._new_walker = walker
        self.report = DamageReport()
        self._known_times: dict[int, Times] = {}  # by number of the chunk; the index has those of others
        self._outside: I64 = np.zeros((0, 4), np.int64)
        try:
            index = form.read_index(path)
        except DamageError:
            file = FileBytes(path)
            try:
                scan = ChunkScan(path, file, walker)
            finally:
                file.close()
            index, self.report = scan.index, scan.report
            self._known_times, self._outside = scan.times, scan.outside
        super().__init__(path, form, index)

    @property
    def warnings(self) -> list[str]:
        """Sentences of the report."""
        return self.report.sentences

    @property
    def span(self) -> tuple[int, int]:
        """Log time of the first message, and log time of the last message plus one nanosecond."""
        first, end = super().span
        times = self._outside[:, 0].tolist()
        return min([first, *times]), max([end, *(time + 1 for time in times)])

    def times(self, ids: Collection[int], start: int = 0, stop: int = LAST_TIME) -> I64:
        """Return the sorted log times of the connections ``ids`` with start <= time < stop."""
        return np.sort(
            np.concatenate([super().times(ids, start, stop), self._chosen(ids, start, stop)[:, 0]])
        )

    def _sources(self, wanted: Collection[int], start: int, stop: int, few: bool) -> list[Iterator[Item]]:
        rows = self._chosen(wanted, start, stop)
        outside = (
            (time, connection, data)
            for time, connection, offset, size in rows[np.argsort(rows[:, 0], kind="stable")].tolist()
            if len(data := self._bytes.read(offset, size)) == size
        )
        return [*super()._sources(wanted, start, stop, few), outside]

    def _chosen(self, ids: Collection[int], start: int, stop: int) -> I64:
        """Return the messages outside chunks of the connections ``ids`` with start <= time < stop."""
        rows = self._outside
        chosen: I64 = rows[np.isin(rows[:, 1], list(ids)) & (rows[:, 0] >= start) & (rows[:, 0] < stop)]
        return chosen

    def _content(self, number: int) -> list[ChunkMessage]:
        """Return the readable messages of a chunk. Lost ones are counted in the report."""
        chunk, expected = self._index.chunks[number], sum(self._index.chunks[number].counts.values())
        content, damage = chunk.unpack(self._bytes)
        data = memoryview(content)
        messages, is_whole = self._form.parse(data, chunk.counts)
        if not is_whole or len(messages) != expected:
            walker = self._new_walker(MemoryBytes(content), chunk.counts, plausible_span(chunk))
            found = (walker.message(record) for record in walker(0) if record.kind == "message")
            messages = [(time, c, data[at : at + size]) for time, c, at, size in found if c in chunk.counts]
        messages = [message for message in messages if chunk.start <= message[0] <= chunk.end]
        if len(messages) < expected or (damage and number not in self.report.chunks):
            self._count_lost(number, messages, damage)
        return messages

    def _count_lost(self, number: int, messages: list[ChunkMessage], damage: str) -> None:
        """Count the lost messages of a chunk. Correct the counts and times of its connections."""
        chunk = self._index.chunks[number]
        kept = Counter(map(itemgetter(1), messages))
        lost = Counter(chunk.counts)
        lost.subtract(kept)
        self.report.doubtful += len(messages)
        if number in self.report.chunks:
            self.report.doubtful -= sum(chunk.counts.values())
        self.report.chunks.setdefault(number, damage or "whose content is not all there")
        self.report.missing += lost.total()
        self._known_times[number] = {
            id_: np.array([t for t, c, _ in messages if c == id_], np.int64) for id_ in chunk.counts
        }
        chunk.counts = {id_: kept[id_] for id_ in chunk.counts}
        self._index.connections = [
            c._replace(msgcount=c.msgcount - lost[c.id]) for c in self._index.connections
        ]

    def _times_of(self, number: int, connection: int) -> I64:
        """Return the log times of a connection in a chunk. Its content gives them if the index is damaged."""
        if number not in self._known_times:
            try:
                return super()._times_of(number, connection)
            except DamageError:
                messages = self._content(number)
                self._known_times.setdefault(
                    number,
                    {
                        id_: np.array([t for t, c, _ in messages if c == id_], np.int64)
                        for id_ in self._index.chunks[number].counts
                    },
                )
        return self._known_times[number][connection]


def plausible_span(chunk: Chunk) -> tuple[int, int] | None:
    """Return the first and last log time that a chunk states; None if they are implausible."""
    return (chunk.start, chunk.end) if 0 < chunk.start <= chunk.end < LAST_TIME else None
