"""Records of an MCAP file (https://mcap.dev/spec), and the index of a sound file."""

from __future__ import annotations

import re
import struct
from binascii import crc32
from collections import Counter
from collections.abc import Container, Iterable, Mapping
from contextlib import suppress
from itertools import islice
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
    Qos,
)
from rosbags.rosbag2.metadata import parse_qos

from bevviz.bags.chunks import Chunk, ChunkFormat, ChunkMessage, FileIndex
from bevviz.bags.reader import LAST_TIME, DamageError, FileBytes, UnindexedError, as_damage, megabytes
from bevviz.bags.remote import open_bytes
from bevviz.model.frame import I64
from bevviz.support.limits import (
    MAX_ATTACHMENT,
    MAX_ATTACHMENTS,
    MAX_INDEX,
    MAX_PROFILE,
    MAX_PROFILES,
)

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX, ATTACHMENT = range(1, 10)
ATTACHMENT_INDEX, STATISTICS, DATA_END = 0x0A, 0x0B, 0x0F
FIRST_PRIVATE = 0x80  # Opcodes from here on are private to applications.
COMPRESSIONS = (b"", b"lz4", b"zstd")
FORMATS = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros1msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
    "omgidl": MessageDefinitionFormat.IDL,
}
RECORD = struct.Struct("<BQ")
CHUNK_HEAD = struct.Struct("<QQQII")  # first and last log time, size, CRC, length of the compression name
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_FOOTER = struct.Struct("<BQQQI8s")  # opcode, length, start of the summary and of its offsets, CRC, magic
_STATISTICS = struct.Struct("<QHIIIIQQ")  # messages, schemas, channels, ..., chunks, first and last log time
_COUNT = struct.Struct("<HQ")

PROFILES = "offered_qos_profiles"  # key of a channel's metadata
PUBLISHERS = "bevviz_publishers"  # key of a channel's metadata: names of the nodes that publish the topic
# Type of a ROS message as DDS names it: sensor_msgs::msg::dds_::PointCloud2_. The topic is rt/NAME.
DDS_TYPE = re.compile(r"(\w+)::(msg|srv|action)::dds_::(\w+)_$")
NO_DEFINITION = MessageDefinition(MessageDefinitionFormat.NONE, "")


class Channels:
    """Connections built from schema and channel records."""

    def __init__(self) -> None:
        self.schemas: dict[int, tuple[str, MessageDefinition]] = {}
        self._dds_schemas: set[int] = set()
        self._channels: dict[int, tuple[int, str, str, bytes]] = {}  # schema, topic, encoding, metadata

    def __contains__(self, channel: object) -> bool:
        return channel in self._channels

    def __bool__(self) -> bool:
        return bool(self._channels)

    def note(self, opcode: int, record: bytes) -> None:
        """Add a schema or channel record. The first of two with the same number counts."""
        if opcode == SCHEMA:
            (number,) = struct.unpack_from("<H", record)
            msgtype, encoding, text = read_strings(record, 2, 3)
            kind = FORMATS.get(encoding.decode(errors="replace"), MessageDefinitionFormat.NONE)
            definition = (
                MessageDefinition(kind, text.decode(errors="replace")) if kind.value else NO_DEFINITION
            )
            if encoding in (b"protobuf", b"jsonschema"):  # a character for each byte
                definition = MessageDefinition(MessageDefinitionFormat.NONE, text.decode("latin-1"))
            name = msgtype.decode(errors="replace")
            if match := DDS_TYPE.match(name):
                name = "/".join(match.groups())
                self._dds_schemas.add(number)
            if match or not text.strip():  # The ROS release defines the type.
                definition = NO_DEFINITION
            self.schemas.setdefault(number, (name, definition))
        elif opcode == CHANNEL:
            number, schema = struct.unpack_from("<HH", record)
            topic, form, metadata = read_strings(record, 4, 3)
            names = topic.decode(errors="replace"), form.decode(errors="replace")
            self._channels.setdefault(number, (schema, *names, metadata))

    def described(self, number: int) -> tuple[object, ...]:
        """Return everything that the records say about a channel."""
        schema, *others = self._channels.get(number, (0,))
        return self.schemas.get(schema), *others[:2]

    def connections(self, counts: Mapping[int, int]) -> list[Connection]:
        """Return the connections with their message counts."""
        connections, stated = [], dict[int, dict[str, str]]()
        for number, (*_, metadata) in self._channels.items():
            with suppress(DamageError), as_damage():
                stated[number] = read_metadata(metadata)
        profiles = parse_profiles(about.get(PROFILES, "") for about in stated.values())
        for number, (schema, topic, encoding, _) in self._channels.items():
            msgtype, definition = self.schemas.get(schema, ("", NO_DEFINITION))
            if schema in self._dds_schemas:
                topic = topic.removeprefix("rt") if topic.startswith("rt/") else topic
            about = stated.get(number, {})
            digest, publishers = about.get("topic_type_hash", ""), about.get(PUBLISHERS)
            extra = ConnectionExtRosbag2(encoding, profiles.get(about.get(PROFILES, ""), []))
            count = counts.get(number, 0)
            connections.append(
                Connection(number, topic, msgtype, definition, digest, count, extra, publishers)
            )
        return connections


