"""Scans of a LiDAR's packets as its driver recorded them, VelodyneScan and PandarScan, as a PointCloud2.

The serialised message is read as an array: as objects its packets, up to 9,000 a second, would be slow.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from bevviz.drivers import hesai, velodyne
from bevviz.errors import UserError
from bevviz.model.frame import I64, U8

VELODYNE = re.compile(r"velodyne_msgs/(msg/)?VelodyneScan$")
PANDAR = re.compile(r"pandar_msgs/(msg/)?PandarScan$")
MOST_PACKETS = 100_000
SECOND = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Packets:
    """What a driver recorded of one scan.

    Attributes:
        stamp: of the header, nanoseconds.
        received: (N,) when each packet was, nanoseconds.
        data: (N, M) bytes of each, a view of the message; of shorter ones the rest is zero.
        sizes: (N,) bytes that each packet has.
        lost: packets that the message announces and does not hold.
    """

    stamp: int
    frame_id: str
    received: I64
    data: U8
    sizes: I64
    lost: int


def is_packets(msgtype: str) -> bool:
    """Whether a message of that type is read here."""
    return PANDAR.search(msgtype) is not None or (
        VELODYNE.search(msgtype) is not None and find_spec("velodyne_decoder") is not None
    )


def lacks(msgtype: str) -> str:
    """What is to be installed for messages of that type, and why; empty: nothing."""
    if VELODYNE.search(msgtype) and not is_packets(msgtype):
        return "packets of the sensor, which velodyne-decoder reads: pip install 'bevviz[velodyne]'"
    return ""


def read_scan(data: bytes | memoryview, msgtype: str, *, ros1: bool, calibration: str = "") -> Any:
    """The sensor_msgs/PointCloud2 that a serialised scan stands for, see ``velodyne`` and ``hesai``.

    Args:
        data: as serialised by ROS 1, or as CDR.
        msgtype: the message's type.
        ros1: how it is serialised.
        calibration: path of the sensor's own angles, where they are known.

    Raises:
        ValueError: no such message, or packets of a model that is not decoded.
        UserError: the file of angles cannot be read.
    """
    if VELODYNE.search(msgtype):
        if calibration:
            raise UserError(
                f"source.lidar_calibration: {calibration}: a Velodyne has none: its packets tell its model"
            )
        return velodyne.decode(split(data, 1206, sized=False, ros1=ros1))
    packets = split(data, 1500, sized=True, ros1=ros1)
    return hesai.decode(packets, Path(calibration) if calibration else None)


def split(data: bytes | memoryview, size: int, *, sized: bool, ros1: bool) -> Packets:
    """The packets of a message that is a header and a list of packets with a stamp and ``size`` bytes each.

    ``sized``: how many of them are the packet's follows.

    Raises:
        ValueError: no such message, or none of its packets is whole.
    """
    order = "<" if ros1 or data[1:2] != b"\0" else ">"
    try:
        sec, nanosec, length = struct.unpack_from(f"{order}III", data, 4)  # behind the encoding, or the seq
        frame_id = bytes(data[16 : 16 + length]).rstrip(b"\0").decode()
        at = 16 + length
        at += 0 if ros1 else -at % 4
        (count,) = struct.unpack_from(f"{order}I", data, at)
    except (struct.error, UnicodeDecodeError) as error:
        raise ValueError(f"{len(data)} bytes are no scan of packets") from error
    at += 4
    if count > MOST_PACKETS:
        raise ValueError(f"a scan of {count} packets is not taken: {MOST_PACKETS} at most")
    names, formats = ["sec", "nanosec", "data"], [f"{order}u4", f"{order}u4", f"({size},)u1"]
    if sized:
        names, formats = [*names, "size"], [*formats, f"{order}u4"]
    packet = np.dtype({"names": names, "formats": formats})
    # CDR aligns the stamp of the next one, and nothing behind the last.
    step = packet.itemsize + (0 if ros1 else -packet.itemsize % 4)
    there = min(count, max(0, (len(data) - at - packet.itemsize) // step + 1))
    if not there:
        raise ValueError(f"none of the {count} packets is whole" if count else "there are no packets in it")
    rows = np.ndarray((there,), packet, data, at, (step,))
    return Packets(
        stamp=sec * SECOND + nanosec,
        frame_id=frame_id,
        received=rows["sec"].astype(np.int64) * SECOND + rows["nanosec"],
        data=rows["data"],
        sizes=np.minimum(rows["size"], size).astype(np.int64) if sized else np.full(there, size, np.int64),
        lost=count - there,
    )
