"""On a real graph: a player process publishes the synthetic drive over DDS on this machine."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bevviz.config import Config, keys, load
from bevviz.errors import UserError
from bevviz.messages.clouds import decode_cloud
from bevviz.messages.decoders import read_header
from bevviz.messages.definitions import typestore
from bevviz.messages.detections import decode_detections_2d, decode_detections_3d
from bevviz.messages.encode import (
    encode_boxes_3d,
    encode_camera_info,
    encode_cloud,
)
from bevviz.messages.images import decode_image
from bevviz.model.frame import Boxes3D, Frame, LateBoxes
from bevviz.model.results import CameraResult, Detections, FrameResult, Objects
from bevviz.pipeline.run import DropPolicy, run
from bevviz.pipeline.session import Session
from bevviz.synthetic import SyntheticSource
from bevviz.synthetic.bag import TOPICS
from bevviz.synthetic.drive import CAMERA_INFO_TOPIC, LIDAR_TOPIC, TRUTH_TOPIC
from tests.support.recordings import Recording, verify_when_indexed
from tests.support.ros_graphs import alone, own_domain, own_graph, playing
from tests.support.ros_player import Play
from tests.support.waiting import PATIENCE, until

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'bevviz[ros]'")

from bevviz.live import graph_info as info
from bevviz.live import typesupport
from bevviz.live.node import Node
from bevviz.live.publish import (
    BEV,
    CLUSTERS,
    DETECTIONS,
    FUSED,
    MARKERS,
    OBSTACLES,
    SPEED,
    TRACKS,
    Publisher,
    RosTopics,
)
from bevviz.live.publish import TOPICS as TOPICS_PUBLISHED
from bevviz.live.requests import RosRequests
from bevviz.live.source import LiveSource, remedy

LIGHT = Play(frames=3, points=20_000)


@pytest.fixture(scope="module")
def robot() -> Iterator[str]:
    """Yield the domain of a robot that plays for several tests."""
    with own_graph(), playing(LIGHT):
        yield os.environ["ROS_DOMAIN_ID"]


@pytest.fixture(autouse=True)
def domain(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Set the robot's domain, or that of an empty graph, on this machine only."""
    with ExitStack() as stack:
        shared = "robot" in request.fixturenames
        number = request.getfixturevalue("robot") if shared else stack.enter_context(own_domain())
        monkeypatch.setenv("ROS_DOMAIN_ID", number)
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield


def frames(source: LiveSource) -> Iterator[Frame]:
    assert source.wait(PATIENCE), source.missing
    return iter(source)


def test_frames_are_those_of_the_drive(robot: str) -> None:
    drive = [snapshot.frame for snapshot in map(SyntheticSource(frames=3).snapshot, range(3))]
    patient = ["sync.max_wait=10 s", "sync.queue=100"]  # a busy machine brings messages late
    with LiveSource(load(settings=patient)) as source:
        # Of a hundred images one is lost where nobody came for it in time.
        heard = list(islice((frame for frame in frames(source) if frame.cameras[0].image is not None), 6))
        assert source.scene.lidar == "rslidar" and source.scene.cameras == ("zed",) and source.scene.truth
        assert set(source.received) == set(TOPICS)
    assert [frame.index for frame in heard] == sorted({frame.index for frame in heard})
    for frame in heard:
        true = next(f for f in drive if np.array_equal(np.resize(f.points, (20_000, 3)), frame.points))
        (camera,), (expected,) = frame.cameras, true.cameras
        assert frame.problems == camera.problems == ()
        assert camera.image is not None and expected.image is not None
        np.testing.assert_array_equal(camera.image.bgr, expected.image.bgr)
        assert camera.camera_from_points is not None and expected.camera_from_points is not None
        np.testing.assert_allclose(camera.camera_from_points, expected.camera_from_points, atol=2e-3)
        assert camera.motion_compensated and camera.sync_error == pytest.approx(0.012, abs=1e-6)
        assert frame.world_frame == "map" and frame.world_from_points is not None
        assert frame.truth is not None and true.truth is not None
        assert frame.truth.labels == true.truth.labels
        np.testing.assert_allclose(frame.truth.boxes.center, true.truth.boxes.center, rtol=1e-6)
        assert 0 < time.time_ns() - frame.received < PATIENCE * 1e9


