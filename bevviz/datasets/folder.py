"""A plain folder of clouds and images as a drive."""

from __future__ import annotations

import csv
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevviz.config.files import parse_yaml
from bevviz.datasets.cloud_files import CLOUDS, array_shape, read_bytes, read_cloud, why_no_points
from bevviz.datasets.dataset import (
    BASE,
    IMAGES,
    Dataset,
    Stream,
    cloud_stream,
    describe_unread,
    files_in,
    frame_stamps,
    image_stream,
    intrinsics_stream,
    mounting_stream,
    pose_stream,
    read_table,
    subfolders,
)
from bevviz.datasets.stamps import MAX_SENSORS, file_times, group_by_sensor, stamps_in
from bevviz.datasets.sustech_labels import FOLDER as LABELS
from bevviz.datasets.sustech_labels import truth_streams
from bevviz.errors import UserError
from bevviz.messages.images import encoded_size
from bevviz.model import geometry
from bevviz.model.frame import F64, I64, Intrinsics
from bevviz.support.extensions import load, registered
from bevviz.support.files import read_lines, read_text
from bevviz.support.limits import CONFIG_LIMIT, TABLE_LIMIT

MAX_COLUMNS = 64  # columns of an NPY file; height grids and transposed tables have more
NOTE_SUFFIXES = (".json", ".yaml", ".yml", ".xml", ".txt", ".toml")
RELATED = "related_images"  # Supervisely's: a folder of images for each cloud
CALIBRATION, STAMPS, POSES = "calibration.yaml", "stamps.csv", "poses.txt"
SENSOR_FOLDER = re.compile(  # folders that contain one folder per camera or LiDAR
    "cam|im(g|age)|lidar|velo|point|cloud|pcd|scan", re.IGNORECASE
)
DRIVE_FOLDER = re.compile(
    r"(\d{3,}|(train|test)(ing)?|val(idation)?"
    r"|(seq(uence)?|run|drive|scene|scenario|clip|session|log)[-_ ]?\d+)$",
    re.IGNORECASE,
)  # folders of a drive or a split, not of a sensor
# Nearest types that a PointCloud2 can hold.
NEAREST_TYPES = {"i8": "<f8", "u8": "<f8", "f2": "<f4", "b1": "u1"}
KEYS = {"rate", "fields", "lidars", "cameras"}
LENS_KEYS = {"D", "distortion_model"}
SENSOR_KEYS = {"pose", "rate", "fields", "K", "size", *LENS_KEYS}
STAMP = r"\d{1,19}(\.\d*)?"
MAX_SIDE = 1 << 31  # limit of an image side, larger than any image
SECONDS, NANOSECONDS = re.compile(r"\d{1,6}|\d{10}"), re.compile(r"\d{1,9}")
MAX_SECONDS = 1e10  # seconds; a larger stamp has another unit
UNIT_TOLERANCE = 0.01  # tolerance of a quaternion's length
MAX_OFFSET = 100  # metres; sensors of one vehicle are closer together
MIN_FRAMES = 5  # Fewer frames say nothing about a rate.
MIN_RATE = 1e-6  # frames per second
FRAME_RATIO = 1.5  # ratio of frame counts that another rate explains


@dataclass(slots=True)
class FoundCalibration:
    """Statements of calibration files, as ``calibration.yaml`` has them: by kind of sensor and name.

    The functions that the entry points ``bevviz.calibrations`` name return it. Their arguments are the folder
    and the names of its LiDARs and of its cameras.

    Attributes:
        lidars: pose of each LiDAR.
        cameras: pose, K, D, distortion_model and size of each camera.
        files: files that state them.
        warnings: problems of files, one sentence each.
    """

    lidars: dict[str, dict[str, Any]] = field(default_factory=dict)
    cameras: dict[str, dict[str, Any]] = field(default_factory=dict)
    files: list[Path] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


