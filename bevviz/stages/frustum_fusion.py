"""Split and merge clusters by the detections of the cameras, and fit a box to each detected object."""

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
from bevviz.stages.box_fit import MAX_SPREAD, NO_EDGE, STRAY_SHARE
from bevviz.stages.cells import sort_by
from bevviz.stages.cluster_relabel import ClaimedPoints, relabel_claimed
from bevviz.stages.clustering import MIN_SIZE
from bevviz.stages.frustum_points import (
    MARGIN,
    TIGHT_SHARE,
    choose_candidate,
    cluster_remainder,
    fit_from,
    points_inside,
    share_inside,
)
from bevviz.stages.mask_lookup import is_covered

EDGE_PIXELS = 2.0  # pixels, one sigma of the edges of an image box,
EDGE_SHARE = 0.03  # or this share of the box's width if that is more;
EDGE_DOUBT = 2.0  # an edge of a box of score s is 1 + EDGE_DOUBT (1 - s) times as uncertain
TALL_SHARE = 0.08  # sigma of a height as a share of it; the object may stand anywhere in the box
HIDDEN_SIGMAS = 2.0  # sigmas: a lower height costs no more than this, because the object may be partly hidden
HIDDEN_SIGMAS_CUT = 1.0  # the same for a box that the image border cuts
REACH_SPREAD = 2.0  # sigmas of its size by which an object may be deeper than its class

RARER = 2.5  # cost of each further size of a class; the first one is the most frequent
NO_SIDES = 1.0  # metres, mean length of a class below which objects have no flat sides: people
UNSEEN_WIDTH = 0.12  # metres by which such an object is wider than its points: no beam hits its very edge
WIDTH_SIGMA = 0.12  # metres, one sigma of the width that the points show
BEHIND = 0.05  # metres from the median of such an object's points to its centre
BORDER = 2.0  # pixels: a box nearer to the image border than this is cut off by it
SAME_OBJECT_IOU = 0.7  # above it boxes of two classes show one object, because NMS works by class
MIN_CLUSTER_SHARE = 0.1  # share of an object's points above which a cluster counts as a part of the object
WHOLE_SHARE = 0.95  # share of an object's clusters in one box of its class above which they are the object
SIMILAR = 2.5  # ratio of the mean lengths of two classes up to which their objects stand side by side
SHORT = 3.0  # metres; depth separates longer objects
DIVIDE_ROUNDS = 3  # rounds in which points are divided by place, with better places each time
UNAVAILABLE = -2  # value of ``taker`` for a point that no detection may claim


def claim_clusters(
    points: F32,
    height: F32 | None,
    clusters: Clusters,
    cameras: Sequence[CameraResult],
    fusion: FusionConfig,
    objects: ObjectsConfig,
    clustering: ClusteringConfig,
) -> tuple[Clusters, tuple[Claims | None, ...], Splits]:
    """Split and merge clusters by the boxes of detections.

    Candidates are searched in the frustum of each kept detection. A candidate is a set of points that is
    connected seen from above (gaps below ``fusion.max_gap``) and not deeper than its class can be. Its rating
    is ::

        score * overlap * t(height) * t(foot) * share

    ``overlap`` is the part of the image box that the candidate's outline covers. ``t(height)`` is the
    agreement of the box's height in metres at the candidate's distance with that of the class. It is
    Student's t, lenient with lower heights because the object may be partly hidden. ``t(foot)`` is the
    agreement of the lower edge of the image box with the ground below the candidate, whatever its class.
    ``share`` is the share of the connected points, beside and above the box too, that are in the box. Two
    detections of similar size that want the same points divide them by their boxes in the image. The best
    rated detection of all claims its points. Other detections that wanted these points search again. This is
    repeated until none is left. Then ``box_fit.fit`` fits a box of the class's size to the candidate, and the
    detection claims the points in it. This joins parts that an occluder separated, and drops points that
    stand too near. If a box of the class holds the candidate's clusters whole, the detection claims them even
    where its image box is too narrow. Otherwise one face of a car, seen alone, would not tell its heading.

    For a detection with a mask (``fusion.masks``) only points under the mask are in the frustum. The other
    points in the box are ignored. A mask with too few points is ignored.

    Noise can be claimed. Clusters outside the size limits cannot, and no smaller cluster is made. A cluster
    that an earlier camera has changed is not changed again, but can be claimed unchanged.

    Args:
        points: (P, 3) obstacle points, z up.
        height: (P,) metres above the ground, if known. Objects of known size stand on the ground.
        clusters: clusters of those points.
        cameras: detections, and the points in the images. A camera without either is skipped.
        fusion: rules.
        objects: sizes of the classes.
        clustering: size limits.

    Returns:
        The new clusters; every point of the old clusters is in one of them.
        The claims of each camera.
        The splits and merges.
    """
    state = _FrameClaims(points, height, clusters, fusion, objects.sizes, clustering.min_cluster_points)
    claims_of_cameras = [state.claim(result) for result in cameras]
    new_clusters, row_of, splits = relabel_claimed(
        points, clusters, state.parts, [c.camera.name for c in cameras], clustering
    )
    claims = tuple(
        None if claims is None else Claims(row_of[claims.cluster], claims.fit, claims.boxes, claims.seen)
        for claims in claims_of_cameras
    )
    return new_clusters, claims, splits


