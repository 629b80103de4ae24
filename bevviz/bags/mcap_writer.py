"""Raw messages into an MCAP file, byte for byte as they were recorded (https://mcap.dev/spec)."""

from __future__ import annotations

import os
import struct
from binascii import crc32
from collections import Counter, defaultdict
from collections.abc import Callable
from functools import partial
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import Self

from backports import zstd
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
    Qos,
    QosTime,
)
from ruamel.yaml import YAML

from bevviz import remains
from bevviz.bags.mcap import (
    ATTACHMENT,
    ATTACHMENT_INDEX,
    CHANNEL,
    CHUNK,
    CHUNK_HEAD,
    DATA_END,
    FOOTER,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    RECORD,
    SCHEMA,
)
from bevviz.errors import UserError
from bevviz.files import claim, unfinished, write_all
from bevviz.version import __version__

HEADER, CHUNK_INDEX, STATISTICS = 1, 8, 0x0B
CHUNK_SIZE = 1 << 22  # bytes that a chunk is closed at

_SCHEMAS = {"protobuf": "protobuf", "json": "jsonschema"}  # of messages that are not ROS's


class McapWriter:
    """Context manager: ``write`` messages in order of log time. The file appears when all went well.

    Until then it is NAME.partial.mcap, which a process that is killed leaves, and which can be read. Where
    ``write`` finds the disk full, what was written until then becomes a complete file if the context is left
    without an error.

    The messages of ROS 1 stay what they are: with the encoding ``ros1``, which MCAP has beside ``cdr``.

    Args:
        path: the ``.mcap`` file; replaced where it exists.
        define: tells what the type of a connection is made of.
        ros1: the profile that the file states.
        compress: chunks with zstd.

    Raises:
        UserError: the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        define: Callable[[Connection], MessageDefinition],
        *,
        ros1: bool = False,
        compress: bool = True,
    ) -> None:
        self._path = path.resolve()
        self._part = unfinished(self._path)
        self._define = define
        self._profile = "ros1" if ros1 else "ros2"
        self._compression = "zstd" if compress else ""
        self._schemas: dict[tuple[str, MessageDefinition], int] = {}
        self._channels: dict[tuple[str, str, MessageDefinition], int] = {}
        self._declared = BytesIO()  # schemas and channels, for the summary
        self._chunk = BytesIO()
        self._index: dict[int, list[tuple[int, int]]] = defaultdict(list)  # of the open chunk, by channel
        self._chunks = BytesIO()  # their records of the summary
        self._chunk_count = 0
        self._counts: Counter[int] = Counter()
        self._attachments = list[bytes]()  # their records of the summary
        self._span = (2**63 - 1, 0)
        self._end = 0

    def __enter__(self) -> Self:
        self._lock = claim(self._path, "bag")
        remains.remember(self, partial(self._part.unlink, missing_ok=True))
        try:
            self._file = os.open(self._part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o666)
            self._put(MAGIC + _record(HEADER, _text(self._profile) + _text(f"bevviz {__version__}")))
        except OSError as error:
            remains.forget(self)
            os.close(self._lock)
            raise UserError(f"{self._path}: cannot write the bag: {error.strerror}") from None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._finish()
            if kind is None:
                self._part.replace(self._path)
        except OSError as failure:
            raise UserError(f"{self._path}: cannot write the bag: {failure.strerror}") from None
        finally:
            os.close(self._file)
            self._part.unlink(missing_ok=True)
            remains.forget(self)
            os.close(self._lock)

    @property
    def size(self) -> int:
        """Bytes so far, as far as they are in the file."""
        return self._end

    def attach(self, name: str, data: bytes) -> None:
        """A file that belongs to the messages; to be called before the first of them.

        Raises:
            UserError: the disk is full.
        """
        if self._end and (self._chunk.tell() or self._chunk_count):
            raise ValueError("what is attached comes before the messages")
        start, named = self._end, _text(name) + _text("application/octet-stream")
        content = bytes(16) + named + struct.pack("<Q", len(data)) + data
        record = _record(ATTACHMENT, content + struct.pack("<I", crc32(content)))
        try:
            self._put(record)
        except OSError as error:
            raise UserError(f"{self._path}: cannot write the bag: {error.strerror}") from None
        about = struct.pack("<QQQQQ", start, len(record), 0, 0, len(data)) + named
        self._attachments.append(_record(ATTACHMENT_INDEX, about))

    def write(
        self, connection: Connection, time: int, data: bytes | memoryview, sent: int | None = None
    ) -> None:
        """Append a message.

        Args:
            connection: where it was recorded: its topic, type, encoding and quality of service are kept.
            time: log time, nanoseconds.
            data: the serialised message.
            sent: time of publication, nanoseconds; None: not known, the log time.

        Raises:
            UserError: the disk is full.
        """
        key = connection.topic, connection.msgtype, connection.msgdef
        channel = self._channels.get(key)
        if channel is None:
            channel = self._channels[key] = self._add_channel(connection, len(self._channels) + 1)
        self._index[channel].append((time, self._chunk.tell()))
        count = self._counts[channel]
        self._counts[channel] += 1
        self._chunk.write(RECORD.pack(MESSAGE, MESSAGE_HEAD.size + len(data)))
        self._chunk.write(
            MESSAGE_HEAD.pack(channel, count & 0xFFFFFFFF, time, time if sent is None else sent)
        )
        self._chunk.write(data)
        if self._chunk.tell() > CHUNK_SIZE:
            try:
                self._close_chunk()
            except OSError as error:
                raise UserError(f"{self._path}: cannot write the bag: {error.strerror}") from None

    def _put(self, data: bytes) -> None:
        write_all(self._file, data)
        self._end += len(data)

    def _add_channel(self, connection: Connection, number: int) -> int:
        extra, definition = connection.ext, self._define(connection)
        form = extra.serialization_format if isinstance(extra, ConnectionExtRosbag2) else "ros1"
        form = form if form in ("ros1", *_SCHEMAS) else "cdr"
        schema = self._schemas.get((connection.msgtype, definition)) or self._add_schema(
            connection.msgtype, definition, form
        )
        metadata = b""
        if isinstance(extra, ConnectionExtRosbag2) and extra.offered_qos_profiles:
            # So that a player offers what is published once to whoever comes late, as the robot did.
            profiles = BytesIO()
            YAML(typ="safe", pure=True).dump([_profile(qos) for qos in extra.offered_qos_profiles], profiles)
            metadata = _text("offered_qos_profiles") + _text(profiles.getvalue().decode())
        if connection.digest.startswith("RIHS"):
            metadata += _text("topic_type_hash") + _text(connection.digest)
        self._declare(
            CHANNEL,
            struct.pack("<HH", number, schema) + _text(connection.topic) + _text(form) + _bytes(metadata),
        )
        return number

    def _add_schema(self, msgtype: str, definition: MessageDefinition, form: str) -> int:
        number = self._schemas[msgtype, definition] = len(self._schemas) + 1
        kind = {
            MessageDefinitionFormat.MSG: "ros1msg" if form == "ros1" else "ros2msg",
            MessageDefinitionFormat.IDL: "ros2idl",
            MessageDefinitionFormat.NONE: _SCHEMAS.get(form, ""),
        }[definition.format]
        name = msgtype.replace("/msg/", "/") if form == "ros1" else msgtype
        content = definition.data.encode("latin-1" if form in _SCHEMAS else "utf-8")
        self._declare(SCHEMA, struct.pack("<H", number) + _text(name) + _text(kind) + _bytes(content))
        return number

    def _declare(self, opcode: int, content: bytes) -> None:
        record = _record(opcode, content)
        self._chunk.write(record)
        self._declared.write(record)

    def _close_chunk(self) -> None:
        data, start = self._chunk.getvalue(), self._end
        index, self._chunk, self._index = self._index, BytesIO(), defaultdict(list)
        packed = zstd.compress(data) if self._compression else data
        times = [time for entries in index.values() for time, _ in entries]
        first, last = min(times, default=0), max(times, default=0)
        head = CHUNK_HEAD.pack(first, last, len(data), crc32(data), len(self._compression))
        head += self._compression.encode() + struct.pack("<Q", len(packed))
        listed, offsets = b"", b""
        index_start = start + RECORD.size + len(head) + len(packed)
        for channel, entries in index.items():
            offsets += struct.pack("<HQ", channel, index_start + len(listed))
            pairs = b"".join(struct.pack("<QQ", *entry) for entry in entries)
            listed += _record(MESSAGE_INDEX, struct.pack("<H", channel) + _bytes(pairs))
        try:
            self._put(RECORD.pack(CHUNK, len(head) + len(packed)) + head)
            self._put(packed)
            self._put(listed)
        except OSError:  # whole chunks are left, and place for the summary of them
            os.ftruncate(self._file, start)
            os.lseek(self._file, start, os.SEEK_SET)
            self._end = start
            self._counts -= Counter({channel: len(entries) for channel, entries in index.items()})
            raise
        about = struct.pack("<QQQQ", first, last, start, index_start - start) + _bytes(offsets)
        about += struct.pack("<Q", len(listed)) + _text(self._compression)
        self._chunks.write(_record(CHUNK_INDEX, about + struct.pack("<QQ", len(packed), len(data))))
        self._chunk_count += 1
        if times:
            self._span = min(first, self._span[0]), max(last, self._span[1])

    def _finish(self) -> None:
        if self._chunk.tell():
            self._close_chunk()
        self._put(_record(DATA_END, struct.pack("<I", 0)))
        summary = self._end
        counts = b"".join(struct.pack("<HQ", *pair) for pair in sorted(self._counts.items()))
        about = struct.pack(
            "<QHIIIIQQ",
            self._counts.total(),
            len(self._schemas),
            len(self._channels),
            len(self._attachments),
            0,  # metadata
            self._chunk_count,
            *(self._span if self._counts else (0, 0)),
        )
        self._put(self._declared.getvalue() + _record(STATISTICS, about + _bytes(counts)))
        self._put(self._chunks.getvalue() + b"".join(self._attachments))
        self._put(_record(FOOTER, struct.pack("<QQI", summary, 0, 0)) + MAGIC)


def _profile(qos: Qos) -> dict[str, object]:
    """A quality of service as metadata.yaml of version 9 has it."""

    def duration(time: QosTime) -> dict[str, int]:
        return {"sec": time.sec, "nsec": time.nsec}

    return {
        "history": qos.history.name.lower(),
        "depth": qos.depth,
        "reliability": qos.reliability.name.lower(),
        "durability": qos.durability.name.lower(),
        "deadline": duration(qos.deadline),
        "lifespan": duration(qos.lifespan),
        "liveliness": qos.liveliness.name.lower(),
        "liveliness_lease_duration": duration(qos.liveliness_lease_duration),
        "avoid_ros_namespace_conventions": qos.avoid_ros_namespace_conventions,
    }


def _record(opcode: int, content: bytes) -> bytes:
    return RECORD.pack(opcode, len(content)) + content


def _bytes(content: bytes) -> bytes:
    return struct.pack("<I", len(content)) + content


def _text(text: str) -> bytes:
    return _bytes(text.encode())
