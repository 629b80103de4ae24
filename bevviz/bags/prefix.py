"""Readers of damaged files up to the damage, in one pass from front to back.

They stand in for the extra ``rescue``, which also searches the bytes after the damage. The ``StreamReader``
of the package mcap ends with the last whole chunk: of the demo drive, cut at two thirds, it gives 116
messages, this pass gives 143.
"""

from __future__ import annotations

from array import array
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path

import apsw
import numpy as np
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition

from bevviz.bags.chunks import Chunk, ChunkFormat, ChunkMessage, ChunkReader, FileIndex
from bevviz.bags.damage import EXTRA, DamageReport
from bevviz.bags.mcap import FORMATS, NO_DEFINITION
from bevviz.bags.reader import LAST_TIME, FileBytes, Message
from bevviz.bags.sqlite import log_path, open_database, page_size_of
from bevviz.errors import UserError
from bevviz.model.frame import I64
from bevviz.support import progress

UNREADABLE = (apsw.Error, ValueError)  # the latter: text that is not UTF-8
EVERY = range(1 << 32)  # numbers of all connections that a file can have


class PrefixChunkReader(ChunkReader):
    """Reader of all chunks before the first broken record, and of each chunk up to its damage.

    Args:
        path: file.
        form: functions of its format.

    Attributes:
        report: counts of the messages read and lost.
    """

    def __init__(self, path: Path, form: ChunkFormat) -> None:
        self.report = DamageReport()
        self._known_times: list[Mapping[int, I64]] = []  # by number of the chunk
        file = FileBytes(path)
        try:
            index = self._scan(path, form, file)
        finally:
            file.close()
        super().__init__(path, form, index)

    @property
    def warnings(self) -> list[str]:
        """Sentences of the report."""
        return self.report.sentences

    def _scan(self, path: Path, form: ChunkFormat, file: FileBytes) -> FileIndex:
        """Read the file from front to back. Return its chunks and connections."""
        known, chunks = form.descriptions(), list[Chunk]()
        bar = progress.bar(total=file.size, unit="B", unit_scale=True, desc=f"read {path.name}", delay=1)
        with bar:
            for chunk in form.walk(file, known, self.report):
                bar.update(chunk.data + chunk.packed - bar.n)
                content, damage = chunk.unpack(file)
                form.note_all(content, known)
                times: dict[int, array[int]] = defaultdict(lambda: array("q"))
                messages, is_whole = form.parse(memoryview(content), EVERY)
                for time, connection, _ in messages:
                    times[connection].append(time)
                if not (damage or is_whole or chunk.cut):
                    damage = "whose content is not all there"
                if damage:
                    self.report.chunks[len(chunks)] = damage
                    self.report.doubtful += sum(map(len, times.values()))
                if chunk.cut:
                    self.report.cut, self.report.rescued = chunk.packed, sum(map(len, times.values()))
                self._known_times.append({c: np.frombuffer(values, np.int64) for c, values in times.items()})
                chunks.append(chunk)
        counts: Counter[int] = Counter()
        for chunk, described in zip(chunks, self._known_times, strict=True):
            chunk.counts = {c: len(values) for c, values in described.items() if c in known}
            self.report.undescribed += sum(map(len, described.values())) - sum(chunk.counts.values())
            chunk.start = min((int(described[c].min()) for c in chunk.counts), default=LAST_TIME)
            chunk.end = max((int(described[c].max()) for c in chunk.counts), default=-1)
            counts.update(chunk.counts)
        self.report.read = counts.total()
        self.report.is_partial = bool(self.report.cut or self.report.chunks or self.report.broken)
        return FileIndex(chunks, known.connections(counts))

    def _content(self, number: int) -> list[ChunkMessage]:
        """Return the messages of a chunk. Those that can no longer be read are counted."""
        chunk = self._index.chunks[number]
        content, _ = chunk.unpack(self._bytes)
        messages, _ = self._form.parse(memoryview(content), chunk.counts)
        self.report.unread = max(self.report.unread, sum(chunk.counts.values()) - len(messages))
        return messages

    def _times_of(self, number: int, connection: int) -> I64:
        """Return the log times of a connection in a chunk, as the pass found them."""
        return self._known_times[number][connection]


class _WholePagesFile(apsw.VFSFile):
    """Database without its last page if that is cut. sqlite3 would read zeros where its bytes are missing."""

    def xFileSize(self) -> int:  # noqa: N802
        """Return the size of all whole pages."""
        size, page = super().xFileSize(), page_size_of(super().xRead(100, 0))
        return size - size % page if page else size