def parse_profiles(texts: Iterable[str]) -> Mapping[str, list[Qos]]:
    """Return the QoS profiles by their text. Texts that cannot be parsed, or are too many, are left out."""
    profiles = dict[str, list[Qos]]()
    for text in islice(dict.fromkeys(texts), MAX_PROFILES):
        with suppress(DamageError), as_damage():
            if len(text) <= MAX_PROFILE:
                profiles[text] = parse_qos(text)
    return profiles


def read_index(path: Path) -> FileIndex:
    """Read the index at the end of a file. It must agree with the statistics.

    Raises:
        DamageError: there is no index, it ends early, or it disagrees with the statistics.
    """
    file = open_bytes(path)
    try:
        end = file.size - _FOOTER.size
        if file.read(0, len(MAGIC)) != MAGIC:
            raise DamageError("it does not begin as an MCAP file does")
        if end < len(MAGIC):
            raise DamageError("the file ends early (no footer)")
        opcode, length, start, _, crc, magic = _FOOTER.unpack(file.read(end, _FOOTER.size))
        if (opcode, length, magic) != (FOOTER, 20, MAGIC):
            raise DamageError("the file ends early (no footer)")
        if not start:
            raise UnindexedError("it has no index")
        if not len(MAGIC) <= start <= end:
            raise DamageError("its footer is damaged")
        if file.size - start > MAX_INDEX:
            raise UnindexedError(f"its index has more than {megabytes(MAX_INDEX)}")
        summary = file.read(start, file.size - start)
        if crc and crc32(summary[: -len(MAGIC) - 4]) != crc:
            raise DamageError("its index does not fit its checksum")
        channels = Channels()
        index = _parse_summary(summary[: end - start], start, channels)
        if not crc:
            _check_channels(file, index, channels)
        for chunk in index.chunks[-1:]:  # If bytes are missing or inserted, at least the last chunk is moved.
            at = chunk.data - RECORD.size - CHUNK_HEAD.size - len(chunk.compression) - 8
            length = CHUNK_HEAD.size + len(chunk.compression) + 8 + chunk.packed
            if file.read(at, RECORD.size) != RECORD.pack(CHUNK, length):
                raise DamageError("its index leads to no chunk")
            for channel in chunk.index:
                read_times(file, chunk, channel)
        return index
    except (struct.error, IndexError, ValueError) as error:
        raise DamageError(f"its index is damaged ({error})") from None
    finally:
        file.close()


def read_attachments(path: Path) -> dict[str, bytes]:
    """Read the attachments at the start of a file by name, also of a file that is cut.

    ``McapWriter.attach`` writes them there. A damaged attachment is left out.
    """
    file, attachments = open_bytes(path), dict[str, bytes]()
    try:
        if file.read(0, len(MAGIC)) != MAGIC:
            return attachments
        offset, left = len(MAGIC), MAX_ATTACHMENT
        for _ in range(MAX_ATTACHMENTS):
            if len(head := file.read(offset, RECORD.size)) < RECORD.size:
                break
            opcode, length = RECORD.unpack(head)
            if opcode == ATTACHMENT and length <= left:
                left -= length
                record = file.read(offset + RECORD.size, length)
                with suppress(struct.error, UnicodeDecodeError):
                    name, media = read_strings(record, 16, 2)
                    at = 16 + 4 + len(name) + 4 + len(media)
                    (size,) = struct.unpack_from("<Q", record, at)
                    (crc,) = struct.unpack_from("<I", record, at + 8 + size)
                    if crc in (0, crc32(record[: at + 8 + size])):
                        attachments[name.decode()] = record[at + 8 : at + 8 + size]
            elif opcode != HEADER:
                break
            offset += RECORD.size + length
        return attachments
    finally:
        file.close()


