"""Index of a frame's results that answers questions about any subject fast."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import numpy as np

from bevviz.evaluate import MIN_HITS, RANGE, Matches, Truth, exemptions, judge, own_truth
from bevviz.model import geometry
from bevviz.model.box_points import rows_in_rectangles
from bevviz.model.decisions import unmatched_detections
from bevviz.model.frame import F32, F64, I32, I64, U8, U16, Bool, Boxes3D
from bevviz.model.reasons import Reason, Scored, StageOwner, owner_of, scored
from bevviz.model.results import CameraResult, Decision, FrameResult
from bevviz.stages.visibility import image_boxes, share_in_image
from bevviz.why.detection_fits import Fits, find_fits
from bevviz.why.subject import FOOT, IN_VIEW, MARGIN, Subject, points_in_box, points_in_boxes

FEW = 3  # fewer points than this count as none
CORE = 0.5  # share of a detection's width and height that is its middle
DEPTH = 1.5  # metres of depth that the visible part of an object takes
SECTORS = 1 << 16
PART = 0.2  # least share of an object's obstacle voxels in a cluster that belongs to it


class Fate(IntEnum):
    """Result of the stages for one raw point."""

    ELSEWHERE = 0  # not a point of the subject
    GROUND = 1
    NOISE = 2
    SET_ASIDE = 3  # in a cluster outside the size limits
    CLUSTERED = 4  # in a cluster that no detection named
    REPORTED = 5  # in a cluster that became an object
    IN_FRONT = 6  # nearer than the subject, in its direction: hides it


@dataclass(frozen=True, slots=True)
class Directions:
    """Directions of raw points from the origin, sorted by sector."""

    row: I64  # (N,) row of the point
    sector: U16  # (N,) ascending; azimuth in steps of 2 pi / ``SECTORS``
    azimuth: F32  # (N,) radians
    elevation: F32  # (N,) radians
    away: F32  # (N,) horizontal metres

    def between(self, low: float, high: float) -> I64:
        """Return the indices of the points in an interval of azimuths in radians, which may wrap around."""
        parts = []
        for turn in (-2 * np.pi, 0.0, 2 * np.pi):
            ends = np.array([low + turn, high + turn], np.float32)
            sectors = _sector(ends)
            first = np.searchsorted(self.sector, sectors[0])
            azimuth = self.azimuth[first : np.searchsorted(self.sector, sectors[1], "right")]
            parts.append(first + np.flatnonzero((azimuth >= ends[0]) & (azimuth < ends[1])))
        return np.concatenate(parts)


def _sector(azimuth: F32) -> U16:
    """Return the sector of each azimuth."""
    share = np.clip(azimuth / (2 * np.pi) + 0.5, 0, 1)
    return np.asarray(share * (SECTORS - 1), np.uint16)


class FrameIndex:
    """Index of one frame. Each array is computed at its first use.

    Args:
        result: result of the frame.
        classes: names of the classes that the detector knows. Classes detected in this frame are added.
        truth: ground truth of the frame; None: its own.
    """

    def __init__(self, result: FrameResult, classes: Sequence[str] = (), truth: Truth | None = None) -> None:
        self.result, self._truth = result, truth
        seen = [name for c in result.cameras if c.detections is not None for name in c.detections.names]
        self.classes = tuple(dict.fromkeys([*classes, *seen]))
        self._places: dict[tuple[object, ...], I64] = {}
        self._uv: dict[str, F32] = {}
        self._in_image: dict[str, I64] = {}  # rows of the raw points in each camera's image
        self._fits: dict[str, Fits] = {}  # by camera
        self._truth_boxes: dict[str, tuple[F32, F32]] = {}  # by camera
        self._labels: dict[int, I32] = {}
        self.false: Mapping[int, Reason] | None = None  # causes of false objects, when they are known

    def for_result(self, result: FrameResult) -> FrameIndex:
        """Return the index of another result of the same frame. Arrays of the frame alone are shared."""
        other = FrameIndex(result, self.classes)
        other._places, other._uv, other._in_image = self._places, self._uv, self._in_image
        other._truth_boxes = self._truth_boxes
        other.truth, other.shown, other.labels_in_evaluate = self.truth, self.shown, self.labels_in_evaluate
        other.directions, other._truth_points = self.directions, self._truth_points
        return other

    def with_truth(self, truth: Truth) -> FrameIndex:
        """Return the index of the same result with another ground truth. Arrays without it are shared."""
        other = FrameIndex(self.result, self.classes, truth)
        other._uv, other._in_image = self._uv, self._in_image
        return other

    def origin(self, section: str) -> StageOwner:
        """Return the owner of the stage of a section."""
        return self._origins[section]

    @cached_property
    def _origins(self) -> dict[str, StageOwner]:
        sections = "ground", "clustering", "detector", "objects"
        return {section: owner_of(self.result.config, section) for section in sections}

    # --- points --------------------------------------------------------------------------------

    @cached_property
    def directions(self) -> Directions:
        """Directions of the raw points."""
        x, y, z = self.result.frame.points.T
        azimuth = np.arctan2(y, x)
        away, sector = np.hypot(x, y), _sector(azimuth)
        row = np.argsort(sector, kind="stable")  # NumPy sorts small integers in a tenth of the time.
        return Directions(row, sector[row], azimuth[row], np.arctan2(z, away)[row], away[row])

    @cached_property
    def obstacle(self) -> I64:
        """(M,) row of each voxel among the obstacles, -1: ground."""
        ground = self.result.ground
        if ground is None:
            return np.zeros(0, np.int64)
        return np.where(ground.mask, -1, np.cumsum(~ground.mask) - 1)

    @cached_property
    def cluster(self) -> I32:
        """(N,) cluster of each raw point, -1: none."""
        voxels, ground, clusters = self.result.voxels, self.result.ground, self.result.clusters
        if voxels is None or ground is None or clusters is None:
            return np.full(len(self.result.frame.points), -1, np.int32)
        of_voxel = np.full(len(ground.mask), -1, np.int32)
        of_voxel[~ground.mask] = clusters.labels
        return of_voxel[voxels.inverse]

    def obstacles_of(self, subject: Subject) -> Bool:
        """Return (M - ground,) whether each obstacle voxel holds a raw point of the subject."""
        voxels, ground = self.result.voxels, self.result.ground
        if voxels is None or ground is None:
            return np.zeros(0, np.bool_)
        is_own = np.zeros(len(ground.mask), np.bool_)
        is_own[voxels.inverse[self.place(subject)]] = True
        return is_own[~ground.mask]

    @property
    def first_labels(self) -> I32:
        """(M,) label that the clustering itself gave each obstacle, before detections divided clusters."""
        result = self.result
        if result.clusters is None or result.obstacles is None or result.first_labels is None:
            return np.zeros(0, np.int32)
        return result.first_labels if self.origin("clustering").ours else result.clusters.labels

    @cached_property
    def fate(self) -> U8:
        """(N,) Fate of each raw point, regardless of the subject."""
        result = self.result
        fate = np.full(len(result.frame.points), Fate.CLUSTERED, np.uint8)
        if result.voxels is None or result.ground is None:
            return fate
        if result.clusters is not None:
            of_cluster = np.full(len(result.clusters) + 1, Fate.CLUSTERED, np.uint8)
            of_cluster[:-1][~result.clusters.kept] = Fate.SET_ASIDE
            if result.objects is not None:
                of_cluster[result.objects.cluster] = Fate.REPORTED
            of_cluster[-1] = Fate.NOISE
            fate = of_cluster[self.cluster]
        fate[result.ground.mask[result.voxels.inverse]] = Fate.GROUND
        return fate

    def uv(self, camera: CameraResult) -> F32:
        """Return (N, 2) pixels of the raw points, NaN behind the camera or without its pose."""
        name, view = camera.camera.name, camera.camera
        if name not in self._uv:
            points = self.result.frame.points
            if view.intrinsics is None or view.camera_from_points is None:
                self._uv[name] = np.full((len(points), 2), np.nan, np.float32)
            else:
                self._uv[name], _ = geometry.project(
                    geometry.apply(view.camera_from_points, points), view.intrinsics
                )
        return self._uv[name]

    def place(self, subject: Subject) -> I64:
        """Return the rows of the subject's raw points: listed, or inside its box, sphere or frustum."""
        if subject.is_place or subject.points is not None:  # The number of possible places has no limit.
            return self._place(subject)
        key = subject.key if subject.xyxy is None else (*subject.key, *subject.xyxy.tolist())
        if key not in self._places:
            self._places[key] = self._place(subject)
        return self._places[key]

    def _place(self, subject: Subject) -> I64:
        """Find the rows of the subject's raw points."""
        if subject.points is not None:
            return subject.points
        points, box = self.result.frame.points, subject.box
        if box is not None:
            if subject.kind == "truth":
                return self._truth_points[subject.row]
            _, rows = _near(points, box)
            if subject.kind == "point":
                away = np.linalg.norm(points[rows] - box.center[0], axis=1)
                return np.asarray(rows[away < box.size[0, 0] / 2])
            foot = -MARGIN if subject.kind == "cell" else FOOT
            return rows[points_in_box(box, points[rows], MARGIN, foot)]
        camera = self.result.camera(subject.camera)
        if camera is None or subject.xyxy is None:
            return np.zeros(0, np.int64)
        rows = self._in_frustum(camera, subject.xyxy)
        return self._foreground(camera, subject.xyxy, rows) if subject.kind == "detection" else rows

    @cached_property
    def _truth_points(self) -> Sequence[I64]:
        """Rows of the raw points of each object of the ground truth."""
        truth, points = self.labels_in_evaluate, self.result.frame.points
        if truth is None or not len(truth.boxes):
            return ()
        first, rows = _near(points, truth.boxes)
        row = np.repeat(np.arange(len(truth.boxes)), np.diff(first))
        is_inside = points_in_boxes(truth.boxes.chosen(row), points[rows], MARGIN, FOOT)
        ends = np.searchsorted(row[is_inside], np.arange(1, len(truth.boxes)))
        return np.split(rows[is_inside], ends)

    def _in_frustum(self, camera: CameraResult, xyxy: F32) -> I64:
        """Return the rows of the raw points that project into an image box."""
        uv, intrinsics = self.uv(camera), camera.camera.intrinsics
        if intrinsics is None:
            return np.zeros(0, np.int64)
        image = np.array([0, 0, intrinsics.width, intrinsics.height], np.float32)
        if (xyxy[:2] < image[:2]).any() or (xyxy[2:] > image[2:]).any():
            return _rows_in(uv, xyxy)
        name = camera.camera.name
        if name not in self._in_image:
            self._in_image[name] = _rows_in(uv, image)
        rows = self._in_image[name]
        return rows[_rows_in(uv[rows], xyxy)]

    def _foreground(self, camera: CameraResult, xyxy: F32, rows: I64) -> I64:
        """Keep the points of a detection's frustum at the depth that is most frequent in its middle.

        The background shows around an object, but seldom in the middle of its box.
        """
        view = camera.camera
        if view.camera_from_points is None:
            return rows
        depth = geometry.apply(view.camera_from_points, self.result.frame.points[rows])[:, 2]
        half = (xyxy[2:] - xyxy[:2]) / 2
        off = np.abs(self.uv(camera)[rows] - xyxy[:2] - half) / half
        middle = np.sort(depth[(off < CORE).all(axis=1)])
        if len(middle) < FEW:
            return rows
        first = int((np.searchsorted(middle, middle + DEPTH) - np.arange(len(middle))).argmax())
        near = middle[first]
        foreground: I64 = rows[(depth >= near - DEPTH) & (depth <= near + 2 * DEPTH)]
        return foreground

    # --- the ground truth ----------------------------------------------------------------------

    @cached_property
    def truth(self) -> tuple[Subject, ...]:
        """Objects of the ground truth, in order of their rows."""
        truth = self.labels_in_evaluate
        return () if truth is None else truth_subjects(truth)

    @cached_property
    def labels_in_evaluate(self) -> Truth | None:
        """The ground truth in the form that ``evaluate`` judges objects by."""
        return own_truth(self.result.frame) if self._truth is None else self._truth

    @property
    def is_labelled(self) -> bool:
        """Whether the ground truth names every object of the frame."""
        truth = self.labels_in_evaluate
        return truth is not None and truth.whole

    @cached_property
    def matches(self) -> Matches | None:
        """The judgement of ``evaluate`` about the objects of the frame."""
        objects, truth = self.result.objects, self.labels_in_evaluate
        return None if objects is None or truth is None else judge(objects, truth, self.result.cameras)

    def exemption(self, row: int) -> str:
        """Return why an object without a label is neither right nor wrong; empty: it is judged."""
        objects, truth, matches = self.result.objects, self.labels_in_evaluate, self.matches
        if objects is None or truth is None or matches is None or matches.partner[row] >= 0:
            return ""
        return exemptions(objects, truth, self.result.cameras)[row]

    def must(self, subject: Subject) -> bool:
        """Return whether a subject had to be reported.

        Ground truth tells. Without it, these are the subjects with 10 points or more whose median is within
        40 m. Of detections these are the kept ones, without doubles.
        """
        truth = self.labels_in_evaluate
        if truth is not None and not subject.is_place:
            return subject.kind == "truth" and bool(truth.must[subject.row])
        if subject.kind == "detection" and subject.row not in self._detections_to_match(subject.camera):
            return False
        points = self.result.frame.points[self.place(subject)]
        return len(points) >= MIN_HITS and bool(np.median(np.hypot(*points[:, :2].T)) <= RANGE)

    def _detections_to_match(self, name: str) -> Collection[int]:
        """Return the kept detections of a camera, without doubles."""
        camera = self.result.camera(name)
        if camera is None or camera.detections is None:
            return ()
        rows, fusion = np.flatnonzero(camera.detections.kept), camera.fusion
        if fusion is not None:
            is_matched = fusion.detection_decision[rows] == Decision.MATCHED
            rows = rows[is_matched | np.isin(rows, unmatched_detections(camera))]
        return rows.tolist()

    @cached_property
    def of_truth(self) -> Bool:
        """(K,) whether at least half of a cluster's points are on objects of the ground truth."""
        known = np.zeros(len(self.result.frame.points), np.bool_)
        for subject in self.truth:
            known[self.place(subject)] = True
        number = 0 if self.result.clusters is None else len(self.result.clusters)
        clustered = self.cluster >= 0
        whole = np.bincount(self.cluster[clustered], minlength=number)
        return np.bincount(self.cluster[clustered & known], minlength=number) * 2 >= np.maximum(whole, 1)

    @cached_property
    def shown(self) -> Mapping[str, F64]:
        """(K,) share of each object of the ground truth that is inside the image, by camera with a pose."""
        boxes = Boxes3D.joined([subject.box for subject in self.truth if subject.box is not None])
        return {
            c.camera.name: share_in_image(boxes, c.camera)
            for c in self.result.cameras
            if c.camera.intrinsics is not None and c.camera.camera_from_points is not None
        }

    def in_view(self, subject: Subject, camera: str = "") -> bool:
        """Return whether a camera has a subject in its image. Every subject is, where no camera has a pose.

        Args:
            subject: the subject.
            camera: name of the camera; empty: any camera.
        """
        names = [name for name in self.shown if camera in ("", name)]
        if not names or subject.box is None:
            return True
        if subject.kind == "truth":
            return any(self.shown[name][subject.row] >= IN_VIEW for name in names)
        views = [c.camera for c in self.result.cameras if c.camera.name in names]
        return any(share_in_image(subject.box, view)[0] >= IN_VIEW for view in views)

    def labels(self, row: int) -> I32:
        """Return the cluster of each obstacle voxel of an object of the ground truth, -1: noise."""
        if row not in self._labels:
            voxels, clusters, points = self.result.voxels, self.result.clusters, self.place(self.truth[row])
            if voxels is None or clusters is None:
                return np.zeros(0, np.int32)
            obstacle = self.obstacle[np.unique(voxels.inverse[points])]
            self._labels[row] = clusters.labels[obstacle[obstacle >= 0]]
        return self._labels[row]

    def voxels_in_cluster(self, cluster: int, row: int) -> int:
        """Return the voxels of a ground truth object in a cluster, 0 if they are a small part of it."""
        labels = self.labels(row)
        count = int((labels == cluster).sum())
        return count if count >= max(FEW, PART * len(labels)) else 0

    def mates(self, cluster: int, row: int) -> Iterator[int]:
        """Yield the rows of other objects of the ground truth with points in the cluster."""
        clusters, truth = self.result.clusters, self.labels_in_evaluate
        if clusters is None or truth is None:
            return
        center, half = clusters.aabb.center[cluster], clusters.aabb.size[cluster] / 2
        diagonal = np.hypot(truth.boxes.size[:, 0], truth.boxes.size[:, 1])
        reach = half[:2] + diagonal[:, None] / 2 + MARGIN
        near = (np.abs(truth.boxes.center[:, :2] - center[:2]) <= reach).all(axis=1)
        for other in np.flatnonzero(near).tolist():
            if other != row and self.voxels_in_cluster(cluster, other):
                yield other

    def fits(self, camera: CameraResult) -> Fits:
        """Return how well each detection of a camera fits each object of the ground truth."""
        name, detections = camera.camera.name, camera.detections
        assert detections is not None
        if name not in self._fits:
            names = {name: [subject.accepts(name) for subject in self.truth] for name in {*detections.names}}
            accepted = np.array([names[name] for name in detections.names], np.bool_)
            self._fits[name] = find_fits(detections, *self.image_boxes(camera), accepted)
        return self._fits[name]

    def owners(self, camera: CameraResult) -> I64:
        """Return the (D,) row of the ground truth object of each detection, -1: none."""
        return self.fits(camera).owner

    def owner_of(self, camera: str, detection: int) -> int:
        """Return the row of the ground truth object of a detection, -1: none, or no detection."""
        result = self.result.camera(camera)
        return -1 if result is None else int(self.owners(result)[detection])

    def scored(self, camera: str, detection: int) -> Scored:
        """Return class and score of a detection."""
        result = self.result.camera(camera)
        assert result is not None and result.detections is not None
        return scored(result.detections, detection)

    def image_boxes(self, camera: CameraResult) -> tuple[F32, F32]:
        """Return (K, 4) projected boxes of the ground truth, and the image boxes around their points."""
        name = camera.camera.name
        if name not in self._truth_boxes:
            whole = np.full((len(self.truth), 4), np.nan, np.float32)
            seen = whole.copy()
            truth, shown = self.labels_in_evaluate, np.flatnonzero(self.shown.get(name, np.zeros(0)) > 0)
            if truth is not None and len(shown):
                around = image_boxes(truth.boxes.chosen(shown), camera.camera)
                is_whole = np.isfinite(around).all(axis=1)
                shown = shown[is_whole]
                whole[shown] = around[is_whole]
                points = [self._truth_points[row] for row in shown.tolist()]
                row = np.repeat(shown, [len(rows) for rows in points])
                uv = self.uv(camera)[np.concatenate([*points, np.zeros(0, np.int64)])]
                inside = _rows_in(uv, whole[row].T)
                rows, first, count = np.unique(row[inside], return_index=True, return_counts=True)
                if len(rows):
                    low, high = (edge.reduceat(uv[inside], first) for edge in (np.minimum, np.maximum))
                    enough = count >= FEW
                    seen[rows[enough]] = np.hstack([low, high])[enough]
            self._truth_boxes[name] = whole, seen
        return self._truth_boxes[name]

    @cached_property
    def competing(self) -> tuple[Subject, ...]:
        """Kept detections of no ground truth object. The ground truth may lack some objects."""
        subjects = []
        for camera in self.result.cameras:
            if camera.detections is not None:
                kept = camera.detections.kept & (self.owners(camera) < 0)
                subjects += [
                    detection_subject(self.result, camera, row) for row in np.flatnonzero(kept).tolist()
                ]
        return tuple(subjects)