def test_the_newest_frame_wins(robot: str) -> None:
    with LiveSource(load()) as source:
        live = frames(source)
        before, dropped = next(live).index, source.dropped
        until(lambda: source.dropped >= dropped + 5, "frames that nobody took")
        least = source.dropped
        frame = next(live)
        assert least <= dropped + frame.index - before - 1 <= source.dropped  # it is the oldest that was not


def test_frames_do_not_wait_for_the_robots_results(robot: str) -> None:
    """One detector stamps its boxes a little after the scan, another one takes 0.7 s for them."""
    kind, cloud = "vision_msgs/msg/Detection3DArray", "sensor_msgs/msg/PointCloud2"
    one = Boxes3D(np.ones((1, 3), np.float32), np.ones((1, 3), np.float32), np.zeros(1, np.float32))
    scans: list[int] = []
    said: list[str] = []
    with Node(name="perception") as robots:
        node = robots.node
        soon, slow = (
            node.create_publisher(typesupport.message_type(kind), topic, 10)
            for topic in ("/soon/boxes", "/slow/boxes")
        )

        def perceive(data: bytes) -> None:
            scans.append(read_header(data, "<", LIDAR_TOPIC)[0])
            for publisher, stamp in ((soon, scans[-1] + 12_000_000), (slow, scans[-8:][0])):
                boxes = encode_boxes_3d(stamp, "rslidar", one, [[("car", 0.9)]])
                publisher.publish(bytes(typestore().serialize_cdr(boxes, kind)))

        node.create_subscription(typesupport.message_type(cloud), LIDAR_TOPIC, perceive, 5, raw=True)
        robots.start()
        with LiveSource(load(settings=["sync.max_wait=20"]), tell=said.append) as source:
            assert source.wait(PATIENCE)
            until(lambda: {"/soon/boxes", "/slow/boxes"} <= set(source.received), "results")
            source.overtaken()
            stamps: dict[int, int] = {}
            taken: Counter[str] = Counter()
            late: list[LateBoxes] = []

            def come(topic: str) -> int:
                mine = [found for found in late if found.boxes.topic == topic and found.index in stamps]
                return len(mine) + taken[topic]

            # With such a wait there were a frame in 20 s, did they wait.
            for frame in islice(source, 100):
                stamps[frame.index] = frame.stamp
                taken.update(box.topic for box in frame.robot_boxes)
                late += source.overtaken()
                if min(map(come, ("/soon/boxes", "/slow/boxes"))) > 2 and len(stamps) > 11:
                    break
    for topic, shift in (("/soon/boxes", 12_000_000), ("/slow/boxes", 0)):
        assert come(topic) > 2
        for found in late:
            if found.boxes.topic == topic and found.index in stamps:
                assert found.boxes.stamp - stamps[found.index] == shift
    assert sum(found.boxes.topic == "/slow/boxes" for found in late) > 2
    assert any(text.startswith("/slow/boxes comes when its frame has gone on") for text in said)


def test_a_stated_topic_can_be_remapped(robot: str) -> None:
    config = load(settings=["source.lidar_topics=[/points]"])
    with LiveSource(config, arguments=["-r", f"/points:={LIDAR_TOPIC}"]) as source:
        next(frames(source))
        assert source.roles.lidars == (LIDAR_TOPIC,)


def test_stated_topic_is_waited_for(robot: str) -> None:
    said: list[str] = []
    settings = ["source.lidar_topics=[/rosout]", "source.camera_topics=[/elsewhere]"]
    with LiveSource(load(settings=settings), tell=said.append) as source:
        absent = "nobody publishes /elsewhere, which source.camera_topics states"
        wrong = "/rosout is a rcl_interfaces/msg/Log, but source.lidar_topics takes PointCloud2 or LaserScan"
        until(lambda: source.missing == f"{wrong}; {absent}", "both")
        until(lambda: {absent, wrong} <= set(said), "both are told")
        assert not source.wait(0)


