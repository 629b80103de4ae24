"""Files of KITTI's data sets: labels, tracklets, calibrations, poses (Geiger, Lenz and Urtasun 2012)."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from bevviz.datasets.cloud_files import read_bytes
from bevviz.datasets.dataset import files_in
from bevviz.errors import UserError
from bevviz.messages.foreign_boxes import LARGEST
from bevviz.model import geometry
from bevviz.model.class_names import KITTI
from bevviz.model.frame import F64, Boxes3D, ImageLabels, LabelledBoxes3D
from bevviz.support.files import read_text

COLUMNS = (
    *("truncation", "occlusion", "alpha", "image box's left", "image box's top", "image box's right"),
    *("image box's bottom", "height", "width", "length", "x", "y", "z", "rotation_y"),
)
MIN_FOCAL = 5.0  # pixels; placeholders are the identity, or negative
EARTH = 6378137.0  # metres; the radius in KITTI's development kit
# SemanticKITTI label numbers of objects; moving objects begin at 252.
OBJECTS = {
    10: "car", 11: "bicycle", 13: "bus", 15: "motorcycle", 16: "on-rails", 18: "truck", 20: "other-vehicle",
    30: "person", 31: "bicyclist", 32: "motorcyclist",
    252: "car", 253: "bicyclist", 254: "person", 255: "motorcyclist", 256: "on-rails", 257: "bus",
    258: "truck", 259: "other-vehicle",
}  # fmt: skip


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


def read_tracked_labels(file: Path, rectified_from_lidar: F64) -> Callable[[int], LabelledBoxes3D]:
    """Read ``label_02/0000.txt``, in which a line has frame, object, and an object label.

    Return the function that gives the boxes of a frame, which raises UserError as ``labelled_boxes`` does.

    Raises:
        UserError: the file cannot be read, or a line does not begin with two numbers.
    """
    lines: dict[int, list[tuple[int, str]]] = defaultdict(list)
    ids: dict[int, list[str]] = defaultdict(list)
    for number, line in enumerate(read_text(file).splitlines(), 1):
        if not line.strip():
            continue
        frame, track, *rest = [*line.split(maxsplit=2), "", ""]
        if not frame.isdigit() or not track.lstrip("-").isdigit():
            raise UserError(f"{file}: line {number} does not begin with a frame and an object")
        lines[int(frame)].append((number, rest[0]))
        ids[int(frame)].append(track)
    return lambda frame: labelled_boxes(file, lines[frame], rectified_from_lidar, ids[frame])


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
    labels, rows, dont_care, kept, unusable, scores = [], [], [], [], [], []
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
    return _labelled(file, boxes, labels, scores, ids=names, image=image, unusable=tuple(unusable))


def _score(file: Path, number: int, values: Sequence[str]) -> float:
    """Return the score in the 16th column of a detector's result; 1 for a label, which has none."""
    try:
        return float(values[14]) if len(values) > 14 else 1.0
    except ValueError:
        raise UserError(f"{file}: line {number} has something that is no number") from None


def _labelled(
    file: Path, boxes: Boxes3D, labels: Sequence[str], scores: Sequence[float] = (), **more: Any
) -> LabelledBoxes3D:
    """Return the labels of a file."""
    values = np.array(scores or [1.0] * len(labels), np.float32)
    return LabelledBoxes3D(str(file), 0, "", boxes, tuple(labels), values, **more)


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


def read_tracklets(file: Path) -> dict[int, LabelledBoxes3D]:
    """Read the labelled objects of each scan by number in the LiDAR frame.

    Raises:
        UserError: the file cannot be read, or has not KITTI's format.
    """
    try:
        root = ElementTree.fromstring(read_text(file))
        items = [item for item in root.findall("tracklets/item") if item.find("objectType") is not None]
        if root.find("tracklets") is None:
            raise ValueError("no tracklets in it")
        rows: dict[int, list[tuple[str, str, list[float]]]] = defaultdict(list)
        for number, item in enumerate(items):
            kind = _text(item, "objectType")
            height, width, length = (float(_text(item, name)) for name in "hwl")
            first = int(_text(item, "first_frame"))
            if kind not in KITTI:
                continue
            for later, pose in enumerate(item.findall("poses/item")):
                x, y, z, turn = (float(_text(pose, name)) for name in ("tx", "ty", "tz", "rz"))
                # A location is the centre of the bottom.
                row = [x, y, z + height / 2, length, width, height, turn]
                rows[first + later].append((kind, str(number), row))
    except (ElementTree.ParseError, ValueError) as error:
        raise UserError(f"{file}: no tracklets as KITTI writes them: {error}") from None
    labels_by_scan = {}
    for scan, objects in rows.items():
        labels, ids, values = zip(*objects, strict=True)
        boxed = np.array(values, np.float32)
        boxes = Boxes3D(boxed[:, :3], boxed[:, 3:6], boxed[:, 6])
        labels_by_scan[scan] = _labelled(file, boxes, labels, ids=tuple(ids))
    return labels_by_scan


def _text(item: Any, name: str) -> str:
    text = item.findtext(name)
    if text is None:
        raise ValueError(f"an item has no {name}")
    return str(text).strip()


