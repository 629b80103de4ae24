"""Reader of a damaged sqlite3 bag: rows are read page by page, without the trees that lead to them.

A bag only grows, so every row before a cut is found even if the tree that leads to it is lost. The
write-ahead log that a killed recorder leaves beside the file is read as well.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition

from bevviz.bags.mcap import FORMATS, NO_DEFINITION
from bevviz.bags.reader import LAST_TIME, DamageError, Message
from bevviz.bags.rescue.report import DamageReport
from bevviz.bags.rescue.sqlite_pages import Pages
from bevviz.bags.sqlite import PAGE_SIZES
from bevviz.errors import UserError
from bevviz.model.frame import I64
from bevviz.support import progress

INTEGER_SIZES = {0: 0, 1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 7: 8, 8: 0, 9: 0}  # bytes by serial type
MAX_COLUMNS = 16  # more columns than any table of rosbag2 has


@dataclass(frozen=True, slots=True)
class Cell:
    """A table row: ``local`` bytes lie at ``offset`` of its page, the other bytes on overflow pages."""

    page: bytes
    rowid: int
    offset: int
    local: int
    size: int
    overflow: int  # first overflow page; 0: none
    columns: tuple[tuple[int, int], ...]  # serial type, offset in the row


class RescuedSqliteReader:
    """Reader of the rows of a damaged file, page by page.

    Args:
        path: file.

    Attributes:
        report: counts of the messages read and lost so far.

    Raises:
        UserError: the file has no readable row.
    """

    compression = ""

    def __init__(self, path: Path) -> None:
        self._pages = Pages(path)
        try:
            sizes = [self._pages.size] if self._pages.size else PAGE_SIZES[::-1]
            for size in sizes:
                self._pages.size = size
                self._collect(path)
                if len(self._rows):
                    break
            if not self.connections and not len(self._rows):
                raise UserError(f"{path}: not a sqlite3 file, or nothing of it is left")
        except BaseException:
            self._pages.close()
            raise

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
        for number, (time, topic, page, at) in enumerate(self._rows.tolist()):
            if topic in ids and start <= time < stop:
                try:
                    cell = self._cell(self._pages.read(page), at)
                    data = self._content(cell)[cell.columns[3][1] :]
                except DamageError:
                    self._unread.add(number)
                    self.report.unread = len(self._unread)
                    continue
                yield known[topic], time, data

    def times(self, ids: Collection[int], start: int = 0, stop: int = LAST_TIME) -> I64:
        """Return the sorted log times of the connections ``ids`` with start <= time < stop."""
        times: I64 = self._rows[np.isin(self._rows[:, 1], list(ids)), 0]
        return times[(times >= start) & (times < stop)]

    def close(self) -> None:
        """Close the file."""
        self._pages.close()

    def _collect(self, path: Path) -> None:
        rows, topics = array("q"), dict[int, tuple[str, str, str]]()
        definitions: dict[str, MessageDefinition] = {}
        self.report = DamageReport(log_pages=self._pages.log_frames)
        self._unread: set[int] = set()
        count = self._pages.count
        bar = progress.bar(total=count, unit="page", desc=f"rescue {path.name}", delay=1)
        seen: set[int] = set()
        with bar:
            for number in self._pages.leaves():
                bar.update(number - bar.n)
                page = self._pages.read(number)
                for at in self._pointers(page, number):
                    try:
                        self._add_row(self._cell(page, at), (number, at), rows, topics, definitions, seen)
                    except DamageError:
                        self.report.broken += 1
        table: I64 = np.frombuffer(rows, np.int64).reshape(-1, 5)
        known = np.isin(table[:, 1], list(topics))
        self.report.undescribed, self.report.read = int((~known).sum()), int(known.sum())
        table = table[known]
        table = table[np.lexsort((table[:, 4], table[:, 0]))]  # rows with the same time in order of their ids
        self._rows: I64 = table[:, :4]  # time, topic, page, offset of the cell
        counts = Counter(table[:, 1].tolist())
        self.connections: Sequence[Connection] = [
            Connection(
                *(number, name, msgtype, definitions.get(msgtype, NO_DEFINITION), "", counts[number]),
                ConnectionExtRosbag2(encoding, []),
                None,
            )
            for number, (name, msgtype, encoding) in sorted(topics.items())
        ]

    def _pointers(self, page: bytes, number: int) -> list[int]:
        """Return the cell offsets of a leaf page."""
        head = 100 if number == 1 else 0
        count = int.from_bytes(page[head + 3 : head + 5], "big")
        listed = page[head + 8 : head + 8 + 2 * count]
        if len(listed) < 2 * count:
            self.report.broken += 1
        return [int(at) for at in np.frombuffer(listed[: len(listed) // 2 * 2], ">u2")]

    def _cell(self, page: bytes, at: int) -> Cell:
        """Parse the row at an offset of a page.

        Raises:
            DamageError: the bytes are no row.
        """
        size, offset = _varint(page, at)
        rowid, offset = _varint(page, offset)
        if size > self._pages.length:
            raise DamageError("a row is longer than the file")
        local, overflow = size, 0
        if size > self._pages.usable - 35:
            least = (self._pages.usable - 12) * 32 // 255 - 23
            local = least + (size - least) % (self._pages.usable - 4)
            local = local if local <= self._pages.usable - 35 else least
            overflow = int.from_bytes(page[offset + local : offset + local + 4], "big")
        end, column = _varint(page, offset)
        end += offset
        columns: list[tuple[int, int]] = []
        start = end
        while column < end and len(columns) < MAX_COLUMNS:
            kind, column = _varint(page, column)
            if kind in (10, 11):
                raise DamageError("a column is of a type that there is not")
            columns.append((kind, start - offset))
            start += INTEGER_SIZES[kind] if kind < 12 else (kind - 12) // 2
        if start - offset > size or column != end:
            raise DamageError("the columns of a row are longer than the row")
        return Cell(page, rowid, offset, local, size, overflow, tuple(columns))

    def _add_row(
        self,
        cell: Cell,
        position: tuple[int, int],
        rows: array[int],
        topics: dict[int, tuple[str, str, str]],
        definitions: dict[str, MessageDefinition],
        seen: set[int],
    ) -> None:
        """Add a row to the table that its columns indicate."""
        kinds = [kind for kind, _ in cell.columns[1:]]
        if len(kinds) == 3 and max(kinds[:2]) < 10 and kinds[2] >= 12 and kinds[2] % 2 == 0:
            # messages: id, topic_id, timestamp, data
            topic, time = _integer(cell, 1), _integer(cell, 2)
            if not 0 <= time < LAST_TIME or cell.columns[3][1] + (kinds[2] - 12) // 2 != cell.size:
                raise DamageError("a message of an impossible time or size")
            if cell.rowid in seen:
                return
            seen.add(cell.rowid)
            try:
                self._overflow_pages(cell)
            except DamageError:
                self.report.incomplete += 1
                return
            rows.extend((time, topic, *position, cell.rowid))
        elif len(kinds) >= 3 and kinds[0] >= 13 and kinds[0] % 2:
            text = self._texts(cell)
            if text[1] in FORMATS:  # message_definitions: id, type, encoding, definition, hash
                definitions[text[0]] = MessageDefinition(FORMATS[text[1]], text[2])
            elif text[0][:1] == "/" or "/" in text[1]:  # topics: id, name, type, serialization_format, ...
                topics[cell.rowid] = text[0], text[1], text[2]

    def _overflow_pages(self, cell: Cell) -> list[int]:
        """Return the overflow pages of a row.

        Raises:
            DamageError: a page is missing.
        """
        pages, number = [], cell.overflow
        left, room = cell.size - cell.local, self._pages.usable - 4
        if cell.offset + cell.local > len(cell.page):
            raise DamageError("a row ends behind its page")
        while left > 0:
            if not self._pages.has(number, 4 + min(left, room)):
                raise DamageError("a row ends behind the file")
            pages.append(number)
            left -= room
            if left > 0:
                number = self._pages.next_overflow(number)
        return pages

    def _content(self, cell: Cell) -> bytes:
        """Return all bytes of a row.

        Raises:
            DamageError: a page is missing.
        """
        pages = self._overflow_pages(cell)
        parts = [cell.page[cell.offset : cell.offset + cell.local]]
        parts += [self._pages.read(number)[4 : self._pages.usable] for number in pages]
        content = b"".join(parts)
        if len(content) < cell.size:
            raise DamageError("a row ends behind the file")
        return content[: cell.size]

    def _texts(self, cell: Cell) -> list[str]:
        """Return the columns after the first one. A column without text is empty."""
        content = self._content(cell)
        return [
            content[start : start + (kind - 13) // 2].decode(errors="replace")
            if kind >= 13 and kind % 2
            else ""
            for kind, start in cell.columns[1:]
        ]


def _integer(cell: Cell, column: int) -> int:
    kind, start = cell.columns[column]
    if kind in (8, 9):
        return kind - 8
    start += cell.offset
    return int.from_bytes(cell.page[start : start + INTEGER_SIZES[kind]], "big", signed=True)


def _varint(data: bytes, offset: int) -> tuple[int, int]:
    """Parse a variable-length integer. Return it with the offset after it.

    Raises:
        DamageError: the data ends before it.
    """
    value = 0
    for at in range(offset, min(offset + 8, len(data))):
        value = value << 7 | data[at] & 0x7F
        if data[at] < 0x80:
            return value, at + 1
    if offset + 8 >= len(data):
        raise DamageError("a row ends behind its page")
    return value << 8 | data[offset + 8], offset + 9
