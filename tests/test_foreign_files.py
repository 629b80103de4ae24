"""Files as other programs than those of the tests' authors write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bevviz.bags.bag import Recording
from bevviz.datasets import open_dataset
from bevviz.datasets.cloud_files import read_cloud
from bevviz.datasets.kitti_drives import CLOUDS
from bevviz.datasets.kitti_files import read_labels
from bevviz.errors import UserError
from bevviz.messages.clouds import decode_cloud
from bevviz.messages.detections import decode_detections_3d
from bevviz.messages.encode import encode_labels
from bevviz.model.frame import Boxes3D
from bevviz.model.geometry import inverse, transform, transform_boxes
from tests.support.datasets import TR, kitti_odometry, kitti_raw, nuscenes

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


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 1234567\n"


@pytest.mark.parametrize("name", ["drive.mcap", "drive.db3", "drive.bag"])
def test_a_git_lfs_pointer_of_a_bag_is_named(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(POINTER)
    with pytest.raises(UserError, match=f"{name}: a Git LFS pointer, not the file itself: 'git lfs pull'"):
        Recording([tmp_path / name])


@pytest.mark.parametrize("suffix", [".pcd", ".ply", ".npy", ".bin"])
def test_pointer_of_git_lfs_gives_no_points(suffix: str, tmp_path: Path) -> None:
    """Read as float32 it gave eight points some 10^31 m away."""
    file = tmp_path / f"0001{suffix}"
    file.write_bytes(POINTER * 2)
    with pytest.raises(UserError, match="a Git LFS pointer"):
        read_cloud(file, ("x", "y", "z", "intensity"))


def test_git_lfs_pointers_are_counted_in_one_line(tmp_path: Path) -> None:
    kitti_odometry(tmp_path)
    scans = sorted((tmp_path / "sequences/00/velodyne").iterdir())
    for scan in scans[:2]:
        scan.write_bytes(POINTER)
    drive = open_dataset(tmp_path / "sequences/00")
    told = drive.warnings if drive else []
    assert any(f"velodyne/{scans[0].name} and 1 more: a Git LFS pointer" in line for line in told)
    assert not any("cut" in line for line in told)


@pytest.mark.parametrize("columns", [4, 5, 6])
def test_kitti_folders_with_further_columns(columns: int, tmp_path: Path) -> None:
    """Waymo in KITTI's form has six (elongation and range); read as four, every point was wrong."""
    folder = kitti_odometry(tmp_path, labels=False)
    rng = np.random.default_rng(0)
    scan = rng.normal(0, [20, 15, 1, 1, 1, 1], (2000, 6)).astype(np.float32)
    scan[:, 3], scan[:, 4] = rng.uniform(0, 1, 2000), rng.integers(0, 64, 2000)
    scan[:, 5] = np.linalg.norm(scan[:, :3], axis=1)
    for file in (folder / "velodyne").iterdir():
        scan[:, :columns].tofile(file)
    drive = open_dataset(folder)
    assert drive
    (stream,) = [stream for stream in drive.streams if stream.type == "sensor_msgs/msg/PointCloud2"]
    points = decode_cloud(stream.make(0), CLOUDS, 0)
    np.testing.assert_array_equal(points.xyz, scan[:, :3])
    assert any(f"{columns} columns of float32" in line for line in drive.warnings) == (columns > 4)


def test_labels_of_types_that_kitti_has_not(tmp_path: Path) -> None:
    """They were left out, and what a detector missed of them was not counted."""
    for folder in ("calib", "label_2"):
        (tmp_path / folder).mkdir()
    (tmp_path / "calib/000000.txt").write_text(f"R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: {TR}\n")
    numbers = "0 0 0 100 100 200 200 1.5 1.6 4 0 1.5 20 0"
    kinds = ["car", "Bus", "Sign", "Misc", "DontCare", "Car"]
    (tmp_path / "label_2/000000.txt").write_text("\n".join(f"{kind} {numbers}" for kind in kinds) + "\n\n")
    labels = read_labels(tmp_path / "label_2/000000.txt")
    assert labels.labels == ("car", "Bus", "Sign", "Car")
    assert len(labels.boxes) == 4


def test_kitti_with_images_that_were_converted(tmp_path: Path) -> None:
    folder = kitti_odometry(tmp_path, labels=False)
    for file in (folder / "image_2").iterdir():
        file.rename(file.with_suffix(".JPG"))
    drive = open_dataset(folder)
    assert drive
    (images,) = [stream for stream in drive.streams if stream.topic.startswith("/image_2/image_rect")]
    assert len(images.times) == 3 and images.make(0).format == "jpeg"


