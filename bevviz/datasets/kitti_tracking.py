"""A sequence of the KITTI tracking benchmark."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

from bevviz.datasets.dataset import (
    BOXES,
    IMAGES,
    Dataset,
    Stream,
    files_in,
    frame_stamps,
    image_stream,
    read_table,
)
from bevviz.datasets.kitti import (
    IMU,
    LIDAR,
    Calibration,
    camera_info_stream,
    cloud_stream,
    ground_truth_stream,
    labelled_boxes,
    mounting_stream,
    pose_stream,
    poses_of_oxts,
)
from bevviz.errors import UserError
from bevviz.model import geometry
from bevviz.support.files import read_text

RATE = 10.0  # Hz; the benchmark has no stamps
CAMERAS = {"image_02": "", "image_03": "the right eye of a stereo pair"}


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
        root, name = path, path.name
        if path.parent.name == "velodyne":
            root = path.parent.parent
            if sequence not in ("", name):
                raise UserError(f"{path}: is one drive; leave --sequence {sequence} out")
        else:
            name = self.choose_drive([drive.name for drive in self.drives(path)])
        scans = files_in(root / "velodyne" / name, [".bin"])
        if not scans:
            raise UserError(f"{root / 'velodyne' / name}: no scan in it; expected 000000.bin")
        self.path = root
        fields = self.column_names(scans)
        self.check_sizes(scans, 4 * len(fields))
        calibration = Calibration(root / f"calib/{name}.txt")
        times = frame_stamps(RATE, _numbers(scans))
        edges, sensors = [], list[Stream]()
        for camera, aside in CAMERAS.items():
            images = files_in(root / camera / name, IMAGES)
            if not images:
                continue
            image_times = frame_stamps(RATE, _numbers(images))
            matrix, camera_from_lidar = calibration.camera(int(camera[-1]))
            edges.append((LIDAR, camera, geometry.inverse(camera_from_lidar)))
            sensors += [
                camera_info_stream(camera, image_times, matrix),
                image_stream(camera, image_times, images, aside=aside),
            ]
        self.streams = []
        oxts = root / f"oxts/{name}.txt"
        if oxts.is_file():
            table = read_table(oxts, 6)
            edges.append((IMU, LIDAR, geometry.inverse(calibration.lidar_from_imu)))
            self.streams.append(pose_stream(frame_stamps(RATE, range(len(table))), IMU, poses_of_oxts(table)))
        if edges:
            self.streams.insert(0, mounting_stream(int(times[0]), edges))
        self.streams += sensors
        labels = root / f"label_02/{name}.txt"
        if labels.is_file():
            self.streams.append(self._ground_truth(labels, calibration, scans))
        self.streams.append(cloud_stream(times, scans, fields))

    def _ground_truth(self, file: Path, calibration: Calibration, scans: list[Path]) -> Stream:
        """Return the ground truth of the scans. A line has frame, object, and an object label."""
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
        numbers, pose = _numbers(scans), calibration.rectified_from_lidar

        return ground_truth_stream(
            BOXES,
            frame_stamps(RATE, numbers),
            lambda row: labelled_boxes(file, lines[numbers[row]], pose, ids[numbers[row]]),
        )


def _numbers(files: list[Path]) -> list[int]:
    wrong = next((file for file in files if not file.stem.isdigit()), None)
    if wrong is not None:
        raise UserError(f"{wrong}: its name is no number; expected 000000{wrong.suffix}")
    return [int(file.stem) for file in files]
