"""Decoder for packets of Ouster's LiDARs, by the layouts in their manuals and the sensor's metadata.

The library ouster-sdk 1.0 cannot be installed beside bevviz: it requires psutil below 6, rerun-sdk 0.41 at
least 7, and it pins rosbags to 0.9.23. benchmarks/ouster.py compares this decoder with it.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from bevviz.errors import UserError
from bevviz.messages.clouds import make_cloud
from bevviz.messages.decoders import Bytes, Decoder, PacketStream, Scan
from bevviz.model.frame import F32, U8, Cloud

FRAME = "os_lidar"  # frame of the clouds that Ouster's driver publishes
SMALLEST = 1000  # bytes; packets of the IMU have 48
MINUTE = 60_000_000_000
ReceivedPacket = tuple[int, bytes | memoryview]  # time of receipt in nanoseconds, and the bytes
POINT = np.dtype(
    [(n, "<f4") for n in ("x", "y", "z", "intensity", "time")] + [("reflectivity", "<u2"), ("ring", "<u2")]
)


@dataclass(frozen=True, slots=True)
class Profile:
    """Packet layout. Offsets and sizes are in bytes; numbers are little-endian.

    Attributes:
        head: size of the packet header.
        column: size of the column header.
        status: type and offset of the column status; a negative offset counts from the end of the column.
        valid: status bits that are set in a valid column.
        number: offset of the scan number in the packet.
        measured: size of a measurement.
        mask: bits of the distance in the first 32 bits of a measurement.
        scale: unit of the distance in millimetres.
        reflectivity: offset of the reflectivity in a measurement.
        signal: offset of the intensity in a measurement; None: the reflectivity is used.
        foot: size of the packet footer.
        after: size of the column footer.
    """

    head: int
    column: int
    status: tuple[str, int]
    valid: int
    number: int
    measured: int
    mask: int
    scale: float
    reflectivity: int
    signal: int | None
    foot: int
    after: int


_NEW: dict[str, Any] = {
    "head": 32, "column": 12, "status": ("<u2", 10), "valid": 1, "number": 2, "foot": 32, "after": 0
}  # fmt: skip
PROFILES = {
    "LEGACY": Profile(0, 16, ("<u4", -4), 0xFFFFFFFF, 10, 12, 0xFFFFF, 1.0, 4, 6, 0, 4),
    "RNG19_RFL8_SIG16_NIR16": Profile(**_NEW, measured=12, mask=0x7FFFF, scale=1.0, reflectivity=4, signal=6),
    "RNG19_RFL8_SIG16_NIR16_DUAL": Profile(
        **_NEW, measured=16, mask=0x7FFFF, scale=1.0, reflectivity=3, signal=8
    ),
    "RNG15_RFL8_NIR8": Profile(**_NEW, measured=4, mask=0x7FFF, scale=8.0, reflectivity=2, signal=None),
}


@dataclass(frozen=True, slots=True, eq=False)
class Sensor:
    """Properties of a sensor, from its metadata.

    Attributes:
        profile: layout of its packets.
        columns: number of columns in a full turn.
        per_packet: number of columns in a packet.
        sent: number of packets in a complete scan; smaller if the sensor measures only a part of the turn.
        directions: (pixels, 2) altitude and azimuth of the beams, radians.
        origin: (2,) start of the beams: metres from the axis, and metres above the sensor's origin.
    """

    profile: Profile
    columns: int
    per_packet: int
    sent: int
    directions: F32
    origin: F32

    @property
    def pixels(self) -> int:
        """Number of beams."""
        return len(self.directions)

    @property
    def step(self) -> int:
        """Size of a column in bytes."""
        return self.profile.column + self.pixels * self.profile.measured + self.profile.after

    @property
    def size(self) -> int:
        """Size of a packet in bytes."""
        return self.profile.head + self.per_packet * self.step + self.profile.foot

    def number(self, packet: bytes | memoryview) -> int:
        """Return the scan number of a packet."""
        at = self.profile.number
        return int.from_bytes(packet[at : at + 2], "little")

    def begin(self, packet: bytes | memoryview) -> int:
        """Return the number of the first column of a packet."""
        at = self.profile.head + 8
        return int.from_bytes(packet[at : at + 2], "little")


class OusterDecoder:
    """Decoder of the packets of one sensor; see ``bevviz.messages.decoders.ScanDecoder``.

    A scan is complete with its last packet. If packets are lost, it ends when the next scan begins. Late and
    repeated packets are discarded.
    """

    frame_id = FRAME

    def __init__(self, sensor: Sensor) -> None:
        self.sensor = sensor
        self._current = -1
        self._finished: deque[int] = deque(maxlen=2)  # numbers of the previous scans
        self._packets: dict[int, ReceivedPacket] = {}  # packets of the current scan by their first column

    def add(self, received: int, data: Bytes, *, ros1: bool) -> Iterator[Scan]:
        """Add a serialised PacketMsg. Yield each scan that ends with it.

        Args:
            received: time of receipt, nanoseconds.
            data: the message.
            ros1: whether ROS 1 serialised it; otherwise it is CDR.

        Raises:
            ValueError: the packet is not of the sensor that the metadata describe.
        """
        packet = payload(data, ros1=ros1)
        if len(packet) != self.sensor.size:
            raise ValueError(
                f"a packet of {len(packet)} bytes, but the sensor that its metadata are of sends packets of "
                f"{self.sensor.size}"
            )
        number, begin = self.sensor.number(packet), self.sensor.begin(packet)
        if number in self._finished or begin >= self.sensor.columns:
            return
        if number != self._current:
            yield from self.rest()
            self._current = number
        self._packets.setdefault(begin, (received, packet))
        if len(self._packets) == self.sensor.sent:
            yield from self.rest()

    def rest(self) -> Iterator[Scan]:
        """Yield the incomplete scan. Its further packets are then too late."""
        if self._packets:
            packets, self._packets = tuple(self._packets.values()), {}
            self._finished.append(self._current)
            self._current = -1
            yield Scan(packets[-1][0], partial(decode, self.sensor, packets))


def open_decoder(text: str, where: str) -> OusterDecoder:
    """Return the decoder for the packets of the sensor that a text describes; see ``read_sensor``."""
    return OusterDecoder(read_sensor(text, where))


def metadata_topic(topic: str) -> str:
    """Return the topic of the metadata (std_msgs/String), for a topic of packets."""
    return f"{topic.rpartition('/')[0]}/metadata"


def read_sensor(text: str, where: str) -> Sensor:
    """Parse a sensor's metadata (JSON, firmware 2 and 3).

    Args:
        text: the metadata.
        where: file or topic of the metadata, for errors.

    Raises:
        UserError: the text is no metadata, or the packets of the sensor are not supported.
    """
    try:
        metadata = json.loads(text)
        beams = metadata.get("beam_intrinsics", metadata)
        data_format = metadata.get("lidar_data_format") or metadata.get("data_format") or {}
        profile = str(data_format.get("udp_profile_lidar", "LEGACY"))
        mode = str(metadata.get("lidar_mode") or metadata.get("config_params", {}).get("lidar_mode", ""))
        columns = int(data_format.get("columns_per_frame") or mode.partition("x")[0])
        angles = [beams["beam_altitude_angles"], beams["beam_azimuth_angles"]]
        directions = np.deg2rad(np.array(angles, np.float64)).T
        transform = np.array(beams.get("beam_to_lidar_transform") or np.eye(4), np.float64).reshape(4, 4)
        origin = transform[[0, 2], 3]
        if "beam_to_lidar_transform" not in beams:
            origin = np.array([float(beams["lidar_origin_to_beam_origin_mm"]), 0.0])
        per_packet = int(data_format.get("columns_per_packet", 16))
        first, last = data_format.get("column_window") or (0, columns - 1)
        if directions.ndim != 2 or not len(directions) or not 0 < per_packet <= columns <= 1 << 14:
            raise ValueError
        measured = (int(first) + np.arange((int(last) - int(first)) % columns + 1)) % columns
    except (ValueError, KeyError, TypeError, AttributeError):
        raise UserError(f"{where}: is not the metadata (JSON) of an Ouster") from None
    if profile not in PROFILES:
        raise UserError(
            f"{where}: an Ouster with packets of the profile {profile}, which is not decoded here "
            f"({', '.join(PROFILES)} are): play them through its driver and record its PointCloud2"
        )
    return Sensor(
        PROFILES[profile],
        columns,
        per_packet,
        len(np.unique(measured // per_packet)),
        directions.astype(np.float32),
        (origin * 1e-3).astype(np.float32),
    )


def payload(data: Bytes, *, ros1: bool) -> memoryview:
    """Return the packet of a serialised PacketMsg. Its bytes are the only field of the message."""
    at = 0 if ros1 else 4
    big = not ros1 and data[1:2] == b"\0"
    length = int.from_bytes(data[at : at + 4], "big" if big else "little")
    return memoryview(data)[at + 4 : at + 4 + length]


def decode(sensor: Sensor, packets: Sequence[ReceivedPacket]) -> Cloud:
    """Decode the packets of one scan into a cloud in the frame os_lidar.

    The stamp is that of the first column, by the sensor's clock if this is within a minute of the time of
    receipt. Otherwise the clock counts from the sensor's start, and the stamp is the time at which the packet
    of the column was received. ``time`` is in seconds after the stamp. Of two returns the first one is used.
    All measurements of a full turn without a return count as dropped, also those in lost packets.

    Args:
        sensor: sensor that sent the packets.
        packets: packets of ``sensor.size`` bytes each.
    """
    received, contents = zip(*packets, strict=True)
    profile, pixels = sensor.profile, sensor.pixels
    kind, at = profile.status
    measured = np.dtype(
        {
            "names": ["range", "reflectivity", "signal"],
            "formats": ["<u4", "u1", "u1" if profile.signal is None else "<u2"],
            "offsets": [0, profile.reflectivity, profile.signal or profile.reflectivity],
            "itemsize": profile.measured,
        }
    )
    column = np.dtype(
        {
            "names": ["clock", "number", "status", "measured"],
            "formats": ["<u8", "<u2", kind, (measured, (pixels,))],
            "offsets": [0, 8, at % sensor.step, profile.column],
            "itemsize": sensor.step,
        }
    )
    data: U8 = np.frombuffer(b"".join(contents), np.uint8).reshape(len(packets), sensor.size)
    shape, steps = (len(packets), sensor.per_packet), (sensor.size, sensor.step)
    columns = np.ndarray(shape, column, data, profile.head, steps).reshape(-1)
    usable = (columns["status"] & profile.valid == profile.valid) & (columns["number"] < sensor.columns)
    rows = np.flatnonzero(usable)
    columns = columns[usable]
    stamp, times = int(received[0]), np.zeros(len(columns))
    if len(columns):
        clock = columns["clock"].astype(np.int64)
        times = (clock - clock[0]) * 1e-9
        first = int(received[rows[0] // sensor.per_packet])
        stamp = int(clock[0]) if abs(int(clock[0]) - first) < MINUTE else first
    ranges = (columns["measured"]["range"] & profile.mask) * np.float32(profile.scale * 1e-3)
    row, pixel = np.nonzero(ranges)
    encoder = 2 * np.pi * (1 - columns["number"] / sensor.columns)
    altitude, azimuth = sensor.directions.T
    out, up = sensor.origin
    angle = encoder[row] - azimuth[pixel]
    # The range includes the distance from the axis to the start of the beam, which turns around the axis.
    length = ranges[row, pixel] - np.hypot(out, up)
    flat = length * np.cos(altitude)[pixel]
    points = np.empty(len(row), POINT)
    points["x"] = flat * np.cos(angle) + out * np.cos(encoder)[row]
    points["y"] = flat * np.sin(angle) + out * np.sin(encoder)[row]
    points["z"] = length * np.sin(altitude)[pixel] + up
    points["reflectivity"] = columns["measured"]["reflectivity"][row, pixel]
    points["intensity"] = columns["measured"]["signal"][row, pixel]
    points["ring"] = pixel
    points["time"] = times[row]
    return make_cloud(stamp, FRAME, points, sensor.columns * pixels)


_TYPES = tuple(f"{package}/msg/PacketMsg" for package in ("ouster_sensor_msgs", "ouster_msgs", "ouster_ros"))
DEFINITIONS = dict.fromkeys(_TYPES, "uint8[] buf\n")
PACKETS = PacketStream("an Ouster", open_decoder, metadata_topic, SMALLEST)
DECODER = Decoder(types=_TYPES, kind="PointCloud2", definitions=DEFINITIONS, packets=PACKETS)
