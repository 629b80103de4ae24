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
from bevviz.why.evidence import MOST, Candidate, Evidence, Named, fusion_of
from bevviz.why.frame_index import FEW, PART, Traces
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


def find_reason(subject: Subject, e: Evidence, traces: Traces) -> tuple[Reason, bool]:
    """Find the first stage that lost the subject, or the fault of its reported object.

    Returns:
        reason: that stage or fault.
        reported: whether it still is an object of a right class.
    """
    if not traces.result.frame.lidar:
        return _seen(subject, e, traces)
    accepts = subject.accepts if traces.origin("objects").ours else subject.accepts_of_others
    if e.named is not None and accepts(e.named.name):
        return _flaw(subject, e, e.named, traces), True
    if e.named is not None and (
        not any(c.kept and subject.accepts(c.name) for c in e.candidates)
        or _in_their_box(subject, e, e.named, traces)
    ):
        return Reason.MISNAMED, False
    if traces.result.objects is None:
        return Reason.FAILED, False
    if traces.origin("objects").ours:
        return _loss(subject, e, traces), False
    return _loss_of_others(subject, e, traces), False


def _seen(subject: Subject, e: Evidence, traces: Traces) -> tuple[Reason, bool]:
    """Return the reason with cameras alone, where a kept detection is reported."""
    best = e.best
    if not detector_ran(traces.result, subject.camera):
        return Reason.NOT_RUN, False
    if best is None or not subject.accepts(best.name):
        return Reason.NOT_DETECTED, False
    return (Reason.REPORTED, True) if best.kept else (_weakness(best, traces), False)


def _flaw(subject: Subject, e: Evidence, named: Named, traces: Traces) -> Reason:
    """Return the fault of a reported object, REPORTED without a fault."""
    opinions = traces.result.opinions
    if opinions is not None and subject.kind == "object":
        denied = opinions.opinion[named.row] == Opinion.CONTRADICTED
        return Reason.CONTRADICTED if denied else Reason.REPORTED
    if named.detection < 0 or subject.kind == "object":
        return Reason.SHARED_BOX if named.also else Reason.REPORTED
    if e.mates or (subject.kind == "truth" and e.purity < MOST):
        return Reason.MERGED
    if not named.own and (subject.kind == "truth" or traces.result.config.fusion.method == "centroid"):
        return Reason.BORROWED
    if named.also:
        return Reason.SHARED_BOX
    whole = sum(part.points for part in e.parts)
    part = e.part(named.cluster)
    several = subject.kind == "truth" and len([p for p in e.parts if p.kept]) > 1
    return Reason.SPLIT if several and part is not None and part.points < WHOLE * whole else Reason.REPORTED


def _loss(subject: Subject, e: Evidence, traces: Traces) -> Reason:
    """Return the reason why our fusion reported no object."""
    if subject.kind == "detection":
        return _loss_of_detection(e, traces)
    if not subject.is_place and not e.in_view:
        return Reason.OUT_OF_VIEW
    if e.raw < FEW:
        return _without_points(e)
    if e.main < 0:
        return _unclustered(e, traces)
    if not detector_ran(traces.result, subject.camera):
        return Reason.NOT_RUN
    if all(camera.fusion is None for camera in cameras_of(traces.result, subject.camera)):
        return Reason.NOT_FUSED
    if not e.in_view:
        return Reason.OUT_OF_VIEW
    best = e.best
    if best is None or not subject.accepts(best.name):
        return Reason.NOT_DETECTED
    if not best.kept:
        return _weakness(best, traces)
    return _refusal(subject, e, best, traces)


def _without_points(e: Evidence) -> Reason:
    """Return the reason for a subject without points."""
    return Reason.HIDDEN if e.in_front > MOST * e.aimed else Reason.NO_POINTS


def _unclustered(e: Evidence, traces: Traces) -> Reason:
    """Return the reason for a subject with points but no kept cluster: the stage that took most of them."""
    aside = next((part for part in e.parts if not part.kept), None)
    if aside is not None and aside.points >= max(e.noise, len(e.ground)):
        return Reason.TOO_SMALL if aside.state == ClusterState.TOO_SMALL else Reason.TOO_LARGE
    if len(e.ground) >= e.noise:
        return Reason.GROUND
    return Reason.NOISE if traces.origin("clustering").ours else Reason.NO_CLUSTER


def cameras_of(result: FrameResult, camera: str) -> list[CameraResult]:
    """Return the camera of that name. An empty name means all cameras."""
    return [c for c in result.cameras if camera in ("", c.camera.name)]


def detector_ran(result: FrameResult, camera: str) -> bool:
    """Return whether the detector ran on an image of the camera, or of any camera."""
    return any(c.detections is not None for c in cameras_of(result, camera))


