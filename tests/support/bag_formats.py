"""Sound bags in every format and compression that is read, small enough to be damaged by the thousand."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import zstandard
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from tests.support import bags

SCANS, POINTS = 40, 150  # 161 messages
CHUNK_SIZE = 40_000  # bytes
ONE_CHUNK = 1 << 30  # bytes, more than a sample has

Item = tuple[str, str, int, bytes]
"""Topic, type, log time and serialised message."""


@cache
def items(ros1: bool) -> tuple[Item, ...]:
    """Return a drive of four seconds in order of log time."""
    messages = bags.Messages(ros1)
    serialize = messages.store.serialize_ros1 if ros1 else messages.store.serialize_cdr
    found = sorted(bags.small_items(messages, SCANS, POINTS), key=lambda item: item.received)
    return tuple((i.topic, i.type, i.received, bytes(serialize(i.message, i.type))) for i in found)


def written_once(write: Callable[[Path], Path]) -> Callable[[Path], Path]:
    """Return a function that writes the same files into each folder. Only the first call makes the bag."""

    @cache
    def made() -> tuple[dict[Path, bytes], Path]:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            path = write(folder).relative_to(folder)
            files = (file for file in folder.rglob("*") if file.is_file())
            return {file.relative_to(folder): file.read_bytes() for file in files}, path

    def copy(folder: Path) -> Path:
        files, path = made()
        for name, data in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(data)
        return folder / path

    return copy


def rosbag2(plugin: StoragePlugin, mode: CompressionMode | None = None) -> Callable[[Path], Path]:
    """Return a function that writes a bag with rosbags and returns its one file."""

    def write(folder: Path) -> Path:
        store = bags.Messages().store
        writer = Writer(folder / "bag", version=9, storage_plugin=plugin)
        if mode is not None:
            writer.set_compression(mode, CompressionFormat.ZSTD)
        with writer:
            topics = {}
            for topic, kind, time, data in items(ros1=False):
                if topic not in topics:
                    topics[topic] = writer.add_connection(topic, kind, typestore=store)
                writer.write(topics[topic], time, data)
        return next(file for file in (folder / "bag").iterdir() if file.name != "metadata.yaml")

    return write


def mcap(
    compression: CompressionType, *, chunked: bool = True, crc: bool = True, chunk_size: int = CHUNK_SIZE
) -> Callable[[Path], Path]:
    """Return a function that writes a file of several chunks with the mcap package."""

    def write(folder: Path) -> Path:
        store = bags.Messages().store
        path = folder / "bag.mcap"
        with path.open("wb") as file:
            writer = McapWriter(
                file,
                chunk_size=chunk_size,
                compression=compression,
                use_chunking=chunked,
                enable_crcs=crc,
            )
            writer.start("ros2")
            channels: dict[str, int] = {}
            for topic, kind, time, data in items(ros1=False):
                if topic not in channels:
                    text, _ = store.generate_msgdef(kind, ros_version=2)
                    schema = writer.register_schema(kind, "ros2msg", text.encode())
                    channels[topic] = writer.register_channel(topic, "cdr", schema)
                writer.add_message(channels[topic], time, data, time)
            writer.finish()  # type: ignore[no-untyped-call]
        return path

    return write


def packed(write: Callable[[Path], Path]) -> Callable[[Path], Path]:
    """Return a function that packs the written file as one zstd file of several frames.

    A recorder that packs while it records leaves such a file.
    """

    def pack(folder: Path) -> Path:
        path = write(folder)
        data, target = path.read_bytes(), path.with_name(f"{path.name}.zstd")
        compressor = zstandard.ZstdCompressor()
        parts = [compressor.compress(data[at : at + 200_000]) for at in range(0, len(data), 200_000)]
        target.write_bytes(b"".join(parts))
        path.unlink()
        return target

    return pack


def ros1(compression: str = "", chunk_size: int = CHUNK_SIZE) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        store = bags.Messages(ros1=True).store
        writer = Writer1(folder / "bag.bag")
        writer.chunk_threshold = chunk_size
        if compression:
            writer.set_compression(Writer1.CompressionFormat[compression.upper()])
        with writer:
            topics = {}
            for topic, kind, time, data in items(ros1=True):
                if topic not in topics:
                    topics[topic] = writer.add_connection(topic, kind, typestore=store)
                writer.write(topics[topic], time, data)
        return folder / "bag.bag"

    return write


def unclosed(folder: Path) -> Path:
    """Write a sqlite3 bag whose recorder was killed: two fifths of the messages are in the log beside it."""
    whole = rosbag2(StoragePlugin.SQLITE3)(folder)
    path = folder / "bag.db3"
    with sqlite3.connect(whole) as source, sqlite3.connect(path) as target:
        source.backup(target)
        rows = target.execute("SELECT * FROM messages ORDER BY id").fetchall()
        first = len(rows) * 3 // 5
        target.execute("DELETE FROM messages WHERE id > ?", (rows[first - 1][0],))
        target.commit()
        target.execute("VACUUM")
        target.execute("PRAGMA journal_mode=WAL")
        target.execute("PRAGMA wal_autocheckpoint=0")
        for row in rows[first:]:
            target.execute(f"INSERT INTO messages VALUES ({','.join('?' * len(row))})", row)
            target.commit()
        for suffix in ("", "-wal"):  # as they are while it is open
            shutil.copy(f"{path}{suffix}", f"{path}{suffix}.copy")
    source.close()
    target.close()
    for suffix in ("", "-wal"):
        Path(f"{path}{suffix}.copy").replace(f"{path}{suffix}")
    path.with_name("bag.db3-shm").unlink(missing_ok=True)
    return path


NONE, LZ4, ZSTD = CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD
MCAP, SQLITE = StoragePlugin.MCAP, StoragePlugin.SQLITE3
WRITERS: dict[str, Callable[[Path], Path]] = {
    "mcap": mcap(NONE),
    "mcap, no checksums": mcap(NONE, crc=False),
    "mcap, lz4": mcap(LZ4),
    "mcap, zstd": mcap(ZSTD),
    "mcap, zstd, no checksums": mcap(ZSTD, crc=False),
    "mcap, flat": mcap(NONE, chunked=False),
    "mcap, one chunk": rosbag2(MCAP),
    "mcap, one lz4 chunk": mcap(LZ4, chunk_size=ONE_CHUNK),
    "mcap, one zstd chunk": rosbag2(MCAP, CompressionMode.STORAGE),
    "mcap, messages packed": rosbag2(MCAP, CompressionMode.MESSAGE),
    "mcap.zstd": rosbag2(MCAP, CompressionMode.FILE),
    "mcap.zstd, several frames": packed(mcap(NONE)),
    "sqlite3": rosbag2(SQLITE),
    "sqlite3, messages packed": rosbag2(SQLITE, CompressionMode.MESSAGE),
    "sqlite3, with a log": unclosed,
    "db3.zstd": rosbag2(SQLITE, CompressionMode.FILE),
    "ros1": ros1(),
    "ros1, bz2": ros1("bz2"),
    "ros1, lz4": ros1("lz4"),
    "ros1, one lz4 chunk": ros1("lz4", ONE_CHUNK),
}
FORMATS = {name: written_once(write) for name, write in WRITERS.items()}
