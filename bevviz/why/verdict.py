"""Reason why a subject was reported or lost."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from bevviz.model.results import (
    CameraResult,
    ClusterState,
    Decision,
    DetectionState,
    FrameResult,
    Fusion,
    Opinion,
)
from bevviz.why.evidence import MOST, Candidate, Evidence, ReportedObject, camera_and_fusion
from bevviz.why.frame_index import FEW, PART, FrameIndex
from bevviz.why.outcome import find_fused
from bevviz.why.subject import Subject

WHOLE = 0.7  # least share of an object's clustered points in its named cluster; with less, it is split


class Reason(StrEnum):
    """The stage or rule that decided about a subject."""

    REPORTED = "reported"
    SHARED_BOX = "shared box"  # reported, but its box also names other clusters
    BORROWED = "borrowed name"  # named by a detection that is not its own
    SPLIT = "split"
    MERGED = "merged"
    MISNAMED = "misnamed"
    FAILED = "failed"
    OUT_OF_VIEW = "out of view"
    HIDDEN = "hidden"
    NO_POINTS = "no points"
    GROUND = "ground"
    NOISE = "noise"
    NO_CLUSTER = "no cluster"  # of a user's function or the robot; the cause is unknown
    TOO_SMALL = "too small"
    TOO_LARGE = "too large"
    NOT_RUN = "detector not run"
    NOT_DETECTED = "not detected"
    BELOW_THRESHOLD = "below threshold"
    SUPPRESSED = "suppressed"
    NOT_FUSED = "not fused"
    LOW_OVERLAP = "low overlap"
    TOO_FEW_POINTS = "too few points"
    TOO_FAR = "too far"
    TAKEN = "taken"
    MISFIT = "misfit"
    OTHER_CLUSTER = "other cluster"
    CONTRADICTED = "contradicted"  # reported by a stage that is not ours, and a camera sees nothing there
    NOT_AMONG = "not among the objects"  # of a 3D detector, or of a robot whose stages are unknown
    LOST_IN_FUSION = "lost in the fusion"  # in the robot's fusion, although it had a cluster and a detection


FLAWED = {Reason.SHARED_BOX, Reason.MERGED, Reason.SPLIT}
HOPELESS = {Reason.OUT_OF_VIEW, Reason.HIDDEN, Reason.NO_POINTS}

_REFUSED = {
    Decision.LOW_OVERLAP: Reason.LOW_OVERLAP,
    Decision.TOO_FEW_POINTS: Reason.TOO_FEW_POINTS,
    Decision.TOO_FAR: Reason.TOO_FAR,
    Decision.TAKEN: Reason.TAKEN,
    Decision.MISFIT: Reason.MISFIT,
    Decision.NO_CLUSTER: Reason.TOO_FEW_POINTS,
}


@dataclass(frozen=True, slots=True)
class Verdict:
    """Reason and sentence about a subject.

    ``reported`` means that it became an object of a right class, even if the object has other faults.
    """

    reason: Reason
    reported: bool
    text: str


def find_reason(subject: Subject, evidence: Evidence, traces: FrameIndex) -> tuple[Reason, bool]:
    """Find the first stage that lost the subject, or the fault of its reported object.

    Returns:
        reason: that stage or fault.
        reported: whether it still is an object of a right class.
    """
    if not traces.result.frame.lidar:
        return _reason_of_cameras(subject, evidence, traces)
    accepts = subject.accepts if traces.origin("objects").ours else subject.accepts_of_others
    if evidence.named is not None and accepts(evidence.named.name):
        return _flaw(subject, evidence, evidence.named, traces), True
    if evidence.named is not None and (
        not any(candidate.kept and subject.accepts(candidate.name) for candidate in evidence.candidates)
        or _is_in_reported_box(subject, evidence, evidence.named, traces)
    ):
        return Reason.MISNAMED, False
    if traces.result.objects is None:
        return Reason.FAILED, False
    if traces.origin("objects").ours:
        return _loss(subject, evidence, traces), False
    return _loss_of_other_stages(subject, evidence, traces), False


def _reason_of_cameras(subject: Subject, evidence: Evidence, traces: FrameIndex) -> tuple[Reason, bool]:
    """Return the reason with cameras alone, where a kept detection is reported."""
    best = evidence.best
    if not detector_ran(traces.result, subject.camera):
        return Reason.NOT_RUN, False
    if best is None or not subject.accepts(best.name):
        return Reason.NOT_DETECTED, False
    return (Reason.REPORTED, True) if best.kept else (_weakness(best, traces), False)


def _flaw(subject: Subject, evidence: Evidence, named: ReportedObject, traces: FrameIndex) -> Reason:
    """Return the fault of a reported object, REPORTED without a fault."""
    opinions = traces.result.opinions
    if opinions is not None and subject.kind == "object":
        denied = opinions.opinion[named.row] == Opinion.CONTRADICTED
        return Reason.CONTRADICTED if denied else Reason.REPORTED
    if named.detection < 0 or subject.kind == "object":
        return Reason.SHARED_BOX if named.also else Reason.REPORTED
    if evidence.mates or (subject.kind == "truth" and evidence.purity < MOST):
        return Reason.MERGED
    if not named.own and (subject.kind == "truth" or traces.result.config.fusion.method == "centroid"):
        return Reason.BORROWED
    if named.also:
        return Reason.SHARED_BOX
    whole = sum(part.points for part in evidence.parts)
    part = evidence.part(named.cluster)
    several = subject.kind == "truth" and len([part for part in evidence.parts if part.kept]) > 1
    return Reason.SPLIT if several and part is not None and part.points < WHOLE * whole else Reason.REPORTED


def _loss(subject: Subject, evidence: Evidence, traces: FrameIndex) -> Reason:
    """Return the reason why our fusion reported no object."""
    if subject.kind == "detection":
        return _loss_of_detection(evidence, traces)
    if not subject.is_place and not evidence.in_view:
        return Reason.OUT_OF_VIEW
    if evidence.raw < FEW:
        return _without_points(evidence)
    if evidence.main < 0:
        return _unclustered(evidence, traces)
    if not detector_ran(traces.result, subject.camera):
        return Reason.NOT_RUN
    if all(camera.fusion is None for camera in cameras_of(traces.result, subject.camera)):
        return Reason.NOT_FUSED
    if not evidence.in_view:
        return Reason.OUT_OF_VIEW
    best = evidence.best
    if best is None or not subject.accepts(best.name):
        return Reason.NOT_DETECTED
    if not best.kept:
        return _weakness(best, traces)
    return _refusal(subject, evidence, best, traces)


def _without_points(evidence: Evidence) -> Reason:
    """Return the reason for a subject without points."""
    return Reason.HIDDEN if evidence.in_front > MOST * evidence.aimed else Reason.NO_POINTS


def _unclustered(evidence: Evidence, traces: FrameIndex) -> Reason:
    """Return the reason for a subject with points but no kept cluster: the stage that took most of them."""
    aside = next((part for part in evidence.parts if not part.kept), None)
    if aside is not None and aside.points >= max(evidence.noise, len(evidence.ground)):
        return Reason.TOO_SMALL if aside.state == ClusterState.TOO_SMALL else Reason.TOO_LARGE
    if len(evidence.ground) >= evidence.noise:
        return Reason.GROUND
    return Reason.NOISE if traces.origin("clustering").ours else Reason.NO_CLUSTER


def cameras_of(result: FrameResult, camera: str) -> list[CameraResult]:
    """Return the camera of that name. An empty name means all cameras."""
    return [c for c in result.cameras if camera in ("", c.camera.name)]


def detector_ran(result: FrameResult, camera: str) -> bool:
    """Return whether the detector ran on an image of the camera, or of any camera."""
    return any(c.detections is not None for c in cameras_of(result, camera))


def _weakness(best: Candidate, traces: FrameIndex) -> Reason:
    """Return the reason for a detection that was not kept.

    If a suppressed detection is below the threshold anyway, the threshold is the reason.
    """
    least = traces.result.config.detector.conf_threshold
    strong = best.state == DetectionState.SUPPRESSED and best.score >= least
    return Reason.SUPPRESSED if strong else Reason.BELOW_THRESHOLD


def _refusal(subject: Subject, evidence: Evidence, best: Candidate, traces: FrameIndex) -> Reason:
    """Return the reason why a cluster and a detection were not matched."""
    _, fusion = camera_and_fusion(traces.result, best.camera)
    if fusion is None:
        return Reason.NOT_FUSED
    reason = pair_reason(fusion, traces, best.row, evidence.main)
    main = evidence.part(evidence.main)
    if subject.kind != "truth" or main is None:
        return reason
    if evidence.purity < MOST or _is_named_by_mate(evidence, fusion, best.camera, traces):
        return Reason.MERGED
    if reason in (Reason.LOW_OVERLAP, Reason.TOO_FEW_POINTS):
        return _fragment(evidence, main.points, traces) or reason
    return reason


def _is_named_by_mate(evidence: Evidence, fusion: Fusion, camera: str, traces: FrameIndex) -> bool:
    """Return whether another object in the subject's cluster named the cluster."""
    if fusion.cluster_decision[evidence.main] != Decision.MATCHED:
        return False
    camera_result, _ = camera_and_fusion(traces.result, camera)
    return int(traces.owners(camera_result)[fusion.cluster_detection[evidence.main]]) in evidence.mates