class Folder(Dataset):
    """Drive of clouds and images in a folder or its subfolders, one subfolder per sensor with its name.

    ``calibration.yaml``, ``stamps.csv`` (file, stamp) and ``poses.txt`` (TUM format) may lie beside them.
    """

    name = "folder"
    about = "folder of clouds and images"
    expects = "PCD, PLY, BIN or NPY files, or a folder of them for each LiDAR; PNG or JPEG for cameras"
    any_folder = True

    @classmethod
    def fits(cls, path: Path) -> bool:
        """Tell whether a folder or a sensor folder in it has clouds."""
        return any(files_in(folder, CLOUDS) for folder in _sensor_folders(path))

    @classmethod
    def states(cls, path: Path) -> bool:
        """Tell whether a calibration, stamps or poses make the folder a drive."""
        return any((path / name).is_file() for name in (CALIBRATION, STAMPS, POSES))

    @classmethod
    def drives(cls, path: Path) -> list[Path]:
        """Return the subfolders with clouds and images of their own, where there are several."""
        inner = [f for f in subfolders(path) if files_in(f, CLOUDS) and files_in(f, IMAGES)]
        return inner if len(inner) > 1 and not files_in(path, CLOUDS) and not cls.states(path) else [path]

    def __init__(self, path: Path, sequence: str) -> None:
        super().__init__(path, sequence)
        path = self.path = self.choose_folder()
        about = self._calibration()
        others = describe_unread(path)
        lidars, cameras = self._sensors(about)
        if not lidars:
            raise UserError(f"{path}: no cloud in it{others and '; '}{others}; expected {self.expects}")
        if others:
            self.warn(others)
        related = self._related_images(lidars)
        alone, cameras = cameras, {**cameras, **{name: [*files] for name, files in related.items()}}
        about, read = self._with_found(about, lidars, cameras)
        if bare := [name for name in cameras if "K" not in about.get("cameras", {}).get(name, {})]:
            self.warn(f"{', '.join(bare)}: {CALIBRATION} does not state K{_unread_notes(path, read)}")
        for kind, sensors in (("lidars", lidars), ("cameras", cameras)):
            if unknown := sorted(about.get(kind, {}).keys() - sensors.keys()):
                names = f"there are {', '.join(sensors)}" if sensors else "there is none"
                names += others and f"; {others}"
                raise UserError(f"{path / CALIBRATION}: no {unknown[0]} among the {kind}; {names}")
        stamped = self._stamps({"lidars": lidars, "cameras": alone}, about)
        for name, clouds in related.items():
            alone[name] = [file for file, cloud in clouds.items() if cloud in stamped]
            stamped |= {file: stamped[clouds[file]] for file in alone[name]}
        cameras = alone
        edges, streams = [], list[Stream]()
        # Without a stated mounting, the only LiDAR's frame may be tilted.
        has_base = len(lidars) > 1 or (path / POSES).is_file() or any("pose" in s for s in _stated(about))
        unplaced = [name for name in lidars if "pose" not in about.get("lidars", {}).get(name, {})]
        if unplaced and len(unplaced) < len(lidars) and not (path / CALIBRATION).is_file():
            lidars = {name: files for name, files in lidars.items() if name not in unplaced}
            self.warn(
                f"{', '.join(unplaced)}: no calibration says how it is mounted beside {', '.join(lidars)}: "
                f"left out (pose in {CALIBRATION})"
            )
        elif len(lidars) > 1 and unplaced:
            self.warn(
                f"nothing says how {', '.join(unplaced)} {'are' if len(unplaced) > 1 else 'is'} mounted: the "
                f"points are taken as they are, in {BASE} (pose in {CALIBRATION})"
            )
        for name, files in cameras.items():
            files, times = _in_order(files, stamped)
            stated = about.get("cameras", {}).get(name, {})
            # Of a folder with clouds and images both have its name. Their frames must differ.
            frame = f"{name}_camera" if name in lidars else name
            if "pose" in stated:
                edges.append((BASE, frame, self._pose(stated["pose"], name)))
            if "K" in stated:
                streams.append(self._camera_info(frame, times, stated))
            streams.append(image_stream(frame, times, files, rectified=not LENS_KEYS & stated.keys()))
        for name, files in lidars.items():
            files, times = _in_order(files, stamped)
            stated = about.get("lidars", {}).get(name, {})
            fields = self._fields(stated.get("fields", about.get("fields")), files)
            self.check_sizes([file for file in files if file.suffix.lower() == ".bin"], 4 * len(fields))
            if has_base:
                pose = self._pose(stated["pose"], name) if "pose" in stated else np.eye(4)
                edges.append((BASE, name, pose))
            read_row = partial(_read_row, files, fields)
            streams.append(cloud_stream(f"/{name}/points", name, times, read_row, files))
            if len(lidars) == 1:
                truth = truth_streams(self.path, name, files, times)
                stems, labels = {file.stem for file in files}, files_in(self.path / LABELS, [".json"])
                if truth and (lost := [file for file in labels if file.stem not in stems]):
                    self.warn(f"{self._name_files(lost)}: not read: no cloud has this name")
                streams += truth
        if not bare and not any(stream.topic == "/ground_truth" for stream in streams):
            self._note_unread_labels({cloud.stem for clouds in lidars.values() for cloud in clouds}, read)
        self.streams = [*mounting_stream(min(stamped.values()), edges), *self._poses(), *streams]

    def _with_found(
        self, about: Mapping[str, Any], lidars: Collection[str], cameras: Collection[str]
    ) -> tuple[Mapping[str, Any], Sequence[Path]]:
        """Add to ``calibration.yaml`` what calibrations of other tools state. Return their files, too."""
        stated = about.get("cameras", {})
        if all({"K", "pose"} <= stated.get(name, {}).keys() for name in cameras):
            return about, ()
        files = list[Path]()
        for point in registered("calibrations").values():
            found: FoundCalibration = load(point)(self.path, lidars, cameras)
            for text in found.warnings:
                self.warn(text)
            files += found.files
            for kind, sensors in (("lidars", found.lidars), ("cameras", found.cameras)):
                known = about.get(kind, {})
                merged = {name: {**sensors.get(name, {}), **known.get(name, {})} for name in sensors | known}
                about = {**about, kind: merged} if merged else about
        if files:
            first = ", ".join(str(file.relative_to(self.path)) for file in files[:3])
            more = f" and {len(files) - 3} more" if len(files) > 3 else ""
            self.warn(f"calibrated by {first}{more}")
        return about, files

    def _note_unread_labels(self, scans: set[str], read: Collection[Path]) -> None:
        """Warn of a folder with a text file for each scan, as labels of most tools are."""
        folders = [inner for folder in subfolders(self.path) for inner in (folder, *subfolders(folder))]
        for folder in folders:
            files = [f for f in files_in(folder, NOTE_SUFFIXES) if scans & {f.stem, Path(f.stem).stem}]
            if files and not set(files) & set(read) and "calib" not in folder.name.lower():
                self.warn(
                    f"{self._name_files(files)}, named as the scans, not read: labels of plain folders are "
                    f"SUSTechPOINTS' in {LABELS}/, else a data set's (docs/inputs.md)"
                )

    def _sensors(self, about: Mapping[str, Any]) -> tuple[dict[str, list[Path]], dict[str, list[Path]]]:
        """Return the LiDARs and the cameras: files by sensor name."""
        sensors: dict[str, dict[str, list[Path]]] = {"lidars": {}, "cameras": {}}
        names, beside = _sensor_folders(self.path), dict[str, list[Path]]()
        for folder in names:
            for kind, suffixes, default in (("lidars", CLOUDS, "lidar"), ("cameras", IMAGES, "camera")):
                name = names[folder] or default
                if name in sensors[kind] or (folder == self.path and name in names.values()):
                    name = f"{(folder if folder == self.path else folder.parent).name}_{name}"
                files = _without_copies(files_in(folder, suffixes))
                if kind == "cameras":
                    files = list(self._camera_images(files))
                sensors[kind] |= self._split_by_sensor(name, files, about.get(kind, ()))
            if folder == self.path:
                beside = {} if sensors["lidars"] else dict(sensors["cameras"])
        pictures = [file for files in beside.values() for file in files]
        others = [files for name, files in sensors["cameras"].items() if name not in beside]
        if 0 < len(pictures) < max(map(len, others), default=0):
            sensors["cameras"] = {n: f for n, f in sensors["cameras"].items() if n not in beside}
            self.warn(f"{self._name_files(pictures)}: beside the folders of the cameras: left out")
        if broken := [file for folder in names for file in _broken_links(folder)]:
            self.warn(f"{self._name_files(broken)}: a link to what is not there")
        lidars = sensors["lidars"]
        for name in list(lidars) if len(lidars) > 1 else ():
            if reason := why_no_points(max(lidars[name], key=lambda file: file.stat().st_size)):
                self.warn(f"{self._name_files(lidars.pop(name))}: {reason}: left out")
        return lidars, sensors["cameras"]

    def _camera_images(self, files: Sequence[Path]) -> Sequence[Path]:
        """Leave out pictures that no camera took: a label image beside its JPEG, and a screenshot.

        A screenshot has another file type, name and size than the camera's images.
        """
        photos = {file.stem for file in files if file.suffix.lower() in (".jpg", ".jpeg")}
        files = [f for f in files if f.suffix.lower() != ".png" or f.stem not in photos]
        groups = dict[tuple[str, str], list[Path]]()
        for file in files:
            groups.setdefault((file.suffix.lower(), re.sub(r"\d+", "0", file.stem)), []).append(file)
        if not 1 < len(groups) <= MAX_SENSORS:
            return files
        suffix, name = max(groups, key=lambda group: (len(groups[group]), group[0] != ".png"))
        size = encoded_size(read_bytes(groups[suffix, name][0]))
        for (other_suffix, _), pictures in groups.items():
            if other_suffix != suffix and (other := encoded_size(read_bytes(pictures[0]))) != size:
                text = f"{other[0]} x {other[1]}, and the camera's images {size[0]} x {size[1]}"
                self.warn(f"{self._name_files(pictures)}: {text}: left out as no image of it")
                files = [file for file in files if file not in pictures]
        return files

    def _related_images(self, lidars: Mapping[str, Sequence[Path]]) -> dict[str, dict[Path, Path]]:
        """Return the images that lie in a folder for each cloud: by camera, with their clouds."""
        related = [
            (cloud, files_in(self.path / RELATED / cloud.name.replace(".", "_"), IMAGES))
            for clouds in lidars.values()
            for cloud in clouds
        ]
        single = all(len(images) < 2 for _, images in related)
        cameras = dict[str, dict[Path, Path]]()
        for cloud, images in related:
            for image in images:
                own_name = image.stem.replace(cloud.stem, "").strip("_-. ")
                cameras.setdefault("camera" if single else own_name or "camera", {})[image] = cloud
        return cameras

    def _split_by_sensor(
        self, sensor: str, files: Sequence[Path], stated: Collection[str]
    ) -> dict[str, list[Path]]:
        """Split the files of a folder by sensor. File names may show several sensors in one folder."""
        groups = group_by_sensor(files)
        if len(groups) > 1 and sensor not in stated:
            groups = {f"{sensor}_{name}" if name else sensor: members for name, members in groups.items()}
            self.warn(f"by the names of their files there are {', '.join(groups)}")
            return groups
        return {sensor: list(files)} if files else {}

    def _calibration(self) -> Mapping[str, Any]:
        """Return the content of ``calibration.yaml``; empty if there is none."""
        file = self.path / CALIBRATION
        if not file.is_file():
            return {}
        about = parse_yaml(read_text(file, CONFIG_LIMIT), str(file)) or {}
        if not isinstance(about, dict) or not all(
            isinstance(about.get(k, {}), dict) for k in ("lidars", "cameras")
        ):
            raise UserError(f"{file}: expected {', '.join(sorted(KEYS))}, see docs/inputs.md")
        stated = _stated(about)
        if any(not isinstance(sensor, dict) for sensor in stated):
            raise UserError(f"{file}: of a sensor {', '.join(sorted(SENSOR_KEYS))} can be stated")
        unknown = sorted(set(about) - KEYS) + sorted({key for s in stated for key in s} - SENSOR_KEYS)
        if unknown:
            known = ", ".join(sorted(KEYS | SENSOR_KEYS))
            raise UserError(f"{file}: {unknown[0]} is not known; there are {known}")
        return about

    def _fields(self, stated: Sequence[Any] | None, files: Sequence[Path]) -> list[str]:
        """Return the column names of BIN and NPY files, as stated or estimated from the largest BIN file.

        Raises:
            UserError: the file holds float64.
        """
        if stated is not None:
            if not isinstance(stated, list) or not {"x", "y", "z"} <= {*stated}:
                raise UserError(
                    f"{self.path / CALIBRATION}: fields: {stated} is no list with x, y and z in it"
                )
            return [str(name) for name in stated]
        fields = self.column_names(files, hint=f" (fields in {CALIBRATION})")
        shape = next((array_shape(file) for file in files if file.suffix.lower() == ".npy"), ())
        if len(shape) == 2 and len(fields) < shape[1] <= MAX_COLUMNS:
            fields += [f"field_{column}" for column in range(len(fields), shape[1])]
            self.warn(f"NPY files are taken for the columns {', '.join(fields)} (fields in {CALIBRATION})")
        return fields

    def _pose(self, values: Any, sensor: str) -> F64:
        """Return (4, 4) base_link_from_sensor from 7 or 16 numbers."""
        try:
            numbers = np.array(values, np.float64).reshape(-1)
            if len(numbers) == 16:
                pose = numbers.reshape(4, 4)
                rotation = pose[:3, :3]
                if (
                    not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
                    or np.linalg.det(rotation) < 0
                ):
                    raise ValueError("its upper left part is no rotation")
                if not np.allclose(pose[3], (0, 0, 0, 1)):
                    raise ValueError("its last row is not 0 0 0 1")
            elif len(numbers) != 7:
                raise ValueError(f"{len(numbers)} numbers")
            elif abs((length := np.linalg.norm(numbers[3:])) - 1) > UNIT_TOLERANCE:
                raise ValueError(f"its quaternion has the length {length:.2f}, not 1")
            else:
                pose = geometry.transform(numbers[:3], numbers[3:])
        except (TypeError, ValueError) as error:
            raise UserError(
                f"{self.path / CALIBRATION}: pose of {sensor}: {error}; expected x y z qx qy qz qw of the "
                "sensor in base_link, or 16 numbers of a matrix"
            ) from None
        if (away := np.abs(pose[:3, 3]).max()) > MAX_OFFSET:
            self.warn(f"{CALIBRATION}: {sensor} is {away:,.0f} m from {BASE}: a pose is in metres")
        return pose

    def _camera_info(self, name: str, times: I64, stated: Mapping[str, Any]) -> Stream:
        try:
            matrix = np.array(stated["K"], np.float64).reshape(3, 3)
            distortion = np.array(stated.get("D", ()), np.float64).reshape(-1)
            width, height = map(int, stated.get("size", (0, 0)))
            sides = (0 <= side < MAX_SIDE for side in (width, height))
            if not np.array_equal(matrix[2], (0, 0, 1)) or not all(sides):
                raise ValueError
        except (TypeError, ValueError):
            raise UserError(
                f"{self.path / CALIBRATION}: camera {name}: K needs 9 numbers, row by row (the last 0 0 1), "
                "D numbers, and size the width and height of the images that K is for"
            ) from None
        model = str(stated.get("distortion_model", "plumb_bob" if len(distortion) else ""))
        if model in geometry.FISHEYE and "D" not in stated:
            distortion = np.zeros(4)  # equidistant: r = f theta
        about = Intrinsics(width, height, matrix, model, distortion)
        return intrinsics_stream(name, times[:1], lambda _: about)

    def _stamps(
        self, sensors: Mapping[str, dict[str, list[Path]]], about: Mapping[str, Any]
    ) -> dict[Path, int]:
        """Return the stamp of each file in nanoseconds.

        A file without a time is removed from ``sensors`` with a warning.
        """
        all_sensors = [
            (kind, name, files) for kind, group in sensors.items() for name, files in group.items()
        ]
        if (self.path / STAMPS).is_file():
            return self._read_stamps(self.path / STAMPS, [files for _, _, files in all_sensors])
        lead = max(sensors["lidars"].items(), key=lambda item: len(item[1]))
        leading = file_times(lead[1])
        if leading is None:
            self.warn(
                f"names without a number: the files are taken in their order, at {_rate(about):g} a second"
            )
        elif leading.frames:
            self.warn(
                f"the names are no stamps: taken for frame numbers, at {_rate(about):g} a second "
                f"(rate in {CALIBRATION})"
            )
        lead_values = leading.values if leading else dict.fromkeys(lead[1], 0)
        stamped = dict[Path, int]()
        by_stem = {file.stem: number for number, file in enumerate(lead[1])}
        for kind, name, files in all_sensors:
            times = file_times(files)
            stated = about.get(kind, {}).get(name, {})
            rate = _rate(about, stated)
            if leading and times and times.frames == leading.frames:
                numbers = times.values
                if times.note:
                    self.warn(f"the names {times.note}")
                if times.frames and "rate" not in stated:
                    self._check_frame_range(lead[0], leading.values, name, numbers)
            elif not leading and {file.stem for file in files} <= by_stem.keys():
                numbers = {file: by_stem[file.stem] for file in files}
            elif not leading:
                numbers = {file: i for i, file in enumerate(files)}
            elif len(files) == len(lead_values):
                ordered = sorted(files, key=lambda file: (times.values.get(file, -1) if times else 0, file))
                numbers = dict(zip(ordered, sorted(lead_values.values()), strict=True))
                rate = _rate(about, about.get("lidars", {}).get(lead[0], {}))
                self.warn(
                    f"{name}: its names do not tell when, as those of {lead[0]} do: taken in their order, "
                    "one for each"
                )
            else:
                numbers = {}
            if undated := [file for file in files if file not in numbers]:
                self.warn(
                    f"{self._name_files(undated)}: the name does not tell when it was taken, as those of "
                    f"{lead[0]} do: left out ({STAMPS} can say it)"
                )
                sensors[kind][name] = [file for file in files if file in numbers]
                if not sensors[kind][name]:
                    del sensors[kind][name]
            if leading and not leading.frames:
                stamped |= numbers
            else:
                stamped |= zip(numbers, frame_stamps(rate, list(numbers.values())).tolist(), strict=True)
        return stamped

    def _check_frame_range(
        self, lead: str, frames: Mapping[Path, int], name: str, numbers: Mapping[Path, int]
    ) -> None:
        """Warn if the frame numbers of a sensor reach much further than those of the LiDAR."""
        (first, last), (start, end) = [(min(n.values()), max(n.values())) for n in (frames, numbers)]
        if min(len(frames), len(numbers)) >= MIN_FRAMES and end - start > FRAME_RATIO * (last - first + 1):
            self.warn(
                f"{name} has the frames {start} to {end}, {lead} {first} to {last}: taken for the same; "
                f"where it counts its own, its rate can be stated ({CALIBRATION})"
            )

    def _read_stamps(self, table: Path, sensors: Sequence[Sequence[Path]]) -> dict[Path, int]:
        """Return the stamps in ``stamps.csv``."""
        stamp_texts = dict[Path, str]()
        for number, row in enumerate(_csv_rows(table), 1):
            if len(row) < 2 or (number == 1 and not re.search(r"\d", row[1])):
                continue
            name, stamp, *more = map(str.strip, row)
            if not re.fullmatch(STAMP, stamp):
                raise UserError(f"{table}: line {number}: '{stamp}' is no stamp")
            if more and SECONDS.fullmatch(stamp) and NANOSECONDS.fullmatch(more[0]):
                stamp = f"{stamp}.{more[0]:0>9}"
            stamp_texts[self.path / name] = stamp
        if missing := [file for files in sensors for file in files if file not in stamp_texts]:
            raise UserError(f"{table}: no stamp for {missing[0].relative_to(self.path)}")
        stamped = dict[Path, int]()
        for files in sensors:
            stamped |= zip(files, stamps_in([stamp_texts[file] for file in files]), strict=True)
        return stamped

    def _poses(self) -> list[Stream]:
        """Return the stream of vehicle poses. A line has stamp x y z qx qy qz qw."""
        file = self.path / POSES
        if not file.is_file():
            return []
        first = next((line for line in read_lines(file, TABLE_LIMIT) if line.strip()), "")
        if len(first.split()) == 12:
            self.warn(f"{POSES} has 12 numbers in a line, as KITTI's, and no stamps: it is not used")
            return []
        table = read_table(file, 8, "stamp x y z qx qy qz qw")
        table = table[np.argsort(table[:, 0], kind="stable")]
        if table[:, 0].max(initial=0) < MAX_SECONDS:
            times = np.round(table[:, 0] * 1e9).astype(np.int64)
        else:
            times = np.array(stamps_in([f"{stamp:.0f}" for stamp in table[:, 0]]), np.int64)
        pose = pose_stream(times, BASE, lambda row: geometry.transform(table[row, 1:4], table[row, 4:]))
        return [pose]


