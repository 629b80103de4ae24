"""On a real graph: a player process publishes the synthetic drive over DDS on this machine."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from bevviz.cli import main
from bevviz.config import Config, load
from bevviz.errors import UserError
from bevviz.extras.demo.drive import LIDAR_TOPIC
from bevviz.messages.clouds import decode_cloud
from bevviz.messages.definitions import typestore
from bevviz.messages.detections import decode_detections_2d, decode_detections_3d
from bevviz.messages.images import decode_image
from bevviz.model.frame import Boxes3D, Frame
from bevviz.model.results import CameraResult, Detections, FrameResult, Objects
from bevviz.pipeline.session import Session
from bevviz.recording.sinks import HEADER_BYTES, MESSAGE_HEADER
from bevviz.support.files import unfinished_files
from tests.support import kept_drives
from tests.support.commands import Capture, environment, error_of
from tests.support.played_drive import drive_of
from tests.support.recordings import Recording
from tests.support.ros_graphs import alone, own_domain, own_graph, playing
from tests.support.ros_player import Play
from tests.support.waiting import PATIENCE, until

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'bevviz[ros]'")

from bevviz.extras.ros_node.topics import RosTopics
from bevviz.live import graph_info as info
from bevviz.live import typesupport
from bevviz.live.node import Node, middlewares
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
)
from bevviz.live.publish import TOPICS as TOPICS_PUBLISHED
from bevviz.live.source import LiveSource
from bevviz.live.status import Notes

TYPES = drive_of(Play()).types
PLAY = Play(points=20_000)  # a cloud goes over the wire in several pieces


@pytest.fixture(scope="module")
def robot() -> Iterator[str]:
    """Yield the domain of a robot that plays for several tests."""
    with own_graph(), playing(PLAY):
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
    drive = kept_drives.frames()[:3]
    patient = ["sync.max_wait=10 s", "sync.queue=100"]  # a busy machine brings messages late
    with LiveSource(load(settings=patient)) as source:
        # Of a hundred images one is lost where nobody came for it in time.
        heard = list(islice((frame for frame in frames(source) if frame.cameras[0].image is not None), 6))
        assert source.scene.lidar == "rslidar" and source.scene.cameras == ("zed",) and source.scene.truth
        assert set(source.watch.received) == set(TYPES)
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


@pytest.mark.long
def test_info_shows_the_graph(robot: str) -> None:
    made = info.describe(load(), seconds=1.0)
    topics = {topic.name: topic for topic in made.topics}
    assert topics.keys() >= TYPES.keys() | {"/rosout"}
    cloud = topics[LIDAR_TOPIC]
    assert cloud.count and cloud.rate and cloud.frame_id == "rslidar"
    assert made.seconds >= 1.0 and cloud.rate == pytest.approx(cloud.count / made.seconds)
    assert topics["/rosout"].count is None and topics["/rosout"].role == ""
    assert topics["/tf_static"].role == "static transforms; from /player (reliable, latched)"
    assert made.transforms["rslidar"] == "base_link" and made.world_frame == "map"
    assert made.missing == ("no detector: --model FILE.onnx",)
    text = info.render(made)
    assert text.startswith(f"graph   ROS_DOMAIN_ID {robot}, rmw_fastrtps_cpp\n")
    assert "zed: 640 x 360" in text


@pytest.mark.parametrize("domain", ["500", "one"])
def test_a_wrong_domain_is_refused(domain: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    with pytest.raises(UserError, match=f"ROS_DOMAIN_ID={domain}: a domain is a number from 0 to 232"):
        Node()


def test_wrong_arguments_are_refused() -> None:
    with pytest.raises(UserError, match="-r no rule: expected FROM:=TO"):
        LiveSource(load(), arguments=["-r", "no rule"])
    with pytest.raises(UserError, match="-r __ns:=van: a namespace begins with a slash: __ns:=/van"):
        LiveSource(load(), arguments=["-r", "__ns:=van"])
    with pytest.raises(UserError, match="ROS does not start"):
        LiveSource(load(), arguments=["-p", "no value"])


@pytest.mark.long
def test_a_late_publisher_may_restart_with_other_qos() -> None:
    said: list[str] = []
    with LiveSource(load(), tell=said.append) as source:
        assert not source.wait(1.0)
        assert "nothing is published on ROS domain" in source.missing
        with playing(PLAY):
            live = frames(source)
            first = next(live)
        until(lambda: f"{LIDAR_TOPIC} has no publisher" in "".join(said), "the publisher's end is told")
        assert any(str(one).startswith("/tf_static has no publisher") for one in source.problems.current)
        with playing(replace(PLAY, best_effort=True, focal=1.25)):
            until(lambda: any("calibration" in text for text in said), "the new calibration is told")
            told = time.time_ns()  # what nobody took before is still handed out
            second = next(frame for frame in live if frame.received > told)
        before, after = first.cameras[0].intrinsics, second.cameras[0].intrinsics
        assert before is not None and after is not None
        assert after.K[0, 0] == pytest.approx(1.25 * before.K[0, 0])
        assert second.index > first.index and second.stamp > first.stamp
        assert f"{LIDAR_TOPIC} is published again" in said


@pytest.mark.long
def test_incompatible_publisher_is_told(robot: str) -> None:
    said: list[str] = []
    only_static = tuple(TYPES.keys() - {"/tf_static"})
    with (
        playing(replace(PLAY, name="volatile", latched=False, without=only_static)),
        LiveSource(load(), tell=said.append) as source,
    ):
        frame = next(frames(source))
        told = "/tf_static: /volatile is not heard, its quality of service does not fit (Volatile publisher"
        until(lambda: any(str(one).startswith(told) for one in source.problems.current), "the mismatch")
        assert any(text.startswith(told) for text in said)
        assert frame.cameras[0].camera_from_points is not None


# --- types without a wheel ---------------------------------------------------------------------


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
    made = session.run(kept_drives.frame(0))
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
        rviz.start()
        topics = RosTopics(source.nodes.node)
        publisher = Publisher([topics], Notes(print))
        publisher.publish(result)  # for nobody
        for topic, short in kinds.items():
            kind = TOPICS_PUBLISHED[topic]
            assert kind.endswith(f"/{short}")

            def receive(data: bytes, topic: str = topic, kind: str = kind) -> None:
                heard[topic] = typestore().deserialize_cdr(data, kind)

            rviz.node.create_subscription(typesupport.message_type(kind), topic, receive, 10, raw=True)

        def all_heard() -> bool:
            publisher.publish(result)
            return len(heard) == len(kinds)

        until(all_heard, f"all of {set(kinds)}")
        rviz.node.create_publisher(typesupport.message_type("std_msgs/msg/String"), "/later", 10)
        until(lambda: "/later" in source.topics, "a look of the source at all of these topics")
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


# --- the command -------------------------------------------------------------------------------


def call(client: Any, request: Any) -> Any:
    assert client.wait_for_service(PATIENCE)
    answer = client.call_async(request)
    until(answer.done, "an answer")
    return answer.result()


@contextmanager
def live(folder: Path, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Run ``bevviz live`` in a folder. It is killed if the test fails."""
    command = [sys.executable, "-m", "bevviz.cli", "live", *arguments]
    run = subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, cwd=folder, env=environment() | alone(folder)
    )
    try:
        yield run
    except BaseException:
        run.kill()
        print(run.communicate()[1])
        raise
    finally:
        run.kill()
        run.wait()


