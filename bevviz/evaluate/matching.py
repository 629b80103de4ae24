"""Matching of objects, and of detections in images, with the ground truth."""

from __future__ import annotations

import itertools
import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from bevviz.evaluate.ground_truth import MAX_DISTANCE, Truth
from bevviz.model import geometry
from bevviz.model.frame import F32, F64, I32, Bool, Boxes3D, Camera
from bevviz.model.results import CameraResult, Objects

DETECTION_OVERLAP = 0.5  # least IoU of a detection and its label in the image
OUTCOMES = ("true", "missed", "false")


@dataclass(frozen=True, slots=True)
class Matches:
    """Objects of a frame matched with its ground truth.

    An object is true if it matches a label that has to be found. It is false if it matches no label. It is
    neither if it matches a label that need not be found, is exempt (``exemptions``), or has a name that the
    labels do not judge (``Truth.judged_names``).
    """

    partner: I32  # (J,) row of the object's label, else -1
    distance: F64  # (J,) metres on the ground plane between the centres, NaN without a label
    true: Bool  # (J,)
    false: Bool  # (J,)
    missed: Bool  # (K,) had to be found, but was not

    @property
    def counts(self) -> Counter[str]:
        """Numbers of true, missed and false objects."""
        return Counter({outcome: int(getattr(self, outcome).sum()) for outcome in OUTCOMES})


class AcceptedNames:
    """Labels of the frames so far, with the names that they accept."""

    def __init__(self) -> None:
        self._accepted: dict[str, frozenset[str]] = {}

    def add(self, truth: Truth) -> None:
        """Add the labels of a frame."""
        for label, names in zip(truth.labels, truth.accepted, strict=True):
            self._accepted[label.lower()] = self._accepted.get(label.lower(), frozenset()) | names

    def of(self, name: str) -> str | None:
        """Return the class for which an object without a label counts. None: no label accepts the name.

        It is the class of the same name. If there is none, it is the accepting label with the fewest names: a
        "person" counts as a pedestrian rather than as a cyclist.
        """
        labels = [label for label, names in self._accepted.items() if name in names]
        if name in labels:
            return name
        return min(labels, key=lambda label: (len(self._accepted[label]), label), default=None)


class JudgedObject(NamedTuple):
    """A true, missed or false object of a frame, or such a detection in its image."""

    outcome: str  # one of OUTCOMES
    name: str  # in lower case: its label, or the own name of a false one
    distance: float = math.nan  # metres from the sensor
    error: float = math.nan  # metres between the centres of a true object and its label


@dataclass
class ObjectScore:
    """True, missed and false objects of frames, or detections in their images.

    Attributes:
        accepted: names of each class; they say for which class a false one counts.
        total: counts of all classes together.
    """

    accepted: AcceptedNames = field(default_factory=AcceptedNames)
    total: Counter[str] = field(default_factory=Counter)
    _frames: list[list[JudgedObject]] = field(default_factory=list)

    def add(self, objects: Objects, truth: Truth, cameras: Sequence[CameraResult] = ()) -> Matches:
        """Match one frame's objects with the ground truth, best score first, and count."""
        matches = judge(objects, truth, cameras)
        self.count(objects, truth, matches)
        return matches

    def count(self, objects: Objects, truth: Truth, matches: Matches) -> None:
        """Count the objects of one frame that are matched already."""
        self.accepted.add(truth)
        self._keep(_judged_objects(objects, truth, matches))

    def add_detections(self, result: CameraResult, truth: Truth) -> None:
        """Match one camera's detections with the labelled image boxes, best score first, and count."""
        self._keep(_judged_detections(result, truth))

    def _keep(self, judged: Iterable[JudgedObject]) -> None:
        """Keep the objects of one frame, and count them: a trial shows the total after each frame."""
        frame = list(judged)
        self._frames.append(frame)
        self.total.update(one.outcome for one in frame)

    @property
    def objects(self) -> Iterator[JudgedObject]:
        """Every object. A false one has the name of the class for which it counts, if there is one."""
        for one in itertools.chain.from_iterable(self._frames):
            name = self.accepted.of(one.name) if one.outcome == "false" else None
            yield one._replace(name=name) if name else one

    def counts(self, cls: str = "", low: float = 0.0, high: float = math.inf) -> Counter[str]:
        """Return the counts ``true``, ``missed`` and ``false`` between two distances in metres.

        Args:
            cls: class; empty: all classes.
            low: least distance.
            high: distances are below this one.
        """
        return Counter(
            one.outcome
            for one in self.objects
            if one.name == (cls or one.name) and low <= one.distance < high
        )

    def errors(self, cls: str = "") -> list[float]:
        """Return the metres between the centres of the true objects of a class; empty: of all classes."""
        return [one.error for one in self.objects if one.outcome == "true" and one.name == (cls or one.name)]

    @property
    def frames(self) -> F64:
        """(F, 3) numbers of true, missed and false objects of each frame."""
        frames = [Counter(one.outcome for one in frame) for frame in self._frames]
        counts = [[frame[outcome] for outcome in OUTCOMES] for frame in frames]
        return np.array(counts, np.float64).reshape(-1, 3)

    @property
    def classes(self) -> dict[str, Counter[str]]:
        """Counts of each class, in lower case."""
        counts: dict[str, Counter[str]] = defaultdict(Counter)
        for one in self.objects:
            counts[one.name][one.outcome] += 1
        return dict(counts)


