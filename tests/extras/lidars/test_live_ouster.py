"""An Ouster beside a live run: packets byte by byte as its manual has them, and metadata that come later."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from bevviz.messages.definitions import typestore
from tests.support.ouster_packets import (
    COLUMNS,
    IMU,
    KIND,
    LIDAR,
    METADATA,
    PACKETS,
    PIXELS,
    metadata,
    millimetres,
    packet,
)
from tests.support.ouster_packets import expected_point as place

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'bevviz[ros]'")

from tests.support.fed_graph import Endpoint, fed_graph, joined

STRING = "std_msgs/msg/String"
PROFILE = "RNG19_RFL8_SIG16_NIR16"
THERE = [(c, p) for c in range(COLUMNS) for p in range(PIXELS) if millimetres(c, p)]


def test_scans_wait_for_metadata_and_end_with_the_next_scan() -> None:
    with fed_graph() as graph:
        lidar, imu = (graph.advertise(topic, KIND) for topic in (LIDAR, IMU))
        number = 0

        def send(data: bytes, to: Endpoint = lidar) -> None:
            graph.publish(to, b"\0\1\0\0" + struct.pack("<I", len(data)) + data)

        def scan(without: int = -1) -> int:
            nonlocal number
            number += 1
            stamp = graph.time_ns()
            for part in set(range(PACKETS)) - {without}:
                send(packet(PROFILE, number, part, stamp))
            send(bytes(48), imu)
            graph.advance(0.1)
            return stamp

        with joined(graph) as session:
            source = session.source
            for _ in range(10):
                scan()
            waiting = f"{LIDAR} holds packets of an Ouster whose metadata are waited for on {METADATA}"
            assert waiting in source.missing and not source.watch.received[LIDAR]

            described = graph.advertise(METADATA, STRING)
            graph.advance(0.5)
            graph.publish(described, typestore().types[STRING](data=metadata(PROFILE)))
            for _ in range(20):
                scan()
            assert source.roles.lidar_names == ("os_lidar",)
            assert source.roles.notes[METADATA] == "metadata of the LiDAR"
            assert source.roles.notes[IMU] == "not used: packets of an Ouster's IMU"

            whole = scan()
            cut = scan(without=1)  # ends when the next one begins
            scan()
            by_stamp = {frame.stamp: frame for frame in session.frames}
            np.testing.assert_allclose(by_stamp[whole].points, [place(*beam) for beam in THERE], atol=1e-5)
            assert by_stamp[whole].clouds[0].dropped == COLUMNS * PIXELS - len(THERE)
            left = [place(*beam) for beam in THERE if beam[0] // 16 != 1]
            np.testing.assert_allclose(by_stamp[cut].points, left, atol=1e-5)

            send(bytes(5000))
            wrong = f"a message cannot be used: {LIDAR}: a packet of 5000 bytes, but the sensor"
            assert session.said[-1].startswith(wrong)
