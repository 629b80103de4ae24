"""Readers of bags that are not bevviz's. From a damaged bag, bevviz must read at least what they read."""

from __future__ import annotations

import io
import re
import shutil
import sqlite3
import struct
import subprocess
from bz2 import BZ2Decompressor
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import rosbag  # type: ignore[import-untyped]
import rosbags.rosbag1
import rosbags.rosbag2
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message
from mcap.stream_reader import StreamReader

Found = tuple[str, int, bytes]
"""Topic, log time and serialised message."""

Judge = Callable[[Path], Iterator[Found]]

STEP = 32  # compressed bytes that a decompressor gets at once; what it made of the last ones is lost


def taken(judge: Judge, path: Path) -> list[Found]:
    """Return the messages that a reader yields before it fails. Ignore the exception that it raises."""
    found: list[Found] = []
    try:
        for item in judge(path):
            found.append(item)  # noqa: PERF402  # what came before an exception counts
    except Exception:
        pass
    return found


# --- MCAP --------------------------------------------------------------------------------------


def mcap_stream(path: Path) -> Iterator[Found]:
    """Read with the mcap package from front to back. Of a damaged chunk, yield the part before the damage."""
    channels: dict[int, Channel] = {}
    with path.open("rb") as file:
        for record in StreamReader(file, emit_chunks=True, record_size_limit=1 << 28).records:
            yield from _records(record, channels)


def _records(record: Any, channels: dict[int, Channel]) -> Iterator[Found]:
    inner: Iterable[Any] = _opened(record) if isinstance(record, Chunk) else [record]
    for item in inner:
        if isinstance(item, Channel):
            channels.setdefault(item.id, item)
        elif isinstance(item, Message) and item.channel_id in channels:
            yield channels[item.channel_id].topic, item.log_time, item.data


def _opened(chunk: Chunk) -> Iterator[Any]:
    """Yield the records of a chunk up to the first one that is damaged or cut.

    The zstandard and lz4 packages unpack it a few bytes at a time: each gives the blocks before the damage.
    A wrong checksum is no reason to give nothing, for wrong messages count for nobody.
    """
    content = chunk.data
    if chunk.compression == "zstd":
        content = _streamed(zstandard.ZstdDecompressor().decompressobj(), chunk.data)
    elif chunk.compression == "lz4":
        content = _streamed(lz4.frame.LZ4FrameDecompressor(), chunk.data)
    elif chunk.compression:
        return
    at = 0
    while at + 9 <= len(content):
        opcode, length = struct.unpack_from("<BQ", content, at)
        at += 9 + length
        if at > len(content):
            return
        record = ReadDataStream(io.BytesIO(content[at - length : at]))
        if opcode == 4:
            yield Channel.read(record)
        elif opcode == 5:
            yield Message.read(record, length)


def _streamed(stream: Any, packed: bytes) -> bytes:
    """Return what a decompressor gives until it raises an error or has reached the end."""
    content = bytearray()
    with suppress(Exception):  # each library has errors of its own
        for at in range(0, len(packed), STEP):
            content += stream.decompress(packed[at : at + STEP])
    return bytes(content)


def mcap_index(path: Path) -> Iterator[Found]:
    """Read with the mcap package by the index."""
    with path.open("rb") as file:
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False):
            yield channel.topic, message.log_time, message.data


def mcap_resync(path: Path) -> Iterator[Found]:
    """Try every offset that looks like the head of a record, with the parser of the mcap package.

    A chunk that the end of the file cuts off is read as far as it goes.
    """
    data = path.read_bytes()
    channels: dict[int, Channel] = {}
    late: list[Message] = []
    at, head = 8, re.compile(rb"[\x01-\x0f].{4}\0{4}", re.DOTALL)
    while at + 9 < len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        end = at + 9 + length
        if 0 < opcode < 16 and (end <= len(data) or opcode == 6):
            stream = ReadDataStream(io.BytesIO(data[at + 9 : end]))
            try:
                if opcode == 4:
                    channel = Channel.read(stream)
                    channels.setdefault(channel.id, channel)
                elif opcode == 5:
                    message = Message.read(stream, length)
                    if message.channel_id in channels:
                        yield channels[message.channel_id].topic, message.log_time, message.data
                    else:
                        late.append(message)
                elif opcode == 6:
                    yield from _records(Chunk.read(stream), channels)
                at = end
                continue
            except Exception:
                pass
        following = head.search(data, at + 1)
        if following is None:
            break
        at = following.start()
    for message in late:
        if message.channel_id in channels:
            yield channels[message.channel_id].topic, message.log_time, message.data


