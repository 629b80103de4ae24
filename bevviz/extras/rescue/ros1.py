"""Records of a damaged ROS 1 bag."""

from __future__ import annotations

import re

from bevviz.bags.chunks import Chunk
from bevviz.bags.ros1 import MAGIC, Connections, Record, chunk_of, is_sane, read_record
from bevviz.extras.rescue.chunks import RecordWalker
from bevviz.support.limits import LONGEST_HEADER

OPCODE = re.compile(rb"(?=\x04\0\0\0op=)")  # Every header contains an opcode.
SEARCH_BACK = 160  # bytes of a header before its opcode that are searched


class Ros1Walker(RecordWalker[Record]):
    """Walker over the records of a ROS 1 bag."""

    descriptions = Connections
    first = len(MAGIC)

    def note(self, record: Record) -> None:
        """Add a connection."""
        self._known.note(record, self._source.read(record.body, record.end - record.body))

    def message(self, record: Record) -> tuple[int, int, int, int]:
        """Return log time and connection of a message, and the offset and size of its data."""
        return record.time("time"), record.number("conn"), record.body, record.end - record.body

    def chunk(self, record: Record) -> Chunk:
        """Return the chunk of a record, without messages."""
        return chunk_of(record, self._source.size)

    def listed(self, record: Record) -> tuple[int, int]:
        """Return the connection of an index record, and its number of messages."""
        return record.number("conn"), record.number("count")

    def _at(self, offset: int) -> Record | None:
        record = read_record(self._source, offset)
        return record if record is not None and is_sane(record, self._source.size) else None

    def _search(self, start: int, stop: int, chunk: bool = False) -> Record | None:
        """Return the next sound record, or the next chunk. It must precede another record or the end."""
        for at in self._source.search(OPCODE, start):
            if at >= stop:
                return None
            before = self._source.read(max(start, at - SEARCH_BACK), SEARCH_BACK)[
                : at - max(start, at - SEARCH_BACK)
            ]
            for back in range(4, len(before) + 1):
                size = int.from_bytes(before[len(before) - back :][:4], "little")
                if not back + 3 < size <= LONGEST_HEADER:
                    continue
                record = self._at(at - back)
                if record is None or (chunk and record.kind != "chunk"):
                    continue
                if record.end >= self._source.size or self._at(record.end) is not None:
                    return record
        return None
