"""Differences between two results of the same frame, and what the ground truth says about them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TypeAlias

import numpy as np

from bevviz.evaluate.ground_truth import Truth
from bevviz.evaluate.matching import Matches, judge, position_text
from bevviz.model import box_overlap, geometry
from bevviz.model.frame import F32, F64, Boxes3D
from bevviz.model.results import CameraResult, FrameResult, Objects
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

Cameras: TypeAlias = tuple[Sequence[CameraResult], Sequence[CameraResult]]  # of both sides, see ``judge``


@dataclass(frozen=True, slots=True)
class ImageBoxes:
    """Detections in one image."""

    xyxy: F32  # (D, 4)
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class SideResult:
    """Results of one side in a frame, without its points and images."""

    index: int  # number of the scan
    stamp: int  # of the scan, in nanoseconds
    received: int  # receive time in nanoseconds; 0: unknown
    pose: F64  # (4, 4) of the points in the fixed frame
    objects: Objects
    images: Mapping[str, ImageBoxes]  # by camera; only cameras with detections
    clusters: int | None  # None: unknown


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

    a: SideResult
    b: SideResult
    effects: BeforeAfter  # pairs of their objects, and the ground truth
    images: Mapping[str, tuple[Difference, ...]]  # by camera

    @property
    def objects(self) -> tuple[Difference, ...]:
        """Every object of both sides."""
        return self.effects.pairs

    @property
    def counts(self) -> Counter[Change]:
        """Number of objects of each kind of difference."""
        return Counter(difference.change for difference in self.objects)

    def box_of(self, difference: Difference) -> Boxes3D:
        """Return the box of the object, B's if B has it."""
        side, row = (self.a, difference.row_a) if difference.row_b < 0 else (self.b, difference.row_b)
        return side.objects.boxes.chosen([row])

    def position_of(self, difference: Difference) -> str:
        """Return the position of the object relative to the points' origin, as ``at 12.3 m, 4° left``."""
        return position_text(self.box_of(difference), 0)

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
    clusters = None if result.clusters is None else int(result.clusters.kept.sum())
    frame, objects = result.frame, result.objects or Objects.empty()
    return SideResult(frame.index, frame.stamp, frame.received, frame.pose, objects, images, clusters)


def differences(
    a: SideResult, b: SideResult, truth: Truth | None = None, *, cameras: Cameras = ((), ())
) -> FrameDifferences:
    """Return the differences of two sides in a frame, as ``before_after`` does."""
    both = [camera for camera in a.images if camera in b.images]
    images = {camera: compare_images(a.images[camera], b.images[camera]) for camera in both}
    effects = before_after(a.objects, b.objects, truth, cameras=cameras)
    return FrameDifferences(a, b, effects, images)


def compare_objects(a: Objects, b: Objects) -> tuple[Difference, ...]:
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
class ChangedObjects:
    """Objects of a frame that a change affects, by class and distance."""

    fixed: tuple[str, ...]  # labelled objects that are found now; the object in question is first
    added: tuple[str, ...]  # other new objects
    false: tuple[str, ...]  # new false objects
    lost: tuple[str, ...]  # objects that are gone, without the false ones
    right: tuple[str, ...]  # objects that were right, of labels that are missed now
    false_gone: tuple[str, ...]  # false objects that are gone
    changed: int  # number of other objects that have moved or have another class


