"""The source of a live run: topics that it takes, frames that it makes, and problems that it names.

The messages are handed over inside this process. tests/test_live_ros.py has the same over DDS.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from mmap import mmap
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bevviz.config import load
from bevviz.config.reloading import ReloadableConfig
from bevviz.drivers.video import VideoPacket
from bevviz.errors import UserError
from bevviz.extras.demo.drive import CAMERA_INFO_TOPIC, LIDAR_TOPIC, TRUTH_TOPIC
from bevviz.messages.encode import encode_boxes_3d, encode_cloud
from bevviz.model.frame import Boxes3D, Cloud, Frame
from bevviz.pipeline.run import DropPolicy, run
from bevviz.sync.video import Video
from tests.support.played_drive import drive_of
from tests.support.ros_player import Play
from tests.support.waiting import until

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'bevviz[ros]'")

from bevviz.live import graph_info as info
from bevviz.live import typesupport
from bevviz.live.graph import PublishedTopic, Subscriptions
from bevviz.live.input_problems import remedy
from bevviz.live.raw_recorder import RawRecorder
from bevviz.live.source import CUT_OFF, LiveSource
from tests.support.fed_graph import NEEDED, FedGraph, Player, fed_graph, joined

CLOUD = "sensor_msgs/msg/PointCloud2"
PATIENT = "sync.max_wait=20"  # seconds: a frame that waits for a sensor in vain does not come in a test


@pytest.fixture
def graph() -> Iterator[FedGraph]:
    with fed_graph() as graph:
        yield graph


@pytest.fixture(scope="module")
def cloud() -> Any:
    """Return the message of a flat square of points."""
    points = np.mgrid[-15:15:1, -15:15:1, -1.8:-1.7:1].reshape(3, -1).T.astype(np.float32)
    return encode_cloud(Cloud(0, "lidar", points))


def test_the_newest_frame_wins(graph: FedGraph) -> None:
    player = Player(graph)
    with LiveSource(load()) as source:
        player.play(NEEDED)
        frames = iter(source)
        before, dropped = next(frames), source.dropped
        player.play(1.0)
        frame = next(frames)
    assert graph.time_ns() - frame.stamp < 0.2e9
    assert source.dropped - dropped == frame.index - before.index - 1 > 5


@pytest.mark.long
def test_frames_do_not_wait_for_the_robots_results(graph: FedGraph) -> None:
    """One detector stamps its boxes a little after the scan, another one takes 0.7 s for them."""
    kind = "vision_msgs/msg/Detection3DArray"
    one = Boxes3D(np.ones((1, 3), np.float32), np.ones((1, 3), np.float32), np.zeros(1, np.float32))
    shifts = {"/soon/boxes": 12_000_000, "/slow/boxes": -700_000_000}
    boxes = {topic: graph.advertise(topic, kind) for topic in shifts}
    player = Player(graph)
    with joined(graph, PATIENT) as session:
        for _ in range(60):
            player.play(0.1)
            for topic, publisher in boxes.items():
                stamp = player.stamp + shifts[topic]
                graph.publish(publisher, encode_boxes_3d(stamp, "rslidar", one, [[("car", 0.9)]]))
        late = session.source.overtaken()
    stamps = {frame.index: frame.stamp for frame in session.frames}
    assert len(stamps) > 25 and max(stamps.values()) == player.stamp
    soon: list[Any] = [b for frame in session.frames for b in frame.robot_boxes if b.topic == "/soon/boxes"]
    soon += [found.boxes for found in late if found.boxes.topic == "/soon/boxes"]
    slow = [found for found in late if found.boxes.topic == "/slow/boxes"]
    assert len(soon) > 20 and {b.stamp - 12_000_000 for b in soon} <= set(stamps.values())
    assert len(slow) > 15 and all(found.boxes.stamp == stamps[found.index] for found in slow)
    assert session.told("/slow/boxes comes when its frame has gone on")


def test_a_stated_topic_can_be_remapped(graph: FedGraph) -> None:
    rules = ["-r", f"/points:={LIDAR_TOPIC}"]
    player = Player(graph)
    with joined(graph, "source.lidar_topics=[/points]", arguments=rules) as session:
        player.play(NEEDED)
        assert session.frames and session.source.roles.lidars == (LIDAR_TOPIC,)


def test_a_stated_topic_is_waited_for(graph: FedGraph) -> None:
    graph.advertise("/rosout", "rcl_interfaces/msg/Log")
    player = Player(graph)
    absent = "nobody publishes /elsewhere, which source.camera_topics states"
    wrong = "/rosout is a rcl_interfaces/msg/Log, but source.lidar_topics takes PointCloud2 or LaserScan"
    with joined(graph, "source.lidar_topics=[/rosout]", "source.camera_topics=[/elsewhere]") as session:
        player.play(NEEDED)
        assert session.source.missing == f"{wrong}; {absent}"
        assert {absent, wrong} <= set(session.said) and not session.frames


def test_deleted_shared_memory_is_named(graph: FedGraph, tmp_path: Path) -> None:
    """The port of a process is mapped and has no name any more, as Fast DDS leaves it after a kill."""
    graph.advertise("/points", CLOUD)
    port = tmp_path / "fastrtps_port28415"
    port.write_bytes(bytes(4096))
    with joined(graph) as session, port.open("r+b") as file, mmap(file.fileno(), 0):
        assert session.source.missing == "no message on /points yet"
        port.unlink()
        assert session.source.missing == f"no message on /points yet; {CUT_OFF}"


def test_info_says_what_is_missing(graph: FedGraph, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first command that a user runs: nothing, then no LiDAR yet, then one without messages."""
    said: list[str] = []
    monkeypatch.setattr("bevviz.support.progress._say", said.append)

    def missing(*settings: str) -> Sequence[str]:
        return info.describe(load(settings=settings), seconds=0.01, patience=2.0).missing

    assert missing()[0].startswith("nothing is published on ROS domain 0: is the robot running")
    graph.advertise("/parameter_events", "rcl_interfaces/msg/ParameterEvent")
    absent = "nobody publishes /points, which source.lidar_topics states"
    assert missing("source.lidar_topics=[/points]")[0] == absent
    assert said[-1] == f"waiting 2 s at most: {absent}"
    graph.advertise("/points", CLOUD)
    assert missing() == ("no message on /points yet", "no detector: --model FILE.onnx")


