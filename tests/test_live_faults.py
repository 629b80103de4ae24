"""No single sensor or topic freezes or ends a live session. The robot is a process made of rclpy alone."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import pytest

from bevviz.config.reloading import ReloadableConfig
from bevviz.model.frame import Frame
from tests.support.faulty_robot import FaultyRobot, faulty_robot
from tests.support.ros_graphs import own_graph
from tests.support.waiting import PATIENCE, until

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'bevviz[ros]'")

from bevviz.extras.ros_node.topics import RosTopics
from bevviz.live.publish import BEV, FUSED, OBSTACLES, TOPICS, TRANSFORMS
from bevviz.live.raw_recorder import RawRecorder
from bevviz.live.source import LiveSource


@dataclass
class Session:
    """Running source, its frames and its messages to the user."""

    source: LiveSource
    said: list[str]
    frames: list[Frame] = field(default_factory=list)

    def until_told(self, *texts: str, within: float = PATIENCE) -> None:
        """Wait until each text is part of a message after the last call."""
        began = time.monotonic()
        until(lambda: all(any(text in line for line in self.said) for text in texts), f"{texts}")
        assert time.monotonic() - began < within, f"{texts} came late"
        self.said.clear()

    def until_frames(self) -> None:
        """Wait for new frames."""
        self.frames.clear()
        until(lambda: len(self.frames) > 3, "frames")


@contextmanager
def running(*settings: str) -> Iterator[Session]:
    """Run a source, and take its frames in a thread."""
    said: list[str] = []
    patient = "sync.max_wait=20"  # A frame that waits for a silent sensor fails its test.
    values = ReloadableConfig(None, [patient, *settings])
    with LiveSource(values.config, tell=said.append, raw=RawRecorder(values)) as source:
        session = Session(source, said)

        def take() -> None:
            if source.wait(PATIENCE):
                for frame in source:
                    session.frames.append(frame)

        thread = threading.Thread(target=take, daemon=True)
        thread.start()
        try:
            yield session
        finally:
            source.stop()
            thread.join()


def is_published(session: Session, topic: str, node: str) -> bool:
    """Return whether the graph shows a topic and its node, which is at times discovered later."""
    info = session.source.topics.get(topic)
    return info is not None and info.publishers[0].node_name == node


@pytest.fixture
def robot() -> Iterator[FaultyRobot]:
    with own_graph(), faulty_robot() as robot:
        yield robot


@pytest.mark.long
def test_a_lost_sensor_stops_no_frame_and_is_named(robot: FaultyRobot) -> None:
    robot.set("/a", kind="PointCloud2", frame="a")
    robot.set("/camera", kind="Image")
    with running() as session:
        session.until_frames()
        robot.set("/camera", silent=True)
        session.until_told("no message on /camera")
        session.until_frames()
        robot.set("/camera", kind="")
        session.until_told("/camera has no publisher any more")
        robot.set("/a", silent=True)
        session.until_told("no cloud for 1.5 s on /a")
        robot.set("/a", silent=False)
        session.until_told("the clouds are back")
        session.until_frames()


@pytest.mark.long
def test_a_second_type_on_a_topic_is_named_and_not_used(robot: FaultyRobot) -> None:
    robot.set("/a", kind="String", node="stranger")
    robot.set(FUSED, kind="String")
    with running() as session:
        until(lambda: is_published(session, FUSED, "robot") and "/a" in session.source.topics, "the strings")
        refused: list[str] = []
        publisher = RosTopics(session.source.nodes.node, refused.append)
        assert len(refused) == 1 and f"/robot publishes {FUSED} as std_msgs/msg/String" in refused[0]
        robot.set("/a", kind="PointCloud2", frame="a")
        clash = "/a has two types: /robot (sensor_msgs/msg/PointCloud2) is received, /stranger (std_msgs"
        session.until_told(clash)
        session.until_frames()
        robot.set("/a", kind="", node="stranger")
        session.until_told("/a has one type")
        robot.set("/a", kind="String", node="stranger")
        robot.set(OBSTACLES, kind="String")  # which this process publishes already
        session.until_told("/a has two types")
        until(lambda: OBSTACLES in session.source.topics, "a topic of another type than ours")
        session.until_frames()
        until(lambda: OBSTACLES not in publisher.topics, "the end of our topic")
        assert TOPICS.keys() - publisher.topics == {FUSED, OBSTACLES, TRANSFORMS}


@pytest.mark.long
def test_no_result_goes_to_a_topic_of_the_robot(robot: FaultyRobot) -> None:
    robot.set(OBSTACLES, kind="PointCloud2", node="detector")
    with running() as session:
        until(lambda: is_published(session, OBSTACLES, "detector"), "the robot's topic")
        told: list[str] = []
        publisher = RosTopics(session.source.nodes.node, told.append)
        assert told == [
            f"{OBSTACLES} is not published: /detector publishes {OBSTACLES}, and messages of two sources "
            f"would mix; --ros-args -r {OBSTACLES}:=/bevviz{OBSTACLES} gives ours another name"
        ]
        assert OBSTACLES not in publisher.topics and BEV in publisher.topics
        told.clear()
        robot.set(BEV, kind="Image", node="viewer")
        until(lambda: told, "the robot's second publisher is named")
        assert told[0].startswith(f"{BEV} is not published any more: /viewer publishes {BEV} now; --ros-args")
        assert BEV not in publisher.topics and not publisher.wants(BEV)
        publisher.send(BEV, b"", 0)  # a result that was on its way goes nowhere


SOON = 12.0  # seconds until a problem is told: two, and the rest for a busy machine


@pytest.mark.long
def test_a_clock_apart_is_named_and_nobody_waits_for_it(robot: FaultyRobot) -> None:
    """The LiDAR that drives the frames by its name gets a clock that is ahead, and then a right one again."""
    for name in ("a", "b"):
        robot.set(f"/{name}", kind="PointCloud2", frame=name)
    robot.set("/tf", kind="TFMessage", frame="b")
    with running() as session:
        session.until_frames()
        robot.set("/a", ahead=37.0)
        clock = "/a: its clock is 37 s ahead of that of /"
        session.until_told(clock, "sync.offsets", "/a has a clock apart", within=SOON)
        session.until_frames()
        waited = [1e-9 * (time.time_ns() - frame.received) for frame in session.frames[-1:]]
        assert waited[0] < 1.0 and session.source.problems.of("/a")
        robot.set("/a", ahead=0.0)
        agrees, follows = "/a: its clock agrees with the others again", "the frames follow /a again"
        session.until_told(agrees, follows, within=SOON)
        assert not session.source.problems.of("/a")


@pytest.mark.long
def test_a_blind_lidar_is_named(robot: FaultyRobot) -> None:
    robot.set("/a", kind="PointCloud2", frame="a")
    with running() as session:
        session.until_frames()
        for points, why in (("none", "0 points"), ("NaN", "all 3,600 points are NaN, infinite or (0, 0, 0)")):
            robot.set("/a", points=points)
            session.until_told(f"LiDAR /a sees nothing: {why}", within=SOON)
            assert session.source.states["/a"] == "degraded"
            robot.set("/a", points="")
            session.until_told("LiDAR /a sees points again", within=SOON)
            assert session.source.states["/a"] == "ok"


@pytest.mark.long
def test_slow_transforms_are_named_with_the_setting(robot: FaultyRobot) -> None:
    robot.set("/a", kind="PointCloud2", frame="a")
    robot.set("/tf", kind="TFMessage", frame="a")
    with running("sync.max_wait=0.5") as session:
        session.until_frames()
        robot.set("/tf", every=10)
        session.until_told("s for /tf, which comes each ", "waits for all; --set sync.max_wait=0.1")
        robot.set("/tf", every=1)
        session.until_told("frames do not wait any more")


@pytest.mark.long
def test_two_robots_with_equal_names_are_named(robot: FaultyRobot) -> None:
    robot.set("/van/points", kind="PointCloud2")
    robot.set("/truck/points", kind="PointCloud2")
    with running() as session:
        session.until_told(
            "/truck and /van are two robots with equal names (points), taken for one: "
            "--ros-args -r __ns:=/truck takes the first alone"
        )
        robot.set("/truck/points", kind="")
        session.until_told("one robot is received")


@pytest.mark.long
def test_transforms_come_by_two_subscriptions_and_count_once(robot: FaultyRobot) -> None:
    """Best effort is sooner beside large clouds, and reliable brings the rest."""
    robot.set("/a", kind="PointCloud2", frame="a")
    robot.set("/tf", kind="TFMessage", frame="a")
    with running() as session:
        session.until_frames()
        node, received = session.source.nodes.input, session.source.watch.received["/tf"]
        qualities = [
            info.qos_profile.reliability.name for info in node.get_subscriptions_info_by_topic("/tf")
        ]
        assert sorted(qualities) == ["BEST_EFFORT", "RELIABLE"]
        until(lambda: len(session.frames) > 20, "frames")
        assert all(frame.world_from_points is not None for frame in session.frames)
        # One message each 0.1 s, as clouds: counted twice they would be twice as many.
        clouds = len(session.frames)
        assert session.source.watch.received["/tf"] - received < 1.5 * clouds
