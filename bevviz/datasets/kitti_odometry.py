"""A sequence of the KITTI odometry benchmark, with the labels of SemanticKITTI (Behley et al. 2019)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bevviz.datasets.dataset import (
    IMAGES,
    SECOND,
    Dataset,
    Stream,
    add_fields,
    files_in,
    frame_stamps,
    image_stream,
    read_bytes,
    read_points,
    read_table,
)
from bevviz.datasets.kitti import (
    CLOUDS,
    LIDAR,
    Calibration,
    camera_info_stream,
    cloud_stream,
    ground_truth_stream,
    mounting_stream,
    pose_stream,
)
from bevviz.errors import UserError
from bevviz.messages.encode import encode_points
from bevviz.model import geometry
from bevviz.model.frame import F64, I64, Boxes3D, LabelledBoxes3D

RATE = 10.0  # Hz, used without times.txt
# SemanticKITTI label numbers of objects; moving objects begin at 252.
OBJECTS = {
    10: "car",
    11: "bicycle",
    13: "bus",
    15: "motorcycle",
    16: "on-rails",
    18: "truck",
    20: "other-vehicle",
    30: "person",
    31: "bicyclist",
    32: "motorcyclist",
    252: "car",
    253: "bicyclist",
    254: "person",
    255: "motorcyclist",
    256: "on-rails",
    257: "bus",
    258: "truck",
    259: "other-vehicle",
}
CAMERAS = {"image_2": "", "image_3": "the right eye of a stereo pair", "image_0": "grey", "image_1": "grey"}


class KittiOdometry(Dataset):
    """Drive of ``velodyne`` and ``calib.txt``; optional ``times.txt``, ``poses.txt``, ``labels``, images."""

    name = "kitti-odometry"
    about = "KITTI odometry or SemanticKITTI sequence"
    expects = "velodyne/000000.bin and calib.txt in it, or in sequences/00"

    @classmethod
    def fits(cls, path: Path) -> bool:
        """Tell whether a folder is a sequence or has a folder ``sequences``."""
        if (path / "sequences").is_dir():
            return any((path / "sequences").glob("*/velodyne"))
        return (path / "velodyne").is_dir() and (path / "calib.txt").is_file()

    @classmethod
    def drives(cls, path: Path) -> list[Path]:
        """Return the folders of the sequences."""
        if not (path / "sequences").is_dir():
            return [path]
        return sorted(scans.parent for scans in (path / "sequences").glob("*/velodyne"))

    def __init__(self, path: Path, sequence: str) -> None:
        super().__init__(path, sequence)
        folder = path
        if (path / "sequences").is_dir():
            folder = path / "sequences" / self.choose_drive([drive.name for drive in self.drives(path)])
        elif sequence:
            raise UserError(f"{path}: is one drive; leave --sequence {sequence} out")
        scans = files_in(folder / "velodyne", [".bin"])
        if not scans:
            raise UserError(f"{folder / 'velodyne'}: no scan in it; expected 000000.bin")
        if not (folder / "calib.txt").is_file():
            raise UserError(f"{folder / 'calib.txt'} is missing: it says where the cameras are")
        fields = self.column_names(scans)
        self.check_sizes(scans, 4 * len(fields))
        calibration = Calibration(folder / "calib.txt")
        numbers = _numbers(scans)
        times = self._times(folder, numbers)
        edges, cameras = [], list[Stream]()
        for camera, aside in CAMERAS.items():
            images = {
                int(file.stem): file for file in files_in(folder / camera, IMAGES) if file.stem.isdigit()
            }
            rows = [row for row, number in enumerate(numbers) if number in images]
            if not rows:
                continue
            image_times = times[rows]
            matrix, camera_from_lidar = calibration.camera(int(camera[-1]))
            edges.append((LIDAR, camera, geometry.inverse(camera_from_lidar)))
            cameras += [
                camera_info_stream(camera, image_times, matrix),
                image_stream(camera, image_times, [images[numbers[row]] for row in rows], aside=aside),
            ]
        self.streams = [mounting_stream(int(times[0]), edges)] if edges else []
        poses = self._poses(folder, calibration)
        if poses is not None:
            with_pose = [row for row, number in enumerate(numbers) if number < len(poses)]
            if len(with_pose) < len(numbers):
                self.warn(
                    f"poses.txt has {len(poses)} poses: {len(numbers) - len(with_pose)} scans have none"
                )
            self.streams.append(
                pose_stream(times[with_pose], LIDAR, poses[[numbers[row] for row in with_pose]])
            )
        self.streams += cameras
        labels = {int(file.stem): file for file in files_in(folder / "labels", [".label"])}
        if not labels:
            self.streams.append(cloud_stream(times, scans, fields))
            return
        rows = [row for row, number in enumerate(numbers) if number in labels]
        files = {row: labels[numbers[row]] for row in rows}

        def cloud(row: int) -> Any:
            points = read_points(scans[row], fields)
            label = np.zeros(len(points), np.uint32)
            if row in files:
                label[:] = self._labels(files[row], len(points))
            return encode_points(int(times[row]), LIDAR, add_fields(points, {"label": label}))

        def objects(row: int) -> LabelledBoxes3D:
            points = read_points(scans[rows[row]], fields)
            return boxes_of(files[rows[row]], points, self._labels(files[rows[row]], len(points)))

        self.streams.append(ground_truth_stream("vision_msgs/msg/Detection3DArray", times[rows], objects))
        self.streams.append(Stream(CLOUDS, "sensor_msgs/msg/PointCloud2", times, cloud))

    def _times(self, folder: Path, numbers: list[int]) -> I64:
        if not (folder / "times.txt").is_file():
            self.warn(f"no times.txt: {RATE:.0f} scans a second are taken")
            return frame_stamps(RATE, numbers)
        table = read_table(folder / "times.txt", 1)[:, 0]
        if len(table) <= max(numbers):
            raise UserError(f"{folder / 'times.txt'}: {len(table)} times, and a scan {max(numbers):06d}.bin")
        if not np.isfinite(table).all() or (np.diff(table) < 0).any():
            raise UserError(f"{folder / 'times.txt'}: its times do not grow line by line")
        return SECOND + np.round(table[numbers] * 1e9).astype(np.int64)

    def _poses(self, folder: Path, calibration: Calibration) -> F64 | None:
        """Return (P, 4, 4) first_scan_from_scan poses; None if there are none."""
        shared_file = folder.parent.parent / "poses" / f"{folder.name}.txt"
        file = folder / "poses.txt" if (folder / "poses.txt").is_file() else shared_file
        if not file.is_file():
            return None
        table = read_table(file, 12)
        poses = np.tile(np.eye(4), (len(table), 1, 1))
        poses[:, :3] = table.reshape(-1, 3, 4)
        reference_from_lidar = calibration.rectified_from_lidar  # The poses are those of the camera.
        moved = geometry.inverse(reference_from_lidar) @ poses @ reference_from_lidar
        return np.asarray(moved)

    def _labels(self, file: Path, points: int) -> np.ndarray[Any, np.dtype[np.uint32]]:
        """Return the (points,) label of each point."""
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
    return LabelledBoxes3D(
        str(file), 0, "", boxes, tuple(names), np.ones(len(names), np.float32), ids=tuple(ids)
    )


def _numbers(scans: list[Path]) -> list[int]:
    wrong = next((scan for scan in scans if not scan.stem.isdigit()), None)
    if wrong is not None:
        raise UserError(f"{wrong}: its name is no number; expected 000000.bin")
    return [int(scan.stem) for scan in scans]
