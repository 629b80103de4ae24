"""Records of a ROS 1 bag (http://wiki.ros.org/Bags/Format/2.0), and the index of a sound bag."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Container, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rosbags.interfaces import Connection, ConnectionExtRosbag1, MessageDefinition, MessageDefinitionFormat

from bevviz.bags.chunks import Chunk, ChunkFormat, ChunkMessage, FileIndex
from bevviz.bags.reader import (
    LAST_TIME,
    DamageError,
    FileBytes,
    UnindexedError,
    megabytes,
    normalized,
)
from bevviz.bags.remote import open_bytes
from bevviz.model.frame import I64
from bevviz.support.limits import LONGEST_HEADER, MAX_INDEX

MAGIC = b"#ROSBAG V2.0\n"
LENGTH = struct.Struct("<I")

# The fields of a record determine its kind. A damaged opcode leaves no trace; damaged fields do.
RECORD_FIELDS: Mapping[str, Mapping[str, int | None]] = {  # field sizes in bytes; None: any
    "chunk": {"compression": None, "size": 4},
    "message": {"conn": 4, "time": 8},
    "connection": {"conn": 4, "topic": None},
    "index": {"ver": 4, "conn": 4, "count": 4},
    "chunk info": {"ver": 4, "chunk_pos": 8, "start_time": 8, "end_time": 8, "count": 4},
    "bag": {"index_pos": 8, "conn_count": 4, "chunk_count": 4},
}
Fields = dict[str, bytes]


@dataclass(slots=True)
class Record:
    """A record of a bag.

    Attributes:
        kind: key of KINDS; empty: another kind.
        fields: header fields by name.
        start: offset of the record.
        body: offset of the data.
        end: offset of the end. It lies beyond the end of the file if the record is cut.
    """

    kind: str
    fields: Fields
    start: int
    body: int
    end: int

    def number(self, name: str) -> int:
        """Return a field as an unsigned integer."""
        return int.from_bytes(self.fields[name], "little")

    def time(self, name: str) -> int:
        """Return a time field in nanoseconds."""
        return nanoseconds(self.fields[name])


def nanoseconds(field: bytes) -> int:
    """Parse a time field to nanoseconds."""
    seconds, nanoseconds = struct.unpack("<II", field)
    return int(seconds) * 10**9 + int(nanoseconds)


def read_record(source: FileBytes, offset: int) -> Record | None:
    """Read the record at an offset. Return None if there is none. Its data may be cut."""
    size = int.from_bytes(source.read(offset, 4), "little")
    if not 4 <= size <= LONGEST_HEADER:
        return None
    fields = read_fields(source.read(offset + 4, size), size)
    length = source.read(offset + 4 + size, 4)
    if fields is None or len(length) < 4 or len(fields.get("op", b"")) != 1:
        return None
    kind = next((name for name, layout in RECORD_FIELDS.items() if fits(fields, layout)), "")
    body = offset + size + 8
    return Record(kind, fields, offset, body, body + int.from_bytes(length, "little"))


def read_fields(header: bytes, size: int) -> Fields | None:
    """Parse the fields of a header of ``size`` bytes. Return None if the bytes are no header."""
    if len(header) < size:
        return None
    fields: Fields = {}
    at = 0
    while at < size:
        length = int.from_bytes(header[at : at + 4], "little")
        name, equals, value = header[at + 4 : at + 4 + length].partition(b"=")
        at += 4 + length
        if not equals or at > size or not name.isascii():
            return None
        fields[name.decode()] = value
    return fields


def fits(fields: Fields, layout: Mapping[str, int | None]) -> bool:
    """Tell whether a record has the fields of a kind."""
    return all(name in fields and size in (None, len(fields[name])) for name, size in layout.items())


def is_sane(record: Record, size: int) -> bool:
    """Tell whether the data of a record has the size that its fields state.

    The data must end within ``size`` bytes, except that of a chunk.
    """
    length = record.end - record.body
    if record.kind == "index":
        return length == 12 * record.number("count") and record.end <= size
    if record.kind == "chunk info":
        return length == 8 * record.number("count") and record.end <= size
    if record.kind == "message":
        return record.end <= size and record.time("time") < LAST_TIME
    if record.kind == "chunk" and record.fields["compression"] == b"none":
        return length == record.number("size")
    return bool(record.kind) and (record.end <= size or record.kind == "chunk")


class Connections:
    """Connections of a bag by its connection records."""

    def __init__(self) -> None:
        self._known: dict[int, Connection] = {}

    def __contains__(self, number: object) -> bool:
        return number in self._known

    def note(self, record: Record, data: bytes) -> None:
        """Add a connection record. The first of two with the same number counts."""
        fields = read_fields(data, len(data))
        topic = record.fields["topic"].decode(errors="replace")
        if fields is None or not topic or record.number("conn") in self:
            return
        kind, digest, text = (
            fields.get(name, b"").decode(errors="replace")
            for name in ("type", "md5sum", "message_definition")
        )
        absolute, parts = topic[0] == "/", [part for part in topic.split("/") if part]
        self._known[record.number("conn")] = Connection(
            record.number("conn"),
            "/" * absolute + "/".join(parts),
            normalized(kind),
            MessageDefinition(MessageDefinitionFormat.MSG, text),
            digest,
            0,
            ConnectionExtRosbag1(None, None),
            None,
        )

    def connections(self, counts: Mapping[int, int]) -> list[Connection]:
        """Return the connections with their message counts."""
        return [c._replace(msgcount=counts.get(number, 0)) for number, c in self._known.items()]


def read_index(path: Path) -> FileIndex:
    """Read the index of a bag. Its parts must agree with each other.

    Raises:
        DamageError: there is no index, it ends early, or it contradicts itself.
    """
    file = open_bytes(path)
    try:
        if file.read(0, len(MAGIC)) != MAGIC:
            raise DamageError("it does not begin as a ROS 1 bag does")
        head = read_record(file, len(MAGIC))
        if head is None or head.kind != "bag":
            raise DamageError("the bag's head is damaged")
        if head.fields.get("encryptor"):
            raise DamageError("the bag is encrypted")
        start = head.number("index_pos")
        if not start:
            raise DamageError("the bag's index is missing (not closed)")
        if not head.end <= start <= file.size:
            raise DamageError("the bag's index is missing (cut)")
        if file.size - start > MAX_INDEX:
            raise UnindexedError(f"the bag's index has more than {megabytes(MAX_INDEX)}")
        return _read_index(file, start, head.number("conn_count"), head.number("chunk_count"))
    except (struct.error, KeyError, ValueError, MemoryError) as error:
        raise DamageError(f"the bag's index is damaged ({error})") from None
    finally:
        file.close()


def _read_index(file: FileBytes, offset: int, connection_count: int, chunk_count: int) -> FileIndex:
    connections, chunks, end = Connections(), [], offset
    described = 0
    while offset < file.size:
        record = read_record(file, offset)
        if record is None or not is_sane(record, file.size):
            raise DamageError("the bag's index ends early or is damaged")
        if record.kind == "connection" and record.fields["op"] == b"\x07":
            connections.note(record, file.read(record.body, record.end - record.body))
            described += 1
        elif record.kind == "chunk info" and record.fields["op"] == b"\x06":
            chunks.append(_read_chunk(file, record, end))
        else:
            raise DamageError("the bag's index is damaged")
        offset = record.end
    if (described, len(chunks)) != (connection_count, chunk_count):
        raise DamageError(
            f"the bag's index has {described} connections and {len(chunks)} chunks, "
            f"its head says {connection_count} and {chunk_count}"
        )
    counts: Counter[int] = Counter()
    for chunk in chunks:
        counts.update(chunk.counts)
    if not all(number in connections for number in counts):
        raise DamageError("the bag's index has messages of connections that it does not describe")
    return FileIndex(chunks, connections.connections(counts))


def _read_chunk(file: FileBytes, info: Record, end: int) -> Chunk:
    """Read the head of a chunk and the index records after it. Compare them with the index of the bag."""
    pairs = np.frombuffer(file.read(info.body, info.end - info.body), "<u4").reshape(-1, 2)
    counts = {number: count for number, count in pairs.tolist() if count}
    record = read_record(file, info.number("chunk_pos"))
    if record is None or record.kind != "chunk" or record.end > end or record.fields["op"] != b"\x05":
        raise DamageError("the bag's index leads to no chunk")
    compression = record.fields["compression"].decode()
    index, at = {}, record.end
    for _ in range(len(pairs)):
        entries = read_record(file, at)
        if entries is None or entries.kind != "index" or not is_sane(entries, end):
            raise DamageError("the index of a chunk ends early or is damaged")
        number = entries.number("conn")
        if entries.number("count") != counts.get(number, 0) or entries.fields["op"] != b"\x04":
            raise DamageError("the index of a chunk disagrees with that of the bag")
        index[number] = entries.body
        at = entries.end
    if not counts.keys() <= index.keys():
        raise DamageError("the index of a chunk disagrees with that of the bag")
    start, last = (info.time("start_time"), info.time("end_time")) if counts else (LAST_TIME, -1)
    length = record.end - record.body
    return Chunk(start, last, record.body, length, record.number("size"), compression, counts, index)


def read_times(file: FileBytes, chunk: Chunk, number: int) -> I64:
    """Return the log times of the messages of a connection by the index of a chunk.

    Raises:
        DamageError: the index ends early, or it disagrees with that of the bag.
    """
    size = 12 * chunk.counts[number]
    data = file.read(chunk.index[number], size)
    if len(data) < size:
        raise DamageError("the index of a chunk ends early")
    entries = np.frombuffer(data, "<u4").reshape(-1, 3).astype(np.int64)
    times: I64 = entries[:, 0] * 10**9 + entries[:, 1]
    if len(times) and not chunk.start <= times.min() <= times.max() <= chunk.end:
        raise DamageError("the index of a chunk disagrees with that of the bag")
    return times


def parse(data: memoryview, connections: Container[int]) -> tuple[list[ChunkMessage], bool]:
    """Return the messages of a chunk by the record lengths, and whether the lengths lead to its end."""
    messages: list[ChunkMessage] = []
    offset, size = 0, len(data)
    while offset + 8 <= size:
        (length,) = LENGTH.unpack_from(data, offset)
        body = offset + length + 8
        fields = read_fields(bytes(data[offset + 4 : body - 4]), length) if body <= size else None
        if fields is None:
            return messages, False
        offset = body + LENGTH.unpack_from(data, body - 4)[0]
        if fits(fields, RECORD_FIELDS["message"]) and offset <= size:
            number, time = int.from_bytes(fields["conn"], "little"), nanoseconds(fields["time"])
            if number in connections and time < LAST_TIME:
                messages.append((time, number, data[body:offset]))
    return messages, offset == size


def chunk_of(record: Record, size: int) -> Chunk:
    """Return the chunk of a record of a file of ``size`` bytes, without messages."""
    compression = record.fields["compression"].decode(errors="replace")
    packed, unpacked = min(record.end, size) - record.body, record.number("size")
    return Chunk(LAST_TIME, -1, record.body, packed, unpacked, compression, {}, cut=record.end > size)


FORM = ChunkFormat(read_index, read_times, parse)
