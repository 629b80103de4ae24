"""ROS 1 bags: rosbags' reader, able to rebuild the index of a bag that was never closed or is cut."""

from __future__ import annotations

import heapq
from bz2 import BZ2Decompressor
from collections import defaultdict
from collections.abc import Callable, Collection, Generator
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np
from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag1,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag1 import Reader
from rosbags.rosbag1.reader import (
    Chunk,
    ChunkInfo,
    Header,
    IndexData,
    ReaderError,
    RecordType,
    normalize,
    read_bytes,
    read_uint32,
)
from rosbags.typesys.msg import normalize_msgtype

from bevviz.bags.mcap import megabytes
from bevviz.errors import UserError
from bevviz.frame import I64

MAGIC = b"#ROSBAG V2.0\n"
# Unlike the one-shot functions these give what there is of a stream whose end is missing.
DECOMPRESSORS: dict[str, Callable[[bytes], bytes]] = {
    "none": bytes,
    "bz2": lambda data: BZ2Decompressor().decompress(data),
    "lz4": lambda data: cast(bytes, LZ4FrameDecompressor().decompress(data)),
}
LONGEST_HEADER = 1 << 24


class Ros1File(Reader):
    """Messages in order of log time. A bag without its index is scanned once, chunk by chunk."""

    path: Path
    format = "ROS 1 bag"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.unread = 0  # bytes of the incomplete record at the end
        self.lost_messages = 0
        self._rebuilt = False
        self._rescued = 0  # messages found in the incomplete record
        self._damaged: set[int] = set()  # chunks
        self._unpacked: dict[int, bytes] = {}

    def open(self) -> None:
        """Read the index, or make one.

        Raises:
            UserError: not a ROS 1 bag.
        """
        with suppress(Exception):  # whatever rosbags stumbles over, the scan answers for
            super().open()
            if self.chunk_infos:
                return
            super().close()
        self.bio = self.path.open("rb")
        if self.bio.read(len(MAGIC)) != MAGIC:
            raise UserError(f"{self.path}: not a ROS 1 bag of version 2.0")
        self.connections, self.chunk_infos, self.chunks = [], [], {}
        self._scan(self.bio)

    @property
    def compression(self) -> str:
        """Of the first chunk: a recorder does not change it."""
        assert self.bio is not None
        for position in self.chunks:
            self.bio.seek(position)
            name = Header.read(self.bio).get_string("compression")
            return "" if name == "none" else name
        return ""

    @property
    def warnings(self) -> list[str]:
        found = []
        if self._rebuilt:
            rest = (
                f", {self._rescued} of them from the incomplete last {megabytes(self.unread)}"
                if self.unread
                else ""
            )
            found.append(
                f"{self.path.name}: the bag's index is missing (not closed, or cut): read "
                f"{self.message_count} messages{rest}; 'rosbag reindex' repairs the file"
            )
        if self._damaged:
            found.append(
                f"{self.path.name}: {len(self._damaged)} damaged chunk(s): {self.lost_messages} messages lost"
            )
        return found

    @property
    def message_count(self) -> int:
        return sum(c.msgcount for c in self.connections)

    def messages(
        self, connections: Collection[Connection] = (), start: int | None = None, stop: int | None = None
    ) -> Generator[tuple[Connection, int, bytes], None, None]:
        """Messages of ``connections`` with start <= log time < stop, in order of log time."""
        wanted = {c.id: c for c in connections}
        for entry in heapq.merge(*(self.indexes[number] for number in wanted)):
            if start is not None and entry.time < start:
                continue
            if stop is not None and entry.time >= stop:
                return
            try:
                number, data = self._message(entry)
            except (ReaderError, OSError, RuntimeError, ValueError):
                self._damaged.add(entry.chunk_pos)
                self.lost_messages += 1
                continue
            yield wanted[number], entry.time, data

    def times(self, connections: Collection[Connection]) -> I64:
        """Log times of all messages of ``connections``, sorted, from the index alone."""
        return np.sort(np.array([e.time for c in connections for e in self.indexes[c.id]], np.int64))

    def _message(self, entry: IndexData) -> tuple[int, bytes]:
        records = BytesIO(self._chunk_data(entry.chunk_pos))
        records.seek(entry.offset)
        while (header := Header.read(records)).get_uint8("op") == RecordType.CONNECTION:
            records.seek(read_uint32(records), 1)
        if header.get_time("time") != entry.time:
            raise ReaderError("the index leads to another message")
        return header.get_uint32("conn"), read_bytes(records, read_uint32(records))

    def _chunk_data(self, position: int) -> bytes:
        """Content of a chunk. Two are kept, for time order goes to and fro between neighbours."""
        if position not in self._unpacked:
            assert self.bio is not None
            if position in self._damaged:
                raise ReaderError("damaged chunk")
            chunk = self.chunks[position]
            self.bio.seek(chunk.datapos)
            if len(self._unpacked) > 1:
                del self._unpacked[next(iter(self._unpacked))]
            self._unpacked[position] = chunk.decompressor(self.bio.read(chunk.datasize))
        return self._unpacked[position]

    def _scan(self, bio: BinaryIO) -> None:
        """Rebuild the index: chunks are unpacked only where their own index records do not suffice."""
        self._rebuilt = True
        size = self.path.stat().st_size
        indexes: dict[int, list[IndexData]] = defaultdict(list)
        chunk: dict[int, list[IndexData]] = {}  # entries of the newest chunk by connection
        position = -1  # of that chunk, -1 once it is complete

        def complete() -> None:
            entries = chunk
            if not chunk or not chunk.keys() <= {c.id for c in self.connections}:
                entries = self._look_into(position)
            times = [e.time for found in entries.values() for e in found]
            counts = {number: len(found) for number, found in entries.items()}
            if times:
                self.chunk_infos.append(ChunkInfo(position, min(times), max(times) + 1, counts))
            for number, found in entries.items():
                indexes[number] += found

        offset = len(MAGIC)
        while offset < size:
            bio.seek(offset)
            try:
                if read_uint32(bio) > LONGEST_HEADER:
                    raise ReaderError("not a record")
                bio.seek(offset)
                header = Header.read(bio)
                opcode, length = header.get_uint8("op"), read_uint32(bio)
                body = bio.tell()
            except (ReaderError, UnicodeDecodeError):
                self.unread = size - offset
                break
            if opcode != RecordType.IDXDATA and position >= 0:
                complete()
                position = -1
            if opcode == RecordType.CHUNK:
                decompressor = DECOMPRESSORS.get(header.get_string("compression"), bytes)
                self.chunks[offset] = Chunk(min(length, size - body), body, decompressor)
                chunk, position = {}, offset
            if body + length > size:
                self.unread = size - offset
                break
            bio.seek(body)
            if opcode == RecordType.IDXDATA:
                found = np.frombuffer(bio.read(length), "<u4").reshape(-1, 3).tolist()
                chunk[header.get_uint32("conn")] = [
                    IndexData(sec * 10**9 + nsec, position, at) for sec, nsec, at in found
                ]
            elif opcode == RecordType.CONNECTION:
                self._note(header, Header.read(BytesIO(length.to_bytes(4, "little") + bio.read(length))))
            offset = body + length
        if position >= 0:
            before = sum(map(len, indexes.values()))
            complete()
            if self.unread:
                self._rescued = sum(map(len, indexes.values())) - before
        self.connections = [c._replace(msgcount=len(indexes[c.id])) for c in self.connections]
        self.indexes = {c.id: sorted(indexes[c.id]) for c in self.connections}

    def _look_into(self, position: int) -> dict[int, list[IndexData]]:
        """The index of a chunk from its content; connections are noted."""
        found: dict[int, list[IndexData]] = defaultdict(list)
        with suppress(ReaderError, OSError, RuntimeError, ValueError):  # ends where the data does
            records = BytesIO(self._chunk_data(position))
            while True:
                offset = records.tell()
                header = Header.read(records)
                data = read_bytes(records, read_uint32(records))
                if header.get_uint8("op") == RecordType.CONNECTION:
                    self._note(header, Header.read(BytesIO(len(data).to_bytes(4, "little") + data)))
                else:
                    found[header.get_uint32("conn")].append(
                        IndexData(header.get_time("time"), position, offset)
                    )
        return found

    def _note(self, header: Header, about: Header) -> None:
        number = header.get_uint32("conn")
        if all(c.id != number for c in self.connections):
            self.connections.append(
                Connection(
                    number,
                    normalize(header.get_string("topic")),
                    normalize_msgtype(about.get_string("type")),
                    MessageDefinition(MessageDefinitionFormat.MSG, about.get_string("message_definition")),
                    about.get_string("md5sum"),
                    0,
                    ConnectionExtRosbag1(None, None),
                    self,
                )
            )
