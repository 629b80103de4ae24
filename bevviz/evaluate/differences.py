"""Differences between two results of the same frame, and what the ground truth says about them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from bevviz.evaluate.ground_truth import Truth
from bevviz.evaluate.matching import judge, position_text
from bevviz.model import box_overlap, geometry
from bevviz.model.frame import F32, F64, Bool, Boxes3D
from bevviz.model.results import FrameResult, Objects
from bevviz.stages.fusion import assign

MAX_PAIR_DISTANCE = 2.0  # metres between the centres of one object, in the bird's-eye view
MIN_BEV_IOU = 0.1  # least IoU of one object with two classes, in the bird's-eye view
MOVED_DISTANCE = 0.2  # metres: an object has moved if its centre is further away
MIN_IMAGE_IOU = 0.5  # least IoU of one detection in the image


class Change(StrEnum):
    """Kind of difference of an object between side A and side B."""

    SAME = "same"
    MOVED = "moved"
    CLASS = "other class"
    ONLY_A = "only A"
    ONLY_B = "only B"


WORST_FIRST = (Change.ONLY_A, Change.ONLY_B, Change.CLASS, Change.MOVED, Change.SAME)
DIFFERENT = WORST_FIRST[:-1]


@dataclass(frozen=True, slots=True)
class ImageBoxes:
    """Detections in one image."""

    xyxy: F32  # (D, 4)
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class SideResult:
    """Results of one side in a frame. Boxes are in ``Frame.points_frame``."""

    boxes: Boxes3D
    names: tuple[str, ...]
    scores: F32
    images: Mapping[str, ImageBoxes] = field(default_factory=dict)  # by camera; only cameras with detections
    clusters: int | None = None  # None: unknown


@dataclass(frozen=True, slots=True)
class Difference:
    """One object of one side or of both. A side without it has row -1 and an empty name."""

    change: Change
    row_a: int
    row_b: int
    name_a: str
    name_b: str
    distance: float = float("nan")  # between the centres: metres in the bird's-eye view, pixels in an image
    iou: float = 0.0

    @property
    def text(self) -> str:
        """The difference in words, without the position."""
        if self.change is Change.CLASS:
            return f"{self.name_a} in A is {self.name_b} in B"
        if self.change is Change.MOVED:
            return f"{self.name_b} moved by {self.distance:.2f} m, IoU {self.iou:.2f}"
        return f"{self.name_a or self.name_b}: {self.change}"


@dataclass(frozen=True, slots=True)
class FrameDifferences:
    """Differences of two sides in one frame."""

    index: int
    stamp: int
    a: SideResult
    b: SideResult
    objects: tuple[Difference, ...]
    images: Mapping[str, tuple[Difference, ...]]  # by camera
    judged: TruthComparison | None = None  # None: no ground truth

    @property
    def counts(self) -> Counter[Change]:
        """Number of objects of each kind of difference."""
        return Counter(difference.change for difference in self.objects)

    def side_with(self, difference: Difference) -> tuple[SideResult, int]:
        """Return a side that has the object, and the object's row there. B comes first."""
        return (self.a, difference.row_a) if difference.row_b < 0 else (self.b, difference.row_b)

    def position_of(self, difference: Difference) -> str:
        """Return the position of the object relative to the points' origin, as ``at 12.3 m, 4° left``."""
        side, row = self.side_with(difference)
        return position_text(side.boxes, row)

    @property
    def number(self) -> int:
        """Number of objects and detections that differ."""
        pairs = [*self.objects, *(d for image_pairs in self.images.values() for d in image_pairs)]
        return sum(difference.change is not Change.SAME for difference in pairs)


def seen(result: FrameResult) -> SideResult:
    """Return the result of a run as one side of a comparison."""
    images = {}
    for camera in result.cameras:
        if (detections := camera.detections) is not None:
            kept = np.flatnonzero(detections.kept)
            images[camera.camera.name] = ImageBoxes(
                detections.xyxy[kept], tuple(detections.names[d] for d in kept)
            )
    clusters = None
    if result.clusters is not None:
        clusters = int(result.clusters.kept.sum())
    if result.objects is None:
        return SideResult(Boxes3D.empty(), (), np.zeros(0, np.float32), images, clusters)
    return SideResult(result.objects.boxes, result.objects.names, result.objects.score, images, clusters)


def differences(
    index: int, stamp: int, a: SideResult, b: SideResult, judged: TruthComparison | None = None
) -> FrameDifferences:
    """Return the differences of two sides in a frame."""
    both = [camera for camera in a.images if camera in b.images]
    return FrameDifferences(
        index,
        stamp,
        a,
        b,
        compare_objects(a, b),
        {camera: compare_images(a.images[camera], b.images[camera]) for camera in both},
        judged,
    )


