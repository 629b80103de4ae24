"""A scene of nuScenes (Caesar et al. 2020), or of a data set with its tables.

The library nuscenes-devkit is licensed for non-commercial use alone. Its release 1.2 requires numpy below 2.
Release 1.1.9 brings 115 packages (600 MB), among them opencv-python, which overwrites our headless OpenCV.
"""

from __future__ import annotations

import json
import math
import os
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from io import TextIOWrapper
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevviz.datasets.cloud_files import read_cloud
from bevviz.datasets.dataset import (
    BASE,
    MAP,
    Dataset,
    Stream,
    cloud_stream,
    image_stream,
    intrinsics_stream,
    mounting_stream,
    pose_stream,
)
from bevviz.datasets.ground_truth import truth_boxes, truth_stream
from bevviz.errors import UserError, first_line
from bevviz.model import geometry
from bevviz.model.class_names import NUSCENES_CLASSES
from bevviz.model.frame import F64, I64, Boxes3D, Intrinsics, LabelledBoxes3D
from bevviz.support import progress
from bevviz.support.files import open_regular

TABLES = "sample_data.json"
FIELDS = ("x", "y", "z", "intensity", "ring")
READ_SIZE = 1 << 22  # characters read at once; the largest table has a gigabyte
MAX_ROW = 1 << 24  # characters; a row usually has a thousand
MAX_TABLE_BYTES = 1 << 33  # bytes of a table
WITHOUT_CLASS = frozenset(  # categories that belong to no class of the detection task
    {
        "animal",
        "human.pedestrian.personal_mobility",
        "human.pedestrian.stroller",
        "human.pedestrian.wheelchair",
        "movable_object.debris",
        "movable_object.pushable_pullable",
        "static_object.bicycle_rack",
        "vehicle.emergency.ambulance",
        "vehicle.emergency.police",
    }
)
Record = Mapping[str, Any]