def _fragment(evidence: Evidence, inside: int, traces: FrameIndex) -> Reason | None:
    """Return the stage that took most of an object, None if its cluster holds at least half of it."""
    if inside >= MOST * evidence.voxels:
        return None
    rest = evidence.obstacles - inside - evidence.noise
    noise = Reason.NOISE if traces.origin("clustering").ours else Reason.NO_CLUSTER
    return max((len(evidence.ground), Reason.GROUND), (evidence.noise, noise), (rest, Reason.SPLIT))[1]


def pair_reason(fusion: Fusion, traces: FrameIndex, detection: int, cluster: int) -> Reason:
    """Return the rule of our fusion that separates a detection and a cluster; REPORTED: they match."""
    config, pair = traces.result.config.fusion, fusion.pair(detection, cluster)
    if config.method == "centroid":
        if pair is None or not np.isfinite(pair.cost):
            return Reason.TOO_FAR
    elif pair is None or pair.points < config.min_points:
        return Reason.TOO_FEW_POINTS
    elif pair.depth > config.max_depth:
        return Reason.TOO_FAR
    elif pair.iou < config.min_iou:
        return Reason.LOW_OVERLAP
    decision, matched = fusion.detection_decision[detection], fusion.detection_cluster[detection]
    if decision == Decision.MATCHED and matched == cluster:
        return Reason.REPORTED
    if decision == Decision.MISFIT:
        return Reason.MISFIT
    return Reason.OTHER_CLUSTER if decision == Decision.MATCHED else Reason.TAKEN


