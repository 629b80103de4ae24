"""Loaders of KITTI's data sets: raw drives, and the object, tracking and odometry benchmarks.

They are described by Geiger, Lenz, Stiller and Urtasun (2012, 2013), SemanticKITTI by Behley et al. (2019).
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.recfunctions import append_fields
from numpy.typing import NDArray

from bevviz.datasets.cloud_files import read_cloud, read_points
from bevviz.datasets.dataset import (
    IMAGES,
    MAP,
    SECOND,
    Dataset,
    Stream,
    cloud_stream,
    files_in,
    frame_stamps,
    image_stream,
    intrinsics_stream,
    mounting_stream,
    pose_stream,
    read_table,
    subfolders,
)
from bevviz.datasets.ground_truth import BOXES_WITH_IMAGE, truth_boxes, truth_stream
from bevviz.datasets.kitti_labels import Calibration, named_rows, read_labels
from bevviz.errors import UserError
from bevviz.extras.datasets.kitti_files import (
    boxes_of,
    poses_of_oxts,
    read_rigid,
    read_semantics,
    read_timestamps,
    read_tracked_labels,
    read_tracklets,
    rectified_camera,
)
from bevviz.messages.encode import encode_transforms
from bevviz.model import geometry
from bevviz.model.frame import F64, I64, Boxes3D, Intrinsics, LabelledBoxes3D
from bevviz.support.files import read_lines

LIDAR, IMU = "velodyne", "imu_link"
CLOUDS = "/velodyne_points"
RATE = 10.0  # Hz, where a benchmark has no stamps
# Names of the benchmark's folders in copies of it.
FOLDER_NAMES = {
    "velodyne": ("velodyne", "points", "point_clouds", "pointclouds", "lidar", "pcd"),
    "calib": ("calib", "calibs"),
    "image_2": ("image_2", "image2", "image_02", "images", "image", "img"),
}
ARCHIVE = "data_object_velodyne"  # folder of the benchmark's scans where each archive has one
LABEL_FOLDERS = ("label_2", "label_all", "label_0")
COPIED_LABELS = ("labels", "label")  # names in copies, where the files may be of another format
KITTI_LABEL = (15, 16)  # columns, without or with a score
MAX_LABELS = 1 << 20  # bytes of a file of labels
FRAME_GAP = 100 * SECOND  # between unrelated frames, of which none may influence the next
# Reasons why a camera gets no role by default; empty: it gets one.
RIGHT_EYE, GREY = "the right eye of a stereo pair", "grey, beside a colour camera"
TRACKING_CAMERAS = {"image_02": "", "image_03": RIGHT_EYE}
ODOMETRY_CAMERAS = {"image_2": "", "image_3": RIGHT_EYE, "image_0": "grey", "image_1": "grey"}
RAW_CAMERAS = {"image_02": "", "image_03": RIGHT_EYE, "image_00": GREY, "image_01": GREY}


class KittiObject(Dataset):
    """Frames of ``velodyne/000000.bin`` and ``calib/000000.txt``; optional ``image_2``, ``label_2``."""

    name = "kitti-object"
    about = "KITTI object benchmark"
    expects = "velodyne/000000.bin and calib/000000.txt, mostly image_2/000000.png and label_2/000000.txt too"
    single_frames = True

    @classmethod
    def fits(cls, path: Path) -> bool:
        """Tell whether a folder has the layout of the benchmark, or its archives, each in a folder."""
        if any((path / ARCHIVE).glob("*/velodyne")):
            return True
        scans = _object_scans(path)
        if not scans and any((path / "calib").glob("[0-9]" * 6 + ".txt")):
            return (path / "velodyne").is_dir()
        if scans and scans[0].parent.name != "velodyne" and len(_image_folders(path)) != 1:
            return False  # A plain folder has all of its cameras.
        # Sets in this layout name frames differently: View of Delft by five digits, converters by tokens.
        calibrations = (_object_folder(path, "calib") / f"{scan.stem}.txt" for scan in scans)
        file = next((file for file in calibrations if file.is_file()), None)
        names = {"P2", "Tr_velo_to_cam", "Tr_velo_to_cam_0"}  # A damaged file may have one of them alone.
        return file is not None and not names.isdisjoint(named_rows(file))

    @classmethod
    def drives(cls, path: Path) -> list[Path]:
        """Return the folder, or those of the splits in the archive of the scans."""
        return sorted(scans.parent for scans in (path / ARCHIVE).glob("*/velodyne")) or [path]

    def __init__(self, path: Path, sequence: str) -> None:
        super().__init__(path, sequence)
        path = self.path = self.choose_folder()
        scans = _object_scans(path)
        fields = _columns(self, scans, path / "velodyne/000000.bin")
        times = FRAME_GAP * np.arange(1, len(scans) + 1, dtype=np.int64)
        names = [scan.stem for scan in scans]
        folder = self._label_folder()
        with_labels, labels = _matching(files_in(folder, [".txt"]), names, lambda file: file.stem)
        if not labels and files_in(folder, [""]):
            self.warn(f"{folder.name} is not read: no .txt in it has the name of a scan")

        calibrations = _object_folder(path, "calib")

        @lru_cache(maxsize=8)
        def calibration(row: int) -> Calibration:
            return Calibration(calibrations / f"{names[row]}.txt")

        cameras = self._cameras(calibration, len(names))

        def mounting(row: int) -> Any:
            poses = {name: calibration(row).camera(number)[1] for name, number in cameras.items()}
            return encode_transforms(
                int(times[row]), [(LIDAR, name, geometry.inverse(pose)) for name, pose in poses.items()]
            )

        # Each frame has its own map with the LiDAR at the origin.
        self.streams = [
            *mounting_stream(int(times[0]), [(MAP, LIDAR, np.eye(4))]),
            Stream("/tf", "tf2_msgs/msg/TFMessage", times, mounting),
        ]
        for camera, number in cameras.items():
            rows, images = _matching(files_in(self._images(camera), IMAGES), names, lambda file: file.stem)
            if images:
                self.streams += _camera_streams(camera, number, times[rows], rows, images, calibration)
        if labels:
            self.streams.append(
                truth_stream(
                    times[with_labels],
                    LIDAR,
                    lambda row: read_labels(labels[row], calibrations),
                    BOXES_WITH_IMAGE,
                )
            )
        self.streams.append(_cloud_stream(times, scans, fields))

    def _label_folder(self) -> Path:
        """Return the folder of the labels. That of a copy counts only if its first label is KITTI's."""
        folders = [_object_folder(self.path, name) for name in LABEL_FOLDERS]
        for folder in (_object_folder(self.path, name) for name in COPIED_LABELS):
            lines = (
                line for file in files_in(folder, [".txt"])[:100] for line in read_lines(file, MAX_LABELS)
            )
            first = next((line.split() for line in lines if line.strip()), [])
            if len(first) in KITTI_LABEL:
                folders.append(folder)
            elif first:
                self.warn(f"{folder.name} is not read: its lines have {len(first)} columns, KITTI's have 15")
        return next((folder for folder in folders if folder.is_dir()), folders[0])

    def _images(self, camera: str) -> Path:
        """Return the folder of a camera. The left colour camera's may have any name if it is the only one."""
        folder = _object_folder(self.path, camera)
        others = _image_folders(self.path)
        if folder.is_dir() or camera != "image_2" or not others:
            return folder
        if len(others) > 1:
            listed = ", ".join(child.name for child in others)
            self.warn(f"no {camera}, so that there is no camera: there are images in {listed}")
            return folder
        return others[0]

    def _cameras(self, calibration: Callable[[int], Calibration], frames: int) -> dict[str, int]:
        """Return the number of each camera: the left colour one, or all of a set with several mountings."""
        for row in range(min(frames, 2)):
            try:
                first = calibration(row)
            except UserError:  # It is reported when the frame is read.
                continue
            if first.has_mountings:
                numbers = (number for number in range(10) if (self.path / f"image_{number}").is_dir())
                return {f"image_{number}": number for number in numbers if first.has_camera(number)}
            break
        return {"image_2": 2}


