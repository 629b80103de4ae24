"""Labels that cannot be used: none of them disappears without being counted and told."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from bevviz.bags.source import BagSource
from bevviz.cli import main
from bevviz.config import Config, SourceConfig
from bevviz.datasets.kitti_labels import read_labels
from bevviz.messages.definitions import typestore
from bevviz.messages.detections import decode_detections_2d, decode_detections_3d
from bevviz.messages.encode import encode_boxes_3d
from bevviz.model.frame import Boxes3D
from tests.support import bags, datasets, documented_json

GOOD = "Car 0.00 0 -1.57 120 40 180 80 1.5 1.6 4.0 0.0 1.5 10.0 -1.57"
REGION = "DontCare -1 -1 -10 200 0 299 99 -1 -1 -1 -1000 -1000 -1000 -10"
Capture = pytest.CaptureFixture[str]


def label(**changed: str) -> str:
    """Return a KITTI label line with other values."""
    names = "type truncation occlusion alpha left top right bottom height width length x y z rotation_y"
    values = dict(zip(names.split(), GOOD.split(), strict=True))
    return " ".join((values | changed).values())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two frames as KITTI's object benchmark has them, each with a car 10 m ahead."""
    for name in ("velodyne", "image_2", "calib", "label_2"):
        (tmp_path / name).mkdir()
    rng = np.random.default_rng(0)
    car = np.column_stack([rng.uniform(8, 12, 200), rng.uniform(-0.8, 0.8, 200), rng.uniform(-1.5, 0, 200)])
    for name in ("000000", "000001"):
        np.column_stack([car, np.ones(200)]).astype(np.float32).tofile(tmp_path / f"velodyne/{name}.bin")
        cv2.imwrite(str(tmp_path / f"image_2/{name}.png"), np.zeros((100, 300, 3), np.uint8))
        (tmp_path / f"calib/{name}.txt").write_text(
            "P2: 100 0 150 0 0 100 50 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\n"
            "Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"
        )
        (tmp_path / f"label_2/{name}.txt").write_text(f"{GOOD}\n{REGION}\n")
    return tmp_path


# --- KITTI -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"x": "nan"}, "its x is nan"),
        ({"length": "inf"}, "its length is inf"),
        ({"rotation_y": "-inf"}, "its rotation_y is -inf"),
        ({"occlusion": "nan"}, "its occlusion is nan"),
        ({"height": "-1"}, "its size is negative: -1.0 1.6 4.0"),
        ({"z": "1e300"}, "its z is 1e+300"),
        ({"rotation_y": "-90"}, "its rotation_y of -90 is no angle in radians: is it in degrees?"),
    ],
)
def test_a_label_of_kitti_is_left_out_with_its_line(folder: Path, changed: Any, why: str) -> None:
    file = folder / "label_2/000000.txt"
    file.write_text(f"{GOOD}\n{label(**changed)}\n{REGION}\n")
    found = read_labels(file)
    assert found.labels == ("Car",) and found.image is not None and len(found.image.dont_care) == 1
    assert found.unusable == (f"{file}: line 2 (Car): {why}",)
    with BagSource([folder], Config()) as source:
        first = next(iter(source))
        assert first.truth is not None and first.truth.image is not None
        assert len(first.truth.boxes) == 1 and len(first.truth.image.dont_care) == 1
        said = f"1 box(es) of /ground_truth could not be used, the first: {file}: line 2 (Car): {why}"
        assert said in source.warnings


def test_a_region_that_is_not_finite_is_told(folder: Path) -> None:
    file = folder / "label_2/000000.txt"
    file.write_text(f"{GOOD}\n{REGION.replace('299', 'nan')}\n")
    assert read_labels(file).unusable == (f"{file}: line 2 (DontCare): its image box's right is nan",)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (label(width="wide"), "000000.txt: line 1 has something that is no number"),
        (GOOD.rpartition(" ")[0], "000000.txt: line 1 has 13 numbers, a KITTI label has 14"),
    ],
)
def test_a_label_file_that_is_none_is_told_by_every_command(
    folder: Path, tmp_path: Path, line: str, said: str, capsys: Capture
) -> None:
    (folder / "label_2/000000.txt").write_text(f"{line}\n")
    commands = (["info"], ["bag", "--save", str(tmp_path / "out.rrd")], ["evaluate", "--model", "demo"])
    for command, *options in commands:
        assert main([command, str(folder), *options]) == 0
        out, err = capsys.readouterr()
        assert said in " ".join((out + err).split())
    assert "1 frames, 1 without truth left out" in out


