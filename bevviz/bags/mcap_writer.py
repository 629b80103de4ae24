"""Writer of raw messages into an MCAP file, byte for byte as recorded (https://mcap.dev/spec)."""

from __future__ import annotations

import os
import struct
from binascii import crc32
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from io import BytesIO
from mmap import ACCESS_READ, mmap
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
from bevviz.errors import UserError, first_line
from bevviz.support import cleanup
from bevviz.support.files import claim_target, lock_file, rename_new, write_all
from bevviz.support.version import __version__

HEADER, CHUNK_INDEX, STATISTICS = 1, 8, 0x0B
CHUNK_SIZE = 1 << 22  # bytes at which a chunk is closed

_SCHEMAS = {"protobuf": "protobuf", "json": "jsonschema"}  # schema encodings of messages other than ROS's


class McapWriter:
    """Context manager that writes messages in order of log time. The file appears after a successful end.

    Until then its name is NAME.partial-XXXXXXXX.mcap. A killed process leaves this file, and it can be read.
    If ``write`` finds the disk full, the caller can leave the context without an error. The messages written
    so far then become a complete file.

    ROS 1 messages are not converted. They get the encoding ``ros1``, which MCAP has besides ``cdr``.

    Args:
        path: the ``.mcap`` file.
        define: returns the message definition of a connection.
        ros1: write the profile ``ros1`` instead of ``ros2``.
        compress: compress chunks with zstd.
        replace: overwrite an existing file. Without it, an existing file stays. A bag that cannot be renamed
            or completed then keeps its unfinished name.

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
        replace: bool = True,
    ) -> None:
        self._path = path.resolve()
        self._replace = replace
        self._define = define
        self._profile = "ros1" if ros1 else "ros2"
        self._compression = "zstd" if compress else ""
        self._schemas: dict[tuple[str, MessageDefinition], int] = {}
        self._channels: dict[tuple[str, str, MessageDefinition], int] = {}
        self._declared = BytesIO()  # schema and channel records, for the summary
        self._declared_count: Counter[int] = Counter()  # number of these records by opcode
        self._chunk = BytesIO()
        # (log time, offset) of the messages of the open chunk, by channel
        self._index: dict[int, list[tuple[int, int]]] = defaultdict(list)
        self._chunks = BytesIO()  # chunk index records, for the summary
        self._chunk_count = 0
        self._counts: Counter[int] = Counter()
        self._attachments = list[bytes]()  # attachment index records, for the summary
        self._span = (2**63 - 1, 0)
        self._end = 0

    def __enter__(self) -> Self:
        unfinished = claim_target(self._path, "bag")
        self._partial_path, self._file = unfinished.path, unfinished.handle
        cleanup.register(self, partial(self._partial_path.unlink, missing_ok=True))
        try:
            self._write_bytes(MAGIC + _record(HEADER, _text(self._profile) + _text(f"bevviz {__version__}")))
        except OSError as error:
            cleanup.unregister(self)
            unfinished.discard()
            raise UserError(f"{self._path}: cannot write the bag: {error.strerror}") from None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        keep = kind is None and not self._replace
        try:
            if kind is None:
                self._finish()
                if self._replace:
                    self._partial_path.replace(self._path)
                else:
                    rename_new(self._partial_path, self._path)
        except FileExistsError:
            raise UserError(f"{self._path}: is already there; the bag is {self._partial_path.name}") from None
        except OSError as failure:
            where = f"; what was written is in {self._partial_path.name}" if keep else ""
            raise UserError(f"{self._path}: cannot write the bag: {failure.strerror}{where}") from None
        finally:
            if not keep:
                self._partial_path.unlink(missing_ok=True)
            cleanup.unregister(self)
            os.close(self._file)  # releases the lock as well

    @property
    def size(self) -> int:
        """Bytes in the file so far, without the open chunk."""
        return self._end

    def attach(self, name: str, data: bytes) -> None:
        """Attach a file to the bag. Call it before the first message.

        Raises:
            UserError: the disk is full.
        """
        if self._end and (self._chunk.tell() or self._chunk_count):
            raise ValueError("what is attached comes before the messages")
        start, names = self._end, _text(name) + _text("application/octet-stream")
        content = bytes(16) + names + struct.pack("<Q", len(data)) + data
        record = _record(ATTACHMENT, content + struct.pack("<I", crc32(content)))
        try:
            self._write_bytes(record)
        except OSError as error:
            raise UserError(f"{self._path}: cannot write the bag: {error.strerror}") from None
        about = struct.pack("<QQQQQ", start, len(record), 0, 0, len(data)) + names
        self._attachments.append(_record(ATTACHMENT_INDEX, about))

    def write(
        self, connection: Connection, time: int, data: bytes | memoryview, sent: int | None = None
    ) -> None:
        """Append a message.

        Args:
            connection: connection that recorded the message. Its topic, type, encoding and quality of service
                are kept.
            time: log time in nanoseconds.
            data: serialised message.
            sent: time of publication in nanoseconds; None: unknown, so the log time.

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

    def _write_bytes(self, data: bytes) -> None:
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
            # A player then offers a latched topic to late subscribers, as the robot did.
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
        self._declared_count[opcode] += 1

    def _close_chunk(self) -> None:
        data, start = self._chunk.getvalue(), self._end
        index, self._chunk, self._index = self._index, BytesIO(), defaultdict(list)
        packed = zstd.compress(data) if self._compression else data
        times = [time for entries in index.values() for time, _ in entries]
        head = CHUNK_HEAD.pack(
            min(times, default=0), max(times, default=0), len(data), crc32(data), len(self._compression)
        )
        head += self._compression.encode() + struct.pack("<Q", len(packed))
        try:
            self._write_bytes(RECORD.pack(CHUNK, len(head) + len(packed)) + head)
            self._write_bytes(packed)
            self._write_bytes(_encode_index(index)[0])
        except OSError:  # Whole chunks stay, and their summary still has room.
            os.ftruncate(self._file, start)
            os.lseek(self._file, start, os.SEEK_SET)
            self._end = start
            self._counts -= Counter({channel: len(entries) for channel, entries in index.items()})
            raise
        self._add_to_summary(start, RECORD.size + len(head) + len(packed), index, len(packed), len(data))

    def _add_to_summary(
        self, start: int, length: int, index: Mapping[int, Sequence[tuple[int, int]]], packed: int, size: int
    ) -> None:
        """Add a written chunk to the summary."""
        times = [time for entries in index.values() for time, _ in entries]
        first, last = min(times, default=0), max(times, default=0)
        listed, record_offsets = _encode_index(index)
        offsets = b"".join(
            struct.pack("<HQ", channel, start + length + at) for channel, at in record_offsets.items()
        )
        about = struct.pack("<QQQQ", first, last, start, length) + _bytes(offsets)
        about += struct.pack("<Q", len(listed)) + _text(self._compression)
        self._chunks.write(_record(CHUNK_INDEX, about + struct.pack("<QQ", packed, size)))
        self._chunk_count += 1
        if times:
            self._span = min(first, self._span[0]), max(last, self._span[1])

    def _resume(self, data: mmap, handle: int) -> bool:
        """Continue after the last whole message of a killed writer.

        Returns:
            False if the file is complete already.

        Raises:
            ValueError: another writer wrote the file, or it is damaged before its end.
        """
        size, at = len(data), len(MAGIC)
        if data[:at] != MAGIC:
            raise ValueError("it is no MCAP file")
        if size > at and data[-len(MAGIC) :] == MAGIC:
            return False
        missing = b""  # missing bytes of the index after the last chunk
        declared: set[tuple[int, int]] = set()  # (opcode, number)
        while not missing and at + RECORD.size <= size:
            opcode, length = RECORD.unpack_from(data, at)
            end = at + RECORD.size + length
            if opcode == HEADER and end <= size:
                at = end
                continue
            if opcode != CHUNK:
                if opcode != DATA_END and any(data[at:]):  # A power cut leaves zeros.
                    raise ValueError(f"it is damaged at byte {at}")
                break
            content = at + RECORD.size + CHUNK_HEAD.size
            if content > size:
                break
            *_, unpacked, _, name_size = CHUNK_HEAD.unpack_from(data, at + RECORD.size)
            self._compression = data[content : content + name_size].decode()
            content += name_size + 8
            if end > size:  # Only a part of the chunk was written.
                if not self._compression:
                    whole = self._index_records(data[content:], declared, self._index)
                    self._chunk.write(data[content : content + whole])
                break
            packed = data[content:end]
            index: dict[int, list[tuple[int, int]]] = {}
            chunk = zstd.decompress(packed) if self._compression else packed
            if self._index_records(chunk, declared, index) != len(chunk):
                raise ValueError(f"the chunk at byte {at} is damaged")
            self._add_to_summary(at, end - at, index, len(packed), unpacked)
            listed, _ = _encode_index(index)
            behind = data[end : end + len(listed)]
            if behind != listed:
                missing = listed
                if not listed.startswith(behind.rstrip(b"\0")):
                    raise ValueError(f"the index at byte {end} is damaged")
            at = end if missing else end + len(listed)
        self._file, self._end = handle, at
        os.lseek(handle, at, os.SEEK_SET)
        self._write_bytes(missing)
        return True

    def _index_records(
        self, data: bytes, declared: set[tuple[int, int]], index: dict[int, list[tuple[int, int]]]
    ) -> int:
        """Count the whole records of a chunk, and list its messages in ``index``.

        Returns:
            Bytes of the whole records.

        Raises:
            ValueError: the bytes after them are no part of a record.
        """
        at = 0
        while at + RECORD.size <= len(data):
            opcode, length = RECORD.unpack_from(data, at)
            end = at + RECORD.size + length
            if opcode not in (SCHEMA, CHANNEL, MESSAGE):
                if any(data[at:]):
                    raise ValueError("a chunk is damaged")
                break
            if end > len(data):
                break
            if opcode == MESSAGE:
                channel, _, time, _ = MESSAGE_HEAD.unpack_from(data, at + RECORD.size)
                index.setdefault(channel, []).append((time, at))
                self._counts[channel] += 1
            elif (key := (opcode, *struct.unpack_from("<H", data, at + RECORD.size))) not in declared:
                declared.add(key)
                self._declared.write(data[at:end])
                self._declared_count[opcode] += 1
            at = end
        return at

    def _finish(self) -> None:
        if self._chunk.tell():
            self._close_chunk()
        self._write_bytes(_record(DATA_END, struct.pack("<I", 0)))
        summary = self._end
        counts = b"".join(struct.pack("<HQ", *pair) for pair in sorted(self._counts.items()))
        about = struct.pack(
            "<QHIIIIQQ",
            self._counts.total(),
            self._declared_count[SCHEMA],
            self._declared_count[CHANNEL],
            len(self._attachments),
            0,  # metadata records
            self._chunk_count,
            *(self._span if self._counts else (0, 0)),
        )
        self._write_bytes(self._declared.getvalue() + _record(STATISTICS, about + _bytes(counts)))
        self._write_bytes(self._chunks.getvalue() + b"".join(self._attachments))
        self._write_bytes(_record(FOOTER, struct.pack("<QQI", summary, 0, 0)) + MAGIC)


