"""The sentence of a verdict, with the number that decided and the stage that it belongs to."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bevviz.config import Config
from bevviz.model.decisions import in_mask
from bevviz.model.results import ClusterState, Decision, FrameResult
from bevviz.why.evidence import Candidate, Evidence, fusion_of
from bevviz.why.frame_index import Fate, Traces
from bevviz.why.outcome import find_fused, in_box_of, opinion_on
from bevviz.why.stage_owner import StageOrigin
from bevviz.why.subject import Subject, count
from bevviz.why.verdict import Reason, Verdict, cameras_of, name_of, pair_reason

_ONLY = ("nothing", "only ground", "mostly ground")  # at a place without an object


def verdict_of(subject: Subject, reason: Reason, reported: bool, e: Evidence, traces: Traces) -> Verdict:
    """Return the verdict with its reason in one sentence."""
    because = Because(subject, e, traces).of(reason)
    head = subject.name[0].upper() + subject.name[1:]
    if reason is Reason.REPORTED:
        return Verdict(reason, reported, f"{head} was reported: {because}.")
    if because.startswith(_ONLY):
        what, _, rest = because.partition(": ")
        return Verdict(reason, reported, f"There is {what} {subject.name.removeprefix('what is ')}: {rest}.")
    joint = "was reported, but" if reported else "was not reported because"
    return Verdict(reason, reported, f"{head} {joint} {because}.")


def label(candidate: Candidate) -> str:
    """Return the class and score of a detection."""
    return f"{candidate.name} {candidate.score:.2f}"


class Because:
    """Words that follow "because" in a verdict.

    Args:
        subject: the object or place in question.
        e: the evidence about it.
        traces: the index of the frame.
    """

    def __init__(self, subject: Subject, e: Evidence, traces: Traces) -> None:
        self.subject, self.e, self.traces = subject, e, traces
        self.result: FrameResult = traces.result
        self.config: Config = traces.result.config

    def of(self, reason: Reason) -> str:
        """Return the words for a reason."""
        said = {
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
        return said[reason]()

    def _origin(self, section: str) -> StageOrigin:
        """Return the owner of the stage of a section."""
        return self.traces.origin(section)

    def _whose(self, section: str, ours: str) -> str:
        """Return our parameter in brackets, or the name of the stage that is not ours."""
        there = self._origin(section)
        return f"({ours})" if there.ours else f"(by {there.name})"

    @property
    def _best(self) -> Candidate:
        """The best detection of the subject, which must exist."""
        assert self.e.best is not None
        return self.e.best

    # --- reported ------------------------------------------------------------------------------

    def _with(self) -> str:
        """Name the object of the subject and its cluster."""
        named = self.e.named
        assert named is not None
        objects = self._origin("objects")
        if not objects.ours:
            score = "" if self.result.objects is None else f" {self.result.objects.score[named.row]:.2f}"
            return f"{objects.name} has {named.name}{score} there"
        return f"cluster {named.cluster} is named {named.name}"

    def _reported(self) -> str:
        if not self.result.frame.lidar:
            least = f"detector.conf_threshold is {self.config.detector.conf_threshold:g}"
            whose = self._whose("detector", least)
            return f"{label(self._best)} was kept {whose}; without a LiDAR nothing tells where it is"
        named, text = self.e.named, self._with()
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

    def _also(self) -> str:
        """Name the other clusters of the same detection."""
        assert self.e.named is not None
        return " and ".join(f"cluster {k}" for k in self.e.named.also)

    def _method(self) -> str:
        """Name the fusion method."""
        return f"fusion.method is {self.config.fusion.method}: each cluster takes the nearest box"

    def _shared_box(self) -> str:
        return f"its box also names {self._also()} ({self._method()})"

    def _borrowed(self) -> str:
        named = self.e.named
        assert named is not None
        score = "" if self.result.objects is None else f" {self.result.objects.score[named.row]:.2f}"
        if self.config.fusion.method == "centroid":
            also = f"that also names {self._also()}" if named.also else "that is not on it"
            return f"{self._with()} by a box {also} ({self._method()})"
        return f"{self._with()} by {named.name}{score}, {self._whose_box(named.camera, named.detection)}"

    def _whose_box(self, camera: str, detection: int) -> str:
        """Name the object of the ground truth that a detection belongs to."""
        found = self.traces.camera(camera)
        owner = -1 if found is None else int(self.traces.owners(found)[detection])
        if owner < 0 or owner == self.subject.row:
            return "a box that fits it badly"
        return f"which is the box of {self.traces.truth[owner].name}"

    def _split(self) -> str:
        kept = [part for part in self.e.parts if part.kept]
        parts = " and ".join(str(part.cluster) for part in kept[:4]) + (" and more" if kept[4:] else "")
        by = "" if self._origin("clustering").ours else f" by {self._origin('clustering').name}"
        apart = f", {self.e.apart:.2f} m apart" if np.isfinite(self.e.apart) else ""
        return f"it is split{by} into clusters {parts}{apart}"

    def _merged(self) -> str:
        e, clustering = self.e, self._origin("clustering")
        own = e.part(e.main)
        rest = 0 if own is None else own.count - own.points
        names = " and ".join(name for name, _ in e.others) or f"{count(rest, 'point')} that are not its own"
        text = f"cluster {e.main} holds {names}, too"
        if not np.isfinite(e.gap):
            return text
        limit = f"clustering.eps is {self.config.clustering.eps:g} m"
        return f"{text}: the gap between them is {e.gap:.2f} m and " + (
            limit if clustering.ours else f"{clustering.name} made one of them"
        )

    def _misnamed(self) -> str:
        named = self.e.named
        assert named is not None
        text = self._with()
        if opinion := opinion_on(self.result, named.row):
            text += f", {opinion}"
        if named.camera and not named.own:
            text += f" by a detection that is not its own, {self._whose_box(named.camera, named.detection)}"
        return text

    # --- LiDAR ---------------------------------------------------------------------------------

    def _failed(self) -> str:
        said = "; ".join(f"{f.stage} failed: {f.reason}" for f in self.result.failures)
        return said or "there are no clusters"

    def _hidden(self) -> str:
        return f"it is hidden: {count(self.e.raw, 'point')} on it, and {in_front(self.e, self.result)}"

    def _no_points(self) -> str:
        e, subject = self.e, self.subject
        if subject.kind not in ("point", "cell") or subject.box is None:
            return f"the LiDAR has {count(e.raw, 'point')} there"
        axes = slice(2 if subject.kind == "cell" else 3)
        center, radius = subject.box.center[0, axes], subject.box.size[0, 0] / 2
        text = f"{_ONLY[0]}: the LiDAR has {count(e.raw, 'point')} within {radius:g} m"
        points = self.result.frame.points
        if e.raw or not len(points):
            return text
        away = float(np.linalg.norm(points[:, axes] - center, axis=1).min())
        return f"{text}, the nearest is {away:.1f} m away"

    def _ground(self) -> str:
        e, ground = self.e, self._origin("ground")
        if self.subject.is_place:
            number = int((self.traces.fate[e.points] == Fate.GROUND).sum())
            whole = "all ground" if number == e.raw else f"{number} of them ground"
            known = e.ground[np.isfinite(e.ground)]
            height = f", {known.min():z.2f} to {known.max():z.2f} m above its level" if len(known) else ""
            only = _ONLY[1] if number == e.raw else _ONLY[2]
            by = "" if ground.ours else f" (by {ground.name})"
            return f"{only}: {count(e.raw, 'point')}, {whole}{height}{by}"
        return (
            f"it was taken for ground: {len(e.ground)} of its {e.voxels} voxels, "
            f"up to {height_of(e):.2f} m high "
            + self._whose(
                "ground", f"ground.distance_threshold is {self.config.ground.distance_threshold:g} m"
            )
        )

    def _noise(self) -> str:
        c, are = self.config.clustering, "is" if self.e.noise == 1 else "are"
        points, neighbours = count(self.e.noise, "obstacle point"), self.e.neighbours
        return (
            f"its {points} {are} noise: none has more than {neighbours} "
            f"neighbours within {c.eps:g} m (clustering.min_points is {c.min_points})"
        )

    def _no_cluster(self) -> str:
        e, clustering = self.e, self._origin("clustering")
        points = count(e.obstacles, "obstacle point")
        few = (
            f"{e.obstacles - e.noise} of its {points} are"
            if e.obstacles > e.noise
            else f"none of its {points} is"
        )
        if clustering.topic:
            best = e.best
            if best is not None and best.cluster >= 0:
                pair = self._pair_text(best.row, best.camera, best.cluster)
                return (
                    f"the robot's clustering lost it: no cluster of {clustering.name} is its own, "
                    f"the best for {label(best)} is cluster {best.cluster} ({pair})"
                )
            return f"the robot's clustering lost it: {few} in a cluster of {clustering.name}"
        return f"{few} in a cluster of {clustering.name}"

    def _size(self, limit: str) -> str:
        aside = next(part for part in self.e.parts if not part.kept)
        value = getattr(self.config.clustering, limit)
        return (
            f"its cluster {aside.cluster} has {count(aside.count, 'point')} (clustering.{limit} is {value})"
        )

    # --- detector ------------------------------------------------------------------------------

    def _not_run(self) -> str:
        return "the detector never ran: " + "; ".join(not_run(self.result, self.subject.camera))

    def _not_detected(self) -> str:
        detector, e = self._origin("detector"), self.e
        best = e.best
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
        only = self.subject.camera or (self.e.best.camera if self.e.best is not None else "")
        cameras = [found.camera for found in cameras_of(self.result, only)]
        names = " and ".join(camera.name for camera in cameras)
        problems = "; ".join(problem for camera in cameras for problem in camera.problems)
        return f"{names} could not be compared with clusters" + (f": {problems}" if problems else "")

    @property
    def _cluster(self) -> int:
        """Cluster that the detection should have named."""
        return self._best.cluster if self.subject.kind == "detection" else self.e.main

    def _pair_text(self, row: int, camera: str, cluster: int) -> str:
        """Return the numbers that the rule of the fusion compared."""
        _, fusion = fusion_of(self.result, camera)
        if fusion is None:
            return "not compared"
        pair = fusion.pair(row, cluster)
        if pair is None:
            return "no point of it is in its frustum"
        if self.config.fusion.method == "centroid":
            return f"{pair.distance:.0f} px, {pair.depth:.1f} m"
        in_frustum = f"{count(pair.points, 'point')} in its frustum, IoU {pair.iou:.2f}"
        return in_frustum + in_mask(fusion, row, self.config)

    def _pair(self) -> str:
        """Return the numbers of the best detection and its cluster."""
        return self._pair_text(self._best.row, self._best.camera, self._cluster)

    def _misfit(self) -> str:
        suits = f"no part of cluster {self._cluster} suits {label(self._best)} in outline and size"
        return f"{suits}, fusion.min_rating is {self.config.fusion.min_rating:g}"

    def _low_overlap(self) -> str:
        both = f"{label(self._best)} and cluster {self._cluster}"
        return f"{both} overlap too little ({self._pair()}), fusion.min_iou is {self.config.fusion.min_iou:g}"

    def _too_few_points(self) -> str:
        if self._cluster < 0:
            return f"{label(self._best)} found no cluster"
        limit = f"fusion.min_points is {self.config.fusion.min_points}"
        return f"{label(self._best)} has too few points of cluster {self._cluster} ({self._pair()}), {limit}"

    def _too_far(self) -> str:
        fusion = self.config.fusion
        limit = (
            f"fusion.match_radius is {fusion.match_radius:g} px"
            if fusion.method == "centroid"
            else f"fusion.max_depth is {fusion.max_depth:g} m"
        )
        return f"cluster {self._cluster} is too far from {label(self._best)} ({self._pair()}), {limit}"

    def _taken(self) -> str:
        best, cluster = self._best, self._cluster
        _, fusion = fusion_of(self.result, best.camera)
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
        own = f"cluster {self.e.main} ({self._pair()})"
        return f"{label(best)} went to cluster {best.cluster}, not to its own, {own}"

    # --- objects that are not ours -------------------------------------------------------------

    def _contradicted(self) -> str:
        assert self.e.named is not None
        return f"it is {opinion_on(self.result, self.e.named.row)}"

    def _not_among(self) -> str:
        text = f"it is not among the objects of {self._origin('objects').name}; "
        return text + (self._fused() or ", ".join(self._beside()))

    def _fused(self) -> str:
        """Name the object that our fusion would make of it; empty: none."""
        j, opinions, clusters = (
            find_fused(self.subject, self.e, self.traces),
            self.result.opinions,
            self.result.clusters,
        )
        if j < 0 or opinions is None or clusters is None:
            return ""
        fused = opinions.fused
        k, name = int(fused.cluster[j]), f"{fused.names[j]} {fused.score[j]:.2f}"
        points = count(int(clusters.count[k]), "point")
        text = f"our fusion has it: cluster {k} ({points}), named by {name} of {fused.camera[j]}"
        row, objects = int(opinions.partner[j]), self.result.objects
        return text if row < 0 or objects is None else f"{text}, {in_box_of(objects, row)}"

    def _beside(self) -> Iterator[str]:
        """Yield the results of the other stages at the place."""
        e, best = self.e, self.e.best
        if e.main >= 0:
            yield f"cluster {e.main} is there"
        else:
            yield f"{count(e.raw, 'point')} are there and no cluster"
        if not detector_known(self.result):
            return
        yield f"{label(best)} as well" if best is not None and best.kept else "and no detection of it"

    def _lost_in_fusion(self) -> str:
        best, cluster = self._best, self._cluster
        clusters, detector, objects = (
            self._origin(section).name for section in ("clustering", "detector", "objects")
        )
        there = f"cluster {cluster} of {clusters} and {label(best)} of {detector} are there"
        return f"the robot's fusion lost it: {there}, but no object of {objects}; ours {self._ours(cluster)}"

    def _ours(self, cluster: int) -> str:
        """Say how our fusion would decide about a detection and a cluster."""
        best = self._best
        _, fusion = fusion_of(self.result, best.camera)
        pair = self._pair_text(best.row, best.camera, cluster)
        if fusion is None:
            return "could not compare them"
        said = pair_reason(fusion, self.traces, best.row, cluster)
        return (
            f"matches them ({pair})"
            if said is Reason.REPORTED
            else f"refuses them, too: {said.value} ({pair})"
        )


# --- numbers in words --------------------------------------------------------------------------


def detector_known(result: FrameResult) -> bool:
    """Return whether a camera has detections."""
    return any(camera.detections is not None for camera in result.cameras)


def not_run(result: FrameResult, only: str = "") -> Iterator[str]:
    """Yield the reason why the detector did not run on each camera's image."""
    failed = "; ".join(f.reason for f in result.failures if f.stage == "detector")
    cameras = [c for c in result.cameras if c.detections is None and only in ("", c.camera.name)]
    if not result.cameras:
        yield "there is no camera"
    for found in cameras:
        name = found.camera.name
        if not result.config.detector.model:
            yield "detector.model is not set"
            return
        if found.camera.image is None and not failed:
            yield "; ".join(found.camera.problems) or f"{name} has no image for this scan"
        else:
            yield f"on {name} it failed: {failed or 'no reason was told'}"


def in_front(e: Evidence, result: FrameResult) -> str:
    """Count the returns that end before the subject."""
    what = ""
    if e.front >= 0:
        name = name_of(result, e.front)
        what = f", most of them on cluster {e.front}" + (f" ({name})" if name else "")
    return f"{e.in_front} of the {e.aimed} returns in its direction end in front of it{what}"


def height_of(e: Evidence) -> float:
    """Return the height in metres of the highest voxel that was removed as ground."""
    known = e.ground[np.isfinite(e.ground)]
    return float(known.max(initial=0))


def state_text(state: ClusterState | Decision) -> str:
    """Return a state in lower case words."""
    return state.name.lower().replace("_", " ")
