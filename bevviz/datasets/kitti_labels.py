"""KITTI's text files of labels and of calibrations (Geiger, Lenz and Urtasun 2012).

Detectors write their results in this format, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from bevviz.datasets.dataset import files_in
from bevviz.errors import UserError
from bevviz.messages.foreign_boxes import LARGEST
from bevviz.model import geometry
from bevviz.model.frame import F64, Boxes3D, ImageLabels, LabelledBoxes3D
from bevviz.support.files import read_text

COLUMNS = (
    *("truncation", "occlusion", "alpha", "image box's left", "image box's top", "image box's right"),
    *("image box's bottom", "height", "width", "length", "x", "y", "z", "rotation_y"),
)
TURN = 6.3  # radians of a full turn, rounded
MIN_FOCAL = 5.0  # pixels; placeholders are the identity, or negative


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


def read_labels(file: Path, calibrations: Path | None = None) -> LabelledBoxes3D:
    """Read the objects of ``label_2/NUMBER.txt`` in the LiDAR frame.

    A ``DontCare`` label keeps its region in the image.

    Args:
        file: label file.
        calibrations: folder of ``NUMBER.txt``; None: the folder ``calib`` next to ``label_2``.

    Raises:
        UserError: a file cannot be read, or has not KITTI's format.
    """
    calibration = Calibration((calibrations or file.parent.parent / "calib") / file.name)
    lines = list(enumerate(read_text(file).splitlines(), 1))
    return labelled_boxes(file, lines, calibration.rectified_from_lidar)


def labelled_boxes(
    file: Path, lines: Sequence[tuple[int, str]], rectified_from_lidar: F64, ids: Sequence[str] = ()
) -> LabelledBoxes3D:
    """Convert label lines to boxes in the LiDAR frame.

    Every type is kept, because data sets in KITTI's format have types of their own. A label with non-finite
    numbers or a negative size is left out and listed in ``unusable``.

    Args:
        file: label file, for messages.
        lines: (line number, line): type, truncated, occluded, alpha, image box, size, location, rotation.
        rectified_from_lidar: (4, 4) transform.
        ids: object name of each line.

    Raises:
        UserError: a line has not KITTI's format.
    """
    lidar_from_camera = geometry.inverse(rectified_from_lidar)
    labels, rows, dont_care, kept, unusable, scores = [], [], [], [], [], []
    for index, (number, line) in enumerate(lines):
        kind, *values = line.split() or [""]
        if not kind:
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
        scores.append(_score(file, number, values))
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
    names = tuple(ids[index] for index in kept) if ids else ()
    confidences = np.array(scores, np.float32)
    return LabelledBoxes3D(
        str(file), 0, "", boxes, tuple(labels), confidences, ids=names, image=image, unusable=tuple(unusable)
    )


def _score(file: Path, number: int, values: Sequence[str]) -> float:
    """Return the score in the 16th column of a detector's result; 1 for a label, which has none."""
    try:
        return float(values[14]) if len(values) > 14 else 1.0
    except ValueError:
        raise UserError(f"{file}: line {number} has something that is no number") from None


def _why_unusable(kind: str, row: Sequence[float]) -> str:
    """Describe the error in the 14 numbers of a label; empty: none."""
    needed = COLUMNS[3:7] if kind == "DontCare" else COLUMNS
    for name, value in zip(COLUMNS, row, strict=True):
        if name in needed and name != "alpha" and not abs(value) < LARGEST:  # This form is also true for NaN.
            return f"its {name} is {value}"
    size = row[7:10]
    if kind != "DontCare" and min(size) < 0:
        return f"its size is negative: {' '.join(map(str, size))}"
    if kind != "DontCare" and abs(row[13]) > TURN:
        return f"its rotation_y of {row[13]:g} is no angle in radians: is it in degrees?"
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
        reference = self._matrix(3, 4, "Tr_velo_to_cam", "Tr_velo_cam", "Tr", "Tr_velo_to_cam_0")
        rectified = self._rectified = np.eye(4)
        if not {"R0_rect", "R_rect"}.isdisjoint(self._rows):  # The odometry benchmark includes it in Tr.
            rectified[:3, :3] = self._matrix(3, 3, "R0_rect", "R_rect")
        self.rectified_from_lidar = rectified @ np.vstack([reference, [0, 0, 0, 1]])

    def camera(self, number: int) -> tuple[F64, F64]:
        """Return (3, 3) K and (4, 4) camera_from_lidar of a camera. Camera 2 is the left colour camera."""
        matrix, camera_from_reference = split_projection(self._matrix(3, 4, f"P{number}"))
        if f"Tr_velo_to_cam_{number}" in self._rows:
            mounted = np.vstack([self._matrix(3, 4, f"Tr_velo_to_cam_{number}"), [0, 0, 0, 1]])
            return matrix, np.asarray(camera_from_reference @ self._rectified @ mounted, np.float64)
        return matrix, camera_from_reference @ self.rectified_from_lidar

    @property
    def has_mountings(self) -> bool:
        """Whether each camera has a mounting of its own, as in conversions of other data sets."""
        return "Tr_velo_to_cam_0" in self._rows

    def has_camera(self, number: int) -> bool:
        """Return whether there is a projection of a camera."""
        return f"P{number}" in self._rows

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

    The first of several lines with a name counts: an exporter of CARLA repeats P2 with numbers that mean
    nothing.

    Raises:
        UserError: the file cannot be read.
    """
    rows = dict[str, F64]()
    for line in read_text(file).splitlines():
        name, *values = line.replace(":", " ", 1).split() or [""]
        try:
            rows.setdefault(name, np.array(values, np.float64))
        except ValueError:
            continue
    return rows


def split_projection(projection: F64) -> tuple[F64, F64]:
    """Split a (3, 4) projection into (3, 3) K and (4, 4) camera_from_reference, both rectified cameras."""
    camera_from_reference = np.eye(4)
    if min(projection[0, 0], projection[1, 1]) < MIN_FOCAL or abs(np.linalg.det(projection[:, :3])) < 1e-9:
        raise UserError(
            f"a projection of {projection.tolist()} is that of no camera: its focal length is not in pixels"
        )
    camera_from_reference[:3, 3] = np.linalg.solve(projection[:, :3], projection[:, 3])
    return projection[:, :3], camera_from_reference
