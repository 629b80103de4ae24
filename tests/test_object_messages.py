"""Boxes in Autoware's, radars', markers' and private messages, which rosbags serialises."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bevviz.bags.source import BagSource
from bevviz.cli import main
from bevviz.config import load
from bevviz.model.frame import LabelledBoxes3D
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
)


def bag(tmp_path: Path, m: bags.Messages, kind: str, message: Any) -> Path:
    cloud = m.cloud(bags.START, np.random.default_rng(0).normal(0, 5, (200, 4)).astype(np.float32))
    items = [
        bags.Item(bags.CLOUD, "sensor_msgs/msg/PointCloud2", bags.START, cloud),
        bags.Item("/my/objects", kind, bags.START + 1000, message),
    ]
    return bags.write(tmp_path / "bag", items, m)


def boxes(path: Path, *settings: str) -> LabelledBoxes3D:
    with BagSource([path], load(settings=settings)) as source:
        (frame,) = source
        assert source.roles.notes["/my/objects"] == "the robot's own result"
    (found,) = frame.robot_boxes
    assert (found.topic, found.stamp, found.frame_id) == ("/my/objects", bags.START, bags.LIDAR_FRAME)
    return found


@pytest.mark.long
@pytest.mark.parametrize("package", ["autoware_perception_msgs", "autoware_auto_perception_msgs"])
@pytest.mark.parametrize("kind", ["Detected", "Tracked", "Predicted"])
def test_objects_of_autoware_are_decoded(tmp_path: Path, package: str, kind: str) -> None:
    m = made(package, AUTOWARE)
    found = boxes(bag(tmp_path, m, f"{package}/msg/{kind}Objects", autoware(m, package, kind)))
    assert_is_box(found)
    assert found.labels == ("pedestrian",)  # the likeliest, by the name of its constant
    assert found.scores.tolist() == [0.75]
    assert found.ids == (() if kind == "Detected" else (bytes(range(16)).hex(),))


def test_a_polygon_of_autoware_is_the_box_around_it(tmp_path: Path) -> None:
    package = "autoware_perception_msgs"
    m = made(package, AUTOWARE)
    outline = [(-1, -1), (3, -1), (3, 1), (0, 0.5)]  # in the object's axes
    found = boxes(
        bag(tmp_path, m, f"{package}/msg/DetectedObjects", autoware(m, package, "Detected", outline))
    )
    np.testing.assert_allclose(found.boxes.size, [[4, 2, BOX[5]]], rtol=1e-6)
    c, s = np.cos(BOX[6]), np.sin(BOX[6])
    np.testing.assert_allclose(found.boxes.center, [[10 + c, 2 + s, 0.5]], rtol=1e-6)


def test_tracks_of_a_radar_are_decoded(tmp_path: Path) -> None:
    m = made("radar_msgs", RADAR)
    found = boxes(bag(tmp_path, m, "radar_msgs/msg/RadarTracks", radar(m)))
    assert_is_box(found, yaw=0.0)
    assert found.labels == ("dynamic",)


MAPPED = "source.boxes={topic: /my/objects, center: pose.position, size: dimensions, label: class_name%s}"


def test_a_private_message_is_mapped_by_its_fields(tmp_path: Path) -> None:
    m = made("my_msgs", PRIVATE)
    path = bag(tmp_path, m, "my_msgs/msg/Things", private(m))
    found = boxes(path, MAPPED % "")
    assert_is_box(found)
    assert found.labels == ("van",)  # of two constants with that value the field's own
    assert (found.scores.tolist(), found.ids) == ([1.0], ())
    found = boxes(path, MAPPED % ", yaw: heading, score: confidence, id: number, objects: things")
    assert_is_box(found, yaw=-0.25)
    assert (found.scores.tolist(), found.ids) == ([0.5], ("12",))


def test_mapped_boxes_serve_as_ground_truth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    m = made("my_msgs", PRIVATE)
    path = str(bag(tmp_path, m, "my_msgs/msg/Things", private(m)))
    assert main(["evaluate", path, "--truth", "/my/objects", "--set", MAPPED % "", "--model", "demo"]) == 0
    assert "1 frame" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("topic: /my/object", "there is no topic /my/object; the nearest are /my/objects"),
        ("topic: /my/objects, centre: pose", "centre is not known, did you mean center? There are topic"),
        ("center: pose", "topic is missing"),
        ("topic: /my/objects, size: extent", "no field extent (of extent); there are pose, dimensions"),
        ("topic: /my/objects, objects: stuff", "no field stuff (of stuff); there are header, things"),
    ],
)
def test_a_wrong_mapping_is_one_line(
    tmp_path: Path, setting: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    m = made("my_msgs", PRIVATE)
    path = str(bag(tmp_path, m, "my_msgs/msg/Things", private(m)))
    main(["info", path, "--set", f"source.boxes={{{setting}}}"])
    said = capsys.readouterr()
    assert message.lower() in " ".join((said.out + said.err).split()).lower()


def test_markers_follow_the_documented_rule(tmp_path: Path) -> None:
    m = bags.Messages()

    def marker(number: int, kind: int, action: int = 0, text: str = "", ns: str = "cars") -> Any:
        box = pose(m), BOX[3:6]
        return m.marker(bags.LIDAR_FRAME, *box, ns=ns, number=number, kind=kind, action=action, text=text)

    shown = [marker(4, 1), marker(4, 9, text="bus"), marker(5, 1), marker(6, 1, action=2), marker(7, 2)]
    shown += [marker(4, 1, ns="people"), marker(8, 1), marker(8, 9, text="van", ns="labels")]
    message = m.make("visualization_msgs/msg/MarkerArray", markers=shown)
    path = bag(tmp_path, m, "visualization_msgs/msg/MarkerArray", message)
    found = boxes(path, "source.boxes={topic: /my/objects}")
    assert found.labels == ("bus", "cars", "people", "van")  # people/4 is no bus, as cars/4 is
    assert found.ids == ("cars/4", "cars/5", "people/4", "cars/8")
    np.testing.assert_allclose(found.boxes.size, [BOX[3:6]] * 4, rtol=1e-6)
    np.testing.assert_allclose(found.boxes.yaw, [BOX[6]] * 4, rtol=1e-6)
    with BagSource([path], load()) as source:  # without being asked to be boxes they are only shown
        assert source.roles.notes["/my/objects"] == "shown: around perception"