def _csv_rows(table: Path) -> Iterator[list[str]]:
    try:
        yield from csv.reader(read_lines(table, TABLE_LIMIT))
    except csv.Error as error:
        raise UserError(f"{table}: is no CSV: {error}") from None


def _stated(about: Mapping[str, Any]) -> list[Any]:
    """Return the stated calibration of each sensor."""
    return [sensor for kind in ("lidars", "cameras") for sensor in about.get(kind, {}).values()]


def _rate(*stated: Mapping[str, Any]) -> float:
    """Return the frames per second that the last of these mappings states.

    Raises:
        UserError: the value is no number, or no sensor has this rate.
    """
    rate = next((about["rate"] for about in reversed(stated) if "rate" in about), 10.0)
    if not isinstance(rate, int | float) or not MIN_RATE <= rate <= 1 / MIN_RATE:
        raise UserError(f"{CALIBRATION}: rate is {rate}, not frames a second")
    return float(rate)


def _sensor_folders(path: Path) -> dict[Path, str]:
    """Return the possible sensor folders with sensor names.

    They are the folder, its subfolders, and the subfolders of camera or LiDAR folders.
    """
    names = {path: "", **{folder: folder.name for folder in subfolders(path)}}
    for folder in [folder for folder, name in names.items() if SENSOR_FOLDER.match(name)]:
        for within in subfolders(folder):
            names[within] = folder.name if within.name == "data" else within.name
    return {folder: name for folder, name in names.items() if not DRIVE_FOLDER.match(name)}