@dataclass(frozen=True, slots=True)
class BeforeAfter:
    """Effects of a change on the objects of one frame.

    Attributes:
        a: objects before the change.
        b: objects after the change.
        pairs: every object before and after the change, which are sides A and B.
        truth: ground truth of the frame; None: unknown.
        before: the objects before, matched with the ground truth.
        after: the objects after, matched with the ground truth.
        asked: row of the labelled object in question; -1: none.
        own: row after the change of the object in question; -1: none.
        doubtful: number of doubtful objects that there are more after the change. Ground truth makes it 0.
    """

    a: Objects
    b: Objects
    pairs: tuple[Difference, ...]
    truth: Truth | None = None
    before: Matches | None = None
    after: Matches | None = None
    asked: int = -1
    own: int = -1
    doubtful: int = 0

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
    def names(self) -> ChangedObjects:
        """Names of the objects that the change affects."""
        before_of, after_of = _rows_by_label(self.before), _rows_by_label(self.after)
        rows = after_of.keys() - before_of.keys()  # also those that need not be found
        fixed = sorted((row != self.asked, self.label_text(row)) for row in rows)
        right = sorted(before_of[row] for row in before_of.keys() - after_of.keys())
        false, false_gone = ([], []) if self.truth is None else (self.new_false, self.false_gone)
        new, gone = self._only(Change.ONLY_B), self._only(Change.ONLY_A)
        own = {after_of[row] for row in rows}
        if self.own in new and self.own not in own:
            fixed.insert(0, (False, _object_text(self.b, self.own)))
            own.add(self.own)
        named_a, named_b = {*right, *false_gone}, {*own, *false}
        moved = (p for p in self.pairs if p.change in (Change.MOVED, Change.CLASS))
        return ChangedObjects(
            tuple(text for _, text in fixed),
            tuple(_object_text(self.b, row) for row in new if row not in own),
            tuple(_object_text(self.b, row) for row in false if row not in own),
            tuple(_object_text(self.a, row) for row in gone if row not in false_gone),
            tuple(_object_text(self.a, row) for row in right),
            tuple(_object_text(self.a, row) for row in false_gone),
            sum(pair.row_a not in named_a and pair.row_b not in named_b for pair in moved),
        )

    @property
    def good(self) -> int:
        """Number of objects that get better: new right ones, and false or doubtful ones that are gone."""
        names = self.names
        gone = len(names.false_gone) if self.truth is not None else max(-self.doubtful, 0)
        return len(names.fixed) + gone

    @property
    def harm(self) -> int:
        """Number of objects that get worse. Without ground truth: new doubtful ones, and those that are gone.

        The objects that are gone then count without the doubtful ones among them.
        """
        if self.truth is not None:
            names = self.names
            return len(names.false) + len(names.right)
        gone = len(self._only(Change.ONLY_A))
        return max(self.doubtful, 0) + max(gone + min(self.doubtful, 0), 0)

    @property
    def text(self) -> str:
        """All effects in brief, in the words of the page and of ``compare``."""
        names = self.names
        named = {
            "fixed": names.fixed,
            "broken": names.right,
            "new false": names.false,
            "false gone": names.false_gone,
            "gone": [name for name in names.lost if name not in names.right],
            "new": [name for name in names.added if name not in names.false],
        }
        texts = [f"{what} {' and '.join(objects)}" for what, objects in named.items() if objects]
        texts += [f"{self.doubtful} more doubtful"] if self.doubtful > 0 else []
        texts += [f"{names.changed} changed"] if names.changed else []
        return ", ".join(texts)

    def label_text(self, row: int) -> str:
        """Return class and distance of a labelled object, as ``person at 12.3 m``."""
        assert self.truth is not None
        return f"{self.truth.labels[row].lower()} at {self.truth.boxes.distance[row]:.1f} m"

    def _only(self, change: Change) -> list[int]:
        """Return the rows of the objects that only one side has."""
        return [max(pair.row_a, pair.row_b) for pair in self.pairs if pair.change is change]

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


def _rows_by_label(matches: Matches | None) -> dict[int, int]:
    """Return the row of the object of each labelled object that has one."""
    if matches is None:
        return {}
    return {label: row for row, label in enumerate(matches.partner.tolist()) if label >= 0}


def _object_text(objects: Objects, row: int) -> str:
    """Return class and distance of an object."""
    return f"{objects.names[row]} at {objects.boxes.distance[row]:.1f} m"


def before_after(
    before: Objects | None,
    after: Objects | None,
    truth: Truth | None,
    *,
    cameras: Cameras = ((), ()),
    asked: int = -1,
    own: int = -1,
    doubtful: int = 0,
) -> BeforeAfter:
    """Compare two results of one frame with each other and, if it is known, with the ground truth.

    Args:
        before: objects of the first result.
        after: objects of the second result.
        truth: ground truth of the frame. None: it is unknown.
        cameras: cameras of both results, see ``judge``.
        asked: see ``BeforeAfter``.
        own: see ``BeforeAfter``.
        doubtful: see ``BeforeAfter``.
    """
    a, b = before or Objects.empty(), after or Objects.empty()
    pairs = compare_objects(a, b)
    if truth is None:
        return BeforeAfter(a, b, pairs, own=own, doubtful=doubtful)
    judged = judge(a, truth, cameras[0]), judge(b, truth, cameras[1])
    return BeforeAfter(a, b, pairs, truth, *judged, asked, own)
