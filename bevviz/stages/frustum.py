"""What a camera's boxes say of the clusters: which points are one object, and how large it is."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bevviz import geometry
from bevviz.config import ClusteringConfig, FusionConfig, ObjectsConfig
from bevviz.frame import (
    F32,
    F64,
    I32,
    I64,
    Bool,
    CameraResult,
    Claims,
    Clusters,
    ClusterState,
    Detections,
    DetectionState,
    Intrinsics,
    Splits,
)
from bevviz.stages.boxfit import NO_EDGE, fit
from bevviz.stages.cells import sort_by
from bevviz.stages.clustering import MIN_SIZE, redescribe
from bevviz.stages.cover import cover
from bevviz.stages.kernel import kernel

EDGE_PIXELS = 2.0  # one sigma of the edges of an image box,
EDGE_SHARE = 0.03  # or this share of its width, where that is more
TALL_SHARE = 0.08  # the same of a height, which also depends on where the object stands in the box
TAIL = 4.0  # degrees of freedom of Student's distribution, of how far a height is from its class's
LOWEST = 2.0  # sigmas: what is hidden may be as low as it likes
LOWEST_CUT = 1.0  # of what the image cuts off
MARGIN = 0.05  # of a box's width that is looked at on either side of it
TIGHT = 0.15  # of a box's sides that it may be too tight by
AROUND = 0.5  # of its width, in which points tell that an object goes on
REACH_SPREAD = 2.0  # sigmas of its size that an object may be deep
WINDOWS = 8  # that overlap at each depth
BORDER = 2.0  # pixels from the border of the image that a box is cut off at
SAME = 0.7  # IoU from which image boxes of two classes show one object: NMS is by class
SKIN = 0.1  # metres around a box in which a point is still its own
KIN = 0.1  # share of an object's points from which a cluster is one that it is made of
NOBODY = -2  # in place of the detection that has a point: nobody can have it
SLACK = 0.5  # metres around a box in which what is left of a cluster, too small to be one, is its own


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
    now, row_of, splits = _relabelled(
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


@dataclass(slots=True)
class _Part:
    """What one detection took."""

    camera: int
    detection: int
    rows: I64


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
        self.parts: list[_Part] = []
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
                self.parts.append(_Part(number, d, rows))
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
        rows, rating, depth = _choose(
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
        inside = _inside(
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
            rest = _rest(work.points, points, rows, flat, work.smallest)
            rows = np.concatenate([rows, rest]) if len(rest) else rows
        return rows, box, seen

    def _fitted(self, d: int, rows: I64, depth: float, about: float = np.nan) -> tuple[F64, I64]:
        """Place, length, width and heading on the ground, and the sides that face the camera."""
        prior = self._size[d, [0, 3, 1, 4]]
        longest = max(self._wide[d], self._tall[d]) * depth
        edge = self._edge[d] * depth
        return _fit(self._work.points, rows, self._place, self._normals[d], edge, prior, longest, about)

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


@kernel
def _fit(
    points: F32, rows: I64, place: F64, normals: F64, edge: F64, prior: F64, longest: float, about: float
) -> tuple[F64, I64]:
    """``boxfit.fit`` of some points seen from a place."""
    xy = np.empty((len(rows), 2))
    for k, i in enumerate(rows):
        xy[k, 0], xy[k, 1] = points[i, 0] - place[0], points[i, 1] - place[1]
    flat, facing = fit(xy, normals, edge, prior, longest, about)
    flat[0] += place[0]
    flat[1] += place[1]
    return flat, facing


@kernel
def _within(points: F32, i: int, flat: F64, skin: float) -> bool:
    """Whether a point is in a box seen from above (place, length, width, heading), or as near as ``skin``."""
    c, s = math.cos(flat[4]), math.sin(flat[4])
    x, y = points[i, 0] - flat[0], points[i, 1] - flat[1]
    along, across = abs(c * x + s * y), abs(c * y - s * x)
    return bool(along <= flat[2] / 2 + skin and across <= flat[3] / 2 + skin)


@kernel
def _inside(
    points: F32,
    uv: F32,
    seen: I64,
    kin: I64,
    taker: I32,
    owner: I64,
    box: F64,
    flat: F64,
    unseen: bool,
) -> I64:
    """Points in an object's box that nobody has: of those in the image box, and of its clusters beside that.

    Args:
        points: (P, 3).
        uv: (P, 2) their pixels.
        seen: those in the image.
        kin: those of the object's clusters.
        taker: (P,) -1 where no detection of this camera has it.
        owner: (P,) -1 where none of any camera has.
        box: (4,) image box.
        flat: (5,) place, length, width and heading of the object's box.
        unseen: those of its clusters that are outside the image count, too.
    """
    margin, across, along = MARGIN * (box[2] - box[0]), TIGHT * (box[2] - box[0]), TIGHT * (box[3] - box[1])
    found = np.empty(len(seen) + len(kin), np.int64)
    known = np.zeros(len(points), np.bool_)
    n = 0
    for i in seen:
        if (
            box[0] - margin <= uv[i, 0] <= box[2] + margin
            and box[1] <= uv[i, 1] <= box[3]
            and taker[i] == -1
            and owner[i] == -1
            and _within(points, i, flat, SKIN)
        ):
            found[n] = i
            known[i] = True
            n += 1
    for i in kin:
        if known[i] or taker[i] != -1 or owner[i] != -1:
            continue
        beside = (
            box[0] - across <= uv[i, 0] <= box[2] + across and box[1] - along <= uv[i, 1] <= box[3] + along
        )
        if (beside or (unseen and np.isnan(uv[i, 0]))) and _within(points, i, flat, SKIN):
            found[n] = i
            n += 1
    return found[:n]


@kernel
def _rest(points: F32, own: I64, rows: I64, flat: F64, smallest: int) -> I64:
    """What is left of a cluster, where that is beside the object and too small to be one; else nothing."""
    taken = np.zeros(len(points), np.bool_)
    for i in rows:
        taken[i] = True
    rest = np.empty(len(own), np.int64)
    n = 0
    for i in own:
        if not taken[i]:
            if n + 1 >= smallest or not _within(points, i, flat, SLACK):
                return rest[:0]
            rest[n] = i
            n += 1
    return rest[:n]


@kernel
def _choose(
    points: F32,
    place: F64,
    uv: F32,
    seen: I64,
    taker: I32,
    box: F64,
    gap: float,
    reach: float,
    ratio: float,
    tall: float,
    height: float,
    sigma: float,
    lowest: float,
    fewest: int,
    least: float,
) -> tuple[I64, float, float]:
    """Points of the best candidate, how well it fits and how far away it begins.

    Args:
        points: (P, 3).
        place: (2,) where the camera is.
        uv: (P, 2) pixels.
        seen: points in the image.
        taker: (P,) -1 where nobody has it.
        box: (4,) the image box.
        gap: points that are this near hold together.
        reach: how deep an object can be; NaN: as deep as it is large.
        ratio: how large it is for each metre of distance.
        tall: how high it is for each metre of distance.
        height: of its class, NaN where unknown.
        sigma: of that.
        lowest: in sigmas, how much lower it may be for nothing more.
        fewest: points.
        least: part of the image box that is covered.
    """
    margin, around = MARGIN * (box[2] - box[0]), AROUND * (box[2] - box[0])
    there = np.empty(len(seen), np.int64)
    n = 0
    for i in seen:
        there[n] = i
        beside = box[0] - around <= uv[i, 0] <= box[2] + around
        n += beside and box[1] <= uv[i, 1] <= box[3] and taker[i] == -1
    there = there[:n]
    inside, far = np.empty(n, np.bool_), np.empty(n)
    xy = np.empty((n, 2))
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    for i in range(n):
        xy[i, 0], xy[i, 1] = points[there[i], 0] - place[0], points[there[i], 1] - place[1]
        far[i] = math.hypot(xy[i, 0], xy[i, 1])
        inside[i] = box[0] - margin <= uv[there[i], 0] <= box[2] + margin
        if inside[i]:
            low_x, high_x = min(low_x, xy[i, 0]), max(high_x, xy[i, 0])
            low_y, high_y = min(low_y, xy[i, 1]), max(high_y, xy[i, 1])
    if high_x < low_x:
        return there[:0], 0.0, 0.0

    # What holds together: cells half as wide as the gap, flooded two cells far. -1: to be flooded, -2: empty.
    cell = gap / 2
    columns, rows = int((high_x - low_x) / cell) + 1, int((high_y - low_y) / cell) + 1
    grid = np.full((columns, rows), -2, np.int32)
    at = np.empty((n, 2), np.int64)
    for i in range(n):
        at[i, 0], at[i, 1] = (
            math.floor((xy[i, 0] - low_x) / cell),
            math.floor((xy[i, 1] - low_y) / cell),
        )
        if inside[i]:
            grid[at[i, 0], at[i, 1]] = -1
    stack = np.empty((n, 2), np.int64)
    bodies = 0
    for i in range(n):
        if not inside[i] or grid[at[i, 0], at[i, 1]] != -1:
            continue
        grid[at[i, 0], at[i, 1]] = bodies
        stack[0, 0], stack[0, 1] = at[i, 0], at[i, 1]
        top = 1
        while top:
            top -= 1
            column, row = stack[top, 0], stack[top, 1]
            for p in range(max(column - 2, 0), min(column + 3, columns)):
                for q in range(max(row - 2, 0), min(row + 3, rows)):
                    if grid[p, q] == -1:
                        grid[p, q] = bodies
                        stack[top, 0], stack[top, 1] = p, q
                        top += 1
        bodies += 1
    start = np.zeros(bodies + 1, np.int64)
    body = np.full(n, -1, np.int64)
    for i in range(n):
        for p in range(max(at[i, 0] - 2, 0), min(at[i, 0] + 3, columns)):
            for q in range(max(at[i, 1] - 2, 0), min(at[i, 1] + 3, rows)):
                if grid[p, q] >= 0 and (body[i] < 0 or (p == at[i, 0] and q == at[i, 1])):
                    body[i] = grid[p, q]
        if body[i] >= 0:
            start[body[i] + 1] += 1
    for k in range(bodies):
        start[k + 1] += start[k]
    end, by_body = start[:-1].copy(), np.empty(start[-1], np.int64)
    for i in np.argsort(far):
        if body[i] >= 0:
            by_body[end[body[i]]] = i
            end[body[i]] += 1

    area = (box[2] - box[0]) * (box[3] - box[1])
    best, best_first, best_last, best_far = 0.0, 0, 0, 0.0
    for k in range(bodies):
        first = start[k]
        while first < start[k + 1]:
            begin = far[by_body[first]]
            deep = ratio * begin if np.isnan(reach) else reach
            u0, v0, u1, v1 = np.inf, np.inf, -np.inf, -np.inf
            held = 0
            last = first
            while last < start[k + 1] and far[by_body[last]] <= begin + deep:
                i = by_body[last]
                if inside[i]:
                    held += 1
                    u, v = uv[there[i], 0], uv[there[i], 1]
                    u0, u1, v0, v1 = min(u0, u), max(u1, u), min(v0, v), max(v1, v)
                last += 1
            if held >= fewest:
                covered = max(min(u1, box[2]) - max(u0, box[0]), 0.0) * max(
                    min(v1, box[3]) - max(v0, box[1]), 0.0
                )
                overlap = covered / area if area > 0 else 0.0
                front = far[by_body[first + (last - 1 - first) // WINDOWS]]
                rating = overlap * held / (last - first)
                if not np.isnan(height):
                    z = max((tall * front - height) / sigma, -lowest)
                    rating /= 1 + z * z / TAIL
                if overlap >= least and rating > best:
                    best, best_first, best_last, best_far = rating, first, last, front
            if last == start[k + 1]:
                break
            while first < start[k + 1] and far[by_body[first]] < begin + deep / WINDOWS:
                first += 1
    chosen = by_body[best_first:best_last]
    return there[chosen[inside[chosen]]], best, best_far


def _relabelled(
    points: F32, clusters: Clusters, parts: list[_Part], cameras: list[str], config: ClusteringConfig
) -> tuple[Clusters, I32, Splits]:
    """The clusters with the parts as clusters of their own, the row of each part (-1 at the end), and why."""
    before, fresh = len(clusters), 0
    origins = []
    for part in parts:
        counts = np.bincount(clusters.labels[part.rows] + 1)
        sources = np.flatnonzero(counts)
        origins.append((sources - 1, counts[sources]))
    left = clusters.count.astype(np.int64)
    for sources, counts in origins:
        known = sources >= 0
        left[sources[known]] -= counts[known]
    unchanged, alive = left == clusters.count, left > 0
    number = np.empty(len(parts), np.int64)
    made: list[tuple[int, int, int]] = []  # part, cluster that it took from, points
    for j, (sources, counts) in enumerate(origins):
        pairs = list(zip(sources.tolist(), counts.tolist(), strict=True))
        whole = [(n, k) for k, n in pairs if k >= 0 and n == clusters.count[k]]
        if whole:  # a part that holds all of a cluster has its number
            number[j] = max(whole)[1]
            alive[number[j]] = True
            unchanged[number[j]] = len(pairs) == 1
        else:
            number[j] = before + fresh
            fresh += 1
        if not whole or len(pairs) > 1:
            made += [(j, k, n) for k, n in pairs]
    if not made:
        return clusters, np.append(number, -1).astype(np.int32), Splits.none()

    labels = clusters.labels.copy()
    for part, k in zip(parts, number.tolist(), strict=True):
        labels[part.rows] = k
    alive = np.concatenate([alive, np.ones(fresh, np.bool_)])
    row = np.append(np.where(alive, np.cumsum(alive) - 1, -1), -1).astype(np.int32)
    if not alive.all():
        labels = row[labels]
    kept = np.concatenate([np.where(unchanged, np.arange(before), -1), np.full(fresh, -1)])[alive]
    rows = np.append(row[number], -1).astype(np.int32)
    now = redescribe(points, labels, clusters, kept, rows[:-1], config)
    part_of, source, taken = np.array(made, np.int32).T
    was_noise = source < 0
    return (
        now,
        rows,
        Splits(
            camera=tuple(cameras[parts[j].camera] for j in part_of),
            detection=np.array([parts[j].detection for j in part_of], np.int32),
            cluster=rows[part_of],
            rest=np.where(~was_noise & (np.append(left, 0)[source] > 0), row[source], -1).astype(np.int32),
            is_noise=was_noise,
            points=taken,
            of=np.where(was_noise, taken, np.append(clusters.count, 0)[source]).astype(np.int32),
        ),
    )
