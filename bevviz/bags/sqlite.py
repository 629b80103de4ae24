"""sqlite3 bags of rosbag2, of every version of their tables."""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import apsw
import numpy as np
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition

from bevviz.bags.mcap import FORMATS, NO_DEFINITION, parse_profiles
from bevviz.bags.reader import LAST_TIME, DamageError, Message, as_damage, check_count, megabytes
from bevviz.model.frame import I64

MAGIC = b"SQLite format 3\0"
PAGE_SIZES = [1 << bits for bits in range(9, 17)]
LOG_HEAD = struct.Struct(">8I")


class SqliteReader:
    """Reader of a complete sqlite3 bag.

    Args:
        path: file.

    Raises:
        DamageError: the end of the file is missing, or messages lie in a log beside it.
    """

    compression = ""
    warnings: Sequence[str] = ()

    def __init__(self, path: Path) -> None:
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
        with as_damage():
            # Without its log, so that nothing is written beside it.
            flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
            self._database = apsw.Connection(f"{path.absolute().as_uri()}?immutable=1", flags=flags)
            check_count(path, self._rows("SELECT count(*) FROM topics")[0][0])
            self.connections: Sequence[Connection] = self._read_connections()
            edges = "SELECT min(timestamp), max(timestamp), count(*) FROM messages"
            ((first, last, self._count),) = self._rows(edges)
        self.span = (LAST_TIME, 0) if first is None else (first, last + 1)
        self._check()

    def messages(self, ids: Collection[int], start: int, stop: int) -> Iterator[Message]:
        """Yield messages of the connections ``ids`` with start <= log time < stop, in order of log time."""
        known = {c.id: c for c in self.connections}
        query = f"SELECT topic_id, timestamp, data FROM messages {_where(ids)} ORDER BY timestamp, id"
        with as_damage():
            for number, time, data in self._database.execute(query, (*ids, start, stop)):
                # sqlite3 reads zeros where pages are missing.
                if os.fstat(self._file.fileno()).st_size < self._size:
                    raise DamageError("the file was cut while it was read")
                yield known[number], time, data

    def times(self, ids: Collection[int], start: int = 0, stop: int = LAST_TIME) -> I64:
        """Return the sorted log times of the connections ``ids`` with start <= time < stop."""
        rows = self._rows(f"SELECT timestamp FROM messages NOT INDEXED {_where(ids)}", *ids, start, stop)
        return np.sort(np.array([time for (time,) in rows], np.int64))

    def _read_connections(self) -> list[Connection]:
        """Read the topics. Older tables lack columns, and the table of definitions."""
        columns = {row[1] for row in self._rows("PRAGMA table_info(topics)")}
        newer = (
            name if name in columns else "''" for name in ("offered_qos_profiles", "type_description_hash")
        )
        topics = self._rows(f"SELECT id, name, type, serialization_format, {', '.join(newer)} FROM topics")
        counts = dict(self._rows("SELECT topic_id, count(*) FROM messages GROUP BY topic_id"))
        definitions = dict[str, MessageDefinition]()
        if self._rows("PRAGMA table_info(message_definitions)"):
            stated = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            for msgtype, encoding, text in self._rows(stated):
                if encoding in FORMATS:  # "unknown" where the recorder did not find the definition
                    definitions.setdefault(msgtype, MessageDefinition(FORMATS[encoding], text))
        profiles = parse_profiles(row[4] for row in topics)
        return [
            Connection(
                *(number, name, msgtype, definitions.get(msgtype, NO_DEFINITION), digest),
                *(counts.get(number, 0), ConnectionExtRosbag2(encoding, profiles.get(offered, [])), None),
            )
            for number, name, msgtype, encoding, offered, digest in topics
        ]

    def _check(self) -> None:
        """Compare the tables and the index with each other.

        Raises:
            DamageError: they disagree.
        """
        if self.span[1] > LAST_TIME or (self.span[0] < 0 and self._count):
            raise DamageError("there are messages of impossible times in it")
        described = sum(c.msgcount for c in self.connections)
        if described != self._count:
            raise DamageError(f"of {self._count} messages {described} are of a topic of it")
        indexed = "SELECT count(*) FROM sqlite_master WHERE type = 'index' AND name = 'timestamp_idx'"
        if self._rows(indexed) == [(1,)]:
            query = "SELECT count(*), sum((id % 65521) * (timestamp % 65521)) FROM messages "
            by_index = self._rows(query + "INDEXED BY timestamp_idx")
            if by_index != self._rows(query + "NOT INDEXED"):
                raise DamageError("its index of times disagrees with its messages")

    def _rows(self, query: str, *values: int) -> list[tuple[Any, ...]]:
        with as_damage():
            return list(self._database.execute(query, values))

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        self._database.close()


def _where(ids: Collection[int]) -> str:
    """Return the condition of the messages of connections between two log times."""
    return f"WHERE topic_id IN ({','.join('?' * len(ids))}) AND timestamp >= ? AND timestamp < ?"


def page_size_of(head: bytes) -> int | None:
    """Return the page size that the head of a file states. None: it is no sqlite3 head."""
    size = int.from_bytes(head[16:18], "big")
    size = 65536 if size == 1 else size
    return size if head[: len(MAGIC)] == MAGIC and size in PAGE_SIZES else None


def log_path(path: Path) -> Path:
    """Return the path of the write-ahead log of a database."""
    return path.with_name(path.name + "-wal")
