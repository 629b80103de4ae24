"""Calibration, labels and poses common to KITTI's data sets (Geiger, Lenz and Urtasun 2012)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bevviz.datasets.dataset import Stream, files_in, read_points
from bevviz.errors import UserError
from bevviz.messages.encode import (
    encode_intrinsics,
    encode_labels,
    encode_points,
    encode_transforms,
)
from bevviz.messages.foreign_boxes import LARGEST
from bevviz.model import geometry
from bevviz.model.frame import F64, I64, Boxes3D, ImageLabels, Intrinsics, LabelledBoxes3D
from bevviz.support.files import read_text

LIDAR, IMU, MAP = "velodyne", "imu_link", "map"
CLOUDS = "/velodyne_points"
COLUMNS = (
    *("truncation", "occlusion", "alpha", "image box's left", "image box's top", "image box's right"),
    *("image box's bottom", "height", "width", "length", "x", "y", "z", "rotation_y"),
)
EARTH = 6378137.0  # metres; the radius in KITTI's development kit


# --- labels ------------------------------------------------------------------------------------


def label_files(path: Path) -> Sequence[Path]:
    """Return the label files of a drive in the order of its scans. A file stands for one scan.

    Raises:
        UserError: there is no label file.
    """
    files = files_in(path, [".txt"]) if path.is_dir() else [path]
    if not files or not files[0].is_file():
        raise UserError(f"--kitti-labels {path}: no label file there; expected label_2/000000.txt or label_2")
    return files


def read_labels(file: Path) -> LabelledBoxes3D:
    """Read the objects of ``label_2/NUMBER.txt`` in the LiDAR frame, with ``calib/NUMBER.txt`` next to it.

    A ``DontCare`` label keeps its region in the image.

    Raises:
        UserError: a file cannot be read, or has not KITTI's format.
    """
    calibration = Calibration(file.parent.parent / "calib" / file.name)
    lines = list(enumerate(read_text(file).splitlines(), 1))
    return labelled_boxes(file, lines, calibration.rectified_from_lidar)


def labelled_boxes(
    file: Path, lines: Sequence[tuple[int, str]], rectified_from_lidar: F64, ids: Sequence[str] = ()
) -> LabelledBoxes3D:
    """Convert label lines to boxes in the LiDAR frame.

    Every type but Misc counts, because data sets in KITTI's format have types of their own. A label with
    non-finite numbers or a negative size is left out and listed in ``unusable``.

    Args:
        file: label file, for messages.
        lines: (line number, line): type, truncated, occluded, alpha, image box, size, location, rotation.
        rectified_from_lidar: (4, 4) transform.
        ids: object name of each line.

    Raises:
        UserError: a line has not KITTI's format.
    """
    lidar_from_camera = geometry.inverse(rectified_from_lidar)
    labels, rows, dont_care, kept, unusable = [], [], [], [], []
    for index, (number, line) in enumerate(lines):
        kind, *values = line.split() or [""]
        if kind in ("", "Misc"):
            continue
        if len(values) < 14:
            raise UserError(f"{file}: line {number} has {len(values)} numbers, a KITTI label has 14")
        try:
            row = [float(value) for value in values[:14]]
        except ValueError:
            raise UserError(f"{file}: line {number} has something that is no number") from None
        if why := _why_unusable(kind, row):
            unusable.append(f"{file}: line {number} ({kind}): {why}")
            continue
        if kind == "DontCare":
            dont_care.append(row[3:7])
            continue
        labels.append(kind)
        rows.append(row)
        kept.append(index)
    table = np.array(rows, np.float64).reshape(-1, 14)
    height, width, length, x, y, z, turn = table[:, 7:].T
    # A location is the centre of the bottom in the reference camera: x right, y down, z forward.
    center = geometry.apply(lidar_from_camera, np.column_stack([x, y - height / 2, z]))
    # The heading is (cos, 0, -sin) in this frame.
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
    names = tuple(ids[index] for index in kept) if ids else ()
    return LabelledBoxes3D(
        str(file), 0, "", boxes, tuple(labels), ones, ids=names, image=image, unusable=tuple(unusable)
    )


def _why_unusable(kind: str, row: Sequence[float]) -> str:
    """Describe the error in the 14 numbers of a label; empty: none."""
    needed = COLUMNS[3:7] if kind == "DontCare" else COLUMNS
    for name, value in zip(COLUMNS, row, strict=True):
        if name in needed and name != "alpha" and not abs(value) < LARGEST:  # This form is also true for NaN.
            return f"its {name} is {value}"
    size = row[7:10]
    if kind != "DontCare" and min(size) < 0:
        return f"its size is negative: {' '.join(map(str, size))}"
    return ""


# --- calibration -------------------------------------------------------------------------------


class Calibration:
    """Calibration file with lines of ``NAME: numbers``. The tracking benchmark omits some colons.

    Raises:
        UserError: the file cannot be read, or has no projections or LiDAR mounting.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self._rows = named_rows(file)
        reference = self._matrix(3, 4, "Tr_velo_to_cam", "Tr_velo_cam", "Tr")
        rectified = np.eye(4)
        if not {"R0_rect", "R_rect"}.isdisjoint(self._rows):  # The odometry benchmark includes it in Tr.
            rectified[:3, :3] = self._matrix(3, 3, "R0_rect", "R_rect")
        self.rectified_from_lidar = rectified @ np.vstack([reference, [0, 0, 0, 1]])

    def camera(self, number: int) -> tuple[F64, F64]:
        """Return (3, 3) K and (4, 4) camera_from_lidar of a camera. Camera 2 is the left colour camera."""
        matrix, camera_from_reference = split_projection(self._matrix(3, 4, f"P{number}"))
        return matrix, camera_from_reference @ self.rectified_from_lidar

    @property
    def lidar_from_imu(self) -> F64:
        """(4, 4) transform from the IMU to the LiDAR."""
        return np.vstack([self._matrix(3, 4, "Tr_imu_to_velo", "Tr_imu_velo"), [0, 0, 0, 1]])

    def _matrix(self, rows: int, columns: int, *names: str) -> F64:
        values = next((self._rows[name] for name in names if name in self._rows), None)
        if values is None or len(values) != rows * columns or not np.isfinite(values).all():
            raise UserError(
                f"{self.file}: no {' or '.join(names)} of {rows} x {columns} numbers, as KITTI writes it"
            )
        return values.reshape(rows, columns)


