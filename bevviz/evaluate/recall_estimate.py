"""Estimate of the recall without ground truth, from tracks over the whole drive."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bevviz.evaluate.ground_truth import MAX_DISTANCE, RANGE, must_be_found
from bevviz.evaluate.metrics import ranges
from bevviz.model import geometry
from bevviz.model.frame import F64, I64, Bool, Boxes3D
from bevviz.model.json_forms import RecallEstimateForm
from bevviz.model.protocols import Observer
from bevviz.model.results import CameraResult, FrameResult, Objects, Tracks
from bevviz.recording.images import unexplained_detections
from bevviz.support import table

LEAST_OBJECTS = 3  # tracks below which the recall is unknown
LEAST_OVERLAP = 0.2  # IoU in the image of an object's box and its detection
REACH = 0.2  # error of a distance that the height of a detection tells, as a share of it
WIDEST = 0.6  # width of an interval from which the recall is unknown
LEVEL = 0.95  # chance that the interval holds the recall, if the model is right
DRAWS = 4000  # from the posterior
MEANS = (np.arange(40) + 0.5) / 40  # values of the mean in which the posterior is computed
SPREADS = (np.arange(10) + 0.5) / 10  # values of the spread between objects, from equal to all or nothing

log_gamma = np.vectorize(math.lgamma, otypes=[np.float64])


@dataclass(frozen=True, slots=True)
class RecallEstimate:
    """Estimated recall of a group of objects: NaN, and no interval, if it is unknown."""

    name: str  # as a metric: ``recall[.CLASS][@RANGE]``
    objects: int  # tracks
    sightings: int  # frames in which these had to be found, summed over the tracks
    recall: float = math.nan
    low: float = math.nan
    high: float = math.nan

    @property
    def known(self) -> bool:
        """Whether the interval is narrow enough."""
        return not math.isnan(self.recall)

    def as_tree(self) -> RecallEstimateForm:
        """Return the estimate for JSON. None: unknown."""
        return {
            "objects": self.objects,
            "sightings": self.sightings,
            "recall": round(self.recall, 4) if self.known else None,
            "low": None if math.isnan(self.low) else round(self.low, 4),
            "high": None if math.isnan(self.high) else round(self.high, 4),
        }


@dataclass(frozen=True, slots=True)
class _TrackHistory:
    """A named track: the frames in which its object had to be found."""

    name: str
    distance: F64  # (N,) metres
    reported: Bool  # (N,)


class RecallEstimator(Observer[FrameResult]):
    """Observer that estimates which share of the objects was reported, without ground truth.

    A track follows the clusters of its object, also while no detection names it. So the frames between its
    first and its last cluster tell how often an object is reported that is reported sometimes. The number of
    objects that are never reported follows from the spread of the others: the number of reports of an object
    is beta-binomial, truncated at one (capture-recapture with heterogeneity, Dorazio and Royle 2003).
    Detections without an object are a lower bound for it.
    """

    def __init__(self) -> None:
        self.frames = 0
        self._frames: list[tuple[I64, F64, Bool, Bool, Bool]] = []  # id, distance, must, reported, seen
        self._names: dict[int, str] = {}
        self._lone: list[tuple[str, float, float]] = []  # name, distance, score

    def observe(self, result: FrameResult) -> None:
        """Note the tracks of a frame."""
        self.frames += 1
        tracks, objects = result.tracks, result.objects
        if tracks is None or objects is None:
            return
        self._names.update(
            (id_, name.lower()) for id_, name in zip(tracks.id.tolist(), tracks.names, strict=True) if name
        )
        boxes, reported = _reported_tracks(result, tracks, objects)
        must = must_be_found(result.frame, boxes)
        distance = boxes.distance.astype(np.float64)
        self._frames.append((tracks.id, distance, must, reported, tracks.cluster >= 0))
        named = np.array([name != "" for name in tracks.names], bool)
        for camera in result.cameras:
            self._lone += _lone_detections(result, camera, boxes.chosen(np.flatnonzero(named | reported)))

    def estimates(self) -> list[RecallEstimate]:
        """Return the estimate of all objects, of each class, and of each range of these."""
        histories = self._histories()
        classes = sorted({history.name for history in histories})
        return [estimate for cls in ("", *classes) for estimate in self._estimates(cls, histories)]

    def table(self) -> str:
        """Return the table for the terminal. A group without objects is left out."""
        rows = [("recall, estimated", "tracks", "frames", "recall", "95 % interval")]
        rows += [
            (e.name.removeprefix("recall").removeprefix(".") or "all", *_numbers(e))
            for e in self.estimates()
            if e.objects
        ]
        return "\n".join(table.lines(rows))

    def _estimates(self, cls: str, histories: Sequence[_TrackHistory]) -> Iterator[RecallEstimate]:
        histories = [history for history in histories if history.name == (cls or history.name)]
        name = f"recall.{cls}" if cls else "recall"
        yield self._estimate(name, cls, histories, 0.0, RANGE + 1)
        for low, high in ranges():
            yield self._estimate(f"{name}@{low}-{high}", cls, histories, low, high)

    def _estimate(
        self, name: str, cls: str, histories: Sequence[_TrackHistory], low: float, high: float
    ) -> RecallEstimate:
        within = [(h.distance >= low) & (h.distance < high) for h in histories]
        number = np.array([inside.sum() for inside in within], np.int64)
        reported = np.array(
            [h.reported[inside].sum() for h, inside in zip(histories, within, strict=True)], np.int64
        )
        elsewhere = np.array(
            [h.reported[~inside].sum() for h, inside in zip(histories, within, strict=True)], np.int64
        )
        there = number > 0
        objects, sightings = int(there.sum()), int(number.sum())
        if objects < LEAST_OBJECTS:
            return RecallEstimate(name, objects, sightings)
        least = (elsewhere == 0).astype(np.int64)
        lone = [s for n, d, s in self._lone if low <= d < high and n in (cls or n)]
        value, lowest, highest = estimate_recall(number[there], reported[there], least[there], lone)
        value = value if highest - lowest <= WIDEST else math.nan
        return RecallEstimate(name, objects, sightings, value, lowest, highest)

    def _histories(self) -> list[_TrackHistory]:
        """Return the tracks that are named often enough, from their first to their last cluster."""
        if not any(len(ids) for ids, *_ in self._frames):
            return []
        ids, distance, must, reported, seen = map(np.concatenate, zip(*self._frames, strict=True))
        order = np.argsort(ids, kind="stable")
        histories = []
        for rows in np.split(order, np.flatnonzero(np.diff(ids[order])) + 1):
            name = self._names.get(int(ids[rows[0]]), "")
            lived = rows[: np.flatnonzero(seen[rows]).max(initial=-1) + 1]
            wanted = lived[must[lived]]
            if name and reported[wanted].any():
                histories.append(_TrackHistory(name, distance[wanted], reported[wanted]))
        return histories


def unreported_tracks(result: FrameResult) -> I64:
    """Return the rows of named tracks with a cluster whose object had to be found, and is not reported."""
    tracks, objects = result.tracks, result.objects
    if tracks is None or objects is None or not len(tracks.id):
        return np.zeros(0, np.int64)
    boxes, reported = _reported_tracks(result, tracks, objects)
    named = np.array([name != "" for name in tracks.names], bool)
    rows: I64 = np.flatnonzero(named & ~reported & (tracks.cluster >= 0) & must_be_found(result.frame, boxes))
    return rows


def _reported_tracks(result: FrameResult, tracks: Tracks, objects: Objects) -> tuple[Boxes3D, Bool]:
    """Return the boxes of the tracks in the frame's coordinates, and (T,) whether an object is each."""
    boxes = tracks.boxes
    if tracks.absolute:
        boxes = geometry.transform_boxes(boxes, geometry.inverse(result.frame.pose))
    agreeing = _agreeing_objects(result)
    reported = np.append(agreeing, False)[tracks.object]
    for row in np.flatnonzero(~reported).tolist():
        reported[row] = _is_reported(boxes, row, tracks.names[row], objects, agreeing)
    return boxes, reported


