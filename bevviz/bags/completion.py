"""Completion of an MCAP file that a killed process or a full disk left without its end, in place."""

from __future__ import annotations

import os
import struct
from functools import partial
from io import BytesIO
from mmap import ACCESS_READ, mmap
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any, cast

import mcap.writer
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, Header, Message, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import CompressionType, Writer

from bevviz.bags.compression import unpack
from bevviz.bags.mcap import CHANNEL, CHUNK, DATA_END, MAGIC, MESSAGE, RECORD, SCHEMA
from bevviz.errors import UserError, first_line
from bevviz.support.files import lock_file, write_all

CHUNK_SIZE = 1 << 22  # bytes at which a chunk is closed

# The writer's own level 3 makes no smaller file of point clouds and images, in three times the time.
_fast = partial(mcap.writer.zstandard.compress, level=1)  # type: ignore[attr-defined]
mcap.writer.zstandard = SimpleNamespace(compress=_fast)  # type: ignore[assignment,attr-defined]


class McapOutput:
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


def start_writer(output: McapOutput, header: Header, compression: CompressionType) -> Writer:
    """Begin a file."""
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
            return resume(handle)
        finally:
            os.close(handle)
    except OSError as error:
        raise UserError(f"{path}: cannot be completed: {error.strerror}") from None
    except (ValueError, struct.error, McapError) as error:
        raise UserError(f"{path}: cannot be completed: {first_line(error) or 'it is damaged'}") from None


def resume(handle: int) -> int:
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
        output = McapOutput(handle, data)
        writer = start_writer(output, header, compression)
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