def test_evaluate_says_how_many_labels_were_left_out(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    for name in ("000000", "000001"):
        (folder / f"label_2/{name}.txt").write_text(f"{label(x='nan')}\n{label(height='0')}\n")
    assert main(["evaluate", str(folder), "--model", "demo", "--json", str(tmp_path / "found.json")]) == 0
    out, err = capsys.readouterr()
    file = folder / "label_2/000000.txt"
    assert f"4 labels are left out, the first: frame 0: {file}: line 1 (Car): its x is nan" in out
    assert f"2 box(es) of /ground_truth could not be used, the first: {file}: line 1 (Car)" in err
    tree = json.loads((tmp_path / "found.json").read_text())
    documented_json.check(tree, "bevviz.evaluate/1")
    assert tree["unusable_labels"] == 4
    assert tree["unusable_examples"][1] == "frame 0: box 0 (Car): a side of it is 0 m long"


def test_labels_beside_a_bag_are_counted(folder: Path, shared: Path, capsys: Capture) -> None:
    bag = bags.write(folder / "bag", bags.small_items(scans=2))
    (folder / "label_2/000001.txt").write_text(f"{label(y='nan')}\n")
    assert main(["evaluate", str(bag), "--model", "demo", "--kitti-labels", str(folder / "label_2")]) == 0
    assert "1 label is left out, the first: frame 1: " in capsys.readouterr().out


def test_a_label_of_the_tracking_benchmark_is_counted(tmp_path: Path) -> None:
    root = datasets.kitti_tracking(tmp_path)
    file = root / "label_02/0000.txt"
    file.write_text(file.read_text().replace(" 1.5 1.6 4.0 ", " 1.5 nan 4.0 ", 1))
    with BagSource([root / "velodyne/0000"], Config()) as source:
        list(source)
        (said,) = [text for text in source.warnings if "box(es)" in text]
    assert said.startswith("1 box(es) of /ground_truth could not be used, the first: ")
    assert said.endswith("0000.txt: line 1 (Car): its width is nan")


# --- messages ----------------------------------------------------------------------------------


def array(size: tuple[float, float, float], x: float = 5.0) -> Any:
    """Make a Detection3DArray of a good box and of one with this size and position."""
    boxes = Boxes3D(np.full((2, 3), 5.0), np.array([[4, 2, 1.5], size], np.float32), np.zeros(2, np.float32))
    results = [[("car", 1.0)], [("van", 1.0)]]
    message = encode_boxes_3d(bags.START, bags.LIDAR_FRAME, boxes, results, ids=["a", "b"])
    message.detections[1].bbox.center.position.x = x
    return message


@pytest.mark.parametrize(
    ("message", "why"),
    [
        (array((4, 2, 1), np.nan), "its centre is not finite: nan, 5, 5"),
        (array((4, np.inf, 1)), "its size is not finite: 4, inf, 1"),
        (array((4, -2, 1)), "its size is negative: 4, -2, 1"),
    ],
)
def test_a_box_of_a_message_is_told_by_info_and_bag(
    tmp_path: Path, message: Any, why: str, capsys: Capture
) -> None:
    found = decode_detections_3d(message, "/ground_truth", 0)
    assert found.labels == ("car",) and found.ids == ("a",)
    assert found.unusable == (f"box 1 (van, id b): {why}",)
    items = bags.small_items(scans=3)
    store = bags.Messages()
    store.store = typestore()
    for topic in ("/ground_truth", "/boxes"):
        items.append(bags.Item(topic, "vision_msgs/msg/Detection3DArray", bags.START + 1, message))
    bag = bags.write(tmp_path / "drive", items, store)
    for command in (["info", str(bag)], ["bag", str(bag), "--save", str(tmp_path / "out.rrd")]):
        assert main(command) == 0
        out, err = capsys.readouterr()
        for topic in ("/ground_truth", "/boxes"):
            said = f"1 box(es) of {topic} could not be used, the first: box 1 (van, id b): {why}"
            assert said in " ".join((out + err).split())


def test_an_image_box_of_a_message_is_told() -> None:
    make = typestore().types
    header = bags.Messages().header(bags.START, "camera")
    center = make["vision_msgs/msg/Pose2D"](make["vision_msgs/msg/Point2D"](1.0, 2.0), 0.0)
    box = make["vision_msgs/msg/BoundingBox2D"](center, -5.0, 3.0)
    detection = make["vision_msgs/msg/Detection2D"](header, [], box, "7")
    found = decode_detections_2d(make["vision_msgs/msg/Detection2DArray"](header, [detection]), "/d", 0)
    assert not len(found.xyxy)
    assert found.unusable == ("box 0 (id 7): its size is negative: -5, 3, 0",)


def test_a_label_of_nuscenes_is_counted_and_the_others_are_kept(tmp_path: Path) -> None:
    root = datasets.nuscenes(tmp_path)
    config = Config(source=SourceConfig(sequence="scene-0061"))
    (table,) = root.glob("v1.0-*/sample_annotation.json")
    rows = json.loads(table.read_text())
    with BagSource([root], config) as source:
        before = [len(frame.truth.boxes) for frame in source if frame.truth is not None]
    rows[0]["size"], rows[1]["rotation"] = ["wide", 4.0, 1.5], [float("nan"), 0, 0, 1]
    table.write_text(json.dumps(rows))
    with BagSource([root], config) as source:
        after = [len(frame.truth.boxes) for frame in source if frame.truth is not None]
        (said,) = [text for text in source.warnings if "box(es)" in text]
    assert sum(after) == sum(before) - 2
    assert said.startswith("2 box(es) of /ground_truth could not be used, the first: box 0 (")
    assert said.endswith("its size is not finite: nan, nan, nan")


def test_a_tracklet_that_is_not_finite_is_counted(tmp_path: Path) -> None:
    drive = datasets.kitti_raw(tmp_path)
    file = drive / "tracklet_labels.xml"
    file.write_text(re.sub("<rz>[^<]*</rz>", "<rz>nan</rz>", file.read_text(), count=1))
    with BagSource([drive], Config()) as source:
        list(source)
        (said,) = [text for text in source.warnings if "box(es)" in text]
    assert said.startswith("1 box(es) of /ground_truth could not be used, the first: box 0 (Car, id 0): ")
    assert "its orientation is not finite" in said