def _agreeing_objects(result: FrameResult) -> Bool:
    """Return (J,) whether the box of an object overlaps its detection in the image. Without one it does."""
    objects = result.objects
    assert objects is not None
    agrees = np.ones(len(objects), bool)
    corners = geometry.corners(objects.boxes)
    cameras = {camera.camera.name: camera for camera in result.cameras}
    for row, (name, detection) in enumerate(zip(objects.camera, objects.detection.tolist(), strict=True)):
        camera = cameras.get(name)
        if camera is None or camera.detections is None or detection < 0:
            continue
        assert camera.camera.camera_from_points is not None and camera.camera.intrinsics is not None
        in_camera = geometry.apply(camera.camera.camera_from_points, corners[row])
        uv, _ = geometry.project(in_camera, camera.camera.intrinsics)
        if np.isfinite(uv).all():
            box = np.concatenate([uv.min(axis=0), uv.max(axis=0)])[None]
            agrees[row] = geometry.iou(box, camera.detections.xyxy[detection][None])[0, 0] >= LEAST_OVERLAP
    return agrees


def _is_reported(boxes: Boxes3D, row: int, name: str, objects: Objects, agreeing: Bool) -> bool:
    """Return whether an object of the name is within the distance of a match."""
    rows = [j for j, other in enumerate(objects.names) if other == name and agreeing[j]]
    away = np.hypot(*(objects.boxes.center[rows, :2] - boxes.center[row, :2]).T)
    return bool((away <= MAX_DISTANCE).any())


