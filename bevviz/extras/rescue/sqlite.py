"""Reader of a damaged sqlite3 bag: rows are read page by page, without the trees that lead to them.

A bag only grows, so every row before a cut is found even if the tree that leads to it is lost. The
write-ahead log that a killed recorder leaves beside the file is read as well. The format of pages is
https://www.sqlite.org/fileformat2.html.
"""

from __future__ import annotations

import struct
from array import array
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition

from bevviz.bags.damage import DamageReport
from bevviz.bags.mcap import FORMATS, NO_DEFINITION
from bevviz.bags.reader import LAST_TIME, DamageError, FileBytes, Message
from bevviz.bags.sqlite import LOG_HEAD, PAGE_SIZES, log_path, page_size_of
from bevviz.errors import UserError
from bevviz.model.frame import I64
from bevviz.support import progress

LEAF = 0x0D  # first byte of a page with table rows
LOG_MAGIC = (0x377F0682, 0x377F0683)
FRAME_HEAD = struct.Struct(">6I")


class Pages:
    """Pages of a file, numbered from 1. A page in the log replaces that of the file."""

    def __init__(self, path: Path) -> None:
        self._file = FileBytes(path)
        log = log_path(path)
        self._log = FileBytes(log) if log.exists() else None
        self.in_log: dict[int, int] = {}  # offset of the newest version by page number
        self.log_frames = 0  # number of log frames with a wrong checksum
        head = self._file.read(0, 100)
        self.size = page_size_of(head) or 0
        if self._log is not None:
            self._read_log(self._log)
            if 1 in self.in_log:
                head = self.read(1)[:100]
        self.reserved = head[20] if len(head) > 20 and self.size else 0
        self.missing = max(0, int.from_bytes(head[28:32], "big") * self.size - self._file.size)

    @property
    def usable(self) -> int:
        """Usable bytes of a page."""
        return self.size - self.reserved

    @property
    def count(self) -> int:
        """Number of pages of the file and the log."""
        file_pages = -(-self._file.size // self.size)
        return max([file_pages, *self.in_log])

    @property
    def length(self) -> int:
        """Size of all pages in bytes."""
        return self.count * self.size

    def read(self, number: int) -> bytes:
        """Read a page. It is shorter at the cut of a file, and empty if it does not exist."""
        if (offset := self.in_log.get(number)) is not None and self._log is not None:
            return self._log.read(offset, self.size)
        return self._file.read((number - 1) * self.size, self.size) if number > 0 else b""

    def has(self, number: int, size: int) -> bool:
        """Tell whether the first ``size`` bytes of a page exist."""
        return number > 0 and (number in self.in_log or (number - 1) * self.size + size <= self._file.size)

    def next_overflow(self, number: int) -> int:
        """Read the number at the start of an overflow page: the next overflow page."""
        if (offset := self.in_log.get(number)) is not None and self._log is not None:
            return int.from_bytes(self._log.read(offset, 4), "big")
        return int.from_bytes(self._file.read((number - 1) * self.size, 4), "big")

    def leaves(self) -> Iterator[int]:
        """Yield the numbers of the pages with table rows."""
        step = max(1, (1 << 22) // self.size)
        for first in range(1, self.count + 1, step):
            block = self._file.read((first - 1) * self.size, step * self.size)
            kinds = bytearray(block[:: self.size].ljust(min(step, self.count + 1 - first), b"\0"))
            if first == 1 and len(block) > 100:
                kinds[0] = block[100]
            for number in range(first, first + len(kinds)):
                if number in self.in_log:
                    page = self.read(number)
                    kinds[number - first] = page[100 if number == 1 else 0]
            yield from (first + int(i) for i in np.flatnonzero(np.frombuffer(kinds, np.uint8) == LEAF))

    def close(self) -> None:
        """Close the files."""
        self._file.close()
        if self._log is not None:
            self._log.close()

    def _read_log(self, log: FileBytes) -> None:
        """Find the newest committed version of each page in the log, without frames of a wrong checksum."""
        head = log.read(0, LOG_HEAD.size)
        if len(head) < LOG_HEAD.size:
            return
        magic, _, page_size, _, salt, salt2, *checksum = LOG_HEAD.unpack(head)
        if magic not in LOG_MAGIC or page_size not in PAGE_SIZES:
            return
        self.size = self.size or page_size
        if page_size != self.size:
            return
        order = ">" if magic & 1 else "<"
        before, pages = (checksum[0], checksum[1]), dict[int, int]()
        offset = LOG_HEAD.size
        while offset + FRAME_HEAD.size + page_size <= log.size:
            frame = log.read(offset, FRAME_HEAD.size)
            number, committed, *salts = FRAME_HEAD.unpack(frame)[:4]
            after = struct.unpack(">2I", frame[16:])
            if salts != [salt, salt2]:
                offset += FRAME_HEAD.size + page_size  # a frame of an older round of the log
                continue
            data = frame[:8] + log.read(offset + FRAME_HEAD.size, page_size)
            if checksum_of(data, order, before) == after and number:
                pages[number] = offset + FRAME_HEAD.size
            else:
                self.log_frames += 1
                pages.pop(number, None)
            before = after
            offset += FRAME_HEAD.size + page_size
            if committed:
                self.in_log.update(pages)
                pages.clear()


@cache
def _weights(size: int) -> NDArray[np.uint32]:
    """Return a (size / 4 + 2, 2) array: the factors of each 32-bit word in the two sums of a checksum.

    The first two words are the previous checksum, the others those of the frame. The checksum takes two words
    at a time: s0 += x0 + s1; s1 += x1 + s0. So both sums are linear in the words.
    """
    steps = size // 8
    weights = np.zeros((size // 4 + 2, 2), np.uint32)
    # Effect of a change of s0 and of s1 before the last n steps on the result, n = 0, 1, ...
    a, b, c, d = 1, 0, 0, 1  # s0 -> (a, b), s1 -> (c, d)
    for step in range(steps - 1, -1, -1):
        # x0 goes into s0 and through it into s1; x1 goes into s1 alone.
        weights[2 * step + 2] = (a + c) & 0xFFFFFFFF, (b + d) & 0xFFFFFFFF
        weights[2 * step + 3] = c, d
        # One more step before: s0' = s0 + s1, s1' = s1 + s0' = s0 + 2 s1.
        a, b, c, d = (x & 0xFFFFFFFF for x in (a + c, b + d, a + 2 * c, b + 2 * d))
    weights[0], weights[1] = (a, b), (c, d)
    return weights


def checksum_of(data: bytes, order: str, before: tuple[int, int]) -> tuple[int, int]:
    """Return the checksum of a log frame. It continues that of the previous frame."""
    numbers = np.concatenate(
        [np.array(before, np.uint32), np.frombuffer(data, order + "u4").astype(np.uint32)]
    )
    with np.errstate(over="ignore"):
        sums = (numbers[:, None] * _weights(len(data))).sum(axis=0, dtype=np.uint32)
    return int(sums[0]), int(sums[1])


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