@dataclass(frozen=True, slots=True)
class _Candidate:
    """Points that a detection may claim."""

    fit: float
    rows: I64
    depth: float  # metres on the ground to its front


@dataclass(frozen=True, slots=True)
class _FittedBox:
    """A box on the ground, and the size of the class that it was fitted with."""

    flat: F64  # (5,) centre, length, width and heading
    facing: I64  # (2,) sides that face the camera, see ``box_fit.fit``
    size: F64  # (6,) NaN: the class has none


class _FrameClaims:
    """Claims of one frame: the points that are still free, and the parts already claimed."""

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
        self.ground = np.zeros(0, np.float32) if height is None else points[:, 2] - height
        self.fewest = max(config.min_points, smallest)
        self.parts: list[ClaimedPoints] = []
        kept = np.append(clusters.state == ClusterState.KEPT, True)  # noise has label -1, the last element
        self.usable = kept[clusters.labels]
        self.owner = np.full(len(points), -1, np.int64)
        self._cameras = 0
        order, self._start = sort_by(clusters.labels + np.int32(1), len(clusters) + 1)  # noise first
        self._order = order.astype(np.int64)

    def claim(self, result: CameraResult) -> Claims | None:
        """Return the claims of one camera's detections. Their ``cluster`` is the number of a part."""
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
        view = _CameraFrustums(
            result.uv, result.depth, result.detections, camera.intrinsics, camera.camera_from_points, self
        )
        detections = result.detections
        claims = Claims.none(len(detections))
        kept = np.flatnonzero(detections.state == DetectionState.KEPT).tolist()
        scores = detections.score.tolist()
        waiting = view.divided({d: view.best(d) for d in kept})
        while waiting:
            d = max(waiting, key=lambda d: waiting[d].fit * scores[d])
            candidate = waiting.pop(d)
            claims.fit[d] = candidate.fit
            if candidate.fit * scores[d] < self.config.min_rating:
                continue
            takers = view.taker[candidate.rows]
            # A better detection has some of the points. Search again among the remaining points.
            if (taker := takers.max(initial=-1)) >= 0:
                if not view.is_same_object(int(taker), d):
                    waiting[d] = view.best(d)
                continue
            part = self._earlier_part(candidate.rows)
            if part >= 0:
                rows = self.parts[part].rows
                _, box, seen = view.settle(d, replace(candidate, rows=rows), grow=False)
            else:
                rows = candidate.rows[self.unowned(candidate.rows)]
                if len(rows) < self.fewest:
                    continue
                candidate = replace(candidate, rows=rows)
                rows, box, seen = view.settle(d, candidate, grow=True)
                part = len(self.parts)
                self.parts.append(ClaimedPoints(number, d, rows))
                self.owner[rows] = part
            claims.cluster[d] = part
            claims.boxes.center[d], claims.boxes.size[d], claims.boxes.yaw[d] = box[:3], box[3:6], box[6]
            claims.seen[d] = seen
            view.taker[rows] = d
        return claims

    def _earlier_part(self, rows: I64) -> int:
        """Return the part of an earlier camera that owns most of these points, -1 for none."""
        owners = self.owner[rows]
        owners = owners[owners >= 0]
        return int(np.bincount(owners).argmax()) if 2 * len(owners) > len(rows) else -1

    def unowned(self, rows: I64) -> Bool:
        """Return the (N,) mask of points that no part owns."""
        return np.asarray(self.owner[rows] < 0)

    def free_of(self, k: int) -> I64:
        """Return the points of a cluster that no part owns."""
        rows = self._order[self._start[k + 1] : self._start[k + 2]]
        return rows[self.owner[rows] < 0]