def _object_folder(path: Path, name: str) -> Path:
    """Return the folder of the object benchmark with a name, one that copies give it, or in its archive."""
    folders = [path / other for other in FOLDER_NAMES.get(name, (name,))]
    if path.parent.name == ARCHIVE:
        root = path.parent.parent
        folders += [root / f"data_object_{name}" / path.name / name, root / path.name / name]
    return next((folder for folder in folders if folder.is_dir()), path / name)


def _image_folders(path: Path) -> list[Path]:
    """Return the subfolders with images."""
    return [child for child in subfolders(path) if files_in(child, IMAGES)]


def _object_scans(path: Path) -> list[Path]:
    """Return the scans of the object benchmark. Copies of it have them as PCD or PLY, or as BIN too."""
    folder = _object_folder(path, "velodyne")
    return files_in(folder, [".bin"]) or files_in(folder, [".pcd", ".ply"])


def _camera_streams(
    camera: str,
    number: int,
    times: I64,
    rows: Sequence[int],
    images: Sequence[Path],
    calibration: Callable[[int], Calibration],
) -> Iterator[Stream]:
    """Yield the calibrations and the images of a camera. ``rows`` are the numbers of the frames."""

    def intrinsics(row: int) -> Intrinsics:
        return Intrinsics(0, 0, calibration(rows[row]).camera(number)[0])

    yield intrinsics_stream(camera, times, intrinsics)
    yield image_stream(camera, times, images)


