"""A robot of a LiDAR and three nodes that pass on objects, each late by the time that it works.

    /lidar -> /detector (30 ms) -> /tracker (10 ms) -> /planner (10 ms)

The tracker drops the last object of each fifth frame. Each node has a context of its own, as in a robot.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[2]
PERIOD = 0.1  # seconds
LIDAR = "/points"
NODES = {"detector": 0.03, "tracker": 0.01, "planner": 0.01}  # seconds of work
TOPICS = {node: f"/{node}/objects" for node in NODES}
PLACES = np.array([[8.0, -4, 0], [15, 3, 0], [25, 0, 0]], np.float32)
DROPPED = 2  # row of ``PLACES`` that the tracker drops in each fifth frame


@contextmanager
def chained_robot() -> Iterator[None]:
    """Run the robot in its own process."""
    command = [sys.executable, "-m", "tests.support.chained_robot"]
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE) as process:
        try:
            yield
        finally:
            process.terminate()


def main() -> None:
    """Publish until the process is ended."""
    import rclpy
    from sensor_msgs.msg import PointCloud2

    from bevviz.live.typesupport import message_type
    from bevviz.messages.definitions import typestore
    from bevviz.messages.encode import encode_boxes_3d
    from bevviz.model.frame import Boxes3D
    from tests.support.faulty_robot import Publication, make_message

    kind = "vision_msgs/msg/Detection3DArray"

    def publisher(node: str, message: Any, topic: str) -> Any:
        context = rclpy.Context()
        rclpy.init(context=context)
        return rclpy.create_node(node, context=context).create_publisher(message, topic, 5)

    lidar = publisher("lidar", PointCloud2, LIDAR)
    outputs = {node: publisher(node, message_type(kind), TOPICS[node]) for node in NODES}
    number, due = 0, time.monotonic()
    while True:
        due += PERIOD
        time.sleep(max(0.0, due - time.monotonic()))
        stamp, number = time.time_ns(), number + 1
        lidar.publish(make_message(Publication(LIDAR, "PointCloud2"), stamp))
        centers = PLACES + np.array([0, 0.3 * np.sin(number / 7), 0], np.float32)
        for node, seconds in NODES.items():
            time.sleep(seconds)
            if node == "tracker" and number % 5 == 0:
                centers = centers[:DROPPED]
            sizes = np.tile(np.array([4, 2, 1.5], np.float32), (len(centers), 1))
            boxes = Boxes3D(centers, sizes, np.zeros(len(centers), np.float32))
            message = encode_boxes_3d(stamp, "lidar", boxes, [[("car", 0.9)]] * len(centers))
            outputs[node].publish(bytes(typestore().serialize_cdr(message, kind)))


if __name__ == "__main__":
    main()