def test_info_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first command that a user runs: no LiDAR yet, then one without messages."""

    def describe(config: Config, missing: str) -> info.LiveInfo:
        for patience in (2.0, 10.0, 60.0):  # nodes of a busy machine take their time to meet
            made = info.describe(config, seconds=0.1, patience=patience)
            if made.missing[0].startswith(missing):
                break
        return made

    said: list[str] = []
    monkeypatch.setattr("bevviz.support.progress._say", said.append)
    with Node(name="half_a_robot") as robots:
        robots.start()
        made = describe(load(settings=["source.lidar_topics=[/points]"]), "nobody publishes /points")
        assert made.missing[0] == "nobody publishes /points, which source.lidar_topics states"
        assert any(line.startswith("waiting 2 s at most: nobody publishes /points") for line in said)
        cloud = typesupport.message_type("sensor_msgs/msg/PointCloud2")
        robots.node.create_publisher(cloud, "/points", 5)
        made = describe(load(), "no message on /points yet")
        assert made.missing == ("no message on /points yet", "no detector: --model FILE.onnx")


def test_stopped_topics_are_reported_and_so_is_their_return() -> None:
    said: list[str] = []
    kind = "sensor_msgs/msg/PointCloud2"
    with Node(name="driver") as driver, LiveSource(load(), tell=said.append) as source:
        driver.start()
        points = driver.node.create_publisher(typesupport.message_type(kind), "/points", 5)
        whole = encode_cloud(SyntheticSource(frames=1).snapshot(0).frame.clouds[0])
        flat = replace(whole, fields=[field for field in whole.fields if field.name != "z"])

        def publish(message: Any) -> bool:
            now = time.time_ns()
            stamp = replace(message.header.stamp, sec=now // 10**9, nanosec=now % 10**9)
            header = replace(message.header, stamp=stamp)
            points.publish(bytes(typestore().serialize_cdr(replace(message, header=header), kind)))
            return True

        def until_told(text: str, message: Any = None) -> None:
            def told() -> bool:
                if message is not None:
                    publish(message)
                return any(text in line for line in said)

            until(told, text)

        until_told("/points", flat)  # at the very first message
        assert source.states == {"/points": "unusable"}
        assert any("z" in line for line in said)
        until_told("/points: its messages can be used again", whole)
        until(lambda: publish(whole) and source.wait(0), "a scene")
        for _ in range(6):
            publish(whole)
            time.sleep(0.05)
        until_told("no cloud for 1.5 s on /points")
        until(lambda: source.states == {"/points": "silent"}, "the state")
        until_told("the clouds are back", whole)
        with Node(name="second_driver") as second:
            second.start()
            second.node.create_publisher(typesupport.message_type(kind), "/points", 5)
            until_told("/points has several publishers, taken for one sensor: /", whole)
        with Node(name="bevviz") as twin:
            twin.start()
            until_told("another node is called /bevviz")


def test_all_clouds_that_arrive_together_are_taken() -> None:
    kind = "sensor_msgs/msg/PointCloud2"
    whole = encode_cloud(SyntheticSource(frames=1).snapshot(0).frame.clouds[0])
    with Node(name="driver") as driver, LiveSource(load()) as source:
        driver.start()
        points = driver.node.create_publisher(typesupport.message_type(kind), "/points", 10)
        sent: list[int] = []

        def publish(clouds: int) -> bool:
            now = time.time_ns()
            sent[:] = [now + 1_000_000 * i for i in range(clouds)]
            for at in sent:
                stamp = replace(whole.header.stamp, sec=at // 10**9, nanosec=at % 10**9)
                cloud = replace(whole, header=replace(whole.header, stamp=stamp))
                points.publish(bytes(typestore().serialize_cdr(cloud, kind)))
            return True

        until(lambda: publish(1) and source.wait(0), "a scene")
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

        def work() -> None:
            run(source, Frames(), dropping=dropping, stop=stop, tick=tick)

        dropping, stop = DropPolicy(), threading.Event()
        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        for clouds in (1, 2, 3, 1, 3, 2, 3):
            publish(clouds)
            until(lambda: seen and seen[-1] == sent[-1], "the last of those that came together")
            assert seen[-clouds:] == sent
        assert source.dropped == sum(dropping.dropped.values()) == 0
        over.set()
        until(lambda: publish(1) and not thread.is_alive(), "the end of the run")
        before = source.received["/points"]
        until(lambda: publish(1) and source.received["/points"] > before + 10, "clouds that nobody takes")
        assert source.dropped == sum(dropping.dropped.values()) == 0


def test_the_first_frame_waits_for_its_calibration(monkeypatch: pytest.MonkeyPatch) -> None:
    """CameraInfo and transforms of a robot that starts: the frames begin with them."""
    monkeypatch.setattr("bevviz.live.source.PATIENCE", PATIENCE)
    said: list[str] = []
    late = ("/tf_static", CAMERA_INFO_TOPIC)
    only = tuple(TOPICS.keys() - {CAMERA_INFO_TOPIC})
    static = tuple(TOPICS.keys() - {"/tf_static"})
    with playing(replace(LIGHT, without=late)), LiveSource(load(), tell=said.append) as source:
        until(lambda: source.received[LIDAR_TOPIC] > 3, "clouds")
        absent = "no transform from 'rslidar' to 'zed2_left_camera_optical_frame' yet"
        until(lambda: source.missing.startswith(absent), "what is waited for")
        assert not source.wait(1.5)
        info, transforms = (
            Play(frames=1, name=name, without=w) for name, w in (("info", only), ("tf", static))
        )
        with playing(info), playing(transforms):
            frame = next(frames(source))
        (camera,) = frame.cameras
        assert camera.intrinsics is not None and camera.camera_from_points is not None, said


def test_info_shows_the_graph(robot: str) -> None:
    made = info.describe(load(), seconds=2.0)
    topics = {topic.name: topic for topic in made.topics}
    assert topics.keys() >= TOPICS.keys() | {"/rosout"}
    cloud = topics[LIDAR_TOPIC]
    assert cloud.count and cloud.rate and cloud.frame_id == "rslidar"
    assert made.seconds >= 2.0 and cloud.rate == pytest.approx(cloud.count / made.seconds)
    assert topics["/rosout"].count is None and topics["/rosout"].role == ""
    assert topics["/tf_static"].role == "static transforms; from /player (reliable, latched)"
    assert made.tree["rslidar"] == "base_link" and made.world_frame == "map"
    assert made.missing == ("no detector: --model FILE.onnx",)
    text = info.render(made)
    assert text.startswith(f"graph   ROS_DOMAIN_ID {robot}, rmw_fastrtps_cpp\n")
    assert "zed: 640 x 360 uncompressed" in text


def test_topics_that_cannot_be_received_are_reported(robot: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def without_vision_msgs(name: str) -> Any:
        if name.startswith("vision_msgs"):
            raise UserError("vision_msgs is not installed")
        return typesupport.message_type(name)

    monkeypatch.setattr("bevviz.live.graph.message_type", without_vision_msgs)
    said: list[str] = []
    with LiveSource(load(settings=["sync.max_wait=20"]), tell=said.append) as source:
        heard = list(islice(frames(source), 3))
        until(lambda: any("is not received" in text for text in said), "what is not received")
    (unheard,) = [text for text in said if "is not received" in text]
    assert unheard.startswith(f"{TRUTH_TOPIC} is not received: vision_msgs is not installed; /player, which")
    assert heard[-1].truth is None and heard[-1].cameras[0].image is not None


def test_what_helps_against_losses_depends_on_the_size() -> None:
    assert "segment" in remedy(1.9e6, 1.9e6) and "docs/live.md" in remedy(1.9e6, 1.9e6)
    assert "clouds or images fill the transport" in remedy(300, 1.9e6)
    assert "segment" not in remedy(300, 300) and "queue" in remedy(300, 300)


@pytest.mark.parametrize("domain", ["500", "one"])
def test_a_wrong_domain_is_refused(domain: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    with pytest.raises(UserError, match=f"ROS_DOMAIN_ID={domain}: a domain is a number from 0 to 232"):
        Node()


def test_wrong_arguments_are_refused() -> None:
    with pytest.raises(UserError, match="ROS does not start"):
        LiveSource(load(), arguments=["-r", "no rule"])


def test_a_late_publisher_may_restart_with_other_qos() -> None:
    said: list[str] = []
    with LiveSource(load(), tell=said.append) as source:
        assert not source.wait(1.0)
        assert "nothing is published on ROS domain" in source.missing
        with playing(LIGHT):
            live = frames(source)
            first = next(live)
        until(lambda: f"{LIDAR_TOPIC} has no publisher" in "".join(said), "the publisher's end is told")
        assert any(text.startswith("/tf_static has no publisher") for text in source.warnings)
        with playing(replace(LIGHT, best_effort=True, focal=1.25)):
            until(lambda: any("calibration" in text for text in said), "the new calibration is told")
            told = time.time_ns()  # what nobody took before is still handed out
            second = next(frame for frame in live if frame.received > told)
        before, after = first.cameras[0].intrinsics, second.cameras[0].intrinsics
        assert before is not None and after is not None
        assert after.K[0, 0] == pytest.approx(1.25 * before.K[0, 0])
        assert second.index > first.index and second.stamp > first.stamp
        assert f"{LIDAR_TOPIC} is published again" in said


def test_incompatible_publisher_is_told() -> None:
    said: list[str] = []
    only_static = tuple(TOPICS.keys() - {"/tf_static"})
    with (
        playing(LIGHT),
        playing(Play(frames=1, name="volatile", latched=False, without=only_static)),
        LiveSource(load(), tell=said.append) as source,
    ):
        frame = next(frames(source))
        told = "/tf_static: /volatile is not heard, its quality of service does not fit (Volatile publisher"
        until(lambda: any(text.startswith(told) for text in source.warnings), "the mismatch")
        assert any(text.startswith(told) for text in said)
        assert frame.cameras[0].camera_from_points is not None


# --- types without a wheel ---------------------------------------------------------------------


@pytest.fixture
def pair() -> Iterator[tuple[Node, Node]]:
    """Two participants."""
    with Node(name="one") as one, Node(name="two") as two:
        one.start()
        two.start()
        yield one, two


def test_generated_types_match_compiled_ones(pair: tuple[Node, Node]) -> None:
    from sensor_msgs.msg import CameraInfo

    kind = "sensor_msgs/msg/CameraInfo"
    made = typesupport._from_definition(kind)
    compiled: list[Any] = []
    raw: list[bytes] = []
    one, two = (session.node for session in pair)
    one.create_subscription(CameraInfo, "/made", compiled.append, 10)
    one.create_subscription(made, "/compiled", raw.append, 10, raw=True)
    from_made, from_compiled = (
        two.create_publisher(made, "/made", 10),
        two.create_publisher(CameraInfo, "/compiled", 10),
    )
    until(lambda: from_made.get_subscription_count() and from_compiled.get_subscription_count(), "a match")

    camera = SyntheticSource(frames=1).snapshot(0).frame.cameras[0]
    assert camera.image is not None and camera.intrinsics is not None
    sent = encode_camera_info(camera.image, camera.intrinsics)
    from_made.publish(bytes(typestore().serialize_cdr(sent, kind)))
    until(lambda: compiled, "a message of the made type")
    message = compiled[0]
    assert (message.width, message.header.frame_id) == (640, camera.image.frame_id)
    np.testing.assert_array_equal(message.k, sent.k)

    from_compiled.publish(message)
    until(lambda: raw, "a message of the compiled type")
    back: Any = typestore().deserialize_cdr(raw[0], kind)
    assert back.header == sent.header and back.roi == sent.roi
    np.testing.assert_array_equal(back.p, sent.p)

    hashes = {
        bytes(info.topic_type_hash.value)
        for topic in ("/made", "/compiled")
        for info in [*one.get_publishers_info_by_topic(topic), *one.get_subscriptions_info_by_topic(topic)]
    }
    assert len(hashes) == 1, "type hashes differ"


@pytest.mark.parametrize(
    ("name", "generated"),
    [
        ("tf2_msgs/msg/TFMessage", "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"),
        (
            "vision_msgs/msg/Detection2DArray",
            "214274120007f4a683866481336b70310268cfa107aebe9d594a6acf75bda968",
        ),
        (
            "vision_msgs/msg/Detection3DArray",
            "793f5eab9595ac1c0da07873cc859db42eae51f0ee76056db8562515d830e018",
        ),
    ],
)
def test_type_hashes_equal_those_of_the_packages(name: str, generated: str) -> None:
    """By rosidl's own generator, from the .msg files that Jazzy ships."""
    assert typestore().hash_rihs01(name) == f"RIHS01_{generated}"