class KittiTracking(Dataset):
    """Drive of ``velodyne/0000`` and ``calib/0000.txt``; optional ``image_02``, ``label_02``, ``oxts``."""

    name = "kitti-tracking"
    about = "KITTI tracking benchmark"
    expects = "velodyne/0000/000000.bin and calib/0000.txt"

    @classmethod
    def fits(cls, path: Path) -> bool:
        """Tell whether a folder has the layout of the benchmark, or is one drive of it."""
        if any((path / "calib").glob("[0-9]" * 4 + ".txt")):
            return any((path / "velodyne").glob("[0-9]" * 4))
        parent = path.parent  # The folder may be velodyne/0000.
        return parent.name == "velodyne" and (parent.parent / f"calib/{path.name}.txt").is_file()

    @classmethod
    def drives(cls, path: Path) -> list[Path]:
        """Return the scan folders of the drives."""
        if path.parent.name == "velodyne":
            return [path]
        return sorted((path / "velodyne").glob("[0-9]" * 4))

    def __init__(self, path: Path, sequence: str) -> None:
        super().__init__(path, sequence)
        folder = self.choose_folder()
        self.path = root = folder.parent.parent
        name = folder.name
        scans = files_in(folder, [".bin"])
        fields = _columns(self, scans, folder / "000000.bin")
        calibration = Calibration(root / f"calib/{name}.txt")
        numbers = _numbers(scans)
        times = frame_stamps(RATE, numbers)
        cameras = []
        for camera, aside in TRACKING_CAMERAS.items():
            if images := files_in(root / camera / name, IMAGES):
                image_times = frame_stamps(RATE, _numbers(images))
                camera_matrices = calibration.camera(int(camera[-1]))
                cameras.append(CameraImages(camera, aside, image_times, images, *camera_matrices))
        poses = None
        if (oxts := root / f"oxts/{name}.txt").is_file():
            table = read_table(oxts, 6)
            times_of_poses = frame_stamps(RATE, range(len(table)))
            poses = VehiclePoses(IMU, times_of_poses, poses_of_oxts(table), calibration.lidar_from_imu)
        self.streams = _sensor_streams(int(times[0]), cameras, poses)
        if (labels := root / f"label_02/{name}.txt").is_file():
            label = read_tracked_labels(labels, calibration.rectified_from_lidar)
            self.streams.append(truth_stream(times, LIDAR, lambda row: label(numbers[row]), BOXES_WITH_IMAGE))
        self.streams.append(_cloud_stream(times, scans, fields))


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
        folder = self.choose_folder()
        scans = files_in(folder / "velodyne", [".bin"])
        fields = _columns(self, scans, folder / "velodyne/000000.bin")
        if not (folder / "calib.txt").is_file():
            raise UserError(f"{folder / 'calib.txt'} is missing: it says where the cameras are")
        calibration = Calibration(folder / "calib.txt")
        numbers = _numbers(scans)
        times = self._times(folder, numbers)
        cameras = []
        for camera, aside in ODOMETRY_CAMERAS.items():
            rows, images = _matching(files_in(folder / camera, IMAGES), numbers, _number)
            if images:
                camera_matrices = calibration.camera(int(camera[-1]))
                cameras.append(CameraImages(camera, aside, times[rows], images, *camera_matrices))
        self.streams = _sensor_streams(
            int(times[0]), cameras, self._poses(folder, calibration, times, numbers)
        )
        with_labels, label_files = _matching(files_in(folder / "labels", [".label"]), numbers, _number)
        if not label_files:
            self.streams.append(_cloud_stream(times, scans, fields))
            return
        files = dict(zip(with_labels, label_files, strict=True))

        def label(row: int, points: int) -> NDArray[np.uint32]:
            return read_semantics(files[row], points) if row in files else np.zeros(points, np.uint32)

        def objects(row: int) -> LabelledBoxes3D:
            points = read_points(scans[with_labels[row]], fields)
            return boxes_of(label_files[row], points, label(with_labels[row], len(points)))

        self.streams += [
            truth_stream(times[with_labels], LIDAR, objects),
            _cloud_stream(times, scans, fields, label),
        ]

    def _times(self, folder: Path, numbers: Sequence[int]) -> I64:
        file = folder / "times.txt"
        if not file.is_file():
            self.warn(f"no times.txt: {RATE:.0f} scans a second are taken")
            return frame_stamps(RATE, numbers)
        table = read_table(file, 1)[:, 0]
        if len(table) <= max(numbers):
            raise UserError(f"{file}: {len(table)} times, and a scan {max(numbers):06d}.bin")
        if not np.isfinite(table).all() or (np.diff(table) < 0).any():
            raise UserError(f"{file}: its times do not grow line by line")
        return SECOND + np.round(table[numbers] * 1e9).astype(np.int64)

    def _poses(
        self, folder: Path, calibration: Calibration, times: I64, numbers: Sequence[int]
    ) -> VehiclePoses | None:
        """Return the first_scan_from_scan poses of the scans; None if there are none."""
        shared_file = folder.parent.parent / "poses" / f"{folder.name}.txt"
        file = folder / "poses.txt" if (folder / "poses.txt").is_file() else shared_file
        if not file.is_file():
            return None
        table = read_table(file, 12)
        poses = np.tile(np.eye(4), (len(table), 1, 1))
        poses[:, :3] = table.reshape(-1, 3, 4)
        reference_from_lidar = calibration.rectified_from_lidar  # The poses are those of the camera.
        moved = geometry.inverse(reference_from_lidar) @ poses @ reference_from_lidar
        rows = [row for row, number in enumerate(numbers) if number < len(poses)]
        if len(rows) < len(numbers):
            self.warn(f"poses.txt has {len(poses)} poses: {len(numbers) - len(rows)} scans have none")
        return VehiclePoses(LIDAR, times[rows], moved[[numbers[row] for row in rows]])


