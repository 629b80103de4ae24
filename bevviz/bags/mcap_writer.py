"""Writer of raw messages into an MCAP file, byte for byte as recorded, by the mcap package."""

from __future__ import annotations

import os
import struct
from collections import Counter
from collections.abc import Callable
from functools import partial
from io import BytesIO
from mmap import ACCESS_READ, mmap
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self, cast

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, Header, Message, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
    Qos,
    QosTime,
)
from ruamel.yaml import YAML

from bevviz.bags.mcap import CHANNEL, CHUNK, DATA_END, MAGIC, MESSAGE, RECORD, SCHEMA
from bevviz.bags.reader import unpack
from bevviz.errors import UserError, first_line
from bevviz.support import cleanup
from bevviz.support.files import claim_target, lock_file, rename_new, write_all
from bevviz.support.version import __version__

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
        self._header = Header("ros1" if ros1 else "ros2", f"bevviz {__version__}")
        self._compression = CompressionType.ZSTD if compress else CompressionType.NONE
        self._schemas: dict[tuple[str, MessageDefinition], int] = {}
        self._channels: dict[tuple[str, str, MessageDefinition], int] = {}
        self._counts: Counter[int] = Counter()  # messages by channel
        self._is_full = False  # the disk

    def __enter__(self) -> Self:
        unfinished = claim_target(self._path, "bag")
        self._partial_path = unfinished.path
        cleanup.register(self, partial(self._partial_path.unlink, missing_ok=True))
        self._output = _Output(unfinished.handle)
        try:
            self._writer = _start(self._output, self._header, self._compression)
        except OSError as error:
            cleanup.unregister(self)
            unfinished.discard()
            raise self._error(error) from None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        keep = kind is None and not self._replace
        try:
            if kind is None:
                if self._is_full:
                    _resume(self._output.handle)
                else:
                    self._writer.finish()  # type: ignore[no-untyped-call]
                if self._replace:
                    self._partial_path.replace(self._path)
                else:
                    rename_new(self._partial_path, self._path)
        except FileExistsError:
            raise UserError(f"{self._path}: is already there; the bag is {self._partial_path.name}") from None
        except OSError as failure:
            where = f"; what was written is in {self._partial_path.name}" if keep else ""
            raise self._error(failure, where) from None
        finally:
            if not keep:
                self._partial_path.unlink(missing_ok=True)
            cleanup.unregister(self)
            os.close(self._output.handle)  # releases the lock as well

    @property
    def size(self) -> int:
        """Bytes in the file so far, without the open chunk."""
        return self._output.end

    def attach(self, name: str, data: bytes) -> None:
        """Attach a file to the bag. Call it before the first message.

        Raises:
            UserError: the disk is full.
        """
        if self._channels:
            raise ValueError("what is attached comes before the messages")
        try:
            self._writer.add_attachment(0, 0, name, "application/octet-stream", data)
        except OSError as error:
            raise self._error(error) from None

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
        whole_chunks = self._output.end
        try:
            key = connection.topic, connection.msgtype, connection.msgdef
            channel = self._channels.get(key)
            if channel is None:
                channel = self._channels[key] = self._add_channel(connection)
            sequence = self._counts[channel] & 0xFFFFFFFF
            self._counts[channel] += 1
            published = time if sent is None else sent
            self._writer.add_message(channel, time, cast(bytes, data), published, sequence)
        except OSError as error:
            self._output.truncate(whole_chunks)  # So the summary still has room.
            self._is_full = True
            raise self._error(error) from None

    def _error(self, error: OSError, where: str = "") -> UserError:
        return UserError(f"{self._path}: cannot write the bag: {error.strerror}{where}")

    def _add_channel(self, connection: Connection) -> int:
        extra, definition = connection.ext, self._define(connection)
        form = extra.serialization_format if isinstance(extra, ConnectionExtRosbag2) else "ros1"
        form = form if form in ("ros1", *_SCHEMAS) else "cdr"
        key = connection.msgtype, definition
        if key not in self._schemas:
            self._schemas[key] = self._add_schema(connection.msgtype, definition, form)
        metadata = {}
        if isinstance(extra, ConnectionExtRosbag2) and extra.offered_qos_profiles:
            # A player then offers a latched topic to late subscribers, as the robot did.
            profiles = BytesIO()
            YAML(typ="safe", pure=True).dump([_profile(qos) for qos in extra.offered_qos_profiles], profiles)
            metadata["offered_qos_profiles"] = profiles.getvalue().decode()
        if connection.digest.startswith("RIHS"):
            metadata["topic_type_hash"] = connection.digest
        return self._writer.register_channel(connection.topic, form, self._schemas[key], metadata)

    def _add_schema(self, msgtype: str, definition: MessageDefinition, form: str) -> int:
        kind = {
            MessageDefinitionFormat.MSG: "ros1msg" if form == "ros1" else "ros2msg",
            MessageDefinitionFormat.IDL: "ros2idl",
            MessageDefinitionFormat.NONE: _SCHEMAS.get(form, ""),
        }[definition.format]
        name = msgtype.replace("/msg/", "/") if form == "ros1" else msgtype
        content = definition.data.encode("latin-1" if form in _SCHEMAS else "utf-8")
        return int(self._writer.register_schema(name, kind, content))