def rosbags2(path: Path) -> Iterator[Found]:
    with rosbags.rosbag2.Reader(path) as reader:
        for connection, time, data in reader.messages():
            yield connection.topic, time, data


# --- sqlite3 -----------------------------------------------------------------------------------

QUERY = "SELECT name, timestamp, data FROM messages {} JOIN topics ON topic_id = topics.id ORDER BY {}"


def sqlite(path: Path) -> Iterator[Found]:
    """sqlite3 itself, log and all, from both ends of the table."""
    copy = path.with_name("copy")
    copy.mkdir()
    try:
        for suffix in ("", "-wal"):
            if Path(f"{path}{suffix}").exists():
                shutil.copy(f"{path}{suffix}", copy / f"bag.db3{suffix}")
        seen: set[Found] = set()
        for order in ("messages.id", "messages.id DESC", "timestamp"):
            rows = _queried(copy / "bag.db3", QUERY.format("NOT INDEXED" * (order != "timestamp"), order))
            for row in taken(lambda _, rows=rows: rows, path):  # type: ignore[misc]
                if row not in seen:
                    seen.add(row)
                    yield row
    finally:
        shutil.rmtree(copy)


def _queried(path: Path, query: str) -> Iterator[Found]:
    with closing(sqlite3.connect(path)) as connection:
        for name, time, data in connection.execute(query):
            yield str(name), int(time), bytes(data)


def sqlite_recover(path: Path) -> Iterator[Found]:
    """Recover with ``.recover`` of the sqlite3 command line, if that has it (Debian's has not)."""
    program = shutil.which("sqlite3")
    if program is None:
        return
    copy = path.with_name("recovered")
    copy.mkdir()
    try:
        for suffix in ("", "-wal"):
            if Path(f"{path}{suffix}").exists():
                shutil.copy(f"{path}{suffix}", copy / f"bag.db3{suffix}")
        found = copy / "found.db3"
        script = subprocess.run([program, copy / "bag.db3", ".recover"], capture_output=True, check=False)
        subprocess.run([program, found], input=script.stdout, capture_output=True, check=False)
        yield from _queried(found, QUERY.format("", "messages.id"))
    finally:
        shutil.rmtree(copy)


# --- ROS 1 -------------------------------------------------------------------------------------


def rosbags1(path: Path) -> Iterator[Found]:
    with rosbags.rosbag1.Reader(path) as reader:
        for connection, time, data in reader.messages():
            yield connection.topic, time, data


def rosbag_original(path: Path) -> Iterator[Found]:
    """ROS 1's own library, which indexes anew what has no index."""
    copy = path.with_name("reindexed.bag")
    shutil.copy(path, copy)
    try:
        try:
            bag = rosbag.Bag(str(copy))
        except rosbag.ROSBagUnindexedException:
            bag = rosbag.Bag(str(copy), "a", allow_unindexed=True)
            for _ in bag.reindex():
                pass
            bag.close()
            bag = rosbag.Bag(str(copy))
        with closing(bag):
            for topic, raw, time in bag.read_messages(raw=True):
                yield topic, time.to_nsec(), raw[1]
    finally:
        copy.unlink()


def ros1_resync(path: Path) -> Iterator[Found]:
    """Try every offset that looks like the head of a record."""
    yield from _ros1_records(path.read_bytes(), 13, {})