class KittiRaw(Dataset):
    """Drive ``2011_09_26/2011_09_26_drive_0001_sync`` with its calibration in ``2011_09_26``."""

    name = "kitti-raw"
    about = "KITTI raw drive"
    expects = "velodyne_points/data/0000000000.bin, and calib_velo_to_cam.txt in the folder above"

    @classmethod
    def fits(cls, path: Path) -> bool:
        """Tell whether a folder is a drive or contains drives.

        A piece of a drive without stamps and calibration is a plain folder.
        """
        if (path / "velodyne_points").is_dir():
            return (path / "velodyne_points/timestamps.txt").is_file() or any(path.parent.glob("calib_*.txt"))
        return any(path.glob("*_drive_*/velodyne_points"))

    @classmethod
    def drives(cls, path: Path) -> list[Path]:
        """Return the folders of the drives."""
        if (path / "velodyne_points").is_dir():
            return [path]
        return sorted(scans.parent for scans in path.glob("*_drive_*/velodyne_points"))

    def __init__(self, path: Path, sequence: str) -> None:
        super().__init__(path, sequence)
        folder = self.choose_folder()
        if files_in(folder / "velodyne_points/data", [".txt"]):
            raise UserError(f"{folder}: is unrectified (extract); give the drive that is called ..._sync")
        scans, times = _stamped(folder / "velodyne_points", [".bin"])
        fields = _columns(self, scans, folder / "velodyne_points/data/0000000000.bin")
        cameras = []
        for camera, aside in RAW_CAMERAS.items():
            images, image_times = _stamped(folder / camera, IMAGES)
            if images:
                camera_matrices = rectified_camera(folder.parent, camera[-2:])
                cameras.append(CameraImages(camera, aside, image_times, images, *camera_matrices))
        self.streams = _sensor_streams(int(times[0]), cameras, _raw_poses(folder))
        tracklets = folder / "tracklet_labels.xml"
        if tracklets.is_file():
            labelled = read_tracklets(tracklets)
            none = truth_boxes(Boxes3D.empty(), (), (), str(tracklets))

            def label(row: int) -> LabelledBoxes3D:
                return labelled.get(_number(scans[row]), none)

            self.streams.append(truth_stream(times, LIDAR, label))
        self.streams.append(_cloud_stream(times, scans, fields))


def _raw_poses(folder: Path) -> VehiclePoses | None:
    """Return the first_from_each poses of the IMU; None if there are none."""
    files, times = _stamped(folder / "oxts", [".txt"])
    if not files:
        return None
    rows = [read_table(file, 6) for file in files]
    short = next((file for file, row in zip(files, rows, strict=True) if len(row) != 1), None)
    if short is not None:
        raise UserError(f"{short}: expected one line of 30 numbers")
    lidar_from_imu = read_rigid(folder.parent / "calib_imu_to_velo.txt")
    return VehiclePoses(IMU, times, poses_of_oxts(np.concatenate(rows)), lidar_from_imu)


