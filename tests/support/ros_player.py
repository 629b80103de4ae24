"""A robot for tests: plays the synthetic drive over DDS, in a process of its own, until it is terminated.

Run with a JSON object of ``Play``'s fields as its argument.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from bevviz.live.typesupport import message_type
from bevviz.messages.definitions import typestore
from bevviz.synthetic import SyntheticSource
from bevviz.synthetic.bag import TOPICS, messages, mounting
from bevviz.synthetic.drive import CAMERA_INFO_TOPIC, IMAGE_TOPIC, LIDAR_TOPIC, PERIOD, START

SENSORS = (LIDAR_TOPIC, IMAGE_TOPIC, CAMERA_INFO_TOPIC)


@dataclass(frozen=True)
class Play:
    frames: int = 10  # of the drive, played in a loop with stamps that go on
    rate: float = 10.0  # scans a second
    name: str = "player"
    best_effort: bool = False  # the sensors' publishers
    latched: bool = True  # /tf_static
    focal: float = 1.0  # factor on the focal length
    points: int = 0  # of each cloud, repeated or cut; 0: as they are
    without: tuple[str, ...] = ()  # topics that are not published

    def arguments(self) -> list[str]:
        return [sys.executable, "-m", "tests.support.ros_player", json.dumps(asdict(self))]


def main(play: Play) -> None:
    import rclpy
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

    source = SyntheticSource(frames=play.frames)
    drive = [_serialised(source, play, index) for index in range(play.frames)]
    rclpy.init()
    node = rclpy.create_node(play.name)
    publishers: dict[str, Any] = {}
    for topic in TOPICS.keys() - set(play.without):
        qos = QoSProfile(depth=10)
        if topic in SENSORS and play.best_effort:
            qos.reliability = ReliabilityPolicy.BEST_EFFORT
        if topic == "/tf_static" and play.latched:
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        publishers[topic] = node.create_publisher(message_type(TOPICS[topic]), topic, qos)
    if "/tf_static" in publishers:
        publishers["/tf_static"].publish(_bytes("/tf_static", mounting(source)))
    print("playing", flush=True)
    start, shift, count = time.monotonic(), time.time_ns() - START, 0
    while rclpy.ok():
        index = count % play.frames
        for topic, offset, message in drive[index]:
            due = start + (count * PERIOD * 1e-9 + offset) * 10.0 / play.rate
            time.sleep(max(0.0, due - time.monotonic()))
            if topic in publishers and rclpy.ok():
                moved = shift + (count - index) * PERIOD
                publishers[topic].publish(_bytes(topic, _shifted(message, moved)))
        count += 1
    node.destroy_node()


def _serialised(source: SyntheticSource, play: Play, index: int) -> list[tuple[str, float, Any]]:
    """Topic, seconds after the scan and message."""
    frame = source.snapshot(index).frame
    cloud = frame.clouds[0]
    if play.points:
        rows = np.resize(np.arange(len(cloud.xyz)), play.points)
        fields = {name: values[rows] for name, values in cloud.fields.items()}
        frame = replace(frame, clouds=(replace(cloud, xyz=cloud.xyz[rows], fields=fields),))
    camera = frame.cameras[0]
    assert camera.intrinsics is not None
    K = (
        camera.intrinsics.K * np.array([[play.focal], [play.focal], [1.0]])
        if play.focal != 1
        else camera.intrinsics.K
    )
    frame = replace(frame, cameras=(replace(camera, intrinsics=replace(camera.intrinsics, K=K)),))
    return [(topic, (at - frame.stamp) * 1e-9, message) for topic, at, message in messages(source, frame)]


def _bytes(topic: str, message: Any) -> bytes:
    return bytes(typestore().serialize_cdr(message, TOPICS[topic]))


def _shifted(message: Any, nanoseconds: int) -> Any:
    """Return the message with its stamps shifted."""
    headers = [t.header for t in message.transforms] if hasattr(message, "transforms") else [message.header]
    moved = [_moved(header, nanoseconds) for header in headers]
    if hasattr(message, "transforms"):
        transforms = [replace(t, header=h) for t, h in zip(message.transforms, moved, strict=True)]
        return replace(message, transforms=transforms)
    return replace(message, header=moved[0])


def _moved(header: Any, nanoseconds: int) -> Any:
    stamp = header.stamp.sec * 10**9 + header.stamp.nanosec + nanoseconds
    return replace(header, stamp=replace(header.stamp, sec=stamp // 10**9, nanosec=stamp % 10**9))


if __name__ == "__main__":
    main(Play(**json.loads(sys.argv[1])))
