"""Which of the stages decided, and the sentence that says so."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from bevviz.config import Config
from bevviz.frame import ClusterState, Decision, DetectionState, FrameResult
from bevviz.why.evidence import Candidate, Evidence, Part
from bevviz.why.subject import LINK, Subject, projected

FEW = 3  # raw points that are as good as none
MOST = 0.5  # share from which something is called the cause
DIVIDED = 0.7  # share of an object's clustered points that its main cluster has at least, if it is whole


class Reason(StrEnum):
    REPORTED = "reported"
    SHARED_BOX = "shared box"  # reported, but its box names other clusters, too
    BORROWED = "borrowed name"  # nothing that a detection is of: named by the box of another cluster
    SPLIT = "split"
    MERGED = "merged"
    MISNAMED = "misnamed"
    FAILED = "failed"
    OUT_OF_VIEW = "out of view"
    HIDDEN = "hidden"
    NO_POINTS = "no points"
    GROUND = "ground"
    NOISE = "noise"
    TOO_SMALL = "too small"
    TOO_LARGE = "too large"
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


_REFUSED = {
    Decision.LOW_OVERLAP: Reason.LOW_OVERLAP,
    Decision.TOO_FEW_POINTS: Reason.TOO_FEW_POINTS,
    Decision.TOO_FAR: Reason.TOO_FAR,
    Decision.TAKEN: Reason.TAKEN,
    Decision.MISFIT: Reason.MISFIT,
    Decision.NO_CLUSTER: Reason.OTHER_CLUSTER,
}


@dataclass(frozen=True, slots=True)
class Verdict:
    """``reported``: it ended as an object of a right class, whatever else is wrong with it."""

    reason: Reason
    reported: bool
    text: str


def judge(subject: Subject, evidence: Evidence, result: FrameResult, config: Config) -> Verdict:
    """The first stage at which the subject was lost, or what is wrong with how it was reported."""
    reason = _find(subject, evidence, result, config)
    good = {Reason.REPORTED, Reason.SHARED_BOX, Reason.SPLIT, Reason.BORROWED}
    reported = reason in good or (reason is Reason.MERGED and _represents(subject, evidence, result))
    because = _because(subject, reason, evidence, result, config)
    head = subject.name[0].upper() + subject.name[1:]
    was = "was" if reported else "was not"
    if reason is Reason.REPORTED:
        text = f"{head} was reported: {because}."
    elif reported:
        text = f"{head} {was} reported, but {because}."
    else:
        text = f"{head} {was} reported because {because}."
    return Verdict(reason, reported, text)


def _find(subject: Subject, e: Evidence, result: FrameResult, config: Config) -> Reason:
    if result.clusters is None:
        return Reason.FAILED
    main = e.parts[0] if e.parts else None
    best = e.candidates[0] if e.candidates else None
    kept = best is not None and best.state == DetectionState.KEPT and subject.accepts(best.name)
    object_ = name_of(result, main.cluster) if main is not None else ""
    if subject.kind == "detection":
        return _find_detection(e, result, best)
    if main is not None and object_:
        return _find_reported(subject, e, result, config, main)
    if not _in_view(subject, result):
        return Reason.OUT_OF_VIEW
    if e.raw < FEW:
        return Reason.HIDDEN if e.in_front > MOST * max(e.aimed, 1) else Reason.NO_POINTS
    if main is None or main.state != ClusterState.KEPT:
        return _lost(e, main)
    if not kept or best is None:
        if best is None or not subject.accepts(best.name):
            return Reason.NOT_DETECTED
        return _weak(best)
    if e.others and best.decision in (Decision.TAKEN, Decision.LOW_OVERLAP):
        return Reason.MERGED
    return Reason.OTHER_CLUSTER if best.decision is Decision.MATCHED else _REFUSED[best.decision]


def _find_reported(subject: Subject, e: Evidence, result: FrameResult, config: Config, main: Part) -> Reason:
    name = name_of(result, main.cluster)
    if not subject.accepts(name):
        return Reason.MERGED if e.others else Reason.MISNAMED
    if e.others:
        return Reason.MERGED
    camera, row, sharing = box_of(result, main.cluster)
    own = any((c.camera, c.row) == (camera, row) and c.overlap >= LINK for c in e.candidates)
    if not own and config.fusion.method == "centroid":
        return Reason.BORROWED  # a name that merely was the nearest
    if sharing:
        return Reason.SHARED_BOX
    kept = [part for part in e.parts if part.state == ClusterState.KEPT]
    whole = sum(part.points for part in e.parts)
    return Reason.SPLIT if len(kept) > 1 and main.points < DIVIDED * whole else Reason.REPORTED


def _find_detection(e: Evidence, result: FrameResult, best: Candidate | None) -> Reason:
    if best is None:
        return Reason.NOT_DETECTED
    if best.state != DetectionState.KEPT:
        return _weak(best)
    found = next(c for c in result.cameras if c.camera.name == best.camera)
    if found.fusion is None:
        return Reason.NOT_FUSED
    if best.decision is Decision.MATCHED:
        return Reason.SHARED_BOX if box_of(result, best.cluster)[2] else Reason.REPORTED
    if best.decision is Decision.NO_CLUSTER:
        return Reason.NO_POINTS if e.raw < FEW else _lost(e, e.parts[0] if e.parts else None)
    if best.decision is Decision.TAKEN and e.others:
        return Reason.MERGED
    obstacles = e.noise + sum(part.points for part in e.parts)
    if best.decision is Decision.TOO_FAR and len(e.ground) > MOST * max(e.voxels, 1) and not e.parts:
        return Reason.GROUND
    return Reason.NO_POINTS if obstacles == 0 and e.raw < FEW else _REFUSED[best.decision]


def _lost(e: Evidence, main: Part | None) -> Reason:
    """Of what has points but no usable cluster: what took most of them."""
    if main is not None:
        return Reason.TOO_SMALL if main.state == ClusterState.TOO_SMALL else Reason.TOO_LARGE
    return Reason.NOISE if e.noise > len(e.ground) else Reason.GROUND


def _weak(best: Candidate) -> Reason:
    if best.state == DetectionState.BELOW_THRESHOLD:
        return Reason.BELOW_THRESHOLD
    return Reason.SUPPRESSED


def _in_view(subject: Subject, result: FrameResult) -> bool:
    if subject.box is None:
        return True
    return any(projected(subject.box, c.camera) is not None for c in result.cameras)


def name_of(result: FrameResult, cluster: int) -> str:
    """Class of the object that a cluster became, empty for none."""
    if result.objects is None:
        return ""
    rows = np.flatnonzero(result.objects.cluster == cluster)
    return result.objects.names[rows[0]] if len(rows) else ""


def box_of(result: FrameResult, cluster: int) -> tuple[str, int, list[int]]:
    """Camera and row of the detection that named a cluster, and the other clusters that it named."""
    for found in result.cameras:
        fusion = found.fusion
        if fusion is None or fusion.cluster_decision[cluster] != Decision.MATCHED:
            continue
        d = int(fusion.cluster_detection[cluster])
        named = (fusion.cluster_decision == Decision.MATCHED) & (fusion.cluster_detection == d)
        return found.camera.name, d, [k for k in np.flatnonzero(named).tolist() if k != cluster]
    return "", -1, []


def _represents(subject: Subject, e: Evidence, result: FrameResult) -> bool:
    """Of those in one cluster, whether this is the one whose detection named it."""
    best = e.candidates[0] if e.candidates else None
    return best is not None and best.decision is Decision.MATCHED and subject.accepts(best.name)


# --- words -------------------------------------------------------------------------------------


def label(candidate: Candidate) -> str:
    return f"{candidate.name} {candidate.score:.2f}"


def _because(subject: Subject, reason: Reason, e: Evidence, result: FrameResult, config: Config) -> str:
    best = e.candidates[0] if e.candidates else None
    main = e.parts[0].cluster if e.parts else -1
    if subject.kind == "detection" and best is not None and best.cluster >= 0:
        main = best.cluster
    if reason in (Reason.REPORTED, Reason.SHARED_BOX, Reason.BORROWED):
        with_ = f"cluster {main} is named {name_of(result, main)}"
        others = " and ".join(f"cluster {k}" for k in box_of(result, main)[2])
        if reason is Reason.SHARED_BOX:
            return f"its box also names {others} ({_method(config)})"
        if reason is Reason.BORROWED:
            also = f"that also names {others}" if others else "that is not on it"
            return f"{with_} by a box {also} ({_method(config)})"
        return f"{with_} by {label(best)}{_split_off(result, main)}" if best is not None else with_
    if reason is Reason.FAILED:
        return "; ".join(f"{f.stage} failed: {f.reason}" for f in result.failures) or "there are no clusters"
    if reason is Reason.OUT_OF_VIEW:
        return "no camera has it in view, and only a camera names objects"
    if reason is Reason.HIDDEN:
        return f"it is hidden: {_count(e.raw, 'point')} on it, and {_in_front(e, result)}"
    if reason is Reason.NO_POINTS:
        return f"the LiDAR has {_count(e.raw, 'point')} there"
    if reason is Reason.GROUND:
        return (
            f"it was taken for ground: {len(e.ground)} of its {e.voxels} voxels, up to "
            f"{_height(e):.2f} m high (ground.distance_threshold is {config.ground.distance_threshold:g} m)"
        )
    if reason is Reason.NOISE:
        return (
            f"its {_count(e.noise, 'obstacle point')} are noise: none has more than {e.neighbours} neighbours"
            f" within {config.clustering.eps:g} m (clustering.min_points is {config.clustering.min_points})"
        )
    if reason is Reason.TOO_SMALL:
        limit = config.clustering.min_cluster_points
        return f"its cluster {main} has {e.parts[0].count} points (clustering.min_cluster_points is {limit})"
    if reason is Reason.TOO_LARGE:
        limit = config.clustering.max_cluster_points or 0
        return f"its cluster {main} has {e.parts[0].count} points (clustering.max_cluster_points is {limit})"
    if reason is Reason.MERGED:
        names = " and ".join(name for name, _ in e.others)
        return (
            f"cluster {main} holds {names}, too: the gap between them is {e.gap:.2f} m and "
            f"clustering.eps is {config.clustering.eps:g} m"
        )
    if reason is Reason.SPLIT:
        kept = " and ".join(str(p.cluster) for p in e.parts if p.state == ClusterState.KEPT)
        return f"it is split into clusters {kept}, {e.apart:.2f} m apart"
    return _because_detected(reason, e, result, config, best, main)


def _because_detected(
    reason: Reason, e: Evidence, result: FrameResult, config: Config, best: Candidate | None, main: int
) -> str:
    """Reasons that lie with the detections and the fusion."""
    if reason is Reason.MISNAMED:
        return f"cluster {main} is named {name_of(result, main)}"
    if reason is Reason.NOT_DETECTED or best is None:
        least = config.detector.explain_threshold
        if not config.detector.model:
            return "there is no detector (detector.model is not set)"
        other = f"; the camera has {label(best)} there" if best is not None else ""
        return f"the detector has no candidate of its class there, not even with a score of {least:g}{other}"
    if reason is Reason.BELOW_THRESHOLD:
        limit = config.detector.conf_threshold
        score = f"{best.name} {best.score:.3g}"
        return f"its detection is too weak: {score}, detector.conf_threshold is {limit:g}"
    fusion = config.fusion
    pair = _pair(result, best)
    if reason is Reason.SUPPRESSED:
        return f"its detection {label(best)} was suppressed by a better one"
    if reason is Reason.NOT_FUSED:
        return f"{best.camera} could not be compared with clusters"
    if reason is Reason.LOW_OVERLAP:
        both = f"{label(best)} and cluster {best.cluster}"
        return f"{both} overlap with {pair}, fusion.min_iou is {fusion.min_iou:g}"
    if reason is Reason.MISFIT:
        suits = f"nothing of cluster {best.cluster} suits {label(best)} in outline and size"
        return f"{suits}, fusion.min_rating is {fusion.min_rating:g}"
    if reason is Reason.TOO_FEW_POINTS:
        return f"{label(best)} has {pair} of cluster {best.cluster}, fusion.min_points is {fusion.min_points}"
    if reason is Reason.TOO_FAR:
        limit_ = (
            f"fusion.match_radius is {fusion.match_radius:g} px"
            if fusion.method == "centroid"
            else f"fusion.max_depth is {fusion.max_depth:g} m"
        )
        return f"cluster {best.cluster} is too far from {label(best)} ({pair}), {limit_}"
    if reason is Reason.TAKEN:
        return f"cluster {best.cluster}, the best for {label(best)}, was taken by {_taker(result, best)}"
    return (
        f"{label(best)} went to cluster {best.cluster}, not to its own, cluster {main}"
        if best.cluster >= 0
        else f"{label(best)} found no cluster"
    )


def _split_off(result: FrameResult, cluster: int) -> str:
    """Where a cluster's points were taken from."""
    splits = result.splits
    if splits is None:
        return ""
    texts = []
    for row in np.flatnonzero((splits.cluster == cluster) & (splits.points < splits.of)).tolist():
        off = f"cluster {splits.rest[row]}" if splits.rest[row] >= 0 else "a cluster"
        texts.append(f", which split it off {off} ({splits.points[row]:,} of {splits.of[row]:,} points)")
    return "".join(texts)