class NuScenes(Dataset):
    """Drive of one scene: ``v1.0-mini/*.json`` with ``samples`` and ``sweeps`` next to ``v1.0-mini``.

    Data sets with the same tables are T4 (``annotation/*.json`` next to ``data``) and Lyft Level 5.
    """

    name = "nuscenes"
    about = "nuScenes"
    expects = "v1.0-mini/sample_data.json, and samples and sweeps beside v1.0-mini"

    @classmethod
    def fits(cls, path: Path) -> bool:
        """Tell whether a folder has the tables of nuScenes, or contains a folder with them."""
        return (path / TABLES).is_file() or bool(_versions(path))

    def __init__(self, path: Path, sequence: str) -> None:
        super().__init__(path, sequence)
        root = path
        if (path / TABLES).is_file():
            versions, root = [path], path.parent
        else:
            versions = _versions(path)
        scenes = {row["name"]: (row, tables) for tables in versions for row in records(tables / "scene.json")}
        available = sorted(scenes)
        if len(scenes) > 1 and not sequence:
            available = self._with_scans(root, scenes)
        absent = f"{len(scenes) - len(available)} of {len(scenes)} scenes have no LiDAR scan here"
        scene, tables = scenes[
            self.choose_drive(available, f"; {absent}" if len(available) < len(scenes) else "")
        ]
        if len(available) < len(scenes):
            self.warn(f"{absent}: {scene['name']} has")
        samples = _by_token(tables, "sample", lambda row: row["scene_token"] == scene["token"])
        data = _by_token(tables, "sample_data", lambda row: row["sample_token"] in samples)
        mounted = _chosen(
            tables, "calibrated_sensor", {row["calibrated_sensor_token"] for row in data.values()}
        )
        sensors = _by_token(tables, "sensor", lambda row: True)
        poses = _chosen(tables, "ego_pose", {row["ego_pose_token"] for row in data.values()})
        rows_by_channel: dict[str, list[Record]] = defaultdict(list)
        missing, incomplete = [], set[str]()
        for row in sorted(data.values(), key=lambda row: row["timestamp"]):
            sensor = sensors[mounted[row["calibrated_sensor_token"]]["sensor_token"]]
            if sensor["modality"] == "radar":
                continue
            if _resolve_file(root, row["filename"]).is_file():
                rows_by_channel[sensor["channel"]].append(row)
            else:
                missing.append(row["filename"])
                if row["is_key_frame"]:
                    incomplete.add(row["sample_token"])
        if missing:
            total = len(missing) + sum(map(len, rows_by_channel.values()))
            self.warn(
                f"{len(missing)} of {total} files of {scene['name']} are not there, "
                f"{len(incomplete)} of its {len(samples)} samples lack one; the first: {missing[0]}"
            )
        edges, clouds, images = [], list[Stream](), list[Stream]()
        key_stamps: dict[str, int] = {}  # stamp of the key scan by sample
        for channel, rows in sorted(rows_by_channel.items()):
            calibration = mounted[rows[0]["calibrated_sensor_token"]]
            pose = geometry.transform_wxyz(calibration["translation"], calibration["rotation"])
            times = 1000 * np.array([row["timestamp"] for row in rows], np.int64)
            files = [_resolve_file(root, row["filename"]) for row in rows]
            if sensors[calibration["sensor_token"]]["modality"] == "lidar":
                turns = round(geometry.yaw(pose) / (np.pi / 2))
                pose = pose @ _quarter_turns(-turns)
                clouds.append(self._clouds(channel, times, files, turns))
                key_stamps |= {
                    r["sample_token"]: int(t) for r, t in zip(rows, times, strict=True) if r["is_key_frame"]
                }
            else:
                images += self._images(channel, times, files, calibration)
            edges.append((BASE, channel, pose))
        if not clouds:
            others = self._with_scans(root, scenes)
            raise UserError(
                f"{root}: no LiDAR scan of {scene['name']} is there; its tables name {len(missing)} files; "
                f"{len(others)} of {len(scenes)} scenes have scans here: {', '.join(others[:8])}"
                f"{' ...' if len(others) > 8 else ''}"
            )
        self.sample_stamps = key_stamps
        self.streams = [
            *mounting_stream(int(clouds[0].times[0]), edges),
            _pose_stream([poses[row["ego_pose_token"]] for rows in rows_by_channel.values() for row in rows]),
            *images,
            *self._ground_truth(tables, key_stamps),
            *clouds,
        ]

    def _with_scans(self, root: Path, scenes: Mapping[str, tuple[Record, Path]]) -> list[str]:
        """Return the names of the scenes whose key LiDAR scans exist. A part of a large set may be here.

        Raises:
            UserError: there is none.
        """
        tokens = set[str]()
        for tables in {tables for _, tables in scenes.values()}:
            lidars = {r["token"] for r in records(tables / "sensor.json") if r["modality"] == "lidar"}
            mounted = _by_token(tables, "calibrated_sensor", lambda r, of=lidars: r["sensor_token"] in of)
            scene_of = {row["token"]: row["scene_token"] for row in records(tables / "sample.json")}
            for row in progress.bar(
                records(tables / "sample_data.json"), desc=f"files of {tables.name}", unit="row", delay=1
            ):
                scene = scene_of.get(row["sample_token"], "")
                if scene in tokens or not row["is_key_frame"]:
                    continue
                if (
                    row["calibrated_sensor_token"] in mounted
                    and _resolve_file(root, row["filename"]).is_file()
                ):
                    tokens.add(scene)
        if not tokens:
            raise UserError(f"{root}: no LiDAR scan that the tables name is there; expected {self.expects}")
        return sorted(name for name, (scene, _) in scenes.items() if scene["token"] in tokens)

    def _clouds(self, channel: str, times: I64, files: Sequence[Path], turns: int) -> Stream:
        """Return the stream of scans, rotated by quarter turns so that x is ahead.

        nuScenes has five float32 values per point. Other sets have another number of them, or real PCD files.
        """
        fields = self.column_names(files, FIELDS)
        self.check_sizes([file for file in files if file.suffix == ".bin"], 4 * len(fields))

        def read(row: int) -> tuple[NDArray[np.void], int]:
            points, announced = read_cloud(files[row], fields)
            return _rotate(points, turns), announced

        return cloud_stream(f"/{channel}/points", channel, times, read, files)

    def _images(
        self, channel: str, times: I64, files: Sequence[Path], calibration: Record
    ) -> Iterator[Stream]:
        """Yield the streams of a camera.

        Images are rectified unless T4's ``camera_distortion`` has coefficients, which are those of OpenCV.
        """
        matrix = np.array(calibration["camera_intrinsic"], np.float64)
        if matrix.shape != (3, 3):
            raise UserError(f"{self.path}: calibrated_sensor.json has no camera_intrinsic for {channel}")
        distortion = np.array(calibration.get("camera_distortion") or (), np.float64).reshape(-1)
        rectified = not distortion.any()
        model = "" if rectified else "plumb_bob" if len(distortion) <= 5 else "rational_polynomial"
        about = Intrinsics(0, 0, matrix, model, distortion if model else np.zeros(0))
        yield intrinsics_stream(channel, times[:1], lambda _: about)
        yield image_stream(channel, times, files, rectified=rectified)

    def _ground_truth(self, tables: Path, key_stamps: Mapping[str, int]) -> Iterator[Stream]:
        """Yield the ground truth of the key frames in the map."""
        if not (tables / "sample_annotation.json").is_file():
            return
        labelled: dict[str, list[Record]] = defaultdict(list)
        for row in records(tables / "sample_annotation.json"):
            if row["sample_token"] in key_stamps:
                labelled[row["sample_token"]].append(row)
        wanted = {row["instance_token"] for rows in labelled.values() for row in rows}
        instances = _chosen(tables, "instance", wanted)
        categories = {row["token"]: row["name"] for row in records(tables / "category.json")}
        order = sorted((time, sample) for sample, time in key_stamps.items())
        times = np.array([time for time, _ in order], np.int64)

        def label(number: int) -> LabelledBoxes3D:
            _, sample = order[number]
            rows = [
                (row, categories[instances[row["instance_token"]]["category_token"]])
                for row in labelled[sample]
            ]
            labelled_rows = [
                (row, NUSCENES_CLASSES.get(name, name)) for row, name in rows if name not in WITHOUT_CLASS
            ]
            boxes = Boxes3D(
                np.array([_numbers(row["translation"], 3) for row, _ in labelled_rows]).reshape(-1, 3),
                np.array(
                    [_numbers(row["size"], 3)[[1, 0, 2]] for row, _ in labelled_rows], np.float32
                ).reshape(-1, 3),
                np.array([_yaw(row["rotation"]) for row, _ in labelled_rows], np.float32),
            )
            ids = [row["instance_token"] for row, _ in labelled_rows]
            return truth_boxes(boxes, [name for _, name in labelled_rows], ids)

        yield truth_stream(times, MAP, label)


