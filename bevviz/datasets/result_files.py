"""Files with the results of a detector, as boxes of a drive's frames: KITTI, nuScenes, COCO, Parquet, CSV."""

from __future__ import annotations

import json
import re
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from bevviz.datasets.dataset import NOT_AS_DOCUMENTED, describe_error, files_in
from bevviz.datasets.kitti_labels import TURN, Calibration, labelled_boxes
from bevviz.errors import UserError, first_line
from bevviz.messages.foreign_boxes import BoxRow, box_columns, boxes_2d, boxes_3d
from bevviz.messages.topics import RESULT_TOPICS, Topic
from bevviz.model import geometry
from bevviz.model.class_names import NUSCENES_CLASSES
from bevviz.model.frame import F64, Frame, LabelledBoxes2D, LabelledBoxes3D
from bevviz.stages.detector.names import COCO_CATEGORIES
from bevviz.support.files import read_text
from bevviz.support.limits import JSON_LIMIT, TABLE_LIMIT

BOXES_3D, BOXES_2D = "vision_msgs/msg/Detection3DArray", "vision_msgs/msg/Detection2DArray"
NUMBER = re.compile(r"(\d+)\D*$")
ROBOFLOW = re.compile(r"_[A-Za-z]+\.rf\.\w+$")  # frame_000012_png.rf.0a1b2c, as Roboflow names copies
BOX_COLUMNS = ("x", "y", "z", "length", "width", "height", "yaw")
IMAGE_COLUMNS = ("x0", "y0", "x1", "y1")
NAME_COLUMNS = ("name", "label", "class", "class_name")
EXPECTED = (
    "a folder of KITTI's text files, a JSON of nuScenes or COCO, or a Parquet or CSV table with the columns "
    f"frame, name, score and {' '.join(BOX_COLUMNS)} (of the points) or {' '.join(IMAGE_COLUMNS)}"
)
Labelled = LabelledBoxes3D | LabelledBoxes2D


class ResultFile(ABC):
    """Results of a detector for the frames of a drive.

    Args:
        name: name that the user gave.
        path: file or folder.

    Attributes:
        topic: topic that the results appear on.
        numbers: numbers of the frames with a result, also of frames that the drive lacks.
        frames: those of the drive.
    """

    is_2d = False

    def __init__(self, name: str, path: Path) -> None:
        self.topic, self.path = RESULT_TOPICS + name, path
        self.numbers: Collection[int] = ()
        self.frames: Sequence[int] = ()

    @property
    def described(self) -> Topic:
        """The topic, as one of a bag."""
        return Topic(self.topic, BOXES_2D if self.is_2d else BOXES_3D, len(self.frames))

    @abstractmethod
    def of(self, frame: Frame) -> Labelled | None:
        """Return the boxes of a frame; None: the file has no results for it.

        Raises:
            UserError: the results cannot be used.
        """

    def placed(self, frame: Frame, rows: Sequence[BoxRow]) -> LabelledBoxes3D:
        """Return boxes in the frame of the points. Raise ValueError if there are too many."""
        columns = box_columns(rows, 10)
        boxes = boxes_3d(columns, self.topic, frame.received, frame.stamp, frame.points_frame)
        scores = np.array([row.score for row in rows], np.float32)[columns.usable]  # 0 is a score here
        return replace(boxes, scores=scores, turns=None, world_from_boxes=frame.pose)

    def in_image(
        self, frame: Frame, xyxy: Any, labels: Sequence[str], scores: Any, camera: str
    ) -> LabelledBoxes2D:
        """Return boxes in the image of a camera. Raise ValueError if there are too many."""
        corners = np.asarray(xyxy, np.float64).reshape(-1, 4)
        low, high, zero = corners[:, :2], corners[:, 2:], np.zeros((len(corners), 1))
        numbers = np.hstack([(low + high) / 2, zero, high - low, zero])
        columns = box_columns(_box_rows(numbers, labels, scores), 6)
        boxes = boxes_2d(columns, self.topic, frame.received, frame.stamp, "")
        return replace(boxes, scores=np.asarray(scores, np.float32)[columns.usable], camera=camera)


def _box_rows(numbers: F64, labels: Sequence[str], scores: Any) -> list[BoxRow]:
    return [BoxRow(*row) for row in zip(map(tuple, numbers.tolist()), labels, scores, strict=True)]


