"""Comparison of two saved runs. Their results are read from the recordings and paired by stamp."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk, RrdReader

from bevviz.compare.differences import FrameDifferences, ImageBoxes, SideResult, differences
from bevviz.compare.log import DifferenceLogger
from bevviz.compare.summary import ComparisonSummary
from bevviz.config import changes, flat_yaml
from bevviz.errors import UserError
from bevviz.model import geometry
from bevviz.model.frame import F64, Boxes3D, Scene
from bevviz.model.protocols import Items, Observer
from bevviz.recording import entities
from bevviz.recording.images import log_over_shared_image
from bevviz.recording.primitives import CORNER
from bevviz.recording.rerun_cli import check_decodes, reader_errors_as_user_errors
from bevviz.recording.writer import Writer

Row = Mapping[str, Any]


@dataclass(slots=True)
class SavedFrame:
    """Results of one frame in a recording, as far as they are compared."""

    index: int = -1  # -1: not a frame of the run
    received: int = 0
    fused: Row = field(default_factory=dict)
    detections: dict[str, Row] = field(default_factory=dict)  # by camera; only cameras with detections
    detected: bool = False
    clusters: int | None = None

    @property
    def world_from_points(self) -> F64:
        """Pose (4, 4) of the points in the fixed frame."""
        if "Transform3D:translation" not in self.fused:
            return np.eye(4)
        return geometry.transform(
            np.array(self.fused["Transform3D:translation"][0]),
            np.array(self.fused["Transform3D:quaternion"][0]),
        )

    def seen(self, cameras: Sequence[str]) -> SideResult:
        """Return the results as one side of a comparison."""
        boxes, names, scores = _boxes(self.fused)
        images = {camera: _image_boxes(self.detections.get(camera, {})) for camera in cameras}
        return SideResult(boxes, names, scores, images if self.detected else {}, self.clusters)


class SavedRun:
    """Recording made by bevviz, read once.

    Raises:
        UserError: the recording cannot be read, or is not from bevviz.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.frames: dict[int, SavedFrame] = {}  # by stamp
        self._property: Row = {}
        if not path.is_file():
            raise UserError(f"{path}: {'it is no file' if path.exists() else 'no such file'}")
        check_decodes(path)
        with reader_errors_as_user_errors(path):
            for chunk in self.stream():
                self._read(chunk)
        if not self._property:
            raise UserError(f"{path}: no recording of bevviz: it does not say how it was made")
        self.frames = {stamp: frame for stamp, frame in self.frames.items() if frame.index >= 0}
        self.cameras = tuple(self._property.get("cameras") or ())
        self.lidars = tuple(self._property.get("lidars") or ())

    @property
    def name(self) -> str:
        """Name of the run: file, preset and version."""
        return f"{self.path} ({self._property['preset'][0]}, {self._property['versions'][0]})"

    @property
    def scene(self) -> Scene:
        """Names of the drive, its LiDARs and cameras."""
        lidar = "lidars" if len(self.lidars) > 1 else "".join(self.lidars)
        return Scene(self._property["source"][0], lidar, self.lidars, self.cameras)

    @property
    def config(self) -> Mapping[str, Any]:
        """Configuration of the run as dotted keys and values."""
        return flat_yaml(self._property["config"][0], str(self.path))

    def stream(self) -> Iterator[Chunk]:
        """Yield the chunks of the run, without the results of a comparison."""
        added = [f"{root}/**" for root in (entities.B, entities.COMPARE)]
        yield from RrdReader(self.path).stream().drop(content=added)

    def _read(self, chunk: Chunk) -> None:
        path = chunk.entity_path
        if path == f"/__properties/{entities.PROPERTY}":
            self._property = _rows(chunk)[0]
            return
        detections = entities.DETECTIONS.path("*").split("*")
        of_image = path.startswith(detections[0]) and path.endswith(detections[1])
        scalar_paths = (
            entities.FUSED,
            entities.EXPLAIN,
            *(entities.COUNT.path(c) for c in ("clusters", "detections")),
        )
        if chunk.is_static or not (of_image or path in scalar_paths):
            return
        for row in _rows(chunk):
            frame = self.frames.setdefault(row[entities.STAMP], SavedFrame())
            if path == entities.EXPLAIN:
                frame.index, frame.received = row[entities.FRAME], row.get(entities.RECEIVED) or 0
            elif path == entities.FUSED:
                frame.fused = row
            elif of_image:
                frame.detections[path.removeprefix(detections[0]).removesuffix(detections[1])] = row
            elif path == entities.COUNT.path("detections"):
                frame.detected = True
            else:
                frame.clusters = int(row["Scalars:scalars"][0])


@dataclass(frozen=True, slots=True)
class SavedFrames:
    """Results of two runs for one frame, and their differences."""

    a: SavedFrame
    b: SavedFrame
    found: FrameDifferences


