"""Tracking metrics: CLEAR MOT, IDF1 and HOTA.

The libraries that have HOTA (TrackEval, trackers) install opencv-python, which overwrites the headless OpenCV
that bevviz needs, and py-motmetrics imports pandas and scipy, which takes two seconds. A test compares the
results with those of TrackEval.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bevviz.evaluate.ground_truth import MAX_DISTANCE, Truth
from bevviz.evaluate.matching import AcceptedNames, accepts
from bevviz.model import geometry
from bevviz.model.frame import F64, I32
from bevviz.model.results import FrameResult
from bevviz.stages.fusion import assign

ALPHAS = np.arange(0.05, 0.99, 0.05)  # similarity thresholds of HOTA
LARGE = 1e6  # metres: more pairs are better than nearer ones


@dataclass(frozen=True, slots=True)
class TrackedFrame:
    """Objects and tracks of one class in one frame, with the distances between them."""

    objects: I32  # (G,) numbers of the objects
    tracks: I32  # (T,) numbers of the tracks
    distance: F64  # (G, T) metres on the ground plane; inf beyond 2 m


@dataclass
class ClassTracks:
    """Frames of one class of a drive."""

    def __post_init__(self) -> None:
        self.steps: list[TrackedFrame] = []
        self._objects: dict[str, int] = {}
        self._tracks: dict[int, int] = {}

    def add(self, objects: Sequence[str], tracks: Sequence[int], distance: F64) -> None:
        """Add a frame.

        Args:
            objects: ids of the labelled objects.
            tracks: ids of the tracks.
            distance: (G, T) metres.
        """
        shape = len(objects), len(tracks)
        self.steps.append(
            TrackedFrame(
                np.array([self._objects.setdefault(name, len(self._objects)) for name in objects], np.int32),
                np.array([self._tracks.setdefault(name, len(self._tracks)) for name in tracks], np.int32),
                np.where(distance <= MAX_DISTANCE, distance, np.inf).reshape(shape),
            )
        )

    def hota(self) -> dict[str, float]:
        """Return HOTA (higher order tracking accuracy), and its parts for detection and association.

        Luiten et al. 2021, with the similarity ``1 - distance / 2 m``. NaN without objects and tracks.
        """
        size = len(self._objects), len(self._tracks)
        similar = [np.where(np.isfinite(s.distance), 1 - s.distance / MAX_DISTANCE, 0.0) for s in self.steps]
        together, of_object, of_track = np.zeros(size), np.zeros(size[0]), np.zeros(size[1])
        for step, similarity in zip(self.steps, similar, strict=True):
            whole = similarity.sum(0)[None] + similarity.sum(1)[:, None] - similarity
            shared = np.divide(similarity, whole, out=np.zeros(whole.shape), where=whole > 0)
            together[np.ix_(step.objects, step.tracks)] += shared
            of_object[step.objects] += 1
            of_track[step.tracks] += 1
        if not of_object.sum() + of_track.sum():
            return dict.fromkeys(("hota", "deta", "assa"), math.nan)
        aligned = together / np.maximum(of_object[:, None] + of_track[None] - together, 1e-9)
        matches = np.zeros((len(ALPHAS), *size))
        for step, similarity in zip(self.steps, similar, strict=True):
            worth = aligned[np.ix_(step.objects, step.tracks)] * similarity
            column = assign(np.where(worth > 0, -worth, np.inf), unmatched=0.0)
            row = np.flatnonzero(column >= 0)
            object_rows, track_rows = step.objects[row], step.tracks[column[row]]
            good = similarity[row, column[row]] >= ALPHAS[:, None] - 1e-9
            matches[:, object_rows, track_rows] += good
        right = matches.sum(axis=(1, 2))
        deta = right / (of_object.sum() + of_track.sum() - right)
        kept = matches / np.maximum(of_object[:, None] + of_track[None] - matches, 1)
        assa = (matches * kept).sum(axis=(1, 2)) / np.maximum(right, 1)
        return {
            "hota": float(np.sqrt(deta * assa).mean()),
            "deta": float(deta.mean()),
            "assa": float(assa.mean()),
        }

    def clear(self) -> dict[str, float]:
        """Return CLEAR MOT (Bernardin and Stiefelhagen 2008) and IDF1 (Ristani et al. 2016).

        An object keeps its track as long as that is near enough. The others are assigned by least distance.
        """
        together = np.zeros((len(self._objects), len(self._tracks)))  # frames in which a pair is near enough
        track_of: dict[int, int] = {}  # last track of each object
        is_tracked: dict[int, bool] = {}  # whether an object was tracked in its last frame
        pairs = switches = fragmentations = 0
        total = 0.0  # metres
        for step in self.steps:
            near = np.isfinite(step.distance)
            together[np.ix_(step.objects, step.tracks)] += near
            column_of = {track: column for column, track in enumerate(step.tracks.tolist())}
            columns = np.full(len(step.objects), -1)
            for row, number in enumerate(step.objects.tolist()):
                column = column_of.get(track_of.get(number, -1), -1)
                if column >= 0 and near[row, column] and column not in columns:
                    columns[row] = column
            free_rows, free = np.flatnonzero(columns < 0), np.setdiff1d(np.arange(len(column_of)), columns)
            assigned = assign(step.distance[np.ix_(free_rows, free)], unmatched=LARGE)
            columns[free_rows[assigned >= 0]] = free[assigned[assigned >= 0]]
            for row, number in enumerate(step.objects.tolist()):
                column = int(columns[row])
                if column >= 0:
                    pairs, total = pairs + 1, total + float(step.distance[row, column])
                    track = int(step.tracks[column])
                    switches += track_of.get(number, track) != track
                    fragmentations += is_tracked.get(number) is False
                    track_of[number] = track
                if column >= 0 or number in is_tracked:  # It is not yet lost before it is first tracked.
                    is_tracked[number] = column >= 0
        objects = sum(len(step.objects) for step in self.steps)
        tracks = sum(len(step.tracks) for step in self.steps)
        most = together.max(initial=0.0)
        best = assign(most - together, unmatched=most)
        same = float(together[best >= 0, best[best >= 0]].sum())
        with np.errstate(divide="ignore", invalid="ignore"):
            return {
                "mota": float(1 - np.float64(objects + tracks - 2 * pairs + switches) / objects),
                "motp_m": float(np.float64(total) / pairs),
                "idf1": float(np.float64(2 * same) / (objects + tracks)),
                "id_switches": float(switches),
                "fragmentations": float(fragmentations),
            }


class TrackScore:
    """Tracking metrics of all classes.

    Confirmed tracks with a cluster in the frame are compared with the objects to be found. A track on an
    object that need not be found does not count.
    """

    def __init__(self) -> None:
        self.classes: dict[str, ClassTracks] = defaultdict(ClassTracks)

    def add(self, result: FrameResult, truth: Truth, judged: AcceptedNames) -> None:
        """Add a frame, unless its objects have no ids or there are no tracks."""
        tracks = result.tracks
        if tracks is None or not truth.ids:
            return
        boxes = truth.boxes.center
        if tracks.absolute:
            boxes = geometry.apply(result.frame.pose, boxes)
        shown = np.flatnonzero(tracks.confirmed & (tracks.cluster >= 0))
        names = [tracks.names[t].lower() for t in shown]
        offsets = boxes[:, None, :2] - tracks.boxes.center[shown][None, :, :2]
        accepted = accepts(truth, names).T
        distance = np.where(accepted, np.linalg.norm(offsets, axis=2), np.inf)
        distance[distance > MAX_DISTANCE] = np.inf
        column = assign(distance, unmatched=MAX_DISTANCE + 1)
        free = np.setdiff1d(np.arange(len(shown)), column[~truth.must & (column >= 0)])
        labels = [label.lower() for label in truth.labels]
        classes = [judged.of(name) for name in names]
        for k in np.flatnonzero(column >= 0).tolist():
            classes[column[k]] = labels[k]
        for name in {"", *labels, *(cls for cls in classes if cls)}:
            rows = [k for k in np.flatnonzero(truth.must) if name in ("", labels[k])]
            track_rows = [t for t in free if name in ("", classes[t])]
            self.classes[name].add(
                [truth.ids[k] for k in rows],
                tracks.id[shown[track_rows]].tolist(),
                distance[np.ix_(rows, track_rows)],
            )

    def results(self) -> dict[str, dict[str, float]]:
        """Return class -> metric -> value for classes with objects to be found. "" means all classes."""
        results = {}
        for name, identities in sorted(self.classes.items()):
            if any(len(step.objects) for step in identities.steps):
                results[name] = {**identities.hota(), **identities.clear()}
        return results