def named_rows(file: Path) -> Mapping[str, F64]:
    """Read the numbers after each name. Other lines are left out.

    Raises:
        UserError: the file cannot be read.
    """
    rows = {}
    for line in read_text(file).splitlines():
        name, *values = line.replace(":", " ", 1).split() or [""]
        try:
            rows[name] = np.array(values, np.float64)
        except ValueError:
            continue
    return rows


def split_projection(projection: F64) -> tuple[F64, F64]:
    """Split a (3, 4) projection into (3, 3) K and (4, 4) camera_from_reference, both rectified cameras."""
    camera_from_reference = np.eye(4)
    try:
        camera_from_reference[:3, 3] = np.linalg.solve(projection[:, :3], projection[:, 3])
    except np.linalg.LinAlgError:
        raise UserError(f"a projection of {projection.tolist()} is that of no camera") from None
    return projection[:, :3], camera_from_reference


# --- positions ---------------------------------------------------------------------------------


def poses_of_oxts(table: F64) -> F64:
    """Return (N, 4, 4) first_from_each IMU poses, computed as in the development kit.

    Args:
        table: (N, 6 or more) latitude, longitude in degrees, altitude in metres, roll, pitch, yaw in radians.
    """
    latitude, longitude, altitude, roll, pitch, yaw = table[:, :6].T
    scale = np.cos(np.radians(latitude[0])) if len(table) else 1.0
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, 0, 3] = scale * EARTH * np.radians(longitude)  # Mercator projection
    poses[:, 1, 3] = scale * EARTH * np.log(np.tan(np.radians(90.0 + latitude) / 2))
    poses[:, 2, 3] = altitude
    poses[:, :3, :3] = _rotations(2, yaw) @ _rotations(1, pitch) @ _rotations(0, roll)
    return np.asarray(geometry.inverse(poses[0]) @ poses if len(poses) else poses)


def _rotations(axis: int, angles: F64) -> F64:
    """Return (N, 3, 3) rotations about an axis."""
    a, b = (axis + 1) % 3, (axis + 2) % 3
    turns = np.tile(np.eye(3), (len(angles), 1, 1))
    turns[:, a, a] = turns[:, b, b] = np.cos(angles)
    turns[:, b, a], turns[:, a, b] = np.sin(angles), -np.sin(angles)
    return turns


# --- streams -----------------------------------------------------------------------------------


def cloud_stream(times: I64, files: Sequence[Path], fields: Sequence[str]) -> Stream:
    """Return the stream of scans with x, y, z, reflectance and further columns (Waymo's has 6 columns)."""

    def make(row: int) -> Any:
        return encode_points(int(times[row]), LIDAR, read_points(files[row], fields))

    return Stream(CLOUDS, "sensor_msgs/msg/PointCloud2", times, make)


def camera_info_stream(camera: str, times: I64, matrix: F64) -> Stream:
    """Return a stream with one calibration for all images."""
    first_time = times[:1]

    def make(row: int) -> Any:
        return encode_intrinsics(int(first_time[row]), camera, Intrinsics(0, 0, matrix))

    return Stream(f"/{camera}/camera_info", "sensor_msgs/msg/CameraInfo", first_time, make)


def mounting_stream(start: int, edges: Sequence[tuple[str, str, F64]]) -> Stream:
    """Return the stream of static transforms (parent, child, parent_from_child)."""
    times = np.array([start], np.int64)
    return Stream(
        "/tf_static", "tf2_msgs/msg/TFMessage", times, lambda row: encode_transforms(int(times[row]), edges)
    )


def pose_stream(times: I64, child: str, poses: F64) -> Stream:
    """Return the stream of (N, 4, 4) poses of a vehicle frame in the map."""

    def make(row: int) -> Any:
        return encode_transforms(int(times[row]), [(MAP, child, poses[row])])

    return Stream("/tf", "tf2_msgs/msg/TFMessage", times, make)


def ground_truth_stream(message_type: str, times: I64, label: Any) -> Stream:
    """Return the stream of ground truth in the LiDAR frame. ``label`` returns the labels of a row."""

    def make(row: int) -> Any:
        labels: LabelledBoxes3D = label(row)
        details = labels.labels, labels.ids, labels.image, labels.unusable
        return encode_labels(int(times[row]), LIDAR, labels.boxes, *details)

    return Stream("/ground_truth", message_type, times, make)
