"""Scan of a damaged MCAP file record by record. After a broken record it searches for the next sound one."""

from __future__ import annotations

import re
import struct
from array import array
from collections import defaultdict
from collections.abc import Callable, Container, Iterator
from typing import NamedTuple

from rosbags.rosbag2 import Reader

from bevviz.bags.chunks import Chunk, ChunkFormat, ChunkMessage, ScanResult
from bevviz.bags.mcap import (
    CHANNEL,
    CHUNK,
    CHUNK_HEAD,
    CHUNK_INDEX,
    DATA_END,
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
    read_index,
    read_strings,
    read_times,
    unpack_chunk,
)
from bevviz.bags.reader import LAST_TIME, FileBytes, MemoryBytes

RECORD_START = re.compile(  # an opcode with a length below 2^40, or the start of a compressed chunk's content
    rb"(?=[\x01-\x0f].{5}\0\0\0|\x04\0\0\0zstd.{8}\x28\xb5\x2f\xfd|\x03\0\0\0lz4.{8}\x04\x22\x4d\x18)",
    re.DOTALL,
)
COMPRESSIONS = (b"", b"lz4", b"zstd")
HOUR, DAY = 3600 * 10**9, 24 * 3600 * 10**9
FIRST_PRIVATE = 0x80  # Opcodes from here on are private to applications.
_SUMMARY = {CHUNK_INDEX, STATISTICS, 0x0A, 0x0C, 0x0D, 0x0E}


class Record(NamedTuple):
    """A record of an MCAP file.

    Attributes:
        opcode: kind of the record.
        body: offset of the content.
        end: offset of the end. It lies beyond the end of the file if the record is cut.
    """

    opcode: int
    body: int
    end: int

    @property
    def start(self) -> int:
        """Offset of the record."""
        return self.body - RECORD.size


class RecordWalker:
    """Iterator over the records of a file or of the content of a chunk.

    Args:
        source: bytes to walk.
        channels: known channels. The caller adds channels during the walk.
        span: first and last plausible log time of a message found by searching; None: not known yet.
    """

    def __init__(
        self, source: FileBytes, channels: Container[int], span: tuple[int, int] | None = None
    ) -> None:
        self._source, self._channels, self._span = source, channels, span
        self.broken = self.passed = 0  # places without a sound record, and their bytes

    def __call__(self, offset: int) -> Iterator[Record]:
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
                self._extend_span(sound)
                yield sound
                if sound.opcode == FOOTER:
                    return
                offset = sound.end
            elif following is not None:
                self._count_broken(following.start - offset)
                offset = following.start
            record = following

    def _resolve(self, record: Record) -> tuple[Record | None, Record | None]:
        """Return a record with its corrected end (None: broken), and the next record (None: unknown)."""
        size, is_chunk = self._source.size, record.opcode == CHUNK
        if record.end == size or record.opcode == FOOTER:
            return record, None
        following = self._at(record.end) if record.end < size else None
        if following is not None or self._skip(record.end) is not None:
            return record, following
        # The length is wrong and the next record lies within or slightly behind; or the next one is broken.
        nearer = self._search(record.body, min(record.end, size), is_chunk)
        if is_chunk:
            return (record._replace(end=nearer.start) if nearer else record), nearer
        if nearer is None and record.end < size:
            doubtful = record.opcode == MESSAGE and not self._begins_message(record.end)
            return (None if doubtful else record), None
        return None, nearer

    def _begins_message(self, offset: int) -> bool:
        """Tell whether a message with a possibly wrong length begins here. The end of the file counts."""
        head = self._source.read(offset, RECORD.size + MESSAGE_HEAD.size)
        if len(head) < RECORD.size + MESSAGE_HEAD.size:
            return True
        return head[0] == MESSAGE and self._fits(offset + RECORD.size)

    def _count_broken(self, size: int) -> None:
        self.broken += 1
        self.passed += size

    def _extend_span(self, record: Record) -> None:
        if record.opcode == MESSAGE:
            _, _, time, _ = MESSAGE_HEAD.unpack(self._source.read(record.body, MESSAGE_HEAD.size))
            first, last = self._span or (time, time)
            self._span = min(first, time), max(last, time)

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
        record = Record(opcode, body, body + length)
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
        if self._channels and channel not in self._channels:
            return False
        if self._span is None:
            return not published or abs(time - published) < DAY
        first, last = self._span
        return bool(first - HOUR <= time <= last + HOUR)

    def _is_sane(self, record: Record) -> bool:
        """Tell whether the lengths within a record fit its own length, as far as its bytes exist."""
        opcode, body, end = record
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
            return Record(CHUNK, body, ends[0])
        for end in ends:
            if body + at < end < size and self._at(end, searched=True) is not None:
                return Record(CHUNK, body, end)
        return None


