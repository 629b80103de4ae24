"""Files as other programs than those of the tests' authors write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bevviz.bags.bag import Recording
from bevviz.datasets.cloud_files import read_cloud
from bevviz.datasets.kitti_labels import read_labels
from bevviz.errors import UserError
from bevviz.messages.detections import decode_detections_3d
from bevviz.messages.encode import encode_boxes_3d
from bevviz.model.frame import Boxes3D
from bevviz.model.geometry import inverse, transform, transform_boxes
from tests.support.datasets import LFS_POINTER, TR

OLD = """# .PCD v.5 - Point Cloud Data file format
VERSION .5
FIELDS x y z
SIZE 4 4 4
TYPE F F F
WIDTH 2
HEIGHT 1
POINTS 2
DATA ascii
"""
COLUMNS = OLD.replace("FIELDS", "COLUMNS")
NO_POINTS = OLD.replace("POINTS 2\n", "")
NO_WIDTH = OLD.replace("WIDTH 2\n", "").replace("HEIGHT 1\n", "")
NO_BYTES = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z _ intensity _ timestamp _ ring _
SIZE 4 4 4 1 4 1 8 1 2 1
TYPE F F F U F U F U U U
COUNT 1 1 1 4 1 0 1 6 1 12
WIDTH 3
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 3
DATA binary
"""


@pytest.mark.parametrize("header", [OLD, COLUMNS, NO_POINTS, NO_WIDTH])
def test_pcd_of_older_versions_is_read(header: str, tmp_path: Path) -> None:
    file = tmp_path / "0001.pcd"
    file.write_text(header + "1 2 3\n4 5 6\n")
    points, announced = read_cloud(file, ())
    assert announced == 2
    assert points.tolist() == [(1, 2, 3), (4, 5, 6)]


def test_pcd_with_padding_of_no_bytes(tmp_path: Path) -> None:
    names, types = ["x", "y", "z", "intensity", "timestamp", "ring"], ["<f4"] * 4 + ["<f8", "<u2"]
    layout = np.dtype({"names": names, "formats": types, "offsets": [0, 4, 8, 16, 20, 34], "itemsize": 48})
    there = np.zeros(3, layout)
    for number, name in enumerate(names):
        there[name] = 10 * number + np.arange(3)
    file = tmp_path / "0001.pcd"
    file.write_bytes(NO_BYTES.encode() + there.tobytes())
    points, announced = read_cloud(file, ())
    assert announced == 3 and points.dtype.names == tuple(names)
    for name in names:
        np.testing.assert_array_equal(points[name], there[name])


@pytest.mark.parametrize("name", ["drive.mcap", "drive.db3", "drive.bag"])
def test_a_git_lfs_pointer_of_a_bag_is_named(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(LFS_POINTER)
    with pytest.raises(UserError, match=f"{name}: a Git LFS pointer, not the file itself: 'git lfs pull'"):
        Recording([tmp_path / name])


@pytest.mark.parametrize("suffix", [".pcd", ".ply", ".npy", ".bin"])
def test_pointer_of_git_lfs_gives_no_points(suffix: str, tmp_path: Path) -> None:
    """Read as float32 it gave eight points some 10^31 m away."""
    file = tmp_path / f"0001{suffix}"
    file.write_bytes(LFS_POINTER * 2)
    with pytest.raises(UserError, match="a Git LFS pointer"):
        read_cloud(file, ("x", "y", "z", "intensity"))


def test_labels_of_types_that_kitti_has_not(tmp_path: Path) -> None:
    """They were left out, and what a detector missed of them was not counted."""
    for folder in ("calib", "label_2"):
        (tmp_path / folder).mkdir()
    (tmp_path / "calib/000000.txt").write_text(f"R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: {TR}\n")
    numbers = "0 0 0 100 100 200 200 1.5 1.6 4 0 1.5 20 0"
    kinds = ["car", "Bus", "Sign", "Misc", "DontCare", "Car"]
    (tmp_path / "label_2/000000.txt").write_text("\n".join(f"{kind} {numbers}" for kind in kinds) + "\n\n")
    labels = read_labels(tmp_path / "label_2/000000.txt")
    assert labels.labels == ("car", "Bus", "Sign", "Misc", "Car")
    assert len(labels.boxes) == 5


def test_boxes_in_a_map_far_from_its_origin_keep_their_place() -> None:
    """In UTM float32 has steps of half a metre: boxes of such a map were off by as much."""
    half = 0.35
    map_from_points = transform((389_123.4567, 5_412_345.6789, 51.2), (0, 0, np.sin(half), np.cos(half)))
    there = np.array([[10.11, -3.22, 0.5], [25.33, 4.44, 1.0]])
    stated = there @ map_from_points[:3, :3].T + map_from_points[:3, 3]
    sizes, turns = np.ones((2, 3), np.float32), np.zeros(2, np.float32)
    msg = encode_boxes_3d(0, "map", Boxes3D(stated, sizes, turns), [[("car", 1.0)]] * 2)
    boxes = transform_boxes(decode_detections_3d(msg, "/boxes", 0).boxes, inverse(map_from_points))
    assert boxes.center.dtype == np.float32
    np.testing.assert_allclose(boxes.center, there, atol=1e-4)


@pytest.mark.parametrize(("label", "name"), [("scalar_Intensity", "intensity"), ("I", "i")])
def test_names_of_fields_of_cloudcompare_and_carla(label: str, name: str, tmp_path: Path) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    (tmp_path / "1.ply").write_text(f"{head}property float {label}\nend_header\n1 2 3 4\n")
    points, _ = read_cloud(tmp_path / "1.ply", ())
    assert points.dtype.names == ("x", "y", "z", name)
