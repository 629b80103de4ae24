"""Folders of data sets as other programs than those of the tests' authors write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bevviz.datasets import open_dataset
from bevviz.extras.datasets.kitti_drives import CLOUDS
from tests.support.datasets import LFS_POINTER, TR, kitti_odometry, kitti_raw, nuscenes


def test_git_lfs_pointers_are_counted_in_one_line(tmp_path: Path) -> None:
    kitti_odometry(tmp_path)
    scans = sorted((tmp_path / "sequences/00/velodyne").iterdir())
    for scan in scans[:2]:
        scan.write_bytes(LFS_POINTER)
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
    points = stream.make(0)
    np.testing.assert_array_equal(points.xyz, scan[:, :3])
    assert any(f"{columns} columns of float32" in line for line in drive.warnings) == (columns > 4)


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
    points = stream.make(0)
    np.testing.assert_array_equal(points.xyz, scan[:, [1, 0, 2]] * [1, -1, 1])
    assert any("4 columns of float32" in line for line in drive.warnings) == (kind == "four")


@pytest.mark.parametrize("name", ["3a2e1b9f8c7d4e5f9a0b1c2d3e4f5a6b", "00544", "0000001"])
def test_kitti_with_other_names_of_frames(name: str, tmp_path: Path) -> None:
    """Folders of nuScenes' devkit and of View of Delft were plain folders, without a calibration."""
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


def test_kitti_that_was_copied_by_a_mac(tmp_path: Path) -> None:
    """A hidden file beside each scan was a scan without a number, and the drive was refused."""
    for folder in (kitti_odometry(tmp_path), kitti_raw(tmp_path)):
        for file in [f for f in folder.rglob("*") if f.suffix in (".bin", ".png", ".label", ".txt")]:
            file.with_name(f"._{file.name}").write_bytes(b"\0\5\x16\7")
        drive = open_dataset(folder)
        assert drive
        counts = {stream.topic: len(stream.times) for stream in drive.streams}
        assert counts[CLOUDS] == 3, counts