def test_stopped_topics_are_reported_and_so_is_their_return(graph: FedGraph, cloud: Any) -> None:
    points = graph.advertise("/points", CLOUD)
    flat = replace(cloud, fields=[field for field in cloud.fields if field.name != "z"])

    def publish(message: Any, seconds: float = 0.5) -> None:
        for _ in range(round(10 * seconds)):
            graph.publish_now(points, message)
            graph.advance(0.1)

    with joined(graph) as session:
        publish(flat, 0.1)  # at the very first message
        assert session.source.states == {"/points": "unusable"}
        assert session.told("a message cannot be used: /points") and session.told("z")
        publish(cloud, NEEDED)
        assert session.told("/points: its messages can be used again") and session.frames
        graph.advance(1.4)
        assert not session.told("no cloud")
        graph.advance(0.6)  # the graph is looked at every half second
        assert session.said[-1] == "no cloud for 1.5 s on /points"
        assert session.source.states == {"/points": "silent"}
        publish(cloud, 1.0)
        assert session.said[-1] == "the clouds are back"
        second = graph.advertise("/points", CLOUD, node="second_driver")
        publish(cloud, 1.0)
        assert session.told("/points has several publishers, taken for one sensor: /robot, /second_driver")
        graph.withdraw(second)
        graph.nodes.append("/bevviz")
        publish(cloud, 1.0)
        assert session.told("/points has one publisher") and session.told("another node is called /bevviz")
        graph.withdraw(points)
        graph.advance(1.0)
        assert session.told("/points has no publisher any more; waiting for it to come back")
        assert session.source.states == {"/points": "no publisher"}


def ends_with(values: list[int], last: list[int]) -> bool:
    return values[-len(last) :] == last


