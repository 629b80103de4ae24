"""No single sensor or topic freezes or ends a live session. The robot is a process made of rclpy alone."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import pytest

from bevviz.config import load
from bevviz.model.frame import Frame
from tests.support.faulty_robot import FaultyRobot, faulty_robot
from tests.support.ros_graphs import own_graph
from tests.support.waiting import PATIENCE, until

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'bevviz[ros]'")

from bevviz.live.publish import BEV, FUSED, OBSTACLES, TOPICS, TRANSFORMS, RosTopics
from bevviz.live.raw_recorder import RawRecorder
from bevviz.live.source import LiveSource


@dataclass
class Session:
    """Running source, its frames and its messages to the user."""

    source: LiveSource
    said: list[str]
    frames: list[Frame] = field(default_factory=list)

    def until_told(self, *texts: str) -> None:
        """Wait until each text is part of a message after the last call."""
        until(lambda: all(any(text in line for line in self.said) for text in texts), f"{texts}")
        self.said.clear()

    def until_frames(self) -> None:
        """Wait for new frames."""
        self.frames.clear()
        until(lambda: len(self.frames) > 3, "frames")


@contextmanager
def running() -> Iterator[Session]:
    """Run a source, and take its frames in a thread."""
    said: list[str] = []
    config = load(settings=["sync.max_wait=20"])  # A frame that waits for a silent sensor fails its test.
    with LiveSource(config, tell=said.append, raw=RawRecorder(config.live)) as source:
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


@pytest.fixture
def robot() -> Iterator[FaultyRobot]:
    with own_graph(), faulty_robot() as robot:
        yield robot


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


def test_a_second_type_on_a_topic_is_named_and_not_used(robot: FaultyRobot) -> None:
    robot.set("/a", kind="String", node="stranger")
    robot.set(FUSED, kind="String")
    with running() as session:
        until(lambda: {"/a", FUSED} <= session.source.topics.keys(), "the strings")
        refused: list[str] = []
        publisher = RosTopics(session.source.node, refused.append)
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


def test_no_result_goes_to_a_topic_of_the_robot(robot: FaultyRobot) -> None:
    robot.set(OBSTACLES, kind="PointCloud2", node="detector")
    with running() as session:
        until(lambda: OBSTACLES in session.source.topics, "the robot's topic")
        told: list[str] = []
        publisher = RosTopics(session.source.node, told.append)
        assert told == [
            f"{OBSTACLES} is not published: /detector publishes {OBSTACLES}, and messages of two sources "
            f"would mix; --ros-args -r {OBSTACLES}:=/bevviz{OBSTACLES} gives ours another name"
        ]
        assert OBSTACLES not in publisher.topics and BEV in publisher.topics
        told.clear()
        robot.set(BEV, kind="Image", node="viewer")
        began = time.monotonic()
        until(lambda: told, "the robot's second publisher is named")
        assert time.monotonic() - began < 2
        assert told[0].startswith(f"{BEV} is not published any more: /viewer publishes {BEV} now; --ros-args")
        assert BEV not in publisher.topics and not publisher.wants(BEV)
        publisher.send(BEV, b"", 0)  # a result that was on its way goes nowhere