def _weakness(best: Candidate, traces: Traces) -> Reason:
    """Return the reason for a detection that was not kept.

    If a suppressed detection is below the threshold anyway, the threshold is the reason.
    """
    least = traces.result.config.detector.conf_threshold
    strong = best.state == DetectionState.SUPPRESSED and best.score >= least
    return Reason.SUPPRESSED if strong else Reason.BELOW_THRESHOLD


def _refusal(subject: Subject, e: Evidence, best: Candidate, traces: Traces) -> Reason:
    """Return the reason why a cluster and a detection were not matched."""
    _, fusion = fusion_of(traces.result, best.camera)
    if fusion is None:
        return Reason.NOT_FUSED
    reason = pair_reason(fusion, traces, best.row, e.main)
    main = e.part(e.main)
    if subject.kind != "truth" or main is None:
        return reason
    if e.purity < MOST or _taken_by_mate(e, fusion, best.camera, traces):
        return Reason.MERGED
    if reason in (Reason.LOW_OVERLAP, Reason.TOO_FEW_POINTS):
        return _fragment(e, main.points, traces) or reason
    return reason


def _taken_by_mate(e: Evidence, fusion: Fusion, camera: str, traces: Traces) -> bool:
    """Return whether another object in the subject's cluster named the cluster."""
    if fusion.cluster_decision[e.main] != Decision.MATCHED:
        return False
    found, _ = fusion_of(traces.result, camera)
    return int(traces.owners(found)[fusion.cluster_detection[e.main]]) in e.mates


def _fragment(e: Evidence, inside: int, traces: Traces) -> Reason | None:
    """Return the stage that took most of an object, None if its cluster holds at least half of it."""
    if inside >= MOST * e.voxels:
        return None
    rest = e.obstacles - inside - e.noise
    noise = Reason.NOISE if traces.origin("clustering").ours else Reason.NO_CLUSTER
    return max((len(e.ground), Reason.GROUND), (e.noise, noise), (rest, Reason.SPLIT))[1]


def pair_reason(fusion: Fusion, traces: Traces, detection: int, cluster: int) -> Reason:
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


def _loss_of_detection(e: Evidence, traces: Traces) -> Reason:
    """Return the reason why a detection gave no object."""
    best = e.best
    if best is None:
        return Reason.NOT_DETECTED
    if not best.kept:
        return _weakness(best, traces)
    _, fusion = fusion_of(traces.result, best.camera)
    if fusion is None:
        return Reason.NOT_FUSED
    if best.decision is Decision.NO_CLUSTER or best.cluster < 0:
        return Reason.NO_POINTS if e.raw < FEW else _unclustered(e, traces)
    if best.decision is Decision.MATCHED:  # a detection of another camera named the object
        return Reason.TAKEN
    held = max((part.points for part in e.parts if part.kept), default=0)
    if e.voxels >= FEW and held < max(FEW, PART * e.obstacles):
        return _unclustered(e, traces)
    return Reason.MERGED if best.decision is Decision.TAKEN and e.mates else _REFUSED[best.decision]


# --- objects that our fusion did not make ------------------------------------------------------


def _loss_of_others(subject: Subject, e: Evidence, traces: Traces) -> Reason:
    """Return the reason why a 3D detector or the robot has no object, as far as its stages are known."""
    if subject.kind != "detection" and e.raw < FEW:
        return _without_points(e)
    robot = {s for s in ("ground", "clustering", "detector", "objects") if traces.origin(s).topic}
    if "objects" not in robot:
        return Reason.NOT_AMONG
    cluster = has_cluster(subject, e)
    if "clustering" in robot and traces.result.clusters is not None and not cluster:
        return Reason.GROUND if "ground" in robot and len(e.ground) >= e.noise else Reason.NO_CLUSTER
    detected = any(c.kept and subject.accepts(c.name) for c in e.candidates)
    ran = detector_ran(traces.result, subject.camera)
    if "detector" in robot and ran and not detected:
        return Reason.NOT_DETECTED if subject.is_place or e.in_view else Reason.OUT_OF_VIEW
    known = {"clustering", "detector"} <= robot and cluster and detected
    return Reason.LOST_IN_FUSION if known else Reason.NOT_AMONG


def _in_their_box(subject: Subject, e: Evidence, named: Named, traces: Traces) -> bool:
    """Return whether the object of our fusion is inside the reported box."""
    j, opinions = find_fused(subject, e, traces), traces.result.opinions
    return j >= 0 and opinions is not None and int(opinions.partner[j]) == named.row


def has_cluster(subject: Subject, e: Evidence) -> bool:
    """Return whether the subject has a cluster; for a detection, one that our fusion accepts."""
    if subject.kind != "detection":
        return e.main >= 0
    return e.best is not None and e.best.kept and e.best.decision in (Decision.MATCHED, Decision.TAKEN)


def name_of(result: FrameResult, cluster: int) -> str:
    """Return the class of the object of a cluster, empty for none."""
    if result.objects is None or cluster < 0:
        return ""
    rows = np.flatnonzero(result.objects.cluster == cluster)
    return result.objects.names[rows[0]] if len(rows) else ""