def _unread_notes(path: Path, read: Collection[Path]) -> str:
    """Return a clause about calibrations and labels of other programs, which are not read; empty: none."""
    folders = [path, *(inner for folder in subfolders(path) for inner in (folder, *subfolders(folder)))]
    files = [file for folder in folders for file in files_in(folder, NOTE_SUFFIXES)]
    files = [file for file in files if file.name not in (CALIBRATION, STAMPS, POSES) and file not in read]
    if not files:
        return ""
    named = files[0].relative_to(path)
    return (
        f"; {named} is not read" if len(files) == 1 else f"; {named} and {len(files) - 1} more are not read"
    )


def _without_copies(files: Sequence[Path]) -> list[Path]:
    """Leave out a BIN file next to one of its name that states its columns: it is the same scan."""
    stems = {file.stem for file in files if file.suffix.lower() in (".pcd", ".ply")}
    return [file for file in files if file.suffix.lower() != ".bin" or file.stem not in stems]


def _broken_links(folder: Path) -> list[Path]:
    return files_in(folder, (*CLOUDS, *IMAGES), lambda entry: entry.is_symlink() and not entry.is_file())


def _in_order(files: Sequence[Path], stamped: Mapping[Path, int]) -> tuple[list[Path], I64]:
    ordered = sorted(files, key=lambda file: stamped[file])
    return ordered, np.array([stamped[file] for file in ordered], np.int64)


def _read_row(files: Sequence[Path], fields: Sequence[str], row: int) -> tuple[NDArray[np.void], int]:
    return read_cloud(files[row], fields)