class _WholePages(apsw.VFS):
    """Access to files for sqlite3 that shows whole pages alone."""

    name = "bevviz whole pages"

    def __init__(self) -> None:
        super().__init__(self.name, "")

    def xOpen(self, name: str | apsw.URIFilename | None, flags: list[int]) -> _WholePagesFile:  # noqa: N802
        """Open a file."""
        return _WholePagesFile("", name, flags)


@cache
def _whole_pages() -> _WholePages:
    """Register the access once. The cache keeps it, since sqlite3 forgets an access without a reference."""
    return _WholePages()


class PrefixSqliteReader:
    """Reader of the rows of a database up to the damage, by sqlite3 itself. The log beside it is not read.

    Args:
        path: file.
        public: the same file under a name without special characters.

    Attributes:
        report: counts of the messages read and lost.

    Raises:
        UserError: the file has no readable row.
    """

    compression = ""

    def __init__(self, path: Path, public: Path) -> None:
        self.report = DamageReport()
        rows = array("q")
        try:
            self._queries = open_database(public, _whole_pages().name)
            self._queries.execute("PRAGMA writable_schema = ON")  # Without it, sqlite3 opens no cut file.
            query = "SELECT id, name, type, serialization_format FROM topics"
            rows_of_topics = list(self._queries.execute(query))
        except UNREADABLE:
            raise UserError(f"{path}: nothing of it can be read; {EXTRA}") from None
        topics = [row for row in rows_of_topics if [*map(type, row)] == [int, str, str, str]]
        definitions = self._definitions()
        try:
            # The data is asked for, so that a row counts only if all of it can be read.
            query = "SELECT timestamp, topic_id, id, data FROM messages ORDER BY id"
            for row in self._queries.execute(query):
                if [*map(type, row)] == [int, int, int, bytes] and 0 <= row[0] < LAST_TIME:
                    rows.extend(row[:3])
                else:
                    self.report.incomplete += 1
        except UNREADABLE:
            self.report.broken = 1
        self.report.is_partial = bool(self.report.broken) or log_path(path).exists()
        table: I64 = np.frombuffer(rows, np.int64).reshape(-1, 3)
        known = np.isin(table[:, 1], [topic[0] for topic in topics])
        self.report.read, self.report.undescribed = int(known.sum()), int((~known).sum())
        self._rows = table[known][np.argsort(table[known][:, 0], kind="stable")]
        counts = Counter(self._rows[:, 1].tolist())
        self.connections: Sequence[Connection] = [
            Connection(
                *(number, name, kind, definitions.get(kind, NO_DEFINITION), "", counts[number]),
                ConnectionExtRosbag2(encoding, []),
                None,
            )
            for number, name, kind, encoding in topics
        ]

    @property
    def span(self) -> tuple[int, int]:
        """Log time of the first message, and log time of the last message plus one nanosecond."""
        times = self._rows[:, 0]
        return (int(times[0]), int(times[-1]) + 1) if len(times) else (LAST_TIME, 0)

    @property
    def warnings(self) -> list[str]:
        """Sentences of the report."""
        return self.report.sentences

    def messages(self, ids: Collection[int], start: int, stop: int) -> Iterator[Message]:
        """Yield messages of the connections ``ids`` with start <= log time < stop, in order of log time."""
        known = {c.id: c for c in self.connections}
        for time, topic, row in self._rows.tolist():
            if topic in ids and start <= time < stop:
                try:
                    ((data,),) = self._queries.execute("SELECT data FROM messages WHERE id = ?", (row,))
                except UNREADABLE:  # The file was changed after the pass.
                    self.report.unread += 1
                    continue
                yield known[topic], time, data

    def times(self, ids: Collection[int], start: int = 0, stop: int = LAST_TIME) -> I64:
        """Return the sorted log times of the connections ``ids`` with start <= time < stop."""
        times: I64 = self._rows[np.isin(self._rows[:, 1], list(ids)), 0]
        return times[(times >= start) & (times < stop)]

    def close(self) -> None:
        """Close the file."""
        self._queries.close()

    def _definitions(self) -> Mapping[str, MessageDefinition]:
        """Return the message definitions by type. Older bags have none."""
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        try:
            rows = list(self._queries.execute(query))
        except UNREADABLE:
            return {}
        return {
            kind: MessageDefinition(FORMATS[form], text)
            for kind, form, text in rows
            if form in FORMATS and isinstance(text, str)
        }