def position_text(boxes: Boxes3D, row: int) -> str:
    """Return the position of a box relative to the points' origin, as ``at 12.3 m, 4° left``."""
    x, y = boxes.center[row, :2].tolist()
    angle = math.degrees(math.atan2(y, x))
    return f"at {math.hypot(x, y):.1f} m, {abs(angle):.0f}° {'left' if angle >= 0 else 'right'}"


def share(right: int, wrong: int) -> float:
    """Return the share of right ones. NaN if there are none at all."""
    return right / (right + wrong) if right + wrong else float("nan")


def rates(counts: Mapping[str, int]) -> dict[str, float]:
    """Return recall, precision and their harmonic mean. NaN if there is nothing to count."""
    true, missed, false = (counts.get(outcome, 0) for outcome in OUTCOMES)
    return {
        "recall": share(true, missed),
        "precision": share(true, false),
        "f1": share(2 * true, missed + false),
    }


def judge(objects: Objects, truth: Truth, cameras: Sequence[CameraResult] = ()) -> Matches:
    """Match the objects of a frame with its ground truth and judge them.

    Args:
        objects: objects of the frame.
        truth: ground truth of the frame.
        cameras: results with the detections of the objects. Without them a region without labels exempts only
            objects with their centre in it.
    """
    partner, distance = match(objects, truth)
    paired = partner >= 0
    missed = truth.must.copy()
    missed[partner[paired]] = False
    true = paired.copy()
    true[paired] = truth.must[partner[paired]]
    judged = truth.judged_names
    is_judged = np.array([name.lower() in judged for name in objects.names], bool)
    exempt = np.array([bool(why) for why in exemptions(objects, truth, cameras)], bool)
    return Matches(partner, distance, true, ~paired & ~exempt & is_judged, missed)


def exemptions(objects: Objects, truth: Truth, cameras: Sequence[CameraResult] = ()) -> list[str]:
    """Return why each object would be neither right nor wrong without a label of its own; empty: it is false.

    It is on a label of a type that is not judged, or in a region without labels: its centre, or more than
    half of the image box of its detection (as KITTI's benchmark ignores detections).
    """
    in_region = truth.unlabelled(objects.boxes)
    if truth.camera is not None:
        detections = next((c.detections for c in cameras if c.camera.name == truth.camera.name), None)
        of_camera = np.array([name == truth.camera.name for name in objects.camera], bool)
        rows = np.flatnonzero(of_camera & (objects.detection >= 0))
        if detections is not None:
            in_region[rows] |= _in_regions(detections.xyxy[objects.detection[rows]], truth)
    on_label = truth.unjudged_label(objects.boxes)
    texts = ["in a DontCare region, where nothing is labelled" if inside else "" for inside in in_region]
    for row in np.flatnonzero(on_label >= 0).tolist():
        texts[row] = f"on a label of the type {truth.labels[on_label[row]]}, which is not judged"
    return texts


def match(objects: Objects, truth: Truth) -> tuple[I32, F64]:
    """Match objects with labels of the same class: the nearest within 2 m, best score first.

    Returns:
        partner: (J,) row of the label, else -1.
        distance: (J,) metres on the ground plane to that label, else NaN.
    """
    best_first = np.argsort(-objects.score, kind="stable")
    accepted = accepts(truth, [objects.names[j] for j in best_first])
    offsets = objects.boxes.center[best_first][:, None, :2] - truth.boxes.center[None, :, :2]
    distance = np.where(accepted, np.linalg.norm(offsets, axis=2), np.inf)
    partners, _ = pair_in_order(distance, MAX_DISTANCE)
    partner, error = np.full(len(distance), -1, np.int32), np.full(len(distance), np.nan)
    partner[best_first] = partners
    paired = np.flatnonzero(partners >= 0)
    error[best_first[paired]] = distance[paired, partners[paired]]
    return partner, error


def accepts(truth: Truth, names: list[str]) -> Bool:
    """Return (J, K) whether a name is accepted for a labelled box."""
    lower = [name.lower() for name in names]
    rows = {name: [name in accepted for accepted in truth.accepted] for name in {*lower}}
    return np.array([rows[name] for name in lower], bool).reshape(len(names), len(truth.accepted))