def _pose_stream(poses: Sequence[Record]) -> Stream:
    """Return the stream of vehicle poses by stamp."""
    pose_rows = {1000 * int(row["timestamp"]): row for row in poses}
    times = np.array(sorted(pose_rows), np.int64)

    def pose(number: int) -> F64:
        row = pose_rows[int(times[number])]
        return geometry.transform_wxyz(row["translation"], row["rotation"])

    return pose_stream(times, BASE, pose)


def _numbers(values: Any, count: int) -> F64:
    """Return (count,) numbers of a label; NaN for invalid values, so that the label counts as unusable."""
    try:
        return np.array(values, np.float64).reshape(count)
    except (TypeError, ValueError):
        return np.full(count, np.nan)


def _yaw(rotation: Any) -> float:
    """Return the rotation about z of a quaternion w, x, y, z; NaN if it is no rotation."""
    try:
        return geometry.yaw(geometry.transform_wxyz(np.zeros(3), _numbers(rotation, 4)))
    except ValueError:
        return math.nan


def _quarter_turns(number: int) -> F64:
    """Return a (4, 4) rotation about z."""
    pose = np.eye(4)
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[number % 4]
    pose[:2, :2] = [[c, -s], [s, c]]
    return pose


def _rotate(points: NDArray[np.void], turns: int) -> NDArray[np.void]:
    """Return the points rotated by quarter turns. Every coordinate keeps its digits."""
    x, y = points["x"], points["y"]
    turned = points.copy()
    turned["x"], turned["y"] = ((x, y), (-y, x), (-x, -y), (y, -x))[turns % 4]
    return turned


# --- tables ------------------------------------------------------------------------------------


def _resolve_file(root: Path, name: str) -> Path:
    """Return the file that a table names, which must be in the data set.

    Only the name counts: ``..`` and an absolute name must not lead out of the folder. Links in the folder are
    followed, because many users keep ``sweeps`` on another disk.

    Raises:
        UserError: the name leads out of the folder.
    """
    relative = os.path.relpath(root / name, root)
    if relative == os.pardir or relative.startswith(f"{os.pardir}{os.sep}"):
        raise UserError(f"{root}: {TABLES} names the file {name}, which is not in the data set")
    return root / relative


def _versions(path: Path) -> list[Path]:
    """Return the folders with tables."""
    return sorted(f.parent for name in ("v*", "annotation") for f in path.glob(f"{name}/{TABLES}"))


def records(table: Path) -> Iterator[dict[str, Any]]:
    """Yield the rows of a table one by one. So a table of a gigabyte takes little memory.

    Raises:
        UserError: the table is missing, cut, or no list of objects.
    """
    decoder, buffer, at = json.JSONDecoder(), "", 0
    try:
        with TextIOWrapper(open_regular(table), encoding="utf-8") as file:
            if os.fstat(file.fileno()).st_size > MAX_TABLE_BYTES:
                raise UserError(f"{table}: has more than {MAX_TABLE_BYTES:,} bytes, which are read at most")
            while True:
                while at < len(buffer) and buffer[at] in "[, \t\r\n":
                    at += 1
                if at < len(buffer) and buffer[at] == "]":
                    return
                try:
                    row, at = decoder.raw_decode(buffer, at)
                    yield row
                    continue
                except json.JSONDecodeError:
                    more = file.read(READ_SIZE)
                if not more or len(buffer) - at > MAX_ROW:
                    raise UserError(f"{table}: is cut, or no table of nuScenes")
                buffer, at = buffer[at:] + more, 0
    except OSError as error:
        raise UserError(f"{table}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise UserError(f"{table}: is no text") from None
    except (ValueError, RecursionError) as error:  # a number with thousands of digits, or a deeply nested row
        raise UserError(f"{table}: is no table of nuScenes: {first_line(error)}") from None


def _by_token(tables: Path, name: str, chosen: Any) -> dict[str, Record]:
    """Return the chosen rows by token."""
    return {row["token"]: row for row in records(tables / f"{name}.json") if chosen(row)}


def _chosen(tables: Path, name: str, tokens: Collection[str]) -> dict[str, Record]:
    """Return the rows with these tokens.

    Raises:
        UserError: a row is missing.
    """
    rows = _by_token(tables, name, lambda row: row["token"] in tokens)
    if missing := set(tokens) - rows.keys():
        raise UserError(f"{tables / name}.json: no row {min(missing)}, which another table names")
    return rows
