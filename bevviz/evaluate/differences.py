"""Differences between two results of the same frame, and what the ground truth says about them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from bevviz.evaluate.ground_truth import Truth
from bevviz.evaluate.matching import Matches, judge, position_text
from bevviz.model import box_overlap, geometry
from bevviz.model.frame import F32, F64, Boxes3D
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
    judged: BeforeAfter | None = None  # None: no ground truth

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
    return replace(side_of(result.objects or Objects.empty()), images=images, clusters=clusters)


def side_of(objects: Objects) -> SideResult:
    """Return objects as one side of a comparison."""
    return SideResult(objects.boxes, objects.names, objects.score)


def differences(
    index: int, stamp: int, a: SideResult, b: SideResult, judged: BeforeAfter | None = None
) -> FrameDifferences:
    """Return the differences of two sides in a frame.

    Args:
        index: number of the scan.
        stamp: stamp of the scan, in nanoseconds.
        a: side A.
        b: side B.
        judged: both sides compared with the ground truth. None: it is unknown.
    """
    both = [camera for camera in a.images if camera in b.images]
    return FrameDifferences(
        index,
        stamp,
        a,
        b,
        compare_objects(a, b) if judged is None else judged.pairs,
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


# --- before and after --------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class BeforeAfter:
    """Effects of a change on the objects of one frame.

    Attributes:
        pairs: every object before and after the change, which are sides A and B.
        truth: ground truth of the frame; None: unknown.
        before: the objects before, matched with the ground truth.
        after: the objects after, matched with the ground truth.
    """

    pairs: tuple[Difference, ...]
    truth: Truth | None = None
    before: Matches | None = None
    after: Matches | None = None

    @property
    def fixed(self) -> list[int]:
        """Rows of labelled objects that were missed and are found."""
        return _found_only(self.after, self.before)

    @property
    def broken(self) -> list[int]:
        """Rows of labelled objects that were found and are missed."""
        return _found_only(self.before, self.after)

    @property
    def found(self) -> tuple[int, int, int]:
        """Number of objects that had to be found, and how many of them are found before and after."""
        there = 0 if self.truth is None else int(self.truth.must.sum())
        missed = (0 if side is None else int(side.missed.sum()) for side in (self.before, self.after))
        before, after = (there - number for number in missed)
        return there, before, after

    @property
    def new_false(self) -> list[int]:
        """Rows of the objects after that are false and were not. Without ground truth: all new ones."""
        pairs = [(pair.row_b, pair.row_a) for pair in self.pairs]
        return self._false_only(pairs, self.after, self.before)

    @property
    def false_gone(self) -> list[int]:
        """Rows of the objects before that were false and are not. Without ground truth: all that are gone."""
        pairs = [(pair.row_a, pair.row_b) for pair in self.pairs]
        return self._false_only(pairs, self.before, self.after)

    @property
    def changed(self) -> int:
        """Number of objects that have moved or have another class."""
        return sum(pair.change in (Change.MOVED, Change.CLASS) for pair in self.pairs)

    @property
    def balance(self) -> tuple[int, int]:
        """Number of objects that get better and that get worse. Without ground truth: new and gone ones."""
        if self.truth is None:
            return len(self.new_false), len(self.false_gone)
        return len(self.fixed) + len(self.false_gone), len(self.broken) + len(self.new_false)

    def text(self, row: int) -> str:
        """Return class and distance of a labelled object, as ``person at 12.3 m``."""
        assert self.truth is not None
        return f"{self.truth.labels[row].lower()} at {self.truth.boxes.distance[row]:.1f} m"

    def _false_only(
        self, pairs: Iterable[tuple[int, int]], matches: Matches | None, others: Matches | None
    ) -> list[int]:
        """Return the rows of one side's false objects whose partner on the other side is not false."""
        if self.truth is None or matches is None or others is None:
            return [row for row, other in pairs if other < 0]
        return [
            row
            for row, other in pairs
            if row >= 0 and matches.false[row] and (other < 0 or not others.false[other])
        ]


def _found_only(matches: Matches | None, others: Matches | None) -> list[int]:
    """Return the rows of labelled objects that one side finds and the other one misses."""
    if matches is None or others is None:
        return []
    return np.flatnonzero(others.missed & ~matches.missed).tolist()


def before_after(before: Objects | None, after: Objects | None, truth: Truth | None) -> BeforeAfter:
    """Compare two results of one frame with each other and, if it is known, with the ground truth."""
    before, after = before or Objects.empty(), after or Objects.empty()
    pairs = compare_objects(side_of(before), side_of(after))
    if truth is None:
        return BeforeAfter(pairs)
    return BeforeAfter(pairs, truth, judge(before, truth), judge(after, truth))
