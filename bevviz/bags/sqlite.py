"""sqlite3 bags, read by rosbags."""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import apsw
import numpy as np
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader as PublicReader

from bevviz.bags.reader import LAST_TIME, DamageError, Message, as_damage, check_count, megabytes
from bevviz.model.frame import I64

MAGIC = b"SQLite format 3\0"
PAGE_SIZES = [1 << bits for bits in range(9, 17)]
LOG_HEAD = struct.Struct(">8I")


class SqliteReader:
    """Reader of a complete sqlite3 bag.

    Args:
        path: file.
        public: the same file with the suffix by which rosbags knows the format.

    Raises:
        DamageError: the end of the file is missing, or messages lie in a log beside it.
    """

    compression = ""
    warnings: Sequence[str] = ()

    def __init__(self, path: Path, public: Path) -> None:
        self._file = path.open("rb")
        head, size = self._file.read(100), self._file.seek(0, 2)
        self._size = size
        page = page_size_of(head)
        if page is None or size < page:
            raise DamageError("the head of the file is damaged")
        if (missing := int.from_bytes(head[28:32], "big") * page - size) > 0:
            raise DamageError(f"the file is damaged or its end is missing ({megabytes(missing)})")
        log = log_path(path)
        if log.exists() and log.stat().st_size > LOG_HEAD.size:
            raise DamageError(f"the recorder did not close it, messages lie in {log.name}")
        self._public = PublicReader(public)
        with as_damage():
            # Without its log, so that nothing is written beside it.
            flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
            self._queries = apsw.Connection(f"file:{public}?immutable=1", flags=flags)
            check_count(path, self._numbers("SELECT count(*) FROM topics")[0][0])  # rosbags reads all of them
            self._public.open()
        self.connections: Sequence[Connection] = list(self._public.connections)
        self._check()

    @property
    def span(self) -> tuple[int, int]:
        """Log time of the first message, and log time of the last message plus one nanosecond."""
        return self._public.start_time, self._public.end_time

    def messages(self, ids: Collection[int], start: int, stop: int) -> Iterator[Message]:
        """Yield messages of the connections ``ids`` with start <= log time < stop, in order of log time."""
        wanted = [c for c in self.connections if c.id in ids]
        with as_damage():
            for message in self._public.messages(wanted, start, stop):
                # sqlite3 reads zeros where pages are missing.
                if os.fstat(self._file.fileno()).st_size < self._size:
                    raise DamageError("the file was cut while it was read")
                yield message

    def times(self, ids: Collection[int], start: int = 0, stop: int = LAST_TIME) -> I64:
        """Return the sorted log times of the connections ``ids`` with start <= time < stop."""
        query = (
            f"SELECT timestamp FROM messages NOT INDEXED WHERE topic_id IN ({','.join('?' * len(ids))}) "
            "AND timestamp >= ? AND timestamp < ?"
        )
        rows = self._numbers(query, *ids, start, stop)
        return np.sort(np.array([time for (time,) in rows], np.int64))

    def _check(self) -> None:
        """Compare the tables and the index with each other.

        Raises:
            DamageError: they disagree.
        """
        if self.span[1] > LAST_TIME or (self.span[0] < 0 and self._public.message_count):
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
        """Close the file."""
        self._file.close()
        self._public.close()
        self._queries.close()


def page_size_of(head: bytes) -> int | None:
    """Return the page size that the head of a file states. None: it is no sqlite3 head."""
    size = int.from_bytes(head[16:18], "big")
    size = 65536 if size == 1 else size
    return size if head[: len(MAGIC)] == MAGIC and size in PAGE_SIZES else None


def log_path(path: Path) -> Path:
    """Return the path of the write-ahead log of a database."""
    return path.with_name(path.name + "-wal")