def complete(path: Path) -> int:
    """Complete a bag of a killed process in place: keep its whole messages and write the index.

    Returns:
        Number of messages.

    Raises:
        UserError: the file cannot be completed. It is unchanged.
    """
    writer = McapWriter(path, _undefined)
    try:
        handle = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
        try:
            lock_file(handle, f"{path}: another process is writing it")
            if os.fstat(handle).st_nlink > 1:
                raise UserError(f"{path}: cannot be completed: it has another name, too (a hard link)")
            with mmap(handle, 0, access=ACCESS_READ) as data:
                unfinished = writer._resume(data, handle)
            if unfinished:
                os.ftruncate(handle, writer._end)
                writer._finish()
        finally:
            os.close(handle)
    except OSError as error:
        raise UserError(f"{path}: cannot be completed: {error.strerror}") from None
    except (ValueError, struct.error, zstd.ZstdError) as error:
        raise UserError(f"{path}: cannot be completed: {first_line(error)}") from None
    return writer._counts.total()


def _undefined(connection: Connection) -> MessageDefinition:
    raise ValueError(f"{connection.topic}: a bag that is completed gets no further messages")


def _encode_index(index: Mapping[int, Sequence[tuple[int, int]]]) -> tuple[bytes, dict[int, int]]:
    """Encode the index of the messages of a chunk. Return it with the offset of each channel's record."""
    listed, offsets = b"", {}
    for channel, entries in index.items():
        offsets[channel] = len(listed)
        pairs = b"".join(struct.pack("<QQ", *entry) for entry in entries)
        listed += _record(MESSAGE_INDEX, struct.pack("<H", channel) + _bytes(pairs))
    return listed, offsets


def _profile(qos: Qos) -> dict[str, object]:
    """Convert a quality of service to the layout of metadata.yaml version 9."""

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
