"""Livox's CustomMsg, serialised by rosbags from the definitions of both drivers."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from bevviz.bags.source import BagSource
from bevviz.cli import main
from bevviz.config import Config
from bevviz.live.live_message import LiveMessage
from bevviz.messages.clouds import decode_cloud
from bevviz.messages.decoding import MessageError
from tests.support import bags

POINT = """uint32 offset_time      # offset time relative to the base time
float32 x               # X axis, unit:m
float32 y               # Y axis, unit:m
float32 z               # Z axis, unit:m
uint8 reflectivity      # reflectivity, 0~255
uint8 tag               # livox tag
uint8 line              # laser number in lidar
"""
CUSTOM = """std_msgs/Header header
uint64 timebase           # The time of first point
uint32 point_num          # Total number of pointclouds
uint8 lidar_id            # Lidar device id number
uint8[3] rsvd             # Reserved use
CustomPoint[] points      # Pointcloud data
"""
FRAMES = ("livox_frame", "mid360", "a")  # what follows a name is aligned, whatever its length


def messages(ros1: bool, package: str, point: str = POINT) -> bags.Messages:
    found = bags.Messages(ros1)
    types = get_types_from_msg(point, f"{package}/msg/CustomPoint")
    found.store.register(types | get_types_from_msg(CUSTOM, f"{package}/msg/CustomMsg"))
    return found


def scan(made: bags.Messages, package: str, stamp: int, frame: str = "livox_frame", points: int = 50) -> Any:
    """Make a scan of a floor, seen from 1.5 m. The last point is a beam that met nothing."""
    rng = np.random.default_rng(stamp % 1000)
    xyz = rng.uniform([-5, -5, -1.5], [15, 5, -1.4], (points, 3)).astype(np.float32)
    xyz[-1:] = 0
    kind = f"{package}/msg/CustomPoint"
    fields = [field.name for field in dataclasses.fields(cast(Any, made.store.types[kind]))]
    rows = [
        made.make(
            kind,
            **{
                name: value
                for name, value in {
                    "offset_time": 5000 * i,
                    **dict(zip("xyz", xyz[i].tolist(), strict=True)),
                    "reflectivity": i % 256,
                    "tag": 16 * (i % 4),
                    "line": i % 6,
                }.items()
                if name in fields
            },
        )
        for i in range(points)
    ]
    return made.make(
        f"{package}/msg/CustomMsg",
        header=made.header(stamp, frame),
        timebase=stamp,
        point_num=points,
        lidar_id=1,
        rsvd=np.zeros(3, np.uint8),
        points=rows,
    )


def columns(message: Any) -> dict[str, Any]:
    """Return the points as rosbags decodes them, without the one at the origin."""
    names = [field.name for field in dataclasses.fields(message.points[0])]
    return {n: np.array([getattr(p, n) for p in message.points[:-1]]) for n in names if n[0] != "_"}


@pytest.mark.parametrize("package", ["livox_ros_driver", "livox_ros_driver2"])
@pytest.mark.parametrize("form", ["mcap", "sqlite3", "ros1"])
def test_clouds_of_a_bag_are_what_rosbags_reads(tmp_path: Path, form: str, package: str) -> None:
    made = messages(form == "ros1", package)
    stamps = [bags.START + i * bags.PERIOD for i in range(3)]
    scans = [scan(made, package, *pair) for pair in zip(stamps, FRAMES, strict=True)]
    kind = f"{package}/msg/CustomMsg"
    items = [bags.Item("/livox/lidar", kind, t, m) for t, m in zip(stamps, scans, strict=True)]
    path = bags.write(tmp_path / ("bag.bag" if form == "ros1" else "bag"), items, made, form=form)
    with BagSource([path], Config()) as source:
        frames = list(source)
        assert source.roles.notes["/livox/lidar"] == "LiDAR, by type and name"
    assert [frame.stamp for frame in frames] == stamps
    for frame, message, name in zip(frames, scans, FRAMES, strict=True):
        theirs = columns(message)
        np.testing.assert_array_equal(frame.points, np.column_stack([theirs[n] for n in "xyz"]).astype("<f4"))
        assert frame.points_frame == name
        assert frame.clouds[0].dropped == 1
        np.testing.assert_array_equal(frame.fields["intensity"], theirs["reflectivity"])
        for field in ("offset_time", "tag", "line"):
            np.testing.assert_array_equal(frame.fields[field], theirs[field])


def test_a_definition_of_the_bags_own_is_believed(tmp_path: Path) -> None:
    """Of the first driver there were points without a tag."""
    package = "livox_ros_driver"
    made = messages(True, package, "".join(line + "\n" for line in POINT.splitlines() if " tag " not in line))
    item = bags.Item("/livox/lidar", f"{package}/msg/CustomMsg", bags.START, scan(made, package, bags.START))
    with BagSource([bags.write(tmp_path / "bag.bag", [item], made, form="ros1")], Config()) as source:
        (frame,) = source
    assert sorted(frame.fields) == ["intensity", "line", "offset_time"]
    np.testing.assert_array_equal(frame.fields["line"], columns(item.message)["line"])


def test_a_cut_message_and_one_without_points() -> None:
    made = messages(False, "livox_ros_driver2")
    kind = "livox_ros_driver2/msg/CustomMsg"
    whole = bytes(made.store.serialize_cdr(scan(made, kind.split("/")[0], bags.START), kind))
    decoded = decode_cloud(LiveMessage("/livox/lidar", kind, 0, whole[:-200]).decode(), "/livox/lidar", 0)
    assert (len(decoded.xyz), decoded.dropped) == (40, 10)
    for cut in range(0, 48, 7):
        with pytest.raises(MessageError, match="/livox/lidar: not a livox_ros_driver2/msg/CustomMsg: "):
            LiveMessage("/livox/lidar", kind, 0, whole[:cut]).decode()
    none = made.store.types[kind](
        header=made.header(1, "a"), timebase=0, point_num=0, lidar_id=0, rsvd=np.zeros(3, np.uint8), points=[]
    )
    empty = LiveMessage("/livox/lidar", kind, 0, bytes(made.store.serialize_cdr(none, kind))).decode()
    assert len(decode_cloud(empty, "/livox/lidar", 0).xyz) == 0


def test_info_names_the_lidar(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    package = "livox_ros_driver2"
    made = messages(False, package)
    item = bags.Item("/livox/lidar", f"{package}/msg/CustomMsg", bags.START, scan(made, package, bags.START))
    assert main(["info", str(bags.write(tmp_path / "bag", [item], made))]) == 0
    said = capsys.readouterr().out
    assert "/livox/lidar: LiDAR, by type and name" in said
    assert "livox_frame" in said