def _lone_detections(
    result: FrameResult, camera: CameraResult, known: Boxes3D
) -> Iterator[tuple[str, float, float]]:
    """Yield name, distance and score of detections without an object whose object had to be found.

    The height of a detection tells its distance, by the height of its class. The known objects, which their
    tracks count, are left out.
    """
    detections, intrinsics = camera.detections, camera.camera.intrinsics
    if detections is None or intrinsics is None or camera.camera.camera_from_points is None:
        return
    sizes, points_from_camera = (
        result.config.objects.sizes,
        geometry.inverse(camera.camera.camera_from_points),
    )
    for row in unexplained_detections(camera).tolist():
        name = detections.names[row].lower()
        if (size := sizes.get(name)) is None:
            continue
        u0, v0, u1, v1 = detections.xyxy[row].tolist()
        edges = geometry.rays(np.array([[(u0 + u1) / 2, v0], [(u0 + u1) / 2, v1]]), intrinsics)
        depth = size[2] / max(float(edges[1, 1] - edges[0, 1]), 1e-6)
        center = geometry.apply(points_from_camera, depth * edges.mean(axis=0, keepdims=True))
        distance = float(np.hypot(*center[0, :2]))
        yaw = np.arctan2(center[:, 1], center[:, 0])
        box = Boxes3D(center, np.array([[2 * REACH * distance + size[0], *size[1:3]]], np.float32), yaw)
        away = np.hypot(*(known.center[:, :2] - center[:, :2]).T)
        if must_be_found(result.frame, box)[0] and not (away <= REACH * distance + size[0] / 2).any():
            yield name, distance, float(detections.score[row])


def estimate_recall(
    number: I64, reported: I64, least: I64, lone: Sequence[float] = ()
) -> tuple[float, float, float]:
    """Return the recall of a drive, and the ends of its interval, from the known tracks.

    Args:
        number: (T,) frames in which each object had to be found.
        reported: (T,) frames in which it was reported.
        least: (T,) reports without which the object would be unknown.
        lone: chances that a detection without an object is right: their scores.
    """
    mean, spread = (values.ravel() for values in np.meshgrid(MEANS, SPREADS))
    alpha, beta = (share * (1 - spread) / spread for share in (mean, 1 - mean))
    rows, count = np.unique(np.stack([number, reported, least]), axis=1, return_counts=True)
    likelihood, expected, unknown = np.zeros(len(mean)), np.zeros(len(mean)), np.zeros(len(mean))
    for (n, x, m), times in zip(rows.T.tolist(), count.tolist(), strict=True):
        few = [np.exp(_log_chance(n, k, alpha, beta)) for k in range(min(m, n + 1))]
        missing = np.clip(np.sum(few, axis=0), 0, 1 - 1e-9) if few else np.zeros(len(mean))
        likelihood += times * (_log_chance(n, x, alpha, beta) - np.log1p(-missing))
        unseen = times / (1 - missing)  # unknown objects for each known one, with their reports
        unknown += n * missing * unseen
        expected += unseen * sum((k * chance for k, chance in enumerate(few)), np.zeros(len(mean)))
    recall = (reported.sum() + expected) / (number.sum() + np.maximum(unknown, sum(lone)))
    likelihood += np.log(mean * (1 - mean) ** 2) + 2 * np.log(1 - spread)  # prior
    weight = np.exp(likelihood - likelihood.max())
    weight /= weight.sum()
    rng = np.random.default_rng(0)
    draws = rng.choice(recall, DRAWS, p=weight)
    size = number.sum() ** 2 / (number**2).sum()  # objects of equal length that tell as much
    draws = rng.beta(draws * size + 0.5, (1 - draws) * size + 0.5)
    low, high = np.quantile(draws, [(1 - LEVEL) / 2, (1 + LEVEL) / 2]).tolist()
    return float(weight @ recall), low, high


def _log_chance(n: int, x: int, alpha: F64, beta: F64) -> F64:
    """Return the logarithm of the chance of ``x`` reports in ``n`` frames: beta-binomial."""
    choices = math.lgamma(n + 1) - math.lgamma(x + 1) - math.lgamma(n - x + 1)
    reports = log_gamma(alpha + x) + log_gamma(beta + (n - x)) - log_gamma(alpha + beta + n)
    return np.asarray(choices + reports - log_gamma(alpha) - log_gamma(beta) + log_gamma(alpha + beta))


def _numbers(estimate: RecallEstimate) -> tuple[str, str, str, str]:
    counts = str(estimate.objects), str(estimate.sightings)
    interval = "-" if math.isnan(estimate.low) else f"{estimate.low:.2f} to {estimate.high:.2f}"
    return *counts, f"{estimate.recall:.2f}" if estimate.known else "unknown", interval
