"""Around perception, on a real graph: marks, diagnostics of both sides, shapes; the bag tells the same."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bevviz.bags.source import BagSource
from bevviz.config import load
from bevviz.messages.definitions import typestore
from bevviz.model.frame import Frame
from bevviz.model.results import FrameResult
from bevviz.pipeline.session import Session
from bevviz.synthetic import SyntheticSource
from bevviz.synthetic.drive import TRUTH_TOPIC
from tests.support.recordings import Recording
from tests.support.ros_graphs import own_graph, playing
from tests.support.ros_player import Play
from tests.support.waiting import PATIENCE, until

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'bevviz[ros]'")

from bevviz.config.reloading import ReloadableConfig
from bevviz.live.node import Node
from bevviz.live.raw_recorder import RawRecorder
from bevviz.live.runtime import Live, Outputs
from bevviz.live.source import LiveSource
from bevviz.live.status import TYPE, Diagnostics, Notes
from bevviz.live.typesupport import message_type

BOXES = "vision_msgs/msg/Detection3DArray"
MARK = "the person behind the van"
PAGE_MARK = "odd (frame 7)"


@dataclass
class Flight:
    folder: Path
    frames: list[Frame]
    heard: list[Any]  # what bevviz said on /diagnostics
    said: list[str]  # on the terminal
    live: Live


def make(kind: str, **values: Any) -> Any:
    return typestore().types[kind](**values)


def header(frame: str) -> Any:
    return make(
        "std_msgs/msg/Header", stamp=make("builtin_interfaces/msg/Time", sec=0, nanosec=0), frame_id=frame
    )


def pose(x: float) -> Any:
    point = make("geometry_msgs/msg/Point", x=x, y=0.0, z=0.0)
    turn = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    return make("geometry_msgs/msg/Pose", position=point, orientation=turn)


class Robot:
    """What it publishes beside what the player does."""

    def __init__(self, node: Any) -> None:
        self.node = node
        self.publishers: dict[str, Any] = {}

    def say(self, topic: str, kind: str, message: Any) -> None:
        if topic not in self.publishers:
            self.publishers[topic] = self.node.create_publisher(message_type(kind), topic, 10)
        self.publishers[topic].publish(bytes(typestore().serialize_cdr(message, kind)))

    def status(self, level: int, text: str) -> None:
        status = make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=level,
            name="lidar/fan",
            message=text,
            hardware_id="",
            values=[],
        )
        self.say("/diagnostics", TYPE, make(TYPE, header=header(""), status=[status]))

    def objects(self, data: bytes) -> None:
        """Publish the ground truth as our objects, and one metre further as the robot's own."""
        message: Any = typestore().deserialize_cdr(data, BOXES)
        self.say("/ours/objects", BOXES, message)
        for detection in message.detections:
            detection.bbox.center.position.x += 1.0
        self.say("/detection/fused_3d", BOXES, message)

    def height_map(self) -> None:
        layout = make(
            "std_msgs/msg/MultiArrayLayout",
            dim=[
                make("std_msgs/msg/MultiArrayDimension", label="column_index", size=2, stride=4),
                make("std_msgs/msg/MultiArrayDimension", label="row_index", size=2, stride=2),
            ],
            data_offset=0,
        )
        heights = np.array([0, 2, 1, 3], np.float32)
        info = make(
            "grid_map_msgs/msg/GridMapInfo", resolution=0.5, length_x=1.0, length_y=1.0, pose=pose(0.0)
        )
        message = make(
            "grid_map_msgs/msg/GridMap",
            header=header("map"),
            info=info,
            layers=["elevation"],
            basic_layers=["elevation"],
            data=[make("std_msgs/msg/Float32MultiArray", layout=layout, data=heights)],
            outer_start_index=0,
            inner_start_index=0,
        )
        self.say("/heights", "grid_map_msgs/msg/GridMap", message)

    def imu(self) -> None:
        known, x = np.zeros(9), "geometry_msgs/msg/Vector3"
        message = make(
            "sensor_msgs/msg/Imu",
            header=header("imu"),
            orientation=pose(0.0).orientation,
            orientation_covariance=known,
            angular_velocity=make(x, x=0.1, y=0.2, z=0.3),
            angular_velocity_covariance=known,
            linear_acceleration=make(x, x=0.0, y=0.0, z=9.8),
            linear_acceleration_covariance=known,
        )
        self.say("/imu", "sensor_msgs/msg/Imu", message)

    def path(self) -> None:
        self.imu()
        self.height_map()
        poses = [
            make("geometry_msgs/msg/PoseStamped", header=header("map"), pose=pose(x)) for x in (0.0, 1.0, 2.0)
        ]
        self.say("/plan", "nav_msgs/msg/Path", make("nav_msgs/msg/Path", header=header("map"), poses=poses))


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Flight]:
    folder = tmp_path_factory.mktemp("around")
    with own_graph() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(folder))
        patch.chdir(folder)
        with playing(Play(frames=3, points=5_000, rate=4)):
            yield fly(folder)


