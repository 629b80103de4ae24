"""A drive of KITTI's raw data (Geiger, Lenz, Stiller and Urtasun 2013), with tracklets as ground truth."""

from __future__ import annotations

from collections import defaultdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from bevviz.datasets.dataset import IMAGES, Dataset, Stream, files_in, image_stream, read_table
from bevviz.datasets.kitti import (
    IMU,
    LIDAR,
    camera_info_stream,
    cloud_stream,
    ground_truth_stream,
    mounting_stream,
    named_rows,
    pose_stream,
    poses_of_oxts,
    split_projection,
)
from bevviz.errors import UserError
from bevviz.model import geometry
from bevviz.model.class_names import KITTI
from bevviz.model.frame import F64, I64, Boxes3D, LabelledBoxes3D
from bevviz.support.files import read_text

CAMERAS = {
    "image_02": "",
    "image_03": "the right eye of a stereo pair",
    "image_00": "grey, beside a colour camera",
    "image_01": "grey, beside a colour camera",
}


class KittiRaw(Dataset):
    """Drive ``2011_09_26/2011_09_26_drive_0001_sync`` with its calibration in ``2011_09_26``."""

    name = "kitti-raw"
    about = "KITTI raw drive"
    expects = "velodyne_points/data/0000000000.bin, and calib_velo_to_cam.txt in the folder above"

    @classmethod
    def fits(cls, path: Path) -> bool:
        """Tell whether a folder is a drive or contains drives."""
        return (path / "velodyne_points").is_dir() or any(path.glob("*_drive_*/velodyne_points"))

    @classmethod
    def drives(cls, path: Path) -> list[Path]:
        """Return the folders of the drives."""
        if (path / "velodyne_points").is_dir():
            return [path]
        return sorted(scans.parent for scans in path.glob("*_drive_*/velodyne_points"))

    def __init__(self, path: Path, sequence: str) -> None:
        super().__init__(path, sequence)
        folder = path
        if not (path / "velodyne_points").is_dir():
            folder = path / self.choose_drive([drive.name for drive in self.drives(path)])
        elif sequence:
            raise UserError(f"{path}: is one drive; leave --sequence {sequence} out")
        if files_in(folder / "velodyne_points/data", [".txt"]):
            raise UserError(f"{folder}: is unrectified (extract); give the drive that is called ..._sync")
        scans, times = self._files(folder / "velodyne_points", ".bin")
        if not scans:
            raise UserError(f"{folder / 'velodyne_points/data'}: no scan in it; expected 0000000000.bin")
        fields = self.column_names(scans)
        self.check_sizes(scans, 4 * len(fields))
        edges, sensors = self._cameras(folder)
        table = self._oxts(folder)
        self.streams = []
        if table is not None:
            oxts, poses = table
            lidar_from_imu = _rigid(folder.parent / "calib_imu_to_velo.txt")
            edges.append((IMU, LIDAR, geometry.inverse(lidar_from_imu)))
            self.streams.append(pose_stream(oxts, IMU, poses))
        if edges:
            self.streams.insert(0, mounting_stream(int(times[0]), edges))
        self.streams += sensors
        tracklets = folder / "tracklet_labels.xml"
        if tracklets.is_file():
            labelled = read_tracklets(tracklets)
            numbers = [int(scan.stem) for scan in scans]
            none = LabelledBoxes3D(str(tracklets), 0, "", Boxes3D.empty(), (), np.zeros(0, np.float32))
            self.streams.append(
                ground_truth_stream(
                    "vision_msgs/msg/Detection3DArray",
                    times,
                    lambda row: labelled.get(numbers[row], none),
                )
            )
        self.streams.append(cloud_stream(times, scans, fields))

    def _cameras(self, folder: Path) -> tuple[list[tuple[str, str, F64]], list[Stream]]:
        """Return the mountings and the streams of the cameras."""
        edges, streams = [], list[Stream]()
        for camera, aside in CAMERAS.items():
            images, times = self._files(folder / camera, *IMAGES)
            if not images:
                continue
            cameras = folder.parent / "calib_cam_to_cam.txt"
            rows = named_rows(cameras)
            number = camera[-2:]
            try:
                projection = rows[f"P_rect_{number}"].reshape(3, 4)
                rectified = np.eye(4)
                rectified[:3, :3] = rows["R_rect_00"].reshape(3, 3)
            except (KeyError, ValueError):
                raise UserError(f"{cameras}: no P_rect_{number} or R_rect_00, as KITTI writes it") from None
            matrix, camera_from_reference = split_projection(projection)
            camera_from_lidar = (
                camera_from_reference @ rectified @ _rigid(folder.parent / "calib_velo_to_cam.txt")
            )
            edges.append((LIDAR, camera, geometry.inverse(camera_from_lidar)))
            streams += [
                camera_info_stream(camera, times, matrix),
                image_stream(camera, times, images, aside=aside),
            ]
        return edges, streams

    def _oxts(self, folder: Path) -> tuple[I64, F64] | None:
        """Return stamps and (P, 4, 4) first_from_each poses; None if there are none."""
        files, times = self._files(folder / "oxts", ".txt")
        if not files:
            return None
        rows = [read_table(file, 6) for file in files]
        short = next((file for file, row in zip(files, rows, strict=True) if len(row) != 1), None)
        if short is not None:
            raise UserError(f"{short}: expected one line of 30 numbers")
        return times, poses_of_oxts(np.concatenate(rows))

    def _files(self, folder: Path, *suffixes: str) -> tuple[list[Path], I64]:
        """Return the files of a sensor and their stamps. ``timestamps.txt`` also lists missing files."""
        files = files_in(folder / "data", suffixes)
        if not files:
            return [], np.zeros(0, np.int64)
        stamps = folder / "timestamps.txt"
        times = [
            _time(stamps, n, line) for n, line in enumerate(read_text(stamps).split("\n"), 1) if line.strip()
        ]
        numbers = [int(file.stem) if file.stem.isdigit() else -1 for file in files]
        beyond = [f for f, number in zip(files, numbers, strict=True) if not 0 <= number < len(times)]
        if beyond:
            raise UserError(f"{stamps}: {len(times)} lines, and none for {beyond[0].name}")
        stamps_ns = np.array([times[number] for number in numbers], np.int64)
        order = np.argsort(stamps_ns, kind="stable")
        return [files[i] for i in order.tolist()], stamps_ns[order]


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
        ones = np.ones(len(labels), np.float32)
        labels_by_scan[scan] = LabelledBoxes3D(str(file), 0, "", boxes, tuple(labels), ones, ids=tuple(ids))
    return labels_by_scan


def _text(item: Any, name: str) -> str:
    text = item.findtext(name)
    if text is None:
        raise ValueError(f"an item has no {name}")
    return str(text).strip()


def _rigid(file: Path) -> F64:
    """Return the (4, 4) transform of a file with R and T."""
    rows = named_rows(file)
    pose = np.eye(4)
    try:
        pose[:3, :3], pose[:3, 3] = rows["R"].reshape(3, 3), rows["T"]
    except (KeyError, ValueError):
        raise UserError(f"{file}: no R and T, as KITTI writes them") from None
    return pose


def _time(file: Path, number: int, line: str) -> int:
    """Parse ``2011-09-26 13:02:25.964389445`` as UTC to nanoseconds."""
    day, _, fraction = line.strip().partition(".")
    try:
        whole = datetime.strptime(day, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
        return round(whole.timestamp()) * 10**9 + int(fraction[:9].ljust(9, "0") or "0")
    except ValueError:
        raise UserError(f"{file}: line {number} is no time, as 2011-09-26 13:02:25.964389445") from None
