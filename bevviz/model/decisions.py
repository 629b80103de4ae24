"""Explanation of every decision of a frame, with its numbers and the parameter that decided it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from bevviz.config import BUILTIN_METHODS, Config
from bevviz.config.plugins import TOPIC
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

MIN_NOISE_SHARE = 0.1  # Least share of noise in the points of a detection that an explanation mentions.


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
    for text in texts:
        yield Explanation("camera", result.camera.name, -1, "problem", f"{result.camera.name}: {text}")


# --- detections --------------------------------------------------------------------------------


def _detections(
    result: CameraResult, detections: Detections, clusters: Clusters | None, config: Config, lidar: bool
) -> Iterator[Explanation]:
    """Yield the explanation of each detection of a camera."""
    for d, value in enumerate(detections.state.tolist()):
        state = DetectionState(value)
        key = state.name.lower()
        if state is DetectionState.BELOW_THRESHOLD:
            text = f"below detector.conf_threshold {config.detector.conf_threshold:g}"
        elif state is DetectionState.SUPPRESSED:
            rival = _label(detections, int(detections.suppressed_by[d]))
            limit = f"detector.iou_threshold {config.detector.iou_threshold:g}"
            text = f"suppressed by {rival}, IoU {detections.overlap[d]:.2f} > {limit}"
        elif result.fusion is None or clusters is None:
            why = "; ".join(result.camera.problems) or "no clusters in this frame"
            text = f"not compared with clusters: {why}" if lidar else "kept"
        else:
            decision = Decision(int(result.fusion.detection_decision[d]))
            key = decision.name.lower()
            text = _detection(decision, d, result, result.fusion, detections, clusters, config)
        yield Explanation("detection", result.camera.name, d, key, f"{_label(detections, d)}: {text}")


def _detection(
    decision: Decision,
    d: int,
    result: CameraResult,
    fusion: Fusion,
    detections: Detections,
    clusters: Clusters,
    config: Config,
) -> str:
    """Return the decision of the fusion about detection ``d`` in words."""
    if decision is Decision.NO_CLUSTER:
        return f"no cluster, {_unclustered(d, result, detections, clusters, config)}"
    k = int(fusion.detection_cluster[d])
    pair = _pair(fusion, d, k)
    if config.fusion.method == "centroid":
        evidence = f"centre of cluster {k} at {pair.depth:.1f} m is {pair.distance:.0f} px from its own"
    else:
        evidence = (
            f"{_points(pair.points)} of cluster {k} in its frustum at {pair.depth:.1f} m, IoU {pair.iou:.2f}"
            + mask_evidence(fusion, d, config)
        )
    if decision is Decision.MATCHED:
        is_matched = (fusion.cluster_decision == Decision.MATCHED) & (fusion.cluster_detection == d)
        others = [str(other) for other in np.flatnonzero(is_matched).tolist() if other != k]
        if not others:
            return f"{evidence}, matched"
        also = f"clusters {', '.join(others)} take" if others[1:] else f"cluster {others[0]} takes"
        return f"{evidence}, matched; {also} the same box"
    if decision is Decision.TAKEN:
        return f"no match: {evidence}, taken by {_label(detections, int(fusion.cluster_detection[k]))}"
    return f"no match: {evidence}, {_rule(decision, d, fusion, detections, config)}"


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
            kinds.append(f"{count} noise ({_noise(config)})")
        else:
            kinds.append(f"{count} of cluster {label} ({_set_aside(int(clusters.state[label]), config)})")
    return f"{_points(len(labels))} in its frustum: {', '.join(kinds)}"


def _noise(config: Config) -> str:
    """Return the parameter or the method that decided what is noise."""
    method_name = config.clustering.method
    if method_name in BUILTIN_METHODS:
        return f"clustering.min_points is {config.clustering.min_points}"
    return f"by {method_name.removeprefix(TOPIC)}"


# --- clusters ----------------------------------------------------------------------------------


def _clusters(cameras: Sequence[CameraResult], clusters: Clusters, config: Config) -> Iterator[Explanation]:
    """Yield the explanation of each cluster for each camera that sees it."""
    compared = [result.camera.name for result in cameras if result.fusion is not None]
    ranges = np.hypot(clusters.centroid[:, 0], clusters.centroid[:, 1])
    for k, (state, count, distance) in enumerate(
        zip(clusters.state.tolist(), clusters.count, ranges, strict=True)
    ):
        head = f"cluster {k}: {_points(count)} at {distance:.1f} m"
        if state != ClusterState.KEPT:
            text = f"{head}: {_set_aside(state, config)}"
            yield Explanation("cluster", "", k, ClusterState(state).name.lower(), text)
            continue
        if not compared:
            yield Explanation(
                "cluster", "", k, "kept", f"{head}: not compared with detections, as no camera has any"
            )
            continue
        unseen = True
        for result in cameras:
            fusion, detections = result.fusion, result.detections
            if fusion is None or detections is None or fusion.cluster_decision[k] == Decision.OUT_OF_VIEW:
                continue
            unseen = False
            decision = Decision(int(fusion.cluster_decision[k]))
            text = _cluster(decision, k, fusion, detections, config)
            if decision is not Decision.MATCHED:
                text = f"in view of {result.camera.name}, {text}"
            yield Explanation("cluster", result.camera.name, k, decision.name.lower(), f"{head}: {text}")
        if unseen:
            yield Explanation(
                "cluster", "", k, "out_of_view", f"{head}: out of view of {' and '.join(compared)}"
            )


def _cluster(decision: Decision, k: int, fusion: Fusion, detections: Detections, config: Config) -> str:
    """Return the decision of the fusion about cluster ``k`` in words."""
    if decision is Decision.NO_DETECTION:
        return "under no detection"
    d = int(fusion.cluster_detection[k])
    label = _label(detections, d)
    if decision is Decision.MATCHED:
        return f"matched with {label}"
    pair = _pair(fusion, d, k)
    if config.fusion.method == "centroid":
        evidence = f"its centre {pair.distance:.0f} px from that of {label}"
    else:
        evidence = f"{_points(pair.points)} in the frustum of {label}, IoU {pair.iou:.2f}"
    if decision is Decision.TAKEN:
        return f"{evidence}, taken by cluster {fusion.detection_cluster[d]}"
    return f"{evidence}, {_rule(decision, d, fusion, detections, config)}"


def _splits(cameras: Sequence[CameraResult], splits: Splits) -> Iterator[Explanation]:
    """Yield the explanation of each cluster that a detection split or merged."""
    by_name = {result.camera.name: result.detections for result in cameras}
    keys = list(zip(splits.camera, splits.detection.tolist(), splits.cluster.tolist(), strict=True))
    for camera, d, part_cluster in dict.fromkeys(keys):
        detections = by_name[camera]
        assert detections is not None
        label_text = f"by {_label(detections, d)}"
        cluster_points, noise_points = [], 0
        rows = [row for row, key in enumerate(keys) if key == (camera, d, part_cluster)]
        for row in rows:
            rest_cluster, points = int(splits.rest[row]), int(splits.points[row])
            share = f"{points:,} of {splits.of[row]:,} points"
            if rest_cluster >= 0:
                text = f"cluster {rest_cluster} split {label_text}: {share} are cluster {part_cluster}"
                yield Explanation("split", camera, rest_cluster, "split", text)
            elif points < splits.of[row]:
                text = f"cluster {part_cluster} split {label_text}: {share} of a cluster "
                text += "that others have the rest of"
                yield Explanation("split", camera, part_cluster, "split", text)
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
                "merged",
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
        yield Explanation("object", name, k, opinion.word, f"{_object(objects, k)}: {text}")


def _opinion(
    opinion: Opinion,
    k: int,
    opinions: Opinions,
    result: CameraResult | None,
    clusters: Clusters | None,
    config: Config,
) -> str:
    """Return the opinion on object ``k`` in words, with the number that decided it."""
    camera, limits = "" if result is None else result.camera.name, config.opinions
    if opinion is Opinion.NOT_ASKED:
        return "unseen, no camera has detections"
    if opinion is Opinion.OUT_OF_VIEW:
        share = f"{opinions.shown[k]:.0%} of it in the image of {camera or 'any camera'}"
        return f"unseen, {share}, opinions.min_shown is {limits.min_shown:g}"
    if opinion is Opinion.HIDDEN:
        share = f"{opinions.visible[k]:.0%} of it is not hidden behind what is nearer"
        return f"unseen, {share}, opinions.min_visible is {limits.min_visible:g}"
    if opinion is Opinion.TOO_SMALL:
        height = f"{opinions.height[k]:.1f} px high in {camera}"
        return f"unseen, {height}, opinions.min_height is {limits.min_height:g} px"
    if opinion is Opinion.NO_CLASS:
        return f"unseen, the detector of {camera} knows no such class"
    assert result is not None
    d = int(opinions.detection[k])
    if opinion is not Opinion.CONTRADICTED:
        assert result.detections is not None
        head = "confirmed by" if opinion is Opinion.CONFIRMED else "named otherwise by"
        return f"{head} {_label(result.detections, d)} of {camera}, {_looks(k, d, opinions, result)}"
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
        limit = f", not even with a score of {config.detector.explain_threshold:g}" if is_network else ""
        return f"no detection there{limit}"
    text = f"the nearest is {_label(detections, d)}, IoU {opinions.iou[k]:.2f}"
    state = DetectionState(int(detections.state[d]))
    if state is DetectionState.BELOW_THRESHOLD:
        return f"{text}, below detector.conf_threshold {config.detector.conf_threshold:g}"
    if fusion is not None and clusters is not None and fusion.detection_decision[d] == Decision.MATCHED:
        cluster = int(fusion.detection_cluster[d])
        return f"{text}, which is cluster {cluster} at {np.hypot(*clusters.centroid[cluster, :2]):.1f} m"
    if opinions.iou[k] < config.opinions.min_iou:
        return f"{text}, opinions.min_iou is {config.opinions.min_iou:g}"
    return f"{text}, which fits another box better"


def _fused(
    objects: Objects, opinions: Opinions, clusters: Clusters | None, config: Config
) -> Iterator[Explanation]:
    """Yield for each object of our fusion whether the other method has it, too."""
    method, fused = _method(config), opinions.fused
    for j, k in enumerate(opinions.partner.tolist()):
        cluster, camera = int(fused.cluster[j]), fused.camera[j]
        points = "" if clusters is None else f", {_points(clusters.count[cluster])}"
        origin = f"cluster {cluster}{points}, named by {_label(fused, j)} of {camera}"
        if k < 0:
            yield Explanation(
                "fused", camera, j, "missed", f"{_object(fused, j)}: missed by {method}; {origin}"
            )
        else:
            match_text = f"{method} has {_label(objects, k)} there"
            yield Explanation("fused", camera, j, "found", f"{_object(fused, j)}: {match_text}; {origin}")


def _method(config: Config) -> str:
    """Return the short name of the method that made the objects."""
    method = config.objects.method.removeprefix(TOPIC)
    return method if method.startswith("/") and not method.endswith(".onnx") else Path(method).name


def _object(objects: Objects, row: int) -> str:
    """Return name, score and distance of an object."""
    return f"{_label(objects, row)} at {np.hypot(*objects.boxes.center[row, :2]):.1f} m"


def _pair(fusion: Fusion, d: int, k: int) -> Pair:
    """Return the evidence of a detection and a cluster that the fusion compared."""
    pair = fusion.pair(d, k)
    assert pair is not None
    return pair


# --- words -------------------------------------------------------------------------------------


def _label(items: Detections | Objects, row: int) -> str:
    """Return name and score of a detection or an object."""
    return f"{items.names[row]} {items.score[row]:.2f}"


def _points(count: int | np.integer) -> str:
    """Return a number of points in words."""
    return f"{count} point" if count == 1 else f"{count} points"


def _rule(decision: Decision, d: int, result: Fusion, detections: Detections, config: Config) -> str:
    """Return the parameter that forbade a pair."""
    fusion = config.fusion
    if decision is Decision.MISFIT and result.claims is not None:
        fit, name = float(result.claims.fit[d]), detections.names[d]
        rating = f"{fit:.2g} x score {detections.score[d]:.2f}"
        limit = f"fusion.min_rating is {fusion.min_rating:g}"
        return f"nothing there suits a {name} better than {rating}, {limit}"
    if decision is Decision.TOO_FEW_POINTS:
        return f"fusion.min_points is {fusion.min_points}"
    if decision is Decision.LOW_OVERLAP:
        return f"fusion.min_iou is {fusion.min_iou:g}"
    if fusion.method == "centroid":
        return f"fusion.match_radius is {fusion.match_radius:g} px"
    return f"fusion.max_depth is {fusion.max_depth:g} m"


def _set_aside(state: int, config: Config) -> str:
    """Return the parameter that excluded a cluster."""
    if state == ClusterState.TOO_SMALL:
        return f"set aside, clustering.min_cluster_points is {config.clustering.min_cluster_points}"
    return f"set aside, clustering.max_cluster_points is {config.clustering.max_cluster_points}"
