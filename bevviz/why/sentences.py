"""The sentence of a verdict, with the number that decided and the stage that it belongs to."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bevviz.config import Config
from bevviz.model.decisions import mask_evidence
from bevviz.model.results import ClusterState, Decision, FrameResult
from bevviz.why.evidence import Candidate, Evidence, camera_and_fusion
from bevviz.why.frame_index import Fate, FrameIndex
from bevviz.why.outcome import find_fused, in_box_of, opinion_on
from bevviz.why.stage_owner import StageOwner
from bevviz.why.subject import Subject, count
from bevviz.why.verdict import Reason, Verdict, cameras_of, name_of, pair_reason

_ONLY = ("nothing", "only ground", "mostly ground")  # at a place without an object


def verdict_of(
    subject: Subject, reason: Reason, reported: bool, evidence: Evidence, traces: FrameIndex
) -> Verdict:
    """Return the verdict with its reason in one sentence."""
    because = ReasonText(subject, evidence, traces).of(reason)
    head = subject.name[0].upper() + subject.name[1:]
    if reason is Reason.REPORTED:
        return Verdict(reason, reported, f"{head} was reported: {because}.")
    if because.startswith(_ONLY):
        content, _, rest = because.partition(": ")
        return Verdict(
            reason, reported, f"There is {content} {subject.name.removeprefix('what is ')}: {rest}."
        )
    joint = "was reported, but" if reported else "was not reported because"
    return Verdict(reason, reported, f"{head} {joint} {because}.")


def label(candidate: Candidate) -> str:
    """Return the class and score of a detection."""
    return f"{candidate.name} {candidate.score:.2f}"


class ReasonText:
    """Words that follow "because" in a verdict.

    Args:
        subject: the object or place in question.
        evidence: the evidence about it.
        traces: the index of the frame.
    """

    def __init__(self, subject: Subject, evidence: Evidence, traces: FrameIndex) -> None:
        self.subject, self.evidence, self.traces = subject, evidence, traces
        self.result: FrameResult = traces.result
        self.config: Config = traces.result.config

    def of(self, reason: Reason) -> str:
        """Return the words for a reason."""
        sentences = {
            Reason.REPORTED: self._reported,
            Reason.SHARED_BOX: self._shared_box,
            Reason.BORROWED: self._borrowed,
            Reason.SPLIT: self._split,
            Reason.MERGED: self._merged,
            Reason.MISNAMED: self._misnamed,
            Reason.FAILED: self._failed,
            Reason.OUT_OF_VIEW: lambda: "no camera has it in view, and only a camera names objects",
            Reason.HIDDEN: self._hidden,
            Reason.NO_POINTS: self._no_points,
            Reason.GROUND: self._ground,
            Reason.NOISE: self._noise,
            Reason.NO_CLUSTER: self._no_cluster,
            Reason.TOO_SMALL: lambda: self._size("min_cluster_points"),
            Reason.TOO_LARGE: lambda: self._size("max_cluster_points"),
            Reason.NOT_RUN: self._not_run,
            Reason.NOT_DETECTED: self._not_detected,
            Reason.BELOW_THRESHOLD: self._below_threshold,
            Reason.SUPPRESSED: self._suppressed,
            Reason.NOT_FUSED: self._not_fused,
            Reason.LOW_OVERLAP: self._low_overlap,
            Reason.TOO_FEW_POINTS: self._too_few_points,
            Reason.TOO_FAR: self._too_far,
            Reason.TAKEN: self._taken,
            Reason.MISFIT: self._misfit,
            Reason.OTHER_CLUSTER: self._other_cluster,
            Reason.CONTRADICTED: self._contradicted,
            Reason.NOT_AMONG: self._not_among,
            Reason.LOST_IN_FUSION: self._lost_in_fusion,
        }
        return sentences[reason]()

    def _origin(self, section: str) -> StageOwner:
        """Return the owner of the stage of a section."""
        return self.traces.origin(section)

    def _parameter_or_owner(self, section: str, ours: str) -> str:
        """Return our parameter in brackets, or the name of the stage that is not ours."""
        owner = self._origin(section)
        return f"({ours})" if owner.ours else f"(by {owner.name})"

    @property
    def _best(self) -> Candidate:
        """The best detection of the subject, which must exist."""
        assert self.evidence.best is not None
        return self.evidence.best

    # --- reported ------------------------------------------------------------------------------

    def _object_text(self) -> str:
        """Name the object of the subject and its cluster."""
        named = self.evidence.named
        assert named is not None
        objects = self._origin("objects")
        if not objects.ours:
            score = "" if self.result.objects is None else f" {self.result.objects.score[named.row]:.2f}"
            return f"{objects.name} has {named.name}{score} there"
        return f"cluster {named.cluster} is named {named.name}"

    def _reported(self) -> str:
        if not self.result.frame.lidar:
            least = f"detector.conf_threshold is {self.config.detector.conf_threshold:g}"
            whose = self._parameter_or_owner("detector", least)
            return f"{label(self._best)} was kept {whose}; without a LiDAR nothing tells where it is"
        named, text = self.evidence.named, self._object_text()
        assert named is not None
        if opinion := opinion_on(self.result, named.row):
            return f"{text}, {opinion}"
        if not named.camera or self.result.objects is None:
            return text
        score = self.result.objects.score[named.row]
        return f"{text} by {named.name} {score:.2f}{self._split_off(named.cluster)}"

    def _split_off(self, cluster: int) -> str:
        """Name the cluster that the points of a cluster were split from."""
        splits, texts = self.result.splits, []
        if splits is None:
            return ""
        for row in np.flatnonzero((splits.cluster == cluster) & (splits.points < splits.of)).tolist():
            off = f"cluster {splits.rest[row]}" if splits.rest[row] >= 0 else "a cluster"
            texts.append(f", which split it off {off} ({splits.points[row]:,} of {splits.of[row]:,} points)")
        return "".join(texts)

    def _other_clusters_text(self) -> str:
        """Name the other clusters of the same detection."""
        assert self.evidence.named is not None
        return " and ".join(f"cluster {cluster}" for cluster in self.evidence.named.also)

    def _method_text(self) -> str:
        """Name the fusion method."""
        return f"fusion.method is {self.config.fusion.method}: each cluster takes the nearest box"

    def _shared_box(self) -> str:
        return f"its box also names {self._other_clusters_text()} ({self._method_text()})"

    def _borrowed(self) -> str:
        named = self.evidence.named
        assert named is not None
        score = "" if self.result.objects is None else f" {self.result.objects.score[named.row]:.2f}"
        if self.config.fusion.method == "centroid":
            also = f"that also names {self._other_clusters_text()}" if named.also else "that is not on it"
            return f"{self._object_text()} by a box {also} ({self._method_text()})"
        box_owner = self._box_owner_text(named.camera, named.detection)
        return f"{self._object_text()} by {named.name}{score}, {box_owner}"

    def _box_owner_text(self, camera: str, detection: int) -> str:
        """Name the object of the ground truth that a detection belongs to."""
        camera_result = self.traces.camera(camera)
        owner = -1 if camera_result is None else int(self.traces.owners(camera_result)[detection])
        if owner < 0 or owner == self.subject.row:
            return "a box that fits it badly"
        return f"which is the box of {self.traces.truth[owner].name}"

    def _split(self) -> str:
        kept = [part for part in self.evidence.parts if part.kept]
        parts = " and ".join(str(part.cluster) for part in kept[:4]) + (" and more" if kept[4:] else "")
        by = "" if self._origin("clustering").ours else f" by {self._origin('clustering').name}"
        apart = f", {self.evidence.apart:.2f} m apart" if np.isfinite(self.evidence.apart) else ""
        return f"it is split{by} into clusters {parts}{apart}"

    def _merged(self) -> str:
        evidence, clustering = self.evidence, self._origin("clustering")
        part = evidence.part(evidence.main)
        rest = 0 if part is None else part.count - part.points
        names = (
            " and ".join(name for name, _ in evidence.others)
            or f"{count(rest, 'point')} that are not its own"
        )
        text = f"cluster {evidence.main} holds {names}, too"
        if not np.isfinite(evidence.gap):
            return text
        limit = f"clustering.eps is {self.config.clustering.eps:g} m"
        return f"{text}: the gap between them is {evidence.gap:.2f} m and " + (
            limit if clustering.ours else f"{clustering.name} made one of them"
        )

    def _misnamed(self) -> str:
        named = self.evidence.named
        assert named is not None
        text = self._object_text()
        if opinion := opinion_on(self.result, named.row):
            text += f", {opinion}"
        if named.camera and not named.own:
            text += (
                f" by a detection that is not its own, {self._box_owner_text(named.camera, named.detection)}"
            )
        return text

    # --- LiDAR ---------------------------------------------------------------------------------

    def _failed(self) -> str:
        failures = "; ".join(f"{failure.stage} failed: {failure.reason}" for failure in self.result.failures)
        return failures or "there are no clusters"

    def _hidden(self) -> str:
        points = count(self.evidence.raw, "point")
        return f"it is hidden: {points} on it, and {in_front(self.evidence, self.result)}"

    def _no_points(self) -> str:
        evidence, subject = self.evidence, self.subject
        if subject.kind not in ("point", "cell") or subject.box is None:
            return f"the LiDAR has {count(evidence.raw, 'point')} there"
        axes = slice(2 if subject.kind == "cell" else 3)
        center, radius = subject.box.center[0, axes], subject.box.size[0, 0] / 2
        text = f"{_ONLY[0]}: the LiDAR has {count(evidence.raw, 'point')} within {radius:g} m"
        points = self.result.frame.points
        if evidence.raw or not len(points):
            return text
        away = float(np.linalg.norm(points[:, axes] - center, axis=1).min())
        return f"{text}, the nearest is {away:.1f} m away"

    def _ground(self) -> str:
        evidence, ground = self.evidence, self._origin("ground")
        if self.subject.is_place:
            number = int((self.traces.fate[evidence.points] == Fate.GROUND).sum())
            whole = "all ground" if number == evidence.raw else f"{number} of them ground"
            known = evidence.ground[np.isfinite(evidence.ground)]
            height = f", {known.min():z.2f} to {known.max():z.2f} m above its level" if len(known) else ""
            only = _ONLY[1] if number == evidence.raw else _ONLY[2]
            by = "" if ground.ours else f" (by {ground.name})"
            return f"{only}: {count(evidence.raw, 'point')}, {whole}{height}{by}"
        return (
            f"it was taken for ground: {len(evidence.ground)} of its {evidence.voxels} voxels, "
            f"up to {height_of(evidence):.2f} m high "
            + self._parameter_or_owner(
                "ground", f"ground.distance_threshold is {self.config.ground.distance_threshold:g} m"
            )
        )

    def _noise(self) -> str:
        clustering, are = self.config.clustering, "is" if self.evidence.noise == 1 else "are"
        points, neighbours = count(self.evidence.noise, "obstacle point"), self.evidence.neighbours
        return (
            f"its {points} {are} noise: none has more than {neighbours} "
            f"neighbours within {clustering.eps:g} m (clustering.min_points is {clustering.min_points})"
        )

    def _no_cluster(self) -> str:
        evidence, clustering = self.evidence, self._origin("clustering")
        points = count(evidence.obstacles, "obstacle point")
        few = (
            f"{evidence.obstacles - evidence.noise} of its {points} are"
            if evidence.obstacles > evidence.noise
            else f"none of its {points} is"
        )
        if clustering.topic:
            best = evidence.best
            if best is not None and best.cluster >= 0:
                pair = self._pair_text(best.row, best.camera, best.cluster)
                return (
                    f"the robot's clustering lost it: no cluster of {clustering.name} is its own, "
                    f"the best for {label(best)} is cluster {best.cluster} ({pair})"
                )
            return f"the robot's clustering lost it: {few} in a cluster of {clustering.name}"
        return f"{few} in a cluster of {clustering.name}"

    def _size(self, limit: str) -> str:
        aside = next(part for part in self.evidence.parts if not part.kept)
        value = getattr(self.config.clustering, limit)
        return (
            f"its cluster {aside.cluster} has {count(aside.count, 'point')} (clustering.{limit} is {value})"
        )

    # --- detector ------------------------------------------------------------------------------

    def _not_run(self) -> str:
        return "the detector never ran: " + "; ".join(not_run(self.result, self.subject.camera))

    def _not_detected(self) -> str:
        detector, evidence = self._origin("detector"), self.evidence
        best = evidence.best
        wrong = f"; the camera has {label(best)} there" if best is not None else ""
        class_ = "of its class " if self.subject.label else ""
        if detector.topic:
            return f"the robot's detector lost it: {detector.name} has no detection {class_}there{wrong}"
        if detector.function:
            return f"{detector.name} gave no detection {class_}there{wrong}"
        least = self.config.detector.explain_threshold
        return f"the detector has no candidate {class_}there, not even with a score of {least:g}{wrong}"

    def _below_threshold(self) -> str:
        limit, best = self.config.detector.conf_threshold, self._best
        whose = f"{best.name} {best.score:.3g}"
        head = "it is too weak" if self.subject.kind == "detection" else f"its detection is too weak: {whose}"
        return f"{head}, detector.conf_threshold is {limit:g}"

    def _suppressed(self) -> str:
        best = self._best
        head = "it" if self.subject.kind == "detection" else f"its detection {label(best)}"
        return f"{head} was suppressed by {self._suppressor(best)}"

    def _suppressor(self, best: Candidate) -> str:
        camera = self.traces.camera(best.camera)
        detections = None if camera is None else camera.detections
        if camera is None or detections is None or detections.suppressed_by[best.row] < 0:
            return "a better one"
        rival = int(detections.suppressed_by[best.row])
        owner = int(self.traces.owners(camera)[rival])
        whose = f", the box of {self.traces.truth[owner].name}" if owner not in (-1, self.subject.row) else ""
        overlap = f"IoU {detections.overlap[best.row]:.2f}, detector.iou_threshold is"
        limit = f"{self.config.detector.iou_threshold:g}"
        return f"{detections.names[rival]} {detections.score[rival]:.2f}{whose} ({overlap} {limit})"

    # --- fusion --------------------------------------------------------------------------------

    def _not_fused(self) -> str:
        only = self.subject.camera or (self.evidence.best.camera if self.evidence.best is not None else "")
        cameras = [result.camera for result in cameras_of(self.result, only)]
        names = " and ".join(camera.name for camera in cameras)
        problems = "; ".join(problem for camera in cameras for problem in camera.problems)
        return f"{names} could not be compared with clusters" + (f": {problems}" if problems else "")

    @property
    def _cluster(self) -> int:
        """Cluster that the detection should have named."""
        return self._best.cluster if self.subject.kind == "detection" else self.evidence.main

    def _pair_text(self, row: int, camera: str, cluster: int) -> str:
        """Return the numbers that the rule of the fusion compared."""
        _, fusion = camera_and_fusion(self.result, camera)
        if fusion is None:
            return "not compared"
        pair = fusion.pair(row, cluster)
        if pair is None:
            return "no point of it is in its frustum"
        if self.config.fusion.method == "centroid":
            return f"{pair.distance:.0f} px, {pair.depth:.1f} m"
        in_frustum = f"{count(pair.points, 'point')} in its frustum, IoU {pair.iou:.2f}"
        return in_frustum + mask_evidence(fusion, row, self.config)

    def _best_pair_text(self) -> str:
        """Return the numbers of the best detection and its cluster."""
        return self._pair_text(self._best.row, self._best.camera, self._cluster)

    def _misfit(self) -> str:
        suits = f"no part of cluster {self._cluster} suits {label(self._best)} in outline and size"
        return f"{suits}, fusion.min_rating is {self.config.fusion.min_rating:g}"

    def _low_overlap(self) -> str:
        both = f"{label(self._best)} and cluster {self._cluster}"
        numbers, least = self._best_pair_text(), self.config.fusion.min_iou
        return f"{both} overlap too little ({numbers}), fusion.min_iou is {least:g}"

    def _too_few_points(self) -> str:
        if self._cluster < 0:
            return f"{label(self._best)} found no cluster"
        limit = f"fusion.min_points is {self.config.fusion.min_points}"
        numbers = self._best_pair_text()
        return f"{label(self._best)} has too few points of cluster {self._cluster} ({numbers}), {limit}"

    def _too_far(self) -> str:
        fusion = self.config.fusion
        limit = (
            f"fusion.match_radius is {fusion.match_radius:g} px"
            if fusion.method == "centroid"
            else f"fusion.max_depth is {fusion.max_depth:g} m"
        )
        return (
            f"cluster {self._cluster} is too far from {label(self._best)} ({self._best_pair_text()}), {limit}"
        )

    def _taken(self) -> str:
        best, cluster = self._best, self._cluster
        _, fusion = camera_and_fusion(self.result, best.camera)
        text = f"cluster {cluster}, the best for {label(best)}, was taken by "
        if fusion is None or fusion.cluster_detection[cluster] in (-1, best.row):
            return text + "another camera's detection"
        taker = int(fusion.cluster_detection[cluster])
        camera = self.traces.camera(best.camera)
        assert camera is not None and camera.detections is not None
        owner = int(self.traces.owners(camera)[taker])
        whose = f", the box of {self.traces.truth[owner].name}" if owner not in (-1, self.subject.row) else ""
        return f"{text}{camera.detections.names[taker]} {camera.detections.score[taker]:.2f}{whose}"

    def _other_cluster(self) -> str:
        best = self._best
        own_cluster = f"cluster {self.evidence.main} ({self._best_pair_text()})"
        return f"{label(best)} went to cluster {best.cluster}, not to its own, {own_cluster}"

    # --- objects that are not ours -------------------------------------------------------------

    def _contradicted(self) -> str:
        assert self.evidence.named is not None
        return f"it is {opinion_on(self.result, self.evidence.named.row)}"

    def _not_among(self) -> str:
        text = f"it is not among the objects of {self._origin('objects').name}; "
        return text + (self._fused_text() or ", ".join(self._other_stages()))

    def _fused_text(self) -> str:
        """Name the object that our fusion would make of it; empty: none."""
        fused_row = find_fused(self.subject, self.evidence, self.traces)
        opinions, clusters = self.result.opinions, self.result.clusters
        if fused_row < 0 or opinions is None or clusters is None:
            return ""
        fused = opinions.fused
        cluster = int(fused.cluster[fused_row])
        name = f"{fused.names[fused_row]} {fused.score[fused_row]:.2f}"
        points = count(int(clusters.count[cluster]), "point")
        text = (
            f"our fusion has it: cluster {cluster} ({points}), named by {name} of {fused.camera[fused_row]}"
        )
        row, objects = int(opinions.partner[fused_row]), self.result.objects
        return text if row < 0 or objects is None else f"{text}, {in_box_of(objects, row)}"

    def _other_stages(self) -> Iterator[str]:
        """Yield the results of the other stages at the place."""
        evidence, best = self.evidence, self.evidence.best
        if evidence.main >= 0:
            yield f"cluster {evidence.main} is there"
        else:
            yield f"{count(evidence.raw, 'point')} are there and no cluster"
        if not detector_known(self.result):
            return
        yield f"{label(best)} as well" if best is not None and best.kept else "and no detection of it"

    def _lost_in_fusion(self) -> str:
        best, cluster = self._best, self._cluster
        clusters, detector, objects = (
            self._origin(section).name for section in ("clustering", "detector", "objects")
        )
        inputs = f"cluster {cluster} of {clusters} and {label(best)} of {detector} are there"
        ours = self._our_decision(cluster)
        return f"the robot's fusion lost it: {inputs}, but no object of {objects}; ours {ours}"

    def _our_decision(self, cluster: int) -> str:
        """Say how our fusion would decide about a detection and a cluster."""
        best = self._best
        _, fusion = camera_and_fusion(self.result, best.camera)
        pair = self._pair_text(best.row, best.camera, cluster)
        if fusion is None:
            return "could not compare them"
        reason = pair_reason(fusion, self.traces, best.row, cluster)
        return (
            f"matches them ({pair})"
            if reason is Reason.REPORTED
            else f"refuses them, too: {reason.value} ({pair})"
        )


# --- numbers in words --------------------------------------------------------------------------


def detector_known(result: FrameResult) -> bool:
    """Return whether a camera has detections."""
    return any(camera.detections is not None for camera in result.cameras)


def not_run(result: FrameResult, only: str = "") -> Iterator[str]:
    """Yield the reason why the detector did not run on each camera's image."""
    failed = "; ".join(failure.reason for failure in result.failures if failure.stage == "detector")
    cameras = [c for c in result.cameras if c.detections is None and only in ("", c.camera.name)]
    if not result.cameras:
        yield "there is no camera"
    for camera in cameras:
        name = camera.camera.name
        if not result.config.detector.model:
            yield "detector.model is not set"
            return
        if camera.camera.image is None and not failed:
            yield "; ".join(camera.camera.problems) or f"{name} has no image for this scan"
        else:
            yield f"on {name} it failed: {failed or 'no reason was told'}"


def in_front(evidence: Evidence, result: FrameResult) -> str:
    """Count the returns that end before the subject."""
    cluster_text = ""
    if evidence.front >= 0:
        name = name_of(result, evidence.front)
        cluster_text = f", most of them on cluster {evidence.front}" + (f" ({name})" if name else "")
    returns = f"{evidence.in_front} of the {evidence.aimed} returns in its direction"
    return f"{returns} end in front of it{cluster_text}"


def height_of(evidence: Evidence) -> float:
    """Return the height in metres of the highest voxel that was removed as ground."""
    known = evidence.ground[np.isfinite(evidence.ground)]
    return float(known.max(initial=0))


def state_text(state: ClusterState | Decision) -> str:
    """Return a state in lower case words."""
    return state.name.lower().replace("_", " ")
