"""Match 2D detections with LiDAR clusters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bevviz.config import ClusteringConfig, FusionConfig
from bevviz.model.frame import F32, F64, I32, I64, Bool, Boxes3D, Intrinsics
from bevviz.model.geometry import apply, iou
from bevviz.model.results import CameraResult, Claims, Clusters, Decision, Detections, Fusion, Objects, Pairs
from bevviz.stages.mask_lookup import is_covered
from bevviz.support.numba_kernel import kernel

# Weights of the three similarities of a cluster and a detection, each from 0 to 1 (see ``fuse``).
IOU_WEIGHT, SHARE_WEIGHT, NEARNESS_WEIGHT = 0.6, 0.25, 0.15


def fuse(
    uv: F32,
    depth: F32,
    clusters: Clusters,
    detections: Detections,
    intrinsics: Intrinsics,
    camera_from_points: F64,
    config: FusionConfig,
    claims: Claims | None = None,
    is_planar: bool = False,
) -> Fusion:
    """Match one camera's detections with the clusters.

    ``frustum``: a box in the image encloses the visible silhouette of an object. So the object's cluster lies
    in the frustum of the box, fills it, and has little outside of it. Objects behind it show only around that
    silhouette. Each pair of a kept detection and a kept cluster with points in its frustum is rated ::

        score * (0.6 IoU + 0.25 share of the cluster's points in the frustum + 0.15 nearest depth / depth)

    The IoU is that of the detection and the box around the projected cluster. The depth is the median of the
    points in the frustum; the nearest depth is that of the nearest permitted cluster in the frustum. The
    matches are the one-to-one assignment of greatest total rating. Of two boxes on one object the box with
    the higher score is matched. Of two clusters that fit equally the nearer one is matched. With ``claims``
    the clusters were made for the detections (``frustum.claim``), and each detection has the cluster made for
    it.

    ``centroid`` is the method of the tutorial. Each cluster's centroid, projected without distortion, gets
    the nearest centre of a 2D box within ``match_radius``. One box may name several clusters.

    Args:
        uv: (P, 2) obstacle points in pixels, NaN where not in front of the camera.
        depth: (P,) metres along the optical axis.
        clusters: clusters of those points.
        detections: detections in this camera's image. Detections that are not KEPT only get a point count.
        intrinsics: the camera.
        camera_from_points: (4, 4) optical frame from the clusters' frame.
        config: method and its thresholds.
        claims: points that each detection claimed, if detections split the clusters.
        is_planar: whether the scan is of one plane, without heights. The IoU is then that of the widths.

    Returns:
        The matches, and the decision and the evidence for every detection and cluster.
    """
    u, v = uv.T
    visible = np.flatnonzero(
        (u >= -0.5) & (u < intrinsics.width - 0.5) & (v >= -0.5) & (v < intrinsics.height - 0.5) & (depth > 0)
    )
    visible = visible[np.argsort(u[visible])]  # _in_boxes needs this order
    uv, depth, labels = uv[visible], depth[visible], clusters.labels[visible]
    cluster_uv = _boxes_around(uv, labels, len(clusters))
    inside, counts = _in_boxes(uv, detections)
    if config.method == "centroid":
        pairs, order = _centroid_pairs(
            clusters, detections, cluster_uv, intrinsics, camera_from_points, config
        )
        reason = np.where(np.isfinite(pairs.cost), Decision.TAKEN, Decision.TOO_FAR).astype(np.int32)
        nearest = _first_of_each(pairs.cluster, order)
        matched = nearest[np.isfinite(pairs.cost[nearest])]
    else:
        overlap = (_width_iou if is_planar else iou)(detections.xyxy, cluster_uv)
        around = detections, cluster_uv, overlap
        pairs, reason = _frustum_pairs(inside, depth, labels, clusters, *around, config)
        if claims is None:
            allowed = np.flatnonzero(reason == Decision.TAKEN)
            matched = allowed[_assign_pairs(pairs, allowed)]
        else:
            matched = np.flatnonzero(claims.cluster[pairs.detection] == pairs.cluster)
            has_other = claims.cluster[pairs.detection] >= 0
            is_taken = np.isin(pairs.cluster, claims.cluster[claims.cluster >= 0])
            reason[(reason == Decision.TAKEN) & ~has_other & ~is_taken] = Decision.MISFIT
        # Permitted pairs come first because they explain most, then pairs of a higher overlap.
        order = np.lexsort((-pairs.points, -pairs.iou, pairs.cost))

    reason[matched] = Decision.MATCHED
    order = np.concatenate([matched[np.argsort(pairs.cost[matched], kind="stable")], order])
    best_cluster = _first_of_each(pairs.detection, order)
    best_detection = _first_of_each(pairs.cluster, order)
    detection_decision, detection_cluster = _decide(
        np.where(detections.kept, Decision.NO_CLUSTER, Decision.NOT_KEPT),
        pairs.detection[best_cluster],
        pairs.cluster[best_cluster],
        reason[best_cluster],
    )
    is_in_view = np.isfinite(cluster_uv[:, 0])
    cluster_decision, cluster_detection = _decide(
        np.where(
            ~clusters.kept,
            Decision.NOT_KEPT,
            np.where(is_in_view, Decision.NO_DETECTION, Decision.OUT_OF_VIEW),
        ),
        pairs.cluster[best_detection],
        pairs.detection[best_detection],
        reason[best_detection],
    )
    # A centroid may be in front of the camera although its cluster is outside the image.
    cluster_decision[~is_in_view & (cluster_decision == Decision.TOO_FAR)] = Decision.OUT_OF_VIEW
    return Fusion(
        detection_decision=detection_decision,
        detection_cluster=detection_cluster,
        detection_points=counts,
        cluster_decision=cluster_decision,
        cluster_detection=cluster_detection,
        pairs=pairs,
        cluster_uv=cluster_uv,
        claims=claims,
        detection_covered=None if claims is None else _count_in_masks(uv, inside, detections, config),
    )


def _count_in_masks(
    uv: F32, inside: dict[int, I64], detections: Detections, config: FusionConfig
) -> I32 | None:
    """Count the points of each box that its mask covers, -1 without a mask. Return None without any masks."""
    masks = detections.masks
    if masks is None or not config.masks:
        return None
    counts = np.full(len(detections), -1, np.int32)
    for d in np.flatnonzero(detections.kept & (masks.place[:, 2] > 0)).tolist():
        counts[d] = np.count_nonzero(is_covered(masks, d, uv[inside[d]], config.mask_margin))
    return counts


def merge(clusters: Clusters, cameras: Sequence[CameraResult], config: ClusteringConfig) -> Objects:
    """Return named 3D boxes from all cameras. If several cameras name one cluster, the best score wins.

    Args:
        clusters: clusters of the frame.
        cameras: results; a camera without fusion is skipped.
        config: ``boxes`` selects oriented or axis-aligned boxes. If detections split the clusters, the
            oriented boxes are those fitted at that time.
    """
    best: dict[int, tuple[float, str, str, int, Claims | None]] = {}
    for result in cameras:
        if result.fusion is None or result.detections is None:
            continue
        for k in np.flatnonzero(result.fusion.cluster_decision == Decision.MATCHED).tolist():
            d = int(result.fusion.cluster_detection[k])
            score = float(result.detections.score[d])
            if k not in best or score > best[k][0]:
                best[k] = score, result.detections.names[d], result.camera.name, d, result.fusion.claims
    rows = sorted(best)
    measured = clusters.boxes(config).chosen(rows)
    boxes, seen = measured, None
    whole = [(claims, d) for *_, d, claims in (best[k] for k in rows) if claims is not None]
    if config.boxes == "oriented" and len(whole) == len(rows):
        boxes = Boxes3D.joined([claims.boxes.chosen([d]) for claims, d in whole])
        seen = np.array([claims.seen[d] for claims, d in whole], bool).reshape(-1, 4)
    return Objects(
        boxes=boxes,
        names=tuple(best[k][1] for k in rows),
        score=np.array([best[k][0] for k in rows], np.float32),
        cluster=np.array(rows, np.int32),
        camera=tuple(best[k][2] for k in rows),
        detection=np.array([best[k][3] for k in rows], np.int32),
        measured=measured,
        seen=seen,
    )


def clusters_in_view(cameras: Sequence[CameraResult], count: int) -> Bool:
    """Return the (count,) mask of clusters in the image of a camera with a fusion result."""
    seen = np.zeros(count, bool)
    for result in cameras:
        if result.fusion is not None:
            decisions = result.fusion.cluster_decision
            seen |= (decisions != Decision.OUT_OF_VIEW) & (decisions != Decision.NOT_KEPT)
    return seen


@kernel
def assign(cost: F64, unmatched: float) -> I32:
    """Solve the one-to-one assignment of least total cost. A row may also stay unassigned.

    Shortest augmenting paths with dual variables (Jonker and Volgenant 1987, in the form of Crouse 2016,
    "On implementing 2D rectangular assignment algorithms"). Additional columns of the matrix stand for
    unassigned rows.

    Args:
        cost: (R, C), inf where a pair is forbidden.
        unmatched: cost of an unassigned row.

    Returns:
        (R,) column of each row, -1 if it is unassigned.
    """
    rows, columns = cost.shape
    u, v = np.zeros(rows), np.zeros(columns + rows)
    column_of = np.full(rows, -1, np.int32)
    row_of = np.full(columns + rows, -1, np.int32)
    shortest = np.empty(columns + rows)  # path costs from the start row to each column
    before = np.empty(columns + rows, np.int32)  # row before each column on that path
    done = np.empty(columns + rows, np.bool_)
    for start in range(rows):
        shortest[:], before[:], done[:] = np.inf, -1, False
        row, length = start, 0.0
        while True:
            sink = -1
            for c in range(columns + rows):
                if done[c]:
                    continue
                through = length + (cost[row, c] if c < columns else unmatched) - u[row] - v[c]
                if through < shortest[c]:
                    shortest[c], before[c] = through, row
                if sink < 0 or shortest[c] < shortest[sink]:
                    sink = c
            length = shortest[sink]
            if row_of[sink] < 0:
                break
            done[sink] = True
            row = int(row_of[sink])
        u[start] += length
        for passed in range(columns + rows):
            if done[passed]:
                u[row_of[passed]] += length - shortest[passed]
                v[passed] -= length - shortest[passed]
        while True:
            row = int(before[sink])
            row_of[sink] = row
            column_of[row], sink = sink, column_of[row]
            if row == start:
                break
    column_of[column_of >= columns] = -1
    return column_of


def _boxes_around(uv: F32, labels: I32, count: int) -> F32:
    """Return (count, 4) image boxes around the points of each label, NaN for labels without points."""
    clustered = np.flatnonzero(labels >= 0)
    order = clustered[np.argsort(labels[clustered], kind="stable")]
    label, start = np.unique(labels[order], return_index=True)
    boxes = np.full((count, 4), np.nan, np.float32)
    if len(label):
        boxes[label, :2] = np.minimum.reduceat(uv[order], start)
        boxes[label, 2:] = np.maximum.reduceat(uv[order], start)
    return boxes


def _in_boxes(uv: F32, detections: Detections) -> tuple[dict[int, I64], I32]:
    """Return the rows of the points in each kept box, and the (D,) number of points in every box.

    ``uv`` is sorted by u.
    """
    xyxy, v = detections.xyxy, np.ascontiguousarray(uv[:, 1])
    left = np.searchsorted(uv[:, 0], xyxy[:, 0], "left")
    right = np.searchsorted(uv[:, 0], xyxy[:, 2], "right")
    inside = {
        d: left[d]
        + np.flatnonzero((v[left[d] : right[d]] >= xyxy[d, 1]) & (v[left[d] : right[d]] <= xyxy[d, 3]))
        for d in np.flatnonzero(detections.kept).tolist()
    }
    return inside, _count_between(v, left, right, xyxy)


@kernel
def _count_between(v: F32, left: I64, right: I64, xyxy: F32) -> I32:
    """Return the (D,) number of values from ``left`` to ``right`` between the upper and lower edge."""
    counts = np.zeros(len(xyxy), np.int32)
    for d in range(len(xyxy)):
        for i in range(left[d], right[d]):
            counts[d] += xyxy[d, 1] <= v[i] <= xyxy[d, 3]
    return counts


def _frustum_pairs(
    inside: dict[int, I64],
    depth: F32,
    labels: I32,
    clusters: Clusters,
    detections: Detections,
    cluster_uv: F32,
    overlaps: F32,
    config: FusionConfig,
) -> tuple[Pairs, I32]:
    """Pair every kept detection with every kept cluster in its frustum.

    Args:
        inside: points in the box of each kept detection.
        depth: of the points.
        labels: cluster of each point.
        clusters: all clusters.
        detections: all detections.
        cluster_uv: box around each projected cluster.
        overlaps: (D, K) IoU of both.
        config: thresholds.

    Returns:
        The pairs, and for each TAKEN or the rule that forbids it.
    """
    point = np.concatenate([np.zeros(0, np.int64), *inside.values()])
    detection = np.repeat(np.fromiter(inside, np.int64), [len(rows) for rows in inside.values()])
    usable = np.append(clusters.kept, False)[labels[point]]  # noise has label -1, the last element
    point, detection = point[usable], detection[usable]

    key = detection * max(len(clusters), 1) + labels[point]
    order = np.lexsort((depth[point], key))
    key, start, points = np.unique(key[order], return_index=True, return_counts=True)
    by_depth = depth[point[order]]
    median = (by_depth[start + (points - 1) // 2] + by_depth[start + points // 2]) / 2
    detection, cluster = np.divmod(key, max(len(clusters), 1))

    box, around = detections.xyxy[detection], cluster_uv[cluster]
    overlap = overlaps[detection, cluster]
    reason = np.select(
        [median > config.max_depth, points < config.min_points, overlap < config.min_iou],
        [Decision.TOO_FAR, Decision.TOO_FEW_POINTS, Decision.LOW_OVERLAP],
        Decision.TAKEN,
    ).astype(np.int32)

    allowed = reason == Decision.TAKEN
    nearest = np.full(len(detections), np.inf, np.float32)
    np.minimum.at(nearest, detection[allowed], median[allowed])
    share = points / np.maximum(np.bincount(labels[labels >= 0], minlength=len(clusters))[cluster], 1)
    nearness = np.minimum(nearest[detection] / median, 1)
    fit = IOU_WEIGHT * overlap + SHARE_WEIGHT * share + NEARNESS_WEIGHT * nearness
    pairs = Pairs(
        detection=detection.astype(np.int32),
        cluster=cluster.astype(np.int32),
        points=points.astype(np.int32),
        depth=median,
        iou=overlap,
        distance=_distance(box, around),
        cost=np.where(allowed, 1 - detections.score[detection] * fit, np.inf).astype(np.float32),
    )
    return pairs, reason


def _width_iou(a: F32, b: F32) -> F32:
    """Return the (A, B) intersection over union of the widths of image boxes."""
    shared = np.minimum(a[:, None, 2], b[:, 2]) - np.maximum(a[:, None, 0], b[:, 0])
    whole = np.maximum(a[:, None, 2], b[:, 2]) - np.minimum(a[:, None, 0], b[:, 0])
    return np.asarray(np.nan_to_num(np.clip(shared, 0, None) / np.maximum(whole, 1e-6)), np.float32)


def _assign_pairs(pairs: Pairs, allowed: I64) -> I64:
    """Return the rows of ``allowed`` that are matches."""
    d, row = np.unique(pairs.detection[allowed], return_inverse=True)
    k, column = np.unique(pairs.cluster[allowed], return_inverse=True)
    cost = np.full((len(d), len(k)), np.inf)
    cost[row, column] = pairs.cost[allowed]
    return np.flatnonzero(assign(cost, unmatched=1.0)[row] == column)


def _centroid_pairs(
    clusters: Clusters,
    detections: Detections,
    cluster_uv: F32,
    intrinsics: Intrinsics,
    camera_from_points: F64,
    config: FusionConfig,
) -> tuple[Pairs, I64]:
    """Pair every kept detection with every kept cluster in front of the camera.

    Returns:
        The pairs, and their rows ordered by distance.
    """
    center = apply(camera_from_points, clusters.centroid)
    kept = np.flatnonzero(detections.kept)
    ahead = np.flatnonzero(clusters.kept & (center[:, 2] > 0))
    detection, cluster = (a.ravel() for a in np.meshgrid(kept, ahead, indexing="ij"))
    on_image = center[cluster] @ intrinsics.K.T.astype(np.float32)
    point = on_image[:, :2] / on_image[:, 2:]
    box = detections.xyxy[detection]
    distance = _distance(box, np.hstack([point, point]))
    pairs = Pairs(
        detection=detection.astype(np.int32),
        cluster=cluster.astype(np.int32),
        points=np.zeros(len(detection), np.int32),
        depth=center[cluster, 2],
        iou=iou(detections.xyxy, cluster_uv)[detection, cluster],
        distance=distance,
        cost=np.where(distance <= config.match_radius, distance, np.inf).astype(np.float32),
    )
    return pairs, np.argsort(distance, kind="stable")


def _distance(a: F32, b: F32) -> F32:
    """Return the (Q,) distances between the centres of (Q, 4) boxes."""
    offset = (a[:, :2] + a[:, 2:] - b[:, :2] - b[:, 2:]) / 2
    return np.hypot(offset[:, 0], offset[:, 1]).astype(np.float32)


def _first_of_each(values: I32, order: I64) -> I64:
    """Return the first row of each value, with the rows in this order."""
    return order[np.unique(values[order], return_index=True)[1]]


def _decide(default: I32, row: I32, partner: I32, reason: I32) -> tuple[I32, I32]:
    """Return decision and partner of each element: ``default`` and -1, replaced at the given rows."""
    decision, other = default.astype(np.int32), np.full(len(default), -1, np.int32)
    decision[row], other[row] = reason, partner
    return decision, other
