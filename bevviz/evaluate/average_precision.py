"""Average precision as the KITTI object benchmark defines it: in the bird's-eye view and in 3D.

Geiger, Lenz and Urtasun 2012, with the 40 recall points of Simonelli et al. 2019. The rules are those of
the benchmark's development kit: which labels and detections count, which are ignored, and at which scores
the curve is sampled.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from bevviz.evaluate.ground_truth import Truth
from bevviz.evaluate.matching import AcceptedNames, accepts
from bevviz.model import box_overlap
from bevviz.model.frame import F32, Bool
from bevviz.model.results import FrameResult
from bevviz.support.numba_kernel import kernel

RECALL_POINTS = 40
COUNTS, IGNORED, OTHER = 0, 1, -1  # role of a label or detection for a class and difficulty

Roles = NDArray[np.int8]  # one of the three values for each label or detection
CurveKey: TypeAlias = tuple[str, float, str, str]  # view, overlap, class, difficulty


class Difficulty(NamedTuple):
    """Limits for the labels of one difficulty of KITTI."""

    height: float  # pixels, least height of an object
    occluded: int  # largest level of occlusion
    truncated: float  # largest truncated share


DIFFICULTIES = {
    "easy": Difficulty(40, 0, 0.15),
    "moderate": Difficulty(25, 1, 0.3),
    "hard": Difficulty(25, 2, 0.5),
}
OVERLAPS = (0.5, 0.7)
VIEWS = ("bev", "3d")
KITTI_CLASSES = {  # label -> labels that count neither as right nor as wrong, names that detectors use
    "Car": (("Van",), ("car",)),
    "Pedestrian": (("Person_sitting",), ("pedestrian", "person")),
    "Cyclist": ((), ("cyclist", "bicycle")),
}


@dataclass(frozen=True, slots=True)
class ScoredObjects:
    """Objects of a frame compared with the ground truth."""

    names: tuple[str, ...]  # (D,) in lower case
    score: F32  # (D,)
    height: F32  # (D,) pixels; inf without an image box
    overlaps: dict[str, F32]  # (D, K) IoU with each label, by view


def scored_objects(result: FrameResult, truth: Truth) -> ScoredObjects:
    """Compare the fused objects of a frame with the ground truth."""
    objects = result.objects
    assert objects is not None
    above, volume = box_overlap.box_iou(objects.boxes, truth.boxes)
    detections = {camera.camera.name: camera.detections for camera in result.cameras}
    height = np.full(len(objects), np.inf, np.float32)
    for j, (camera, row) in enumerate(zip(objects.camera, objects.detection.tolist(), strict=True)):
        if row >= 0 and (camera_detections := detections.get(camera)) is not None:
            height[j] = camera_detections.xyxy[row, 3] - camera_detections.xyxy[row, 1]
    names = tuple(name.lower() for name in objects.names)
    return ScoredObjects(names, objects.score, height, {"bev": above, "3d": volume})


@dataclass
class Curve:
    """Precision-recall curve of one class at one difficulty: add every frame, then call ``average``."""

    view: str
    min_overlap: float

    def __post_init__(self) -> None:
        self._frames: list[tuple[F32, F32, Roles, Roles]] = []

    def add(self, objects: ScoredObjects, det: Roles, label: Roles) -> None:
        """Add a frame.

        Args:
            objects: objects of the frame.
            det: (D,) COUNTS, IGNORED or OTHER for each object.
            label: (K,) the same for each label.
        """
        rows, columns = np.flatnonzero(det != OTHER), np.flatnonzero(label != OTHER)
        if len(rows) == 0 and not (label == COUNTS).any():
            return
        self._frames.append(
            (
                np.ascontiguousarray(objects.overlaps[self.view][np.ix_(rows, columns)]),
                np.ascontiguousarray(objects.score[rows]),
                det[rows],
                label[columns],
            )
        )

    @property
    def labels(self) -> int:
        """Number of labels to be found."""
        return sum(int((frame[3] == COUNTS).sum()) for frame in self._frames)

    def average(self) -> float:
        """Return the mean precision over the recall points. NaN if there is no label to be found."""
        total = self.labels
        if not total:
            return float("nan")
        scores = [_match(*frame, self.min_overlap, -np.inf, False)[2] for frame in self._frames]
        precision = np.zeros(RECALL_POINTS + 1)
        for i, threshold in enumerate(_thresholds(np.concatenate(scores), total)):
            counts = [_match(*frame, self.min_overlap, threshold, True)[:2] for frame in self._frames]
            right, wrong = np.sum(counts, axis=0)
            precision[i] = right / (right + wrong) if right + wrong else 0.0
        precision = np.maximum.accumulate(precision[::-1])[::-1]
        return float(precision[1:].mean())


def _thresholds(scores: F32, total: int) -> Iterable[float]:
    """Return the scores of true positives at which the recall is nearest to each recall point."""
    scores = np.sort(scores)[::-1]
    recall = 0.0
    chosen = []
    for i, score in enumerate(scores.tolist()):
        left = (i + 1) / total
        last = i == len(scores) - 1
        right = left if last else (i + 2) / total
        if right - recall < recall - left and not last:
            continue
        chosen.append(score)
        recall += 1 / RECALL_POINTS
    return chosen


@kernel
def _match(
    overlap: F32,
    score: F32,
    det: Roles,
    label: Roles,
    min_overlap: float,
    threshold: float,
    count_false: bool,
) -> tuple[int, int, F32]:
    """Match labels to objects.

    Each label in turn takes the best of the objects that are left: the one with the best overlap or, without
    ``count_false``, with the best score.

    Returns:
        Number of true positives, number of false positives, scores of the true positives.
    """
    taken = np.zeros(len(score), np.bool_)
    scores = np.empty(len(label), np.float32)
    right = 0
    for k in range(len(label)):
        best, value, ignored = -1, 0.0, False
        for d in range(len(score)):
            if taken[d] or score[d] < threshold or overlap[d, k] <= min_overlap:
                continue
            if not count_false:
                if best < 0 or score[d] > value:
                    best, value = d, score[d]
            elif det[d] == 0:
                if best < 0 or ignored or overlap[d, k] > value:
                    best, value, ignored = d, overlap[d, k], False
            elif best < 0:
                best, ignored = d, True
        if best < 0:
            continue
        taken[best] = True
        if label[k] == 0 and det[best] == 0:
            scores[right] = score[best]
            right += 1
    false = 0
    if count_false:
        for d in range(len(score)):
            false += not (taken[d] or det[d] != 0 or score[d] < threshold)
    return right, false, scores[:right]


class AveragePrecision:
    """Average precision of all classes of a drive.

    KITTI's labels are split by KITTI's difficulties. Other labels count if they have to be found.
    """

    def __init__(self) -> None:
        self._curves: dict[CurveKey, Curve] = {}
        self._frames: list[tuple[ScoredObjects, Truth]] = []  # frames with labels other than KITTI's
        self._judged = AcceptedNames()  # classes of these frames

    def add(self, objects: ScoredObjects, truth: Truth) -> None:
        """Add a frame."""
        if truth.image is None:
            self._judged.add(truth)
            self._frames.append((objects, truth))
            return
        labels = np.array(truth.labels, object)
        size = truth.image.xyxy[:, 3] - truth.image.xyxy[:, 1]
        for kind, (neighbours, names) in KITTI_CLASSES.items():
            is_class, is_neighbour = labels == kind, np.isin(labels.astype(str), neighbours)
            has_name = np.isin(np.array(objects.names, str), names)
            for name, limit in DIFFICULTIES.items():
                within = (truth.image.occluded <= limit.occluded) & (truth.image.truncated <= limit.truncated)
                counts = is_class & within & (size > limit.height)
                label = _roles(counts, is_class | is_neighbour)
                small = objects.height < limit.height
                det = _roles(has_name & ~small, has_name | small)
                self._add(self._curves, (kind.lower(), name), objects, det, label)

    def _by_label(self) -> dict[CurveKey, Curve]:
        """Return the curves of labels other than KITTI's.

        The class of a detection is known when all labels are known. So these curves are made at the end.
        """
        curves: dict[CurveKey, Curve] = {}
        names = {label.lower() for _, truth in self._frames for label in truth.labels}
        for objects, truth in self._frames:
            labels = np.array([label.lower() for label in truth.labels], object)
            classes = np.array(_object_classes(objects, truth, self._judged), object)
            for name in sorted(names):
                has_label, has_class = labels == name, classes == name
                self._add(
                    curves,
                    (name, ""),
                    objects,
                    _roles(has_class, has_class),
                    _roles(has_label & truth.must, has_label),
                )
        return curves

    def _add(
        self,
        curves: dict[CurveKey, Curve],
        group: tuple[str, str],
        objects: ScoredObjects,
        det: Roles,
        label: Roles,
    ) -> None:
        for view in VIEWS:
            for overlap in OVERLAPS:
                curves.setdefault((view, overlap, *group), Curve(view, overlap)).add(objects, det, label)

    @property
    def labels(self) -> dict[tuple[str, str], int]:
        """(class, difficulty) -> number of labels to be found."""
        counts = {key[2:]: curve.labels for key, curve in self._curves.items()}
        to_find = ((k, truth) for _, truth in self._frames for k in np.flatnonzero(truth.must).tolist())
        counts |= Counter((truth.labels[k].lower(), "") for k, truth in to_find)
        return {group: count for group, count in counts.items() if count}

    def results(self) -> dict[CurveKey, float]:
        """Return (view, overlap, class, difficulty) -> average precision, for curves with labels to be found.

        The kit samples at most one score for each true positive. With 40 labels or fewer it has fewer than 40
        points, so that the average is at most (labels - 1) / 40.
        """
        curves = self._curves | self._by_label()
        return {key: curve.average() for key, curve in curves.items() if curve.labels}


def _roles(counts: Bool, ignored: Bool) -> Roles:
    return np.where(counts, COUNTS, np.where(ignored, IGNORED, OTHER)).astype(np.int8)


def _object_classes(objects: ScoredObjects, truth: Truth, judged: AcceptedNames) -> list[str | None]:
    """Return the class of each detection.

    It is the class of the label with the largest overlap, among the labels that accept the detection's name.
    Without overlap it is the class for which the name is judged.
    """
    overlap = np.where(accepts(truth, list(objects.names)), objects.overlaps[VIEWS[0]], 0)
    classes = [judged.of(name) for name in objects.names]
    for d in np.flatnonzero((overlap > 0).any(axis=1)).tolist():
        classes[d] = truth.labels[int(overlap[d].argmax())].lower()
    return classes
