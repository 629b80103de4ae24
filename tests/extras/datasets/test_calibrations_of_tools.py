"""Calibration files as tools write them, beside the folders of a plain drive."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

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