def _pair(result: FrameResult, best: Candidate) -> str:
    """The number that the fusion's rule looked at."""
    fusion = next(c for c in result.cameras if c.camera.name == best.camera).fusion
    pair = None if fusion is None else fusion.pair(best.row, best.cluster)
    if pair is None:
        return ""
    if best.decision is Decision.LOW_OVERLAP:
        return f"IoU {pair.iou:.2f}"
    if best.decision is Decision.TOO_FEW_POINTS:
        return _count(pair.points, "point")
    return f"{pair.distance:.0f} px, {pair.depth:.1f} m"


def _taker(result: FrameResult, best: Candidate) -> str:
    found = next(c for c in result.cameras if c.camera.name == best.camera)
    if found.fusion is None or found.detections is None:
        return "another detection"
    d = int(found.fusion.cluster_detection[best.cluster])
    return f"{found.detections.names[d]} {found.detections.score[d]:.2f}"


def _in_front(e: Evidence, result: FrameResult) -> str:
    what = ""
    if e.front >= 0:
        name = name_of(result, e.front)
        what = f", most of them on cluster {e.front}" + (f" ({name})" if name else "")
    return f"{e.in_front} of the {e.aimed} returns in its direction end in front of it{what}"


def _height(e: Evidence) -> float:
    known = e.ground[np.isfinite(e.ground)]
    return float(known.max(initial=0))


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number or 'no'} {what}s"


def _method(config: Config) -> str:
    return f"fusion.method is {config.fusion.method}: each cluster takes the nearest box"
