"""MCAP files: rosbags' reader, able to rebuild the index of a file whose end is missing."""

from __future__ import annotations

import heapq
import struct
from binascii import crc32
from collections import defaultdict
from collections.abc import Collection, Generator, Iterator
from contextlib import suppress
from operator import itemgetter
from pathlib import Path
from typing import IO

import numpy as np
from backports import zstd
from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag2.metadata import ReaderMetadata
from rosbags.rosbag2.storage_mcap import ChunkInfo, McapReader

from bevviz.errors import UserError
from bevviz.frame import I64

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, DATA_END, FOOTER = 3, 4, 5, 6, 7, 0x0F, 2
FORMATS = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros1msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
    "omgidl": MessageDefinitionFormat.IDL,
}
RECORD = struct.Struct("<BQ")
CHUNK_HEAD = struct.Struct("<QQQII")  # first and last log time, size, CRC, length of the compression's name
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time

Message = tuple[Connection, int, bytes | memoryview]


class McapFile(McapReader):
    """Messages in order of log time. A file without its index is scanned once, record by record.

    Differs from rosbags' reader where a file is not as it should be: the end may be missing, even in the
    middle of a compressed chunk; a damaged chunk costs its own messages only; messages outside chunks
    may be out of order; channels that are not ROS do not matter.
    """

    path: Path
    format = "MCAP"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.unread = 0  # bytes of the incomplete record at the end
        self._size = 0
        self._rescued = 0  # messages found in them
        self.damaged_chunks = 0
        self.damaged_messages = 0
        self._flat: I64 = np.zeros((0, 4), np.int64)  # messages outside chunks: time, channel, offset, size
        self._definitions: dict[int, tuple[str, MessageDefinition]] = {}

    def open(self) -> None:
        """Read the index, or make one.

        Raises:
            UserError: there is no MCAP record in the file.
        """
        self._size = self.path.stat().st_size
        with suppress(Exception):  # whatever rosbags stumbles over, the scan answers for
            super().open()
            if self.chunks and (
                self.metadata.message_count == 0 or any(c.channel_count for c in self.chunks)
            ):
                return
            super().close()
        self.bio = self.path.open("rb")
        if self.bio.read(len(MAGIC)) != MAGIC:
            raise UserError(f"{self.path}: not an MCAP file")
        self._scan(self.bio)

    @property
    def compression(self) -> str:
        return ", ".join(sorted({c.compression for c in self.chunks} - {""}))

    @property
    def warnings(self) -> list[str]:
        found = []
        if self.unread:
            found.append(
                f"{self.path.name}: the file ends in the middle of a record (no footer): read "
                f"{self.metadata.message_count} messages, {self._rescued} of them from the incomplete last "
                f"{megabytes(self.unread)}; 'mcap recover' writes a sound copy"
            )
        if self.damaged_chunks:
            found.append(
                f"{self.path.name}: {self.damaged_chunks} damaged chunk(s) in the file: "
                f"{self.damaged_messages} messages lost"
            )
        return found

    def messages(  # type: ignore[override]  # views of the chunk instead of copies
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Generator[Message, None, None]:
        """Messages of ``connections`` with start <= log time < stop, in order of log time."""
        wanted = {c.id: c for c in connections}
        low = 0 if start is None else start
        high = 2**63 - 1 if stop is None else stop
        sources: list[Iterator[tuple[int, Connection | None, bytes | memoryview]]] = [
            self._chunk_messages(c, wanted, low, high)
            for c in self.chunks
            if c.message_start_time < high
            and c.message_end_time >= low
            and c.channel_count.keys() & wanted.keys()
        ]
        if len(self._flat):
            sources.append(self._flat_messages(wanted, low, high))
        for time, connection, data in heapq.merge(*sources, key=itemgetter(0)):
            if connection is not None:
                yield connection, time, data

    def times(self, connections: Collection[Connection]) -> I64:
        """Log times of all messages of ``connections``, sorted, from the index alone."""
        wanted = {c.id for c in connections}
        parts = [self._flat[np.isin(self._flat[:, 1], list(wanted)), 0]]
        for chunk in self.chunks:
            for channel in wanted & chunk.channel_count.keys():
                offset = chunk.message_index_offsets.get(channel)
                if offset is None:
                    parts.append(np.array([t for c, t, _ in self._records(chunk) if c == channel], np.int64))
                else:
                    entries = np.frombuffer(self._read(offset + 15, 16 * chunk.channel_count[channel]), "<i8")
                    parts.append(entries[::2])
        return np.sort(np.concatenate(parts))

    def _read(self, offset: int, size: int) -> bytes:
        assert self.bio is not None
        self.bio.seek(offset)
        return self.bio.read(size)

    def _chunk_messages(
        self, chunk: ChunkInfo, wanted: dict[int, Connection], low: int, high: int
    ) -> Iterator[tuple[int, Connection | None, bytes | memoryview]]:
        # The merge draws the first item of every source at once: this one costs no reading.
        yield chunk.message_start_time, None, b""
        found = [(t, wanted[c], d) for c, t, d in self._records(chunk) if c in wanted and low <= t < high]
        found.sort(key=itemgetter(0))
        yield from found

    def _flat_messages(
        self, wanted: dict[int, Connection], low: int, high: int
    ) -> Iterator[tuple[int, Connection | None, bytes | memoryview]]:
        time, channel = self._flat[:, 0], self._flat[:, 1]
        chosen = self._flat[np.isin(channel, list(wanted)) & (time >= low) & (time < high)]
        for t, c, offset, size in chosen[np.argsort(chosen[:, 0], kind="stable")].tolist():
            yield t, wanted[c], self._read(offset, size)

    def _records(self, chunk: ChunkInfo) -> Iterator[tuple[int, int, memoryview]]:
        """Channel, log time and payload of each message of a chunk; schemas and channels are noted."""
        try:
            data = self._chunk_data(chunk)
        except (ValueError, RuntimeError, zstd.ZstdError):
            self.damaged_chunks += 1
            self.damaged_messages += sum(chunk.channel_count.values())
            return
        offset = 0
        while offset + RECORD.size <= len(data):
            opcode, size = RECORD.unpack_from(data, offset)
            offset += RECORD.size
            if offset + size > len(data):
                return
            record = data[offset : offset + size]
            offset += size
            if opcode == MESSAGE:
                channel, _, time, _ = MESSAGE_HEAD.unpack_from(record)
                yield channel, time, record[MESSAGE_HEAD.size :]
            else:
                self._note(opcode, record)

    def _chunk_data(self, chunk: ChunkInfo) -> memoryview:
        head = self._read(chunk.chunk_start_offset + RECORD.size, CHUNK_HEAD.size)
        _, _, size, crc, name = CHUNK_HEAD.unpack(head)
        packed = self._read(
            chunk.chunk_start_offset + RECORD.size + CHUNK_HEAD.size + name + 8, chunk.compressed_size
        )
        if chunk.compression == "zstd":
            data = zstd.ZstdDecompressor().decompress(packed)
        elif chunk.compression == "lz4":
            data = LZ4FrameDecompressor().decompress(packed)
        elif chunk.compression == "":
            data = packed
        else:
            raise UserError(f"{self.path}: chunk compression '{chunk.compression}' is not known")
        cut = chunk.chunk_start_offset + chunk.chunk_length > self._size
        if not cut and (len(data) != size or (crc and crc32(data) != crc)):
            raise ValueError("the chunk's content does not fit its checksum")
        return memoryview(data)

    def _note(self, opcode: int, record: memoryview) -> None:
        if opcode == SCHEMA:
            (number,) = struct.unpack_from("<H", record)
            msgtype, encoding, text = _strings(record, 2, 3)
            kind = FORMATS.get(encoding.decode(), MessageDefinitionFormat.NONE)
            definition = MessageDefinition(kind, text.decode() if kind.value else "")
            self._definitions[number] = msgtype.decode(), definition
        elif opcode == CHANNEL:
            number, schema = struct.unpack_from("<HH", record)
            topic, encoding = _strings(record, 4, 2)
            name, definition = self._definitions.get(
                schema, ("", MessageDefinition(MessageDefinitionFormat.NONE, ""))
            )
            if all(c.id != number for c in self.connections):
                ext = ConnectionExtRosbag2(encoding.decode(), [])
                self.connections.append(
                    Connection(number, topic.decode(), name, definition, "", 0, ext, self)
                )

    def _scan(self, bio: IO[bytes]) -> None:
        """Rebuild the index: chunks are jumped over unless they hold a channel not yet known."""
        size = self._size
        offset = len(MAGIC)
        flat: list[tuple[int, int, int, int]] = []
        indexed = True  # the newest chunk has been asked for its channels
        while True:
            bio.seek(offset)
            head = bio.read(RECORD.size)
            opcode, length = RECORD.unpack(head) if len(head) == RECORD.size else (0, 0)
            if opcode != MESSAGE_INDEX and not indexed:
                self._complete_chunk()
                indexed = True
            body = offset + RECORD.size
            if opcode in (DATA_END, FOOTER):
                break
            if opcode == 0 or body + length > size:
                self.unread = size - offset
                if opcode == CHUNK and self._note_chunk(offset, length, size):
                    self._complete_chunk()
                    self._rescued = sum(self.chunks[-1].channel_count.values())
                break
            if opcode in (SCHEMA, CHANNEL):
                self._note(opcode, memoryview(bio.read(length)))
            elif opcode == MESSAGE:
                channel, _, time, _ = MESSAGE_HEAD.unpack(bio.read(MESSAGE_HEAD.size))
                flat.append((time, channel, body + MESSAGE_HEAD.size, length - MESSAGE_HEAD.size))
            elif opcode == CHUNK:
                indexed = not self._note_chunk(offset, length, size)
            elif opcode == MESSAGE_INDEX and self.chunks:
                channel, entries = struct.unpack("<HI", bio.read(6))
                if entries:
                    self.chunks[-1].message_index_offsets[channel] = offset
                    self.chunks[-1].channel_count[channel] = entries // 16
            offset = body + length
        self._flat = np.array(flat, np.int64).reshape(-1, 4)
        self._summarise()

    def _note_chunk(self, offset: int, length: int, file_size: int) -> bool:
        head = self._read(offset + RECORD.size, CHUNK_HEAD.size + 64)
        if len(head) < CHUNK_HEAD.size:
            return False
        first, last, size, _, name = CHUNK_HEAD.unpack_from(head)
        data = offset + RECORD.size + CHUNK_HEAD.size + name + 8
        compression = head[CHUNK_HEAD.size : CHUNK_HEAD.size + name].decode(errors="replace")
        packed = min(offset + RECORD.size + length, file_size) - data
        if packed <= 0:
            return False
        self.chunks.append(
            ChunkInfo(first, last, offset, RECORD.size + length, {}, 0, compression, packed, size, {})
        )
        return True

    def _complete_chunk(self) -> None:
        """Look into the newest chunk where its message index is missing or names an unknown channel."""
        counts = self.chunks[-1].channel_count
        if counts and counts.keys() <= {c.id for c in self.connections}:
            return
        found: dict[int, int] = defaultdict(int)
        for channel, _, _ in self._records(self.chunks[-1]):
            found[channel] += 1
        if not counts:
            counts.update(found)

    def _summarise(self) -> None:
        counts: dict[int, int] = defaultdict(int)
        for chunk in self.chunks:
            for channel, count in chunk.channel_count.items():
                counts[channel] += count
        for channel, count in zip(*np.unique(self._flat[:, 1], return_counts=True), strict=True):
            counts[int(channel)] += int(count)
        self.connections = [c._replace(msgcount=counts[c.id]) for c in self.connections]
        filled = [c for c in self.chunks if c.channel_count]
        first = [c.message_start_time for c in filled] + self._flat[:1, 0].tolist()
        last = [c.message_end_time for c in filled]
        if len(self._flat):
            first.append(int(self._flat[:, 0].min()))
            last.append(int(self._flat[:, 0].max()))
        start, end = min(first, default=2**63 - 1), max(last, default=-1) + 1
        self.metadata = ReaderMetadata(
            max(0, end - start), start, end, sum(counts.values()), None, None, None, None
        )


def _strings(record: memoryview, offset: int, count: int) -> list[bytes]:
    """``count`` strings, each behind its length."""
    found = []
    for _ in range(count):
        (size,) = struct.unpack_from("<I", record, offset)
        found.append(bytes(record[offset + 4 : offset + 4 + size]))
        offset += 4 + size
    return found


def megabytes(size: int) -> str:
    """A file size for people: ``3.1 MB``."""
    return f"{size / 1e6:.1f} MB" if size >= 100_000 else f"{size / 1e3:.1f} kB"
