"""Bags as others write them: definitions in IDL, no index, boxes in any frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import IndexType, Writer
from rosbags.typesys import Stores, get_typestore

import bevviz
from bevviz.bags.source import BagSource
from bevviz.cli import main
from bevviz.config import load
from bevviz.messages.encode import encode_points
from bevviz.messages.foreign_boxes import decode_objects
from bevviz.model import geometry
from bevviz.model.frame import F64, Intrinsics
from bevviz.stages.robot_results import in_points_frame
from tests.support import bags

LINE = "=" * 80 + "\n"
IDL = {  # as rosidl generates it from .msg files, and rosbag2 stores it
    "sensor_msgs/msg/PointCloud2": """// generated from rosidl_adapter/resource/msg.idl.em
#include "sensor_msgs/msg/PointField.idl"
#include "std_msgs/msg/Header.idl"

module sensor_msgs {
  module msg {
    @verbatim (language="comment", text=
      "A collection of N-dimensional points.")
    struct PointCloud2 {
      std_msgs::msg::Header header;
      uint32 height;
      uint32 width;
      sequence<sensor_msgs::msg::PointField> fields;
      boolean is_bigendian;
      uint32 point_step;
      uint32 row_step;
      sequence<uint8> data;
      boolean is_dense;
    };
  };
};
""",
    "sensor_msgs/msg/PointField": """module sensor_msgs {
  module msg {
    module PointField_Constants {
      const uint8 FLOAT32 = 7;
    };
    struct PointField {
      string name;
      uint32 offset;
      uint8 datatype;
      uint32 count;
    };
  };
};
""",
    "std_msgs/msg/Header": """#include "builtin_interfaces/msg/Time.idl"
module std_msgs { module msg { struct Header { builtin_interfaces::msg::Time stamp; string frame_id; }; }; };
""",
    "builtin_interfaces/msg/Time": """module builtin_interfaces { module msg {
  struct Time { int32 sec; uint32 nanosec; };
}; };
""",
}


@pytest.mark.parametrize("encoding", ["ros2idl", "omgidl"])
def test_definitions_in_idl_are_taken(encoding: str, tmp_path: Path) -> None:
    xyz = np.random.default_rng(0).normal(0, 10, (200, 3)).astype(np.float32)
    points = xyz.view([(name, "<f4") for name in "xyz"]).reshape(-1)
    stamp = 1_700_000_000_000_000_000
    data = get_typestore(Stores.ROS2_JAZZY).serialize_cdr(
        encode_points(stamp, "lidar", points), "sensor_msgs/msg/PointCloud2"
    )
    text = "".join(f"{LINE}IDL: {name}\n{body}" for name, body in IDL.items())
    with (tmp_path / "drive.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        schema = writer.register_schema("sensor_msgs/msg/PointCloud2", encoding, text.encode())
        channel = writer.register_channel("/points", "cdr", schema)
        writer.add_message(channel, stamp, bytes(data), stamp)
        writer.finish()  # type: ignore[no-untyped-call]
    with bevviz.open(tmp_path / "drive.mcap") as drive:
        (frame,) = drive.frames
        np.testing.assert_array_equal(frame.points, xyz)
        assert not [warning for warning in drive.warnings if "not usable" in warning]


BARE = {
    "index_types": IndexType.NONE,
    "repeat_channels": False,
    "repeat_schemas": False,
    "use_statistics": False,
    "use_summary_offsets": False,
}


@pytest.mark.parametrize(
    ("left_out", "said"),
    [
        (BARE, "it has no index"),  # as rosbag2's preset ``fastwrite``
        ({"use_statistics": False}, "it has no statistics"),
        ({}, "it has no index of chunks"),
    ],
)
def test_without_an_index_it_is_read_from_end_to_end(
    left_out: dict[str, Any], said: str, tmp_path: Path
) -> None:
    bag = bags.write(tmp_path / "sound", bags.small_items(scans=3))
    (sound,) = bag.glob("*.mcap")
    with sound.open("rb") as source, (tmp_path / "fast.mcap").open("wb") as file:
        writer = Writer(file, use_chunking=False, **left_out)
        writer.start("ros2")
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(source).iter_messages():
            if schema is not None and channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", number)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()  # type: ignore[no-untyped-call]
    with bevviz.open(tmp_path / "fast.mcap") as drive, bevviz.open(sound) as same:
        for frame, other in zip(drive.frames, same.frames, strict=True):
            np.testing.assert_array_equal(frame.points, other.points)
        told = [warning for warning in drive.warnings if warning not in same.warnings]
        assert f": {said}" in told[0] and told[0].endswith(": it is read from end to end")
        assert not [warning for warning in told if "rescued" in warning or "lost" in warning]


BOX_SIZE = (4.5, 1.8, 1.5)
BOX = geometry.transform((12.0, 3.0, -1.0), (0, 0, np.sin(0.25), np.cos(0.25)))  # in the LiDAR's frame
CAMERA = geometry.transform((0.1, 0, -0.2), (-0.5, 0.5, -0.5, 0.5))  # LiDAR from the optical frame
FRAMES = {bags.LIDAR_FRAME: BOX, bags.CAMERA_FRAME: geometry.inverse(CAMERA) @ BOX}


def pose_of(m: bags.Messages, matrix: F64) -> Any:
    place = dict(zip("xyz", matrix[:3, 3].tolist(), strict=True))
    turn = dict(zip("xyzw", geometry.quaternion(matrix).tolist(), strict=True))
    return m.make(
        "geometry_msgs/msg/Pose",
        position=m.make("geometry_msgs/msg/Point", **place),
        orientation=m.make("geometry_msgs/msg/Quaternion", **turn),
    )


def stated_in(m: bags.Messages, array: str, frames: Sequence[str]) -> Any:
    """Make an array with the box in each of the frames; ``array`` is the frame of the array's own header."""
    size = m.make("geometry_msgs/msg/Vector3", **dict(zip("xyz", BOX_SIZE, strict=True)))
    found = []
    for frame in frames:
        bbox = m.make("vision_msgs/msg/BoundingBox3D", center=pose_of(m, FRAMES[frame]), size=size)
        header = m.header(bags.START, frame)
        found.append(m.make("vision_msgs/msg/Detection3D", header=header, results=[], bbox=bbox, id=frame))
    header = m.header(bags.START, array)
    return m.make("vision_msgs/msg/Detection3DArray", header=header, detections=found)


