"""Records of a damaged MCAP file."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

from bevviz.bags.chunks import Chunk
from bevviz.bags.mcap import (
    CHANNEL,
    CHUNK,
    CHUNK_HEAD,
    CHUNK_INDEX,
    COMPRESSIONS,
    DATA_END,
    FIRST_PRIVATE,
    FOOTER,
    HEADER,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    RECORD,
    SCHEMA,
    STATISTICS,
    Channels,
    chunk_at,
    read_strings,
)
from bevviz.bags.reader import LAST_TIME
from bevviz.extras.rescue.chunks import RecordWalker

RECORD_START = re.compile(  # an opcode with a length below 2^40, or the start of a compressed chunk's content
    rb"(?=[\x01-\x0f].{5}\0\0\0|\x04\0\0\0zstd.{8}\x28\xb5\x2f\xfd|\x03\0\0\0lz4.{8}\x04\x22\x4d\x18)",
    re.DOTALL,
)
HOUR, DAY = 3600 * 10**9, 24 * 3600 * 10**9
_SUMMARY = {CHUNK_INDEX, STATISTICS, 0x0A, 0x0C, 0x0D, 0x0E}


KINDS = {
    SCHEMA: "connection",
    CHANNEL: "connection",
    MESSAGE: "message",
    CHUNK: "chunk",
    MESSAGE_INDEX: "index",
    STATISTICS: "statistics",
}


@dataclass(slots=True)
class Record:
    """A record of an MCAP file.

    Attributes:
        opcode: kind of the record.
        start: offset of the record.
        body: offset of the content.
        end: offset of the end. It lies beyond the end of the file if the record is cut.
    """

    opcode: int
    start: int
    body: int
    end: int

    @property
    def kind(self) -> str:
        """Kind as ``RecordWalker`` names it."""
        return KINDS.get(self.opcode, "")


class McapWalker(RecordWalker[Record]):
    """Walker over the records of an MCAP file."""

    descriptions = Channels
    first = len(MAGIC)

    def note(self, record: Record) -> None:
        """Add a schema or a channel."""
        self._known.note(record.opcode, self._source.read(record.body, record.end - record.body))

    def message(self, record: Record) -> tuple[int, int, int, int]:
        """Return log time and channel of a message, and the offset and size of its data."""
        channel, _, time, _ = MESSAGE_HEAD.unpack(self._source.read(record.body, MESSAGE_HEAD.size))
        first, last = self._span or (time, time)
        self._span = min(first, time), max(last, time)
        return time, channel, record.body + MESSAGE_HEAD.size, record.end - record.body - MESSAGE_HEAD.size

    def chunk(self, record: Record) -> Chunk:
        """Return the chunk of a record, without messages."""
        chunk = chunk_at(self._source, record.body, record.end)
        assert chunk is not None  # ``_chunk`` has checked its head.
        return chunk

    def listed(self, record: Record) -> tuple[int, int]:
        """Return the channel of a message index, and its number of messages."""
        channel, size = struct.unpack("<HI", self._source.read(record.body, 6))
        return channel, size // 16

    def stated(self, record: Record) -> int | None:
        """Return the number of messages by the statistics."""
        data = self._source.read(record.body, 8)
        return int.from_bytes(data, "little") if record.end - record.body >= 8 else None

    def _is_last(self, record: Record) -> bool:
        return record.opcode == FOOTER

    def _is_doubtful(self, record: Record) -> bool:
        return record.opcode == MESSAGE and not self._begins_message(record.end)

    def _begins_message(self, offset: int) -> bool:
        """Tell whether a message with a possibly wrong length begins here. The end of the file counts."""
        head = self._source.read(offset, RECORD.size + MESSAGE_HEAD.size)
        if len(head) < RECORD.size + MESSAGE_HEAD.size:
            return True
        return head[0] == MESSAGE and self._fits(offset + RECORD.size)

    def _skip(self, offset: int) -> Record | None:
        """Return the record after a broken one if the broken one's length still leads to it."""
        head = self._source.read(offset, RECORD.size)
        if len(head) < RECORD.size:
            return None
        end = offset + RECORD.size + RECORD.unpack(head)[1]
        return self._at(end, searched=True) if end < self._source.size else None

    def _search(self, start: int, stop: int, chunk: bool = False) -> Record | None:
        """Return the next sound record, or only the next chunk."""
        for offset in self._source.search(RECORD_START, start):
            if offset >= stop:
                return None
            head = self._source.read(offset, RECORD.size)
            if head[:4] in (b"\x04\0\0\0", b"\x03\0\0\0"):
                offset -= RECORD.size + CHUNK_HEAD.size - 4
                record = self._chunk(offset) if offset >= start else None
            else:
                record = self._at(offset, searched=True)
            if record is not None and (record.opcode == CHUNK or not chunk):
                return record
        return None

    def _at(self, offset: int, searched: bool = False) -> Record | None:
        """Return the record at an offset, None if it makes no sense.

        Args:
            offset: offset of the record.
            searched: no other record leads to this offset, so the checks are stricter.
        """
        head = self._source.read(offset, RECORD.size)
        if len(head) < RECORD.size:
            return None
        opcode, length = RECORD.unpack(head)
        body, size = offset + RECORD.size, self._source.size
        record = Record(opcode, offset, body, body + length)
        if opcode == CHUNK or (length > CHUNK_HEAD.size + 8 and self._is_chunk(offset)):
            return self._chunk(offset)
        if record.end > size:
            cut = not searched and 0 < opcode <= DATA_END and length < 1 << 40 and self._is_sane(record)
            return record if cut else None
        if not self._is_sane(record) and not (opcode >= FIRST_PRIVATE and not searched):
            return None
        if searched and record.end + RECORD.size <= size and opcode != FOOTER:
            after, following = RECORD.unpack(self._source.read(record.end, RECORD.size))
            if not (0 < after <= DATA_END or after >= FIRST_PRIVATE) or following >= 1 << 40:
                return None
            if opcode == MESSAGE and not self._fits(body):
                return None
        return record

    def _fits(self, body: int) -> bool:
        """Tell whether a message has a known channel and a time close to that of the others."""
        head = self._source.read(body, MESSAGE_HEAD.size)
        channel, _, time, published = MESSAGE_HEAD.unpack(head)
        if self._known and channel not in self._known:
            return False
        if self._span is None:
            return not published or abs(time - published) < DAY
        first, last = self._span
        return bool(first - HOUR <= time <= last + HOUR)

    def _is_sane(self, record: Record) -> bool:
        """Tell whether the lengths within a record fit its own length, as far as its bytes exist."""
        opcode, body, end = record.opcode, record.body, record.end
        length = end - body
        if opcode == MESSAGE:
            head = self._source.read(body, MESSAGE_HEAD.size)
            return (
                length >= MESSAGE_HEAD.size
                and len(head) == MESSAGE_HEAD.size
                and MESSAGE_HEAD.unpack(head)[2] < LAST_TIME
            )
        if opcode in (SCHEMA, CHANNEL, HEADER, MESSAGE_INDEX):
            if length > 1 << 26:
                return False
            data = self._source.read(body, length)
            offset, count = {SCHEMA: (2, 3), CHANNEL: (4, 3), HEADER: (0, 2), MESSAGE_INDEX: (2, 1)}[opcode]
            try:
                return offset + sum(4 + len(text) for text in read_strings(data, offset, count)) == len(data)
            except struct.error:
                return False
        if opcode in (FOOTER, DATA_END):
            return length == (20 if opcode == FOOTER else 4)
        return opcode in _SUMMARY or opcode == 9  # 9: an attachment

    def _is_chunk(self, offset: int) -> bool:
        """Tell whether a record with another opcode is a chunk, by the two lengths that agree in a chunk."""
        head = self._source.read(offset, RECORD.size + CHUNK_HEAD.size + 12)
        name_size = int.from_bytes(head[RECORD.size + 28 : RECORD.size + 32], "little")
        if name_size > 4 or len(head) < RECORD.size + CHUNK_HEAD.size + 12:
            return False
        at = RECORD.size + CHUNK_HEAD.size
        length = int.from_bytes(head[1:9], "little")
        packed = int.from_bytes(head[at + name_size : at + name_size + 8], "little")
        return (
            head[at : at + name_size] in COMPRESSIONS and length == CHUNK_HEAD.size + name_size + 8 + packed
        )

    def _chunk(self, offset: int) -> Record | None:
        """Return the chunk at an offset. A chunk states its length twice, so one of them may be damaged."""
        body = offset + RECORD.size
        head = self._source.read(offset, RECORD.size + CHUNK_HEAD.size + 12)
        if len(head) < RECORD.size + CHUNK_HEAD.size:
            return None
        name_size = int.from_bytes(head[RECORD.size + 28 : RECORD.size + 32], "little")
        at = RECORD.size + CHUNK_HEAD.size
        if name_size > 4 or head[at : at + name_size] not in COMPRESSIONS or len(head) < at + name_size + 8:
            return None
        size = self._source.size
        ends = [
            body + int.from_bytes(head[1:9], "little"),
            offset + at + name_size + 8 + int.from_bytes(head[at + name_size : at + name_size + 8], "little"),
        ]
        if ends[0] == ends[1]:
            return Record(CHUNK, offset, body, ends[0])
        for end in ends:
            if body + CHUNK_HEAD.size + 12 <= end < size and self._at(end, searched=True) is not None:
                return Record(CHUNK, offset, body, end)
        return None
