"""Probability that the reason of an answer without ground truth is right."""

from __future__ import annotations

import numpy as np

from bevviz.model import geometry
from bevviz.model.frame import F64
from bevviz.model.reasons import ReasonKind
from bevviz.why.confidence_table import COEFFICIENTS, SECOND
from bevviz.why.evidence import Evidence, camera_and_fusion
from bevviz.why.frame_index import FEW, FrameIndex
from bevviz.why.subject import Subject

LIMIT = 0.7  # least probability of an answer; with less, it says that it cannot tell
FEATURES = (
    "constant",
    "score of the detection",
    "IoU of the detection and the cluster",
    "share of its points in its cluster",
    "share of its cluster that belongs to it",
    "noise share",
    "ground share",
    "log10 of its voxels",
    "number of its clusters, 1: four or more",
    "IoU with the nearest other kept detection",
    "another object in its cluster",
    "known as a cluster alone",
)
STAGES = {
    **dict.fromkeys(("reported", "merged", "shared box", "borrowed name", "split", "misnamed"), "objects"),
    **dict.fromkeys(("below threshold", "suppressed", "not detected"), "detector"),
    **dict.fromkeys(("noise", "ground", "too small", "too large", "no points"), "LiDAR"),
}


def stage_of(kind: ReasonKind) -> str:
    """Return the group of reasons that has its own coefficients."""
    return STAGES.get(kind.value, "fusion")


def confidence_of(subject: Subject, evidence: Evidence, kind: ReasonKind, traces: FrameIndex) -> float | None:
    """Return the probability that a reason is right.

    It is None with ground truth, for stages that are not ours, and for subjects that the benchmark does not
    ask about: these have no fit.
    """
    ours = all(traces.origin(name).ours for name in ("ground", "clustering", "detector", "objects"))
    if subject.kind not in ("detection", "cluster", "pixel") or traces.result.frame.truth is not None:
        return None
    if not ours or not traces.result.frame.lidar:
        return None
    exponent = float(features_of(subject, evidence, traces) @ np.array(COEFFICIENTS[stage_of(kind)]))
    return float(1 / (1 + np.exp(-exponent)))


def features_of(subject: Subject, evidence: Evidence, traces: FrameIndex) -> F64:
    """Return the values of FEATURES."""
    best, part = evidence.best, evidence.part(evidence.main)
    pair, nearest = None, 0.0
    if best is not None:
        _, fusion = camera_and_fusion(traces.result, best.camera)
        cluster = evidence.main if evidence.main >= 0 else best.cluster
        pair = None if fusion is None or cluster < 0 else fusion.pair(best.row, cluster)
    camera = traces.camera(subject.camera)
    if subject.xyxy is not None and camera is not None and camera.detections is not None:
        others = camera.detections.kept.copy()
        if subject.kind == "detection":
            others[subject.row] = False
        overlap = geometry.iou(subject.xyxy[None], camera.detections.xyxy[others])
        nearest = float(overlap.max(initial=0.0))
    several = sum(piece.kept and piece.points >= FEW for piece in evidence.parts)
    points = 0 if part is None else part.points
    return np.array(
        [
            1.0,
            0.0 if best is None else best.score,
            0.0 if pair is None else pair.iou,
            min(points / max(evidence.obstacles, 1), 1.0),
            0.0 if part is None else min(points / max(part.count, 1), 1.0),
            evidence.noise / max(evidence.voxels, 1),
            len(evidence.ground) / max(evidence.voxels, 1),
            np.log10(1 + evidence.voxels),
            min(several, 4) / 4,
            nearest,
            float(bool(evidence.mates)),
            float(subject.kind == "cluster"),
        ]
    )


def likely(kind: ReasonKind) -> tuple[ReasonKind, ReasonKind]:
    """Return the named reason and the one that was right most often where it was wrong."""
    return kind, ReasonKind(SECOND.get(kind.value, "below threshold"))