def _rows_in(uv: F32, box: F32) -> I64:
    """Return the rows of the pixels inside an image box, or each inside its own: (4, N)."""
    u, v = uv.T
    x0, y0, x1, y1 = box
    with np.errstate(invalid="ignore"):
        return np.flatnonzero((u >= x0) & (u <= x1) & (v >= y0) & (v <= y1))


def _near(points: F32, boxes: Boxes3D) -> tuple[I64, I64]:
    """Find the points that may be in each box or in the margin around it, see ``rows_in_rectangles``."""
    half = np.hypot(boxes.size[:, 0], boxes.size[:, 1]) / 2
    reach = np.column_stack([half + np.float32(MARGIN), half + np.float32(2 * MARGIN)])
    center = boxes.center[:, :2]
    low, high = (center - reach).astype(np.float64), (center + reach).astype(np.float64)
    return rows_in_rectangles(points, low, high)


def truth_subjects(truth: Truth) -> tuple[Subject, ...]:
    """Return the objects of a frame's ground truth, in order of their rows."""
    away = truth.boxes.distance
    return tuple(
        Subject(
            "truth",
            f"the {label.lower()} at {away[row]:.1f} m",
            label,
            truth.accepted[row],
            row,
            box=truth.boxes.chosen([row]),
        )
        for row, label in enumerate(truth.labels)
    )


def detection_subject(result: FrameResult, camera: CameraResult, row: int) -> Subject:
    """Return a detection as a subject of its own."""
    detections, clusters = camera.detections, result.clusters
    assert detections is not None
    label = detections.names[row]
    cluster = -1 if camera.fusion is None else camera.fusion.matched_cluster(row)
    name = f"the {label} {detections.score[row]:.2f} in {camera.camera.name}"
    if clusters is not None and cluster >= 0:
        name += f" at {clusters.boxes(result.config.clustering).distance[cluster]:.1f} m"
    return Subject(
        "detection", name, label, frozenset({label.lower()}), row, camera.camera.name, detections.xyxy[row]
    )
