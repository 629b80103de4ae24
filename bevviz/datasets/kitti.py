"""Labels of the KITTI object benchmark (Geiger, Lenz and Urtasun 2012)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bevviz import geometry
from bevviz.errors import UserError
from bevviz.frame import F64, Boxes3D, ImageLabels, LabelledBoxes3D

# What a detector of COCO's classes may rightly call them.
ACCEPTED = {
    "Pedestrian": frozenset({"pedestrian", "person"}),
    "Person_sitting": frozenset({"person_sitting", "pedestrian", "person"}),
    "Cyclist": frozenset({"cyclist", "person", "bicycle"}),
    "Car": frozenset({"car"}),
    "Van": frozenset({"van", "car", "truck", "bus"}),
    "Truck": frozenset({"truck", "car", "bus"}),
    "Tram": frozenset({"tram", "train", "bus"}),
}


def label_files(path: Path) -> Sequence[Path]:
    """The label files of a drive's scans in their order: a file is one scan, a folder many.

    Raises:
        UserError: there is none.
    """
    files = sorted(path.glob("*.txt")) if path.is_dir() else [path]
    if not files or not files[0].is_file():
        raise UserError(f"--kitti-labels {path}: no label file there; expected label_2/000000.txt or label_2")
    return files


def read_labels(file: Path) -> LabelledBoxes3D:
    """The labelled objects in the frame of the LiDAR, with the calibration of the same number beside them.

    The file is ``label_2/NUMBER.txt`` and the calibration ``calib/NUMBER.txt``. Of ``DontCare`` the region
    in the image is kept.

    Raises:
        UserError: a file cannot be read, or is none of KITTI's.
    """
    calibration = file.parent.parent / "calib" / file.name
    lidar_from_camera = geometry.inverse(_camera_from_lidar(calibration))
    labels, rows, dont_care = [], [], []
    for number, line in enumerate(_read(file).splitlines(), 1):
        kind, *values = line.split()
        if kind not in ACCEPTED and kind != "DontCare":
            continue
        if len(values) < 14:
            raise UserError(f"{file}: line {number} has {len(values)} numbers, a KITTI label has 14")
        try:
            row = [float(value) for value in values[:14]]
        except ValueError:
            raise UserError(f"{file}: line {number} has something that is no number") from None
        if kind == "DontCare":
            dont_care.append(row[3:7])
            continue
        labels.append(kind)
        rows.append(row)
    table = np.array(rows, np.float64).reshape(-1, 14)
    height, width, length, x, y, z, turn = table[:, 7:].T
    # A location is the middle of the bottom, in the reference camera: x right, y down, z forward.
    center = geometry.apply(lidar_from_camera, np.column_stack([x, y - height / 2, z]))
    # The heading is (cos, 0, -sin) there.
    heading = (
        np.column_stack([np.cos(turn), np.zeros(len(turn)), -np.sin(turn)]) @ lidar_from_camera[:3, :3].T
    )
    boxes = Boxes3D(
        center,
        np.column_stack([length, width, height]).astype(np.float32),
        np.arctan2(heading[:, 1], heading[:, 0]).astype(np.float32),
    )
    image = ImageLabels(
        table[:, 3:7].astype(np.float32),
        table[:, 0].astype(np.float32),
        table[:, 1].astype(np.int32),
        np.array(dont_care, np.float32).reshape(-1, 4),
    )
    ones = np.ones(len(labels), np.float32)
    return LabelledBoxes3D(str(file), 0, "", boxes, tuple(labels), ones, image=image)


def _camera_from_lidar(calibration: Path) -> F64:
    """(4, 4) rectified reference camera from LiDAR."""
    lines = [line.split(":", 1) for line in _read(calibration).splitlines() if ":" in line]
    rows = {name: np.array(values.split(), np.float64) for name, values in lines}
    rectified, reference = np.eye(4), np.eye(4)
    try:
        rectified[:3, :3] = rows["R0_rect"].reshape(3, 3)
        reference[:3] = rows["Tr_velo_to_cam"].reshape(3, 4)
    except (KeyError, ValueError):
        raise UserError(f"{calibration}: no R0_rect and Tr_velo_to_cam as KITTI writes them") from None
    return rectified @ reference


def _read(path: Path) -> str:
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "is no text"
        raise UserError(f"--kitti-labels: {path}: cannot be read: {reason}") from None
