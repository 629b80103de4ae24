"""sqlite3 bags: rosbags reads a sound one; of others the pages are read (https://www.sqlite.org/fileformat2.html).

A bag only grows, so every row that lies before a cut is found even where the tree that should lead to it
is not. A write-ahead log beside the file, which a recorder leaves that was killed, is read with it.
"""

from __future__ import annotations

import os
import struct
from array import array
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import apsw
import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition
from rosbags.rosbag2 import Reader as PublicReader

from bevviz import announce
from bevviz.bags.mcap import FORMATS, NOTHING
from bevviz.bags.reader import (
    LAST,
    Bytes,
    DamageError,
    Message,
    Reader,
    as_damage,
    megabytes,
    public_messages,
)
from bevviz.errors import UserError
from bevviz.frame import I64

MAGIC = b"SQLite format 3\0"
LEAF = 0x0D  # first byte of a page with table rows
PAGE_SIZES = [1 << bits for bits in range(9, 17)]
INTEGER_SIZES = {0: 0, 1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8, 7: 8, 8: 0, 9: 0}  # by serial type
COLUMNS = 16  # more than a table of any version of rosbag2 has
LOG_MAGIC = (0x377F0682, 0x377F0683)
LOG_HEAD, FRAME_HEAD = struct.Struct(">8I"), struct.Struct(">6I")


class SoundSqlite:
    """rosbags' reader, for a file that is all there.

    Args:
        path: of the file.
        public: the same file under a name that rosbags knows the format by.

    Raises:
        DamageError: its end is missing, or messages lie in a log beside it.
    """

    compression = ""
    warnings: Sequence[str] = ()

    def __init__(self, path: Path, public: Path) -> None:
        self._path = path
        self._file = path.open("rb")
        head, size = self._file.read(100), self._file.seek(0, 2)
        self._size = size
        page = _page_size(head)
        if page is None or size < page:
            raise DamageError("the head of the file is damaged")
        if (missing := int.from_bytes(head[28:32], "big") * page - size) > 0:
            raise DamageError(f"the file is damaged or its end is missing ({megabytes(missing)})")
        log = log_of(path)
        if log.exists() and log.stat().st_size > LOG_HEAD.size:
            raise DamageError(f"the recorder did not close it: messages in {log.name} are read with it")
        self._public = PublicReader(public)
        with as_damage():
            self._public.open()
            self._queries = apsw.Connection(
                f"file:{public}?immutable=1", flags=apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
            )
        self.connections: Sequence[Connection] = list(self._public.connections)
        self._check()

    @property
    def span(self) -> tuple[int, int]:
        return self._public.start_time, self._public.end_time

    def messages(self, ids: Collection[int], start: int, stop: int) -> Iterator[Message]:
        wanted = [c for c in self.connections if c.id in ids]
        for message in public_messages(self._public.messages(wanted, start, stop)):
            # Where pages are missing sqlite3 reads zeros.
            if os.fstat(self._file.fileno()).st_size < self._size:
                raise DamageError("the file was cut while it was read")
            yield message

    def times(self, ids: Collection[int]) -> I64:
        query = f"SELECT timestamp FROM messages WHERE topic_id IN ({_marks(ids)}) ORDER BY timestamp"
        return np.array([time for (time,) in self._numbers(query, *ids)], np.int64)

    def sums(self, ids: Collection[int], start: int, stop: int) -> tuple[int, int]:
        query = (
            "SELECT count(*), sum(timestamp >> 32), sum(timestamp & 4294967295) "
            "FROM messages NOT INDEXED "
            f"WHERE topic_id IN ({_marks(ids)}) AND timestamp >= ? AND timestamp < ?"
        )
        ((count, high, low),) = self._numbers(query, *ids, start, stop)
        return count, ((high or 0) << 32) + (low or 0)

    def rescuer(self) -> Reader:
        return SqliteRescuer(self._path)

    def _check(self) -> None:
        """Hold the tables and the index against each other.

        Raises:
            DamageError: they disagree.
        """
        if self.span[1] > LAST or (self.span[0] < 0 and self._public.message_count):
            raise DamageError("there are messages of impossible times in it")
        described = sum(c.msgcount for c in self.connections)
        if described != self._public.message_count:
            raise DamageError(f"of {self._public.message_count} messages {described} are of a topic of it")
        indexed = "SELECT count(*) FROM sqlite_master WHERE type = 'index' AND name = 'timestamp_idx'"
        if self._numbers(indexed) == [(1,)]:
            query = "SELECT count(*), sum((id % 65521) * (timestamp % 65521)) FROM messages "
            by_index = self._numbers(query + "INDEXED BY timestamp_idx")
            if by_index != self._numbers(query + "NOT INDEXED"):
                raise DamageError("its index of times disagrees with its messages")

    def _numbers(self, query: str, *values: int) -> list[tuple[Any, ...]]:
        with as_damage():
            return list(self._queries.execute(query, values))

    def close(self) -> None:
        self._file.close()
        self._public.close()
        self._queries.close()