def _check_channels(file: FileBytes, index: FileIndex, channels: Channels) -> None:
    """Compare channel descriptions with the data if the summary has no checksum.

    Reading all data takes too long. A writer describes a channel at its first message at the latest, so the
    chunk with this message is enough. That is one chunk of most files and a few of others.

    Raises:
        DamageError: the data describes a channel in another way.
    """
    in_data, seen = Channels(), set[int]()
    for chunk in sorted(index.chunks, key=attrgetter("data")):
        if chunk.counts.keys() <= seen:
            continue
        seen |= chunk.counts.keys()
        content, damage = chunk.unpack(file)
        if not damage:  # Reading its messages reports the damage.
            note_all(content, in_data)
    wrong = [
        c.topic
        for c in index.connections
        if c.id in in_data and in_data.described(c.id) != channels.described(c.id)
    ]
    if wrong:
        raise DamageError(f"its index describes {', '.join(wrong)} in another way than its data")


def note_all(content: bytes, channels: Channels) -> None:
    """Note the schema and channel records in the content of a chunk."""
    offset = 0
    while offset + RECORD.size <= len(content):
        opcode, length = RECORD.unpack_from(content, offset)
        start = offset + RECORD.size
        offset = start + length
        if opcode in (SCHEMA, CHANNEL) and offset <= len(content):
            with suppress(struct.error):
                channels.note(opcode, content[start:offset])


def _parse_summary(summary: bytes, end: int, channels: Channels) -> FileIndex:
    """Parse the index in a summary section that begins at ``end``. Fill ``channels`` from its records."""
    chunks = []
    statistics: tuple[Any, ...] | None = None
    stated_counts: Mapping[int, int] = {}
    offset = 0
    while offset < len(summary):
        opcode, length = RECORD.unpack_from(summary, offset)
        offset += RECORD.size
        if offset + length > len(summary):
            raise DamageError("its index ends early")
        record = summary[offset : offset + length]
        offset += length
        if opcode in (SCHEMA, CHANNEL):
            channels.note(opcode, record)
        elif opcode == CHUNK_INDEX:
            chunks.append(_parse_chunk_index(record, end))
        elif opcode == STATISTICS:
            statistics = _STATISTICS.unpack_from(record)
            (size,) = struct.unpack_from("<I", record, _STATISTICS.size)
            stated_counts = dict(_COUNT.iter_unpack(record[_STATISTICS.size + 4 :][:size]))
    if statistics is None:
        raise UnindexedError("it has no statistics that its index could be held against")
    counts: Counter[int] = Counter()
    for chunk in chunks:
        counts.update(chunk.counts)
    total, chunk_count, first, last = statistics[0], statistics[5], statistics[6], statistics[7]
    index = FileIndex(chunks, channels.connections(counts))
    if total and not chunks:
        raise UnindexedError("it has no index of chunks")
    if counts.total() != total or (chunk_count, counts) != (len(chunks), Counter(stated_counts)):
        raise DamageError(
            f"its index, of {len(chunks)} chunks with {counts.total()} messages, disagrees with its "
            f"statistics, of {chunk_count} with {total}"
        )
    if total and index.span != (first, last + 1):
        raise DamageError("its index disagrees with its statistics on the time")
    if not counts.keys() <= {c.id for c in index.connections}:
        raise DamageError("its index has messages on channels that it does not describe")
    return index


