"""Each known problem of a robot's data is told within two seconds of its begin and of its end.

The messages are handed over inside this process, and the test turns the clock.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from bevviz.messages.encode import (
    encode_camera_info,
    encode_cloud,
    encode_compressed_image,
    encode_image,
    encode_transforms,
)
from bevviz.model.frame import Cloud, Image, Intrinsics

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'bevviz[ros]'")

from tests.support import videos
from tests.support.fed_graph import FedGraph, Session, fed_graph, joined

CLOUD = "sensor_msgs/msg/PointCloud2"
IMAGE = "sensor_msgs/msg/Image"
TF = "tf2_msgs/msg/TFMessage"
INFO = "sensor_msgs/msg/CameraInfo"
TOPICS = {"/a": CLOUD, "/b": CLOUD, "/camera/image": IMAGE, "/camera/camera_info": INFO, "/tf": TF}
FRAMES = [("map", "base_link"), *(("base_link", sensor) for sensor in ("a", "b", "camera"))]
K = np.array([[4.0, 0, 2], [0, 4, 2], [0, 0, 1]])
SOON = 2.0  # seconds
STEP = 0.1  # seconds between two clouds


def make_cloud(frame: str, stamp: int, points: int | None = None) -> Any:
    """Return the message of a flat square, or of its first points."""
    square = np.mgrid[-15:15:1, -15:15:1, -1.8:-1.7:1].reshape(3, -1).T.astype(np.float32)
    return encode_cloud(Cloud(stamp, frame, square[:points]))


@dataclass
class Robot:
    """LiDARs /a and /b, a camera and transforms. A fault is a change of one of the fields."""

    graph: FedGraph
    silent: frozenset[str] = frozenset()
    ahead: float = 0.0  # seconds, stamps of /a
    blind: bool = False  # /a
    unreadable: str = ""  # topic whose messages have no content
    publishers: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for topic, kind in TOPICS.items():
            self.publishers[topic] = self.graph.advertise(topic, kind)

    def play(self, seconds: float = STEP, stamp: int | None = None) -> None:
        """Publish each topic once in ``STEP``. ``stamp``: of all messages, nanoseconds."""
        for i in range(round(seconds / STEP)):
            now = self.graph.time_ns() if stamp is None else stamp + round(i * STEP * 1e9)
            edges = [(parent, child, np.eye(4)) for parent, child in FRAMES]
            self._publish("/tf", bytes_of(TF, encode_transforms(now, edges)))
            image = Image(now, "camera", np.zeros((4, 4, 3), np.uint8))
            self._publish("/camera/image", encode_image(image))
            self._publish("/camera/camera_info", encode_camera_info(image, Intrinsics(4, 4, K)))
            ahead = round(self.ahead * 1e9)
            self._publish("/a", make_cloud("a", now + ahead, 0 if self.blind else None))
            self._publish("/b", make_cloud("b", now))
            self.graph.advance(STEP)

    def _publish(self, topic: str, message: Any) -> None:
        publisher = self.publishers.get(topic)
        if publisher is not None and topic not in self.silent:
            self.graph.publish(publisher, b"\0\1\0\0" if topic == self.unreadable else message)

    def withdraw(self) -> None:
        """Let the camera vanish."""
        self.graph.withdraw(self.publishers.pop("/camera/image"))

    def advertise(self) -> None:
        """Let the camera come back."""
        self.publishers["/camera/image"] = self.graph.advertise("/camera/image", IMAGE)

    def set(self, **fields: Any) -> None:
        """Change fields."""
        for name, value in fields.items():
            setattr(self, name, value)


def bytes_of(kind: str, message: Any) -> bytes:
    from bevviz.messages.definitions import typestore

    return bytes(typestore().serialize_cdr(message, kind))


@pytest.fixture
def robot() -> Iterator[Robot]:
    with fed_graph() as graph:
        yield Robot(graph)


def until_told(session: Session, robot: Robot, text: str) -> float:
    """Play until a text is told. Return the seconds that it took."""
    session.said.clear()
    begun = robot.graph.now
    while not session.told(text):
        robot.play()
        assert robot.graph.now - begun < 10, f"{text}: not among {session.said}"
    return robot.graph.now - begun


Change = Callable[[Robot], None]


def change(**fields: Any) -> Change:
    return lambda robot: robot.set(**fields)


@pytest.mark.parametrize(
    ("fault", "begin", "mended", "end"),
    [
        (
            change(silent=frozenset({"/camera/image"})),
            "no message on /camera/image for 1.5 s",
            change(silent=frozenset()),
            "/camera/image is back",
        ),
        (
            change(silent=frozenset({"/a", "/b"})),
            "no cloud for 1.5 s on /a, /b",
            change(silent=frozenset()),
            "the clouds are back",
        ),
        (
            Robot.withdraw,
            "/camera/image has no publisher any more",
            Robot.advertise,
            "/camera/image is published again",
        ),
        (change(ahead=37.0), "/a: its clock is 37 s ahead", change(ahead=0.0), "/a: its clock agrees with"),
        (change(ahead=-90.0), "/a: its clock is 90.0", change(ahead=0.0), "/a: its clock agrees with"),
        (change(blind=True), "LiDAR /a sees nothing: 0 points", change(blind=False), "/a sees points again"),
        (
            change(unreadable="/a"),
            "a message cannot be used: /a",
            change(unreadable=""),
            "/a: its messages can be used again",
        ),
        (
            change(silent=frozenset({"/tf"})),
            "no transform from",
            change(silent=frozenset()),
            "over: ",
        ),
    ],
)
def test_begin_and_end_are_told_soon(
    robot: Robot, fault: Change, begin: str, mended: Change, end: str
) -> None:
    with joined(robot.graph) as session:
        robot.play(4.0)
        assert session.frames and not session.source.problems.current, session.said
        fault(robot)
        began = until_told(session, robot, begin)
        assert session.source.problems.current
        robot.play(1.0)
        mended(robot)
        ended = until_told(session, robot, end)
        assert (began <= SOON, ended <= SOON) == (True, True), (began, ended)
        robot.play(2.0)
        assert not session.source.problems.current
        texts = [p.history for p in session.source.problems.all.values() if begin in str(p)]
        span = re.compile(r"\(\d\d:\d\d:\d\d to \d\d:\d\d:\d\d")
        assert texts and all(span.search(text) for text in texts)


def test_a_bag_in_a_loop_gives_no_advice_about_clocks(robot: Robot) -> None:
    """The stamps are those of the recording. Each loop begins three seconds after the last one ended."""
    recorded = 1_600_000_000 * 10**9
    with joined(robot.graph) as session:
        for _ in range(4):
            robot.play(5.0, stamp=recorded)
            robot.graph.advance(3.0)
        assert len(session.frames) > 100
        advice = [text for text in session.said if "clock" in text or "sync." in text]
        assert not advice and session.told("the stamps of the clouds jumped back")


def test_several_robots_are_named(robot: Robot) -> None:
    """Frames begin with the name of their robot, so that each sensor is of one robot for certain."""
    with joined(robot.graph) as session:
        for name in ("van", "truck"):
            robot.publishers |= {
                f"/{name}/lidar": robot.graph.advertise(f"/{name}/lidar", CLOUD),
                f"/{name}/odom": robot.graph.advertise(f"/{name}/odom", "nav_msgs/msg/Odometry"),
            }
        for topic in TOPICS:
            robot.graph.withdraw(robot.publishers.pop(topic))
        for _ in range(30):
            for name in ("van", "truck"):
                cloud = make_cloud(f"{name}/lidar", robot.graph.time_ns())
                robot.graph.publish(robot.publishers[f"/{name}/lidar"], cloud)
            robot.graph.advance(STEP)
        (told,) = session.source.problems.of("namespaces")
        assert str(told) == (
            "the topics are of 2 robots, truck and van: truck is shown; "
            "--set source.lidar_topics=[/van/lidar] shows van"
        )


def test_a_video_that_waits_for_its_key_frame_is_named(robot: Robot) -> None:
    """The encoder began before us: its next key frame is packet 60."""
    packets = videos.encode(videos.numbered(80), group=60)[1:]
    robot.withdraw()
    video = robot.graph.advertise("/video/h264", "sensor_msgs/msg/CompressedImage")
    with joined(robot.graph) as session:

        def play(packets: list[bytes]) -> None:
            for data in packets:
                robot.play(STEP)
                message = encode_compressed_image(robot.graph.time_ns(), "camera", data, "h264")
                robot.graph.publish(video, message)

        play(packets[:30])
        waiting = "/video/h264: the video has no key frame yet; its camera shows nothing until one comes"
        assert session.source.problems.of("/video/h264")[0].finding.text == waiting
        session.said.clear()
        play(packets[30:])
        assert session.told("/video/h264: a key frame has come")
        assert not session.source.problems.of("/video/h264")
