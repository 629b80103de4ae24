"""The reason of a verdict: the parameter that decided, and a clause with the values that were compared."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bevviz.evaluate import MAX_DISTANCE
from bevviz.model.decisions import mask_evidence, pair_kind
from bevviz.model.reasons import Limit, Reason, ReasonKind, Scored, limit, limit_of, scored
from bevviz.model.results import CameraResult, Decision, FrameResult
from bevviz.why.evidence import Evidence, ReportedObject
from bevviz.why.frame_index import Fate, FrameIndex
from bevviz.why.subject import LINK, Subject, count
from bevviz.why.subject_matches import find_fused, first_name, opinion_on

WITHIN = f"evaluate allows {MAX_DISTANCE:g} m"
ONLY = ("nothing", "only ground", "mostly ground")  # beginnings of a clause about a place without an object

_SECTIONS = {  # sections of the stages whose owner decides
    **dict.fromkeys(
        (
            *(ReasonKind.REPORTED, ReasonKind.SHARED_BOX, ReasonKind.BORROWED, ReasonKind.MISNAMED),
            *(ReasonKind.MISPLACED, ReasonKind.CONTRADICTED, ReasonKind.NOT_AMONG),
        ),
        "objects",
    ),
    **dict.fromkeys(
        (ReasonKind.SPLIT, ReasonKind.MERGED, ReasonKind.NOISE, ReasonKind.NO_CLUSTER), "clustering"
    ),
    ReasonKind.GROUND: "ground",
    ReasonKind.NOT_DETECTED: "detector",
    ReasonKind.BELOW_THRESHOLD: "detector",
}


def reason_of(kind: ReasonKind, subject: Subject, evidence: Evidence, traces: FrameIndex) -> Reason:
    """Return the reason of a kind about a subject, with the parameter that decided and its clause."""
    return _ReasonWriter(kind, subject, evidence, traces).reason()


class _ReasonWriter:
    """Writer of the clause of one reason, the words after "because". Its methods are named as the kinds.

    Args:
        kind: the kind of the reason.
        subject: the object or place in question.
        evidence: the evidence about it.
        traces: the index of the frame.
    """

    def __init__(self, kind: ReasonKind, subject: Subject, evidence: Evidence, traces: FrameIndex) -> None:
        self.kind, self.subject, self.evidence, self.traces = kind, subject, evidence, traces
        self.result: FrameResult = traces.result
        self.config = traces.result.config
        section = _SECTIONS.get(kind, "")
        if kind is ReasonKind.REPORTED and not self.result.frame.lidar:
            section = "detector"
        self.owner = traces.origin(section) if section else None
        self.by = self.owner.name if self.owner is not None else ""
        self.limit = self._limit()

    def reason(self) -> Reason:
        """Return the reason."""
        return Reason(self.kind, self.limit, getattr(self, f"_{self.kind.name.lower()}")(), self.by)

    def _limit(self) -> Limit | None:
        """Return the parameter that decided, None if it belongs to a stage that is not ours."""
        kind, ours = self.kind, not self.by
        if kind in (ReasonKind.SHARED_BOX, ReasonKind.BORROWED):
            shared = kind is ReasonKind.SHARED_BOX or self.config.fusion.method == "centroid"
            return limit(self.config, "fusion.method") if shared else None
        if kind is ReasonKind.REPORTED and not self.result.frame.lidar:
            return limit_of(ReasonKind.BELOW_THRESHOLD, self.config) if ours else None
        decides = ours or kind not in (ReasonKind.GROUND, ReasonKind.MERGED, ReasonKind.NOT_DETECTED)
        return limit_of(kind, self.config) if decides else None

    def _by(self) -> str:
        """Return our parameter in brackets, or the name of the stage that is not ours."""
        return f"({self.limit})" if self.limit is not None else f"(by {self.by})"

    # --- reported ------------------------------------------------------------------------------

    @property
    def _named(self) -> ReportedObject:
        """The reported object of the subject."""
        assert self.evidence.named is not None
        return self.evidence.named

    @property
    def _object(self) -> Scored:
        """Class and score of the reported object."""
        assert self.result.objects is not None
        return scored(self.result.objects, self._named.row)

    @property
    def _opinion(self) -> str:
        """The opinion of the cameras on the reported object; empty: none."""
        return opinion_on(self.result, self._named.row)

    def _naming(self) -> str:
        """Name the object of the subject and its cluster."""
        if self.by:
            return f"{self.by} has {self._object} there"
        return f"cluster {self._named.cluster} is named {self._named.name}"

    def _reported(self) -> str:
        if not self.result.frame.lidar:
            best = self.evidence.best
            assert best is not None
            return f"{best.label} was kept {self._by()}; without a LiDAR nothing tells where it is"
        exempt = self.traces.exemption(self.subject.row) if self.subject.kind == "object" else ""
        return self._made_by() + (f", {exempt}: neither right nor wrong" if exempt else "")

    def _made_by(self) -> str:
        """Say what made a reported object."""
        named, splits = self._named, self.result.splits
        if self._opinion:
            return f"{self._naming()}, {self._opinion}"
        if not named.camera:
            return self._naming()
        text = f"{self._naming()} by {self._object}"
        if splits is None:
            return text
        for row in np.flatnonzero((splits.cluster == named.cluster) & (splits.points < splits.of)).tolist():
            off = f"cluster {splits.rest[row]}" if splits.rest[row] >= 0 else "a cluster"
            text += f", which split it off {off} ({splits.points[row]:,} of {splits.of[row]:,} points)"
        return text

    def _also(self) -> str:
        """Name the other clusters of the same detection."""
        return " and ".join(f"cluster {cluster}" for cluster in self._named.also)

    def _owner_of_box(self) -> str:
        """Name the object that the detection of the reported object belongs to."""
        owner = self._box_owner(self._named.camera, self._named.detection)
        return f"which is the box of {owner}" if owner else "a box that fits it badly"

    def _box_owner(self, camera: str, detection: int) -> str:
        """Name the other ground truth object that a detection belongs to; empty: none."""
        owner = self.traces.owner_of(camera, detection)
        return "" if owner in (-1, self.subject.row) else self.traces.truth[owner].name

    def _whose(self, camera: str, detection: int) -> str:
        """Return a clause with the other object that a detection belongs to; empty: none."""
        owner = self._box_owner(camera, detection)
        return f", the box of {owner}" if owner else ""

    def _shared_box(self) -> str:
        return f"its box also names {self._also()} ({self.limit}: each cluster takes the nearest box)"

    def _borrowed(self) -> str:
        if self.limit is None:
            return f"{self._naming()} by {self._object}, {self._owner_of_box()}"
        also = f"that also names {self._also()}" if self._named.also else "that is not on it"
        return f"{self._naming()} by a box {also} ({self.limit}: each cluster takes the nearest box)"

    def _misnamed(self) -> str:
        text = self._naming() + (f", {self._opinion}" if self._opinion else "")
        if self._named.camera and not self._named.own:
            text += f" by a detection that is not its own, {self._owner_of_box()}"
        return text

    def _misplaced(self) -> str:
        return f"its object is too far off: {self._naming()}, {self._named.away:.1f} m from it ({WITHIN})"

    def _contradicted(self) -> str:
        return f"it is {self._opinion}"

    def _split(self) -> str:
        clusters, apart = [part.cluster for part in self.evidence.parts if part.kept], self.evidence.apart
        parts = " and ".join(map(str, clusters[:4])) + (" and more" if clusters[4:] else "")
        by = f" by {self.by}" if self.by else ""
        return f"it is split{by} into clusters {parts}" + (
            f", {apart:.2f} m apart" if np.isfinite(apart) else ""
        )

    def _merged(self) -> str:
        evidence, main = self.evidence, self.evidence.main
        part, clusters = evidence.part(main), self.result.clusters
        assert clusters is not None
        rest = int(clusters.count[main]) - (0 if part is None else part.points)
        names = " and ".join(mate.name for mate, _ in evidence.mates)
        names = names or f"{count(rest, 'point')} that are not its own"
        text = f"cluster {main} holds {names}, too"
        if not np.isfinite(evidence.gap):
            return text
        gap = f"{evidence.gap:.2f} m"
        if evidence.joined_by is not None:
            return f"{text}: the fusion joined clusters {gap} apart for {evidence.joined_by}"
        if self.limit is not None and evidence.gap > self.config.clustering.eps:
            return f"{text}: other points of the cluster bridge the gap of {gap} between them, {self.limit}"
        because = self.limit if self.limit is not None else f"{self.by} made one of them"
        return f"{text}: the gap between them is {gap} and {because}"

    # --- LiDAR ---------------------------------------------------------------------------------

    def _failed(self) -> str:
        failures = (f"{failure.stage} failed: {failure.reason}" for failure in self.result.failures)
        return "; ".join(failures) or "there are no clusters"

    def _out_of_view(self) -> str:
        return "no camera has it in view, and only a camera names objects"

    def _hidden(self) -> str:
        evidence, front = self.evidence, ""
        if evidence.front >= 0:
            name = name_of(self.result, evidence.front)
            front = f", most of them on cluster {evidence.front}" + (f" ({name})" if name else "")
        returns = f"{evidence.in_front} of the {evidence.aimed} returns in its direction"
        return f"it is hidden: {count(evidence.raw, 'point')} on it, and {returns} end in front of it{front}"

    def _no_points(self) -> str:
        """Return the number of points, and around a point or cell the distance of the nearest one."""
        subject, points = self.subject, self.result.frame.points
        text = f"the LiDAR has {count(self.evidence.raw, 'point')}"
        if subject.kind not in ("point", "cell") or subject.box is None:
            return f"{ONLY[0]}: {text} there" if subject.is_place else f"{text} there"
        text = f"{ONLY[0]}: {text} within {float(subject.box.size[0, 0] / 2):g} m"
        if self.evidence.raw or not len(points):
            return text
        axes = slice(2 if subject.kind == "cell" else 3)
        away = np.linalg.norm(points[:, axes] - subject.box.center[0, axes], axis=1)
        return f"{text}, the nearest is {float(away.min()):.1f} m away"

    def _ground(self) -> str:
        evidence = self.evidence
        lowest, highest = evidence.ground_span
        if not self.subject.is_place:
            removed = f"{len(evidence.ground)} of its {evidence.voxels} voxels"
            height = float(np.nan_to_num(highest))
            where = (
                f"up to {height:.2f} m high"
                if height > -0.005
                else f"{-height:.2f} m or more below that ground"
            )
            return f"it was taken for ground: {removed}, {where.replace('-0.00', '0.00')} {self._by()}"
        number = int((self.traces.fate[evidence.points] == Fate.GROUND).sum())
        all_of_it = number == evidence.raw
        whole = "all ground" if all_of_it else f"{number} of them ground"
        known = np.isfinite(highest)
        height_text = f", {lowest:z.2f} to {highest:z.2f} m above its level" if known else ""
        by = f" (by {self.by})" if self.by else ""
        return f"{ONLY[1 if all_of_it else 2]}: {count(evidence.raw, 'point')}, {whole}{height_text}{by}"

    def _noise(self) -> str:
        noise, obstacles = self.evidence.noise, self.evidence.obstacles
        are = "is" if noise == 1 else "are"
        few = f"{noise} of its" if noise < obstacles else "its"
        points = f"{few} {count(max(noise, obstacles), 'obstacle point')}"
        eps = self.config.clustering.eps
        most = f"none has more than {self.evidence.neighbours} neighbours within {eps:g} m"
        return f"{points} {are} noise: {most} ({self.limit})"

    def _no_cluster(self) -> str:
        obstacles, noise, best = self.evidence.obstacles, self.evidence.noise, self.evidence.best
        points, is_robot = count(obstacles, "obstacle point"), self.owner is not None and self.owner.topic
        few = f"{obstacles - noise} of its {points} are" if obstacles > noise else f"none of its {points} is"
        text = f"{few} in a cluster of {self.by}"
        if is_robot and best is not None and best.cluster >= 0:
            nearest = f"the best for {best.label} is cluster {best.cluster} ({self._pair(best.cluster)})"
            text = f"no cluster of {self.by} is its own, {nearest}"
        return f"the robot's clustering lost it: {text}" if is_robot else text

    def _too_small(self) -> str:
        aside, parts = self.evidence.aside, [part for part in self.evidence.parts if not part.kept]
        assert aside is not None
        text = f"its cluster {aside.cluster} has {count(aside.count, 'point')} ({self.limit})"
        if len(parts) > 1:
            text += f", and {self.evidence.aside_points} of its points are in {len(parts)} such clusters"
        splits = self.result.splits
        rows = [] if splits is None else np.flatnonzero(splits.rest == aside.cluster).tolist()
        if splits is None or not rows:
            return text
        row = max(rows, key=lambda row: int(splits.points[row]))
        name, detection = splits.camera[row], int(splits.detection[row])
        taker = f"{self.traces.scored(name, detection)}{self._whose(name, detection)}"
        return f"{text}: the fusion gave the rest of it to {taker}"

    _too_large = _too_small

    # --- detector ------------------------------------------------------------------------------

    def _not_run(self) -> str:
        return "the detector never ran: " + "; ".join(not_run(self.result, self.subject.camera))

    def _not_detected(self) -> str:
        subject, best, shared = self.subject, self.evidence.best, self.evidence.shared(self.subject)
        wrong = f"; the camera has {best.label} there" if best is not None else ""
        class_ = "of its class " if subject.label else ""
        if self.owner is not None and self.owner.topic:
            return f"the robot's detector lost it: {self.by} has no detection {class_}there{wrong}"
        if self.limit is None:
            return f"{self.by} gave no detection {class_}there{wrong}"
        if shared is not None:
            fit = f"{shared.label} fits it ({shared.overlap:.2f})"
            owner = self.traces.truth[shared.owner].name
            return f"the detector has no box for it alone: {fit}, but is the box of {owner}{wrong}"
        nearest, overlap = self._nearest_detection()
        if nearest is not None:
            fit = f"the best of its class there, {nearest}, overlaps it by {overlap:.2f}"
            return f"the detector has no box that fits it: {fit}{wrong}"
        if subject.kind == "detection":
            something = "it is probably that of something else"
            return f"{something}: the detector has no candidate for the object there"
        if best is not None and not subject.label:
            something = f"{best.label} there is probably that of something else"
            return f"the detector has no candidate for it: {something}"
        least = self.limit.number
        return f"the detector has no candidate {class_}there, not even with a score of {least}{wrong}"

    def _nearest_detection(self) -> tuple[Scored | None, float]:
        """Return the detection of a right class that overlaps an object of the ground truth most.

        It is one that overlaps too little to be a candidate. None: no detection does at all.
        """
        best: tuple[float, Scored | None] = 0.0, None
        for camera in self.result.cameras if self.subject.kind == "truth" else ():
            detections = camera.detections
            if detections is None or not len(detections):
                continue
            overlap = self.traces.fits(camera).overlap[:, self.subject.row].copy()
            overlap[[not self.subject.accepts(name) for name in detections.names]] = 0
            row = int(overlap.argmax())
            if best[0] < overlap[row] < LINK:
                best = float(overlap[row]), scored(detections, row)
        return best[1], best[0]

    def _below_threshold(self) -> str:
        best = self.evidence.best
        assert self.limit is not None and best is not None
        score = best.label.beside(float(self.limit.value))
        if self.subject.kind == "detection":
            return f"it is too weak: {score}, {self.limit}"
        return f"its detection is too weak: {best.name} {score}, {self.limit}"

    def _suppressed(self) -> str:
        best = self.evidence.best
        assert best is not None
        camera = self.result.camera(best.camera)
        assert camera is not None and camera.detections is not None
        head = "it" if self.subject.kind == "detection" else f"its detection {best.label}"
        rival = int(camera.detections.suppressed_by[best.row])
        if rival < 0:
            return f"{head} was suppressed by a better one"
        better = f"{scored(camera.detections, rival)}{self._whose(best.camera, rival)}"
        overlap = float(camera.detections.overlap[best.row])
        return f"{head} was suppressed by {better} (IoU {overlap:.2f}, {self.limit})"

    def _second_name(self) -> str:
        first = first_name(self.subject, self.evidence, self.traces)
        same = f"both have the same image box and the same cluster {self.evidence.main}"
        return f"the reported {first}, and nothing was missed: {same}"

    # --- fusion --------------------------------------------------------------------------------

    def _not_fused(self) -> str:
        only = self.subject.camera or (self.evidence.best.camera if self.evidence.best is not None else "")
        cameras = [result.camera for result in cameras_of(self.result, only)]
        problems = "; ".join(problem for camera in cameras for problem in camera.problems)
        names = " and ".join(camera.name for camera in cameras)
        return f"{names} could not be compared with clusters{f': {problems}' if problems else ''}"

    @property
    def _label(self) -> Scored:
        """Class and score of the best detection."""
        assert self.evidence.best is not None
        return self.evidence.best.label

    @property
    def _cluster(self) -> int:
        """The cluster that was compared with the best detection."""
        best = self.evidence.best
        return best.cluster if self.subject.kind == "detection" and best is not None else self.evidence.main

    def _pair(self, cluster: int) -> str:
        """Return the numbers that the rule of the fusion compared for the best detection and a cluster."""
        best = self.evidence.best
        assert best is not None
        if (fusion := self.result.fusion(best.camera)) is None:
            return "not compared"
        pair = fusion.pair(best.row, cluster)
        if pair is None:
            return "no point of it is in its frustum"
        if self.config.fusion.method == "centroid":
            return f"{pair.distance:.0f} px, {pair.depth:.1f} m"
        mask = mask_evidence(fusion, best.row, self.config)
        return f"{count(pair.points, 'point')} in its frustum, IoU {pair.iou:.2f}{mask}"

    def _misfit(self) -> str:
        return f"no part of cluster {self._cluster} suits {self._label} in outline and size, {self.limit}"

    def _low_overlap(self) -> str:
        both = f"{self._label} and cluster {self._cluster}"
        return f"{both} overlap too little ({self._pair(self._cluster)}), {self.limit}"

    def _too_few_points(self) -> str:
        if self._cluster < 0:
            return f"{self._label} found no cluster"
        few = f"too few points of cluster {self._cluster} ({self._pair(self._cluster)})"
        return f"{self._label} has {few}, {self.limit}"

    def _too_far(self) -> str:
        both = f"cluster {self._cluster} is too far from {self._label}"
        return f"{both} ({self._pair(self._cluster)}), {self.limit}"

    def _taken(self) -> str:
        best, cluster = self.evidence.best, self._cluster
        assert best is not None
        fusion = self.result.fusion(best.camera)
        free = fusion is not None and fusion.cluster_decision[cluster] != Decision.MATCHED
        if free and best.cluster >= 0:  # Nobody took its own cluster: the detection wanted another one.
            cluster = best.cluster
        taker = -1 if fusion is None else int(fusion.cluster_detection[cluster])
        text = f"cluster {cluster}, the best for {best.label}, was taken by "
        if taker in (-1, best.row):
            return text + "another camera's detection"
        return f"{text}{self.traces.scored(best.camera, taker)}{self._whose(best.camera, taker)}"

    def _other_cluster(self) -> str:
        assert self.evidence.best is not None
        own_cluster = f"cluster {self._cluster} ({self._pair(self._cluster)})"
        return f"{self._label} went to cluster {self.evidence.best.cluster}, not to its own, {own_cluster}"

    # --- objects that are not ours -------------------------------------------------------------

    def _not_among(self) -> str:
        """Name the object that our fusion would make, or the results of the other stages at the place."""
        text = f"it is not among the objects of {self.by}; "
        row, opinions = find_fused(self.subject, self.evidence, self.traces), self.result.opinions
        clusters, objects = self.result.clusters, self.result.objects
        if row < 0 or opinions is None or clusters is None:
            return text + ", ".join(self._other_stages())
        fused, partner = opinions.fused, int(opinions.partner[row])
        points = count(int(clusters.count[fused.cluster[row]]), "point")
        named = f"named by {scored(fused, row)} of {fused.camera[row]}"
        text += f"our fusion has it: cluster {fused.cluster[row]} ({points}), {named}"
        in_box = partner >= 0 and objects is not None
        return f"{text}, in the box of {scored(objects, partner)}" if in_box else text

    def _other_stages(self) -> Iterator[str]:
        """Yield the results of the other stages at the place."""
        if self.evidence.main >= 0:
            yield f"cluster {self.evidence.main} is there"
        else:
            yield f"{count(self.evidence.raw, 'point')} are there and no cluster"
        if any(camera.detections is not None for camera in self.result.cameras):
            best = self.evidence.best
            yield f"{best.label} as well" if best is not None and best.kept else "and no detection of it"

    def _lost_in_fusion(self) -> str:
        """Return the decision of our fusion about the robot's cluster and detection."""
        best, cluster = self.evidence.best, self._cluster
        assert best is not None
        names = {s: self.traces.origin(s).name for s in ("clustering", "detector", "objects")}
        inputs = (
            f"cluster {cluster} of {names['clustering']} and {best.label} of {names['detector']} are there"
        )
        fusion = self.result.fusion(best.camera)
        decision = "could not compare them"
        if fusion is not None:
            kind = pair_kind(fusion, self.config, best.row, cluster)
            matches = kind is ReasonKind.MATCHED
            decision = "matches them" if matches else f"refuses them, too: {kind.value}"
            decision += f" ({self._pair(cluster)})"
        return f"the robot's fusion lost it: {inputs}, but no object of {names['objects']}; ours {decision}"


