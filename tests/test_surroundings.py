"""What a robot publishes around its perception, decoded, kept and logged."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr

from bevviz.config import SourceConfig, load
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.extras.demo.sensors import Lidar, PinholeCamera
from bevviz.messages.decoders import MessageError
from bevviz.messages.definitions import typestore
from bevviz.messages.encode import encode_cloud, encode_image
from bevviz.messages.robot_description import mesh_file
from bevviz.messages.roles import find_roles, surroundings_kind
from bevviz.messages.surroundings import decode_shapes, decode_statuses
from bevviz.messages.topics import Topic
from bevviz.model.frame import ComponentStatus, Frame, Image, PlacedShape, Scene
from bevviz.model.results import FrameResult
from bevviz.recording.frame_logger import FrameLogger
from bevviz.sync.buffers import MANY, SAMPLES, SurroundingsBuffer
from tests.support.recordings import Recording


def make(kind: str, **values: Any) -> Any:
    return typestore().types[kind](**values)


def header(frame: str = "map", stamp: int = 7) -> Any:
    return make(
        "std_msgs/msg/Header", stamp=make("builtin_interfaces/msg/Time", sec=0, nanosec=stamp), frame_id=frame
    )


def pose(x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> Any:
    return make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=x, y=y, z=0.0),
        orientation=make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=np.sin(yaw / 2), w=np.cos(yaw / 2)),
    )


def grid(cells: list[int], width: int, height: int) -> Any:
    zero = make("builtin_interfaces/msg/Time", sec=0, nanosec=0)
    about = make(
        "nav_msgs/msg/MapMetaData",
        map_load_time=zero,
        resolution=0.5,
        width=width,
        height=height,
        origin=pose(1.0),
    )
    return make("nav_msgs/msg/OccupancyGrid", header=header(), info=about, data=np.array(cells, np.int8))


def marker(kind: int, points: list[tuple[float, float, float]] | None = None, **more: Any) -> Any:
    lasting = make("builtin_interfaces/msg/Duration", sec=0, nanosec=0)
    values: dict[str, Any] = {
        "header": header(),
        "ns": "wall",
        "id": 3,
        "type": kind,
        "action": 0,
        "pose": pose(2.0, yaw=np.pi / 2),
        "scale": make("geometry_msgs/msg/Vector3", x=4.0, y=2.0, z=1.0),
        "color": make("std_msgs/msg/ColorRGBA", r=1.0, g=0.5, b=0.0, a=1.0),
        "lifetime": lasting,
        "frame_locked": False,
        "points": [make("geometry_msgs/msg/Point", x=x, y=y, z=z) for x, y, z in points or ()],
        "colors": [],
        "texture_resource": "",
        "texture": None,
        "uv_coordinates": [],
        "text": "",
        "mesh_resource": "",
        "mesh_file": None,
        "mesh_use_embedded_materials": False,
    }
    return make("visualization_msgs/msg/Marker", **(values | more))


def test_a_laser_scan_has_the_points_within_its_range() -> None:
    scan = make(
        "sensor_msgs/msg/LaserScan",
        header=header("laser"),
        angle_min=0.0,
        angle_max=np.pi,
        angle_increment=np.pi / 2,
        time_increment=0.0,
        scan_time=0.0,
        range_min=0.1,
        range_max=10.0,
        ranges=np.array([2.0, np.inf, 3.0], np.float32),
        intensities=np.zeros(0, np.float32),
    )
    (shape,) = decode_shapes(scan, "LaserScan", "/scan")
    assert shape.points is not None and (shape.topic, shape.frame_id, shape.stamp) == ("/scan", "laser", 7)
    np.testing.assert_allclose(shape.points, [[2, 0, 0], [-3, 0, 0]], atol=1e-6)


def test_a_map_has_its_cells_and_its_place() -> None:
    (shape,) = decode_shapes(grid([0, 100, -1, 50, 0, 0], 3, 2), "OccupancyGrid", "/map")
    assert shape.grid is not None and shape.grid.resolution == 0.5
    assert shape.grid.cells.tolist() == [[0, 100, -1], [50, 0, 0]]
    assert shape.grid.pose[:3, 3].tolist() == [1, 0, 0]
    with pytest.raises(MessageError, match=r"/map: 5 cells in a map of 3 x 2"):
        decode_shapes(grid([0] * 5, 3, 2), "OccupancyGrid", "/map")


def test_a_marker_is_where_its_pose_says() -> None:
    line = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)]
    markers = [
        marker(1),
        marker(4, line),
        marker(5, line * 2),
        marker(8, line),
        marker(2),
        marker(10),
        marker(1, action=2),
    ]
    shapes = decode_shapes(make("visualization_msgs/msg/MarkerArray", markers=markers), "MarkerArray", "/m")
    cube, strip, lines, points, sphere = shapes  # no mesh, nothing that is deleted
    assert cube.topic == "/m/wall/3" and cube.color is not None and cube.color.tolist() == [255, 128, 0, 255]
    assert cube.solids is not None and cube.solids.half.tolist() == [[2, 1, 0.5]] and not cube.solids.round
    np.testing.assert_allclose(cube.solids.quaternion, [[0, 0, 0.5**0.5, 0.5**0.5]], atol=1e-6)
    np.testing.assert_allclose(strip.strips[0], [[2, 0, 0], [2, 1, 0]], atol=1e-6)
    assert len(lines.strips) == 2 and points.points is not None and len(points.points) == 2
    assert sphere.solids is not None and sphere.solids.round


def test_diagnostics_and_topic_statistics_are_decoded() -> None:
    status = make(
        "diagnostic_msgs/msg/DiagnosticStatus", level=9, name="fan", message="odd", hardware_id="", values=[]
    )
    array = make("diagnostic_msgs/msg/DiagnosticArray", header=header(), status=[status])
    assert decode_statuses(array) == [ComponentStatus("fan", "error", "odd")]
    kinds = {
        ("/robot1/bevviz/mark", "String"): "mark",
        ("/chatter", "String"): None,
        ("/scan", "LaserScan"): "shape",
    }
    assert {topic: surroundings_kind(*topic) for topic in kinds} == kinds


def test_memory_is_bounded_and_marks_last_one_frame() -> None:
    around = SurroundingsBuffer()
    assert around.take(lambda name: np.eye(4)) is None
    around.add_mark("here")
    around.add_statuses([ComponentStatus(str(k), "ok", "") for k in range(3 * MANY)])
    around.add_shapes("/m", [PlacedShape("/m", "map", k) for k in range(3 * MANY)])
    taken = around.take(lambda name: None)
    assert taken is not None and taken.marks == ("here",)
    assert len(taken.statuses) == len(taken.shapes) == MANY and taken.shapes[0].world_from_shape is None
    again = around.take(lambda name: np.eye(4))
    assert again is not None and again.marks == () and again.shapes[0].world_from_shape is not None


@pytest.fixture
def frame() -> Frame:
    source = SyntheticSource(
        frames=1, lidar=Lidar(beams=8, azimuths=90), camera=PinholeCamera(width=64, height=36, focal=44.0)
    )
    return source.snapshot(0).frame


def test_shapes_are_logged_once_and_cleared_when_they_are_gone(frame: Frame, tmp_path: Path) -> None:
    config, around = load(), SurroundingsBuffer()
    around.add_shapes("/map", decode_shapes(grid([0, 100, -1, 50, 0, 0], 3, 2), "OccupancyGrid", "/map"))
    around.add_shapes("/m", decode_shapes(marker(1), "Marker", "/m"))
    path = tmp_path / "around.rrd"
    with rr.RecordingStream("test") as recording:
        recording.save(path)
        logger = FrameLogger(recording, config, Scene("test", frame.lidar))
        logger.log_static()
        for index in range(3):
            if index == 2:
                around.add_shapes("/m", [])
            now = replace(
                frame, index=index, stamp=frame.stamp + index, around=around.take(lambda name: np.eye(4))
            )
            logger.log(FrameResult.unprocessed(now, config))
    logged = Recording(path)
    (number,) = logged.at["/robot/map"]["GridMap:data"]
    data = logged.at["/robot/map"]["GridMap:data"][number][0]
    assert number == 0 and np.array(data, np.uint8).view(np.int8).tolist() == [
        50,
        0,
        0,
        0,
        100,
        -1,
    ]  # top first
    assert list(logged.at["/robot/m/wall/3"]["Boxes3D:half_sizes"]) == [0]
    assert logged.cleared("/robot/m/wall/3") == {2} and logged.cleared("/robot/map") == set()


URDF = """<robot name="van">
  <link name="base_link">
  <visual><origin xyz="1 0 0.5" rpy="0 0 1.5707963"/><geometry><box size="4 2 1"/></geometry></visual>
  <visual><geometry><mesh filename="package://van/roof.stl"/></geometry></visual></link>
  <link name="mast"/>
  <link name="wheel"><visual><geometry><cylinder radius="0.3" length="0.2"/></geometry></visual></link>