# --- files of a drive --------------------------------------------------------------------------


def _columns(drive: Dataset, scans: Sequence[Path], expected: Path) -> list[str]:
    """Check the scans of a drive and return the names of their columns (Waymo's scans have 6 columns).

    Raises:
        UserError: there is no scan. The message names the first one that is ``expected``.
    """
    if not scans:
        raise UserError(f"{expected.parent}: no scan in it; expected {expected.name}")
    fields = drive.column_names(scans)
    drive.check_sizes([scan for scan in scans if scan.suffix == ".bin"], 4 * len(fields))
    return fields


def _number(file: Path) -> int:
    """Return the number in the name of a file; -1 if it has another name."""
    return int(file.stem) if file.stem.isdigit() else -1


def _numbers(files: Sequence[Path]) -> list[int]:
    wrong = next((file for file in files if _number(file) < 0), None)
    if wrong is not None:
        raise UserError(f"{wrong}: its name is no number; expected 000000{wrong.suffix}")
    return list(map(_number, files))


def _matching(
    files: Iterable[Path], scans: Sequence[Hashable], key: Callable[[Path], Hashable]
) -> tuple[list[int], list[Path]]:
    """Return the rows of the scans that have a file with the same ``key``, and these files."""
    by_key = {key(file): file for file in files}
    rows = [row for row, scan in enumerate(scans) if scan in by_key]
    return rows, [by_key[scans[row]] for row in rows]


def _stamped(folder: Path, suffixes: Sequence[str]) -> tuple[list[Path], I64]:
    """Return the files of a sensor in order of their stamps. ``timestamps.txt`` also lists missing files."""
    files = files_in(folder / "data", suffixes)
    if not files:
        return [], np.zeros(0, np.int64)
    times = read_timestamps(folder / "timestamps.txt")
    beyond = next((file for file in files if not 0 <= _number(file) < len(times)), None)
    if beyond is not None:
        raise UserError(f"{folder / 'timestamps.txt'}: {len(times)} lines, and none for {beyond.name}")
    stamps = np.array([times[_number(file)] for file in files], np.int64)
    order = np.argsort(stamps, kind="stable")
    return [files[i] for i in order.tolist()], stamps[order]


# --- streams -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class CameraImages:
    """Rectified images of a camera."""

    name: str
    aside: str  # reason why the camera gets no role by default; empty: it gets one
    times: I64  # (N,) stamps
    files: Sequence[Path]
    K: F64  # (3, 3)
    camera_from_lidar: F64  # (4, 4)


@dataclass(frozen=True, slots=True)
class VehiclePoses:
    """Poses of the LiDAR or the IMU in the map."""

    frame: str
    times: I64  # (N,) stamps
    poses: F64  # (N, 4, 4) map_from_frame
    lidar_from_imu: F64 | None = None  # (4, 4) mounting of an IMU


def _sensor_streams(start: int, cameras: Sequence[CameraImages], poses: VehiclePoses | None) -> list[Stream]:
    """Return the streams of mountings, poses and cameras of a drive that begins at ``start``."""
    edges = [(LIDAR, camera.name, geometry.inverse(camera.camera_from_lidar)) for camera in cameras]
    streams = list[Stream]()
    if poses is not None:
        if poses.lidar_from_imu is not None:
            edges.append((IMU, LIDAR, geometry.inverse(poses.lidar_from_imu)))
        streams.append(pose_stream(poses.times, poses.frame, poses.poses.__getitem__))
    for camera in cameras:
        streams += [
            intrinsics_stream(camera.name, camera.times[:1], [Intrinsics(0, 0, camera.K)].__getitem__),
            image_stream(camera.name, camera.times, camera.files, aside=camera.aside),
        ]
    return [*mounting_stream(start, edges), *streams]


def _cloud_stream(
    times: I64,
    files: Sequence[Path],
    fields: Sequence[str],
    label: Callable[[int, int], NDArray[np.uint32]] | None = None,
) -> Stream:
    """Return the stream of scans. ``label`` returns the labels of a row with a number of points."""

    def read(row: int) -> tuple[NDArray[np.void], int]:
        points, announced = read_cloud(files[row], fields)
        if label is not None:
            points = append_fields(points, "label", label(row, len(points)), usemask=False)
        return points, announced

    return cloud_stream(CLOUDS, LIDAR, times, read)