def pair_in_order(distance: F32, limit: float) -> tuple[np.ndarray[tuple[int], np.dtype[np.int32]], Bool]:
    """Pair each row in turn with the nearest free column within ``limit``.

    Args:
        distance: (N, M).
        limit: largest distance of a pair.

    Returns:
        partner: (N,) column of each row, else -1.
        free: (M,) whether a column has no partner.
    """
    free = np.ones(distance.shape[1], bool)
    partner = np.full(len(distance), -1, np.int32)
    for row, values in enumerate(distance):
        candidates = np.flatnonzero(free & (values <= limit))
        if len(candidates):
            partner[row] = candidates[values[candidates].argmin()]
            free[partner[row]] = False
    return partner, free


def _judged_objects(objects: Objects, truth: Truth, matches: Matches) -> Iterator[JudgedObject]:
    """Yield the true, missed and false objects of a frame."""
    labels, distance = [label.lower() for label in truth.labels], truth.boxes.distance
    for j in np.flatnonzero(matches.true).tolist():
        k = int(matches.partner[j])
        yield JudgedObject("true", labels[k], float(distance[k]), float(matches.distance[j]))
    for k in np.flatnonzero(matches.missed).tolist():
        yield JudgedObject("missed", labels[k], float(distance[k]))
    distance = objects.boxes.distance
    for j in np.flatnonzero(matches.false).tolist():
        yield JudgedObject("false", objects.names[j].lower(), float(distance[j]))


def _judged_detections(result: CameraResult, truth: Truth) -> Iterator[JudgedObject]:
    """Match one camera's detections with the labelled image boxes. Yield true, missed and false ones."""
    detections, camera = result.detections, result.camera
    if detections is None or camera.intrinsics is None or camera.camera_from_points is None:
        return
    boxes = image_boxes_of(truth, camera)
    kept = np.flatnonzero(detections.kept)
    kept = kept[np.argsort(-detections.score[kept], kind="stable")]
    names = [detections.names[d].lower() for d in kept]
    overlap = geometry.iou(detections.xyxy[kept], boxes)
    cost = np.where(accepts(truth, names) & (overlap >= DETECTION_OVERLAP), 1 - overlap, np.inf)
    partner, free = pair_in_order(cost, 1.0)
    excused, judged = _in_regions(detections.xyxy[kept], truth), truth.judged_names
    if truth.judged is not None:
        excused |= (overlap[:, ~truth.judged] >= DETECTION_OVERLAP).any(axis=1)
    to_find = truth.must & np.isfinite(boxes).all(axis=1)
    for name, k, is_excused in zip(names, partner.tolist(), excused.tolist(), strict=True):
        if k >= 0 and to_find[k]:
            yield JudgedObject("true", truth.labels[k].lower())
        elif k < 0 and not is_excused and name in judged:
            yield JudgedObject("false", name)
    for row in np.flatnonzero(free & to_find).tolist():
        yield JudgedObject("missed", truth.labels[row].lower())


def image_boxes_of(truth: Truth, camera: Camera) -> F32:
    """Return (K, 4) image boxes of the labels in a camera.

    They are labelled, or enclose the visible part of the projected 3D box. NaN if the box is not visible, or
    the camera has no pose.
    """
    boxes = np.full((len(truth.labels), 4), np.nan, np.float32)
    if camera.intrinsics is None or camera.camera_from_points is None:
        return boxes
    if truth.image is not None and truth.camera is not None and truth.camera.name == camera.name:
        return truth.image.xyxy
    corners = geometry.apply(camera.camera_from_points, geometry.corners(truth.boxes).reshape(-1, 3))
    uv, depth = geometry.project(corners, camera.intrinsics)
    uv, ahead = uv.reshape(-1, 8, 2), depth.reshape(-1, 8).min(axis=1) > geometry.MIN_DEPTH
    size = np.array([camera.intrinsics.width, camera.intrinsics.height], np.float32)
    inside = np.clip(uv[ahead], -0.5, size - 0.5)
    boxes[ahead] = np.hstack([inside.min(axis=1), inside.max(axis=1)])
    boxes[(boxes[:, 2:] <= boxes[:, :2]).any(axis=1)] = np.nan
    return boxes


def _in_regions(xyxy: F32, truth: Truth) -> Bool:
    """Return (D,) whether more than half of an image box lies in a region without labels."""
    none = np.zeros(len(xyxy), bool)
    if truth.image is None or len(truth.image.dont_care) == 0 or len(xyxy) == 0:
        return none
    regions = truth.image.dont_care
    low = np.maximum(xyxy[:, None, :2], regions[None, :, :2])
    high = np.minimum(xyxy[:, None, 2:], regions[None, :, 2:])
    shared = np.prod(np.clip(high - low, 0, None), axis=2)
    area = np.prod(xyxy[:, 2:] - xyxy[:, :2], axis=1)
    return np.asarray(shared.max(axis=1) > DETECTION_OVERLAP * area, bool)
