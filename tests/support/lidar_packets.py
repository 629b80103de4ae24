"""Packets of Hesai's and Velodyne's LiDARs as their manuals define them, in messages."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from rosbags.typesys import get_types_from_msg

from bevviz.extras.lidars.hesai import MODELS, Model
from tests.support import bags

SCAN, PACKET = "pandar_msgs/msg/PandarScan", "pandar_msgs/msg/PandarPacket"
VELODYNE = "velodyne_msgs/msg/VelodyneScan"
MODELS_BY_NAME = {model.name: model for model in MODELS}


# Of each model: its size, its header, the bytes behind the blocks, and where among these the return mode and
# the microseconds are.
LAYOUTS = {
    "Pandar40P": (1262, b"", 22, 14, 10),
    "Pandar64": (1194, bytes([0xEE, 0xFF, 64, 6, 0, 4, 0, 0]), 22, 14, 10),
    "PandarQT64": (1072, bytes([0xEE, 0xFF, 3, 1, 0, 0, 64, 4, 1, 4, 2, 1]), 28, 16, 12),
    "PandarQT128": (1127, bytes([0xEE, 0xFF, 3, 2, 3, 0, 128, 2, 1, 4, 2, 29]), 87, 33, 42),
    "PandarXT16": (568, bytes([0xEE, 0xFF, 6, 1, 0, 0, 16, 8, 1, 4, 2, 1]), 28, 10, 19),
    "PandarXT32": (1080, bytes([0xEE, 0xFF, 6, 1, 0, 0, 32, 8, 1, 4, 2, 1]), 28, 10, 19),
    "PandarXT32M": (820, bytes([0xEE, 0xFF, 6, 1, 0, 0, 32, 6, 1, 5, 3, 1]), 28, 10, 19),
}


def packet(model: Model, number: int, *, mode: int = 0x37) -> bytes:
    """Each block a degree on, each beam 1,000 units away and 10 more a channel; the third met nothing."""
    size, header, tail, at_mode, at_clock = LAYOUTS[model.name]
    body = b""
    for block in range(model.blocks):
        body += b"\xff\xee" if model.name == "Pandar40P" else b""
        body += struct.pack("<H", 100 * (block + 10 * number))
        for channel in range(model.channels):
            far = 0 if channel == 2 else 1000 + 10 * channel + (block % 2) * (channel % 2)
            body += struct.pack("<HB", far, channel) + bytes(model.unit - 3)
    end = bytearray(tail)
    end[at_mode] = mode
    end[at_clock : at_clock + 4] = struct.pack("<I", (999_900 + 1000 * number) % 1_000_000)
    made = header + body + bytes(end)
    assert len(made) == size
    return made


def messages(ros1: bool = False) -> bags.Messages:
    made = bags.Messages(ros1)
    stamp = "time" if ros1 else "builtin_interfaces/Time"
    texts = {
        PACKET: f"{stamp} stamp\nuint8[1500] data\nuint32 size\n",
        SCAN: "std_msgs/Header header\npandar_msgs/PandarPacket[] packets\n",
        "velodyne_msgs/msg/VelodynePacket": f"{stamp} stamp\nuint8[1206] data\n",
        VELODYNE: "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets\n",
    }
    for kind, text in texts.items():
        made.store.register(get_types_from_msg(text, kind))
    return made


def scan(made: bags.Messages, stamp: int, found: list[bytes], kind: str = SCAN, frame: str = "lidar") -> Any:
    rows = []
    for number, data in enumerate(found):
        time = made.header(stamp + 1_000_000 * number, "").stamp
        size = 1500 if kind == SCAN else 1206
        held = np.frombuffer(data.ljust(size, b"\0"), np.uint8)
        more = {"size": len(data)} if kind == SCAN else {}
        rows.append(made.make(kind.replace("Scan", "Packet"), stamp=time, data=held, **more))
    return made.make(kind, header=made.header(stamp, frame), packets=rows)