def scan(file: FileBytes, result: ScanResult, report: Callable[[int], object]) -> None:
    """Scan a file from front to back, with the content of every chunk."""
    channels = Channels()
    walker = RecordWalker(file, channels)
    outside = array("q")
    for opcode, body, end in walker(len(MAGIC) if file.read(0, len(MAGIC)) == MAGIC else 0):
        report(end)
        if opcode in (SCHEMA, CHANNEL):
            channels.note(opcode, file.read(body, end - body))
        elif opcode == MESSAGE:
            channel, _, time, _ = MESSAGE_HEAD.unpack(file.read(body, MESSAGE_HEAD.size))
            outside.extend((time, channel, body + MESSAGE_HEAD.size, end - body - MESSAGE_HEAD.size))
        elif opcode == CHUNK:
            chunk = _read_head(file, body, end)
            result.begin(chunk)
            _describe(file, chunk, channels, result)
            if chunk.cut:
                result.cut, result.rescued = file.size - body, sum(chunk.counts.values())
        elif opcode == MESSAGE_INDEX:
            channel, size = struct.unpack("<HI", file.read(body, 6))
            result.listed[channel] += size // 16
        elif opcode == STATISTICS and end - body >= 8:
            result.stated = int.from_bytes(file.read(body, 8), "little")
    result.end()
    result.broken += walker.broken
    result.passed += walker.passed
    result.index.connections = channels.connections(result.finish(channels, outside))


def _read_head(file: FileBytes, body: int, end: int) -> Chunk:
    first, last, size, crc, name_size = CHUNK_HEAD.unpack(file.read(body, CHUNK_HEAD.size))
    name = file.read(body + CHUNK_HEAD.size, name_size).decode()
    data = body + CHUNK_HEAD.size + name_size + 8
    cut = end > file.size
    return Chunk(first, last, data, min(end, file.size) - data, size, name, {}, crc, times={}, cut=cut)


def _describe(file: FileBytes, chunk: Chunk, channels: Channels, result: ScanResult) -> None:
    """Fill in the messages and channels of a chunk."""
    times: dict[int, array[int]] = defaultdict(lambda: array("q"))
    data, chunk.damage, _ = unpack_chunk(file, chunk)
    content = MemoryBytes(data)
    walker = RecordWalker(content, channels, _span(chunk))
    for opcode, body, end in walker(0):
        if opcode == MESSAGE:
            channel, _, time, _ = MESSAGE_HEAD.unpack(content.read(body, MESSAGE_HEAD.size))
            times[channel].append(time)
        elif opcode in (SCHEMA, CHANNEL):
            channels.note(opcode, content.read(body, end - body))
    if not (chunk.cut or chunk.damage):
        result.broken += walker.broken
        result.passed += walker.passed
    chunk.fill(times)


def read_messages(file: FileBytes, chunk: Chunk) -> tuple[list[ChunkMessage], str]:
    """Return the messages of a chunk on the channels of its index, and the damage of its content."""
    content, damage, checked = unpack_chunk(file, chunk)
    data = memoryview(content)
    messages, whole = _messages(data, chunk.counts)
    if not checked and not (whole and len(messages) == sum(chunk.counts.values())):
        walk = RecordWalker(MemoryBytes(content), chunk.counts, _span(chunk))(0)
        records = [data[r.start : r.end] for r in walk if r.opcode == MESSAGE]
        messages = [message for record in records for message in _messages(record, chunk.counts)[0]]
    return messages, damage


def _messages(data: memoryview, channels: Container[int]) -> tuple[list[ChunkMessage], bool]:
    """Return the messages of a chunk by the record lengths, and whether the lengths lead to its end."""
    messages, offset, size = [], 0, len(data)
    while offset + RECORD.size <= size:
        opcode, length = RECORD.unpack_from(data, offset)
        body = offset + RECORD.size
        offset = body + length
        if opcode == MESSAGE and offset <= size and length >= MESSAGE_HEAD.size:
            channel, _, time, _ = MESSAGE_HEAD.unpack_from(data, body)
            if channel in channels and time < LAST_TIME:
                messages.append((time, channel, data[body + MESSAGE_HEAD.size : offset]))
    return messages, offset == size


def _span(chunk: Chunk) -> tuple[int, int] | None:
    return (chunk.start, chunk.end) if 0 < chunk.start <= chunk.end < LAST_TIME else None


REPAIR = "'mcap recover' writes a sound copy"
FORM = ChunkFormat(Reader, True, read_index, read_times, read_messages, scan, REPAIR)
