"""Around perception, beside a robot: marks, diagnostics of both sides, shapes; the bag tells the same."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bevviz.bags.source import BagSource
from bevviz.config import load
from bevviz.extras.demo.drive import TRUTH_TOPIC
from bevviz.messages.definitions import typestore
from bevviz.model.frame import Frame
from bevviz.model.results import FrameResult
from tests.support.recordings import Recording
from tests.support.waiting import until

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'bevviz[ros]'")

from bevviz.config.reloading import ReloadableConfig
from bevviz.extras.ros_node.diagnostics import TYPE, Diagnostics
from bevviz.live.raw_recorder import RawRecorder
from bevviz.live.run_outputs import Outputs
from bevviz.live.runtime import Live
from bevviz.live.source import LiveSource
from bevviz.live.status import Notes
from bevviz.live.typesupport import message_type
from tests.support.fed_graph import FedGraph, Player, fed_graph, play_in_step
from tests.support.live_sessions import CalledReceiver, run_beside

pytestmark = pytest.mark.long

BOXES, STRING = "vision_msgs/msg/Detection3DArray", "std_msgs/msg/String"
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

    def __init__(self, graph: FedGraph) -> None:
        self.graph = graph
        self.publishers: dict[str, Any] = {}

    def say(self, topic: str, kind: str, message: Any) -> None:
        if topic not in self.publishers:
            self.publishers[topic] = self.graph.advertise(topic, kind)
        self.graph.publish(self.publishers[topic], message)

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

    def objects(self, data: bytes, info: object) -> None:
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
    with fed_graph() as graph, pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(folder))
        patch.chdir(folder)
        yield fly(folder, graph)


def fly(folder: Path, graph: FedGraph) -> Flight:
    from rclpy.qos import QoSProfile

    frames: list[Frame] = []
    said: list[str] = []
    asked = ["objects.method=topic:/ours/objects", "live.robot_time=0.5 s", "live.trigger_after=0"]
    settings = ReloadableConfig(None, ["live.flight_time=600 s", *asked])
    raw = RawRecorder(settings)
    player, robot = Player(graph, frames=3), Robot(graph)
    graph.subscribe(message_type(BOXES), TRUTH_TOPIC, robot.objects, QoSProfile(depth=10))
    with LiveSource(settings.config, raw=raw) as source:
        player.play(2.0)
        assert source.wait(0), source.missing
        diagnostics = Diagnostics(source.nodes.node)

        def on_result(result: FrameResult) -> None:
            frames.append(result.frame)
            diagnostics.observe(result)

        live = Live(source, settings, Outputs(), Notes(said.append), robot="")
        live.receivers.append(CalledReceiver(on_result))
        live.problems.set("robots", "names", "two robots are merged", "", "--ros-args -r __ns:=/a")
        diagnostics.every_second(lambda: diagnostics.publish(live.numbers, live.problems.current))

        def feed() -> None:
            for level, text in ((0, "spins"), (1, "is slow")):
                for _ in range(10):  # the first ones come before their topics are found
                    robot.status(level, text)
                    robot.path()
                    play_in_step(player, live, source)
            robot.say("/bevviz/mark", STRING, make(STRING, data=MARK))
            source.mark(PAGE_MARK)
            for _ in range(10):
                play_in_step(player, live, source)
            until(lambda: any("robot and ours differ" in text for text in said), "a save for that")
            live.flight.save(Path("snap.rrd"))

        run_beside(live, feed)
    heard = [one for message in graph.sent["/diagnostics"] for one in message.status]
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
    texts = {pair.key: pair.value for pair in by_name["bevviz: sources"].values}
    merged = "two robots are merged: --ros-args -r __ns:=/a"
    assert texts["robots names"].startswith(f"{merged} (for ")
    assert by_name["bevviz: sources"].message.startswith(merged)
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