@pytest.mark.parametrize("kind", ["four", "pcd"])
def test_tables_of_nuscenes_with_other_scans(kind: str, tmp_path: Path) -> None:
    """Sets with nuScenes' tables have four columns or true PCD, which were read as five float32 a point."""
    root = nuscenes(tmp_path)
    rng = np.random.default_rng(0)
    scan = rng.normal(0, [20, 15, 1, 0.1], (2000, 4)).astype("<f4")
    head = "VERSION 0.7\nFIELDS x y z i\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 2000\nHEIGHT 1\n"
    table = root / "v1.0-mini/sample_data.json"
    for file in root.glob("s*/LIDAR_TOP/*"):
        if kind == "pcd":
            file.with_suffix("").write_bytes(f"{head}POINTS 2000\nDATA binary\n".encode() + scan.tobytes())
        else:
            scan.tofile(file)
    if kind == "pcd":
        table.write_text(table.read_text().replace(".pcd.bin", ".pcd"))
    drive = open_dataset(root, sequence="scene-0061")
    assert drive
    (stream,) = [stream for stream in drive.streams if stream.type == "sensor_msgs/msg/PointCloud2"]
    points = decode_cloud(stream.make(0), "", 0)
    np.testing.assert_array_equal(points.xyz, scan[:, [1, 0, 2]] * [1, -1, 1])
    assert any("4 columns of float32" in line for line in drive.warnings) == (kind == "four")


def test_boxes_in_a_map_far_from_its_origin_keep_their_place() -> None:
    """In UTM float32 has steps of half a metre: boxes of such a map were off by as much."""
    half = 0.35
    map_from_points = transform((389_123.4567, 5_412_345.6789, 51.2), (0, 0, np.sin(half), np.cos(half)))
    there = np.array([[10.11, -3.22, 0.5], [25.33, 4.44, 1.0]])
    stated = there @ map_from_points[:3, :3].T + map_from_points[:3, 3]
    sizes, turns = np.ones((2, 3), np.float32), np.zeros(2, np.float32)
    msg = encode_labels(0, "map", Boxes3D(stated, sizes, turns), ["car", "car"], ["1", "2"])
    boxes = transform_boxes(decode_detections_3d(msg, "/boxes", 0).boxes, inverse(map_from_points))
    assert boxes.center.dtype == np.float32
    np.testing.assert_allclose(boxes.center, there, atol=1e-4)


@pytest.mark.parametrize("name", ["3a2e1b9f8c7d4e5f9a0b1c2d3e4f5a6b", "00544", "0000001"])
def test_kitti_with_other_names_of_frames(name: str, tmp_path: Path) -> None:
    """As nuScenes' devkit converts its scenes, and View of Delft: they were plain folders, not calibrated."""
    for folder in ("velodyne", "calib"):
        (tmp_path / folder).mkdir()
    np.ones((2000, 4), "<f4").tofile(tmp_path / f"velodyne/{name}.bin")
    rows = f"P2: {TR}\nR0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: {TR}\n"
    (tmp_path / f"calib/{name}.txt").write_text(rows)
    drive = open_dataset(tmp_path)
    assert drive and drive.name == "kitti-object"
    (tmp_path / f"calib/{name}.txt").write_text(rows.replace("cam:", "cam_0:"))  # of a converted Waymo
    drive = open_dataset(tmp_path)
    assert drive and drive.name == "kitti-object"


@pytest.mark.parametrize(("label", "name"), [("scalar_Intensity", "intensity"), ("I", "i")])
def test_names_of_fields_of_cloudcompare_and_carla(label: str, name: str, tmp_path: Path) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    (tmp_path / "1.ply").write_text(f"{head}property float {label}\nend_header\n1 2 3 4\n")
    points, _ = read_cloud(tmp_path / "1.ply", ())
    assert points.dtype.names == ("x", "y", "z", name)


def test_kitti_that_was_copied_by_a_mac(tmp_path: Path) -> None:
    """What it lays beside each file was a scan without a number, and the drive was refused."""
    for folder in (kitti_odometry(tmp_path), kitti_raw(tmp_path)):
        for file in [f for f in folder.rglob("*") if f.suffix in (".bin", ".png", ".label", ".txt")]:
            file.with_name(f"._{file.name}").write_bytes(b"\0\5\x16\7")
        drive = open_dataset(folder)
        assert drive
        counts = {stream.topic: len(stream.times) for stream in drive.streams}
        assert counts[CLOUDS] == 3, counts
