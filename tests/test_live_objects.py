"""Boxes in Autoware's, radars' and private messages beside a live run, known by the .msg files alone."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from bevviz.config import load
from bevviz.errors import UserError
from bevviz.extras.demo.drive import PERIOD, TRUTH_TOPIC
from bevviz.messages import definitions
from bevviz.messages.definitions import store_of, typestore
from bevviz.messages.encode import encode_cloud
from bevviz.model.frame import Cloud
from tests.support import bags
from tests.support.object_messages import (
    AUTOWARE,
    BOX,
    PRIVATE,
    RADAR,
    assert_is_box,
    autoware,
    made,
    pose,
    private,
    radar,
    vector,
)
from tests.support.ros_graphs import own_graph
from tests.support.waiting import until

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'bevviz[ros]'")

from bevviz.live.node import Node
from bevviz.live.source import LiveSource
from bevviz.live.typesupport import message_type
from tests.support.fed_graph import NEEDED, Player, fed_graph, joined

CLOUD = "sensor_msgs/msg/PointCloud2"
STATED = "source.boxes={topic: my/things, size: dimensions, yaw: heading, label: class_name, id: number}"


@pytest.fixture
def packages(tmp_path: Path) -> Iterator[None]:
    """Make a workspace known as sourcing it does. None of its packages can be imported."""
    for package, texts in (
        ("autoware_perception_msgs", AUTOWARE),
        ("radar_msgs", RADAR),
        ("my_msgs", PRIVATE),
    ):
        folder = tmp_path / "share" / package / "msg"
        folder.mkdir(parents=True)
        for name, text in texts.items():
            (folder / f"{name}.msg").write_text(text)
    with own_graph() as patch:
        patch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
        yield
    store_of.cache_clear()
    message_type.cache_clear()


# As Foxy's package has them, of which nothing says that they are not today's.
FOXY = {
    "ObjectHypothesisWithPose": "string id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose\n",
    "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "Detection3D": "std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox3D bbox\n"
    "sensor_msgs/PointCloud2 source_cloud\nbool is_tracking\nstring tracking_id\n",
    "Detection3DArray": "std_msgs/Header header\nDetection3D[] detections\n",
}


def of_foxy() -> bags.Messages:
    found = bags.Messages()
    found.store = get_typestore(Stores.ROS2_FOXY)
    for name, text in FOXY.items():
        found.store.register(get_types_from_msg(text, f"vision_msgs/msg/{name}"))
    return found


def older(m: bags.Messages) -> Any:
    where = m.make("geometry_msgs/msg/PoseWithCovariance", pose=pose(m), covariance=np.zeros(36))
    about = m.header(bags.START, bags.LIDAR_FRAME)
    one = m.make(
        "vision_msgs/msg/Detection3D",
        header=about,
        results=[m.make("vision_msgs/msg/ObjectHypothesisWithPose", id="bus", score=0.5, pose=where)],
        bbox=m.make("vision_msgs/msg/BoundingBox3D", center=pose(m), size=vector(m, "Vector3", BOX[3:6])),
        source_cloud=m.cloud(bags.START, np.zeros((2, 4), np.float32)),
        is_tracking=True,
        tracking_id="7",
    )
    return m.make("vision_msgs/msg/Detection3DArray", header=about, detections=[one])


def stamped(message: Any, at: int) -> Any:
    """Return the message with a stamp in nanoseconds, in the frame of the LiDAR."""
    stamp = replace(message.header.stamp, sec=at // 10**9, nanosec=at % 10**9)
    return replace(message, header=replace(message.header, stamp=stamp, frame_id="rslidar"))


@pytest.mark.long
def test_boxes_of_other_messages_are_received(packages: None) -> None:
    stores: Mapping[str, bags.Messages] = {
        "autoware_perception_msgs": made("autoware_perception_msgs", AUTOWARE),
        "radar_msgs": made("radar_msgs", RADAR),
        "my_msgs": made("my_msgs", PRIVATE),
        "vision_msgs": of_foxy(),
    }
    perception, about = stores["autoware_perception_msgs"], "autoware_perception_msgs"
    sent = {
        "/perception/objects": (f"{about}/msg/TrackedObjects", autoware(perception, about, "Tracked")),
        "/perception/seen": (f"{about}/msg/DetectedObjects", autoware(perception, about, "Detected")),
        "/perception/ahead": (f"{about}/msg/PredictedObjects", autoware(perception, about, "Predicted")),
        "/older": ("vision_msgs/msg/Detection3DArray", older(stores["vision_msgs"])),
        "/radar/tracks": ("radar_msgs/msg/RadarTracks", radar(stores["radar_msgs"])),
        "/robot/my/things": ("my_msgs/msg/Things", private(stores["my_msgs"])),
    }
    remap = ["-r", "my/things:=/robot/my/things"]
    with fed_graph() as graph:
        player = Player(graph, without=(TRUTH_TOPIC,))
        publishers = {topic: graph.advertise(topic, kind) for topic, (kind, _) in sent.items()}
        with joined(graph, STATED, arguments=remap) as session:
            player.play(NEEDED)
            for _ in range(10):
                for topic, (kind, message) in sent.items():
                    store = stores[kind.partition("/")[0]].store
                    data = store.serialize_cdr(stamped(message, player.stamp + PERIOD), kind)
                    graph.publish(publishers[topic], bytes(data))
                player.play(0.1)
    boxes = {one.topic: one for frame in session.frames for one in frame.robot_boxes}
    assert {topic: one.labels for topic, one in boxes.items()} == {
        "/perception/objects": ("pedestrian",),
        "/perception/seen": ("pedestrian",),
        "/perception/ahead": ("pedestrian",),
        "/older": ("bus",),
        "/radar/tracks": ("dynamic",),
        "/robot/my/things": ("van",),
    }
    for topic in ("/perception/objects", "/perception/seen", "/perception/ahead", "/older"):
        assert_is_box(boxes[topic])
    assert boxes["/older"].ids == ("7",)
    assert_is_box(boxes["/radar/tracks"], yaw=0.0)
    assert_is_box(boxes["/robot/my/things"], yaw=-0.25)


PLANNER = """
import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path

