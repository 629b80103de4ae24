"""sqlite3 bags: rosbags' reader, able to collect the rows of a file whose end is missing."""

from __future__ import annotations

import mmap
from collections import Counter
from collections.abc import Collection, Generator, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import apsw
import numpy as np
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.metadata import ReaderMetadata
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from bevviz.bags.mcap import FORMATS, megabytes
from bevviz.errors import UserError
from bevviz.frame import I64

MAGIC = b"SQLite format 3\0"
LEAF = 0x0D  # first byte of a page with table rows
INTEGER_SIZES = {0: 0, 1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 7: 8, 8: 0, 9: 0}


class Record(NamedTuple):
    """Where a row lies: ``local`` bytes at ``offset``, the rest in a chain of overflow pages."""

    rowid: int
    offset: int
    local: int
    size: int
    overflow: int  # first overflow page, 0: none
    columns: tuple[tuple[int, int], ...]  # serial type, offset in the record


class Row(NamedTuple):
    """A message."""

    timestamp: int
    rowid: int
    topic: int
    record: Record


class SqliteFile(Sqlite3Reader):
    """Messages in order of log time.

    A damaged file is read page by page (https://www.sqlite.org/fileformat2.html): a bag only grows, so every
    row that lies before the cut is found even where the tree that should lead to it is not.
    """

    path: Path
    format = "sqlite3"
    compression = ""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.lost_messages = 0
        self._missing = 0  # bytes
        self._rows: list[Row] | None = None
        self._bytes: mmap.mmap | None = None
        self._page = 4096
        self._usable = 4096

    def open(self) -> None:
        """Open the database, or collect its rows.

        Raises:
            UserError: not a bag, or nothing in it is readable.
        """
        with self.path.open("rb") as file:
            head = file.read(32)
            size = file.seek(0, 2)
        page = int.from_bytes(head[16:18], "big")
        self._page = 65536 if page == 1 else page
        self._missing = max(0, int.from_bytes(head[28:32], "big") * self._page - size)
        if head[: len(MAGIC)] != MAGIC or self._page < 512 or size < self._page:
            raise UserError(f"{self.path}: not a sqlite3 file, or nothing of it is left")
        self._usable = self._page - head[20]
        if not self._missing:  # else sqlite3 would fill a page that is cut with zeros
            with suppress(ReaderError, apsw.Error):
                super().open()
                return
        self._collect()

    def close(self) -> None:
        if self.dbconn is not None:
            super().close()
        if self._bytes is not None:
            self._bytes.close()

    @property
    def warnings(self) -> list[str]:
        found = []
        if self._rows is not None:
            found.append(
                f"{self.path.name}: the file is damaged or its end is missing "
                f"({megabytes(self._missing)}): read {len(self._rows)} messages, "
                f"{self.lost_messages} more are incomplete"
            )
        log = self.path.with_name(self.path.name + "-wal")
        if log.exists() and log.stat().st_size:
            found.append(
                f"{self.path.name}: messages in {log.name} are not read: the recorder did not close the bag "
                f"('sqlite3 {self.path.name} \"pragma wal_checkpoint\"' moves them in)"
            )
        return found

    def messages(
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Generator[tuple[Connection, int, bytes], None, None]:
        """Messages of ``connections`` with start <= log time < stop, in order of log time."""
        given = 0
        if self._rows is None:
            try:
                for message in super().messages(connections, start, stop):
                    yield message
                    given += 1
                return
            except apsw.Error:  # a damaged page: what is left is found without the tree
                self._collect()
        wanted = {c.id: c for c in connections}
        low, high = start or 0, 2**63 if stop is None else stop
        rows = [r for r in self._rows or () if r.topic in wanted and low <= r.timestamp < high]
        for row in rows[given:]:
            yield wanted[row.topic], row.timestamp, self._content(row.record)[row.record.columns[3][1] :]

    def times(self, connections: Collection[Connection]) -> I64:
        """Log times of all messages of ``connections``, sorted, without their data."""
        topics = [c.id for c in connections]
        if self._rows is not None:
            return np.array([r.timestamp for r in self._rows if r.topic in topics], np.int64)
        assert self.dbconn is not None
        marks = ",".join("?" for _ in topics)
        query = f"SELECT timestamp FROM messages WHERE topic_id IN ({marks}) ORDER BY timestamp"
        return np.fromiter((t for (t,) in self.dbconn.execute(query, topics)), np.int64)

    def _collect(self) -> None:
        with self.path.open("rb") as file:
            data = self._bytes = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        topics: dict[int, tuple[str, str, str]] = {}
        definitions: dict[str, MessageDefinition] = {}
        rows: dict[int, Row] = {}
        leaves = np.frombuffer(data[:: self._page], np.uint8) == LEAF
        for page in np.flatnonzero(leaves).tolist():
            with suppress(IndexError, ValueError):  # a damaged page: its other cells are lost
                for record in self._cells(data, page * self._page):
                    self._take(record, rows, topics, definitions)
        complete = [r for r in rows.values() if r.topic in topics and self._is_complete(r.record)]
        self.lost_messages = len(rows) - len(complete)
        self._rows = sorted(complete)
        counts = Counter(r.topic for r in self._rows)
        nothing = MessageDefinition(MessageDefinitionFormat.NONE, "")
        if self.connections:  # found damaged while reading
            return
        for number, (name, msgtype, encoding) in sorted(topics.items()):
            ext = ConnectionExtRosbag2(encoding, [])
            definition = definitions.get(msgtype, nothing)
            self.connections.append(
                Connection(number, name, msgtype, definition, "", counts[number], ext, self)
            )
        start = self._rows[0].timestamp if self._rows else 2**63 - 1
        end = self._rows[-1].timestamp + 1 if self._rows else 0
        count = len(self._rows)
        self.metadata = ReaderMetadata(max(0, end - start), start, end, count, None, None, None, None)

    def _cells(self, data: mmap.mmap, page: int) -> Iterator[Record]:
        """The rows that start in a leaf page."""
        for cell in range(int.from_bytes(data[page + 3 : page + 5], "big")):
            at = page + 8 + 2 * cell
            size, offset = _varint(data, page + int.from_bytes(data[at : at + 2], "big"))
            rowid, offset = _varint(data, offset)
            local, overflow = size, 0
            if size > self._usable - 35:
                least = (self._usable - 12) * 32 // 255 - 23
                local = least + (size - least) % (self._usable - 4)
                local = local if local <= self._usable - 35 else least
                overflow = int.from_bytes(data[offset + local : offset + local + 4], "big")
            end, column = _varint(data, offset)
            end += offset
            columns = []
            start = end
            while column < end:
                kind, column = _varint(data, column)
                columns.append((kind, start - offset))
                start += INTEGER_SIZES[kind] if kind < 12 else (kind - 12) // 2
            yield Record(rowid, offset, local, size, overflow, tuple(columns))

    def _take(
        self,
        record: Record,
        rows: dict[int, Row],
        topics: dict[int, tuple[str, str, str]],
        definitions: dict[str, MessageDefinition],
    ) -> None:
        """Tell from its columns which table a row is of."""
        shape = "".join("t" if k % 2 else "b" for k, _ in record.columns[1:] if k >= 12)
        width = len(record.columns)
        if width == 4 and shape == "b":  # messages: id, topic_id, timestamp, data
            timestamp = self._integer(record, 2)
            rows[record.rowid] = Row(timestamp, record.rowid, self._integer(record, 1), record)
        elif width >= 4 and shape == "t" * (width - 1) and self._is_complete(record):
            text = [self._text(record, column) for column in range(1, width)]
            if text[1] in FORMATS:  # message_definitions: id, type, encoding, definition, hash
                definitions[text[0]] = MessageDefinition(FORMATS[text[1]], text[2])
            else:  # topics: id, name, type, serialization_format, ...
                topics[record.rowid] = text[0], text[1], text[2]

    def _is_complete(self, record: Record) -> bool:
        assert self._bytes is not None
        left, page = record.size - record.local, record.overflow
        while left > 0:
            start = (page - 1) * self._page
            if page == 0 or start + 4 + min(left, self._usable - 4) > len(self._bytes):
                return False
            page = int.from_bytes(self._bytes[start : start + 4], "big")
            left -= self._usable - 4
        return record.offset + record.local <= len(self._bytes)

    def _content(self, record: Record) -> bytes:
        assert self._bytes is not None
        parts = [self._bytes[record.offset : record.offset + record.local]]
        left, page = record.size - record.local, record.overflow
        while left > 0:
            start = (page - 1) * self._page
            parts.append(self._bytes[start + 4 : start + 4 + min(left, self._usable - 4)])
            page = int.from_bytes(self._bytes[start : start + 4], "big")
            left -= self._usable - 4
        return b"".join(parts)

    def _integer(self, record: Record, column: int) -> int:
        assert self._bytes is not None
        kind, start = record.columns[column]
        start += record.offset
        if kind in (8, 9):
            return kind - 8
        return int.from_bytes(self._bytes[start : start + INTEGER_SIZES[kind]], "big", signed=True)

    def _text(self, record: Record, column: int) -> str:
        kind, start = record.columns[column]
        return self._content(record)[start : start + (kind - 13) // 2].decode()


def _varint(data: mmap.mmap, offset: int) -> tuple[int, int]:
    """A variable-length integer and the offset behind it."""
    value = 0
    for _ in range(8):
        byte = data[offset]
        offset += 1
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, offset
    return value << 8 | data[offset], offset + 1