def test_a_type_without_its_package_is_reported() -> None:
    with pytest.raises(UserError, match="AMENT_PREFIX_PATH: source the workspace that has it"):
        typesupport.message_type("no_such_msgs/msg/Thing")


# --- publishing back ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def result() -> FrameResult:
    """Return the result of a frame in which the detector found one car, on the first cluster."""
    config = load()
    session = Session(config)
    made = session.run(SyntheticSource(frames=1).snapshot(0).frame)
    assert made.clusters is not None
    one, zero = np.ones(1, np.float32), np.zeros(1, np.int32)
    car = Detections(
        np.array([[10, 20, 110, 70]], np.float32), one * 0.75, zero, ("car",), zero, zero - 1, one
    )
    row = made.clusters.obb
    boxes = Boxes3D(row.center[:1], row.size[:1], row.yaw[:1])
    objects = Objects(boxes, ("car",), one * 0.75, zero, ("zed",), zero)
    camera = CameraResult(made.cameras[0].camera, car, None)
    assert made.tracks is not None
    tracks = replace(
        made.tracks,
        names=("car", *made.tracks.names[1:]),
        confirmed=np.arange(len(made.tracks)) == 0,
        velocity=np.full_like(made.tracks.velocity, 1.5),
    )
    return replace(made, cameras=(camera,), objects=objects, tracks=tracks)


