"""A robot for tests that plays recorded messages over DDS, in a process of its own, until it is terminated.

Of the package it uses only what rclpy needs for types without a wheel. It reads a pickled ``Drive`` from its
standard input.
"""

from __future__ import annotations

import pickle
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

from bevviz.live.typesupport import message_type
from bevviz.messages.definitions import typestore

PERIOD = 100_000_000  # nanoseconds between two scans
SENSORS = ("PointCloud2", "Image", "CameraInfo")


@dataclass(frozen=True)
class Play:
    frames: int = 3  # of the drive, played in a loop with stamps that go on
    rate: float = 10.0  # scans a second
    name: str = "player"
    best_effort: bool = False  # the sensors' publishers
    latched: bool = True  # /tf_static
    focal: float = 1.0  # factor on the focal length
    points: int = 5000  # of each cloud, repeated or cut
    without: tuple[str, ...] = ()  # topics that are not published


@dataclass(frozen=True)
class Drive:
    """Messages with stamps that begin at 0: the mounting, and those of each frame with their delays."""

    play: Play
    types: Mapping[str, str]  # by topic
    static: bytes  # of /tf_static
    frames: Sequence[Sequence[tuple[float, str, bytes]]]  # seconds after the scan, topic, message

    @property
    def topics(self) -> list[str]:
        return [topic for topic in self.types if topic not in self.play.without]

    def quality(self, topic: str) -> Any:
        """Return the quality of service of a topic's publisher."""
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        qos = QoSProfile(depth=10)
        if self.play.best_effort and self.types[topic].endswith(SENSORS):
            qos.reliability = ReliabilityPolicy.BEST_EFFORT
        if self.play.latched and topic == "/tf_static":
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        return qos

    def schedule(self, begin: int) -> Iterator[tuple[float, str, bytes]]:
        """Yield seconds since the begin, topic and message, without end. ``begin`` is the first stamp."""
        yield 0.0, "/tf_static", self.static
        for number in count():
            shift = begin + (number - number % len(self.frames)) * PERIOD
            for offset, topic, data in self.frames[number % len(self.frames)]:
                due = (number * PERIOD * 1e-9 + offset) * 10.0 / self.play.rate
                yield due, topic, self._shifted(topic, data, shift)

    def _shifted(self, topic: str, data: bytes, nanoseconds: int) -> bytes:
        kind = self.types[topic]
        message = shifted(typestore().deserialize_cdr(data, kind), nanoseconds)
        return bytes(typestore().serialize_cdr(message, kind))


def shifted(message: Any, nanoseconds: int) -> Any:
    """Return a message with its stamps shifted."""
    if hasattr(message, "transforms"):
        return replace(message, transforms=[shifted(one, nanoseconds) for one in message.transforms])
    stamp = message.header.stamp
    total = stamp.sec * 10**9 + stamp.nanosec + nanoseconds
    stamp = replace(stamp, sec=total // 10**9, nanosec=total % 10**9)
    return replace(message, header=replace(message.header, stamp=stamp))


def main(drive: Drive) -> None:
    import rclpy

    rclpy.init()
    node = rclpy.create_node(drive.play.name)
    publishers = {
        topic: node.create_publisher(message_type(drive.types[topic]), topic, drive.quality(topic))
        for topic in drive.topics
    }
    print("playing", flush=True)
    start = time.monotonic()
    for due, topic, data in drive.schedule(time.time_ns()):
        time.sleep(max(0.0, start + due - time.monotonic()))
        if not rclpy.ok():
            break
        if topic in publishers:
            publishers[topic].publish(data)
    node.destroy_node()


if __name__ == "__main__":
    sys.modules["tests.support.ros_player"] = sys.modules["__main__"]  # the name in the pickle
    main(pickle.load(sys.stdin.buffer))
