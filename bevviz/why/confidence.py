"""Probabilities of the outcomes of a subject without ground truth, by a logistic model of the evidence."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bevviz.model import geometry
from bevviz.model.frame import F32
from bevviz.model.reasons import ReasonKind
from bevviz.model.results import CameraResult, ClusterState, Decision, DetectionState
from bevviz.why.confidence_table import COEFFICIENTS
from bevviz.why.evidence import MOST, Evidence
from bevviz.why.frame_index import FEW, FrameIndex
from bevviz.why.subject import Subject, points_in_box, single_box

LIMIT = 0.7  # least probability of an answer; with less, it says that it cannot tell
SAME_BOX = 0.5  # IoU from which a suppressed detection is one of the box in question
HIGH = 0.15  # metres above the local ground from which points that are called ground may be an object
FAR = 40.0  # metres, distance of a subject without points
SIZE = (1.5, 0.8)  # metres, length and width of an object of unknown class
LEAST = 0.05  # metres, least size that is compared
AROUND = 0.1  # metres around an object's box that still belong to it
BORDER = 2.0  # pixels: a box nearer to the left or right border is cut off by it


class Outcome(NamedTuple):
    """A possible outcome of a subject: its reason, and whether it still is an object of a right class."""

    kind: ReasonKind
    reported: bool
    probability: float


def rank_outcomes(
    subject: Subject, evidence: Evidence, rule: tuple[ReasonKind, bool], traces: FrameIndex
) -> tuple[Outcome, ...]:
    """Return the outcomes of a subject, the most probable first.

    There are none with ground truth, for stages that are not ours, and for subjects that the benchmark does
    not ask about: these have no fit.

    Args:
        subject: the object or place in question.
        evidence: the evidence about it.
        rule: the outcome by the order in which the stages are blamed.
        traces: the index of the frame.
    """
    ours = all(traces.origin(name).ours for name in ("ground", "clustering", "detector", "objects"))
    asked = subject.kind in ("detection", "cluster") or subject.asked is not None
    if not asked or traces.result.frame.truth is not None or not ours or not traces.result.frame.lidar:
        return ()
    features = features_of(subject, evidence, traces)
    if features is None or not COEFFICIENTS:  # The benchmark empties the table before it fits another one.
        return ()
    values, named = np.array([*features.values()]), outcome_key(*rule)
    exponents = {key: float(values @ row[1:]) for key, row in COEFFICIENTS.items()}
    if named in exponents:
        exponents[named] += COEFFICIENTS[named][0]
    weights = np.exp(np.array([*exponents.values()]) - max(exponents.values()))
    outcomes = [
        Outcome(ReasonKind(key.removesuffix("*")), key.endswith("*"), probability)
        for key, probability in zip(exponents, (weights / weights.sum()).tolist(), strict=True)
    ]
    return tuple(sorted(outcomes, key=lambda outcome: -outcome.probability))


def outcome_key(kind: ReasonKind, reported: bool) -> str:
    """Return the name of an outcome in the table: that of its reason, with a star if it is reported."""
    return f"{kind.value}{'*' if reported else ''}"


def features_of(subject: Subject, evidence: Evidence, traces: FrameIndex) -> dict[str, float] | None:
    """Return the features of a subject by name. None: no camera compared it with detections."""
    camera = _camera_of(subject, evidence, traces)
    if camera is None:
        return None
    assert camera.fusion is not None
    cluster_uv = camera.fusion.cluster_uv
    box = subject.xyxy if subject.asked is None else subject.asked
    if box is None:
        box = cluster_uv[subject.row]
    if not np.isfinite(box).all():
        return None
    best = evidence.best
    main = evidence.main if evidence.main >= 0 or best is None else best.cluster
    return {
        "constant": 1.0,
        **_detection_features(box, main, evidence, camera, traces),
        **_object_features(box, evidence, cluster_uv, traces),
        **_point_features(main, evidence),
        **_cluster_features(box, main, evidence, camera, traces),
        **_box_features(box, evidence, camera, traces),
        "known as a cluster alone": float(subject.kind == "cluster"),
        "known as a place alone": float(subject.kind == "pixel"),
    }


def _camera_of(subject: Subject, evidence: Evidence, traces: FrameIndex) -> CameraResult | None:
    """Return the camera in question: that of the subject or of its detection, or the first one."""
    name = subject.camera or (evidence.best.camera if evidence.best is not None else "")
    for camera in traces.result.cameras:
        if name in ("", camera.camera.name) and camera.detections is not None and camera.fusion is not None:
            return camera
    return None


def _detection_features(
    box: F32, main: int, evidence: Evidence, camera: CameraResult, traces: FrameIndex
) -> dict[str, float]:
    """Return the features of the detections at the box in question."""
    best, detections, fusion = evidence.best, camera.detections, camera.fusion
    assert detections is not None and fusion is not None
    config = traces.result.config
    threshold, score = config.detector.conf_threshold, detections.score
    fits = geometry.iou(box[None], detections.xyxy)[0]
    others = detections.kept.copy()
    if best is not None:
        others[best.row] = False
    suppressed = (detections.state == DetectionState.SUPPRESSED) & (score >= threshold) & (fits >= SAME_BOX)
    weak = detections.state == DetectionState.BELOW_THRESHOLD
    kept = best is not None and best.kept
    matched = best is not None and kept and best.decision == Decision.MATCHED
    elsewhere = matched and best is not None and best.cluster != main
    pair = None if best is None or main < 0 else fusion.pair(best.row, main)
    ratio = 0.0 if best is None or kept else min(best.score / max(threshold, 1e-6), 1.5)
    return {
        "its detection is kept": float(kept),
        "score of its detection": 0.0 if best is None else best.score,
        "score by the threshold, if it is not kept": ratio,
        "IoU of its detection and the box": 0.0 if best is None else float(fits[best.row]),
        "largest IoU of the box and another kept detection": float(fits[others].max(initial=0.0)),
        "largest share of the box in another kept detection": _largest_share(box, detections.xyxy[others]),
        "largest IoU of the box and any detection": float(fits.max(initial=0.0)),
        "largest IoU times score of a weak detection": float((fits * score)[weak].max(initial=0.0)),
        "a strong detection was suppressed": float(suppressed.any()),
        "its detection was matched": float(matched),
        "its detection was matched with another cluster": float(elsewhere),
        "IoU of its detection and its cluster": 0.0 if pair is None else pair.iou,
        "this IoU minus fusion.min_iou": 0.0 if pair is None else pair.iou - config.fusion.min_iou,
    }


def _object_features(box: F32, evidence: Evidence, cluster_uv: F32, traces: FrameIndex) -> dict[str, float]:
    """Return the features of the reported objects at the box in question."""
    objects, best, fit, other = traces.result.objects, evidence.best, 0.0, 0
    if objects is not None and len(objects):
        fit = float(geometry.iou(box[None], np.nan_to_num(cluster_uv[objects.cluster], nan=-1.0)).max())
        own = -1 if best is None else best.row
        of_others = {*objects.cluster[objects.detection != own].tolist()}
        other = sum(part.points for part in evidence.parts if part.cluster in of_others)
    return {
        "it has an object": float(evidence.named is not None),
        "largest IoU of the box and the cluster of an object": fit,
        "share of its points in objects of other detections": other / max(evidence.obstacles, 1),
        **_object_box_features(evidence, traces),
    }


def _object_box_features(evidence: Evidence, traces: FrameIndex) -> dict[str, float]:
    """Return what the object's 3D box says about its cluster: it may lack points, or have too many."""
    named, result = evidence.named, traces.result
    outside = others = 0.0
    if named is not None and result.objects is not None and named.cluster >= 0:
        assert result.clusters is not None and result.obstacles is not None
        inside = points_in_box(single_box(result.objects.boxes, named.row), result.obstacles, AROUND)
        own = result.clusters.labels == named.cluster
        outside = float((own & ~inside).sum() / max(int(own.sum()), 1))
        others = float((inside & ~own).sum() / max(int(inside.sum()), 1))
    return {
        "share of its cluster outside its object's box": outside,
        "share of the points in its object's box in no cluster of it": others,
    }