class _Output:
    """Stream that the mcap package writes to.

    Args:
        handle: descriptor of the file.
        known: bytes that the file has already. They are compared with the written bytes, not written again.
    """

    def __init__(self, handle: int, known: mmap | bytes = b"") -> None:
        self.handle, self.end = handle, 0
        self.known: mmap | bytes = known

    def tell(self) -> int:
        """Return the number of bytes written so far."""
        return self.end

    def write(self, data: bytes) -> None:
        """Append bytes to the file.

        Raises:
            ValueError: the known bytes differ, and not because the file ends there.
        """
        if self.known:
            known = self.known[self.end : self.end + len(data)]
            if known != data:
                is_cut = self.end + len(known) == len(self.known) or not any(
                    self.known[self.end + len(known) :]
                )
                if not (is_cut and data.startswith(known.rstrip(b"\0"))):
                    raise ValueError(f"it is damaged after byte {self.end}, or another program wrote it")
                self.truncate(self.end)
        if not self.known:
            write_all(self.handle, data)
        self.end += len(data)

    def truncate(self, size: int) -> None:
        """Keep the first bytes of the file. The next bytes are written after them."""
        os.ftruncate(self.handle, size)
        os.lseek(self.handle, size, os.SEEK_SET)
        self.known, self.end = b"", size


def _start(output: _Output, header: Header, compression: CompressionType) -> Writer:
    writer = Writer(cast(IO[Any], output), CHUNK_SIZE, compression, use_summary_offsets=False)
    writer.start(header.profile, header.library)
    return writer


def complete(path: Path) -> int:
    """Complete a bag of a killed process in place: keep its whole messages and write the index.

    Returns:
        Number of messages. 0: the bag was complete already.

    Raises:
        UserError: the file cannot be completed. It is unchanged.
    """
    try:
        handle = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
        try:
            lock_file(handle, f"{path}: another process is writing it")
            if os.fstat(handle).st_nlink > 1:
                raise UserError(f"{path}: cannot be completed: it has another name, too (a hard link)")
            return _resume(handle)
        finally:
            os.close(handle)
    except OSError as error:
        raise UserError(f"{path}: cannot be completed: {error.strerror}") from None
    except (ValueError, struct.error, McapError) as error:
        raise UserError(f"{path}: cannot be completed: {first_line(error) or 'it is damaged'}") from None


def _resume(handle: int) -> int:
    """Complete an unfinished file: write its messages again, from the first on.

    The same messages give the same bytes, so nothing is written before the end of the last whole chunk. Bytes
    that differ before it are damage.

    Returns:
        Number of messages. 0: the file was complete already.

    Raises:
        ValueError: another program wrote the file, or it is damaged before its end.
    """
    with mmap(handle, 0, access=ACCESS_READ) as data:
        if data[: len(MAGIC)] != MAGIC:
            raise ValueError("it is no MCAP file")
        if len(data) > len(MAGIC) and data[-len(MAGIC) :] == MAGIC:
            return 0
        _, size = RECORD.unpack_from(data, len(MAGIC))
        at = len(MAGIC) + RECORD.size
        header = Header.read(ReadDataStream(BytesIO(data[at : at + size])))
        chunk, is_whole = _read_chunk(data, at + size)
        compression = CompressionType.ZSTD if chunk and chunk.compression else CompressionType.NONE
        output = _Output(handle, data)
        writer = _start(output, header, compression)
        count, at = 0, -1
        while chunk and is_whole and output.known and output.end > at:
            at = output.end
            count += _add_records(writer, _content(chunk))
            chunk, is_whole = _read_chunk(data, output.end)
        # A last chunk that is not full stays in the writer, and ``finish`` writes it again.
        if output.known:
            rest = data[output.end : output.end + 1]
            if rest not in (b"", bytes([CHUNK]), bytes([DATA_END])) and any(data[output.end :]):
                raise ValueError(f"it is damaged after byte {output.end}")
            is_readable = chunk and not is_whole and not chunk.compression
            tail = _whole_records(chunk.data) if chunk and is_readable else b""
            output.truncate(output.end)
            count += _add_records(writer, tail)
        writer.finish()  # type: ignore[no-untyped-call]
    return count


def _read_chunk(data: mmap, at: int) -> tuple[Chunk | None, bool]:
    """Read the chunk at an offset. Return None if there is none, and whether it is complete."""
    try:
        opcode, length = RECORD.unpack_from(data, at)
        end = at + RECORD.size + length
        if opcode == CHUNK:
            return Chunk.read(ReadDataStream(BytesIO(data[at + RECORD.size : end]))), end <= len(data)
    except (struct.error, McapError):  # The file ends in the head of the chunk.
        pass
    return None, False


def _content(chunk: Chunk) -> bytes:
    """Unpack a chunk.

    Raises:
        ValueError: the chunk is damaged.
    """
    content, damage = unpack(chunk.compression, chunk.data, chunk.uncompressed_size, chunk.uncompressed_crc)
    if damage:
        raise ValueError(damage)
    return content


def _add_records(writer: Writer, content: bytes) -> int:
    """Add the records of a chunk to a writer. Return the number of messages."""
    count = 0
    for record in breakup_chunk(Chunk("", content, 0, 0, 0, len(content))):
        if isinstance(record, Schema):
            writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel):
            writer.register_channel(record.topic, record.message_encoding, record.schema_id, record.metadata)
        elif isinstance(record, Message):
            writer.add_message(
                record.channel_id, record.log_time, record.data, record.publish_time, record.sequence
            )
            count += 1
    return count


def _whole_records(content: bytes) -> bytes:
    """Return the whole records at the start of a chunk whose end is missing.

    Raises:
        ValueError: the bytes after them are no part of a record.
    """
    at = 0
    while at + RECORD.size <= len(content):
        opcode, length = RECORD.unpack_from(content, at)
        end = at + RECORD.size + length
        if opcode not in (SCHEMA, CHANNEL, MESSAGE):
            if any(content[at:]):  # A power cut leaves zeros.
                raise ValueError("a chunk is damaged")
            break
        if end > len(content):
            break
        at = end
    return content[:at]


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