@pytest.mark.long
def test_a_run_is_killed_started_again_and_ordered(
    robot: str, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A user, systemd and the robot's operator act on ``bevviz live`` in one day."""
    # A process that is killed amid a message may leave Fast DDS's shared memory locked for those after it.
    monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter
    from std_srvs.srv import Trigger

    arguments = ["--publish", "--save", "drive.rrd", "--save", "drive.mcap", "--preset", "reference"]
    arguments += [
        "--set",
        "live.max_rate=5",
        "--flight",
        "2 s",
        "--ros-args",
        "-p",
        "range_x:=12.0",
        "-r",
        f"{BEV}:=/seen",
    ]
    recording, bag = tmp_path / "drive.rrd", tmp_path / "drive.mcap"
    with live(tmp_path, *arguments) as run:
        until(
            lambda: run.poll() is not None or (is_large(recording) and unfinished_files(bag)), "a recording"
        )
        run.send_signal(signal.SIGKILL)
    killed = recording.read_bytes()

    heard: dict[str, list[Any]] = {"/seen": [], CLUSTERS: []}
    with live(tmp_path, *arguments) as run, Node(name="operator") as operator:
        operator.start()
        node = operator.node
        for topic, kind in (("/seen", TOPICS_PUBLISHED[BEV]), (CLUSTERS, TOPICS_PUBLISHED[CLUSTERS])):

            def hear(data: bytes, topic: str = topic, kind: str = kind) -> None:
                heard[topic].append(typestore().deserialize_cdr(data, kind))

            node.create_subscription(typesupport.message_type(kind), topic, hear, 10, raw=True)
        until(lambda: all(heard.values()) or run.poll() is not None, "results on the graph")
        assert {(m.height, m.width, m.encoding) for m in heard["/seen"]} == {(480, 400, "bgr8")}
        assert {m.header.frame_id for m in heard[CLUSTERS]} == {"rslidar"}

        change = SetParameters.Request(parameters=[Parameter("range_x", value=6.0).to_parameter_msg()])
        client = node.create_client(SetParameters, "/bevviz/set_parameters")
        assert call(client, change).results[0].successful
        until(lambda: heard["/seen"][-1].height == 240, "an image of the new range")
        client = node.create_client(Trigger, "/bevviz/save_recording")
        answer = until(lambda: (a := call(client, Trigger.Request())).success and a, "a logged frame")

        with pytest.MonkeyPatch.context() as patch:
            for name, value in alone(tmp_path).items():
                patch.setenv(name, value)
            patch.setattr(tempfile, "tempdir", None)
            patch.chdir(tmp_path)
            assert main(["snap", "mine.rrd"]) == 0
            paths = [str(tmp_path / name) for name in ("mine.rrd", "mine.mcap")]
            assert capsys.readouterr().out.split() == paths
            assert "mine.rrd: is already there" in error_of(capsys, "snap", "mine.rrd", "--pid", str(run.pid))
            assert "no 'bevviz live' of yours with process id 1" in error_of(capsys, "snap", "--pid", "1")

            def complete() -> set[Path]:
                return {path for path in tmp_path.glob("flight_*.rrd") if ".partial-" not in path.name}

            saved = complete()
            run.send_signal(signal.SIGUSR1)
            (signalled,) = until(lambda: complete() - saved, "a recording")
            until(lambda: signalled.with_suffix(".mcap").exists(), "its bag")
            run.send_signal(signal.SIGTERM)
            run.send_signal(signal.SIGTERM)  # somebody has no patience
            _, said = run.communicate(timeout=PATIENCE)
            assert "no 'bevviz live' of yours runs" in error_of(capsys, "snap")
    assert run.returncode == 0 and "Traceback" not in said, said
    again = (
        "an earlier run is saved in drive.rrd and drive.mcap: this one goes to drive-2.rrd and drive-2.mcap"
    )
    assert again in said and "configuration: bev.range_x 12.0 -> 6.0" in said
    assert "drive.mcap: " in said and "messages of a run that was killed, completed" in said
    assert (
        f"flight recorder saved in {signalled.name} and {signalled.stem}.mcap" in said and "(SIGUSR1)" in said
    )
    assert recording.read_bytes() == killed and shown_in(without_its_end(recording, tmp_path))
    names = ("drive-2.rrd", "mine.rrd", signalled.name, answer.message)
    for path in (tmp_path / name for name in names):
        assert shown_in(path)
        static = Recording(path).static["/config"] or Recording(path).rows["/config"]
        assert "range_x" in str(static)
    for path in (bag, *(tmp_path / name for name in names)):
        with path.with_suffix(".mcap").open("rb") as file:
            summary = make_reader(file, validate_crcs=True).get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count > 20


def is_large(path: Path) -> bool:
    return path.exists() and path.stat().st_size > 1_000_000


def shown_in(path: Path) -> list[int]:
    """Return the frames of a recording."""
    return [row["frame"] for row in Recording(path).rows["/explain"]]


def without_its_end(recording: Path, folder: Path) -> Path:
    """Return a copy of what a killed process wrote, without a last message that it did not finish.

    The viewer reads such a file, the SDK does not.
    """
    data, copy, end = recording.read_bytes(), folder / "whole.rrd", HEADER_BYTES
    while len(data) - end >= MESSAGE_HEADER.size:
        _, size = MESSAGE_HEADER.unpack_from(data, end)
        if end + MESSAGE_HEADER.size + size > len(data):
            break
        end += MESSAGE_HEADER.size + size
    copy.write_bytes(data[:end])
    return copy


@pytest.mark.long
def test_commands_work_before_the_robot_starts(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SIGUSR1 and snap are answered, and a wrong parameter ends the command at once."""
    monkeypatch.chdir(tmp_path)
    wrong = error_of(capsys, "live", "--observe", "--ros-args", "-p", "voxel_size:=-1")
    assert "voxel.size must be greater than or equal to 0" in wrong
    with live(tmp_path, "--observe") as run:
        assert run.stderr is not None
        assert run.stderr.readline().startswith("bevviz: waiting: nothing is published")
        run.send_signal(signal.SIGUSR1)
        assert "there is nothing to save yet" in run.stderr.readline()
        for name, value in alone(tmp_path).items():
            monkeypatch.setenv(name, value)
        monkeypatch.setattr(tempfile, "tempdir", None)
        assert "there is nothing to save yet; waiting: nothing is published" in error_of(capsys, "snap")
        run.send_signal(signal.SIGTERM)
        _, said = run.communicate(timeout=PATIENCE)
        assert (run.returncode, said) == (1, "")


def test_another_middleware_is_refused_and_not_aborted(monkeypatch: pytest.MonkeyPatch) -> None:
    if "rmw_cyclonedds_cpp" in middlewares():
        pytest.skip("rmw_cyclonedds_cpp is installed here")
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_cyclonedds_cpp")
    text = (
        "^RMW_IMPLEMENTATION=rmw_cyclonedds_cpp is not installed for this Python, there is rmw_fastrtps_cpp"
    )
    with pytest.raises(UserError, match=text):
        info.describe(Config())
