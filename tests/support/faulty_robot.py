"""A robot for tests that is made of rclpy alone. Its topics fall silent, vanish and change on command.

It runs in a process of its own and reads commands as JSON, one a line. A command sets fields of a topic:
``{"topic": "/points", "kind": "PointCloud2"}``. See ``Publication`` for the fields.
"""

from __future__ import annotations

import json
import select
import subprocess
import sys
import time
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bevviz.messages.definitions import typestore
from bevviz.messages.encode import encode_transforms

ROOT = Path(__file__).parents[2]
PERIOD = 0.1  # seconds


@dataclass
class Publication:
    """Messages of one topic."""

    topic: str
    kind: str = ""  # PointCloud2, Image, TFMessage or String; empty: the publisher is destroyed
    frame: str = "lidar"
    silent: bool = False
    node: str = "robot"
    ahead: float = 0.0  # seconds that the stamps are ahead of the clock
    points: str = ""  # "none" or "NaN"; empty: those of the ground
    every: int = 1  # periods between two messages


class FaultyRobot:
    """Handle of the process."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def set(self, topic: str, **fields: Any) -> None:
        """Change a topic, and wait until the change is made."""
        assert self._process.stdin is not None and self._process.stdout is not None
        print(json.dumps({"topic": topic, **fields}), file=self._process.stdin, flush=True)
        assert self._process.stdout.readline() == "done\n"


@contextmanager
def faulty_robot() -> Iterator[FaultyRobot]:
    """Run a robot in its own process, at first without topics."""
    command = [sys.executable, "-m", "tests.support.faulty_robot"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe, text=True) as process:
        try:
            yield FaultyRobot(process)
        finally:
            process.terminate()


def main() -> None:
    """Publish what the commands say, until the end of the standard input."""
    import rclpy
    from rclpy.qos import QoSProfile

    nodes: dict[str, Any] = {}
    publications: dict[tuple[str, str], tuple[Publication, Any]] = {}
    due, number = time.monotonic(), 0
    while True:
        ready, _, _ = select.select([sys.stdin], [], [], max(0.0, due - time.monotonic()))
        if ready:
            if not (line := sys.stdin.readline()):
                return
            change = json.loads(line)
            key = change["topic"], change.get("node", "robot")
            publication, publisher = publications.get(key, (Publication(*key[:1]), None))
            before = publication.kind
            for name, value in change.items():
                setattr(publication, name, value)
            if publication.node not in nodes:
                # A context of its own, because a process can have one type on a name only.
                context = rclpy.Context()
                rclpy.init(context=context)
                nodes[publication.node] = rclpy.create_node(publication.node, context=context)
            node = nodes[publication.node]
            if publication.kind != before:
                if publisher is not None:
                    node.destroy_publisher(publisher)
                publisher = None
                if publication.kind:
                    publisher = node.create_publisher(
                        _type(publication.kind), publication.topic, QoSProfile(depth=5)
                    )
            publications[key] = publication, publisher
            print("done", flush=True)
        if time.monotonic() < due:
            continue
        due, number = due + PERIOD, number + 1
        for publication, publisher in publications.values():
            if publisher is not None and not publication.silent and number % publication.every == 0:
                publisher.publish(make_message(publication, time.time_ns()))


def _type(kind: str) -> Any:
    from sensor_msgs.msg import Image, PointCloud2
    from std_msgs.msg import String

    from bevviz.live.typesupport import message_type

    if kind == "TFMessage":  # no wheel has it
        return message_type("tf2_msgs/msg/TFMessage")
    return {"PointCloud2": PointCloud2, "Image": Image, "String": String}[kind]


def make_message(publication: Publication, stamp: int) -> Any:
    """Return a message of a publication with a stamp in nanoseconds, before ``ahead`` is added."""
    stamp += round(publication.ahead * 1e9)
    if publication.kind == "TFMessage":
        message = encode_transforms(stamp, [("odom", publication.frame, np.eye(4))])
        return bytes(typestore().serialize_cdr(message, "tf2_msgs/msg/TFMessage"))
    message = _type(publication.kind)()
    if publication.kind == "String":
        message.data = "not a cloud"
        return message
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
    message.header.frame_id = publication.frame
    if publication.kind == "Image":
        message.height, message.width, message.encoding, message.step = 36, 64, "bgr8", 192
        message.data = array("B", bytes(36 * 192))
        return message
    from sensor_msgs.msg import PointField

    ground = np.mgrid[-15:15:0.5, -15:15:0.5, -1.8:-1.7:1].reshape(3, -1).T
    points = ground.astype(np.float32)
    if publication.points == "NaN":
        points[:] = np.nan
    elif publication.points == "none":
        points = points[:0]
    message.height, message.width, message.point_step = 1, len(points), 12
    message.row_step = 12 * len(points)
    message.fields = [
        PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1)
        for i, name in enumerate("xyz")
    ]
    message.data = array("B", points.tobytes())
    return message


if __name__ == "__main__":
    main()
