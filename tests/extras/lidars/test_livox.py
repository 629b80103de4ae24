"""Livox's CustomMsg, serialised by rosbags from the definitions of both drivers."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bevviz.bags.source import BagSource
from bevviz.cli import main
from bevviz.config import Config
from bevviz.live.live_message import LiveMessage
from bevviz.messages.clouds import decode_cloud
from bevviz.messages.decoders import MessageError
from tests.support import bags
from tests.support.livox_messages import POINT, messages, scan

FRAMES = ("livox_frame", "mid360", "a")  # what follows a name is aligned, whatever its length


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