def open_results(
    results: Mapping[str, str],
    drive: Path,
    scans: int,
    samples: Mapping[str, int],
    tell: Callable[[str], object],
) -> list[ResultFile]:
    """Open the files of ``source.results``.

    Args:
        results: file or folder by name.
        drive: path of the drive, whose scans may have names.
        scans: number of scans.
        samples: stamp of each sample of nuScenes by token.
        tell: receives a warning if a file has results of frames beyond the drive.

    Raises:
        UserError: a file is missing, of no known kind, counts frames from 1, or has no result for any frame.
    """
    opened = []
    numbered = f"those of this drive from 0 to {scans - 1}"
    for name, text in results.items():
        path = Path(text).expanduser()
        file = _open(name, path, drive, scans, samples)
        if not file.frames:
            lost = f"no result in it is of one of the {scans} frames of this drive"
            if isinstance(file, NuScenesResults) and not samples:
                lost = "its results are of nuScenes' samples, which the drive lacks"
            raise UserError(f"--results {path}: {lost}")
        last = max(file.numbers, default=0)
        if last == scans and 0 not in file.numbers:
            raise UserError(
                f"--results {path}: its frames are numbered to {last}, {numbered}: number them from 0"
            )
        if last >= scans:
            tell(f"--results {path}: its frames are numbered to {last}, {numbered}: is it of another drive?")
        opened.append(file)
    return opened


def results_are_2d(path: Path) -> bool:
    """Tell whether a file has image boxes alone. The drive is not needed for that."""
    return _open("", path, Path(), 1 << 40, {}).is_2d


def _open(name: str, path: Path, drive: Path, scans: int, samples: Mapping[str, int]) -> ResultFile:
    """Open a file of any kind.

    Raises:
        UserError: the file is missing, of no known kind, or not as documented.
    """
    try:
        return _open_as_documented(name, path, drive, scans, samples)
    except NOT_AS_DOCUMENTED as error:
        raise UserError(f"--results {path}: is not as documented ({describe_error(error)})") from error


def _open_as_documented(
    name: str, path: Path, drive: Path, scans: int, samples: Mapping[str, int]
) -> ResultFile:
    if not path.exists():
        raise UserError(f"--results {path}: no such file or folder; expected {EXPECTED}")
    if path.is_dir() or path.suffix == ".txt":
        return KittiResults(name, path, drive, scans)
    if path.suffix.lower() in (".parquet", ".csv", ".feather"):
        return TableResults(name, path, scans)
    if path.suffix.lower() != ".json":
        raise UserError(f"--results {path}: is not read; expected {EXPECTED}")
    state = path.stat()
    try:
        tree = _read_json(path, state.st_size, state.st_mtime_ns)
    except ValueError as error:
        raise UserError(f"--results {path}: is no JSON: {first_line(error)}") from None
    if isinstance(tree, dict) and isinstance(tree.get("results"), dict):
        return NuScenesResults(name, path, tree["results"], samples)
    return CocoResults(name, path, tree, drive, scans)


@lru_cache(maxsize=1)
def _read_json(path: Path, size: int, mtime: int) -> Any:
    """Read a file that a command opens several times: for its kind, and for each source of frames."""
    return json.loads(read_text(path, JSON_LIMIT))


# --- KITTI -------------------------------------------------------------------------------------


