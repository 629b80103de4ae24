"""Scans of LiDAR packets in VelodyneScan and PandarScan messages.

A serialised message is read as an array. Deserialising up to 9,000 packets a second as objects is slow.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from bevviz.messages.decoders import SECOND
from bevviz.model.frame import I64, U8

MOST_PACKETS = 100_000


@dataclass(frozen=True, slots=True)
class ListMessage:
    """Beginning of a serialised message with a std_msgs/Header and a list."""

    order: Literal["<", ">"]  # byte order, as struct and numpy write it
    stamp: int  # of the header, nanoseconds
    frame_id: str
    count: int  # length that the list states
    at: int  # byte at which its first item begins


def read_list_message(
    data: bytes | memoryview, *, ros1: bool, alignment: int = 4, skipped: int = 0
) -> ListMessage:
    """Read the beginning of a message.

    Args:
        data: serialised message.
        ros1: whether ROS 1 serialised the message; otherwise it is CDR.
        alignment: bytes to which CDR aligns the field behind the header.
        skipped: bytes of the fields between the header and the list.

    Raises:
        ValueError: the data are no such message.
    """
    order: Literal["<", ">"] = "<" if ros1 or data[1:2] != b"\0" else ">"
    try:
        # Behind the encapsulation header of CDR, or the seq of ROS 1.
        sec, nanosec, length = struct.unpack_from(f"{order}III", data, 4)
        at = 16 + length
        frame_id = bytes(data[16:at]).rstrip(b"\0").decode()
        at += skipped + (0 if ros1 else -(at - 4) % alignment)
        (count,) = struct.unpack_from(f"{order}I", data, at)
    except (struct.error, UnicodeDecodeError) as error:
        raise ValueError(f"{len(data)} bytes end before the list of the message") from error
    return ListMessage(order, sec * SECOND + nanosec, frame_id, count, at + 4)


@dataclass(frozen=True, slots=True)
class ScanPackets:
    """Packets of one scan.

    Attributes:
        stamp: stamp of the header, nanoseconds.
        frame_id: frame of the header.
        received: (N,) time at which the driver received each packet, nanoseconds.
        data: (N, M) bytes of the packets, a view of the message. Shorter packets end with zeros.
        sizes: (N,) size of each packet in bytes.
        lost: number of packets that the message announces but does not hold.
    """

    stamp: int
    frame_id: str
    received: I64
    data: U8
    sizes: I64
    lost: int


def split(data: bytes | memoryview, size: int, *, sized: bool, ros1: bool) -> ScanPackets:
    """Split a message into its packets.

    The message has a header and a list of packets, each with a stamp and ``size`` bytes.

    Args:
        data: serialised message.
        size: bytes of the packet field.
        sized: whether a field with the number of used bytes follows each packet.
        ros1: whether ROS 1 serialised the message; otherwise it is CDR.

    Raises:
        ValueError: the data are no such message, or no packet is complete.
    """
    message = read_list_message(data, ros1=ros1)
    order, count, at = message.order, message.count, message.at
    if count > MOST_PACKETS:
        raise ValueError(f"a scan of {count} packets is not taken: {MOST_PACKETS} at most")
    names, formats = ["sec", "nanosec", "data"], [f"{order}u4", f"{order}u4", f"({size},)u1"]
    if sized:
        names, formats = [*names, "size"], [*formats, f"{order}u4"]
    packet = np.dtype({"names": names, "formats": formats})
    # CDR aligns the stamp of the next packet. The last packet has no padding behind it.
    step = packet.itemsize + (0 if ros1 else -packet.itemsize % 4)
    complete = min(count, max(0, (len(data) - at - packet.itemsize) // step + 1))
    if not complete:
        raise ValueError(f"none of the {count} packets is whole" if count else "there are no packets in it")
    rows = np.ndarray((complete,), packet, data, at, (step,))
    return ScanPackets(
        stamp=message.stamp,
        frame_id=message.frame_id,
        received=rows["sec"].astype(np.int64) * SECOND + rows["nanosec"],
        data=rows["data"],
        sizes=np.minimum(rows["size"], size).astype(np.int64) if sized else np.full(complete, size, np.int64),
        lost=count - complete,
    )


def encode_scan(
    frame_id: str, received: Sequence[int], packets: Sequence[bytes], size: int, *, sized: bool
) -> bytes:
    """Serialise a scan as CDR, as ``split`` reads it. Its stamp is the time of its first packet.

    Args:
        frame_id: frame of the header.
        received: nanoseconds of each packet.
        packets: the packets, of ``size`` bytes or fewer.
        size: bytes of the packet field.
        sized: whether a field with the number of used bytes follows each packet.
    """
    name = frame_id.encode() + b"\0"
    head = struct.pack("<4sIII", b"\0\1\0\0", *divmod(received[0], SECOND), len(name)) + name
    parts = [head + bytes(-len(head) % 4), struct.pack("<I", len(packets))]
    for time, packet in zip(received, packets, strict=True):
        used = struct.pack("<I", len(packet)) if sized else b""
        data = struct.pack("<II", *divmod(time, SECOND)) + packet.ljust(size, b"\0") + used
        parts.append(data + bytes(-len(data) % 4))
    return b"".join(parts)