def test_published_results_are_not_read_back(result: FrameResult) -> None:
    heard: dict[str, Any] = {}
    kinds = {BEV: "Image", OBSTACLES: "PointCloud2", CLUSTERS: "Detection3DArray", FUSED: "Detection3DArray"}
    kinds |= {DETECTIONS: "Detection2DArray", TRACKS: "Detection3DArray", MARKERS: "MarkerArray"}
    with LiveSource(load()) as source, Node(name="rviz") as rviz:
        topics = RosTopics(source.node)
        publisher = Publisher(load(), [topics])
        publisher.publish(result)  # for nobody
        for topic, short in kinds.items():
            kind = TOPICS_PUBLISHED[topic]
            assert kind.endswith(f"/{short}")

            def receive(data: bytes, topic: str = topic, kind: str = kind) -> None:
                heard[topic] = typestore().deserialize_cdr(data, kind)

            rviz.node.create_subscription(typesupport.message_type(kind), topic, receive, 10, raw=True)
        rviz.start()

        def all_heard() -> bool:
            publisher.publish(result)
            return len(heard) == len(kinds)

        until(all_heard, f"all of {set(kinds)}")
        until(lambda: len(rviz.node.get_publishers_info_by_topic(BEV)) == 1, "the graph")
        until(lambda: "no LiDAR" in source.missing, "the source has looked around")
        time.sleep(1.0)  # twice
        assert source.roles.lidars == () and "no LiDAR" in source.missing

    frame, image = result.frame, result.cameras[0].camera.image
    assert result.bev is not None and result.obstacles is not None and result.clusters is not None
    assert result.objects is not None and image is not None
    bev = decode_image(heard[BEV], BEV, 0)
    assert (bev.stamp, bev.frame_id, heard[BEV].encoding) == (frame.stamp, "rslidar", "bgr8")
    np.testing.assert_array_equal(bev.bgr, result.bev.image)
    cloud = decode_cloud(heard[OBSTACLES], OBSTACLES, 0)
    assert (cloud.stamp, cloud.frame_id) == (frame.stamp, "rslidar")
    np.testing.assert_array_equal(cloud.xyz, result.obstacles)
    clusters = decode_detections_3d(heard[CLUSTERS], CLUSTERS, 0)
    kept = np.flatnonzero(result.clusters.state == 0)
    assert len(kept) and clusters.labels == tuple(f"cluster_{row}" for row in kept)
    np.testing.assert_allclose(clusters.boxes.size, result.clusters.obb.size[kept], rtol=1e-6)
    np.testing.assert_allclose(clusters.boxes.yaw, result.clusters.obb.yaw[kept], atol=1e-6)
    fused = heard[FUSED].detections[0]
    assert [h.hypothesis.class_id for h in fused.results] == ["cluster_0", "car"]
    assert [h.hypothesis.score for h in fused.results] == [1.0, 0.75]
    assert result.tracks is not None
    (track,) = heard[TRACKS].detections
    assert track.header.frame_id == result.tracks.frame_id and track.id == str(result.tracks.id[0])
    speed = result.tracks.speed[0]
    assert [h.hypothesis.class_id for h in track.results] == ["car", SPEED]
    assert track.results[1].hypothesis.score == pytest.approx(float(speed))
    markers = {marker.ns: marker for marker in heard[MARKERS].markers}
    assert markers["names"].text == f"car #{track.id} {speed:.1f} m/s"
    scale = markers["boxes"].scale
    np.testing.assert_allclose([scale.x, scale.y, scale.z], result.tracks.boxes.size[0], rtol=1e-6)
    ends = [(point.x, point.y, point.z) for point in markers["ways"].points]
    np.testing.assert_allclose(np.subtract(ends[1], ends[0]), result.tracks.velocity[0], atol=1e-5)
    seen = decode_detections_2d(heard[DETECTIONS], DETECTIONS, 0)
    assert (seen.stamp, seen.frame_id, seen.labels) == (image.stamp, image.frame_id, ("car",))
    np.testing.assert_allclose(seen.xyxy, [[10, 20, 110, 70]])


