"""Explanation of every decision of a frame, with its numbers and the parameter that decided it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from bevviz.config import Config
from bevviz.model import geometry
from bevviz.model.frame import I64
from bevviz.model.reasons import Reason, ReasonKind, kind_of, limit, limit_of, owner_of, scored
from bevviz.model.results import (
    CameraResult,
    Clusters,
    ClusterState,
    Decision,
    Detections,
    DetectionState,
    Explanation,
    Fusion,
    Objects,
    Opinion,
    Opinions,
    Pair,
    Splits,
)

SAME_BOX = 0.5  # IoU from which a detection is the double of another
MIN_NOISE_SHARE = 0.1  # Least share of noise in the points of a detection that an explanation mentions.


def unmatched_detections(result: CameraResult, *, doubles: bool = False) -> I64:
    """Return the rows of kept detections without an object, except doubles of a detection that has one.

    Of unmatched detections that are doubles of one another, only the best is returned without ``doubles``.
    """
    detections, fusion = result.detections, result.fusion
    if detections is None or fusion is None:
        return np.zeros(0, np.int64)
    matched = fusion.detection_decision == Decision.MATCHED
    rows: I64 = np.flatnonzero(detections.kept & ~matched)
    if len(rows) and matched.any():
        rows = rows[geometry.iou(detections.xyxy[rows], detections.xyxy[matched]).max(axis=1) < SAME_BOX]
    if doubles:
        return rows
    overlaps = np.triu(geometry.iou(detections.xyxy[rows], detections.xyxy[rows]) >= SAME_BOX, k=1)
    singles: I64 = rows[~overlaps.any(axis=0)]  # the best of doubles comes first
    return singles


def explain(
    cameras: Sequence[CameraResult],
    clusters: Clusters | None,
    config: Config,
    splits: Splits | None = None,
    lidar: bool = True,
    objects: Objects | None = None,
    opinions: Opinions | None = None,
) -> tuple[Explanation, ...]:
    """Explain each detection, each cluster, each split and each problem of a camera in one sentence.

    A detection's distances are along its camera's optical axis. A cluster's are horizontal, from the origin
    of its frame. A cluster is explained once for each camera that sees it, or once if none does.

    Problems have the subject ``camera``, row -1 and the state ``problem``. Changes of clusters by a camera
    have the subject ``split``. Its state is ``split`` for the rest of a divided cluster, and ``merged`` for a
    cluster made from several. Objects of a 3D detector or of the robot have the subject ``object``, and the
    word of their ``Opinion`` as state. Objects of our fusion beside them have the subject ``fused`` and the
    state ``missed`` or ``found``.

    Args:
        cameras: results of all cameras.
        clusters: clusters of the frame, None if their stage failed.
        config: configuration of the result.
        splits: clusters that detections split or merged.
        lidar: whether the frame has a LiDAR, so that clusters are expected.
        objects: objects of the frame.
        opinions: opinions of the cameras on them. None: our fusion made the objects.
    """
    explanations: list[Explanation] = []
    for result in cameras:
        explanations.extend(_problems(result, config))
        if result.detections is not None:
            explanations.extend(_detections(result, result.detections, clusters, config, lidar))
    if clusters is not None:
        explanations.extend(_clusters(cameras, clusters, config))
    if splits is not None:
        explanations.extend(_splits(cameras, splits))
    if objects is not None and opinions is not None:
        explanations.extend(_objects(objects, opinions, cameras, clusters, config))
        explanations.extend(_fused(objects, opinions, clusters, config))
    return tuple(explanations)


def _problems(result: CameraResult, config: Config) -> Iterator[Explanation]:
    """Yield the problems of a camera."""
    texts = [*result.camera.problems]
    if result.detections is None and result.camera.image is not None:
        why = "the detector failed" if config.detector.model else "detector.model is not set"
        texts.append(f"no detections, {why}")
    name = result.camera.name
    for text in texts:
        yield Explanation("camera", name, -1, Reason(ReasonKind.PROBLEM), f"{name}: {text}")


# --- detections --------------------------------------------------------------------------------


def detection_reason(detections: Detections, row: int, config: Config) -> Reason:
    """Return the reason why the detector stage kept a detection or not."""
    kind = kind_of(DetectionState(int(detections.state[row])))
    if (decisive := limit_of(kind, config)) is None:
        return Reason(kind)
    if kind is ReasonKind.BELOW_THRESHOLD:
        return Reason(kind, decisive, f"below {decisive.short}")
    rival = int(detections.suppressed_by[row])
    better = None if rival < 0 else scored(detections, rival)
    text = f"suppressed by {better}, IoU {float(detections.overlap[row]):.2f} > {decisive.short}"
    return Reason(kind, decisive, text)


def pair_kind(fusion: Fusion, config: Config, detection: int, cluster: int) -> ReasonKind:
    """Return the rule of our fusion that separates a detection and a cluster; MATCHED: none does."""
    pair, decision = fusion.pair(detection, cluster), Decision(int(fusion.detection_decision[detection]))
    if (rule := _separating_rule(pair, config)) is not None:
        return rule
    if decision is Decision.MATCHED:
        is_own = fusion.detection_cluster[detection] == cluster
        return ReasonKind.MATCHED if is_own else ReasonKind.OTHER_CLUSTER
    return ReasonKind.MISFIT if decision is Decision.MISFIT else ReasonKind.TAKEN


def _separating_rule(pair: Pair | None, config: Config) -> ReasonKind | None:
    """Return the limit that a pair does not meet."""
    fusion = config.fusion
    if fusion.method == "centroid":
        return ReasonKind.TOO_FAR if pair is None or not np.isfinite(pair.cost) else None
    if pair is None or pair.points < fusion.min_points:
        return ReasonKind.TOO_FEW_POINTS
    if pair.depth > fusion.max_depth:
        return ReasonKind.TOO_FAR
    return ReasonKind.LOW_OVERLAP if pair.iou < fusion.min_iou else None


def _detections(
    result: CameraResult, detections: Detections, clusters: Clusters | None, config: Config, lidar: bool
) -> Iterator[Explanation]:
    """Yield the explanation of each detection of a camera."""
    for d in range(len(detections)):
        reason = detection_reason(detections, d, config)
        if reason.kind is not ReasonKind.KEPT:
            text = reason.text
        elif result.fusion is None or clusters is None:
            why = "; ".join(result.camera.problems) or "no clusters in this frame"
            text = f"not compared with clusters: {why}" if lidar else "kept"
        else:
            kind = kind_of(Decision(int(result.fusion.detection_decision[d])))
            reason = Reason(kind, limit_of(kind, config))
            text = _detection(reason, d, result, result.fusion, detections, clusters, config)
        yield Explanation("detection", result.camera.name, d, reason, f"{scored(detections, d)}: {text}")


def _detection(
    reason: Reason,
    d: int,
    result: CameraResult,
    fusion: Fusion,
    detections: Detections,
    clusters: Clusters,
    config: Config,
) -> str:
    """Return the decision of the fusion about detection ``d`` in words."""
    if reason.kind is ReasonKind.NO_CLUSTER:
        return f"no cluster, {_unclustered(d, result, detections, clusters, config)}"
    k = int(fusion.detection_cluster[d])
    pair = fusion.pair(d, k)
    assert pair is not None
    if config.fusion.method == "centroid":
        evidence = f"centre of cluster {k} at {pair.depth:.1f} m is {pair.distance:.0f} px from its own"
    else:
        evidence = (
            f"{_points(pair.points)} of cluster {k} in its frustum at {pair.depth:.1f} m, IoU {pair.iou:.2f}"
            + mask_evidence(fusion, d, config)
        )
    if reason.kind is ReasonKind.MATCHED:
        is_matched = (fusion.cluster_decision == Decision.MATCHED) & (fusion.cluster_detection == d)
        others = [str(other) for other in np.flatnonzero(is_matched).tolist() if other != k]
        if not others:
            return f"{evidence}, matched"
        also = f"clusters {', '.join(others)} take" if others[1:] else f"cluster {others[0]} takes"
        return f"{evidence}, matched; {also} the same box"
    if reason.kind is ReasonKind.TAKEN:
        return f"no match: {evidence}, taken by {scored(detections, int(fusion.cluster_detection[k]))}"
    return f"no match: {evidence}, {_rule(reason, d, fusion, detections)}"


def mask_evidence(fusion: Fusion, d: int, config: Config) -> str:
    """Return how many points in a detection's frustum its mask covers, as the end of a sentence.

    The text is empty without a mask.
    """
    if fusion.detection_covered is None or (covered := int(fusion.detection_covered[d])) < 0:
        return ""
    points = f"{covered} of {_points(fusion.detection_points[d])} in the frustum"
    least = max(config.fusion.min_points, config.clustering.min_cluster_points)
    if covered < least:
        return f", only {points} in the mask, which is left aside below {least}"
    return f", {points} lie in the mask"


def _unclustered(
    d: int, result: CameraResult, detections: Detections, clusters: Clusters, config: Config
) -> str:
    """Return the kinds of obstacle points in a frustum that has no candidate cluster."""
    if config.fusion.method == "centroid":
        return "none has its centre before the camera"
    if result.uv is None or result.depth is None:
        return f"{_points(result.fusion.detection_points[d] if result.fusion else 0)} in its frustum"
    x0, y0, x1, y1 = detections.xyxy[d]
    u, v = result.uv.T
    labels = clusters.labels[(u >= x0) & (u <= x1) & (v >= y0) & (v <= y1) & (result.depth > 0)]
    if len(labels) == 0:
        return "no obstacle point in its frustum"
    kinds = []
    for label, count in zip(*np.unique(labels, return_counts=True), strict=True):
        if label < 0:
            owner = owner_of(config, "clustering")
            rule = str(limit_of(ReasonKind.NOISE, config)) if owner.ours else f"by {owner.name}"
            kinds.append(f"{count} noise ({rule})")
        else:
            kinds.append(
                f"{count} of cluster {label} ({_set_aside(cluster_reason(clusters, label, config))})"
            )
    return f"{_points(len(labels))} in its frustum: {', '.join(kinds)}"


# --- clusters ----------------------------------------------------------------------------------


def cluster_reason(clusters: Clusters, row: int, config: Config) -> Reason:
    """Return the reason why a cluster is kept or outside the size limits."""
    kind = kind_of(ClusterState(int(clusters.state[row])))
    return Reason(kind, limit_of(kind, config))


def _clusters(cameras: Sequence[CameraResult], clusters: Clusters, config: Config) -> Iterator[Explanation]:
    """Yield the explanation of each cluster for each camera that sees it."""
    compared = [result.camera.name for result in cameras if result.fusion is not None]
    views = [
        (
            result.camera.name,
            result.fusion,
            result.detections,
            [kind_of(Decision(decision)) for decision in result.fusion.cluster_decision.tolist()],
        )
        for result in cameras
        if result.fusion is not None and result.detections is not None
    ]
    ranges = clusters.boxes(config.clustering).distance.tolist()
    for k, (count, distance) in enumerate(zip(clusters.count.tolist(), ranges, strict=True)):
        head, reason = (
            f"cluster {k}: {_points(count)} at {distance:.1f} m",
            cluster_reason(clusters, k, config),
        )
        if reason.kind is not ReasonKind.KEPT:
            yield Explanation("cluster", "", k, reason, f"{head}: {_set_aside(reason)}")
            continue
        if not compared:
            text = f"{head}: not compared with detections, as no camera has any"
            yield Explanation("cluster", "", k, reason, text)
            continue
        unseen = True
        for camera, fusion, detections, kinds in views:
            if (kind := kinds[k]) is ReasonKind.OUT_OF_VIEW:
                continue
            unseen = False
            d = int(fusion.cluster_detection[k])
            reason = Reason(kind, limit_of(kind, config))
            text = _cluster(reason, k, d, fusion, detections, config)
            if kind is not ReasonKind.MATCHED:
                text = f"in view of {camera}, {text}"
            yield Explanation("cluster", camera, k, reason, f"{head}: {text}")
        if unseen:
            text = f"{head}: out of view of {' and '.join(compared)}"
            yield Explanation("cluster", "", k, Reason(ReasonKind.OUT_OF_VIEW), text)


def _cluster(reason: Reason, k: int, d: int, fusion: Fusion, detections: Detections, config: Config) -> str:
    """Return the decision of the fusion about a cluster in words."""
    if reason.kind is ReasonKind.NO_DETECTION:
        return "under no detection"
    pair, label = fusion.pair(d, k), scored(detections, d)
    if reason.kind is ReasonKind.MATCHED:
        return f"matched with {label}"
    assert pair is not None
    if config.fusion.method == "centroid":
        evidence = f"its centre {pair.distance:.0f} px from that of {label}"
    else:
        evidence = f"{_points(pair.points)} in the frustum of {label}, IoU {pair.iou:.2f}"
    if reason.kind is ReasonKind.TAKEN:
        return f"{evidence}, taken by cluster {fusion.detection_cluster[d]}"
    return f"{evidence}, {_rule(reason, d, fusion, detections)}"


def _splits(cameras: Sequence[CameraResult], splits: Splits) -> Iterator[Explanation]:
    """Yield the explanation of each cluster that a detection split or merged."""
    by_name = {result.camera.name: result.detections for result in cameras}
    keys = list(zip(splits.camera, splits.detection.tolist(), splits.cluster.tolist(), strict=True))
    for camera, d, part_cluster in dict.fromkeys(keys):
        detections = by_name[camera]
        assert detections is not None
        label_text = f"by {scored(detections, d)}"
        cluster_points, noise_points = [], 0
        rows = [row for row, key in enumerate(keys) if key == (camera, d, part_cluster)]
        for row in rows:
            rest_cluster, points = int(splits.rest[row]), int(splits.points[row])
            share = f"{points:,} of {splits.of[row]:,} points"
            if rest_cluster >= 0:
                text = f"cluster {rest_cluster} split {label_text}: {share} are cluster {part_cluster}"
                yield Explanation("split", camera, rest_cluster, Reason(ReasonKind.SPLIT), text)
            elif points < splits.of[row]:
                text = f"cluster {part_cluster} split {label_text}: {share} of a cluster "
                text += "that others have the rest of"
                yield Explanation("split", camera, part_cluster, Reason(ReasonKind.SPLIT), text)
            elif splits.is_noise[row]:
                noise_points = points
            else:
                cluster_points.append(f"{points:,}")
        if len(cluster_points) > 1 or noise_points > MIN_NOISE_SHARE * splits.points[rows].sum():
            pieces = [f"clusters of {' and '.join(cluster_points)} points"] if len(cluster_points) > 1 else []
            pieces += [f"a cluster of {cluster_points[0]} points"] if len(cluster_points) == 1 else []
            pieces += [f"{_points(noise_points)} of noise"] if noise_points else []
            yield Explanation(
                "split",
                camera,
                part_cluster,
                Reason(ReasonKind.MERGED),
                f"cluster {part_cluster} made {label_text} of {' and '.join(pieces)}",
            )


# --- opinions of cameras -----------------------------------------------------------------------


def _objects(
    objects: Objects,
    opinions: Opinions,
    cameras: Sequence[CameraResult],
    clusters: Clusters | None,
    config: Config,
) -> Iterator[Explanation]:
    """Yield the opinion of the cameras on each object."""
    by_name = {result.camera.name: result for result in cameras}
    for k, name in enumerate(opinions.camera):
        opinion = Opinion(int(opinions.opinion[k]))
        text = _opinion(opinion, k, opinions, by_name.get(name), clusters, config)
        if opinion is Opinion.NOT_ASKED:
            problems = "; ".join(p for result in cameras for p in result.camera.problems)
            text += f": {problems}" if problems else ""
        yield Explanation(
            "object", name, k, Reason(ReasonKind(opinion.word)), f"{_object(objects, k)}: {text}"
        )


def _opinion(
    opinion: Opinion,
    k: int,
    opinions: Opinions,
    result: CameraResult | None,
    clusters: Clusters | None,
    config: Config,
) -> str:
    """Return the opinion on object ``k`` in words, with the number that decided it."""
    camera = "" if result is None else result.camera.name
    if opinion is Opinion.NOT_ASKED:
        return "unseen, no camera has detections"
    if opinion is Opinion.OUT_OF_VIEW:
        share = f"{opinions.shown[k]:.0%} of it in the image of {camera or 'any camera'}"
        return f"unseen, {share}, {limit(config, 'opinions.min_shown')}"
    if opinion is Opinion.HIDDEN:
        share = f"{opinions.visible[k]:.0%} of it is not hidden behind what is nearer"
        return f"unseen, {share}, {limit(config, 'opinions.min_visible')}"
    if opinion is Opinion.TOO_SMALL:
        height = f"{opinions.height[k]:.1f} px high in {camera}"
        return f"unseen, {height}, {limit(config, 'opinions.min_height')}"
    if opinion is Opinion.NO_CLASS:
        return f"unseen, the detector of {camera} knows no such class"
    assert result is not None
    d = int(opinions.detection[k])
    if opinion is not Opinion.CONTRADICTED:
        assert result.detections is not None
        head = "confirmed by" if opinion is Opinion.CONFIRMED else "named otherwise by"
        return f"{head} {scored(result.detections, d)} of {camera}, {_looks(k, d, opinions, result)}"
    visibility = f"{opinions.shown[k]:.0%} in its image, {opinions.visible[k]:.0%} not hidden"
    return f"contradicted by {camera} ({visibility}): {_nearest(k, d, opinions, result, clusters, config)}"


def _looks(k: int, d: int, opinions: Opinions, result: CameraResult) -> str:
    """Return the evidence that detection ``d`` is of object ``k``."""
    evidence = f"IoU {opinions.iou[k]:.2f} in the image"
    if np.isnan(opinions.held[k]) or result.fusion is None:
        return f"{evidence}, without a cluster"
    cluster = int(result.fusion.detection_cluster[d])
    return f"{opinions.held[k]:.0%} of cluster {cluster} is in the box, {evidence}"


def _nearest(
    k: int, d: int, opinions: Opinions, result: CameraResult, clusters: Clusters | None, config: Config
) -> str:
    """Return the detection that is nearest to a contradicted object, and why it does not confirm it."""
    detections, fusion = result.detections, result.fusion
    if d < 0 or detections is None:
        is_network = Path(config.detector.model).suffix == ".onnx"
        weakest = f", not even with a score of {config.detector.explain_threshold:g}" if is_network else ""
        return f"no detection there{weakest}"
    text = f"the nearest is {scored(detections, d)}, IoU {opinions.iou[k]:.2f}"
    reason = detection_reason(detections, d, config)
    if reason.kind is ReasonKind.BELOW_THRESHOLD:
        return f"{text}, {reason.text}"
    if fusion is not None and clusters is not None and fusion.detection_decision[d] == Decision.MATCHED:
        cluster = int(fusion.detection_cluster[d])
        away = clusters.boxes(config.clustering).distance[cluster]
        return f"{text}, which is cluster {cluster} at {away:.1f} m"
    if opinions.iou[k] < config.opinions.min_iou:
        return f"{text}, {limit(config, 'opinions.min_iou')}"
    return f"{text}, which fits another box better"


def _fused(
    objects: Objects, opinions: Opinions, clusters: Clusters | None, config: Config
) -> Iterator[Explanation]:
    """Yield for each object of our fusion whether the other method has it, too."""
    method, fused = owner_of(config, "objects").name, opinions.fused
    for j, k in enumerate(opinions.partner.tolist()):
        cluster, camera = int(fused.cluster[j]), fused.camera[j]
        points = "" if clusters is None else f", {_points(clusters.count[cluster])}"
        origin = f"cluster {cluster}{points}, named by {scored(fused, j)} of {camera}"
        if k < 0:
            text = f"{_object(fused, j)}: missed by {method}; {origin}"
            yield Explanation("fused", camera, j, Reason(ReasonKind.MISSED), text)
        else:
            match_text = f"{method} has {scored(objects, k)} there"
            text = f"{_object(fused, j)}: {match_text}; {origin}"
            yield Explanation("fused", camera, j, Reason(ReasonKind.IN_BOTH), text)


def _object(objects: Objects, row: int) -> str:
    """Return name, score and distance of an object."""
    return f"{scored(objects, row)} at {objects.boxes.distance[row]:.1f} m"


def _points(count: int | np.integer) -> str:
    """Return a number of points in words."""
    return f"{count} point" if count == 1 else f"{count} points"


def _rule(reason: Reason, d: int, fusion: Fusion, detections: Detections) -> str:
    """Return the parameter that forbade a pair."""
    if reason.kind is ReasonKind.MISFIT and fusion.claims is not None:
        rating = f"{float(fusion.claims.fit[d]):.2g} x score {detections.score[d]:.2f}"
        return f"nothing there suits a {detections.names[d]} better than {rating}, {reason.limit}"
    return str(reason.limit)


def _set_aside(reason: Reason) -> str:
    """Return the parameter that excluded a cluster."""
    return f"set aside, {reason.limit}"
