"""Boxes in Autoware's, radars' and private messages on a real graph, known by the .msg files alone."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from bevviz.config import load
from bevviz.errors import UserError
from bevviz.ros.definitions import store_of
from bevviz.ros.encode import encode_cloud
from bevviz.synthetic import SyntheticSource
from tests import bags
from tests.graphs import own_graph, until
from tests.test_objects import AUTOWARE, PRIVATE, RADAR, assert_is_box, autoware, made, private, radar

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'bevviz[ros]'")

from bevviz.live.source import LiveSource
from bevviz.ros.node import Node
from bevviz.ros.typesupport import message_type

CLOUD = "sensor_msgs/msg/PointCloud2"
STATED = "source.boxes={topic: my/things, size: dimensions, yaw: heading, label: class_name, id: number}"


@pytest.fixture
def packages(tmp_path: Path) -> Iterator[None]:
    """A workspace, as sourcing it would make it known; nothing of it can be imported."""
    for package, definitions in (
        ("autoware_perception_msgs", AUTOWARE),
        ("radar_msgs", RADAR),
        ("my_msgs", PRIVATE),
    ):
        folder = tmp_path / "share" / package / "msg"
        folder.mkdir(parents=True)
        for name, text in definitions.items():
            (folder / f"{name}.msg").write_text(text)
    with own_graph() as patch:
        patch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
        yield
    store_of.cache_clear()
    message_type.cache_clear()


def now(message: Any) -> Any:
    """With the stamp of this moment."""
    at = time.time_ns()
    stamp = replace(message.header.stamp, sec=at // 10**9, nanosec=at % 10**9)
    return replace(message, header=replace(message.header, stamp=stamp, frame_id="rslidar"))


def test_boxes_of_other_messages_are_received(packages: None) -> None:
    stores: Mapping[str, bags.Messages] = {
        "autoware_perception_msgs": made("autoware_perception_msgs", AUTOWARE),
        "radar_msgs": made("radar_msgs", RADAR),
        "my_msgs": made("my_msgs", PRIVATE),
    }
    kind = "autoware_perception_msgs/msg/TrackedObjects"
    sent = {
        "/perception/objects": (kind, autoware(stores["autoware_perception_msgs"], kind[:24], "Tracked")),
        "/radar/tracks": ("radar_msgs/msg/RadarTracks", radar(stores["radar_msgs"])),
        "/robot/my/things": ("my_msgs/msg/Things", private(stores["my_msgs"])),
    }
    cloud = encode_cloud(SyntheticSource(frames=1).snapshot(0).frame.clouds[0])
    with (
        Node(name="robot") as robot,
        LiveSource(
            load(settings=[STATED]), arguments=["--ros-args", "-r", "my/things:=/robot/my/things"]
        ) as source,
    ):
        robot.start()
        points = robot.node.create_publisher(message_type(CLOUD), "/points", 5)
        others = {t: robot.node.create_publisher(message_type(kind), t, 5) for t, (kind, _) in sent.items()}

        def publish() -> bool:
            for topic, (kind, message) in sent.items():
                data = stores[kind.partition("/")[0]].store.serialize_cdr(now(message), kind)
                others[topic].publish(bytes(data))
            points.publish(bytes(store_of(CLOUD).serialize_cdr(now(cloud), CLOUD)))
            return True

        until(lambda: publish() and source.wait(0), "a scene")
        frames = iter(source)

        boxes: dict[str, Any] = {}

        def all_came() -> bool:
            publish()
            boxes.update({one.topic: one for one in next(frames).robot_boxes})
            return boxes.keys() == sent.keys()

        until(all_came, "all boxes")
    assert {topic: one.labels for topic, one in boxes.items()} == {
        "/perception/objects": ("pedestrian",),
        "/radar/tracks": ("dynamic",),
        "/robot/my/things": ("van",),
    }
    assert_is_box(boxes["/perception/objects"])
    assert_is_box(boxes["/radar/tracks"], yaw=0.0)
    assert_is_box(boxes["/robot/my/things"], yaw=-0.25)


def test_what_is_not_known_is_said(packages: None, tmp_path: Path) -> None:
    said: list[str] = []
    with Node(name="robot") as robot:
        robot.start()
        robot.node.create_publisher(message_type("my_msgs/msg/Things"), "/my/things", 5)
        store_of.cache_clear()
        (tmp_path / "share" / "my_msgs" / "msg" / "Thing.msg").unlink()
        with LiveSource(load(settings=["source.boxes={topic: /my/things}"]), tell=said.append):
            until(lambda: any("is not received" in line for line in said), "what is not received")
    expected = "/my/things is not received: my_msgs/msg/Things is not known without its package, and no"
    assert any(line.startswith(f"{expected} my_msgs/msg/Thing.msg is in AMENT_PREFIX_PATH") for line in said)
    with pytest.raises(UserError, match=r"no your_msgs/msg/Box\.msg is in AMENT_PREFIX_PATH"):
        message_type("your_msgs/msg/Box")