def _point_features(main: int, evidence: Evidence) -> dict[str, float]:
    """Return the features of the subject's points, stage by stage."""
    part, obstacles, voxels = evidence.part(main), max(evidence.obstacles, 1), max(evidence.voxels, 1)
    kept = [piece.points for piece in evidence.parts if piece.kept]
    aside = {
        state: sum(piece.points for piece in evidence.parts if piece.state == state) / obstacles
        for state in (ClusterState.TOO_SMALL, ClusterState.TOO_LARGE)
    }
    pieces = [
        piece.points
        for piece in evidence.parts
        if piece.kept and piece.cluster != main and piece.points >= MOST * piece.count
    ]
    high = int((evidence.ground[np.isfinite(evidence.ground)] > HIGH).sum())
    return {
        "share of its points in its cluster": 0.0 if part is None else min(part.points / obstacles, 1.0),
        "share of its cluster that belongs to it": 0.0 if part is None else part.points / max(part.count, 1),
        "share of its points in other clusters that are mostly its own": sum(pieces) / obstacles,
        "largest share of its points in a kept cluster": max(kept, default=0) / obstacles,
        "share of its points in clusters that are too small": aside[ClusterState.TOO_SMALL],
        "share of its points in clusters that are too large": aside[ClusterState.TOO_LARGE],
        "number of its clusters, 1: four or more": min(sum(points >= FEW for points in kept), 4) / 4,
        "noise share": evidence.noise / voxels,
        "ground share": len(evidence.ground) / voxels,
        "share of ground that is high": high / voxels,
        "log10 of its voxels": float(np.log10(1 + evidence.voxels)),
        "log10 of its obstacle voxels": float(np.log10(1 + evidence.obstacles)),
    }