def fly(folder: Path) -> Flight:
    frames: list[Frame] = []
    heard: list[Any] = []
    said: list[str] = []
    asked = ["objects.method=topic:/ours/objects", "live.robot_time=0.5 s", "live.trigger_after=0"]
    asked += ["live.flight_size=2000 MB", "live.raw_size=2000 MB"]  # A slow machine needs minutes for it all.
    asked.append("live.log_queue=100")  # no frame is left out, least of all the one with the mark
    settings = ReloadableConfig(None, ["live.flight_time=600 s", *asked])
    Session(settings.config).run(SyntheticSource(frames=1).snapshot(0).frame)  # what is compiled, is
    raw = RawRecorder(settings.config.live)
    with Node(name="robot") as node:
        node.start()
        robot = Robot(node.node)

        def hear(data: bytes) -> None:
            told: Any = typestore().deserialize_cdr(data, TYPE)
            heard.extend(status for status in told.status if status.name.startswith("bevviz"))

        node.node.create_subscription(message_type(TYPE), "/diagnostics", hear, 10, raw=True)
        node.node.create_subscription(message_type(BOXES), TRUTH_TOPIC, robot.objects, 10, raw=True)
        with LiveSource(settings.config, raw=raw) as source:
            assert source.wait(PATIENCE), source.missing
            diagnostics = Diagnostics(source.node)

            def on_result(result: FrameResult) -> None:
                frames.append(result.frame)
                diagnostics.observe(result)

            live = Live(
                source, settings, Outputs(), Notes(said.append), on_result=on_result, raw=raw, robot=""
            )
            diagnostics.every_second(lambda: diagnostics.publish(live.numbers, ["two LiDARs are one"]))

            def latest(condition: Callable[[Any], object]) -> Callable[[], bool]:
                return lambda: bool(frames and frames[-1].around and condition(frames[-1].around))

            def during() -> None:
                try:
                    until(lambda: live.frames > 2, "frames")
                    for text, level in (("spins", 0), ("is slow", 1)):
                        robot.status(level, text)
                        robot.path()

                        def told(around: Any, text: str = text, level: int = level) -> bool:
                            robot.status(level, text)
                            robot.path()
                            seen = {shape.topic for shape in around.shapes}  # each is found at its own time
                            return seen == SHAPES and any(s.text == text for s in around.statuses)

                        until(latest(told), text)
                    mark = node.node.create_publisher(message_type("std_msgs/msg/String"), "/bevviz/mark", 10)
                    until(mark.get_subscription_count, "somebody who hears marks")
                    text = make("std_msgs/msg/String", data=MARK)
                    mark.publish(bytes(typestore().serialize_cdr(text, "std_msgs/msg/String")))
                    until(lambda: source.received["/bevviz/mark"], "the mark")
                    assert live.mark(PAGE_MARK)
                    marks = (MARK, PAGE_MARK)
                    until(
                        lambda: all(any(m in str(f.around) for f in list(frames)) for m in marks),
                        "frames with both",
                    )
                    until(
                        lambda: {s.name for s in heard} >= {f"bevviz: {p}" for p in PARTS}, "our diagnostics"
                    )
                    until(lambda: any("robot and ours differ" in text for text in said), "a save for that")
                    # What was seen in results is logged in a thread of its own, a slow one may be far behind.
                    newest = frames[-1].index
                    until(lambda: live.encoder.context.clock[0] > newest + 6, "the log")
                    live.save(Path("snap.rrd"))
                finally:
                    live.stop()

            thread = threading.Thread(target=during)
            thread.start()
            live.run()
            thread.join()
    return Flight(folder, frames, heard, said, live)


PARTS = ("pipeline", "anomalies", "sources")
SHAPES = {"/plan", "/heights"}


