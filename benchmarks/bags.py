"""The bag that whole runs are timed on: a short drive, repeated until it has the size that is wanted."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from tqdm import tqdm

from bevviz.extras.demo.bag import write_bag
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.messages.definitions import typestore

SECOND = 1_000_000_000


def simulate(frames: int, path: Path) -> Path:
    """Write the synthetic drive as a bag."""
    source = SyntheticSource(frames=frames)
    write_bag(source, path, tqdm(source, total=source.total, unit="scan", desc="simulate", disable=None))
    return path


def clouds(bag: Path) -> list[Any]:
    """Every PointCloud2 of a bag, deserialised."""
    with AnyReader([bag]) as reader:
        wanted = [c for c in reader.connections if c.msgtype.endswith("PointCloud2")]
        return [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(wanted)]


def repeat(bag: Path, folder: Path, size: int) -> Path:
    """Write a bag of ``size`` bytes: repeat the messages of another bag with stamps that continue."""
    times = -(-size // bag.stat().st_size)
    store = typestore()
    with (
        AnyReader([bag], default_typestore=store) as reader,
        Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer,
    ):
        length = reader.duration // (SECOND // 10) * (SECOND // 10) + SECOND // 10
        topics = {
            c.id: writer.add_connection(c.topic, c.msgtype, typestore=store) for c in reader.connections
        }
        messages = [(c, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()]
        for _ in tqdm(range(times), unit="drive", desc="repeat", disable=None):
            for c, received, message in messages:
                writer.write(topics[c.id], received, store.serialize_cdr(message, c.msgtype))
            messages = [(c, t + length, _later(message, length)) for c, t, message in messages]
    return next(folder.glob("*.mcap"))


def _later(message: Any, by: int) -> Any:
    """Shift the stamps of a message by ``by`` nanoseconds, in place, and return the message."""
    headers: Iterable[Any] = [t.header for t in getattr(message, "transforms", ())] or [message.header]
    for header in headers:
        stamp = header.stamp.sec * SECOND + header.stamp.nanosec + by
        header.stamp.sec, header.stamp.nanosec = divmod(stamp, SECOND)
    return message