def _loss_of_detection(evidence: Evidence, traces: FrameIndex) -> Reason:
    """Return the reason why a detection gave no object."""
    best = evidence.best
    if best is None:
        return Reason.NOT_DETECTED
    if not best.kept:
        return _weakness(best, traces)
    _, fusion = camera_and_fusion(traces.result, best.camera)
    if fusion is None:
        return Reason.NOT_FUSED
    if best.decision is Decision.NO_CLUSTER or best.cluster < 0:
        return Reason.NO_POINTS if evidence.raw < FEW else _unclustered(evidence, traces)
    if best.decision is Decision.MATCHED:  # a detection of another camera named the object
        return Reason.TAKEN
    most_points = max((part.points for part in evidence.parts if part.kept), default=0)
    if evidence.voxels >= FEW and most_points < max(FEW, PART * evidence.obstacles):
        return _unclustered(evidence, traces)
    return Reason.MERGED if best.decision is Decision.TAKEN and evidence.mates else _REFUSED[best.decision]


# --- objects that our fusion did not make ------------------------------------------------------


def _loss_of_other_stages(subject: Subject, evidence: Evidence, traces: FrameIndex) -> Reason:
    """Return the reason why a 3D detector or the robot has no object, as far as its stages are known."""
    if subject.kind != "detection" and evidence.raw < FEW:
        return _without_points(evidence)
    robot = {
        section for section in ("ground", "clustering", "detector", "objects") if traces.origin(section).topic
    }
    if "objects" not in robot:
        return Reason.NOT_AMONG
    cluster = has_cluster(subject, evidence)
    if "clustering" in robot and traces.result.clusters is not None and not cluster:
        return (
            Reason.GROUND
            if "ground" in robot and len(evidence.ground) >= evidence.noise
            else Reason.NO_CLUSTER
        )
    detected = any(candidate.kept and subject.accepts(candidate.name) for candidate in evidence.candidates)
    ran = detector_ran(traces.result, subject.camera)
    if "detector" in robot and ran and not detected:
        return Reason.NOT_DETECTED if subject.is_place or evidence.in_view else Reason.OUT_OF_VIEW
    known = {"clustering", "detector"} <= robot and cluster and detected
    return Reason.LOST_IN_FUSION if known else Reason.NOT_AMONG


def _is_in_reported_box(
    subject: Subject, evidence: Evidence, named: ReportedObject, traces: FrameIndex
) -> bool:
    """Return whether the object of our fusion is inside the reported box."""
    row, opinions = find_fused(subject, evidence, traces), traces.result.opinions
    return row >= 0 and opinions is not None and int(opinions.partner[row]) == named.row


def has_cluster(subject: Subject, evidence: Evidence) -> bool:
    """Return whether the subject has a cluster; for a detection, one that our fusion accepts."""
    if subject.kind != "detection":
        return evidence.main >= 0
    return (
        evidence.best is not None
        and evidence.best.kept
        and evidence.best.decision in (Decision.MATCHED, Decision.TAKEN)
    )


def name_of(result: FrameResult, cluster: int) -> str:
    """Return the class of the object of a cluster, empty for none."""
    if result.objects is None or cluster < 0:
        return ""
    rows = np.flatnonzero(result.objects.cluster == cluster)
    return result.objects.names[rows[0]] if len(rows) else ""