def read_semantics(file: Path, points: int) -> NDArray[np.uint32]:
    """Read the (points,) label of each point.

    Raises:
        UserError: the file cannot be read, or has another number of labels.
    """
    data = read_bytes(file)
    labels = np.frombuffer(data[: len(data) // 4 * 4], "<u4")
    if len(labels) != points:
        raise UserError(
            f"{file}: {len(labels)} labels for {points} points: one of the two is cut, or of another scan"
        )
    return labels


def boxes_of(file: Path, points: Any, labels: Any) -> LabelledBoxes3D:
    """Return a box around the labelled points of each object. It covers only the visible part of the object.

    From above, the box is the smallest rotated rectangle. Its height spans all points.

    Args:
        file: label file, named in the result.
        points: (N,) points with x, y, z.
        labels: (N,) labels: the class in the lower 16 bits, the object number in the upper; 0: no object.
    """
    import cv2

    classes = labels & 0xFFFF
    chosen = np.flatnonzero((labels >> 16 > 0) & np.isin(classes, list(OBJECTS)))
    order = chosen[np.argsort(labels[chosen], kind="stable")]
    starts = np.flatnonzero(np.diff(labels[order].astype(np.int64), prepend=-1))
    centers, sizes, turns, names, ids = [], [], [], list[str](), list[str]()
    for members in np.split(order, starts[1:]) if len(order) else ():
        xy = np.column_stack([points["x"][members], points["y"][members]])
        (x, y), (length, width), angle = cv2.minAreaRect(xy)
        low, high = float(points["z"][members].min()), float(points["z"][members].max())
        if width > length:
            length, width, angle = width, length, angle + 90.0
        centers.append([x, y, (low + high) / 2])
        sizes.append([length, width, high - low])
        turns.append(np.radians(angle))
        names.append(OBJECTS[int(classes[members[0]])])
        ids.append(f"{names[-1]}-{int(labels[members[0]] >> 16)}")
    boxes = Boxes3D(
        np.array(centers, np.float32).reshape(-1, 3),
        np.array(sizes, np.float32).reshape(-1, 3),
        np.array(turns, np.float32),
    )
    return _labelled(file, boxes, names, ids=tuple(ids))


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


def rectified_camera(folder: Path, number: str) -> tuple[F64, F64]:
    """Read (3, 3) K and (4, 4) camera_from_lidar of a camera of the raw data.

    Raises:
        UserError: a file of the calibration cannot be read, or has not KITTI's format.
    """
    file = folder / "calib_cam_to_cam.txt"
    rows = named_rows(file)
    rectified = np.eye(4)
    try:
        projection = rows[f"P_rect_{number}"].reshape(3, 4)
        rectified[:3, :3] = rows["R_rect_00"].reshape(3, 3)
    except (KeyError, ValueError):
        raise UserError(f"{file}: no P_rect_{number} or R_rect_00, as KITTI writes it") from None
    K, camera_from_reference = split_projection(projection)
    return K, camera_from_reference @ rectified @ read_rigid(folder / "calib_velo_to_cam.txt")


def read_rigid(file: Path) -> F64:
    """Read the (4, 4) transform of a file with R and T.

    Raises:
        UserError: the file cannot be read, or has not KITTI's format.
    """
    rows = named_rows(file)
    pose = np.eye(4)
    try:
        pose[:3, :3], pose[:3, 3] = rows["R"].reshape(3, 3), rows["T"]
    except (KeyError, ValueError):
        raise UserError(f"{file}: no R and T, as KITTI writes them") from None
    return pose


def split_projection(projection: F64) -> tuple[F64, F64]:
    """Split a (3, 4) projection into (3, 3) K and (4, 4) camera_from_reference, both rectified cameras."""
    camera_from_reference = np.eye(4)
    if min(projection[0, 0], projection[1, 1]) < MIN_FOCAL or abs(np.linalg.det(projection[:, :3])) < 1e-9:
        raise UserError(
            f"a projection of {projection.tolist()} is that of no camera: its focal length is not in pixels"
        )
    camera_from_reference[:3, 3] = np.linalg.solve(projection[:, :3], projection[:, 3])
    return projection[:, :3], camera_from_reference


# --- times and positions---------------------------------------------------------------------------


def read_timestamps(file: Path) -> list[int]:
    """Read the nanoseconds of each line, such as ``2011-09-26 13:02:25.964389445`` in UTC.

    Raises:
        UserError: the file cannot be read, or has not KITTI's format.
    """
    lines = enumerate(read_text(file).split("\n"), 1)
    return [_parse_time(file, number, line) for number, line in lines if line.strip()]


def _parse_time(file: Path, number: int, line: str) -> int:
    """Parse ``2011-09-26 13:02:25.964389445`` as UTC to nanoseconds."""
    day, _, fraction = line.strip().partition(".")
    try:
        whole = datetime.strptime(day, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
        return round(whole.timestamp()) * 10**9 + int(fraction[:9].ljust(9, "0") or "0")
    except ValueError:
        raise UserError(f"{file}: line {number} is no time, as 2011-09-26 13:02:25.964389445") from None


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
    poses[:, :3, :3] = geometry.rotations(2, yaw) @ geometry.rotations(1, pitch) @ geometry.rotations(0, roll)
    return np.asarray(geometry.inverse(poses[0]) @ poses if len(poses) else poses)
