"""Packets and metadata of an Ouster as its manual defines them, and bags of them."""

from __future__ import annotations

import json
import struct
from math import cos, pi, radians, sin
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import get_types_from_msg

from tests.support import bags

PIXELS, COLUMNS, PACKETS = 16, 64, 4  # of a scan, in packets of 16 columns
KIND = "ouster_sensor_msgs/msg/PacketMsg"
LIDAR, IMU, METADATA = "/ouster/lidar_packets", "/ouster/imu_packets", "/ouster/metadata"
ALTITUDES = [15.0 - 2 * i for i in range(PIXELS)]
AZIMUTHS = [(-4.2, -1.4, 1.4, 4.2)[i % 4] for i in range(PIXELS)]
ORIGIN = 15.8


def metadata(profile: str, nested: bool = True) -> str:
    beams = {
        "beam_altitude_angles": ALTITUDES,
        "beam_azimuth_angles": AZIMUTHS,
        "lidar_origin_to_beam_origin_mm": ORIGIN,
    }
    form = {
        "columns_per_frame": COLUMNS,
        "columns_per_packet": COLUMNS // PACKETS,
        "pixels_per_column": PIXELS,
        "udp_profile_lidar": profile,
    }
    return json.dumps(
        {"beam_intrinsics": beams, "lidar_data_format": form} if nested else {**beams, "data_format": form}
    )


def millimetres(column: int, pixel: int) -> int:
    """Return a range of about 10 m in steps of 8 mm. Every seventh column of a pixel met nothing."""
    return 0 if (column + pixel) % 7 == 0 else 8 * (1250 + column + 3 * pixel)


def measured(profile: str, far: int, pixel: int) -> bytes:
    if profile == "LEGACY":
        return struct.pack("<IHHHH", far, 40 + pixel, 500 + pixel, 7, 0)
    if profile == "RNG15_RFL8_NIR8":
        return struct.pack("<HBB", far // 8 | 0x8000, 40 + pixel, 7)
    if profile.endswith("DUAL"):
        return struct.pack("<IIHHHH", far | (40 + pixel) << 24, 99, 500 + pixel, 1, 7, 0)
    return struct.pack("<IHHHH", far | 0x80000, 40 + pixel, 500 + pixel, 7, 0)


def packet(profile: str, scan: int, number: int, clock: int) -> bytes:
    legacy = profile == "LEGACY"
    data = b"" if legacy else struct.pack("<HH", 1, scan) + bytes(28)
    for column in range(number * 16, number * 16 + 16):
        data += struct.pack("<QH", clock + 1_000_000 * column, column)
        data += struct.pack("<HI", scan, 0) if legacy else struct.pack("<H", 1)
        data += b"".join(measured(profile, millimetres(column, p), p) for p in range(PIXELS))
        data += b"\xff\xff\xff\xff" if legacy else b""
    return data + (b"" if legacy else bytes(32))


def expected_point(column: int, pixel: int) -> tuple[float, float, float]:
    """Compute the position of a pixel by the formula of the manual."""
    around = 2 * pi * (1 - column / COLUMNS)
    turn, tilt = around - radians(AZIMUTHS[pixel]), radians(ALTITUDES[pixel])
    far = millimetres(column, pixel) - ORIGIN
    x = far * cos(turn) * cos(tilt) + ORIGIN * cos(around)
    y = far * sin(turn) * cos(tilt) + ORIGIN * sin(around)
    return x / 1000, y / 1000, far * sin(tilt) / 1000


def bag(
    path: Path,
    profile: str = "RNG15_RFL8_NIR8",
    *,
    told: str | None = None,
    scans: int = 4,
    form: str = "mcap",
    clock: int = bags.START,
    order: tuple[int, ...] = (),
) -> Path:
    """Write scans of 64 ms each, 100 ms apart; ``order`` puts all packets out of the order of their time."""
    made = bags.Messages(form == "ros1")
    made.store.register(get_types_from_msg("uint8[] buf\n", KIND))

    def held(data: bytes) -> Any:
        return made.make(KIND, buf=np.frombuffer(data, np.uint8))

    items = []
    if told is not None:
        text = made.make("std_msgs/msg/String", data=told)
        items.append(bags.Item(METADATA, "std_msgs/msg/String", bags.START - 1, text))
    for place, number in enumerate(order or range(scans * PACKETS)):
        scan, part = divmod(number, PACKETS)
        at = bags.START + place // PACKETS * bags.PERIOD + (place % PACKETS + 1) * 16_000_000
        data = packet(profile, scan + 65534 & 0xFFFF, part, clock + scan * bags.PERIOD)
        items.append(bags.Item(LIDAR, KIND, at, held(data)))
        items.append(bags.Item(IMU, KIND, at, held(bytes(48))))
    return bags.write(path, items, made, form=form)
