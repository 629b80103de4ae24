"""Calibration files as tools write them, beside the folders of a plain drive."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import bevviz
from bevviz.extras.datasets.calibrations import find_calibrations
from bevviz.model import geometry

POSE = [0.2, 0.05, -0.1, -0.5, 0.5, -0.5, 0.5]  # of the camera in the LiDAR's frame
LIDAR_FROM_CAMERA = geometry.transform(POSE[:3], POSE[3:])
CAMERA_FROM_LIDAR = geometry.inverse(LIDAR_FROM_CAMERA)
K = [450.0, 0, 320, 0, 450, 240, 0, 0, 1]
ROWS = "[" + ", ".join(map(str, K)) + "]"
OST = (
    "image_width: 640\nimage_height: 480\ncamera_name: camera\n"
    f"camera_matrix: {{rows: 3, cols: 3, data: {ROWS}}}\n"
    "distortion_model: plumb_bob\ndistortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}\n"
)
PINHOLE = "".join(
    f"cam_{key}: {value}\n"
    for key, value in {
        "model": "Pinhole",
        "width": 640,
        "height": 480,
        "fx": 450.0,
        "fy": 450.0,
        "cx": 320.0,
        "cy": 240.0,
    }.items()
)


def listed(matrix: Any) -> str:
    return "[" + ", ".join(map(str, np.asarray(matrix, float).ravel())) + "]"


def opencv(name: str, matrix: Any, rows: int, columns: int) -> str:
    return (
        f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: {listed(matrix)}\n"
    )


def direct_visual(key: str, pose: list[float]) -> str:
    camera = {"camera_model": "plumb_bob", "intrinsics": [450, 450, 320, 240], "distortion_coeffs": [0] * 5}
    return json.dumps({"camera": camera, "results": {key: pose}})


INVERSE = [*CAMERA_FROM_LIDAR[:3, 3].tolist(), *geometry.quaternion(CAMERA_FROM_LIDAR).tolist()]
LENS = "%YAML:1.0\n---\n" + opencv("camera_matrix", K, 3, 3)
LIVO = (
    f"extrin_calib:\n  Rcl: {listed(CAMERA_FROM_LIDAR[:3, :3])}\n  Pcl: {listed(CAMERA_FROM_LIDAR[:3, 3])}\n"
)
PLAIN = "\n".join(",".join(map(str, row)) for row in CAMERA_FROM_LIDAR)
PLACE, QUATERNION = dict(zip("xyz", POSE[:3], strict=True)), dict(zip("xyzw", POSE[3:], strict=True))
INFO = {"header": {}, "width": 640, "height": 480, "distortion_model": "plumb_bob", "d": [0.0] * 5, "k": K}
MATRIX = f"extrinsic_matrix: {CAMERA_FROM_LIDAR.tolist()}\n"
FILES = {
    "direct_visual_lidar_calibration": {"calib.json": direct_visual("T_lidar_camera", POSE)},
    "direct_visual, the other way round": {"calib.json": direct_visual("T_camera_lidar", INVERSE)},
    "ros2_camera_lidar_fusion": {"a.yaml": OST, "extrinsic.yaml": MATRIX},
    "FAST-LIVO2": {"avia.yaml": LIVO, "camera_pinhole.yaml": PINHOLE},
    "T_C_L": {"calib.yaml": LENS + opencv("T_C_L", CAMERA_FROM_LIDAR, 4, 4)},
    "T_lidar_cam": {"calib.yaml": LENS + opencv("T_lidar_cam", LIDAR_FROM_CAMERA, 4, 4)},
    "Tcl": {"calib.yaml": LENS + opencv("Tcl", CAMERA_FROM_LIDAR, 4, 4)},
    "LVT2Calib": {"ost.yaml": OST, "extrinsic.txt": PLAIN},
    "RELLIS-3D": {
        "camera_info.txt": "450.0 450.0 320.0 240.0\n",
        "transforms.yaml": f"os1_cloud_node-pylon_camera_node:\n  q: {QUATERNION}\n  t: {PLACE}\n",
    },
    "CameraInfo as JSON": {"info.json": json.dumps(INFO), "extrinsic.txt": PLAIN},
    "LVT2Calib, with spaces": {"ost.yaml": OST, "extrinsics.txt": PLAIN.replace(",", " ")},
}  # fmt: skip


@pytest.mark.parametrize("tool", FILES)
def test_the_calibration_of_a_tool_is_read(tmp_path: Path, tool: str) -> None:
    """The direction of the transform is in its name."""
    for name, text in FILES[tool].items():
        (tmp_path / name).write_text(text)
    found = find_calibrations(tmp_path, ["lidar"], ["camera"])
    np.testing.assert_allclose(
        np.reshape(found.cameras["camera"]["pose"], (4, 4)), LIDAR_FROM_CAMERA, atol=1e-6
    )
    assert np.allclose(np.ravel(found.cameras["camera"]["K"]), K)
    assert not found.warnings


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            "cam0: {camera_model: omni, intrinsics: [1.2, 990, 990, 320, 240]}",
            "camera_model omni is not supported",
        ),
        (
            "cam0: {camera_model: pinhole, intrinsics: [450, 450, 320, 240], T_cam_imu: [1]}",
            "T_cam_imu of cam0 states the IMU, not the LiDAR",
        ),
    ],
)
def test_what_a_camchain_cannot_give_is_said(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "camchain.yaml").write_text(text)
    assert any(reason in warning for warning in find_calibrations(tmp_path, ["lidar"], ["camera"]).warnings)


def test_a_file_that_was_not_read_is_named(tmp_path: Path) -> None:
    (tmp_path / "ost.yaml").write_text(OST)
    (tmp_path / "extrinsics.yaml").write_text("rotation_of_our_tool: [1, 2, 3]\n")
    (warning,) = find_calibrations(tmp_path, ["lidar"], ["camera"]).warnings
    assert warning.startswith("extrinsics.yaml: is not used")


def sensor_folder(path: Path, size: tuple[int, int] = (640, 480)) -> None:
    """Write two scans and two JPEG images of a size."""
    for name in ("os1_cloud_node_kitti_bin", "pylon_camera_node", "pylon_camera_node_label_id"):
        (path / name).mkdir(parents=True)
    points = np.random.default_rng(0).uniform(-9, 9, (2000, 4)).astype(np.float32)
    for number in range(2):
        points.tofile(path / f"os1_cloud_node_kitti_bin/{number:06}.bin")
        image = np.full((size[1], size[0], 3), 90, np.uint8)
        name = f"frame{number:06}-1581624660_{149 + 100 * number}"
        cv2.imwrite(str(path / f"pylon_camera_node/{name}.jpg"), image)
        cv2.imwrite(str(path / f"pylon_camera_node_label_id/{name}.png"), image)


def test_pictures_that_no_camera_took_are_left_out(tmp_path: Path) -> None:
    """RELLIS-3D has label images of the camera's names, and people keep screenshots beside both."""
    sensor_folder(tmp_path)
    for name, text in FILES["RELLIS-3D"].items():
        (tmp_path / name).write_text(text)
    picture = np.full((600, 900, 3), 200, np.uint8)
    for name in ("view.png", "pylon_camera_node/000104.png"):
        cv2.imwrite(str(tmp_path / name), picture)
    label = tmp_path / "pylon_camera_node/frame000000-1581624660_149.png"
    cv2.imwrite(str(label), np.zeros((480, 640), np.uint8))
    with bevviz.open(tmp_path) as drive:
        (camera,) = drive[0].frame.cameras
        warnings = "\n".join(map(str, drive.warnings))
    assert camera.image is not None and camera.image.bgr.shape == (480, 640, 3)
    assert camera.intrinsics is not None and camera.intrinsics.K.ravel().tolist() == K
    assert camera.camera_from_points is not None
    np.testing.assert_allclose(camera.camera_from_points, CAMERA_FROM_LIDAR, atol=1e-6)
    assert "view.png: beside the folders of the cameras: left out" in warnings
    assert "000104.png: 900 x 600, and the camera's images 640 x 480: left out as no image of it" in warnings