def test_all_clouds_that_arrive_together_are_taken(graph: FedGraph, cloud: Any) -> None:
    points = graph.advertise("/points", CLOUD)
    seen: list[int] = []
    over = threading.Event()

    class Frames:
        def perceive(self, frame: Frame, network: object = None) -> Frame:
            return frame

        def finish(self, frame: Frame) -> Frame:
            seen.append(frame.stamp)
            return frame

    def tick() -> None:
        """Ctrl-C, noticed when the loop has ended already."""
        if over.is_set():
            stop.set()
            until(lambda: all(thread.name != "run" for thread in threading.enumerate()), "the end")
            raise KeyboardInterrupt

    def publish(clouds: int) -> list[int]:
        graph.advance(0.1)
        sent = []
        for _ in range(clouds):
            graph.advance(0.001)
            sent.append(graph.time_ns())
            graph.publish_now(points, cloud)
        return sent

    dropping, stop = DropPolicy(), threading.Event()
    with LiveSource(load()) as source:
        thread = threading.Thread(
            target=lambda: run(source, Frames(), dropping=dropping, stop=stop, tick=tick), daemon=True
        )
        thread.start()
        until(lambda: publish(1) and source.wait(0), "a scene")
        for clouds in (1, 2, 3, 1, 3, 2, 3):
            sent = publish(clouds)
            until(partial(ends_with, seen, sent), "those that came together")
        assert source.dropped == sum(dropping.dropped.values()) == 0
        over.set()
        until(lambda: publish(1) and not thread.is_alive(), "the end of the run")
        for _ in range(10):  # clouds that nobody takes
            publish(1)
        assert source.dropped == sum(dropping.dropped.values()) == 0


def test_the_first_frame_waits_for_its_calibration(graph: FedGraph) -> None:
    """CameraInfo and transforms of a robot that starts: the frames begin with them."""
    late = ("/tf_static", CAMERA_INFO_TOPIC)
    player = Player(graph, without=late)
    with joined(graph) as session:
        player.play(2.0)
        absent = "no transform from 'rslidar' to 'zed2_left_camera_optical_frame' yet"
        assert session.source.missing.startswith(absent) and not session.frames
        both = Player(
            graph, name="late", without=tuple(topic for topic in drive_of(Play()).types if topic not in late)
        )
        for _ in range(40):
            both.play(0.05)
            player.play(0.0)
    (camera,) = session.frames[0].cameras
    assert camera.intrinsics is not None and camera.camera_from_points is not None, session.said


@pytest.mark.long
def test_a_mounting_that_never_comes_is_not_waited_for_long(graph: FedGraph) -> None:
    player = Player(graph, without=("/tf_static",))
    with joined(graph) as session:
        player.play(5.0)
    assert session.told("not waited for any longer: no transform from 'rslidar'") and session.frames
    assert session.frames[-1].cameras[0].camera_from_points is None


