"""What a camera's boxes say of the clusters: which points are one object, and how large it is."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bevviz.config import ClusteringConfig, FusionConfig, ObjectsConfig
from bevviz.model import geometry
from bevviz.model.frame import F32, F64, I64, Bool, Intrinsics
from bevviz.model.results import (
    CameraResult,
    Claims,
    Clusters,
    ClusterState,
    Detections,
    DetectionState,
    Splits,
)
from bevviz.stages.box_fit import NO_EDGE
from bevviz.stages.cells import sort_by
from bevviz.stages.cluster_relabel import Part, relabelled
from bevviz.stages.clustering import MIN_SIZE
from bevviz.stages.frustum_points import MARGIN, choose, fit_from, leftover, points_inside
from bevviz.stages.mask_lookup import cover

EDGE_PIXELS = 2.0  # one sigma of the edges of an image box,
EDGE_SHARE = 0.03  # or this share of its width, where that is more
TALL_SHARE = 0.08  # the same of a height, which also depends on where the object stands in the box
LOWEST = 2.0  # sigmas: what is hidden may be as low as it likes
LOWEST_CUT = 1.0  # of what the image cuts off
REACH_SPREAD = 2.0  # sigmas of its size that an object may be deep
BORDER = 2.0  # pixels from the border of the image that a box is cut off at
SAME = 0.7  # IoU from which image boxes of two classes show one object: NMS is by class
KIN = 0.1  # share of an object's points from which a cluster is one that it is made of
NOBODY = -2  # in place of the detection that has a point: nobody can have it


def claim(
    points: F32,
    height: F32 | None,
    clusters: Clusters,
    cameras: Sequence[CameraResult],
    fusion: FusionConfig,
    objects: ObjectsConfig,
    clustering: ClusteringConfig,
) -> tuple[Clusters, tuple[Claims | None, ...], Splits]:
    """Split and merge clusters by the boxes of detections.

    In the frustum of each kept detection, what holds together seen from above (gaps below ``fusion.max_gap``)
    and is not deeper than the class can be is a candidate. It is rated::

        score * overlap * t(height) * share

    with the part of the image box that the candidate's outline covers; how well the box's height in metres at
    the candidate's distance agrees with that of the class (Student's t, lenient with what is lower, as it may
    be hidden in part); and how much of what it hangs together with is in the box. The best rated detection of
    all takes its points, others that wanted them look again, and so on. What is taken in the end is what lies
    in the box of the class's size that is fitted (``boxfit.fit``) to the candidate: that joins what something
    in front has parted, and leaves out what stands too near.

    Of a detection with a mask (``fusion.masks``) only what this covers is in the frustum; what is beside it
    in the box is as if it were not there. Where too few points are in it, it is left aside.

    Noise can be taken, clusters outside the size limits cannot, nor is anything made that is smaller. A
    cluster that an earlier camera has shaped is not shaped again, but can be taken as it is.

    Args:
        points: (P, 3) obstacle points, z up.
        height: (P,) metres above the ground, where known: objects of known size stand on it.
        clusters: of those points.
        cameras: their detections, and the points in their images; those that lack either are skipped.
        fusion: rules.
        objects: sizes of the classes.
        clustering: size limits.

    Returns:
        The clusters as they are now, every point of the old ones in one of them; for each camera what its
        detections took; and what was split and merged.
    """
    work = _Work(points, height, clusters, fusion, objects.sizes, clustering.min_cluster_points)
    taken = [work.look(result) for result in cameras]
    now, row_of, splits = relabelled(
        points, clusters, work.parts, [c.camera.name for c in cameras], clustering
    )
    claims = tuple(
        None if claims is None else Claims(row_of[claims.cluster], claims.fit, claims.boxes, claims.seen)
        for claims in taken
    )
    return now, claims, splits


def _same(found: Detections, a: int, b: int) -> bool:
    """Whether two boxes show one object under two names."""
    overlap = geometry.iou(found.xyxy[[a]], found.xyxy[[b]])[0, 0]
    return found.names[a] != found.names[b] and bool(overlap >= SAME)


@dataclass(frozen=True, slots=True)
class _Candidate:
    fit: float
    rows: I64
    depth: float  # metres on the ground to where it begins


class _Work:
    """One frame: the points that are still free, and the parts that were taken."""

    def __init__(
        self,
        points: F32,
        height: F32 | None,
        clusters: Clusters,
        config: FusionConfig,
        sizes: Mapping[str, tuple[float, ...] | None],
        smallest: int,
    ) -> None:
        self.points, self.height, self.clusters, self.config = points, height, clusters, config
        self.sizes, self.smallest = sizes, smallest
        self.fewest = max(config.min_points, smallest)
        self.parts: list[Part] = []
        kept = np.append(clusters.state == ClusterState.KEPT, True)  # noise is the last
        self.usable = kept[clusters.labels]
        self.owner = np.full(len(points), -1, np.int64)
        self._cameras = 0
        order, self._start = sort_by(clusters.labels + np.int32(1), len(clusters) + 1)  # noise comes first
        self._order = order.astype(np.int64)

    def look(self, result: CameraResult) -> Claims | None:
        """What the detections of one camera take; clusters are numbers of parts."""
        camera, number = result.camera, self._cameras
        self._cameras += 1
        if (
            result.detections is None
            or result.uv is None
            or result.depth is None
            or camera.intrinsics is None
            or camera.camera_from_points is None
        ):
            return None
        view = _View(
            result.uv, result.depth, result.detections, camera.intrinsics, camera.camera_from_points, self
        )
        found = result.detections
        claims = Claims.none(len(found))
        kept = np.flatnonzero(found.state == DetectionState.KEPT).tolist()
        waiting = {d: view.best(d) for d in kept}
        scores = found.score.tolist()
        while waiting:
            d = max(waiting, key=lambda d: waiting[d].fit * scores[d])
            candidate = waiting.pop(d)
            claims.fit[d] = candidate.fit
            if candidate.fit * scores[d] < self.config.min_rating:
                continue
            takers = view.taker[candidate.rows]
            if (lost := takers.max(initial=-1)) >= 0:  # others were better: what is left?
                if not _same(found, int(lost), d):
                    waiting[d] = view.best(d)
                continue
            part = self._owned(candidate.rows)
            if part >= 0:
                rows = self.parts[part].rows
                _, box, seen = view.settled(d, replace(candidate, rows=rows), grow=False)
            else:
                rows = candidate.rows[self.unowned(candidate.rows)]
                if len(rows) < self.fewest:
                    continue
                candidate = replace(candidate, rows=rows)
                rows, box, seen = view.settled(d, candidate, grow=True)
                part = len(self.parts)
                self.parts.append(Part(number, d, rows))
                self.owner[rows] = part
            claims.cluster[d] = part
            claims.boxes.center[d], claims.boxes.size[d], claims.boxes.yaw[d] = box[:3], box[3:6], box[6]
            claims.seen[d] = seen
            view.taker[rows] = d
        return claims

    def _owned(self, rows: I64) -> int:
        """The part of an earlier camera that most of these points are of, -1: none."""
        owners = self.owner[rows]
        owners = owners[owners >= 0]
        return int(np.bincount(owners).argmax()) if 2 * len(owners) > len(rows) else -1

    def unowned(self, rows: I64) -> Bool:
        """(N,) which of these points no part has."""
        return np.asarray(self.owner[rows] < 0)

    def free_of(self, k: int) -> I64:
        """Points of a cluster that no part has."""
        rows = self._order[self._start[k + 1] : self._start[k + 2]]
        return rows[self.owner[rows] < 0]


class _View:
    """The points as one camera sees them, from above with the camera at the origin."""

    def __init__(
        self,
        uv: F32,
        depth: F32,
        detections: Detections,
        intrinsics: Intrinsics,
        camera_from_points: F64,
        work: _Work,
    ) -> None:
        self._work, self._uv, self._detections = work, uv, detections
        points_from_camera = geometry.inverse(camera_from_points)
        self._place = points_from_camera[:2, 3].copy()
        self.taker = np.where(work.usable, np.int32(-1), np.int32(NOBODY))  # detection that has each point
        self._seen = np.flatnonzero((depth > 0) & (depth <= work.config.max_depth) & ~np.isnan(uv[:, 0]))
        # Directions of the middles of the left, upper, right and lower edge of each box.
        x0, y0, x1, y1 = detections.xyxy.T.astype(np.float64)
        mx, my = (x0 + x1) / 2, (y0 + y1) / 2
        corners = np.stack([x0, my, mx, y0, x1, my, mx, y1], axis=1).reshape(-1, 2)
        rays = geometry.rays(corners, intrinsics).reshape(-1, 4, 3)
        middle = (rays[:, 0] + rays[:, 2]) / 2
        flat = np.hypot(middle[:, 0], 1)  # of a ray's length, what lies on the ground
        self._tall = (rays[:, 3, 1] - rays[:, 1, 1]) / flat  # metres high for each metre of distance
        self._wide = (rays[:, 2, 0] - rays[:, 0, 0]) / flat
        across = rays[:, [0, 2]] @ points_from_camera[:2, :3].T  # (D, 2, 2) on the ground
        across /= np.maximum(np.linalg.norm(across, axis=2, keepdims=True), 1e-9)
        self._normals = np.stack([-across[..., 1], across[..., 0]], axis=2)
        self._normals[:, 1] *= -1
        self._cut = np.stack(
            [
                x0 <= BORDER,
                y0 <= BORDER,
                x1 >= intrinsics.width - 1 - BORDER,
                y1 >= intrinsics.height - 1 - BORDER,
            ],
            axis=1,
        )

        with_sigma = np.maximum(EDGE_PIXELS / np.maximum(x1 - x0, 1.0), EDGE_SHARE) * self._wide
        # (D, 2) sigma of the left and right edge for each metre of distance
        self._edge = np.where(self._cut[:, [0, 2]], NO_EDGE, np.maximum(with_sigma, 1e-6)[:, None])
        self._boxes = detections.xyxy.astype(np.float64)
        self._barred = {
            d: barred
            for d in np.flatnonzero(detections.kept).tolist()
            if (barred := _beside_mask(uv, self._seen, detections, d, work.config, work.fewest)) is not None
        }
        sizes = [work.sizes.get(name.lower()) for name in detections.names]
        self._size = np.array([size or (np.nan,) * 6 for size in sizes], np.float64).reshape(-1, 6)

    def best(self, d: int) -> _Candidate:
        """The best rated of what is free in a detection's frustum."""
        config, (length, width, height, *spread) = self._work.config, self._size[d].tolist()
        rows, rating, depth = choose(
            self._work.points,
            self._place,
            self._uv,
            self._allowed(d, self._seen),
            self.taker,
            self._boxes[d],
            config.max_gap,
            math.hypot(length + REACH_SPREAD * spread[0], width + REACH_SPREAD * spread[1]),
            max(self._tall[d], self._wide[d]),
            self._tall[d],
            height,
            math.hypot(spread[2], TALL_SHARE * height),
            LOWEST_CUT if self._cut[d, 1] or self._cut[d, 3] else LOWEST,
            self._work.fewest,
            config.min_iou,
        )
        return _Candidate(rating, rows, depth)

    def _allowed(self, d: int, rows: I64) -> I64:
        """Without what is beside a detection's mask."""
        return rows[~self._barred[d][rows]] if d in self._barred else rows

    def settled(self, d: int, candidate: _Candidate, grow: bool) -> tuple[I64, F64, Bool]:
        """The object's points, its box (centre, size, heading), and which of its sides were seen."""
        work, rows = self._work, candidate.rows
        if not grow:
            return rows, *self._upright(d, rows, *self._fitted(d, rows, candidate.depth))
        # Its clusters are its own beyond the image that cuts it off, and beside a box that is too tight.
        counts = np.bincount(work.clusters.labels[rows] + 1)
        own = [work.free_of(k) for k in np.flatnonzero(counts[1:] > KIN * len(rows)).tolist()]
        kin = self._allowed(d, np.concatenate([*own, np.zeros(0, np.int64)]))
        cut = self._cut[d]
        if cut[0] or cut[2]:
            beyond = kin[np.isnan(self._uv[kin, 0])]
            away = work.points[beyond, :2] - work.points[rows, :2].mean(axis=0)
            long = np.nan_to_num(self._size[d, 0], nan=candidate.depth * self._wide[d])
            rows = np.concatenate([rows, beyond[np.hypot(away[:, 0], away[:, 1]) <= long]])
        flat, _ = self._fitted(d, rows, candidate.depth)
        inside = points_inside(
            work.points,
            self._uv,
            self._allowed(d, self._seen),
            kin,
            self.taker,
            work.owner,
            self._boxes[d],
            flat,
            cut.any(),
        )
        rows = inside if len(inside) >= work.fewest else candidate.rows
        flat, facing = self._fitted(d, rows, candidate.depth, about=flat[4])
        box, seen = self._upright(d, rows, flat, facing)
        for points in own:
            rest = leftover(work.points, points, rows, flat, work.smallest)
            rows = np.concatenate([rows, rest]) if len(rest) else rows
        return rows, box, seen

    def _fitted(self, d: int, rows: I64, depth: float, about: float = np.nan) -> tuple[F64, I64]:
        """Place, length, width and heading on the ground, and the sides that face the camera."""
        prior = self._size[d, [0, 3, 1, 4]]
        longest = max(self._wide[d], self._tall[d]) * depth
        edge = self._edge[d] * depth
        return fit_from(self._work.points, rows, self._place, self._normals[d], edge, prior, longest, about)

    def _upright(self, d: int, rows: I64, flat: F64, facing: I64) -> tuple[F64, Bool]:
        """The box (centre, size, heading), longer than wide without a class, and which sides are seen."""
        work, (x, y, length, width, heading) = self._work, flat.tolist()
        has_size = not math.isnan(self._size[d, 0])
        seen = [facing[0] > 0, facing[0] < 0, facing[1] > 0, facing[1] < 0]
        if not has_size and width > length:
            length, width, heading = width, length, heading - math.pi / 2
            seen = [seen[3], seen[2], seen[0], seen[1]]
        if not -math.pi / 2 < heading <= math.pi / 2:
            heading += math.pi if heading < 0 else -math.pi
            seen = [seen[1], seen[0], seen[3], seen[2]]
        z = work.points[rows, 2]
        low, high = float(z.min()), float(z.max())
        if has_size and work.height is not None:
            low = float(np.partition(z - work.height[rows], len(z) // 2)[len(z) // 2])
            high = max(high, low + self._size[d, 2] - self._size[d, 5])
        length, width, tall = (max(side, MIN_SIZE) for side in (length, width, high - low))
        return np.array([x, y, (low + high) / 2, length, width, tall, heading]), np.array(seen)


def _beside_mask(
    uv: F32, seen: I64, detections: Detections, d: int, config: FusionConfig, fewest: int
) -> Bool | None:
    """(P,) points in a detection's box beside its mask; None: it has none, or too few points are in it."""
    masks = detections.masks
    if masks is None or not config.masks or not masks.has(d):
        return None
    x0, y0, x1, y1 = detections.xyxy[d].tolist()
    margin = MARGIN * (x1 - x0)
    u, v = uv[seen].T
    inside = seen[(u >= x0 - margin) & (u <= x1 + margin) & (v >= y0) & (v <= y1)]
    covered = cover(masks, d, uv[inside], config.mask_margin)
    if np.count_nonzero(covered) < fewest:
        return None
    barred = np.zeros(len(uv), np.bool_)
    barred[inside] = ~covered
    return barred
