"""A plain folder of clouds and images."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevviz import geometry
from bevviz.datasets.dataset import (
    IMAGES,
    SECOND,
    Dataset,
    Stream,
    columns_of,
    frames_at,
    read_bytes,
    read_table,
    read_text,
)
from bevviz.errors import UserError, first_line
from bevviz.frame import F64, I64, Intrinsics
from bevviz.ros.encode import (
    encode_compressed_image,
    encode_intrinsics,
    encode_points,
    encode_transforms,
)

CLOUDS = (".pcd", ".ply", ".bin", ".npy")
MAP, BASE = "map", "base_link"
CALIBRATION, STAMPS, POSES = "calibration.yaml", "stamps.csv", "poses.txt"
UNITS = {19: 1, 16: 1000, 13: 1_000_000, 10: SECOND}  # digits of a stamp -> nanoseconds of its unit
KEYS = {"rate", "fields", "lidars", "cameras"}
SENSOR_KEYS = {"pose", "K", "D", "distortion_model"}


class Folder(Dataset):
    """Clouds and images in it or in folders of it, one folder a sensor, which is called like it.

    Beside them may lie ``calibration.yaml``, ``stamps.csv`` (file, stamp) and ``poses.txt`` (as TUM's).
    """

    name = "folder"
    about = "folder of clouds and images"
    expects = "PCD, PLY, BIN or NPY files, or a folder of them for each LiDAR; PNG or JPEG for cameras"
    any_folder = True

    @classmethod
    def fits(cls, path: Path) -> bool:
        return any(_of_kind(folder, CLOUDS) for folder in (path, *_folders(path)))

    def __init__(self, path: Path, sequence: str) -> None:
        super().__init__(path, sequence)
        if sequence:
            raise UserError(f"{path}: is one drive; leave --sequence {sequence} out")
        about = self._calibration()
        sensors = {folder.name: folder for folder in _folders(path)}
        lidars = {name: files for name, folder in sensors.items() if (files := _of_kind(folder, CLOUDS))}
        cameras = {name: files for name, folder in sensors.items() if (files := _of_kind(folder, IMAGES))}
        if files := _of_kind(path, CLOUDS):
            lidars = {"lidar": files, **lidars}
        if files := _of_kind(path, IMAGES):
            cameras = {"camera": files, **cameras}
        if not lidars:
            raise UserError(f"{path}: no cloud in it; expected {self.expects}")
        for kind, there in (("lidars", lidars), ("cameras", cameras)):
            if unknown := sorted(about.get(kind, {}).keys() - there.keys()):
                names = ", ".join(there)
                raise UserError(f"{path / CALIBRATION}: no {unknown[0]} among the {kind}; there are {names}")
        stamped = self._stamps([*lidars.values(), *cameras.values()], float(about.get("rate", 10.0)))
        fields = [str(name) for name in about.get("fields", ("x", "y", "z", "intensity"))]
        edges, streams = [], list[Stream]()
        for name, files in cameras.items():
            files, times = _in_order(files, stamped)
            stated = about.get("cameras", {}).get(name, {})
            if "pose" in stated:
                edges.append((BASE, name, self._pose(stated["pose"], name)))
            if "K" in stated:
                streams.append(self._camera_info(name, times, stated))
            streams.append(_pictures(name, times, files, rectified="D" not in stated))
        for name, files in lidars.items():
            files, times = _in_order(files, stamped)
            self.check_sizes([file for file in files if file.suffix == ".bin"], 4 * len(fields))
            stated = about.get("lidars", {}).get(name, {})
            edges.append((BASE, name, self._pose(stated["pose"], name) if "pose" in stated else np.eye(4)))
            streams.append(_clouds(name, times, files, fields))
        start = min(stamped.values())
        self.streams = [
            Stream(
                "/tf_static",
                "tf2_msgs/msg/TFMessage",
                np.array([start], np.int64),
                lambda _: encode_transforms(start, edges),
            ),
            *self._poses(),
            *streams,
        ]

    def _calibration(self) -> Mapping[str, Any]:
        """What ``calibration.yaml`` says; empty where there is none."""
        from ruamel.yaml import YAML
        from ruamel.yaml.error import YAMLError

        file = self.path / CALIBRATION
        if not file.is_file():
            return {}
        try:
            about = YAML(typ="safe", pure=True).load(read_text(file)) or {}
        except YAMLError as error:
            raise UserError(f"{file}: is not valid YAML: {first_line(error)}") from None
        if not isinstance(about, dict) or not all(
            isinstance(about.get(k, {}), dict) for k in ("lidars", "cameras")
        ):
            raise UserError(f"{file}: expected {', '.join(sorted(KEYS))}, see docs/inputs.md")
        stated = [s for kind in ("lidars", "cameras") for s in about.get(kind, {}).values()]
        if any(not isinstance(sensor, dict) for sensor in stated):
            raise UserError(f"{file}: of a sensor {', '.join(sorted(SENSOR_KEYS))} can be stated")
        unknown = sorted(set(about) - KEYS) + sorted({key for s in stated for key in s} - SENSOR_KEYS)
        if unknown:
            known = ", ".join(sorted(KEYS | SENSOR_KEYS))
            raise UserError(f"{file}: {unknown[0]} is not known; there are {known}")
        return about

    def _pose(self, values: Any, sensor: str) -> F64:
        """(4, 4) base_link from a sensor, of 7 numbers or of 16."""
        try:
            numbers = np.array(values, np.float64).reshape(-1)
            if len(numbers) == 16:
                pose = numbers.reshape(4, 4)
                if not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-3):
                    raise ValueError("its upper left part is no rotation")
                return pose
            if len(numbers) != 7:
                raise ValueError(f"{len(numbers)} numbers")
            return geometry.transform(numbers[:3], numbers[3:])
        except (TypeError, ValueError) as error:
            raise UserError(
                f"{self.path / CALIBRATION}: pose of {sensor}: {error}; expected x y z qx qy qz qw of the "
                "sensor in base_link, or 16 numbers of a matrix"
            ) from None

    def _camera_info(self, name: str, times: I64, stated: Mapping[str, Any]) -> Stream:
        try:
            matrix = np.array(stated["K"], np.float64).reshape(3, 3)
            distortion = np.array(stated.get("D", ()), np.float64).reshape(-1)
        except (TypeError, ValueError):
            raise UserError(
                f"{self.path / CALIBRATION}: camera {name}: K needs 9 numbers, row by row, and D only numbers"
            ) from None
        model = str(stated.get("distortion_model", "plumb_bob" if len(distortion) else ""))
        about = Intrinsics(0, 0, matrix, model, distortion)
        return Stream(
            f"/{name}/camera_info",
            "sensor_msgs/msg/CameraInfo",
            times[:1],
            lambda row: encode_intrinsics(int(times[row]), name, about),
        )

    def _stamps(self, sensors: Sequence[Sequence[Path]], rate: float) -> dict[Path, int]:
        """Of each file, in nanoseconds."""
        table = self.path / STAMPS
        files = [file for sensor in sensors for file in sensor]
        if table.is_file():
            return self._listed(table, files)
        texts = {file: _number(file) for file in files}
        if all("." in text or len(text) in UNITS for text in texts.values() if text) and all(texts.values()):
            return {file: _stamp(text) for file, text in texts.items()}
        if all(texts.values()):
            numbers = [int(text.partition(".")[0]) for text in texts.values()]
            self.warn(
                f"the names are no stamps: taken for frame numbers, at {rate:g} a second "
                f"(rate in {CALIBRATION})"
            )
            return dict(zip(files, frames_at(rate, numbers).tolist(), strict=True))
        self.warn(f"names without a number: the files are taken in their order, at {rate:g} a second")
        return {
            file: int(stamp)
            for sensor in sensors
            for file, stamp in zip(sensor, frames_at(rate, range(len(sensor))), strict=True)
        }

    def _listed(self, table: Path, files: Sequence[Path]) -> dict[Path, int]:
        """By ``stamps.csv``."""
        found = {}
        for number, row in enumerate(csv.reader(read_text(table).splitlines()), 1):
            if len(row) < 2 or (number == 1 and not re.search(r"\d", row[1])):
                continue
            try:
                found[self.path / row[0].strip()] = _stamp(row[1].strip())
            except ValueError:
                raise UserError(f"{table}: line {number}: '{row[1]}' is no stamp") from None
        if missing := [file for file in files if file not in found]:
            raise UserError(f"{table}: no stamp for {missing[0].relative_to(self.path)}")
        return found

    def _poses(self) -> list[Stream]:
        """Where the vehicle is: a line has stamp x y z qx qy qz qw."""
        file = self.path / POSES
        if not file.is_file():
            return []
        table = read_table(file, 8)
        table = table[np.argsort(table[:, 0], kind="stable")]
        times = np.round(table[:, 0] * 1e9).astype(np.int64)

        def make(row: int) -> Any:
            pose = geometry.transform(table[row, 1:4], table[row, 4:])
            return encode_transforms(int(times[row]), [(MAP, BASE, pose)])

        return [Stream("/tf", "tf2_msgs/msg/TFMessage", times, make)]


def _folders(path: Path) -> list[Path]:
    return sorted(found for found in path.iterdir() if found.is_dir() and not found.name.startswith("."))


def _of_kind(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    return sorted(f for f in folder.iterdir() if f.suffix.lower() in suffixes and f.is_file())


def _number(file: Path) -> str:
    """The last number in a name; "" where there is none."""
    found = re.findall(r"\d+(?:\.\d+)?", file.stem)
    return str(found[-1]) if found else ""


def _stamp(text: str) -> int:
    """Nanoseconds of a stamp in seconds, or, without a point, in what it has the digits of."""
    whole, point, fraction = text.partition(".")
    if point:
        return int(whole) * SECOND + int(fraction[:9].ljust(9, "0"))
    return int(whole) * UNITS.get(len(whole), SECOND)


def _in_order(files: Sequence[Path], stamped: Mapping[Path, int]) -> tuple[list[Path], I64]:
    ordered = sorted(files, key=lambda file: stamped[file])
    return ordered, np.array([stamped[file] for file in ordered], np.int64)


def _pictures(name: str, times: I64, files: Sequence[Path], *, rectified: bool) -> Stream:
    def make(row: int) -> Any:
        kind = files[row].suffix.lower().lstrip(".").replace("jpg", "jpeg")
        return encode_compressed_image(int(times[row]), name, read_bytes(files[row]), kind)

    topic = f"/{name}/{'image_rect' if rectified else 'image_raw'}/compressed"
    return Stream(topic, "sensor_msgs/msg/CompressedImage", times, make)


def _clouds(name: str, times: I64, files: Sequence[Path], fields: Sequence[str]) -> Stream:
    def make(row: int) -> Any:
        return encode_points(int(times[row]), name, read_cloud(files[row], fields))

    return Stream(f"/{name}/points", "sensor_msgs/msg/PointCloud2", times, make)


def read_cloud(file: Path, fields: Sequence[str]) -> NDArray[np.void]:
    """(N,) points with x, y, z and what else the file has.

    Args:
        file: PCD, PLY, BIN (float32) or NPY.
        fields: columns of the last two.

    Raises:
        UserError: it cannot be read, or is damaged.
    """
    suffix = file.suffix.lower()
    try:
        if suffix == ".bin":
            values = np.frombuffer(
                read_bytes(file), "<f4", count=file.stat().st_size // (4 * len(fields)) * len(fields)
            )
            return columns_of(values.reshape(-1, len(fields)), fields)
        if suffix == ".npy":
            loaded = np.load(file, allow_pickle=False)
            if loaded.dtype.names:
                return np.asarray(loaded.reshape(-1))
            if loaded.ndim != 2 or loaded.shape[1] < 3:
                raise ValueError(f"has the shape {loaded.shape}, not (N, 3) or more")
            names = [*fields, *(f"field_{i}" for i in range(loaded.shape[1]))][: loaded.shape[1]]
            return columns_of(loaded.astype(np.float32), names)
        return _read_by_open3d(file)
    except (OSError, ValueError, EOFError, RuntimeError) as error:
        raise UserError(f"{file}: cannot be read as a cloud: {first_line(error)}") from None


def _read_by_open3d(file: Path) -> NDArray[np.void]:
    """A PCD or PLY with all fields of one number a point."""
    from bevviz.o3d import load

    o3d = load()
    if not file.is_file() or not file.stat().st_size:
        raise ValueError("is empty")
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.t.io.read_point_cloud(str(file))
    if "positions" not in cloud.point:
        raise ValueError("no point in it, or damaged")
    columns = dict(zip("xyz", cloud.point["positions"].numpy().T, strict=True))
    for name, values in cloud.point.items():
        table = values.numpy()
        if name != "positions" and table.ndim == 2 and table.shape[1] == 1 and table.dtype.kind in "uif":
            columns[name] = table[:, 0]
    layout = np.dtype([(name, values.dtype) for name, values in columns.items()])
    points = np.empty(len(columns["x"]), layout)
    for name, values in columns.items():
        points[name] = values
    return points
