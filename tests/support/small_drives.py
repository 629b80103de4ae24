"""Simulated drives of few beams and pixels, with detections that the simulator knows."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np

from bevviz.config import Config
from bevviz.extras.demo.drive import Snapshot, SyntheticSource
from bevviz.extras.demo.sensors import Lidar, PinholeCamera
from bevviz.model import geometry
from bevviz.model.frame import F32, Camera
from bevviz.model.results import Detections, DetectionState
from bevviz.pipeline.stage_loader import DetectFunction, StageLoader, Stages

APART = 3  # every third frame of the street is taken, so that a short drive shows more of it
LIDARS = ((24, 700), (32, 900), (40, 1000))  # beams and azimuths
CAMERA = 256, 144, 176.0  # pixels
LEAST_PIXELS = 6  # of an object that has a detection

Candidates: TypeAlias = tuple[F32, F32, list[str]]  # boxes, scores and names


def source(seed: int, frames: int) -> SyntheticSource:
    lidar, camera = Lidar(*LIDARS[seed % len(LIDARS)]), PinholeCamera(*CAMERA)
    return SyntheticSource(frames * APART, seed, lidar=lidar, camera=camera)


def snapshots(drive: SyntheticSource, frames: int, dim: float = 1.0, start: int = 0) -> Iterator[Snapshot]:
    """Yield the frames 0, 1, 2 ... of a drive, in another light, ``start`` nanoseconds later."""
    for index in range(frames):
        snapshot = drive.snapshot(index * APART)
        frame = snapshot.frame
        camera = frame.cameras[0]
        assert camera.image is not None
        image = replace(camera.image, bgr=(camera.image.bgr * dim).astype(np.uint8))
        moved: dict[str, Any] = {"stamp": frame.stamp + start, "received": frame.received + start}
        frame = replace(frame, index=index, cameras=(replace(camera, image=image),), **moved)
        yield replace(snapshot, frame=frame)


def without_points(snapshot: Snapshot, objects: list[int], left: int) -> Snapshot:
    """Leave ``left`` points of some objects."""
    kept = ~np.isin(snapshot.point_object, objects)
    for number in objects:
        rows = np.flatnonzero(snapshot.point_object == number)
        kept[rows[:: max(1, len(rows) // left)]] = True
    frame = snapshot.frame
    fields = {name: values[kept] for name, values in frame.fields.items()}
    frame = replace(frame, points=frame.points[kept], fields=fields)
    return replace(snapshot, frame=frame, point_object=snapshot.point_object[kept])


def candidates(
    snapshot: Snapshot,
    scores: Mapping[str, float] = MappingProxyType({}),
    names: Mapping[str, str] = MappingProxyType({}),
    dropped: Container[str] = (),
) -> Candidates:
    """Return boxes around the pixels of each object, their scores (0.8 if none is stated) and names."""
    truth = snapshot.frame.truth
    assert truth is not None
    boxes, found_scores, labels = list[list[float]](), list[float](), list[str]()
    for number, label in zip(map(str, snapshot.truth_object.tolist()), truth.labels, strict=True):
        rows, columns = np.nonzero(snapshot.pixel_object == int(number))
        if len(rows) >= LEAST_PIXELS and number not in dropped:
            boxes.append([columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5])
            found_scores.append(scores.get(number, 0.8))
            labels.append(names.get(number, label))
    return np.array(boxes, np.float32).reshape(-1, 4), np.array(found_scores, np.float32), labels


def detections(boxes: F32, score: F32, names: list[str], config: Config) -> Detections:
    """Return candidates as a detector does: the best of the overlapping ones above the threshold are kept."""
    order = np.argsort(-score, kind="stable")
    boxes, score, labels = boxes[order], score[order], [names[i] for i in order.tolist()]
    state = np.where(
        score < config.detector.conf_threshold, DetectionState.BELOW_THRESHOLD, DetectionState.KEPT
    ).astype(np.int32)
    by, overlap = np.full(len(score), -1, np.int32), np.zeros(len(score), np.float32)
    ious = geometry.iou(boxes, boxes)
    for i in range(len(score)):
        for j in range(i):
            same = state[j] == DetectionState.KEPT and labels[i] == labels[j] and by[i] < 0
            if same and ious[i, j] > config.detector.iou_threshold:
                state[i], by[i], overlap[i] = DetectionState.SUPPRESSED, j, ious[i, j]
    return Detections(boxes, score, np.zeros(len(score), np.int32), tuple(labels), state, by, overlap)


class KnownDetections(StageLoader):
    """Loader of stages whose detector answers from candidates of each image, with the thresholds in force."""

    def __init__(self) -> None:
        super().__init__()
        self._candidates: dict[int, Candidates] = {}

    def add(self, stamp: int, found: Candidates) -> None:
        self._candidates[stamp] = found

    def load(self, config: Config, detect: DetectFunction | None = None) -> Stages:
        return super().load(config, detect or partial(self._answer, config))

    def _answer(self, config: Config, camera: Camera) -> Detections:
        assert camera.image is not None
        return detections(*self._candidates[camera.image.stamp], config)
