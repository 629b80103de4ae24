"""Clouds and images between two processes of one machine: Fast DDS as it comes, and with profiles.

A publisher and a subscriber of rclpy, without bevviz: 120,000 points (1.9 MB), an image of 640 x 360 (0.7 MB)
and one of 1280 x 720 (2.8 MB) at 10 Hz. Prints, for each side that has ros/config/fastdds.xml, how long
messages take from their stamp to the middleware having them whole, and how many never came.
"""

from __future__ import annotations

import argparse
import array
import json
import os
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.measure import machine

PROFILE = Path(__file__).parents[1] / "ros" / "config" / "fastdds.xml"
POINTS, RATE = 120_000, 10.0
IMAGES = {"/small": (640, 360), "/large": (1280, 720)}
CLOUD = "/points"
MEETING = 2.0  # seconds in which the two find each other
FIRST = 10  # messages that are left out: the two have just met
SIDES = {"nobody": (), "receiver": ("receive",), "publisher": ("publish",), "both": ("publish", "receive")}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=8.0, help="of each run (default: 8)")
    parser.add_argument("--turns", type=int, default=2, help="runs of each case, in turns (default: 2)")
    parser.add_argument("--domain", type=int, default=45, help="ROS domain that nobody else uses")
    parser.add_argument("--part", choices=("publish", "receive"), help=argparse.SUPPRESS)
    parser.add_argument("--best-effort", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.part is not None:
        part = publish if options.part == "publish" else receive
        part(options.seconds, options.best_effort)
        return 0
    print(machine())
    cases = [(side, best) for best in (False, True) for side in SIDES] * options.turns
    print("quality, who has the profile: p50, p99, missing, of each topic")
    for side, best in tqdm(cases, unit="run", disable=None):
        found = exchange(options, SIDES[side], best)
        tqdm.write(f"{'best effort' if best else 'reliable'}, {side}: {'; '.join(found)}")
    return 0


def exchange(options: argparse.Namespace, profiled: tuple[str, ...], best: bool) -> list[str]:
    """One run of two processes, in words by topic."""
    env = {name: value for name, value in os.environ.items() if name != "FASTRTPS_DEFAULT_PROFILES_FILE"}
    env |= {"ROS_DOMAIN_ID": str(options.domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}

    def start(part: str, seconds: float) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "benchmarks.transport", "--part", part, f"--seconds={seconds}"]
        given = {"FASTRTPS_DEFAULT_PROFILES_FILE": str(PROFILE)} if part in profiled else {}
        command += ["--best-effort"] if best else []
        return subprocess.Popen(command, env=env | given, stdout=subprocess.PIPE, text=True)

    with start("receive", options.seconds) as receiver:
        assert receiver.stdout is not None and receiver.stdout.readline() == "ready\n"
        with start("publish", options.seconds + MEETING) as publisher:
            sent = json.loads(publisher.communicate()[0])
        found: dict[str, list[tuple[int, int]]] = json.loads(receiver.communicate()[0])
    return [described(topic, sent, found.get(topic, [])) for topic in (CLOUD, *IMAGES)]


def described(topic: str, sent: list[int], found: list[tuple[int, int]]) -> str:
    """Latency and losses of a topic: stamps that were sent, and stamps with their times of receipt."""
    if len(found) <= FIRST:
        return f"{topic} {len(found)} of {len(sent)} came"
    taken = np.array([1e-6 * (received - stamp) for stamp, received in found[FIRST:]])
    expected = [stamp for stamp in sent if found[FIRST][0] <= stamp <= found[-1][0]]
    p50, p99 = np.percentile(taken, (50, 99))
    return f"{topic} {p50:.0f}, {p99:.0f} ms, {len(expected) - len(taken)} of {len(expected)}"


def publish(seconds: float, best: bool) -> None:
    """Publish for ``seconds`` and print the stamps of the sent messages."""
    from sensor_msgs.msg import Image, PointCloud2, PointField

    node = _node("publisher")
    noise = np.random.default_rng(0)
    cloud = PointCloud2(height=1, width=POINTS, point_step=16, row_step=16 * POINTS, is_dense=True)
    cloud.fields = [PointField(name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate("xyzi")]
    cloud.data = array.array("B", noise.bytes(16 * POINTS))
    messages: list[tuple[Any, Any]] = [(node.create_publisher(PointCloud2, CLOUD, _qos(best)), cloud)]
    for topic, (width, height) in IMAGES.items():
        image = Image(width=width, height=height, encoding="bgr8", step=3 * width)
        image.data = array.array("B", noise.bytes(3 * width * height))
        messages.append((node.create_publisher(Image, topic, _qos(best)), image))
    sent = []
    start = time.monotonic()
    for number in range(round(seconds * RATE)):
        time.sleep(max(0.0, start + number / RATE - time.monotonic()))
        sent.append(time.time_ns())
        for publisher, message in messages:
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(sent[-1], 10**9)
            publisher.publish(message)
    time.sleep(0.5)  # for what is sent again
    print(json.dumps(sent))


def receive(seconds: float, best: bool) -> None:
    """Receive for ``seconds``. Print the stamps with the times at which the middleware had the messages."""
    import rclpy
    from sensor_msgs.msg import Image, PointCloud2

    node = _node("receiver")
    found: dict[str, list[tuple[int, int]]] = defaultdict(list)

    def take(topic: str) -> Callable[[bytes, dict[str, int]], None]:
        def note(data: bytes, info: dict[str, int]) -> None:
            sec, nanosec = np.frombuffer(data, "<u4", 2, 4).tolist()
            found[topic].append((sec * 10**9 + nanosec, info["received_timestamp"]))

        return note

    for topic, kind in ((CLOUD, PointCloud2), *dict.fromkeys(IMAGES, Image).items()):
        node.create_subscription(kind, topic, take(topic), _qos(best), raw=True)
    print("ready", flush=True)
    while not found:
        rclpy.spin_once(node, timeout_sec=1.0)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.1)
    print(json.dumps(found))


def _node(name: str) -> Any:
    import rclpy

    rclpy.init()
    return rclpy.create_node(name)


def _qos(best: bool) -> Any:
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    return QoSProfile(
        depth=5, reliability=ReliabilityPolicy.BEST_EFFORT if best else ReliabilityPolicy.RELIABLE
    )


if __name__ == "__main__":
    sys.exit(main())