class _CameraFrustums:
    """Points as one camera sees them, on the ground plane with the camera at the origin."""

    def __init__(
        self,
        uv: F32,
        depth: F32,
        detections: Detections,
        intrinsics: Intrinsics,
        camera_from_points: F64,
        work: _FrameClaims,
    ) -> None:
        self._work, self._uv, self._detections = work, uv, detections
        points_from_camera = geometry.inverse(camera_from_points)
        self._place, self._eye = points_from_camera[:2, 3].copy(), float(points_from_camera[2, 3])
        self.taker = np.where(work.usable, np.int32(-1), np.int32(UNAVAILABLE))  # detection
        self._seen = np.flatnonzero((depth > 0) & (depth <= work.config.max_depth) & ~np.isnan(uv[:, 0]))
        # Rays go through the middles of the left, upper, right and lower edge of each box.
        x0, y0, x1, y1 = detections.xyxy.T.astype(np.float64)
        mx, my = (x0 + x1) / 2, (y0 + y1) / 2
        corners = np.stack([x0, my, mx, y0, x1, my, mx, y1], axis=1).reshape(-1, 2)
        rays = geometry.rays(corners, intrinsics).reshape(-1, 4, 3)
        middle = (rays[:, 0] + rays[:, 2]) / 2
        flat = np.hypot(middle[:, 0], 1)  # horizontal length of a ray of depth 1
        self._tall = (rays[:, 3, 1] - rays[:, 1, 1]) / flat  # metres of height for each metre of distance
        self._wide = (rays[:, 2, 0] - rays[:, 0, 0]) / flat
        lower = rays[:, 3] @ points_from_camera[:3, :3].T
        self._drop = lower[:, 2] / np.maximum(np.hypot(lower[:, 0], lower[:, 1]), 1e-9)
        across = rays[:, [0, 2]] @ points_from_camera[:2, :3].T  # (D, 2, 2) directions on the ground
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

        share = EDGE_SHARE * (1 + EDGE_DOUBT * (1 - detections.score))
        with_sigma = np.maximum(EDGE_PIXELS / np.maximum(x1 - x0, 1.0), share) * self._wide
        low_sigma = np.maximum(EDGE_PIXELS / np.maximum(y1 - y0, 1.0), share) * self._tall
        # (D,) sigma of the lower edge for each metre of distance
        self._footing = np.where(self._cut[:, 3], np.inf, low_sigma)
        # (D, 2) sigma of the left and right edge for each metre of distance
        self._edge = np.where(self._cut[:, [0, 2]], NO_EDGE, np.maximum(with_sigma, 1e-6)[:, None])
        self._boxes = detections.xyxy.astype(np.float64)
        kept = np.flatnonzero(detections.kept)
        self._beside_masks = {
            d: barred
            for d in kept.tolist()
            if (barred := _points_beside_mask(uv, self._seen, detections, d, work.config, work.fewest))
            is not None
        }
        unknown = (np.nan,) * 6
        self._sizes = {  # (M, 6) sizes of each kept detection's class
            d: np.array(work.sizes.get(detections.names[d].lower()) or unknown, np.float64).reshape(-1, 6)
            for d in kept.tolist()
        }
        self._overlap = np.zeros((len(detections), len(detections)), np.float32)
        self._overlap[np.ix_(kept, kept)] = geometry.iou(detections.xyxy[kept], detections.xyxy[kept])

    def is_same_object(self, a: int, b: int) -> bool:
        """Return whether two boxes show one object under two names."""
        names = self._detections.names
        return names[a] != names[b] and bool(self._overlap[a, b] >= SAME_OBJECT_IOU)

    def best(self, d: int) -> _Candidate:
        """Return the best rated candidate among the free points in a detection's frustum, for any size."""
        config = self._work.config
        sizes = [
            (
                math.hypot(length + REACH_SPREAD * long_spread, width + REACH_SPREAD * wide_spread),
                height,
                math.hypot(tall_spread, TALL_SHARE * height),
            )
            for length, width, height, long_spread, wide_spread, tall_spread in self._sizes[d].tolist()
        ]
        rows, rating, depth = choose_candidate(
            self._work.points,
            self._place,
            self._uv,
            self._allowed(d, self._seen),
            self.taker,
            self._boxes[d],
            config.max_gap,
            max(self._tall[d], self._wide[d]),
            self._tall[d],
            np.array(sizes),
            self._lowest(d),
            self._work.ground,
            self._eye,
            self._drop[d],
            self._footing[d],
            self._work.fewest,
            config.min_iou,
        )
        return _Candidate(rating, rows, depth)

    def divided(self, candidates: dict[int, _Candidate]) -> dict[int, _Candidate]:
        """Divide points that two detections of similar size want, and return the new candidates.

        Depth does not separate such objects, for example two people side by side.
        """
        likely = [
            d
            for d, c in candidates.items()
            if c.fit * self._detections.score[d] >= self._work.config.min_rating
        ]
        divided = set[int]()
        for i, d in enumerate(likely):
            for e in likely[i + 1 :]:
                if self._divide(d, e, candidates[d].rows, candidates[e].rows):
                    divided |= {d, e}
        return candidates | {d: self.best(d) for d in divided}

    def _divide(self, d: int, e: int, rows_d: I64, rows_e: I64) -> bool:
        """Divide the points that two detections want by their boxes in the image and by place.

        Each point goes to the detection that is more likely to have it. A point is most likely in the middle
        of an image box and at the mean place of the points that the detection has so far.

        Returns:
            Whether both detections keep enough points.
        """
        if not 0 < self._overlap[d, e] < SAME_OBJECT_IOU:
            return False
        long, other = self._sizes[d][0, 0], self._sizes[e][0, 0]  # NaN, unlike any other, without a size
        if not (long <= min(SIMILAR * other, SHORT) and other <= min(SIMILAR * long, SHORT)):
            return False
        shared = np.intersect1d(rows_d, rows_e)
        if len(shared) < self._work.fewest:
            return False
        rows = np.union1d(rows_d, rows_e)
        only_d, only_e = ~np.isin(rows, rows_e), ~np.isin(rows, rows_d)
        xy, spread = self._work.points[rows, :2], self._sizes[d][0, 1] / 2
        by_image = self._log_density(d, rows) - self._log_density(e, rows)
        is_d = only_d | (~only_e & (by_image >= 0))
        for _ in range(DIVIDE_ROUNDS):
            if min(np.count_nonzero(is_d), np.count_nonzero(~is_d)) < self._work.fewest:
                return False
            off_d, off_e = (((xy - xy[side].mean(axis=0)) ** 2).sum(axis=1) for side in (is_d, ~is_d))
            is_d = only_d | (~only_e & (by_image + (off_e - off_d) / (2 * spread**2) >= 0))
        if min(np.count_nonzero(is_d), np.count_nonzero(~is_d)) < self._work.fewest:
            return False
        for number, lost in ((d, rows[~is_d]), (e, rows[is_d])):
            barred = self._beside_masks.setdefault(number, np.zeros(len(self._uv), np.bool_))
            barred[lost] = True
        return True

    def _log_density(self, d: int, rows: I64) -> F64:
        """Return the log-likelihood of points in a detection's image box. It is highest in the middle."""
        low, high = self._boxes[d, :2], self._boxes[d, 2:]
        middle, half = (low + high) / 2, (high - low) / 2
        off = np.abs(self._uv[rows] - middle) / half
        return np.asarray(np.log(np.maximum(1 - off, 0.01) / half).sum(axis=1), np.float64)

    def _allowed(self, d: int, rows: I64) -> I64:
        """Drop the points of the box that the detection's mask does not cover."""
        return rows[~self._beside_masks[d][rows]] if d in self._beside_masks else rows

    def _without_others(self, d: int, rows: I64) -> I64:
        """Drop the points beside a detection's box that a box of another class shows."""
        others = np.array([name != self._detections.names[d] for name in self._detections.names])
        boxes = self._boxes[[d, *np.flatnonzero(others & self._detections.kept)]]
        u, v = self._uv[rows].T
        x0, y0, x1, y1 = boxes.T[:, :, None]
        inside = (u >= x0) & (u <= x1) & (v >= y0) & (v <= y1)
        kept: I64 = rows[inside[0] | ~inside[1:].any(axis=0)]
        return kept

    def settle(self, d: int, candidate: _Candidate, grow: bool) -> tuple[I64, F64, Bool]:
        """Return the object's points, its box (centre, size, heading), and which of its sides were seen."""
        work, rows = self._work, candidate.rows
        if not grow:
            return rows, *self._upright_box(rows, self._fit(d, rows, candidate.depth))
        # The object's clusters may continue beyond the image border that cuts the box, and beside a tight
        # box. If one box of the class holds them, they are the object, however narrow the image box is,
        # but for what another box shows: a cyclist beside a car may be in one cluster with it.
        counts = np.bincount(work.clusters.labels[rows] + 1)
        free_rows = [
            work.free_of(k) for k in np.flatnonzero(counts[1:] > MIN_CLUSTER_SHARE * len(rows)).tolist()
        ]
        kin = self._allowed(d, np.concatenate([*free_rows, np.zeros(0, np.int64)]))
        cut = self._cut[d]
        if cut[0] or cut[2]:
            beyond = kin[np.isnan(self._uv[kin, 0])]
            away = work.points[beyond, :2] - work.points[rows, :2].mean(axis=0)
            long = np.nan_to_num(self._sizes[d][:, 0].max(), nan=candidate.depth * self._wide[d])
            rows = np.concatenate([rows, beyond[np.hypot(away[:, 0], away[:, 1]) <= long]])
        flat, is_whole = self._fit(d, rows, candidate.depth).flat, False
        is_long = self._sizes[d][:, 0].max() >= NO_SIDES
        if is_long and len(own := self._without_others(d, kin)) > len(rows):
            whole = self._fit(d, own, candidate.depth).flat
            is_whole = share_inside(work.points, own, whole) >= WHOLE_SHARE
            flat, kin = (whole, own) if is_whole else (flat, kin)
        inside = points_inside(
            work.points,
            self._uv,
            self._allowed(d, self._seen),
            kin,
            self.taker,
            work.owner,
            self._boxes[d],
            flat,
            np.inf if is_whole else TIGHT_SHARE,
            is_whole or cut.any(),
        )
        rows = inside if len(inside) >= work.fewest else candidate.rows
        fitted = self._fit(d, rows, candidate.depth, about=flat[4])
        box, seen = self._upright_box(rows, fitted)
        for points in free_rows:
            rest = cluster_remainder(work.points, points, rows, fitted.flat, work.smallest)
            rows = np.concatenate([rows, rest]) if len(rest) else rows
        return rows, box, seen

    def _fit(self, d: int, rows: I64, depth: float, about: float = np.nan) -> _FittedBox:
        """Fit a box of each size of the class on the ground, and return the one that explains most.

        The costs of two sizes are compared as negative log-likelihoods: with the logarithms of the spreads,
        and with the height of the image box at this distance.
        """
        longest = max(self._wide[d], self._tall[d]) * depth
        sizes, bounds = self._sizes[d], np.zeros(len(self._sizes[d]))
        if len(sizes) > 1:
            bounds += [self._size_cost(d, size, depth) + k * RARER for k, size in enumerate(sizes)]
            order = np.argsort(bounds, kind="stable")
            sizes, bounds = sizes[order], bounds[order]
        edge = self._edge[d] * depth
        points, rays = self._work.points, self._normals[d]
        flat, facing, number = fit_from(points, rows, self._place, rays, edge, sizes, bounds, longest, about)
        return _FittedBox(flat, facing, sizes[number])

    def _size_cost(self, d: int, size: F64, depth: float) -> float:
        """Return the cost of one size of the class, from its spreads and from the height of the image box."""
        height, spread = size[2], math.hypot(size[5], TALL_SHARE * size[2])
        z = max((self._tall[d] * depth - height) / spread, -self._lowest(d))
        return float(np.log(size[3:]).sum() + 0.5 * z * z)

    def _lowest(self, d: int) -> float:
        """Return the sigmas beyond which a lower height costs no more."""
        return HIDDEN_SIGMAS_CUT if self._cut[d, 1] or self._cut[d, 3] else HIDDEN_SIGMAS

    def _upright_box(self, rows: I64, fitted: _FittedBox) -> tuple[F64, Bool]:
        """Return the box (centre, size, heading) and which sides are seen.

        The box of a detection without class size has length >= width.
        """
        work, facing, (x, y, length, width, heading) = self._work, fitted.facing, fitted.flat.tolist()
        has_size = not math.isnan(fitted.size[0])
        seen = [facing[0] > 0, facing[0] < 0, facing[1] > 0, facing[1] < 0]
        is_round = bool(fitted.size[0] < NO_SIDES)
        if is_round:
            x, y, length, width, heading = self._round_box(rows, fitted.size)
            seen = [False, True, False, False]
        if (is_round or not has_size) and width > length:
            length, width, heading = width, length, heading - math.pi / 2
            seen = [seen[3], seen[2], seen[0], seen[1]]
        if not -math.pi / 2 < heading <= math.pi / 2:
            heading += math.pi if heading < 0 else -math.pi
            seen = [seen[1], seen[0], seen[3], seen[2]]
        z = work.points[rows, 2]
        low, high = float(z.min()), float(z.max())
        if has_size and work.height is not None:
            low = float(np.partition(z - work.height[rows], len(z) // 2)[len(z) // 2])
            high = max(high, low + fitted.size[2] - fitted.size[5])
        length, width, tall = (max(side, MIN_SIZE) for side in (length, width, high - low))
        return np.array([x, y, (low + high) / 2, length, width, tall, heading]), np.array(seen)

    def _round_box(self, rows: I64, size: F64) -> tuple[float, float, float, float, float]:
        """Return centre, length, width and heading of an object without flat sides, seen along its length.

        The points lie on the half that is seen. They show its width, which is weighed with the size of the
        class by the variances.
        """
        place = np.median(self._work.points[rows, :2], axis=0).astype(np.float64)
        away = (place - self._place) / max(float(np.hypot(*(place - self._place))), 1e-6)
        x, y = place + BEHIND * away
        across = (self._work.points[rows, :2] - self._place) @ np.array([-away[1], away[0]])
        low, high = np.percentile(across, (100 * STRAY_SHARE, 100 - 100 * STRAY_SHARE))
        mean = math.sqrt(size[0] * size[1])
        spread = mean * (size[3] / size[0] + size[4] / size[1]) / 2
        trust = spread**2 / (spread**2 + WIDTH_SIGMA**2)
        wide = mean + trust * (float(high - low) + UNSEEN_WIDTH - mean)
        return x, y, mean, min(wide, size[0] + MAX_SPREAD * size[3]), math.atan2(away[1], away[0])


def _points_beside_mask(
    uv: F32, seen: I64, detections: Detections, d: int, config: FusionConfig, fewest: int
) -> Bool | None:
    """Return the (P,) mask of points in a detection's box that its instance mask does not cover.

    The result is None if the detection has no instance mask or too few points are under it.
    """
    masks = detections.masks
    if masks is None or not config.masks or not masks.has(d):
        return None
    x0, y0, x1, y1 = detections.xyxy[d].tolist()
    margin = MARGIN * (x1 - x0)
    u, v = uv[seen].T
    inside = seen[(u >= x0 - margin) & (u <= x1 + margin) & (v >= y0) & (v <= y1)]
    covered = is_covered(masks, d, uv[inside], config.mask_margin)
    if np.count_nonzero(covered) < fewest:
        return None
    barred = np.zeros(len(uv), np.bool_)
    barred[inside] = ~covered
    return barred