def test_a_lidar_that_nothing_places_is_left_out(tmp_path: Path) -> None:
    """Beside a placed LiDAR its points would be anywhere: RELLIS-3D's Velodyne looks backwards."""
    sensor_folder(tmp_path)
    (tmp_path / "vel_cloud_node_kitti_bin").mkdir()
    np.ones((500, 4), np.float32).tofile(tmp_path / "vel_cloud_node_kitti_bin/000000.bin")
    for name, text in FILES["RELLIS-3D"].items():
        (tmp_path / name).write_text(text)
    with bevviz.open(tmp_path) as drive:
        assert [cloud.name for cloud in drive[0].frame.clouds] == ["os1_cloud_node_kitti_bin"]
        assert any("vel_cloud_node_kitti_bin: no calibration says how" in str(w) for w in drive.warnings)
    (tmp_path / "vel2os1.yaml").write_text(f"vel2os1:\n  q: {QUATERNION}\n  t: {PLACE}\n")
    found = find_calibrations(tmp_path, ["os1_cloud_node_kitti_bin", "vel_cloud_node_kitti_bin"], ["camera"])
    pose = np.reshape(found.lidars["vel_cloud_node_kitti_bin"]["pose"], (4, 4))
    np.testing.assert_allclose(pose, LIDAR_FROM_CAMERA, atol=1e-6)


@pytest.mark.parametrize(
    ("size", "matrix", "words"),
    [
        ((320, 240), [225.0, 0, 159.75, 0, 225, 119.75, 0, 0, 1], ""),
        ((597, 360), None, "is for 640 x 480 pixels, the image has 597 x 360"),
    ],
)
def test_the_size_in_a_camera_info_counts(
    tmp_path: Path, size: tuple[int, int], matrix: list[float] | None, words: str
) -> None:
    """Smaller images have a smaller K; cropped ones have none, as nothing says what was cut off."""
    sensor_folder(tmp_path, size)
    for name, text in FILES["CameraInfo as JSON"].items():
        (tmp_path / name).write_text(text)
    with bevviz.open(tmp_path) as drive:
        (camera,) = drive[0].frame.cameras
    got = None if camera.intrinsics is None else camera.intrinsics.K.ravel().tolist()
    assert got == (None if matrix is None else pytest.approx(matrix))
    assert any(words in problem for problem in camera.problems) or not words
