"""A log of Argoverse 2's Sensor Dataset (Wilson et al. 2021): tables in Feather files, images as JPEG."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevviz.datasets.dataset import (
    BASE,
    Dataset,
    Stream,
    cloud_stream,
    files_in,
    image_stream,
    intrinsics_stream,
    mounting_stream,
    pose_stream,
    subfolders,
)
from bevviz.datasets.ground_truth import truth_boxes, truth_stream
from bevviz.errors import UserError, first_line
from bevviz.model import geometry
from bevviz.model.frame import F64, I64, Boxes3D, Intrinsics, LabelledBoxes3D

LIDAR, CAMERAS = "sensors/lidar", "sensors/cameras"
MOUNTING, LENSES = "calibration/egovehicle_SE3_sensor.feather", "calibration/intrinsics.feather"
POSES, LABELS = "city_SE3_egovehicle.feather", "annotations.feather"
QUATERNION = ("qx", "qy", "qz", "qw")
POSITION = ("tx_m", "ty_m", "tz_m")
# Columns of a scan and their names here.
FIELDS = {"x": "x", "y": "y", "z": "z", "intensity": "intensity", "laser_number": "ring", "offset_ns": "time"}
FORMATS = {"intensity": "u1", "ring": "u1"}
CLASSES = {  # category -> class; others in small letters
    "REGULAR_VEHICLE": "car",
    **dict.fromkeys(("LARGE_VEHICLE", "BOX_TRUCK", "TRUCK", "TRUCK_CAB"), "truck"),
    **dict.fromkeys(("BUS", "SCHOOL_BUS", "ARTICULATED_BUS"), "bus"),
    "VEHICULAR_TRAILER": "trailer",
    **dict.fromkeys(("PEDESTRIAN", "OFFICIAL_SIGNALER"), "pedestrian"),
    "CONSTRUCTION_CONE": "traffic_cone",
}
Table = dict[str, NDArray[Any]]


class Argoverse2(Dataset):
    """Drive of one log: ``sensors/lidar/TIMESTAMP.feather`` and ``calibration`` in a folder.

    The scans of both LiDARs are one cloud in the frame of the vehicle, as the data set has them.
    """

    name = "argoverse2"
    about = "Argoverse 2"
    expects = f"{LIDAR}/TIMESTAMP.feather, {CAMERAS}/NAME/TIMESTAMP.jpg and {MOUNTING}"

    @classmethod
    def fits(cls, path: Path) -> bool:
        """Tell whether a folder is a log or contains logs."""
        return bool(_logs(path))

    @classmethod
    def drives(cls, path: Path) -> list[Path]:
        """Return the folders of the logs."""
        return _logs(path)

    def __init__(self, path: Path, sequence: str) -> None:
        super().__init__(path, sequence)
        folder = self.path = self.choose_folder()
        scans = files_in(folder / LIDAR, [".feather"])
        if not scans:
            raise UserError(f"{folder / LIDAR}: no scan in it; {self.about} has {self.expects}")
        times = _stamps(scans)
        mounting = _read(folder / MOUNTING, ("sensor_name", *QUATERNION, *POSITION))
        placed = {str(name): _pose(mounting, row) for row, name in enumerate(mounting["sensor_name"])}
        cameras = {camera.name: files_in(camera, [".jpg", ".png"]) for camera in _cameras(folder)}
        edges = [(BASE, name, placed[name]) for name in cameras if name in placed]
        self.streams = [
            *mounting_stream(int(times[0]), edges),
            *self._poses(),
            *self._images(cameras),
            *self._ground_truth(),
            _clouds(times, scans),
        ]

    def _poses(self) -> Iterator[Stream]:
        """Yield the stream of vehicle poses in the city."""
        if not (self.path / POSES).is_file():
            self.warn(f"no {POSES}: the motion of the vehicle is not known")
            return
        table = _read(self.path / POSES, ("timestamp_ns", *QUATERNION, *POSITION))
        order = np.argsort(table["timestamp_ns"], kind="stable")
        times = table["timestamp_ns"][order].astype(np.int64)
        yield pose_stream(times, BASE, lambda row: _pose(table, int(order[row])))

    def _images(self, cameras: dict[str, list[Path]]) -> Iterator[Stream]:
        """Yield the streams of the cameras. Their lenses have three radial coefficients."""
        columns = (
            "sensor_name",
            "fx_px",
            "fy_px",
            "cx_px",
            "cy_px",
            "k1",
            "k2",
            "k3",
            "width_px",
            "height_px",
        )
        table = _read(self.path / LENSES, columns)
        rows = {str(name): row for row, name in enumerate(table["sensor_name"])}
        for name, files in cameras.items():
            if not files:
                continue
            times = _stamps(files)
            if name in rows:
                about = _intrinsics(table, rows[name])
                yield intrinsics_stream(name, times[:1], lambda _, about=about: about)  # type: ignore[misc]
            else:
                self.warn(f"{LENSES}: nothing on the camera {name}")
            yield image_stream(name, times, files, rectified=False)

    def _ground_truth(self) -> Iterator[Stream]:
        """Yield the labelled boxes in the frame of the vehicle."""
        if not (self.path / LABELS).is_file():
            return
        sizes = ("length_m", "width_m", "height_m")
        columns = ("timestamp_ns", "track_uuid", "category", *sizes, *QUATERNION, *POSITION)
        table = _read(self.path / LABELS, columns)
        stamps = table["timestamp_ns"].astype(np.int64)
        times = np.unique(stamps)

        def label(number: int) -> LabelledBoxes3D:
            rows = np.flatnonzero(stamps == times[number])
            boxes = Boxes3D(
                np.stack([table[name][rows] for name in POSITION], axis=1),
                np.stack([table[name][rows] for name in sizes], axis=1).astype(np.float32),
                np.array([geometry.yaw(_pose(table, int(row))) for row in rows], np.float32),
            )
            names = [str(table["category"][row]) for row in rows]
            labels = [CLASSES.get(name, name.lower()) for name in names]
            ids = [str(table["track_uuid"][row]) for row in rows]
            return truth_boxes(boxes, labels, ids)

        yield truth_stream(times, BASE, label)


def _logs(path: Path) -> list[Path]:
    """Return the logs: the folder itself, or its subfolders."""
    folders = [path] if (path / LIDAR).is_dir() else subfolders(path)
    return [folder for folder in folders if (folder / LIDAR).is_dir() and (folder / MOUNTING).is_file()]


def _cameras(folder: Path) -> list[Path]:
    return subfolders(folder / CAMERAS) if (folder / CAMERAS).is_dir() else []


def _stamps(files: Sequence[Path]) -> I64:
    """Return the stamps of files, which are their names in nanoseconds.

    Raises:
        UserError: a name is no number.
    """
    if wrong := [file for file in files if not file.stem.isdigit()]:
        raise UserError(f"{wrong[0]}: the name is no stamp in nanoseconds")
    return np.array([int(file.stem) for file in files], np.int64)


def _read(file: Path, columns: Sequence[str], optional: Sequence[str] = ()) -> Table:
    """Read columns of a Feather file, and those of ``optional`` that it has.

    Raises:
        UserError: the file cannot be read, or lacks a column.
    """
    import pyarrow
    from pyarrow import feather

    try:
        table = feather.read_table(str(file), memory_map=False)
    except (OSError, ValueError, KeyError, pyarrow.ArrowException) as error:
        raise UserError(f"{file}: cannot be read as a Feather table: {first_line(error)}") from None
    if missing := [name for name in columns if name not in table.column_names]:
        raise UserError(
            f"{file}: has no column {', '.join(missing)}; there are {', '.join(table.column_names)}"
        )
    names = [*columns, *(name for name in optional if name in table.column_names)]
    return {name: table.column(name).to_numpy() for name in names}


def _pose(table: Table, row: int) -> F64:
    """Return the (4, 4) pose in a row."""
    position, quaternion = ([float(table[name][row]) for name in names] for names in (POSITION, QUATERNION))
    return geometry.transform(position, quaternion)


def _intrinsics(table: Table, row: int) -> Intrinsics:
    """Return the lens of a camera."""
    fx, fy, cx, cy, k1, k2, k3 = (
        float(table[name][row]) for name in ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3")
    )
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    size = int(table["width_px"][row]), int(table["height_px"][row])
    return Intrinsics(*size, matrix, "plumb_bob", np.array([k1, k2, 0, 0, k3]))


def _clouds(times: I64, files: Sequence[Path]) -> Stream:
    """Return the stream of scans. ``time`` is in seconds after the stamp."""

    def read(row: int) -> tuple[NDArray[np.void], int]:
        table = _read(files[row], ("x", "y", "z"), ("intensity", "laser_number", "offset_ns"))
        names = [name for name in FIELDS if name in table]
        kinds = [(FIELDS[name], FORMATS.get(FIELDS[name], "<f4")) for name in names]
        points = np.empty(len(table["x"]), kinds)
        for name in names:
            points[FIELDS[name]] = table[name] * 1e-9 if name == "offset_ns" else table[name]
        return points, 0

    return cloud_stream("/lidar/points", BASE, times, read)