def _ros1_records(data: bytes, at: int, topics: dict[int, str]) -> Iterator[Found]:
    while at + 8 < len(data):
        record = _ros1_record(data, at)
        if record is None:
            mark = data.find(b"op=", at + 5)
            starts = range(max(at + 1, mark - 120), mark - 7)
            at = next((s for s in reversed(starts) if _ros1_record(data, s)), mark if mark > 0 else len(data))
            continue
        fields, body, end = record
        opcode = fields[b"op"][0]
        if opcode == 7 and b"topic" in fields:
            topics.setdefault(int.from_bytes(fields[b"conn"], "little"), fields[b"topic"].decode())
        elif opcode == 2:
            number = int.from_bytes(fields[b"conn"], "little")
            if number in topics:
                sec, nsec = struct.unpack("<II", fields[b"time"])
                yield topics[number], sec * 10**9 + nsec, data[body:end]
        elif opcode == 5:
            yield from _ros1_records(_ros1_content(fields[b"compression"], data[body:end]), 0, topics)
        at = end


def _ros1_record(data: bytes, at: int) -> tuple[dict[bytes, bytes], int, int] | None:
    size = int.from_bytes(data[at : at + 4], "little")
    if not 8 <= size < 4096:
        return None
    fields, place, stop = {}, at + 4, at + 4 + size
    while place < stop:
        length = int.from_bytes(data[place : place + 4], "little")
        name, equals, value = data[place + 4 : place + 4 + length].partition(b"=")
        place += 4 + length
        if not equals:
            return None
        fields[name] = value
    length = int.from_bytes(data[stop : stop + 4], "little")
    end = stop + 4 + length
    if place != stop or len(fields.get(b"op", b"")) != 1 or (end > len(data) and fields[b"op"] != b"\x05"):
        return None
    if fields[b"op"] == b"\x02" and (len(fields.get(b"conn", b"")), len(fields.get(b"time", b""))) != (4, 8):
        return None
    return fields, stop + 4, min(end, len(data))


def _ros1_content(compression: bytes, packed: bytes) -> bytes:
    if compression == b"bz2":
        return _streamed(BZ2Decompressor(), packed)
    if compression == b"lz4":
        return _streamed(lz4.frame.LZ4FrameDecompressor(), packed)
    return packed


# --- packed files and messages -----------------------------------------------------------------


def unpacked(judge: Judge) -> Judge:
    """Make a judge of zstd files: it reads as much of the file as the zstandard package unpacks."""

    def read(path: Path) -> Iterator[Found]:
        target = path.with_name("unpacked") / path.stem
        target.parent.mkdir()
        try:
            with target.open("wb") as out, path.open("rb") as file:
                stream = zstandard.ZstdDecompressor().decompressobj(read_across_frames=True)
                try:
                    while block := file.read(1 << 10):
                        out.write(stream.decompress(block))
                except zstandard.ZstdError:
                    pass
            yield from judge(target)
        finally:
            shutil.rmtree(target.parent)

    return read


def messages_unpacked(judge: Judge) -> Judge:
    """Make a judge that unpacks each message with the zstandard package and skips it if that fails."""

    def read(path: Path) -> Iterator[Found]:
        for topic, time, data in taken(judge, path):
            try:
                yield topic, time, zstandard.ZstdDecompressor().decompress(data)
            except zstandard.ZstdError:
                continue

    return read


def judges(name: str) -> dict[str, Judge]:
    """Those that can read a format."""
    found: dict[str, Judge]
    if "mcap" in name:
        found = {
            "mcap": mcap_stream,
            "mcap, by the index": mcap_index,
            "mcap, resyncing": mcap_resync,
            "rosbags": rosbags2,
        }
    elif name.startswith("ros1"):
        found = {"rosbags": rosbags1, "rosbag": rosbag_original, "ROS 1, resyncing": ros1_resync}
    else:
        found = {"sqlite3": sqlite, "sqlite3 .recover": sqlite_recover, "rosbags": rosbags2}
    if "messages packed" in name:
        return {key: messages_unpacked(judge) for key, judge in found.items()}
    return {key: unpacked(judge) for key, judge in found.items()} if ".zstd" in name else found
