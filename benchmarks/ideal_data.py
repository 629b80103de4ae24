"""Labelled frames for ``benchmarks.ideal``: synthetic drives, KITTI and SUSTechPOINTS."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

import bevviz
from benchmarks.fix import noisy
from bevviz.config import Config
from bevviz.evaluate import Truth, truth_of
from bevviz.extras.demo.drive import Snapshot, SyntheticSource
from bevviz.extras.demo.sensors import Lidar, PinholeCamera
from bevviz.model.frame import F32, Boxes3D, Camera, Frame, LabelledBoxes3D
from bevviz.model.results import Detections
from bevviz.pipeline.stage_loader import DetectFunction, StageLoader, Stages
from tests.support import small_drives

ASKED = (1, 3)  # frames of a drive that are asked about; the others are their neighbours
LIDARS = ((32, 900), (40, 1000), (64, 1200))  # beams and azimuths
CAMERA = 512, 288, 352.0  # pixels
DEMO_ASKED = (20, 70)  # frames of a drive with a LiDAR of 64 beams
APART = 3  # frames between a frame of that drive and its neighbours
SUS_NAMES = {"Rider": "Cyclist", "Motor": "motorcycle", "Bus": "bus"}  # label -> label that bevviz knows
COCO_NAMES = {"Car": "car", "Van": "car", "Truck": "truck", "Tram": "train"}  # any other label is a person


@dataclass(frozen=True, slots=True, eq=False)
class LabelledFrame:
    """A frame with ground truth.

    Attributes:
        drive: drive that it is of; frames of one drive are not independent.
        number: number in the drive.
        frame: the frame.
        truth: its ground truth.
        visible: (K, 4) image box of each object in the first camera, NaN: project its 3D box.
        asked: whether its missed objects are asked about.
    """

    drive: str
    number: int
    frame: Frame
    truth: Truth
    visible: F32
    asked: bool = True


@dataclass(frozen=True, slots=True)
class DataSet:
    """Labelled frames, and what detects in their images.

    Attributes:
        name: name of the data set.
        frames: frames of one drive follow each other.
        loader: loader of the stages.
        settings: settings of each configuration.
        classes: classes that the detector knows.
    """

    name: str
    frames: tuple[LabelledFrame, ...]
    loader: StageLoader
    settings: tuple[str, ...]
    classes: tuple[str, ...]

    @property
    def judged(self) -> frozenset[str]:
        """Names that some label accepts."""
        return frozenset().union(*(names for frame in self.frames for names in frame.truth.accepted))

    def neighbours(self, position: int) -> list[LabelledFrame]:
        """Return the frames before and after a frame of the same drive."""
        frames, drive = self.frames, self.frames[position].drive
        beside = [i for i in (position - 1, position + 1) if 0 <= i < len(frames)]
        return [frames[i] for i in beside if frames[i].drive == drive]

    def asked(self, half: str = "") -> list[int]:
        """Return the positions of the frames of one half that are asked about; an empty half is all."""
        return [i for i, f in enumerate(self.frames) if f.asked and half in ("", self.half(i))]

    def half(self, position: int) -> str:
        """Return the half of a frame: methods may be chosen on ``seen`` frames only."""
        frame = self.frames[position]
        odd = zlib.crc32(f"{self.name}/{frame.drive}/{frame.number}".encode()) % 2
        return "unseen" if odd else "seen"


class LabelDetections(StageLoader):
    """Loader of stages whose detector gives the image boxes of the labels."""

    def __init__(self) -> None:
        super().__init__()
        self._known: dict[int, small_drives.Candidates] = {}

    def add(self, frame: Frame) -> None:
        """Add the labels of a frame."""
        assert frame.truth is not None and frame.truth.image is not None
        names = [COCO_NAMES.get(label, "person") for label in frame.truth.labels]
        score = np.full(len(names), 0.9, np.float32)
        found = frame.truth.image.xyxy.astype(np.float32), score, names
        self._known[id(frame.cameras[0].image)] = found

    def load(self, config: Config, detect: DetectFunction | None = None) -> Stages:
        """Return the stages of a configuration."""
        return super().load(config, detect or partial(self._answer, config))

    def _answer(self, config: Config, camera: Camera) -> Detections:
        return small_drives.detections(*self._known[id(camera.image)], config)


def visible_boxes(snapshot: Snapshot) -> F32:
    """Return the (K, 4) image boxes around the pixels of each object."""
    boxes = np.full((len(snapshot.truth_object), 4), np.nan, np.float32)
    for row, number in enumerate(snapshot.truth_object.tolist()):
        v, u = np.nonzero(snapshot.pixel_object == number)
        if len(u):
            boxes[row] = u.min() - 0.5, v.min() - 0.5, u.max() + 0.5, v.max() + 0.5
    return boxes


def drives(seeds: Sequence[int]) -> DataSet:
    """Return drives of several LiDARs. Their detections are weak, doubled or of nothing at times."""
    loader, frames, number = small_drives.KnownDetections(), list[LabelledFrame](), ASKED[-1] + 2
    for seed in seeds:
        lidar, camera = Lidar(*LIDARS[seed % len(LIDARS)]), PinholeCamera(*CAMERA)
        drive = SyntheticSource(number * small_drives.APART, seed, lidar=lidar, camera=camera)
        rng = np.random.default_rng(seed)
        # The stamp of an image tells the loader which image it is.
        for snapshot in small_drives.snapshots(drive, number, start=seed * 10**12):
            frame = snapshot.frame
            assert frame.truth is not None and frame.cameras[0].image is not None
            loader.add(frame.cameras[0].image.stamp, noisy(small_drives.candidates(snapshot), rng))
            truth, boxes = truth_of(frame, frame.truth), visible_boxes(snapshot)
            is_asked = frame.index in ASKED
            frames.append(LabelledFrame(str(seed), frame.index, frame, truth, boxes, is_asked))
    return DataSet("drives", tuple(frames), loader, (), ("person", "cyclist", "car"))


def demo(seeds: Sequence[int]) -> DataSet:
    """Return drives with a LiDAR of 64 beams and the network of the demo."""
    frames = list[LabelledFrame]()
    for seed in seeds:
        drive = SyntheticSource(DEMO_ASKED[-1] + APART + 1, seed)
        for asked in DEMO_ASKED:
            for number in (asked - APART, asked, asked + APART):
                snapshot = drive.snapshot(number)
                frame = snapshot.frame
                assert frame.truth is not None
                truth, boxes = truth_of(frame, frame.truth), visible_boxes(snapshot)
                frames.append(LabelledFrame(str(seed), number, frame, truth, boxes, number == asked))
    return DataSet(
        "demo", tuple(frames), StageLoader(), ("detector.model=demo",), ("person", "cyclist", "car")
    )


def kitti(data: Path, *, by_labels: bool) -> DataSet:
    """Return KITTI's labelled frames. They are no drive: a frame's neighbours are other places.

    Args:
        data: folder with ``kitti``, ``kitti_more`` and ``models``.
        by_labels: detect by the labels' image boxes, in place of YOLOX.
    """
    loader, frames = LabelDetections() if by_labels else StageLoader(), list[LabelledFrame]()
    for folder in ("kitti", "kitti_more"):
        with bevviz.open(data / folder) as drive:
            for number in range(len(drive)):
                frame = drive.frames.frame(number)
                assert frame is not None and frame.truth is not None and frame.truth.image is not None
                if isinstance(loader, LabelDetections):
                    loader.add(frame)
                visible = frame.truth.image.xyxy
                frames.append(LabelledFrame(folder, number, frame, truth_of(frame, frame.truth), visible))
    if by_labels:
        return DataSet("kitti-labels", tuple(frames), loader, (), ("car", "truck", "train", "person"))
    return DataSet("kitti", tuple(frames), loader, _yolox(data), _classes(data, loader))


def sus(data: Path) -> DataSet:
    """Return the frames of SUSTechPOINTS that have images, with YOLOX."""
    loader, frames = StageLoader(), list[LabelledFrame]()
    files = sorted((data / "sus/label").glob("*.json"))
    with bevviz.open(data / "sus") as drive:
        for number, file in enumerate(files):
            frame = drive.frames.frame(number)
            if frame is None or all(camera.image is None for camera in frame.cameras):
                continue
            frame = replace(frame, truth=_sus_labels(file, frame))
            assert frame.truth is not None
            nowhere = np.full((len(frame.truth.labels), 4), np.nan, np.float32)
            frames.append(LabelledFrame("sus", number, frame, truth_of(frame, frame.truth), nowhere))
    return DataSet("sus", tuple(frames), loader, _yolox(data), _classes(data, loader))


def _sus_labels(file: Path, frame: Frame) -> LabelledBoxes3D:
    """Read a label file of SUSTechPOINTS. Its boxes are in the frame of the points."""
    rows = json.loads(file.read_text())
    values = [
        np.array([[row["psr"][key][axis] for axis in "xyz"] for row in rows], np.float32)
        for key in ("position", "scale", "rotation")
    ]
    labels = tuple(SUS_NAMES.get(row["obj_type"], row["obj_type"]) for row in rows)
    boxes = Boxes3D(values[0], values[1], values[2][:, 2].copy())
    return LabelledBoxes3D(
        "labels", frame.stamp, frame.points_frame, boxes, labels, np.ones(len(labels), np.float32)
    )


def _yolox(data: Path) -> tuple[str, ...]:
    return (f"detector.model={data / 'models/yolox_nano.onnx'}",)


def _classes(data: Path, loader: StageLoader) -> tuple[str, ...]:
    """Return the classes of YOLOX."""
    return loader.load(bevviz.config.load(settings=_yolox(data))).class_names


def data_sets(data: Path, seeds: Sequence[int]) -> dict[str, Callable[[], DataSet]]:
    """Return what reads or simulates each data set, by name.

    Args:
        data: folder with the real frames.
        seeds: of the synthetic drives.
    """
    return {
        "drives": partial(drives, seeds),
        "demo": partial(demo, seeds[: max(1, len(seeds) // 2)]),
        "kitti": partial(kitti, data, by_labels=False),
        "kitti-labels": partial(kitti, data, by_labels=True),
        "sus": partial(sus, data),
    }
