"""ROS 1 bags (http://wiki.ros.org/Bags/Format/2.0): the index of a sound bag, a scan of a damaged bag."""

from __future__ import annotations

import re
import struct
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rosbags.interfaces import Connection, ConnectionExtRosbag1, MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag1 import Reader

from bevviz.bags.chunks import Chunk, ChunkFormat, ChunkMessage, FileIndex, ScanResult
from bevviz.bags.reader import LAST_TIME, DamageError, FileBytes, MemoryBytes, normalized, unpack
from bevviz.model.frame import I64

MAGIC = b"#ROSBAG V2.0\n"
OPCODE = re.compile(rb"(?=\x04\0\0\0op=)")  # Every header contains an opcode.
LONGEST_HEADER = 1 << 16  # bytes; the data of a connection has the form of a header and may be longer
SEARCH_BACK = 160  # bytes of a header before its opcode that are searched

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
        sec, nsec = struct.unpack("<II", self.fields[name])
        return int(sec) * 10**9 + int(nsec)


def read_record(source: FileBytes, offset: int) -> Record | None:
    """Read the record at an offset. Return None if there is none. Its data may be cut."""
    size = int.from_bytes(source.read(offset, 4), "little")
    if not 4 <= size <= LONGEST_HEADER:
        return None
    fields = read_fields(source.read(offset + 4, size), size)
    length = source.read(offset + 4 + size, 4)
    if fields is None or len(length) < 4 or len(fields.get("op", b"")) != 1:
        return None
    kind = next((name for name, layout in RECORD_FIELDS.items() if _fits(fields, layout)), "")
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


def _fits(fields: Fields, layout: Mapping[str, int | None]) -> bool:
    return all(name in fields and size in (None, len(fields[name])) for name, size in layout.items())


def _is_sane(record: Record, size: int) -> bool:
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

    def counted(self, counts: Mapping[int, int]) -> list[Connection]:
        """Return the connections with their message counts."""
        return [c._replace(msgcount=counts.get(number, 0)) for number, c in self._known.items()]


# --- the index of a sound bag ------------------------------------------------------------------


def read_index(path: Path) -> FileIndex:
    """Read the index of a bag. Its parts must agree with each other.

    Raises:
        DamageError: there is no index, it ends early, or it contradicts itself.
    """
    file = FileBytes(path)
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
        if record is None or not _is_sane(record, file.size):
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
    return FileIndex(chunks, connections.counted(counts))


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
        if entries is None or entries.kind != "index" or not _is_sane(entries, end):
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
    return Chunk(start, last, record.body, length, record.number("size"), compression, counts, index=index)


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


# --- a damaged bag -----------------------------------------------------------------------------


class RecordWalker:
    """Iterator over the records of a bag or of a chunk. After a broken record it finds the next sound one.

    Only a chunk may be cut: it may end beyond the bytes.
    """

    def __init__(self, source: FileBytes) -> None:
        self._source = source
        self.broken = self.passed = 0

    def __call__(self, offset: int) -> Iterator[Record]:
        """Yield the records from ``offset`` on."""
        size = self._source.size
        record = self._at(offset)
        while offset < size:
            if record is None:
                record = self._search(offset + 1, size)
                self.broken += 1
                self.passed += (record.start if record else size) - offset
                if record is None:
                    return
                offset = record.start
            assert record is not None
            following = self._at(record.end)
            if following is None and record.end != size:
                # The length is wrong and the next record lies within, or the next record is broken.
                is_chunk = record.kind == "chunk"
                nearer = self._search(record.body, min(record.end, size), is_chunk)
                if nearer is not None and is_chunk:
                    record.end, following = nearer.start, nearer
                elif nearer is not None:
                    self.broken += 1
                    self.passed += nearer.start - offset
                    record, offset = nearer, nearer.start
                    continue
            yield record
            offset = record.end
            record = following

    def _at(self, offset: int) -> Record | None:
        record = read_record(self._source, offset)
        return record if record is not None and _is_sane(record, self._source.size) else None

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


def scan(file: FileBytes, result: ScanResult, report: Callable[[int], object]) -> None:
    """Scan a bag from front to back, with the content of every chunk."""
    connections, walker = Connections(), RecordWalker(file)
    outside = array("q")  # messages of an uncompressed chunk whose head is damaged
    for record in walker(len(MAGIC)):
        report(record.end)
        if record.kind == "connection":
            connections.note(record, file.read(record.body, record.end - record.body))
        elif record.kind == "chunk":
            compression = record.fields["compression"].decode(errors="replace")
            packed = min(record.end, file.size) - record.body
            chunk = Chunk(LAST_TIME, -1, record.body, packed, record.number("size"), compression, {}, 0, {})
            chunk.cut = record.end > file.size
            result.begin(chunk)
            _describe(file, chunk, connections, result)
            if chunk.cut:
                result.cut, result.rescued = file.size - record.body, sum(chunk.counts.values())
        elif record.kind == "index":
            result.listed[record.number("conn")] += record.number("count")
        elif record.kind == "message":
            size = record.end - record.body
            outside.extend((record.time("time"), record.number("conn"), record.body, size))
    result.end()
    result.broken += walker.broken
    result.passed += walker.passed
    result.index.connections = connections.counted(result.finish(connections, outside))


def _describe(file: FileBytes, chunk: Chunk, connections: Connections, result: ScanResult) -> None:
    """Fill in the messages and connections of a chunk."""
    times: dict[int, array[int]] = defaultdict(lambda: array("q"))
    content, chunk.damage = _unpacked(file, chunk)
    walker = RecordWalker(content)
    for record in walker(0):
        if record.kind == "message":
            times[record.number("conn")].append(record.time("time"))
        elif record.kind == "connection":
            connections.note(record, content.read(record.body, record.end - record.body))
    if not (chunk.cut or chunk.damage):
        result.broken += walker.broken
        result.passed += walker.passed
    chunk.fill(times)


def read_messages(file: FileBytes, chunk: Chunk) -> tuple[list[ChunkMessage], str]:
    """Return the messages of a chunk on the connections of its index, and the damage of its content."""
    content, damage = _unpacked(file, chunk)
    data = memoryview(content.read(0, content.size))
    messages = [
        (r.time("time"), r.number("conn"), data[r.body : r.end])
        for r in RecordWalker(content)(0)
        if r.kind == "message" and r.number("conn") in chunk.counts
    ]
    return messages, damage


def _unpacked(file: FileBytes, chunk: Chunk) -> tuple[MemoryBytes, str]:
    """Return the content of a chunk and its damage."""
    packed = file.read(chunk.data, chunk.packed)
    cut = chunk.cut or len(packed) < chunk.packed
    data, damage = unpack(chunk.compression, packed, chunk.size, cut=cut)
    return MemoryBytes(data), damage


REPAIR = "'rosbag reindex' repairs the file"
FORM = ChunkFormat(Reader, False, read_index, read_times, read_messages, scan, REPAIR)