class KittiResults(ResultFile):
    """Text files in KITTI's label format, with the score as the 16th column; one file for each frame.

    Boxes are in the rectified frame of the reference camera. The calibration is that of the drive
    (``calib``), else of the folder beside the results, else the pose of the first camera.
    """

    def __init__(self, name: str, path: Path, drive: Path, scans: int) -> None:
        super().__init__(name, path)
        files = files_in(path, [".txt"]) if path.is_dir() else [path]
        if not files:
            raise UserError(f"--results {path}: no .txt file in it; expected {EXPECTED}")
        numbers = _scan_numbers(drive)
        self._files = {}
        for file in files:
            number = numbers.get(file.stem) if numbers else _number(file.stem)
            if number is not None:
                self._files[number] = file
        self.numbers, self.frames = self._files, sorted(n for n in self._files if n < scans)
        self._calibrations = drive / "calib", path.parent / "calib", path.parent.parent / "calib"
        first = files[len(files) // 2]
        rows = [row for line in read_text(first).splitlines() if (row := line.split())]
        if wrong := [row for row in rows if len(row) < 15]:
            raise UserError(
                f"--results {first}: a line has {len(wrong[0])} columns, a result of KITTI has 16"
            )
        self.is_2d = bool(rows) and all(len(row) > 10 and float(row[8]) <= 0 for row in rows)

    def of(self, frame: Frame) -> Labelled | None:
        """Return the boxes of a frame."""
        file = self._files.get(frame.index)
        if file is None:
            return None
        lines = list(enumerate(read_text(file).splitlines(), 1))
        camera = frame.cameras[0].name if frame.cameras else ""
        if self.is_2d:
            rows = [line.split() for _, line in lines if line.strip()]
            corners = [[float(value) for value in row[4:8]] for row in rows]
            scores = [float(row[15]) if len(row) > 15 else 1.0 for row in rows]
            return self.in_image(frame, corners, [row[0] for row in rows], scores, camera)
        labelled = labelled_boxes(file, lines, self._rectified_from_points(frame, file))
        placed = replace(
            labelled, topic=self.topic, stamp=frame.stamp, frame_id=frame.points_frame, image=None
        )
        return replace(placed, world_from_boxes=frame.pose, received=frame.received)

    def _rectified_from_points(self, frame: Frame, file: Path) -> F64:
        """Return the (4, 4) transform to the frame of KITTI's boxes."""
        for folder in self._calibrations:
            if (folder / file.name).is_file():
                cloud = frame.points_from_clouds[0] if frame.points_from_clouds else np.eye(4)
                rectified_from_lidar = Calibration(folder / file.name).rectified_from_lidar
                return np.asarray(rectified_from_lidar @ geometry.inverse(cloud), np.float64)
        for camera in frame.cameras:
            if camera.camera_from_points is not None:
                return camera.camera_from_points
        raise UserError(f"{file}: boxes in a camera's frame, and no camera of the drive is placed")


# --- JSON --------------------------------------------------------------------------------------


class NuScenesResults(ResultFile):
    """Results as nuScenes' detection challenge defines them: boxes in the map, by the token of the sample."""

    def __init__(self, name: str, path: Path, results: Mapping[str, Any], samples: Mapping[str, int]) -> None:
        super().__init__(name, path)
        self._by_stamp = {samples.get(token, 0): rows for token, rows in results.items() if token in samples}
        self.frames = range(len(self._by_stamp))

    def of(self, frame: Frame) -> Labelled | None:
        """Return the boxes of a frame."""
        rows = self._by_stamp.get(frame.stamp)
        if rows is None:
            return None
        boxes = []
        for row in rows:
            name, (w, *xyz) = row["detection_name"], row["rotation"]
            width, length, height = row["size"]
            numbers = (*row["translation"], length, width, height, *xyz, w)
            score = float(row.get("detection_score", 1.0))
            boxes.append(BoxRow(numbers, NUSCENES_CLASSES.get(name, name), score))
        return replace(self.placed(frame, boxes), world_from_boxes=np.eye(4))


class CocoResults(ResultFile):
    """Image boxes as COCO defines results (a list), or a whole data set with ``images`` and ``annotations``.

    The number at the end of an image's file name is that of its frame, else its ``image_id``.
    """

    is_2d = True

    def __init__(self, name: str, path: Path, tree: Any, drive: Path, scans: int) -> None:
        super().__init__(name, path)
        about = tree if isinstance(tree, dict) else {}
        rows = about.get("annotations", about.get("predictions")) if about else tree
        if not isinstance(rows, list) or not all(isinstance(row, dict) and "bbox" in row for row in rows):
            raise UserError(f"--results {path}: neither results of nuScenes nor of COCO")
        self._names = {int(row["id"]): str(row["name"]) for row in about.get("categories", ())}
        images = {image["id"]: str(image["file_name"]) for image in about.get("images", ())}
        self._rows: dict[int, list[Mapping[str, Any]]] = defaultdict(list)
        files, numbers = dict[tuple[int, Path], str](), _scan_numbers(drive)
        for row in rows:
            file = images.get(row["image_id"], str(row["image_id"]))
            stem = ROBOFLOW.sub("", Path(file).stem)
            number = numbers.get(stem, _number(stem))
            if number is None:
                continue
            if (other := files.setdefault((number, Path(file).parent), file)) != file:
                raise UserError(
                    f"--results {path}: {other} and {file} both end in {number}, the number of their frame"
                )
            self._rows[number].append({**row, "folder": Path(file).parent.name})
        self.numbers, self.frames = self._rows, sorted(n for n in self._rows if n < scans)

    def of(self, frame: Frame) -> Labelled | None:
        """Return the boxes of a frame. Images in folders are those of the cameras with these names."""
        rows = self._rows.get(frame.index)
        if rows is None:
            return None
        cameras = [camera.name for camera in frame.cameras]
        of_cameras = [row["folder"] for row in rows if row["folder"] in cameras]
        camera = of_cameras[0] if of_cameras else (cameras or [""])[0]
        rows = [row for row in rows if row["folder"] == camera] if of_cameras else rows
        box = np.array([row["bbox"] for row in rows], np.float32).reshape(-1, 4)
        labels = [self._names.get(row["category_id"]) or _coco_name(row["category_id"]) for row in rows]
        xyxy = np.column_stack([box[:, :2], box[:, :2] + box[:, 2:]])
        return self.in_image(frame, xyxy, labels, [row.get("score", 1.0) for row in rows], camera)


# --- tables ------------------------------------------------------------------------------------


class TableResults(ResultFile):
    """Table with a row for each box: frame, name, score, and the box in the frame of the points or an image.

    The columns are those of ``objects.to_pandas()`` and ``detections.to_pandas()``, with the frame's number.
    """

    def __init__(self, name: str, path: Path, scans: int) -> None:
        super().__init__(name, path)
        table = _read_table(path)
        columns = set(table.column_names)
        self._name = next((column for column in NAME_COLUMNS if column in columns), "")
        self.is_2d = not columns.issuperset(BOX_COLUMNS)
        box = IMAGE_COLUMNS if self.is_2d else BOX_COLUMNS
        if "frame" not in columns or not self._name or not columns.issuperset(box):
            raise UserError(
                f"--results {path}: its columns are {', '.join(sorted(columns))}; expected {EXPECTED}"
            )
        used = ["frame", self._name, *box, *(columns & {"score", "camera"})]
        self._columns = {column: table.column(column).to_numpy() for column in used}
        for name in {*box, "score"} & self._columns.keys():
            self._columns[name] = self._columns[name].astype(np.float64)
        if not self.is_2d and (largest := np.abs(self._columns["yaw"]).max(initial=0)) > TURN:
            raise UserError(
                f"--results {path}: a yaw of {largest:g} is no angle in radians: is it in degrees?"
            )
        numbers = self._columns["frame"].astype(np.int64)
        self._rows = {int(n): np.flatnonzero(numbers == n) for n in np.unique(numbers)}
        self.numbers, self.frames = self._rows, sorted(n for n in self._rows if 0 <= n < scans)

    def of(self, frame: Frame) -> Labelled | None:
        """Return the boxes of a frame."""
        rows = self._rows.get(frame.index)
        if rows is None:
            return None
        values = {name: column[rows] for name, column in self._columns.items()}
        labels = [str(label) for label in values[self._name]]
        scores = values.get("score", np.ones(len(rows)))
        box = np.stack([values[name] for name in (IMAGE_COLUMNS if self.is_2d else BOX_COLUMNS)], axis=1)
        if not self.is_2d:
            half = box[:, 6:] / 2
            numbers = np.hstack([box[:, :6], np.zeros((len(box), 2)), np.sin(half), np.cos(half)])
            return self.placed(frame, _box_rows(numbers, labels, scores))
        names = [str(name) for name in values.get("camera", ())]
        camera = names[0] if names else next((camera.name for camera in frame.cameras), "")
        return self.in_image(frame, box, labels, scores, camera)


def _read_table(path: Path) -> Any:
    """Read a table of Arrow."""
    import pyarrow
    import pyarrow.csv as csv
    from pyarrow import feather, parquet

    try:
        if path.suffix.lower() == ".csv":
            read_text(path, TABLE_LIMIT)  # It must be text of a usual size.
            table = csv.read_csv(str(path))
            return table.rename_columns([name.strip() for name in table.column_names])
        return (
            feather.read_table(str(path)) if path.suffix.lower() == ".feather" else parquet.read_table(path)
        )
    except (OSError, ValueError, pyarrow.ArrowException) as error:
        raise UserError(f"--results {path}: cannot be read as a table: {first_line(error)}") from None


def _scan_numbers(drive: Path) -> Mapping[str, int]:
    """Return the number of each scan of a data set like KITTI's by the name of its files."""
    return {file.stem: number for number, file in enumerate(files_in(drive / "velodyne", [".bin"]))}


def _number(text: str) -> int | None:
    """Return the number at the end of a name; None if there is none."""
    match = NUMBER.search(text)
    return int(match[1]) if match and len(match[1]) < 19 else None


def _coco_name(category: int) -> str:
    """Return the name of one of COCO's 91 categories."""
    return COCO_CATEGORIES[category] if 0 < category < len(COCO_CATEGORIES) else f"class_{category}"
