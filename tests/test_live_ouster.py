"""An Ouster on a real graph: packets byte by byte as its manual has them, and metadata that come later."""

from __future__ import annotations

import struct
import time
from collections.abc import Iterator

import numpy as np
import pytest

from bevviz.config import load
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
from tests.support.ros_graphs import own_graph
from tests.support.waiting import until

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'bevviz[ros]'")

from bevviz.live.node import Node
from bevviz.live.source import LiveSource
from bevviz.live.typesupport import message_type

PROFILE = "RNG19_RFL8_SIG16_NIR16"
THERE = [(c, p) for c in range(COLUMNS) for p in range(PIXELS) if millimetres(c, p)]


@pytest.fixture
def graph() -> Iterator[None]:
    with own_graph():
        yield


def test_scans_wait_for_metadata_and_end_with_the_next_scan(graph: None) -> None:
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from std_msgs.msg import String

    said: list[str] = []
    with Node(name="os_driver") as robot, LiveSource(load(), tell=said.append) as source:
        robot.start()
        kind = message_type(KIND)
        lidar, imu = (robot.node.create_publisher(kind, t, 100) for t in (LIDAR, IMU))
        number = 0
        clocks = dict[int, int]()

        def send(data: bytes, to: object = lidar) -> None:
            to.publish(b"\0\1\0\0" + struct.pack("<I", len(data)) + data)  # type: ignore[attr-defined]

        def scan(without: int = -1) -> bool:
            nonlocal number
            number += 1
            clocks[number] = time.time_ns()
            for part in set(range(PACKETS)) - {without}:
                send(packet(PROFILE, number, part, clocks[number]))
            send(bytes(48), imu)
            return True

        waiting = f"{LIDAR} holds packets of an Ouster whose metadata are waited for on {METADATA}"
        until(lambda: scan() and waiting in source.missing, "what is waited for")
        assert not source.received[LIDAR] and not source.wait(0)

        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        robot.node.create_publisher(String, METADATA, latched).publish(String(data=metadata(PROFILE)))
        until(lambda: scan() and source.wait(0), "a scene")
        assert source.roles.lidar_names == ("os_lidar",)
        assert source.roles.notes[METADATA] == "metadata of the LiDAR"
        assert source.roles.notes[IMU] == "not used: packets of an Ouster's IMU"

        frames = iter(source)
        scan()
        whole = next(frame for frame in frames if frame.stamp == clocks[number])
        np.testing.assert_allclose(whole.points, [place(*beam) for beam in THERE], atol=1e-5)
        assert whole.clouds[0].dropped == COLUMNS * PIXELS - len(THERE)

        scan(without=1)  # ends when the next one begins
        cut = number
        scan()
        frame = next(frame for frame in frames if frame.stamp == clocks[cut])
        left = [place(*beam) for beam in THERE if beam[0] // 16 != 1]
        np.testing.assert_allclose(frame.points, left, atol=1e-5)

        send(bytes(5000))
        wrong = f"a message cannot be used: {LIDAR}: a packet of 5000 bytes, but the sensor"
        until(lambda: any(line.startswith(wrong) for line in said), "a packet of another size")
