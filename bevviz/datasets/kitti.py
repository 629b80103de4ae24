"""Frames and labels of the KITTI object benchmark (Geiger, Lenz and Urtasun 2012)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from bevviz import geometry
from bevviz.errors import UserError
from bevviz.frame import (
    F64,
    I64,
    Boxes3D,
    Camera,
    Cloud,
    Frame,
    Image,
    ImageLabels,
    Intrinsics,
    LabelledBoxes3D,
    Scene,
)

LIDAR, CAMERA = "velodyne", "image_2"
SECONDS_APART = 100  # of single frames: nothing in one is in the next

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
    lidar_from_camera = geometry.inverse(_calibration(calibration)[0])
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


def is_kitti(folder: Path) -> bool:
    """Whether it has what the object benchmark's folders are called."""
    return all((folder / name).is_dir() for name in ("velodyne", "calib"))


class KittiFrames:
    """The frames of the object benchmark, each by itself: no drive, so that nothing is tracked.

    Args:
        folder: with ``velodyne`` and ``calib``, and ``image_2`` and ``label_2`` where there are any.
        every: each such frame only.
        frames: first and last + 1 of those that are run, counted from 0.

    Raises:
        UserError: no scan in it.
    """

    def __init__(
        self, folder: Path, *, every: int = 1, frames: tuple[int | None, int | None] | None = None
    ) -> None:
        self._folder = folder
        self._names = sorted(path.stem for path in (folder / "velodyne").glob("*.bin"))
        if not self._names:
            raise UserError(f"{folder / 'velodyne'}: no scan in it; expected 000000.bin")
        self._chosen = range(len(self._names))[slice(*(frames or (None, None)))][::every]
        self._labelled = (folder / "label_2").is_dir()
        self.total = len(self._chosen)
        self.warnings: tuple[str, ...] = ()
        self.scene = Scene(folder.resolve().name, LIDAR, (LIDAR,), cameras=(CAMERA,), truth=self._labelled)

    @property
    def scans(self) -> I64:
        """(N,) made-up stamps, in nanoseconds."""
        return SECONDS_APART * 1_000_000_000 * np.arange(1, len(self._names) + 1, dtype=np.int64)

    def __iter__(self) -> Iterator[Frame]:
        for number in self._chosen:
            yield self.frame(number)

    def close(self) -> None:
        """Nothing is open."""

    def number_at(self, time: str | float) -> int:
        """Raises UserError: single frames have no times."""
        raise UserError(f"{time}: {self.scene.name} has single frames, which have no times; give a number")

    def frame(self, number: int) -> Frame:
        """One frame.

        Raises:
            UserError: there is none of that number, or a file cannot be read.
        """
        if not 0 <= number < len(self._names):
            raise UserError(f"frame {number}: there are {len(self._names)}, counted from 0")
        name, stamp = self._names[number], int(self.scans[number])
        scan = self._folder / f"velodyne/{name}.bin"
        try:
            values = np.fromfile(scan, np.float32).reshape(-1, 4)
        except (OSError, ValueError) as error:
            raise UserError(f"{scan}: is no scan of x, y, z, reflectance: {error}") from None
        values = values[np.isfinite(values).all(axis=1)]
        points = np.ascontiguousarray(values[:, :3])
        fields = {"intensity": np.ascontiguousarray(values[:, 3])}
        labels = self._folder / f"label_2/{name}.txt"
        return Frame(
            index=number,
            stamp=stamp,
            received=stamp,
            lidar=LIDAR,
            points=points,
            points_frame=LIDAR,
            fields=fields,
            world_frame=LIDAR,
            clouds=(Cloud(stamp, LIDAR, points, fields, name=LIDAR),),
            points_from_clouds=(np.eye(4),),
            cameras=(self._camera(name, stamp),),
            truth=read_labels(labels) if self._labelled else None,
        )

    def _camera(self, name: str, stamp: int) -> Camera:
        """The left colour camera: beside the rectified reference camera, by P2's last column."""
        import cv2

        camera_from_lidar, p2 = _calibration(self._folder / f"calib/{name}.txt")
        beside = np.eye(4)
        beside[:3, 3] = np.linalg.solve(p2[:, :3], p2[:, 3])
        file = self._folder / f"{CAMERA}/{name}.png"
        bgr = cv2.imread(str(file)) if file.is_file() else None
        if bgr is None:
            return Camera(CAMERA, None, None, None, None, problems=(f"{file} is no image",))
        intrinsics = Intrinsics(bgr.shape[1], bgr.shape[0], p2[:, :3])
        placed = beside @ camera_from_lidar
        image = Image(stamp, CAMERA, np.asarray(bgr, np.uint8))
        return Camera(CAMERA, image, intrinsics, placed, geometry.inverse(placed), 0.0, mounting=placed)


def _calibration(calibration: Path) -> tuple[F64, F64]:
    """(4, 4) rectified reference camera from LiDAR, and (3, 4) P2, the left colour camera."""
    lines = [line.split(":", 1) for line in _read(calibration).splitlines() if ":" in line]
    rectified, reference = np.eye(4), np.eye(4)
    try:
        rows = {name: np.array(values.split(), np.float64) for name, values in lines}
        rectified[:3, :3] = rows["R0_rect"].reshape(3, 3)
        reference[:3] = rows["Tr_velo_to_cam"].reshape(3, 4)
        p2 = rows["P2"].reshape(3, 4)
    except (KeyError, ValueError):
        raise UserError(f"{calibration}: no P2, R0_rect and Tr_velo_to_cam as KITTI writes them") from None
    return rectified @ reference, p2


def _read(path: Path) -> str:
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "is no text"
        raise UserError(f"{path}: cannot be read: {reason}") from None