# --- orders ------------------------------------------------------------------------------------


def call(node: Any, client: Any, request: Any) -> Any:
    assert client.wait_for_service(PATIENCE)
    answer = client.call_async(request)
    until(answer.done, "an answer")
    return answer.result()


def test_parameters_and_the_saving_of_the_recording(pair: tuple[Node, Node]) -> None:
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter
    from std_srvs.srv import Trigger

    config = load(preset="reference")
    ordered: list[str] = []

    def change(settings: list[str]) -> None:
        nonlocal config
        config = load(settings=settings, preset="reference")
        ordered.extend(settings)

    full = False

    def save() -> Path:
        if full:
            raise UserError("no space left in /tmp")
        return Path("/tmp/robot.rrd")

    robot, operator = pair
    orders = RosRequests(robot.node, config, change, save)
    client = operator.node.create_client(SetParameters, "/one/set_parameters")

    def set_to(name: str, value: Any) -> Any:
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        return call(operator.node, client, request).results[0]

    assert robot.node.get_parameter("range_x").value == 10.0
    assert set_to("range_x", 25).successful  # an integer, as `ros2 param set` makes of it
    assert set_to("max_cluster_size", 500).successful
    assert config.clustering.max_cluster_points == 500
    orders.show(config)
    assert set_to("max_cluster_size", 0).successful
    assert config.clustering.max_cluster_points is None
    assert ordered == [
        "bev.range_x=25",
        "clustering.max_cluster_points=500",
        "clustering.max_cluster_points=null",
    ]
    refused = set_to("voxel_size", -1.0)
    assert not refused.successful and "voxel_size out of range" in refused.reason
    (allowed,) = robot.node.describe_parameter("clustering.eps").floating_point_range
    assert 0 == allowed.from_value < allowed.to_value < 1000
    assert robot.node.get_parameter("voxel_size").value == 0.05

    orders.show(load(settings=["voxel_size=0.2"], preset="reference"))
    assert robot.node.get_parameter("voxel_size").value == 0.2
    assert len(ordered) == 3, "what is shown is no order"

    del ordered[:]
    settings = {
        "clustering.eps": "60 cm",
        "live.max_rate": 5,
        "live.triggers": ["tf", "stage"],
        "source.lidar_topics": "[/points]",
        "sync.motion_compensation": True,
    }
    assert all(set_to(name, value).successful for name, value in settings.items())
    orders.show(config)
    assert (config.clustering.eps, config.live.triggers) == (0.5, ()), "each order is alone in this test"
    assert set_to("live.max_rate", 5).successful and set_to("live.max_rate", "").successful
    assert ordered == [
        "clustering.eps=60 cm",
        "live.max_rate=5",
        'live.triggers=["tf", "stage"]',
        "source.lidar_topics=[/points]",
        "sync.motion_compensation=true",
        "live.max_rate=5",
    ]
    orders.show(load(settings=["live.max_rate=5"], preset="reference"))
    assert set_to("live.max_rate", "").successful and ordered[-1] == "live.max_rate=null"
    assert not set_to("live.triggers", ["typhoon"]).successful
    assert {name for name in keys() if not robot.node.has_parameter(name)} == set()

    trigger = operator.node.create_client(Trigger, "/one/save_recording")
    answer = call(operator.node, trigger, Trigger.Request())
    assert (answer.success, answer.message) == (True, "/tmp/robot.rrd")
    full = True
    answer = call(operator.node, trigger, Trigger.Request())
    assert (answer.success, answer.message) == (False, "no space left in /tmp")