def compare_objects(a: SideResult, b: SideResult) -> tuple[Difference, ...]:
    """Pair the objects of two sides. Each object of either side occurs once.

    Two boxes may be one object if they have the same class and their centres are within 2 m in the
    bird's-eye view. With different classes they need an IoU of 0.1 or more in the bird's-eye view. The pairs
    are the one-to-one assignment with the most pairs and, among those, the least total cost ::

        distance / 2 m + (1 - IoU) + (1 if the class differs)

    A pair of one class has moved if its centres are more than 0.2 m apart.
    """
    distance = np.linalg.norm(a.boxes.center[:, None, :2] - b.boxes.center[None, :, :2], axis=2)
    iou = box_overlap.bev_iou(a.boxes, b.boxes)
    other_class = _names_differ(a.names, b.names)
    allowed = np.where(other_class, iou >= MIN_BEV_IOU, distance <= MAX_PAIR_DISTANCE)
    cost = np.where(allowed, np.minimum(distance / MAX_PAIR_DISTANCE, 1) + (1 - iou) + other_class, np.inf)
    return _make_pairs(a.names, b.names, cost, distance, iou, MOVED_DISTANCE)


def compare_images(a: ImageBoxes, b: ImageBoxes) -> tuple[Difference, ...]:
    """Pair the detections of two sides in an image. A pair has an IoU of 0.5 or more.

    Each detection of either side occurs once.
    """
    iou = geometry.iou(a.xyxy, b.xyxy)
    middle_a, middle_b = ((boxes.xyxy[:, :2] + boxes.xyxy[:, 2:]) / 2 for boxes in (a, b))
    distance = np.linalg.norm(middle_a[:, None] - middle_b[None], axis=2)
    cost = np.where(iou >= MIN_IMAGE_IOU, 1 - iou + _names_differ(a.names, b.names), np.inf)
    return _make_pairs(a.names, b.names, cost, distance, iou, np.inf)


def _names_differ(a: Sequence[str], b: Sequence[str]) -> np.ndarray[tuple[int, int], np.dtype[np.bool_]]:
    return np.array([[x != y for y in b] for x in a], bool).reshape(len(a), len(b))


def _make_pairs(
    a: Sequence[str], b: Sequence[str], cost: F64, distance: F32, iou: F32, moved: float
) -> tuple[Difference, ...]:
    # Two unmatched objects cost more than any pair, so that the assignment makes as many pairs as it can.
    column = assign(np.asarray(cost, np.float64), unmatched=10.0)
    pairs = []
    for i, j in enumerate(column.tolist()):
        if j < 0:
            pairs.append(Difference(Change.ONLY_A, i, -1, a[i], ""))
            continue
        pair_distance = float(distance[i, j])
        change = Change.CLASS if a[i] != b[j] else Change.MOVED if pair_distance > moved else Change.SAME
        pairs.append(Difference(change, i, j, a[i], b[j], pair_distance, float(iou[i, j])))
    only_b = sorted(set(range(len(b))) - set(column.tolist()))
    return (*pairs, *(Difference(Change.ONLY_B, -1, j, "", b[j]) for j in only_b))


# --- ground truth ------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class TruthComparison:
    """Frame of both sides compared with the ground truth. Row i is the i-th object to be found."""

    labels: tuple[str, ...]
    boxes: Boxes3D  # in the frame of the points
    a: Bool  # found by A
    b: Bool
    wrong_a: tuple[str, ...]  # names of A's false objects
    wrong_b: tuple[str, ...]
    names: frozenset[str]  # names that the labels of this frame accept; other names are not judged

    @property
    def fixed(self) -> Sequence[int]:
        """Rows of objects that only B finds."""
        rows: list[int] = np.flatnonzero(self.b & ~self.a).tolist()
        return rows

    @property
    def broken(self) -> Sequence[int]:
        """Rows of objects that only A finds."""
        rows: list[int] = np.flatnonzero(self.a & ~self.b).tolist()
        return rows

    def text(self, row: int) -> str:
        """Return class and distance of an object, as ``person at 12.3 m``."""
        return f"{self.labels[row].lower()} at {self.boxes.distance[row]:.1f} m"


def compare_with_truth(a: FrameResult, b: FrameResult, truth: Truth) -> TruthComparison:
    """Compare both sides of a frame with its ground truth."""
    to_find = np.flatnonzero(truth.must)
    (found_a, wrong_a), (found_b, wrong_b) = (_side(side.objects, truth) for side in (a, b))
    return TruthComparison(
        labels=tuple(truth.labels[k] for k in to_find),
        boxes=truth.boxes.chosen(to_find),
        a=found_a[to_find],
        b=found_b[to_find],
        wrong_a=wrong_a,
        wrong_b=wrong_b,
        names=frozenset().union(*truth.accepted),
    )


def _side(objects: Objects | None, truth: Truth) -> tuple[Bool, tuple[str, ...]]:
    """Return (K,) whether each labelled box is found, and the names of the false objects."""
    if objects is None:
        return np.zeros(len(truth.labels), bool), ()
    matches = judge(objects, truth)
    return ~matches.missed, tuple(objects.names[j].lower() for j in np.flatnonzero(matches.false))
