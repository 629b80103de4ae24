"""The reason why a subject was reported or lost, with the values that decided."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bevviz.evaluate import MAX_DISTANCE
from bevviz.model.decisions import pair_kind
from bevviz.model.reasons import Reason, ReasonKind, facts_of, kind_of
from bevviz.model.results import Decision, DetectionState, FrameResult, Fusion, Opinion
from bevviz.why.evidence import MOST, Candidate, Evidence, ReportedObject
from bevviz.why.false_objects import false_reasons
from bevviz.why.frame_index import FEW, PART, FrameIndex
from bevviz.why.ideal import StageSet
from bevviz.why.reason_text import cameras_of, detector_ran, reason_of
from bevviz.why.subject import Subject
from bevviz.why.subject_matches import find_fused, first_name

LikelyReasons = tuple[()] | tuple[ReasonKind, ReasonKind]

ROAD = 0.1  # metres above the local ground up to which a voxel in an image box may be the road itself
NEARLY = 0.6  # share of the main loss from which a second one may matter as well
WHOLE = 0.7  # least share of an object's clustered points in its named cluster; with less, it is split

FALSE = {  # causes of false objects
    ReasonKind.DUPLICATE,
    ReasonKind.SPLIT,
    ReasonKind.MISNAMED,
    ReasonKind.MISPLACED,
    ReasonKind.WRONG_DEPTH,
    ReasonKind.WALL,
    ReasonKind.DETECTOR_ERROR,
}
FLAWED = {ReasonKind.SHARED_BOX, ReasonKind.MERGED, ReasonKind.SPLIT}
HOPELESS = {ReasonKind.OUT_OF_VIEW, ReasonKind.HIDDEN, ReasonKind.NO_POINTS}


@dataclass(frozen=True, slots=True)
class Verdict:
    """Reason and sentence about a subject.

    Attributes:
        reason: the stage or rule that decided, with its values.
        reported: whether it became an object of a right class, even if the object has other faults.
        cause: the sentence about the reason.
        restored_by: smallest sets of stages whose ideal results bring a missed object back; empty: none does,
            or no ground truth tells what is ideal.
        advice: clause with the best change, or with what was tried in vain; empty: nothing was searched.
    """

    reason: Reason
    reported: bool
    cause: str
    restored_by: tuple[StageSet, ...] = ()
    advice: str = ""

    @property
    def text(self) -> str:
        """The cause and the advice in one sentence."""
        return f"{self.cause.removesuffix('.')}; {self.advice}." if self.advice else self.cause

    @property
    def kind(self) -> ReasonKind:
        """The kind of the reason."""
        return self.reason.kind


def find_reason(
    subject: Subject, evidence: Evidence, traces: FrameIndex, restored_by: Sequence[StageSet] = ()
) -> tuple[Reason, bool]:
    """Find the stage that lost the subject, or the fault of its reported object.

    It is the first stage that lost it. If ideal results are known, it is a stage whose ideal result brings
    the object back: the first that lost it if it does, else the first one that does.

    Returns:
        reason: that stage or fault, with its values.
        reported: whether it still is an object of a right class.
    """
    if subject.kind == "object" and (false := false_reasons(traces).get(subject.row)) is not None:
        return false, True
    decider = _Decider(subject, evidence, traces)
    kind, reported = decider.decide()
    stages = [stage for stages in restored_by for stage in stages]
    if stages and not reported and stage_of(kind, evidence) not in stages:
        kind = next(filter(None, map(decider.kind_at, stages)), kind)
    return reason_of(kind, subject, evidence, traces), reported


def stage_of(kind: ReasonKind, evidence: Evidence) -> str:
    """Return the stage that a reason blames, empty for none."""
    if kind is ReasonKind.MISNAMED and evidence.named is not None:
        return "detector" if evidence.named.own else "fusion"
    if kind is ReasonKind.MERGED and evidence.joined_by is not None:
        return "fusion"
    return facts_of(kind).stage


def ground_lost(subject: Subject, evidence: Evidence) -> int:
    """Return the number of a subject's voxels that were taken for ground.

    The image box of a detection also holds the road before and behind its object. It does not count.
    """
    if subject.kind != "detection":
        return len(evidence.ground)
    return len(evidence.ground) - int((np.abs(evidence.ground) < ROAD).sum())


def likely_reasons(
    subject: Subject, evidence: Evidence, traces: FrameIndex, kind: ReasonKind
) -> LikelyReasons:
    """Return two reasons that each lost much of a subject, the reason of the verdict first; else nothing.

    Ground truth tells which one mattered, so there are none with it.
    """
    lost = {ReasonKind.GROUND: ground_lost(subject, evidence), ReasonKind.NOISE: evidence.noise}
    if (aside := evidence.aside) is not None:
        lost[kind_of(aside.state)] = evidence.aside_points
    if traces.labels_in_evaluate is not None or subject.is_place or kind not in lost or evidence.main >= 0:
        return ()
    second = max((other for other in lost if other is not kind), key=lambda other: lost[other])
    return () if lost[second] < NEARLY * lost[kind] else (kind, second)


class _Decider:
    """The order in which the stages are blamed.

    Args:
        subject: the object or place in question.
        evidence: the evidence about it.
        traces: the index of the frame.
    """

    def __init__(self, subject: Subject, evidence: Evidence, traces: FrameIndex) -> None:
        self.subject, self.evidence, self.traces = subject, evidence, traces
        self.result: FrameResult = traces.result
        self.ground = ground_lost(subject, evidence)

    def decide(self) -> tuple[ReasonKind, bool]:
        """Return the kind of the reason, and whether the subject is an object of a right class."""
        subject, evidence, named = self.subject, self.evidence, self.evidence.named
        if not self.result.frame.lidar:
            return self._by_cameras()
        ours = self.traces.origin("objects").ours
        accepts = subject.accepts if ours else subject.accepts_of_others
        if named is not None and named.right and (accepts(named.name) or subject.kind == "truth"):
            return self._flaw(named), True
        if named is not None and accepts(named.name) and subject.kind == "truth":
            return self._misplaced(named), False
        kept = [candidate for candidate in evidence.own_candidates if candidate.kept]
        if named is not None and (
            not any(subject.accepts(candidate.name) for candidate in kept) or self._is_in_reported_box(named)
        ):
            return ReasonKind.MISNAMED, False
        if self.result.objects is None:
            return ReasonKind.FAILED, False
        return self._loss() if ours else self._loss_of_other_stages(), False

    def _by_cameras(self) -> tuple[ReasonKind, bool]:
        """Return the reason with cameras alone, where a kept detection is reported."""
        if not detector_ran(self.result, self.subject.camera):
            return ReasonKind.NOT_RUN, False
        loss = self._detector_loss()
        return loss or ReasonKind.REPORTED, loss is None

    def _flaw(self, named: ReportedObject) -> ReasonKind:
        """Return the fault of a reported object, REPORTED without a fault."""
        opinions, subject, evidence = self.result.opinions, self.subject, self.evidence
        if opinions is not None and subject.kind == "object":
            denied = opinions.opinion[named.row] == Opinion.CONTRADICTED
            return ReasonKind.CONTRADICTED if denied else ReasonKind.REPORTED
        if named.detection < 0 or subject.kind == "object":
            return ReasonKind.SHARED_BOX if named.also else ReasonKind.REPORTED
        if evidence.mates or (subject.kind == "truth" and evidence.purity < MOST):
            return ReasonKind.MERGED
        if not named.own and (subject.kind == "truth" or self.result.config.fusion.method == "centroid"):
            return ReasonKind.BORROWED
        if named.also:
            return ReasonKind.SHARED_BOX
        whole = sum(part.points for part in evidence.parts)
        part = evidence.part(named.cluster)
        several = subject.kind == "truth" and len([part for part in evidence.parts if part.kept]) > 1
        is_split = several and part is not None and part.points < WHOLE * whole
        return ReasonKind.SPLIT if is_split else ReasonKind.REPORTED

    def _misplaced(self, named: ReportedObject) -> ReasonKind:
        """Return why ``evaluate`` does not count the object: it is too far off, or has another name."""
        if named.counts_for >= 0:
            is_merged = self.evidence.mates or self.evidence.purity < MOST
            return ReasonKind.MERGED if is_merged else ReasonKind.BORROWED
        if named.away <= MAX_DISTANCE:
            return ReasonKind.MISNAMED
        flaw = self._flaw(named)
        return flaw if flaw in (ReasonKind.MERGED, ReasonKind.SPLIT) else ReasonKind.MISPLACED

    def kind_at(self, stage: str) -> ReasonKind | None:
        """Return how a stage lost the subject; None: it shows no loss there."""
        evidence = self.evidence
        if stage == "ground":
            return ReasonKind.GROUND if self.ground else None
        if stage == "clustering":
            return self._clustering_loss()
        best = evidence.best
        if stage == "detector":
            named = evidence.named
            if named is not None and named.own and not self.subject.accepts(named.name):
                return ReasonKind.MISNAMED
            return self._detector_loss()
        if best is None or not best.kept:
            return None
        if (fusion := self.result.fusion(best.camera)) is None:
            return ReasonKind.NOT_FUSED
        if evidence.main < 0:
            if best.decision is Decision.NO_CLUSTER:
                return ReasonKind.TOO_FEW_POINTS
            return None if best.decision is Decision.MATCHED else kind_of(best.decision)
        kind = pair_kind(fusion, self.result.config, best.row, evidence.main)
        return None if kind is ReasonKind.MATCHED else kind

    def _clustering_loss(self) -> ReasonKind | None:
        """Return how the clustering lost the subject; None: it has a cluster of its own."""
        evidence = self.evidence
        if evidence.main < 0:
            if evidence.aside is None and not evidence.noise:
                return None
            if evidence.aside is None or evidence.aside_points < evidence.noise:
                return self._noise()
            return kind_of(evidence.aside.state)
        part = evidence.part(evidence.main)
        if evidence.mates or evidence.purity < MOST:
            return ReasonKind.MERGED
        inside = 0 if part is None else part.points
        rest = evidence.obstacles - inside - evidence.noise
        if evidence.noise > max(rest, 0):
            return self._noise()
        return ReasonKind.SPLIT if rest > 0 else None

    # --- our stages ----------------------------------------------------------------------------

    def _loss(self) -> ReasonKind:
        """Return the reason why our fusion reported no object."""
        subject, evidence = self.subject, self.evidence
        if subject.kind == "detection":
            return self._loss_of_detection()
        if not subject.is_place and not evidence.in_view:
            return ReasonKind.OUT_OF_VIEW
        if evidence.raw < FEW:
            return self._without_points()
        if evidence.main < 0:
            return self._unclustered()
        if not detector_ran(self.result, subject.camera):
            return ReasonKind.NOT_RUN
        if all(camera.fusion is None for camera in cameras_of(self.result, subject.camera)):
            return ReasonKind.NOT_FUSED
        if not evidence.in_view:
            return ReasonKind.OUT_OF_VIEW
        if (loss := self._detector_loss()) is not None:
            return loss
        assert evidence.best is not None
        return self._refusal(evidence.best)

    def _without_points(self) -> ReasonKind:
        """Return the reason for a subject without points."""
        hidden = self.evidence.in_front > MOST * self.evidence.aimed
        return ReasonKind.HIDDEN if hidden else ReasonKind.NO_POINTS

    def _unclustered(self) -> ReasonKind:
        """Return the stage that took most points of a subject without a kept cluster."""
        evidence = self.evidence
        aside = evidence.aside
        if aside is not None and evidence.aside_points >= max(evidence.noise, self.ground):
            return kind_of(aside.state)
        ground = self.ground or (len(evidence.ground) if not evidence.noise else 0)
        return ReasonKind.GROUND if ground and ground >= evidence.noise else self._noise()

    def _noise(self) -> ReasonKind:
        """Return the reason for points in no cluster. Only for our clustering the cause is known."""
        return ReasonKind.NOISE if self.traces.origin("clustering").ours else ReasonKind.NO_CLUSTER

    def _detector_loss(self) -> ReasonKind | None:
        """Return how the detector lost the subject; None: it kept a detection of a right class."""
        best = self.evidence.best
        if best is None or not self.subject.accepts(best.name):
            return ReasonKind.NOT_DETECTED
        return None if best.kept else self._weakness(best)

    def _weakness(self, best: Candidate) -> ReasonKind:
        """Return the reason for a detection that was not kept.

        If a suppressed detection is below the threshold anyway, the threshold is the reason.
        """
        least = self.result.config.detector.conf_threshold
        strong = best.state == DetectionState.SUPPRESSED and best.score >= least
        return ReasonKind.SUPPRESSED if strong else ReasonKind.BELOW_THRESHOLD

    def _refusal(self, best: Candidate) -> ReasonKind:
        """Return the reason why a cluster and a detection were not matched."""
        evidence = self.evidence
        if (fusion := self.result.fusion(best.camera)) is None:
            return ReasonKind.NOT_FUSED
        kind = pair_kind(fusion, self.result.config, best.row, evidence.main)
        if kind is ReasonKind.MATCHED:  # the object counts for another one in the cluster
            return ReasonKind.MERGED if self.subject.kind == "truth" else ReasonKind.REPORTED
        main = evidence.part(evidence.main)
        if self.subject.kind != "truth" or main is None:
            return kind
        if evidence.purity < MOST or self._is_named_by_mate(fusion, best.camera):
            return ReasonKind.MERGED
        if kind in (ReasonKind.LOW_OVERLAP, ReasonKind.TOO_FEW_POINTS):
            return self._fragment(main.points) or kind
        return kind

    def _is_named_by_mate(self, fusion: Fusion, camera: str) -> bool:
        """Return whether another object in the subject's cluster named the cluster."""
        evidence = self.evidence
        if fusion.cluster_decision[evidence.main] != Decision.MATCHED:
            return False
        owner = self.traces.owner_of(camera, int(fusion.cluster_detection[evidence.main]))
        return any(mate.row == owner for mate, _ in evidence.mates)

    def _fragment(self, inside: int) -> ReasonKind | None:
        """Return the stage that took most of an object, None if its cluster holds at least half of it."""
        evidence = self.evidence
        if inside >= MOST * evidence.voxels:
            return None
        rest = evidence.obstacles - inside - evidence.noise
        lost = (
            (self.ground, ReasonKind.GROUND),
            (evidence.noise, self._noise()),
            (rest, ReasonKind.SPLIT),
        )
        return max(lost)[1]

    def _loss_of_detection(self) -> ReasonKind:
        """Return the reason why a detection gave no object."""
        evidence, best = self.evidence, self.evidence.best
        if best is None:
            return ReasonKind.NOT_DETECTED
        if best.kept and first_name(self.subject, evidence, self.traces) is not None:
            return ReasonKind.SECOND_NAME
        most_points = max((part.points for part in evidence.parts if part.kept), default=0)
        lost = evidence.voxels >= FEW and most_points < max(FEW, PART * evidence.obstacles)
        if not best.kept:  # The fusion may give noise to a detection, but never ground.
            is_ground = lost and self.ground >= max(evidence.noise, evidence.aside_points, FEW)
            return ReasonKind.GROUND if is_ground else self._weakness(best)
        if self.result.fusion(best.camera) is None:
            return ReasonKind.NOT_FUSED
        if best.decision is Decision.NO_CLUSTER or best.cluster < 0:
            return ReasonKind.NO_POINTS if evidence.raw < FEW else self._unclustered()
        if best.decision is Decision.MATCHED:  # a detection of another camera named the object
            return ReasonKind.TAKEN
        if lost:
            return self._unclustered()
        is_merged = best.decision is Decision.TAKEN and evidence.mates
        return ReasonKind.MERGED if is_merged else kind_of(best.decision)

    # --- objects that our fusion did not make --------------------------------------------------

    def _loss_of_other_stages(self) -> ReasonKind:
        """Return the reason why a 3D detector or the robot has no object, as far as its stages are known."""
        subject, evidence = self.subject, self.evidence
        if subject.kind != "detection" and evidence.raw < FEW:
            return self._without_points()
        sections = "ground", "clustering", "detector", "objects"
        robot = {section for section in sections if self.traces.origin(section).topic}
        if "objects" not in robot:
            return ReasonKind.NOT_AMONG
        cluster = self._has_cluster()
        if "clustering" in robot and self.result.clusters is not None and not cluster:
            removed = "ground" in robot and self.ground >= evidence.noise
            return ReasonKind.GROUND if removed else ReasonKind.NO_CLUSTER
        kept = [candidate for candidate in evidence.own_candidates if candidate.kept]
        detected = any(subject.accepts(candidate.name) for candidate in kept)
        if "detector" in robot and detector_ran(self.result, subject.camera) and not detected:
            visible = subject.is_place or evidence.in_view
            return ReasonKind.NOT_DETECTED if visible else ReasonKind.OUT_OF_VIEW
        known = {"clustering", "detector"} <= robot and cluster and detected
        return ReasonKind.LOST_IN_FUSION if known else ReasonKind.NOT_AMONG

    def _has_cluster(self) -> bool:
        """Return whether the subject has a cluster; for a detection, one that our fusion accepts."""
        best = self.evidence.best
        if self.subject.kind != "detection":
            return self.evidence.main >= 0
        return best is not None and best.kept and best.decision in (Decision.MATCHED, Decision.TAKEN)

    def _is_in_reported_box(self, named: ReportedObject) -> bool:
        """Return whether the object of our fusion is inside the reported box."""
        row, opinions = find_fused(self.subject, self.evidence, self.traces), self.result.opinions
        return row >= 0 and opinions is not None and int(opinions.partner[row]) == named.row