# --- cameras and clusters ----------------------------------------------------------------------


def cameras_of(result: FrameResult, camera: str) -> list[CameraResult]:
    """Return the camera of that name. An empty name means all cameras."""
    return [c for c in result.cameras if camera in ("", c.camera.name)]


def detector_ran(result: FrameResult, camera: str) -> bool:
    """Return whether the detector ran on an image of the camera, or of any camera."""
    return any(c.detections is not None for c in cameras_of(result, camera))


def not_run(result: FrameResult, only: str = "") -> Iterator[str]:
    """Yield the reason why the detector did not run on each camera's image."""
    failed = "; ".join(failure.reason for failure in result.failures if failure.stage == "detector")
    if not result.cameras:
        yield "there is no camera"
    for camera in cameras_of(result, only):
        if camera.detections is not None:
            continue
        if not result.config.detector.model:
            yield "detector.model is not set"
            return
        name = camera.camera.name
        if camera.camera.image is None and not failed:
            yield "; ".join(camera.camera.problems) or f"{name} has no image for this scan"
        else:
            yield f"on {name} it failed: {failed or 'no reason was told'}"


def name_of(result: FrameResult, cluster: int) -> str:
    """Return the class of the object of a cluster, empty for none."""
    if result.objects is None or cluster < 0:
        return ""
    rows = np.flatnonzero(result.objects.cluster == cluster)
    return result.objects.names[rows[0]] if len(rows) else ""
