"""Accuracy of fused boxes on labelled KITTI frames.

It shares no code with what it judges: labels are read here, and boxes are compared by shapely.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from shapely import Polygon
from tqdm import tqdm

from bevviz.config import Config
from bevviz.model import geometry
from bevviz.model.frame import Boxes3D, Camera, Frame, Image, Intrinsics
from bevviz.model.results import Detections, FrameResult
from bevviz.pipeline.session import Session
from bevviz.pipeline.stage_loader import DetectFunction, StageLoader

RANGE = 40.0  # metres, on the ground, of an object that must be found
MIN_HITS = 10  # LiDAR points in its box
FOUND = 2.0  # metres between the centres of an object and the box that finds it
RIGHT = {  # names that are right for each label
    "Pedestrian": {"pedestrian", "person"},
    "Person_sitting": {"person_sitting", "person"},
    "Cyclist": {"cyclist", "person", "bicycle"},
    "Car": {"car"},
    "Van": {"van", "car", "truck", "bus"},
    "Truck": {"truck", "car", "bus"},
    "Tram": {"tram", "train", "bus"},
    "Misc": {"misc"},
}


@dataclass(frozen=True, slots=True)
class Label:
    """One labelled object, in the frame of the LiDAR."""

    kind: str
    xyxy: np.ndarray  # (4,) pixels
    center: np.ndarray  # (3,)
    size: np.ndarray  # (3,) length, width, height
    yaw: float
    hits: int  # LiDAR points in its box
    occluded: int  # 0: seen whole, 1: partly, 2: largely hidden, 3: not known
    truncated: float  # share outside of the image

    @property
    def required(self) -> bool:
        return bool(np.hypot(*self.center[:2]) <= RANGE and self.hits >= MIN_HITS)


@dataclass(frozen=True, slots=True)
class Shot:
    """A labelled frame."""

    name: str
    frame: Frame
    labels: tuple[Label, ...]
    ignored: np.ndarray  # (K, 4) image boxes in which nothing is labelled


def read(root: Path, name: str) -> Shot:
    """One frame of the object benchmark, as it lies in its folders."""
    rows = [r.split(":", 1) for r in (root / f"calib/{name}.txt").read_text().splitlines() if ":" in r]
    calib = {key: np.array(values.split(), float) for key, values in rows}
    p2 = calib["P2"].reshape(3, 4)
    rectify, velodyne, shift = np.eye(4), np.eye(4), np.eye(4)
    rectify[:3, :3] = calib["R0_rect"].reshape(3, 3)
    velodyne[:3] = calib["Tr_velo_to_cam"].reshape(3, 4)
    shift[:3, 3] = np.linalg.solve(p2[:, :3], p2[:, 3])  # camera 2 beside the reference camera
    rectified = rectify @ velodyne
    points = np.fromfile(root / f"velodyne/{name}.bin", np.float32).reshape(-1, 4)
    image = cv2.imread(str(root / f"image_2/{name}.png"))
    assert image is not None
    camera = Camera(
        "image_2",
        Image(0, "image_2", np.asarray(image, np.uint8)),
        Intrinsics(image.shape[1], image.shape[0], p2[:, :3]),
        shift @ rectified,
        None,
        sync_error=0.0,
    )
    frame = Frame(
        index=int(name) if name.isdigit() else 0,
        stamp=0,
        received=0,
        lidar="velodyne",
        points=np.ascontiguousarray(points[:, :3]),
        points_frame="velodyne",
        world_frame="velodyne",
        cameras=(camera,),
    )
    labels, ignored = [], []
    back = np.linalg.inv(rectified)
    for line in (root / f"label_2/{name}.txt").read_text().splitlines():
        kind, *numbers = line.split()
        v = np.array(numbers, float)
        if kind == "DontCare":
            ignored.append(v[3:7])
            continue
        height, width, length = v[7:10]
        center = (back @ [*(v[10:13] - [0, height / 2, 0]), 1])[:3]
        ahead = back[:3, :3] @ [np.cos(v[13]), 0, -np.sin(v[13])]
        yaw = float(np.arctan2(ahead[1], ahead[0]))
        size = np.array([length, width, height])
        offset = points[:, :3] - center
        c, s = np.cos(yaw), np.sin(yaw)
        local = np.column_stack(
            [c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0], offset[:, 2]]
        )
        hits = int((np.abs(local) <= size / 2).all(axis=1).sum())
        labels.append(Label(kind, v[3:7], center, size, yaw, hits, int(v[1]), float(v[0])))
    return Shot(name, frame, tuple(labels), np.array(ignored).reshape(-1, 4))


def oracle(shot: Shot, off: float = 0.0) -> DetectFunction:
    """Return a detector whose detections are the label boxes, so that only the later stages are judged.

    Args:
        shot: the frame.
        off: one sigma of the error of the box edges, as a share of the box's width and height.
    """
    n = len(shot.labels)
    none = np.zeros(n, np.int32)
    boxes = np.array([label.xyxy for label in shot.labels], np.float32).reshape(-1, 4)
    size = boxes[:, 2:] - boxes[:, :2]
    random = np.random.default_rng(shot.frame.index)
    boxes += (off * random.normal(size=boxes.shape) * np.hstack([size, size])).astype(np.float32)
    found = Detections(
        xyxy=boxes,
        score=np.full(n, 0.9, np.float32),
        class_id=none,
        names=tuple(label.kind.lower() for label in shot.labels),
        state=none,
        suppressed_by=none - 1,
        overlap=np.zeros(n, np.float32),
    )
    return lambda camera: found


def enlarge_cars(shot: Shot, factors: Sequence[float] = (1.38, 1.2, 1.2)) -> Shot:
    """Stretch the cars of a frame along, across and upwards: their points, labels and image boxes."""
    scale = np.array(factors)
    camera, points, labels = shot.frame.cameras[0], shot.frame.points.copy(), []
    intrinsics, camera_from_points = camera.intrinsics, camera.camera_from_points
    assert intrinsics is not None and camera_from_points is not None

    def rectangle(center: np.ndarray, size: np.ndarray, yaw: float) -> np.ndarray:
        box = Boxes3D(*(np.array([value], np.float32) for value in (center, size, yaw)))
        corners = geometry.corners(box).reshape(-1, 3)
        uv, _ = geometry.project(geometry.apply(camera_from_points, corners), intrinsics)
        return np.concatenate([uv.min(axis=0), uv.max(axis=0)])

    for label in shot.labels:
        if label.kind != "Car":
            labels.append(label)
            continue
        c, s = np.cos(label.yaw), np.sin(label.yaw)
        car_from_lidar = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        up = np.array([0, 0, 0.5])
        bottom = label.center - up * label.size
        local = (shot.frame.points - bottom) @ car_from_lidar.T
        body = (np.abs(local[:, :2]) <= label.size[:2] / 2 + 0.05).all(axis=1)
        body &= (local[:, 2] > 0.15) & (local[:, 2] < label.size[2] + 0.1)  # the ground below stays
        points[body] = (local[body] * scale) @ car_from_lidar + bottom
        size = label.size * scale
        center = bottom + up * size
        change = rectangle(center, size, label.yaw) - rectangle(label.center, label.size, label.yaw)
        limit = [intrinsics.width - 1, intrinsics.height - 1] * 2
        xyxy = np.clip(label.xyxy + np.nan_to_num(change), 0, limit)
        labels.append(replace(label, center=center, size=size, xyxy=xyxy))
    return replace(shot, frame=replace(shot.frame, points=points), labels=tuple(labels))


def outline(center: np.ndarray, size: np.ndarray, yaw: float) -> Polygon:
    c, s = np.cos(yaw), np.sin(yaw)
    half = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * size[:2] / 2
    return Polygon(half @ np.array([[c, s], [-s, c]]) + center[:2])


@dataclass(frozen=True, slots=True)
class Verdict:
    """Outcome of an object that must be found."""

    frame: str
    label: Label
    distance: float  # metres to the centre of its box; inf: none
    iou: float  # with it, from above


@dataclass(frozen=True, slots=True)
class Placed:
    """Surroundings of a named box."""

    frame: str
    name: str
    size: np.ndarray
    nearest: float  # metres to the nearest labelled object, whatever its class
    ignored: bool  # it stands where nothing is labelled


@dataclass
class Tally:
    objects: list[Verdict] = field(default_factory=list)
    boxes: list[Placed] = field(default_factory=list)

    def add(self, shot: Shot, result: FrameResult) -> None:
        found = result.objects
        assert found is not None and not result.failures, result.failures
        center, size, yaw = found.boxes.center, found.boxes.size, found.boxes.yaw
        distance = np.array(
            [
                [
                    np.hypot(*(c[:2] - label.center[:2])) if n.lower() in RIGHT[label.kind] else np.inf
                    for c, n in zip(center, found.names, strict=True)
                ]
                for label in shot.labels
            ]
        ).reshape(len(shot.labels), len(found))
        partner = np.full(len(shot.labels), -1)
        for flat in np.argsort(distance, axis=None):  # nearest pairs first, each once
            row, j = divmod(int(flat), max(len(found), 1))
            if np.isfinite(distance[row, j]) and partner[row] < 0 and j not in partner:
                partner[row] = j
        for row, label in enumerate(shot.labels):
            if not label.required:
                continue
            j = int(partner[row])
            if j < 0:
                self.objects.append(Verdict(shot.name, label, np.inf, 0.0))
                continue
            mine = outline(label.center, label.size, label.yaw)
            theirs = outline(center[j], size[j], float(yaw[j]))
            shared = mine.intersection(theirs).area
            iou = shared / (mine.area + theirs.area - shared)
            self.objects.append(Verdict(shot.name, label, float(distance[row, j]), float(iou)))
        for j in range(len(found)):
            away = [float(np.hypot(*(center[j, :2] - label.center[:2]))) for label in shot.labels]
            box = result.cameras[0].detections
            where = box.xyxy[found.detection[j]] if box is not None else np.zeros(4)
            middle = (where[:2] + where[2:]) / 2
            out = (middle >= shot.ignored[:, :2]) & (middle <= shot.ignored[:, 2:])
            self.boxes.append(
                Placed(
                    shot.name,
                    found.names[j],
                    size[j],
                    min(away, default=np.inf),
                    bool(out.all(axis=1).any()),
                )
            )

    def figures(self) -> dict[str, str]:
        """Return the figures by name. Shares have their 95 % interval, from a bootstrap over frames."""
        objects, cars = self.objects, [v for v in self.objects if v.label.kind == "Car"]
        people = [v for v in self.objects if v.label.kind in ("Pedestrian", "Person_sitting")]
        errors = [v.distance for v in objects if v.distance <= FOUND]
        wrong = [b for b in self.boxes if b.nearest > FOUND]
        return {
            "found within 2 m": _share([(v.frame, v.distance <= FOUND) for v in objects]),
            "error, median m": f"{np.median(errors):.2f}" if errors else "-",
            "90 % m": f"{np.quantile(errors, 0.9):.2f}" if errors else "-",
            "IoU 0.5": _share([(v.frame, v.iou >= 0.5) for v in objects]),
            "cars 0.5": _share([(v.frame, v.iou >= 0.5) for v in cars]),
            "cars 0.7": _share([(v.frame, v.iou >= 0.7) for v in cars]),
            "people 0.5": _share([(v.frame, v.iou >= 0.5) for v in people]),
            "wrong": _share([(b.frame, b.nearest > FOUND) for b in self.boxes]),
            "wrong, unlabelled ground aside": str(sum(not b.ignored for b in wrong)),
            "largest": f"{max((b.size.max() for b in self.boxes), default=0):.1f} m",
        }


def _share(cases: Sequence[tuple[str, bool]]) -> str:
    """Return how many of the cases hold, with the 95 % interval from a bootstrap over frames."""
    if not cases:
        return "0 of 0"
    frames = sorted({frame for frame, _ in cases})
    held, total = np.zeros((2, len(frames)))
    for frame, holds in cases:
        held[frames.index(frame)] += holds
        total[frames.index(frame)] += 1
    draws = np.random.default_rng(0).integers(0, len(frames), (2000, len(frames)))
    low, high = np.percentile(held[draws].sum(axis=1) / total[draws].sum(axis=1), (2.5, 97.5))
    return f"{held.sum():.0f} of {total.sum():.0f} ({100 * low:.0f}-{100 * high:.0f} %)"


def shots(root: Path, names: Iterable[str] | None = None) -> Iterator[Shot]:
    chosen = names or sorted(path.stem for path in (root / "velodyne").glob("*.bin"))
    for name in chosen:
        yield read(root, name)


@dataclass(frozen=True, slots=True)
class Case:
    """A configuration, and what detects: the labels, whose boxes may be off, or the network that it names."""

    config: Config
    by_labels: bool = True
    off: float = 0.0


def measure(root: Path, cases: Mapping[str, Case], names: Iterable[str] | None = None) -> dict[str, Tally]:
    """Every case on every frame, or on those that are named."""
    tallies = {name: Tally() for name in cases}
    loader = StageLoader()
    for shot in tqdm(list(shots(root, names)), unit="frame", disable=None):
        for name, case in cases.items():
            detect = oracle(shot, case.off) if case.by_labels else None
            tallies[name].add(shot, Session(case.config, detect, loader=loader).run_single(shot.frame))
    return tallies