def markers_in(m: bags.Messages, frames: Sequence[str]) -> Any:
    """Make the same boxes as cube markers."""
    found = [m.marker(frame, pose_of(m, FRAMES[frame]), BOX_SIZE, ns=frame) for frame in frames]
    return m.make("visualization_msgs/msg/MarkerArray", markers=found)


@pytest.mark.parametrize("world", [True, False])
@pytest.mark.parametrize(
    ("kind", "array", "frames"),
    [
        ("detections", bags.CAMERA_FRAME, [bags.CAMERA_FRAME]),
        ("detections", "", [bags.CAMERA_FRAME]),
        ("detections", "", list(FRAMES)),
        ("markers", "", list(FRAMES)),
    ],
)
def test_boxes_are_upright_where_the_points_are(
    tmp_path: Path, kind: str, array: str, frames: list[str], world: bool
) -> None:
    """In an optical frame z is ahead: taken for the vertical, boxes lay on their side, unsaid."""
    m = bags.Messages()
    xyzi = np.random.default_rng(0).normal(0, 5, (200, 4)).astype(np.float32)
    edges = [(bags.LIDAR_FRAME, bags.CAMERA_FRAME, CAMERA)]
    edges += [("map", bags.LIDAR_FRAME, geometry.transform((5, 6, 0), (0, 0, 0.6, 0.8)))] if world else []
    message = stated_in(m, array, frames) if kind == "detections" else markers_in(m, frames)
    type_of = {
        "detections": "vision_msgs/msg/Detection3DArray",
        "markers": "visualization_msgs/msg/MarkerArray",
    }
    items = [
        bags.Item("/tf_static", "tf2_msgs/msg/TFMessage", bags.START, m.transforms(bags.START, *edges)),
        bags.Item(bags.CLOUD, "sensor_msgs/msg/PointCloud2", bags.START, m.cloud(bags.START, xyzi)),
        bags.Item("/objects", type_of[kind], bags.START + 1000, message),
    ]
    path = bags.write(tmp_path / "bag", items, m)
    settings = ["source.boxes={topic: /objects}"] if kind == "markers" else []
    with BagSource([path], load(settings=settings)) as source:
        (frame,) = source
        assert not [warning for warning in source.warnings if "/objects" in warning]
    (found,) = frame.robot_boxes
    boxes = in_points_frame(frame.pose, found)
    np.testing.assert_allclose(boxes.center, [BOX[:3, 3]] * len(frames), atol=1e-5)
    np.testing.assert_allclose(boxes.size, [BOX_SIZE] * len(frames), rtol=1e-6)
    np.testing.assert_allclose(boxes.yaw, [0.5] * len(frames), atol=1e-6)