def _parse_chunk_index(record: bytes, end: int) -> Chunk:
    start, last, offset, length, size = struct.unpack_from("<QQQQI", record)
    at = 36 + size
    index_length, name_size = struct.unpack_from("<QI", record, at)
    name = record[at + 12 : at + 12 + name_size]
    packed, unpacked = struct.unpack_from("<QQ", record, at + 12 + name_size)
    listed = dict(_COUNT.iter_unpack(record[36:at]))
    stop = offset + length + index_length  # end of the message indexes, which follow the chunk
    if not (offset < offset + length <= stop <= end) or max(start, last) >= LAST_TIME or packed > length:
        raise DamageError("its index leads out of the file, or out of time")
    if listed and (min(listed.values()) < offset + length or max(listed.values()) >= stop):
        raise DamageError("its index leads out of the file")
    order = sorted((at, channel) for channel, at in listed.items())
    counts = {}
    for (at, channel), (after, _) in zip(order, [*order[1:], (stop, 0)], strict=True):
        if (count := (after - at - 15) // 16) > 0:
            counts[channel] = count
    data = offset + RECORD.size + CHUNK_HEAD.size + len(name) + 8
    checksum, index = data - 16 - len(name), {c: listed[c] for c in counts}
    return Chunk(start, last, data, packed, unpacked, name.decode(), counts, index, checksum)


def read_times(file: FileBytes, chunk: Chunk, channel: int) -> I64:
    """Return the log times of the messages of a channel by the message index of a chunk.

    Raises:
        DamageError: the record is no message index, or it disagrees with the chunk index.
    """
    entries = 16 * chunk.counts[channel]
    record = file.read(chunk.index[channel], 15 + entries)
    expected = struct.pack("<BQHI", MESSAGE_INDEX, 6 + entries, channel, entries)
    if record[:15] != expected or len(record) != 15 + entries:
        raise DamageError("the message index of a chunk is damaged")
    times: I64 = np.frombuffer(record, "<i8", offset=15)[::2]
    listed = times.tolist()  # NumPy takes longer for so few.
    if listed and not chunk.start <= min(listed) <= max(listed) <= chunk.end:
        raise DamageError("the message index of a chunk disagrees with that of the chunks")
    return times


def read_single(file: FileBytes, chunk: Chunk, channel: int, start: int, stop: int) -> list[ChunkMessage]:
    """Return the messages of a channel with start <= log time < stop, of a chunk that is not packed.

    The checksum of the chunk is not checked.

    Raises:
        DamageError: a message is not where the index says.
    """
    times = read_times(file, chunk, channel)
    entries = file.read(chunk.index[channel] + 15, 16 * chunk.counts[channel])
    offsets = np.frombuffer(entries, "<u8")[1::2]
    messages: list[ChunkMessage] = []
    head = RECORD.size + MESSAGE_HEAD.size
    for time, offset in zip(times.tolist(), offsets.tolist(), strict=True):
        if not start <= time < stop:
            continue
        content = file.read(chunk.data + offset, head) if offset + head <= chunk.size else b""
        if len(content) != head:
            raise DamageError("the message index of a chunk leads out of it")
        opcode, length = RECORD.unpack_from(content)
        stated = MESSAGE_HEAD.unpack_from(content, RECORD.size)
        end = offset + RECORD.size + length
        if (opcode, stated[0], stated[2]) != (MESSAGE, channel, time) or end > chunk.size:
            raise DamageError("a message is not where the index of its chunk says")
        messages.append((time, channel, file.read(chunk.data + offset + head, length - MESSAGE_HEAD.size)))
    return messages


def parse(data: memoryview, channels: Container[int]) -> tuple[list[ChunkMessage], bool]:
    """Return the messages of a chunk by the record lengths, and whether the lengths lead to its end."""
    messages: list[ChunkMessage] = []
    offset, size = 0, len(data)
    while offset + RECORD.size <= size:
        opcode, length = RECORD.unpack_from(data, offset)
        body = offset + RECORD.size
        offset = body + length
        if opcode == MESSAGE and offset <= size and length >= MESSAGE_HEAD.size:
            channel, _, time, _ = MESSAGE_HEAD.unpack_from(data, body)
            if channel in channels and time < LAST_TIME:
                messages.append((time, channel, data[body + MESSAGE_HEAD.size : offset]))
    return messages, offset == size


def chunk_at(file: FileBytes, body: int, end: int) -> Chunk | None:
    """Return the chunk of a record without its messages, or None if its head is damaged."""
    head = file.read(body, CHUNK_HEAD.size + 12)
    if len(head) < CHUNK_HEAD.size:
        return None
    first, last, size, _, name_size = CHUNK_HEAD.unpack_from(head)
    name, data = head[CHUNK_HEAD.size :][:name_size], body + CHUNK_HEAD.size + name_size + 8
    if name_size != len(name) or name not in COMPRESSIONS or data > min(end, file.size):
        return None
    packed = min(end, file.size) - data
    return Chunk(first, last, data, packed, size, name.decode(), {}, {}, body + 24, end > file.size)


def read_strings(record: bytes, offset: int, count: int) -> list[bytes]:
    """Parse ``count`` strings, each after its length.

    Raises:
        struct.error: the record ends before them.
    """
    values = []
    for _ in range(count):
        (size,) = struct.unpack_from("<I", record, offset)
        offset += 4
        if offset + size > len(record):
            raise struct.error("a string ends behind its record")
        values.append(bytes(record[offset : offset + size]))
        offset += size
    return values


def read_metadata(record: bytes) -> dict[str, str]:
    """Parse the pairs of strings of a map."""
    texts: list[str] = []
    offset = 0
    while offset < len(record):
        (text,) = read_strings(record, offset, 1)
        texts.append(text.decode())
        offset += 4 + len(text)
    return dict(zip(texts[::2], texts[1::2], strict=True))


FORM = ChunkFormat(read_index, read_times, parse, read_single)