def test_heights_are_a_surface_and_an_imu_is_plotted(flight: Flight) -> None:
    recording = Recording(flight.folder / "snap.rrd")
    vertices = recording.column("/robot/heights", "Mesh3D:vertex_positions")[-1]
    assert [vertex[2] for vertex in vertices] == [0.0, 1.0, 2.0, 3.0]
    assert len(recording.column("/robot/heights", "Mesh3D:triangle_indices")[-1]) == 2
    turns = recording.rows["/motion/rotation_rad_s/imu"]
    assert len(turns) >= 2 and turns[-1]["Scalars:scalars"] == [0.1, 0.2, 0.3]
    felt = [row["Scalars:scalars"] for row in recording.rows["/motion/acceleration_m_s2/imu"]]
    assert felt[-1] == [0.0, 0.0, 9.8]
    assert recording.static["/motion/rotation_rad_s/imu"]["SeriesLines:names"] == ["x", "y", "z"]


def test_a_mark_is_a_note_at_one_frame(flight: Flight) -> None:
    recording = Recording(flight.folder / "snap.rrd")
    lane = recording.at["/explain/states/marks"]["StateChange:state"]
    for mark in (MARK, PAGE_MARK):
        (logged,) = (row for row in recording.rows["/explain/log"] if mark in str(row["TextLog:text"]))
        marked = logged["frame"]
        assert mark in lane[marked][0]  # with how long ago, where its frame was dropped
        assert f"- {mark}" in recording.at["/explain"]["TextDocument:text"][marked][0]


def test_the_robots_diagnostics_have_lanes_and_lines(flight: Flight) -> None:
    recording = Recording(flight.folder / "snap.rrd")
    changes = recording.column("/robot/diagnostics/lidar_fan", "StateChange:state")
    assert [value[0] for value in changes] == ["ok", "warning"]
    texts = [text for row in recording.rows["/explain/log"] for text in row["TextLog:text"] or ()]
    assert texts.count("diagnostics: lidar/fan: warning, is slow") == 1


def test_our_results_are_compared_with_the_robots(flight: Flight) -> None:
    against = flight.live.against
    assert against is not None and against.topic == "/detection/fused_3d"
    assert against.frames > 3 and against.differing == against.frames
    recording = Recording(flight.folder / "snap.rrd")
    moved = [value[0] for value in recording.column("/compare/count/moved", "Scalars:scalars")]
    (only,) = {value[0] for value in recording.column("/compare/count/only_a", "Scalars:scalars")}
    assert sum(count >= 1 for count in moved) > 3  # a slow machine compares fewer frames
    assert only == 0
    assert "/compare/objects/moved" in recording.at and recording.static["/compare/about"]
    (told,) = [text for text in flight.said if "robot and ours differ" in text]
    assert "1.00 m apart" in told and told.startswith("flight recorder saved in flight_")


def test_bevviz_publishes_its_own_diagnostics(flight: Flight) -> None:
    by_name = {status.name: status for status in flight.heard}
    assert set(by_name) == {f"bevviz: {part}" for part in PARTS}
    assert int(by_name["bevviz: sources"].level) == 1
    assert by_name["bevviz: sources"].message == "two LiDARs are one"
    numbers = {pair.key: pair.value for pair in by_name["bevviz: pipeline"].values}
    assert float(numbers["frames"]) > 0 and float(numbers["raw_mb"]) > 0 and "dropped: source" in numbers


def test_a_plan_is_shown_where_it_is(flight: Flight) -> None:
    recording = Recording(flight.folder / "snap.rrd")
    (strip,) = recording.column("/robot/plan", "LineStrips3D:strips")[-1]
    assert [point[0] for point in strip] == [0.0, 1.0, 2.0]
    shapes = [shape for frame in flight.frames if frame.around for shape in frame.around.shapes]
    placed = [one for one in shapes if one.topic == "/plan" and one.world_from_shape is not None]
    assert placed and placed[-1].frame_id == "map"


def test_a_bag_gives_the_same_surroundings(flight: Flight) -> None:
    with BagSource([flight.folder / "snap.mcap"], load()) as source:
        frames = list(source)
        assert source.roles.notes["/plan"] == "shown: around perception"
    assert [mark for f in frames if f.around for mark in f.around.marks] == [MARK, PAGE_MARK]
    last = frames[-1].around
    assert last is not None and {shape.topic for shape in last.shapes} == SHAPES
    # One frame takes all the samples that came before it, and a fast robot sends them within one.
    assert sum(len(m.stamp) for f in frames if f.around for m in f.around.motions) >= 2
    assert {(s.name, s.level) for s in last.statuses if s.name == "lidar/fan"} == {("lidar/fan", "warning")}