def test_the_command_runs_beside_a_robot(robot: str, tmp_path: Path) -> None:
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter
    from std_srvs.srv import Trigger

    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    environment |= alone(tmp_path)
    command = [sys.executable, "-m", "bevviz.cli", "live", "--publish", "--save", "all.rrd"]
    command += ["--preset", "reference", "--ros-args", "-p", "range_x:=12.0", "-r", f"{BEV}:=/seen"]
    run = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=tmp_path, env=environment)
    heard: dict[str, list[Any]] = {"/seen": [], CLUSTERS: []}
    answer: Any = None
    try:
        with Node(name="operator") as operator:
            operator.start()
            node = operator.node
            for topic, kind in (("/seen", TOPICS_PUBLISHED[BEV]), (CLUSTERS, TOPICS_PUBLISHED[CLUSTERS])):
                node.create_subscription(
                    typesupport.message_type(kind),
                    topic,
                    lambda data, topic=topic, kind=kind: heard[topic].append(
                        typestore().deserialize_cdr(data, kind)
                    ),
                    10,
                    raw=True,
                )
            until(lambda: all(heard.values()) or run.poll() is not None, "results on the graph")
            assert {(m.height, m.width, m.encoding) for m in heard["/seen"]} == {(480, 400, "bgr8")}
            assert {m.header.frame_id for m in heard[CLUSTERS]} == {"rslidar"}

            change = SetParameters.Request(parameters=[Parameter("range_x", value=6.0).to_parameter_msg()])
            client = node.create_client(SetParameters, "/bevviz/set_parameters")
            assert call(node, client, change).results[0].successful
            until(lambda: heard["/seen"][-1].height == 240, "an image of the new range")

            client = node.create_client(Trigger, "/bevviz/save_recording")

            def saved() -> bool:
                nonlocal answer
                answer = call(node, client, Trigger.Request())
                return bool(answer.success)

            until(saved, "a recording of what was published, once it is logged, too")
    finally:
        run.send_signal(signal.SIGTERM)
        _, said = run.communicate(timeout=PATIENCE)
    assert run.returncode == 0, said
    assert "configuration: bev.range_x 12.0 -> 6.0" in said and "Traceback" not in said
    for path in (tmp_path / "all.rrd", tmp_path / answer.message):
        verify_when_indexed(path)
        recording = Recording(path)
        assert recording.rows["/bev"]  # of what was saved at once there may be one frame
        configs = recording.static["/config"] or recording.rows["/config"]
        assert "range_x" in str(configs)