</robot>"""


def test_links_of_a_robot_description_are_placed() -> None:
    description = make("std_msgs/msg/String", data=URDF)
    base, mast, wheel = decode_shapes(description, "String", "/robot_description")
    assert [shape.frame_id for shape in (base, mast, wheel)] == ["base_link", "mast", "wheel"]
    assert base.solids is not None and mast.solids is not None and wheel.solids is not None
    np.testing.assert_allclose(base.solids.center, [[1, 0, 0.5]])
    np.testing.assert_allclose(base.solids.half, [[2, 1, 0.5]])
    np.testing.assert_allclose(base.solids.quaternion, [[0, 0, 0.5**0.5, 0.5**0.5]], atol=1e-6)
    np.testing.assert_allclose(wheel.solids.half, [[0.3, 0.3, 0.1]], rtol=1e-6)
    assert mast.solids.round and mast.topic == "/robot_description/mast"
    assert (
        surroundings_kind("/robot1/robot_description", "String") == "shape"
        and surroundings_kind("/chatter", "String") is None
    )
    for wrong in ("<robot", URDF.replace("4 2 1", "4 2")):
        with pytest.raises(MessageError, match="/robot_description: "):
            decode_shapes(make("std_msgs/msg/String", data=wrong), "String", "/robot_description")


@pytest.mark.long
def test_image_and_obstacles_of_the_robot_replace_missing_ones(tmp_path: Path) -> None:
    kinds = {"/points": "PointCloud2", "/lidar/points_no_ground": "PointCloud2"}
    kinds |= {"/visualization/bev_image": "Image", "/camera/image": "Image"}
    topics = [Topic(name, f"sensor_msgs/msg/{kind}", None, name) for name, kind in kinds.items()]
    assert find_roles(topics, SourceConfig()).around == ()
    roles = find_roles(topics, SourceConfig(), results=True)
    assert {(topic, kind) for topic, kind, _ in roles.around} == {
        ("/lidar/points_no_ground", "shape"),
        ("/visualization/bev_image", "shape"),
    }
    assert roles.lidars == ("/points",) and [camera.topic for camera in roles.cameras] == ["/camera/image"]

    frame = (
        SyntheticSource(
            frames=1, lidar=Lidar(beams=8, azimuths=90), camera=PinholeCamera(width=64, height=36, focal=44.0)
        )
        .snapshot(0)
        .frame
    )
    cloud = encode_cloud(replace(frame.clouds[0], frame_id="map"))
    image = encode_image(Image(7, "rslidar", np.full((4, 6, 3), 9, np.uint8)))
    around = SurroundingsBuffer()
    around.add_shapes("/obstacles", decode_shapes(cloud, "PointCloud2", "/lidar/points_no_ground"))
    around.add_shapes("/bev", decode_shapes(image, "Image", "/visualization/bev_image"))
    frame = replace(frame, around=around.take(lambda name: np.eye(4) if name == "map" else None))
    path = tmp_path / "out.rrd"
    scene = Scene("s", "rslidar", ("rslidar",), ("zed",))
    with rr.RecordingStream("test") as recording:
        recording.save(path)
        FrameLogger(recording, load(), scene).log(FrameResult.unprocessed(frame, load()))
        recording.flush()
    shown = Recording(path).at
    points = shown["/robot/lidar/points_no_ground"]["Points3D:positions"][0]
    assert len(points) == len(frame.points)
    assert "Image:buffer" in shown["/robot/visualization/bev_image"]


def height_map(values: np.ndarray[Any, Any], start: tuple[int, int] = (0, 0), **more: Any) -> Any:
    """Of (rows, columns), stored by columns and beginning anywhere, as grid_map does."""
    rows, columns = values.shape
    stored = np.roll(values, start, axis=(0, 1)).T
    dims = [
        make("std_msgs/msg/MultiArrayDimension", label="column_index", size=columns, stride=rows * columns),
        make("std_msgs/msg/MultiArrayDimension", label="row_index", size=rows, stride=rows),
    ]
    layout = make("std_msgs/msg/MultiArrayLayout", dim=dims, data_offset=0)
    layer = make("std_msgs/msg/Float32MultiArray", layout=layout, data=stored.astype(np.float32).ravel())
    info = make(
        "grid_map_msgs/msg/GridMapInfo",
        resolution=0.5,
        length_x=rows / 2,
        length_y=columns / 2,
        pose=pose(10.0),
    )
    given = {"layers": ["elevation"], "basic_layers": [], "data": [layer]} | more
    return make(
        "grid_map_msgs/msg/GridMap",
        header=header("odom"),
        info=info,
        outer_start_index=start[0],
        inner_start_index=start[1],
        **given,
    )


@pytest.mark.parametrize("start", [(0, 0), (2, 1)])
def test_a_height_map_lies_where_it_is_measured(start: tuple[int, int]) -> None:
    values = np.arange(12, dtype=np.float32).reshape(4, 3)
    values[0, 0] = np.nan
    (shape,) = decode_shapes(height_map(values, start), "GridMap", "/heights")
    assert shape.frame_id == "odom" and shape.stamp == 7 and shape.surface is not None
    surface = shape.surface
    places = {float(z): (float(x), float(y)) for x, y, z in surface.vertices}
    assert len(places) == 11 and places[1.0] == (10.75, 0.0) and places[11.0] == (9.25, -0.5)
    assert len(surface.triangles) == 2 * 5, "the unknown corner has no triangles"
    edges = surface.vertices[surface.triangles] - np.roll(surface.vertices[surface.triangles], 1, axis=1)
    assert np.abs(edges[..., :2]).max() == 0.5, "of neighbours alone"


def test_a_layer_without_heights_is_a_coloured_plane() -> None:
    values = np.arange(4, dtype=np.float32).reshape(2, 2)
    (shape,) = decode_shapes(height_map(values, layers=["cost"]), "GridMap", "/costs")
    assert shape.surface is not None
    assert (shape.surface.vertices[:, 2] == 0).all() and sorted(shape.surface.values) == [0, 1, 2, 3]
    assert decode_shapes(height_map(np.full((2, 2), np.nan)), "GridMap", "/empty") == []
    large = np.zeros((1500, 1000), np.float32)
    (shape,) = decode_shapes(height_map(large), "GridMap", "/large")
    assert shape.surface is not None and 100_000 < len(shape.surface.vertices) <= 250_000


@pytest.mark.parametrize(
    ("more", "why"),
    [
        ({"layers": ["a", "b"]}, "2 names of 1 layers"),
        ({"layers": ["a"], "basic_layers": ["b"]}, "basic layer 'b' is not among"),
        ({"data": [make("std_msgs/msg/Float32MultiArray", layout=make("std_msgs/msg/MultiArrayLayout", dim=[],
          data_offset=0), data=np.zeros(3, np.float32))]}, "3 values in no cells"),
    ],
)  # fmt: skip
def test_an_inconsistent_height_map_is_refused(more: dict[str, Any], why: str) -> None:
    with pytest.raises(MessageError, match=why):
        decode_shapes(height_map(np.zeros((2, 2)), **more), "GridMap", "/heights")


STL = b"""solid s
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 1 0 0
vertex 0 1 0
endloop
endfacet
endsolid s
"""


def test_local_meshes_are_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, frame: Frame) -> None:
    roof = tmp_path / "prefix/share/van/roof.stl"
    roof.parent.mkdir(parents=True)
    roof.write_bytes(STL)
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path / 'none'}:{tmp_path / 'prefix'}")
    (tmp_path / "secret.txt").write_text("no mesh")
    text = URDF.replace(
        '<link name="mast"/>',
        f"""<link name="mast"><visual><origin xyz="0 0 1"/><geometry>
        <mesh filename="file://{roof}" scale="0.001 0.001 0.001"/></geometry></visual>
        <visual><geometry><mesh filename="file://{tmp_path}/secret.txt"/></geometry></visual></link>""",
    )
    base, mast, _ = shapes = decode_shapes(
        make("std_msgs/msg/String", data=text), "String", "/robot_description"
    )
    assert [mesh.path for mesh in base.meshes] == [roof] and base.solids is not None
    (mesh,) = mast.meshes
    assert mast.solids is None and mesh.scale == (0.001, 0.001, 0.001) and mesh.pose[2, 3] == 1
    monkeypatch.delenv("AMENT_PREFIX_PATH")
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(roof.parent))
    assert mesh_file("package://van/roof.stl") == roof
    assert mesh_file("package://van/none.stl") is None and mesh_file("http://host/roof.stl") is None

    def place(name: str, gone: str) -> Any:
        return None if name == gone else np.eye(4)

    around, path = SurroundingsBuffer(), tmp_path / "meshes.rrd"
    around.add_shapes("/robot_description", shapes)
    with rr.RecordingStream("test") as recording:
        recording.save(path)
        logger = FrameLogger(recording, load(), Scene("test", frame.lidar))
        logger.log_static()
        for index in range(3):
            known = around.take(partial(place, gone="mast" if index else ""))
            now = replace(frame, index=index, stamp=frame.stamp + index, around=known)
            logger.log(FrameResult.unprocessed(now, load()))
        later = logger.context
    logged, asset = Recording(path), "/robot/robot_description/mast/mesh_0"
    assert bytes(logged.static[asset]["Asset3D:blob"][0]) == STL
    assert logged.static[asset]["InstancePoses3D:scales"] == [pytest.approx([0.001] * 3)]
    scale = logged.at["/robot/robot_description/mast"]["Transform3D:scale"]
    assert {number: value for number, value in scale.items() if value} == {1: [[0, 0, 0]], 2: [[0, 0, 0]]}
    assert asset in later.fixed, "a recording that begins later has it, too"


def test_samples_of_an_imu_go_with_the_frame_that_comes_next(frame: Frame, tmp_path: Path) -> None:
    around, path = SurroundingsBuffer(), tmp_path / "imu.rrd"
    none = (np.nan, np.nan, np.nan)
    with rr.RecordingStream("test") as recording:
        recording.save(path)
        logger = FrameLogger(recording, load(), Scene("test", frame.lidar))
        logger.log_static()
        for index in range(2):
            for k in range(3):
                sample = frame.stamp + 10 * index + k
                around.add_motion("/imu", sample, sample + 5, (index, k, 0.5), (0, 0, 9.8) if k else none)
            now = replace(
                frame, index=index, stamp=frame.stamp + 10 * index + 3, around=around.take(lambda _: None)
            )
            logger.log(FrameResult.unprocessed(now, load()))
    assert around.take(lambda _: None) is None
    rows = Recording(path).rows
    turns, felt = rows["/motion/rotation_rad_s/imu"], rows["/motion/acceleration_m_s2/imu"]
    assert [row["Scalars:scalars"] for row in turns] == [[i, k, 0.5] for i in range(2) for k in range(3)]
    assert [row["frame"] for row in turns] == [0, 0, 0, 1, 1, 1] and len(felt) == 4
    assert [row["stamp"] - frame.stamp for row in turns] == [0, 1, 2, 10, 11, 12]
    for k in range(2 * SAMPLES):
        around.add_motion("/imu", k, k, none, none)
    taken = around.take(lambda _: None)
    assert taken is not None and len(taken.motions[0].stamp) == SAMPLES