rclpy.init()
node = rclpy.create_node("planner", namespace="/robot")
publisher = node.create_publisher(Path, "/things", 5)
thing = PoseStamped()
thing.header.frame_id = "tram"
thing.pose.position.x, thing.pose.position.y, thing.pose.position.z = 10.0, 2.0, 1.5

def publish():
    path = Path(poses=[thing])
    path.header.stamp, path.header.frame_id = node.get_clock().now().to_msg(), "rslidar"
    publisher.publish(path)

timer = node.create_timer(0.1, publish)
print("playing", flush=True)
rclpy.spin(node)
"""
STRANGE = "source.boxes={topic: /things, center: pose.position, size: pose.position, label: header.frame_id}"


@pytest.mark.long
def test_who_publishes_a_type_is_asked_what_it_is_made_of(
    packages: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = "nav_msgs/msg/Path"
    known = Typestore()  # all but this one, whose package is hidden
    known.fielddefs = {kind: fields for kind, fields in typestore().fielddefs.items() if kind != path}
    known.types = {kind: made for kind, made in typestore().types.items() if kind != path}
    monkeypatch.setattr(definitions, "typestore", lambda: known)
    monkeypatch.setattr(definitions, "_learned", {})
    monkeypatch.setitem(sys.modules, "nav_msgs.msg", None)
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    with pytest.raises(UserError, match=f"{path} is not known without its package"):
        message_type(path)
    cloud = encode_cloud(Cloud(0, "rslidar", np.zeros((9, 3), np.float32)))
    with (
        subprocess.Popen([sys.executable, "-c", PLANNER], stdout=subprocess.PIPE, text=True) as planner,
        Node(name="robot") as robot,
        LiveSource(load(settings=[STRANGE])) as source,
    ):
        try:
            assert planner.stdout is not None and planner.stdout.readline() == "playing\n"
            robot.start()
            points = robot.node.create_publisher(message_type(CLOUD), "/points", 5)

            def publish() -> bool:
                points.publish(bytes(known.serialize_cdr(stamped(cloud, time.time_ns()), CLOUD)))
                return True

            until(
                lambda: publish() and source.wait(0) and source.watch.received["/things"],
                "a scene with things",
            )
            frames = iter(source)
            found: list[Any] = []

            def came() -> bool:
                publish()
                found.extend(next(frames).robot_boxes)
                return bool(found)

            until(came, "a thing")
        finally:
            planner.terminate()
    assert (found[0].labels, found[0].boxes.center.tolist()) == (("tram",), [[10.0, 2.0, 1.5]])
    text = definitions.definition(path)
    assert text is not None and "geometry_msgs/PoseStamped[] poses" in text


def test_an_unknown_type_is_reported(packages: None, tmp_path: Path) -> None:
    (tmp_path / "share" / "my_msgs" / "msg" / "Thing.msg").unlink()
    with fed_graph() as graph:
        graph.advertise("/my/things", "my_msgs/msg/Things").topic_type_hash = "RIHS01_00"
        with joined(graph, "source.boxes={topic: /my/things}") as session:
            graph.advance(5.0)
    expected = "/my/things is not received: my_msgs/msg/Things is not known without its package, and no"
    asked = "; /robot, which publishes it, was asked and does not answer"
    (unheard,) = [line for line in session.said if line.startswith(expected) and line.endswith(asked)]
    assert f"{expected} my_msgs/msg/Thing.msg is in AMENT_PREFIX_PATH" in unheard
    with pytest.raises(UserError, match=r"no your_msgs/msg/Box\.msg is in AMENT_PREFIX_PATH"):
        message_type("your_msgs/msg/Box")