def test_boxes_in_unplaced_frames_are_dropped_and_reported(tmp_path: Path) -> None:
    m = bags.Messages()
    items = [
        bags.Item(
            bags.CLOUD,
            "sensor_msgs/msg/PointCloud2",
            bags.START,
            m.cloud(bags.START, np.ones((9, 4), np.float32)),
        ),
        bags.Item(
            "/objects", "vision_msgs/msg/Detection3DArray", bags.START + 1000, stated_in(m, "", list(FRAMES))
        ),
    ]
    with BagSource([bags.write(tmp_path / "bag", items, m)], load()) as source:
        (frame,) = source
        (said,) = [warning for warning in source.warnings if "/objects" in warning]
    assert frame.robot_boxes[0].ids == (bags.LIDAR_FRAME,)
    assert "frame 'camera_optical' is unknown: the boxes of /objects are left out" in said


def test_headers_of_objects_replace_a_missing_message_frame() -> None:
    def one(frame: str) -> Any:
        place = SimpleNamespace(position=SimpleNamespace(x=1.0, y=2.0, z=3.0))
        return SimpleNamespace(header=header(frame), pose=place, size=(4.0, 2.0, 1.5))

    def header(frame: str) -> Any:
        return SimpleNamespace(stamp=SimpleNamespace(sec=5, nanosec=0), frame_id=frame)

    for array, frame_id, frames in (("", "lidar", ("lidar", "/map")), ("base", "base", ())):
        msg = SimpleNamespace(header=header(array), boxes=[one("lidar"), one("/map")])
        found = decode_objects(msg, "/b", 9, {"topic": "/b", "objects": "boxes"})
        assert (found.stamp, found.frame_id) == (5 * 10**9, frame_id)
        assert found.frames == tuple(frame.removeprefix("/") for frame in frames)


def test_messages_that_cannot_be_used_are_counted_once(tmp_path: Path) -> None:
    m = bags.Messages()
    items = [item for item in bags.small_items(m, scans=3) if item.topic != bags.INFO]
    nothing = Intrinsics(64, 48, np.zeros((3, 3)))
    for scan in range(3):
        at = bags.START + scan * bags.PERIOD
        items.append(bags.Item(bags.INFO, "sensor_msgs/msg/CameraInfo", at, m.camera_info(at, nothing)))
    with BagSource([bags.write(tmp_path / "bag", items, m)], load()) as source:
        assert len(list(source)) == 3
        assert [w.partition(" of ")[0] for w in source.warnings if "message(s)" in w] == ["3 message(s)"]


@pytest.mark.parametrize(
    "command",
    [
        ["evaluate", "--truth", "/objects"],
        ["evaluate", "--truth", "/objects", "--save", "evaluated.rrd"],
        ["export", "-o", "training"],
        ["compare", "--set-b", "clustering.method=topic:/nothing", "--save", "compared.rrd"],
    ],
)
def test_a_failing_stage_is_reported_where_it_is_evaluated(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """All objects are missed then, and labels empty: as if the robot had found nothing."""
    monkeypatch.chdir(tmp_path)
    m = bags.Messages()
    boxes = "vision_msgs/msg/Detection3DArray"
    items = [
        *bags.small_items(m, scans=3),
        *(bags.Item("/objects", boxes, bags.START + i * bags.PERIOD, truth(m, i)) for i in range(3)),
        bags.Item("/nothing", boxes, bags.START + 3600 * 10**9, truth(m, 36_000)),
    ]
    path = bags.write(tmp_path / "bag", items, m)
    objects = [] if command[0] == "compare" else ["--set", "objects.method=topic:/nothing"]
    main([command[0], str(path), *command[1:], *objects, "--quiet"])
    (said,) = [line for line in capsys.readouterr().err.splitlines() if "failed in" in line]
    side, stage = ("B: ", "clustering") if command[0] == "compare" else ("", "objects")
    assert f"warning: {side}{stage} failed in 3 of 3 frames, first: the robot published no boxes" in said


def truth(m: bags.Messages, scan: int) -> Any:
    message = stated_in(m, bags.LIDAR_FRAME, [bags.LIDAR_FRAME])
    message.header.stamp = m.header(bags.START + scan * bags.PERIOD, "").stamp
    return message


def test_messages_with_the_stamp_of_another_one_are_said(tmp_path: Path) -> None:
    """Of two results with one stamp, as of two cameras on one topic, the first was gone without a word."""
    m = bags.Messages()
    items = bags.small_items(m, scans=3)
    for i in range(3):
        for late in (1000, 2000):
            at = bags.START + i * bags.PERIOD + late
            items.append(bags.Item("/objects", "vision_msgs/msg/Detection3DArray", at, truth(m, i)))
    with BagSource([bags.write(tmp_path / "bag", items, m)], load()) as source:
        assert len(list(source)) == 3
        assert [w for w in source.warnings if "stamp" in w] == [
            "/objects: 3 of its messages had the stamp of another one, whose place they took"
        ]
