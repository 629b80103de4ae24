"""Files of KITTI's drives: labels, tracklets, calibrations, poses (Geiger, Lenz and Urtasun 2012)."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from bevviz.datasets.cloud_files import read_bytes
from bevviz.datasets.ground_truth import truth_boxes
from bevviz.datasets.kitti_labels import labelled_boxes, named_rows, split_projection
from bevviz.errors import UserError
from bevviz.model import geometry
from bevviz.model.class_names import KITTI
from bevviz.model.frame import F64, Boxes3D, LabelledBoxes3D
from bevviz.support.files import read_text

EARTH = 6378137.0  # metres; the radius in KITTI's development kit
# SemanticKITTI label numbers of objects; moving objects begin at 252.
OBJECTS = {
    10: "car", 11: "bicycle", 13: "bus", 15: "motorcycle", 16: "on-rails", 18: "truck", 20: "other-vehicle",
    30: "person", 31: "bicyclist", 32: "motorcyclist",
    252: "car", 253: "bicyclist", 254: "person", 255: "motorcyclist", 256: "on-rails", 257: "bus",
    258: "truck", 259: "other-vehicle",
}  # fmt: skip


# --- labels ------------------------------------------------------------------------------------


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
        labels_by_scan[scan] = truth_boxes(boxes, labels, ids, str(file))
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
    return truth_boxes(boxes, names, ids, str(file))


# --- calibration -------------------------------------------------------------------------------


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