def _cluster_features(
    box: F32, main: int, evidence: Evidence, camera: CameraResult, traces: FrameIndex
) -> dict[str, float]:
    """Return the features of the subject's cluster, beside its share of points."""
    clusters, splits, inside = traces.result.clusters, traces.result.splits, 0.0
    length, width = size = _class_size(evidence, traces)
    if clusters is not None and main >= 0:
        length, width = np.sort(clusters.obb.size[main, :2])[::-1].tolist()
        if camera.uv is not None:
            uv = camera.uv[clusters.labels == main]
            inside = float(((uv >= box[:2]) & (uv <= box[2:])).all(axis=1).mean())
    joined = divided = False
    if splits is not None and main >= 0:
        rows = splits.cluster == main
        joined = int((rows & ~splits.is_noise).sum()) > 1
        divided = bool((rows & (splits.points < splits.of)).any())
    return {
        "share of its cluster inside the box": inside,
        "another object in its cluster": float(bool(evidence.mates)),
        "a detection divided its cluster": float(divided),
        "a detection joined its cluster": float(joined),
        "log2 of its cluster's length by the class's": float(np.log2(max(length, LEAST) / size[0])),
        "log2 of its cluster's width by the class's": float(np.log2(max(width, LEAST) / size[1])),
    }


def _box_features(box: F32, evidence: Evidence, camera: CameraResult, traces: FrameIndex) -> dict[str, float]:
    """Return the features of the box in question. Little of an object at the border may be in the image."""
    intrinsics, (length, width) = camera.camera.intrinsics, _class_size(evidence, traces)
    across, high = np.maximum(box[2:] - box[:2], 1.0).tolist()
    cut, metres = 0.0, LEAST
    if intrinsics is not None:
        cut = float(box[0] <= BORDER or box[2] >= intrinsics.width - 1 - BORDER)
        away = evidence.distance if np.isfinite(evidence.distance) else FAR
        metres = max(across * away / float(intrinsics.K[0, 0]), LEAST)
    return {
        "log2 of the box's width by its height": float(np.log2(across / high)),
        "at the border, log2 of its width by the class's": cut * float(np.log2(metres / width)),
        "at the border, log2 of its width by the class's length": cut * float(np.log2(metres / length)),
    }


def _class_size(evidence: Evidence, traces: FrameIndex) -> tuple[float, float]:
    """Return the mean length and width of the class of the subject's detection."""
    best, sizes = evidence.best, traces.result.config.objects.sizes
    size = None if best is None else sizes.get(best.name)
    return SIZE if size is None else (size[0], size[1])


def _largest_share(box: F32, boxes: F32) -> float:
    """Return the largest share of a box that lies inside one of others."""
    low, high = np.maximum(box[:2], boxes[:, :2]), np.minimum(box[2:], boxes[:, 2:])
    shared = np.maximum(high - low, 0.0).prod(axis=1)
    return float(shared.max(initial=0.0) / max(float((box[2:] - box[:2]).prod()), 1.0))