class SavedPair:
    """Old and new run. Iterate over it to get the stamps of their common frames.

    Raises:
        UserError: a recording cannot be used, or they have no frame in common.
    """

    def __init__(self, old: Path, new: Path) -> None:
        self.a, self.b = SavedRun(old), SavedRun(new)
        self._stamps = sorted(self.a.frames.keys() & self.b.frames.keys())
        if not self._stamps:
            raise UserError(
                f"{old} and {new} have no scan in common: none of {len(self.a.frames)} stamps is among "
                f"{len(self.b.frames)}"
            )
        self.summary = ComparisonSummary((self.a.name, self.b.name), changes(self.a.config, self.b.config))

    @property
    def scene(self) -> Scene:
        """Names of the old run's drive, LiDARs and cameras."""
        return self.a.scene

    @property
    def total(self) -> int:
        """Number of common frames."""
        return len(self._stamps)

    @property
    def warnings(self) -> Sequence[str]:
        """One sentence for each run with frames that the other one lacks."""
        both = len(self._stamps)
        return [
            f"{run.path}: {len(run.frames) - both} of {len(run.frames)} frames are not in the other one"
            for run in (self.a, self.b)
            if len(run.frames) > both
        ]

    def __iter__(self) -> Iterator[int]:
        return iter(self._stamps)

    def perceive(self, stamp: int, network: Executor | None = None) -> SavedFrames:
        """Compare the runs at one of the stamps."""
        a, b = self.a.frames[stamp], self.b.frames[stamp]
        frame_differences = differences(a.index, stamp, a.seen(self.a.cameras), b.seen(self.b.cameras))
        return SavedFrames(a, b, frame_differences)

    def finish(self, frames: SavedFrames) -> SavedFrames:
        """Return the frames as they are."""
        return frames


class SavedPairRecorder(Observer[SavedFrames]):
    """Observer that copies both runs to a recording, the new one under ``/b``, and logs their differences."""

    def __init__(self, recording: rr.RecordingStream, pair: SavedPair) -> None:
        self._recording, self._pair = recording, pair

    def begin(self, items: Items[object]) -> None:
        """Copy both runs."""
        recording, pair = self._recording, self._pair
        recording.send_chunks(pair.a.stream())
        recording.send_chunks(_under_b(pair.b))
        writer_b = Writer(recording, entities.B)
        for camera in pair.b.cameras:
            log_over_shared_image(writer_b, camera)
        self._differences = DifferenceLogger(recording, pair.summary.names, pair.summary.about)

    def observe(self, frames: SavedFrames) -> None:
        """Log the differences of a frame."""
        posed = frames.a if frames.a.fused else frames.b
        self._differences.log(frames.found, frames.a.received, posed.world_from_points)


def _under_b(run: SavedRun) -> Iterator[Chunk]:
    """Yield the run's results, moved to ``/b``. The data of sensors and robot are those of the old run."""
    input_paths = {entities.TRUTH, *(entities.POINTS.path(lidar) for lidar in run.lidars)}
    for camera in run.cameras:
        input_paths |= {entities.SENSOR.path(camera), entities.IMAGE.path(camera)}
    property_path = f"/__properties/{entities.PROPERTY}"
    roots = (entities.WORLD, entities.EXPLAIN, entities.BEV, entities.HEALTH, entities.CONFIG)
    for chunk in run.stream():
        path = chunk.entity_path
        if path == property_path:
            yield chunk.with_entity_path(property_path + entities.B.replace("/", "_"))
        elif path not in input_paths and any(path == root or path.startswith(f"{root}/") for root in roots):
            yield chunk.with_entity_path(entities.B + path)


def _rows(chunk: Chunk) -> list[Row]:
    """Return the logged rows without null values. Times are integers."""
    batch = chunk.to_record_batch()
    clocks = set(chunk.timeline_names) - {entities.FRAME}
    batch = batch.cast(pa.schema([f.with_type(pa.int64()) if f.name in clocks else f for f in batch.schema]))
    names = [name for name in batch.schema.names if not name.startswith("rerun.controls")]
    rows = batch.select(names).to_pylist()
    return [{name: value for name, value in row.items() if value is not None} for row in rows]


def _boxes(row: Row) -> tuple[Boxes3D, tuple[str, ...], np.ndarray[Any, np.dtype[np.float32]]]:
    if not row.get("Boxes3D:centers"):
        return Boxes3D.empty(), (), np.zeros(0, np.float32)
    quaternions = np.array(row["Boxes3D:quaternions"], np.float32)
    boxes = Boxes3D(
        np.array(row["Boxes3D:centers"], np.float32),
        np.array(row["Boxes3D:half_sizes"], np.float32) * 2,
        2 * np.arctan2(quaternions[:, 2], quaternions[:, 3]),
    )
    return boxes, tuple(row["class_name"]), np.array(row["score"], np.float32)


def _image_boxes(row: Row) -> ImageBoxes:
    if not row.get("Boxes2D:centers"):
        return ImageBoxes.empty()
    centers = np.array(row["Boxes2D:centers"], np.float32) - CORNER
    half_sizes = np.array(row["Boxes2D:half_sizes"], np.float32)
    names = tuple(label.rpartition(" ")[0] for label in row["Boxes2D:labels"])  # the score follows the name
    return ImageBoxes(np.hstack([centers - half_sizes, centers + half_sizes]), names)