@pytest.mark.long
def test_topics_that_cannot_be_received_are_reported(
    graph: FedGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without_vision_msgs(name: str) -> Any:
        if name.startswith("vision_msgs"):
            raise UserError("vision_msgs is not installed")
        return typesupport.message_type(name)

    monkeypatch.setattr("bevviz.live.graph.message_type", without_vision_msgs)
    player = Player(graph)
    with joined(graph, PATIENT) as session:
        player.play(8.0)
    (unheard,) = [text for text in session.said if "is not received" in text]
    assert unheard.startswith(f"{TRUTH_TOPIC} is not received: vision_msgs is not installed; its publishers")
    assert session.frames[-1].truth is None and session.frames[-1].cameras[0].image is not None


def test_a_silent_lidar_is_replaced_by_another(graph: FedGraph, cloud: Any) -> None:
    """The frames go on without what is silent or gone, and its state is told each time it changes."""
    topics = {name: graph.advertise(f"/{name}", CLOUD) for name in "ab"}
    silent: set[str] = set()

    with joined(graph, PATIENT, "sync.queue=1000") as session:

        def go_on(*texts: str, lidar: str) -> None:
            """Publish until each text is told and the frames follow a LiDAR."""
            session.said.clear()
            for _ in range(30):
                for name in topics.keys() - silent:
                    graph.publish_now(topics[name], cloud, name)
                graph.advance(0.1)
            assert [text for text in texts if not session.told(text)] == [], session.said
            assert {frame.clouds[0].topic for frame in session.frames[-4:]} == {lidar}

        go_on(lidar="/a")
        silent.add("a")
        go_on("/a does not deliver: the frames follow /b", "no message on /a", lidar="/b")
        silent.clear()
        go_on("the frames follow /a again", "/a is back", lidar="/a")
        graph.withdraw(topics.pop("a"))
        go_on("/a has no publisher any more", "the frames follow /b", lidar="/b")
        topics["a"] = graph.advertise("/a", CLOUD)
        go_on("/a is published again", lidar="/a")


def test_a_changed_frame_and_millimetres_are_told_at_once(graph: FedGraph, cloud: Any) -> None:
    points = graph.advertise("/a", CLOUD)
    shape = np.frombuffer(cloud.data, np.float32).reshape(-1, cloud.point_step // 4).copy()
    shape[:, :3] *= 1000
    large = replace(cloud, data=shape.view(np.uint8).ravel())
    with joined(graph) as session:
        for _ in range(30):
            graph.publish_now(points, cloud, "a")
            graph.advance(0.1)
        for message in (cloud, large):
            graph.publish_now(points, message, "odd")
            graph.advance(0.6)
    assert session.told("/a: its frame_id changed from 'a' to 'odd'")
    assert session.told("coordinates in millimetres")


def test_a_second_type_on_a_topic_is_named_and_not_used(graph: FedGraph, cloud: Any) -> None:
    stranger = graph.advertise("/a", "std_msgs/msg/String", node="stranger")
    points = graph.advertise("/a", CLOUD)
    with joined(graph) as session:
        for _ in range(30):
            graph.publish_now(points, cloud, "a")
            graph.publish(stranger, b"\0\1\0\0\0\0\0\0")
            graph.advance(0.1)
        clash = "/a has two types: /robot (sensor_msgs/msg/PointCloud2) is received, /stranger (std_msgs"
        assert session.told(clash) and session.frames and session.source.states == {"/a": "degraded"}
        graph.withdraw(stranger)
        graph.advance(0.6)
        assert session.told("/a has one type")


def test_what_helps_against_losses_depends_on_the_size() -> None:
    assert "segment" in remedy(1.9e6, 1.9e6) and "docs/live.md" in remedy(1.9e6, 1.9e6)
    assert "clouds or images fill the transport" in remedy(300, 1.9e6)
    assert "clouds of 50 MB" in remedy(1e6, 50e6) and "depth" in remedy(1e6, 50e6)
    assert "segment" not in remedy(300, 300) and "queue" in remedy(300, 300)


def test_images_that_wait_are_taken_with_the_first() -> None:
    """One for each cloud of 50 MB is what rclpy takes, and the middleware overwrites the others."""
    graph, taken = FedGraph(), list[bytes]()
    node: Any = SimpleNamespace(
        input=SimpleNamespace(create_subscription=lambda *given, **options: graph.subscribe(*given))
    )
    subscriptions = Subscriptions(node, (), lambda topic, data, info: taken.append(data))
    for kind in ("Image", "PointCloud2"):
        assert subscriptions.listen(PublishedTopic(f"/{kind}", f"sensor_msgs/msg/{kind}", ())) is None
    for subscription in graph.subscriptions:
        subscription.handle.messages += [(b"second", {}), (b"third", {})]
        subscription.receive(subscription.topic.encode(), {})
    assert taken == [b"/Image", b"second", b"third", b"/PointCloud2"]


@pytest.mark.long
def test_a_topic_of_an_unknown_type_is_named_as_not_saved(graph: FedGraph) -> None:
    graph.advertise("/arm/state", "arm_msgs/msg/State")
    player = Player(graph)
    with joined(graph, raw=RawRecorder(ReloadableConfig())) as session:
        player.play(NEEDED + 2.0)
        told = "/arm/state is not among the saved messages: arm_msgs/msg/State"
        assert session.told(told), session.said


def test_a_video_without_a_key_frame_is_named() -> None:
    video = Video("/camera/h264")
    assert not video.awaits_key
    video.add(VideoPacket(video.topic, 1, 1, "camera", "h264", b"\0", False))
    assert video.awaits_key
    video.add(VideoPacket(video.topic, 2, 2, "camera", "h264", b"\0", True))
    assert not video.awaits_key