def _marks(ids: Collection[int]) -> str:
    return ",".join("?" for _ in ids)


# --- a damaged file ----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Cell:
    """A row of a table: ``local`` bytes of it lie at ``offset`` of its page, the rest on overflow pages."""

    page: bytes
    rowid: int
    offset: int
    local: int
    size: int
    overflow: int  # the first of those pages, 0: none
    columns: tuple[tuple[int, int], ...]  # serial type, offset in the row


class Pages:
    """The pages of a file, those of the log beside it before its own. Numbers count from 1."""

    def __init__(self, path: Path) -> None:
        self._file = Bytes(path)
        log = log_of(path)
        self._log = Bytes(log) if log.exists() else None
        self.in_log: dict[int, int] = {}  # page -> offset of its newest version
        self.log_frames = 0  # that are not sound
        head = self._file.read(0, 100)
        self.size = _page_size(head) or 0
        if self._log is not None:
            self._read_log(self._log)
            if 1 in self.in_log:
                head = self.read(1)[:100]
        self.reserved = head[20] if len(head) > 20 and self.size else 0
        self.missing = max(0, int.from_bytes(head[28:32], "big") * self.size - self._file.size)

    @property
    def usable(self) -> int:
        return self.size - self.reserved

    @property
    def count(self) -> int:
        own = -(-self._file.size // self.size)
        return max([own, *self.in_log])

    @property
    def length(self) -> int:
        """Bytes."""
        return self.count * self.size

    def read(self, number: int) -> bytes:
        """A page; shorter where the file is cut, empty where there is none."""
        if (offset := self.in_log.get(number)) is not None and self._log is not None:
            return self._log.read(offset, self.size)
        return self._file.read((number - 1) * self.size, self.size) if number > 0 else b""

    def has(self, number: int, size: int) -> bool:
        """Whether the first ``size`` bytes of a page are there."""
        return number > 0 and (number in self.in_log or (number - 1) * self.size + size <= self._file.size)

    def first(self, number: int) -> int:
        """The number that a page begins with: of the next overflow page."""
        if (offset := self.in_log.get(number)) is not None and self._log is not None:
            return int.from_bytes(self._log.read(offset, 4), "big")
        return int.from_bytes(self._file.read((number - 1) * self.size, 4), "big")

    def leaves(self) -> Iterator[int]:
        """Numbers of the pages with table rows."""
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
        self._file.close()
        if self._log is not None:
            self._log.close()

    def _read_log(self, log: Bytes) -> None:
        """Find the newest version of each page among what was committed, by frames whose checksums fit."""
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
                offset += FRAME_HEAD.size + page_size  # of an older round of the log
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


class SqliteRescuer:
    """The rows of a file, page by page, without the trees that lead to them.

    Args:
        path: of the file.

    Raises:
        UserError: there is nothing left of it.
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
        times = self._rows[:, 0]
        return (int(times[0]), int(times[-1]) + 1) if len(times) else (LAST, 0)

    @property
    def warnings(self) -> list[str]:
        found = [f"read {len(self._rows)} messages"]
        if self._incomplete:
            found.append(f"{self._incomplete} more are incomplete: lost")
        if self._undescribed:
            found.append(f"{self._undescribed} messages are of topics that nothing describes: lost")
        if self._broken:
            found.append(f"{self._broken} broken row(s) or page(s) passed over")
        if self._pages.log_frames:
            found.append(f"{self._pages.log_frames} page(s) of the log do not fit their checksum")
        if self._unread:
            found.append(f"{len(self._unread)} messages could no longer be read: lost")
        return found

    def messages(self, ids: Collection[int], start: int, stop: int) -> Iterator[Message]:
        known = {c.id: c for c in self.connections}
        for number, (time, topic, page, at) in enumerate(self._rows.tolist()):
            if topic in ids and start <= time < stop:
                try:
                    cell = self._cell(self._pages.read(page), at)
                    data = self._content(cell)[cell.columns[3][1] :]
                except DamageError:
                    self._unread.add(number)
                    continue
                yield known[topic], time, data

    def times(self, ids: Collection[int]) -> I64:
        times: I64 = self._rows[np.isin(self._rows[:, 1], list(ids)), 0]
        return times

    def close(self) -> None:
        self._pages.close()

    def _collect(self, path: Path) -> None:
        rows, topics = array("q"), dict[int, tuple[str, str, str]]()
        definitions: dict[str, MessageDefinition] = {}
        self._incomplete = self._broken = 0
        self._unread: set[int] = set()
        count = self._pages.count
        bar = announce.bar(total=count, unit="page", desc=f"rescue {path.name}", delay=1)
        seen: set[int] = set()
        with bar:
            for number in self._pages.leaves():
                bar.update(number - bar.n)
                page = self._pages.read(number)
                for at in self._pointers(page, number):
                    try:
                        self._take(self._cell(page, at), (number, at), rows, topics, definitions, seen)
                    except DamageError:
                        self._broken += 1
        found: I64 = np.frombuffer(rows, np.int64).reshape(-1, 5)
        known = np.isin(found[:, 1], list(topics))
        self._undescribed = int((~known).sum())
        found = found[known]
        found = found[np.lexsort((found[:, 4], found[:, 0]))]  # rows of one time in order of their ids
        self._rows: I64 = found[:, :4]  # time, topic, page, offset of the cell
        counts = Counter(found[:, 1].tolist())
        self.connections: Sequence[Connection] = [
            Connection(
                *(number, name, msgtype, definitions.get(msgtype, NOTHING), "", counts[number]),
                ConnectionExtRosbag2(encoding, []),
                None,
            )
            for number, (name, msgtype, encoding) in sorted(topics.items())
        ]

    def _pointers(self, page: bytes, number: int) -> list[int]:
        """Offsets of the cells of a leaf."""
        head = 100 if number == 1 else 0
        count = int.from_bytes(page[head + 3 : head + 5], "big")
        listed = page[head + 8 : head + 8 + 2 * count]
        if len(listed) < 2 * count:
            self._broken += 1
        return [int(at) for at in np.frombuffer(listed[: len(listed) // 2 * 2], ">u2")]

    def _cell(self, page: bytes, at: int) -> Cell:
        """A row by its offset in a page.

        Raises:
            DamageError: it makes no sense.
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
        while column < end and len(columns) < COLUMNS:
            kind, column = _varint(page, column)
            if kind in (10, 11):
                raise DamageError("a column is of a type that there is not")
            columns.append((kind, start - offset))
            start += INTEGER_SIZES[kind] if kind < 12 else (kind - 12) // 2
        if start - offset > size or column != end:
            raise DamageError("the columns of a row are longer than the row")
        return Cell(page, rowid, offset, local, size, overflow, tuple(columns))

    def _take(
        self,
        cell: Cell,
        place: tuple[int, int],
        rows: array[int],
        topics: dict[int, tuple[str, str, str]],
        definitions: dict[str, MessageDefinition],
        seen: set[int],
    ) -> None:
        """Tell from its columns which table a row is of."""
        kinds = [kind for kind, _ in cell.columns[1:]]
        if len(kinds) == 3 and max(kinds[:2]) < 10 and kinds[2] >= 12 and kinds[2] % 2 == 0:
            # messages: id, topic_id, timestamp, data
            topic, time = _integer(cell, 1), _integer(cell, 2)
            if not 0 <= time < LAST or cell.columns[3][1] + (kinds[2] - 12) // 2 != cell.size:
                raise DamageError("a message of an impossible time or size")
            if cell.rowid in seen:
                return
            seen.add(cell.rowid)
            try:
                self._overflow(cell)
            except DamageError:
                self._incomplete += 1
                return
            rows.extend((time, topic, *place, cell.rowid))
        elif len(kinds) >= 3 and kinds[0] >= 13 and kinds[0] % 2:
            text = self._texts(cell)
            if text[1] in FORMATS:  # message_definitions: id, type, encoding, definition, hash
                definitions[text[0]] = MessageDefinition(FORMATS[text[1]], text[2])
            elif text[0][:1] == "/" or "/" in text[1]:  # topics: id, name, type, serialization_format, ...
                topics[cell.rowid] = text[0], text[1], text[2]

    def _overflow(self, cell: Cell) -> list[int]:
        """The overflow pages of a row.

        Raises:
            DamageError: they are not all there.
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
                number = self._pages.first(number)
        return pages

    def _content(self, cell: Cell) -> bytes:
        """All bytes of a row.

        Raises:
            DamageError: they are not all there.
        """
        pages = self._overflow(cell)
        parts = [cell.page[cell.offset : cell.offset + cell.local]]
        parts += [self._pages.read(number)[4 : self._pages.usable] for number in pages]
        content = b"".join(parts)
        if len(content) < cell.size:
            raise DamageError("a row ends behind the file")
        return content[: cell.size]

    def _texts(self, cell: Cell) -> list[str]:
        """The columns behind the first one; of those that are no text nothing."""
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
    """A variable-length integer and the offset behind it.

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


def _page_size(head: bytes) -> int | None:
    """None: it is not the head of a file."""
    size = int.from_bytes(head[16:18], "big")
    size = 65536 if size == 1 else size
    return size if head[: len(MAGIC)] == MAGIC and size in PAGE_SIZES else None


def log_of(path: Path) -> Path:
    return path.with_name(path.name + "-wal")


@cache
def _weights(size: int) -> NDArray[np.uint32]:
    """(size / 4 + 2, 2) what each number of a frame, and the two of the checksum before, add to its checksum.

    The checksum takes two numbers at a time: s0 += x0 + s1; s1 += x1 + s0. So it is a sum of multiples.
    """
    steps = size // 8
    weights = np.zeros((size // 4 + 2, 2), np.uint32)
    # What a change of s0 and of s1 before the last n steps does in the end, n = 0, 1, ...
    a, b, c, d = 1, 0, 0, 1  # s0 -> (a, b), s1 -> (c, d)
    for step in range(steps - 1, -1, -1):
        # x0 goes into s0, and through it into s1; x1 goes into s1 alone.
        weights[2 * step + 2] = (a + c) & 0xFFFFFFFF, (b + d) & 0xFFFFFFFF
        weights[2 * step + 3] = c, d
        # One more step before: s0' = s0 + s1, s1' = s1 + s0' = s0 + 2 s1.
        a, b, c, d = (x & 0xFFFFFFFF for x in (a + c, b + d, a + 2 * c, b + 2 * d))
    weights[0], weights[1] = (a, b), (c, d)
    return weights


def checksum_of(data: bytes, order: str, before: tuple[int, int]) -> tuple[int, int]:
    """The checksum of a frame of the log, which goes on from that of the frame before."""
    numbers = np.concatenate(
        [np.array(before, np.uint32), np.frombuffer(data, order + "u4").astype(np.uint32)]
    )
    with np.errstate(over="ignore"):
        sums = (numbers[:, None] * _weights(len(data))).sum(axis=0, dtype=np.uint32)
    return int(sums[0]), int(sums[1])
