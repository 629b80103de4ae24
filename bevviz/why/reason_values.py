"""The values that decided about a subject, for each kind of reason."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from bevviz.model.decisions import detection_reason, mask_evidence, pair_reason
from bevviz.model.reasons import Limit, Reason, ReasonKind, Scored, StageOwner, limit, limit_of, scored
from bevviz.model.results import CameraResult, Decision, FrameResult
from bevviz.why.evidence import Evidence, camera_and_fusion
from bevviz.why.frame_index import Fate, FrameIndex
from bevviz.why.subject import LINK, Subject
from bevviz.why.subject_matches import find_fused, first_name, opinion_on

_OWN_LIMIT = {  # section of a stage whose parameter decides only if the stage is ours
    ReasonKind.GROUND: "ground",
    ReasonKind.MERGED: "clustering",
    ReasonKind.NOT_DETECTED: "detector",
}


class ReasonValues:
    """The values that decided, for each kind of reason.

    Args:
        subject: the object or place in question.
        evidence: the evidence about it.
        traces: the index of the frame.
    """

    def __init__(self, subject: Subject, evidence: Evidence, traces: FrameIndex) -> None:
        self.subject, self.evidence, self.traces = subject, evidence, traces
        self.result: FrameResult = traces.result
        self.config = traces.result.config

    def reason(self, kind: ReasonKind) -> Reason:
        """Return the reason of a kind with its values and the parameter that decided."""
        values = {
            ReasonKind.REPORTED: self._reported,
            ReasonKind.SHARED_BOX: self._object,
            ReasonKind.BORROWED: self._object,
            ReasonKind.MISNAMED: self._object,
            ReasonKind.MISPLACED: self._object,
            ReasonKind.CONTRADICTED: self._object,
            ReasonKind.SPLIT: self._split,
            ReasonKind.MERGED: self._merged,
            ReasonKind.FAILED: self._failed,
            ReasonKind.HIDDEN: self._hidden,
            ReasonKind.NO_POINTS: self._no_points,
            ReasonKind.GROUND: self._ground,
            ReasonKind.NOISE: self._noise,
            ReasonKind.NO_CLUSTER: self._noise,
            ReasonKind.TOO_SMALL: self._aside,
            ReasonKind.TOO_LARGE: self._aside,
            ReasonKind.NOT_RUN: self._not_run,
            ReasonKind.NOT_DETECTED: self._detection,
            ReasonKind.BELOW_THRESHOLD: self._detection,
            ReasonKind.SUPPRESSED: self._suppressed,
            ReasonKind.SECOND_NAME: self._second_name,
            ReasonKind.NOT_FUSED: self._not_fused,
            ReasonKind.TAKEN: self._taken,
            ReasonKind.NOT_AMONG: self._not_among,
            ReasonKind.LOST_IN_FUSION: self._lost_in_fusion,
        }.get(kind)
        if kind is ReasonKind.OUT_OF_VIEW:
            return Reason(kind)
        return Reason(kind, self._limit(kind), self._pair() if values is None else values())

    def _limit(self, kind: ReasonKind) -> Limit | None:
        """Return the parameter that decided, None if it belongs to a stage that is not ours."""
        if kind in (ReasonKind.SHARED_BOX, ReasonKind.BORROWED):
            shared = kind is ReasonKind.SHARED_BOX or self.config.fusion.method == "centroid"
            return limit(self.config, "fusion.method") if shared else None
        if kind is ReasonKind.REPORTED and not self.result.frame.lidar:
            ours = self._owner("detector").ours
            return limit_of(ReasonKind.BELOW_THRESHOLD, self.config) if ours else None
        section = _OWN_LIMIT.get(kind, "")
        return limit_of(kind, self.config) if not section or self._owner(section).ours else None

    def _owner(self, section: str) -> StageOwner:
        """Return the owner of the stage of a section."""
        return self.traces.origin(section)

    # --- reported ------------------------------------------------------------------------------

    def _reported(self) -> dict[str, Any]:
        if not self.result.frame.lidar:
            return self._detection()
        values, splits = self._object(), self.result.splits
        if self.subject.kind == "object":
            values["exempt"] = self.traces.exemption(self.subject.row)
        if splits is None or not values["camera"]:
            return {**values, "split_off": ()}
        parts = (splits.cluster == values["cluster"]) & (splits.points < splits.of)
        columns = (column[parts].tolist() for column in (splits.rest, splits.points, splits.of))
        return {**values, "split_off": tuple(zip(*columns, strict=True))}

    def _object(self) -> dict[str, Any]:
        """Return the values of the reported object."""
        named, objects = self.evidence.named, self.result.objects
        assert named is not None and objects is not None
        return {
            "object": Scored(named.name, float(objects.score[named.row])),
            "cluster": named.cluster,
            "by": self._owner("objects").name,
            "opinion": opinion_on(self.result, named.row),
            "camera": named.camera,
            "own": named.own,
            "also": named.also,
            "away": named.away,
            "box_owner": self._box_owner(named.camera, named.detection),
        }

    def _box_owner(self, camera: str, detection: int) -> str:
        """Name the other ground truth object that a detection belongs to; empty: none."""
        camera_result = self.traces.camera(camera)
        owner = -1 if camera_result is None else int(self.traces.owners(camera_result)[detection])
        return "" if owner in (-1, self.subject.row) else self.traces.truth[owner].name

    def _split(self) -> dict[str, Any]:
        clusters = tuple(part.cluster for part in self.evidence.parts if part.kept)
        return {"clusters": clusters, "apart": self.evidence.apart, "by": self._owner("clustering").name}

    def _merged(self) -> dict[str, Any]:
        evidence = self.evidence
        part, clusters = evidence.part(evidence.main), self.result.clusters
        assert clusters is not None
        whole = int(clusters.count[evidence.main])
        return {
            "cluster": evidence.main,
            "others": tuple(name for name, _ in evidence.others),
            "rest": whole if part is None else whole - part.points,
            "gap": evidence.gap,
            "by": self._owner("clustering").name,
            "joined_by": evidence.joined_by,
            "eps": self.config.clustering.eps,
        }

    # --- LiDAR ---------------------------------------------------------------------------------

    def _failed(self) -> dict[str, Any]:
        return {"failures": tuple((failure.stage, failure.reason) for failure in self.result.failures)}

    def _hidden(self) -> dict[str, Any]:
        evidence = self.evidence
        return {
            "points": evidence.raw,
            "in_front": evidence.in_front,
            "aimed": evidence.aimed,
            "front": evidence.front,
            "front_name": name_of(self.result, evidence.front),
        }

    def _no_points(self) -> dict[str, Any]:
        """Return the number of points, and at a place the distance of the nearest one."""
        values: dict[str, Any] = {"points": self.evidence.raw, "radius": None, "nearest": float("nan")}
        subject, points = self.subject, self.result.frame.points
        if subject.kind not in ("point", "cell") or subject.box is None:
            return values
        axes = slice(2 if subject.kind == "cell" else 3)
        values["radius"] = float(subject.box.size[0, 0] / 2)
        if not self.evidence.raw and len(points):
            away = np.linalg.norm(points[:, axes] - subject.box.center[0, axes], axis=1)
            values["nearest"] = float(away.min())
        return values

    def _ground(self) -> dict[str, Any]:
        evidence = self.evidence
        known = evidence.ground[np.isfinite(evidence.ground)]
        return {
            "points": evidence.raw,
            "ground_points": int((self.traces.fate[evidence.points] == Fate.GROUND).sum()),
            "removed": len(evidence.ground),
            "voxels": evidence.voxels,
            "lowest": float(known.min()) if len(known) else float("nan"),
            "highest": float(known.max()) if len(known) else float("nan"),
            "by": self._owner("ground").name,
        }

    def _noise(self) -> dict[str, Any]:
        evidence, best = self.evidence, self.evidence.best
        owner = self._owner("clustering")
        values = self._pair(best.cluster) if owner.topic and best is not None and best.cluster >= 0 else {}
        return {
            **values,
            "obstacles": evidence.obstacles,
            "noise": evidence.noise,
            "neighbours": evidence.neighbours,
            "eps": self.config.clustering.eps,
            "by": owner.name,
            "robot": bool(owner.topic),
        }

    def _aside(self) -> dict[str, Any]:
        aside = self.evidence.aside
        assert aside is not None
        parts = [part for part in self.evidence.parts if not part.kept]
        taker, owner = self._divider(aside.cluster)
        return {
            "cluster": aside.cluster,
            "count": aside.count,
            "clusters": len(parts),
            "points": self.evidence.aside_points,
            "taker": taker,
            "taker_owner": owner,
        }

    def _divider(self, cluster: int) -> tuple[Scored | None, str]:
        """Return the detection that took the larger part of a cluster, and the object it is the box of."""
        splits = self.result.splits
        rows = [] if splits is None else np.flatnonzero(splits.rest == cluster).tolist()
        if splits is None or not rows:
            return None, ""
        row = max(rows, key=lambda row: int(splits.points[row]))
        camera, detection = self.traces.camera(splits.camera[row]), int(splits.detection[row])
        assert camera is not None and camera.detections is not None
        return scored(camera.detections, detection), self._box_owner(camera.camera.name, detection)

    # --- detector ------------------------------------------------------------------------------

    def _not_run(self) -> dict[str, Any]:
        return {"problems": tuple(not_run(self.result, self.subject.camera))}

    def _detection(self) -> dict[str, Any]:
        """Return the best detection of the subject."""
        best, shared = self.evidence.best, self.evidence.shared(self.subject)
        owner = self._owner("detector")
        values = {
            "detection": None if best is None else best.label,
            "by": owner.name,
            "robot": bool(owner.topic),
            "shared": None if shared is None else shared.label,
            "nearest": None,
        }
        if shared is None:
            nearest, overlap = self._nearest_detection()
            return {**values, "nearest": nearest, "overlap": overlap}
        owner_name = self.traces.truth[shared.owner].name
        return {**values, "overlap": shared.overlap, "shared_owner": owner_name}

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

    def _suppressed(self) -> dict[str, Any]:
        best = self.evidence.best
        assert best is not None
        camera = self.traces.camera(best.camera)
        assert camera is not None and camera.detections is not None
        rival = int(camera.detections.suppressed_by[best.row])
        owner = self._box_owner(best.camera, rival) if rival >= 0 else ""
        return {**detection_reason(camera.detections, best.row, self.config).values, "rival_owner": owner}

    def _second_name(self) -> dict[str, Any]:
        first = first_name(self.subject, self.evidence, self.traces)
        return {"first": first, "cluster": self.evidence.main}

    # --- fusion --------------------------------------------------------------------------------

    def _not_fused(self) -> dict[str, Any]:
        only = self.subject.camera or (self.evidence.best.camera if self.evidence.best is not None else "")
        cameras = [result.camera for result in cameras_of(self.result, only)]
        return {
            "cameras": tuple(camera.name for camera in cameras),
            "problems": tuple(problem for camera in cameras for problem in camera.problems),
        }

    def _pair(self, cluster: int | None = None) -> dict[str, Any]:
        """Return the values that the fusion compared for the best detection and its cluster."""
        best = self.evidence.best
        assert best is not None
        if cluster is None:
            cluster = best.cluster if self.subject.kind == "detection" else self.evidence.main
        _, fusion = camera_and_fusion(self.result, best.camera)
        return {
            "detection": best.label,
            "cluster": cluster,
            "matched": best.cluster,
            "compared": fusion is not None,
            "pair": None if fusion is None else fusion.pair(best.row, cluster),
            "centroid": self.config.fusion.method == "centroid",
            "mask": "" if fusion is None else mask_evidence(fusion, best.row, self.config),
        }

    def _taken(self) -> dict[str, Any]:
        best, values = self.evidence.best, self._pair()
        assert best is not None
        camera, fusion = camera_and_fusion(self.result, best.camera)
        free = fusion is not None and fusion.cluster_decision[values["cluster"]] != Decision.MATCHED
        if free and best.cluster >= 0:  # Nobody took its own cluster: the detection wanted another one.
            values = self._pair(best.cluster)
        taker = -1 if fusion is None else int(fusion.cluster_detection[values["cluster"]])
        if camera.detections is None or taker in (-1, best.row):
            return {**values, "taker": None}
        owner = self._box_owner(best.camera, taker)
        return {**values, "taker": scored(camera.detections, taker), "taker_owner": owner}

    # --- objects that are not ours -------------------------------------------------------------

    def _not_among(self) -> dict[str, Any]:
        """Return the object that our fusion would make, or the results of the other stages at the place."""
        evidence, best = self.evidence, self.evidence.best
        values = {
            "by": self._owner("objects").name,
            "fused": None,
            "cluster": evidence.main,
            "points": evidence.raw,
            "detector_known": any(camera.detections is not None for camera in self.result.cameras),
            "detection": best.label if best is not None and best.kept else None,
        }
        row, opinions = find_fused(self.subject, evidence, self.traces), self.result.opinions
        if row < 0 or opinions is None or self.result.clusters is None:
            return values
        cluster, partner = int(opinions.fused.cluster[row]), int(opinions.partner[row])
        inside = partner >= 0 and self.result.objects is not None
        return {
            **values,
            "fused": scored(opinions.fused, row),
            "camera": opinions.fused.camera[row],
            "cluster": cluster,
            "points": int(self.result.clusters.count[cluster]),
            "partner": scored(self.result.objects, partner) if inside else None,
        }

    def _lost_in_fusion(self) -> dict[str, Any]:
        """Return the decision of our fusion about the robot's cluster and detection."""
        best, values = self.evidence.best, self._pair()
        assert best is not None
        _, fusion = camera_and_fusion(self.result, best.camera)
        ours = None if fusion is None else pair_reason(fusion, self.config, best.row, values["cluster"])
        owners = {section: self._owner(section).name for section in ("clustering", "detector", "objects")}
        return {**values, **owners, "ours": ours}


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