def test_commands_work_before_the_robot_starts(tmp_path: Path) -> None:
    """SIGUSR1 and snap are answered, parameters are taken, and a wrong one ends the command at once."""
    environment = os.environ | alone(tmp_path)
    command = [sys.executable, "-m", "bevviz.cli", "live", "--observe"]
    wrong = [*command, "--ros-args", "-p", "voxel_size:=-1"]
    refused = subprocess.run(wrong, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert refused.returncode == 2 and "voxel.size must be greater than or equal to 0" in refused.stderr
    run = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=tmp_path, env=environment)
    assert run.stderr is not None
    try:
        assert run.stderr.readline().startswith("bevviz: waiting: nothing is published")
        run.send_signal(signal.SIGUSR1)
        assert "there is nothing to save yet" in run.stderr.readline()
        snap = [sys.executable, "-m", "bevviz.cli", "snap"]
        asked = subprocess.run(
            snap, capture_output=True, text=True, env=environment, timeout=PATIENCE, check=False
        )
        assert asked.returncode == 2
        assert "there is nothing to save yet; waiting: nothing is published" in asked.stderr
    finally:
        run.send_signal(signal.SIGTERM)
        _, said = run.communicate(timeout=PATIENCE)
    assert run.returncode == 1 and said == ""


def test_another_middleware_is_refused_and_not_aborted() -> None:
    command = [sys.executable, "-m", "bevviz.cli", "info", "--live"]
    environment = dict(os.environ) | {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}
    done = subprocess.run(
        command, capture_output=True, text=True, env=environment, timeout=PATIENCE, check=False
    )
    if done.returncode == 0:
        pytest.skip("rmw_cyclonedds_cpp is installed here")
    assert done.returncode == 2
    assert "RMW_IMPLEMENTATION=rmw_cyclonedds_cpp is not installed for this Python" in done.stderr


def test_parameters_of_the_command_line() -> None:
    ordered: list[str] = []
    arguments = ["-p", "range_y:=12.5", "-r", "__node:=eye", "-r", "__ns:=/robot1"]
    with Node(arguments) as session:
        RosRequests(session.node, Config(), ordered.extend)
        assert session.node.get_fully_qualified_name() == "/robot1/eye"
        assert session.resolve("points") == "/robot1/points"
    assert ordered == ["bev.range_y=12.5"]
