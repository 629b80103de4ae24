"""What is true of each object of a synthetic frame, and where it was lost: told from the simulator alone.

Nothing of ``bevviz.why`` is asked but the names of its reasons. The simulator knows which object each point
and each pixel is of; `cause` has the rule.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevviz.evaluate import judge, truth_of
from bevviz.extras.demo.drive import IMAGE_DELAY, START, TRUTH_RANGE, Snapshot, SyntheticSource
from bevviz.extras.demo.mesh import Material, Mesh, merge
from bevviz.extras.demo.sensors import Caster, Lidar, RaycastView
from bevviz.model import geometry
from bevviz.model.frame import F32, F64, I32, I64
from bevviz.model.reasons import ReasonKind
from bevviz.model.results import (
    ClusterState,
    Decision,
    Detections,
    DetectionState,
    FrameResult,
    Fusion,
)

IN_VIEW = 0.1  # share of an object's surface that lies in the direction of the image
FEW = 3  # points that are as good as none
OWN = 0.3  # least IoU of a detection and the box around an object's own pixels
PART = 0.2  # share of an object's obstacle voxels that makes a cluster one of its clusters
MOST = 0.5  # share from which a cluster is mostly of an object, or an object mostly in a cluster
NEARER = 0.5  # metres by which what blocks a beam must be nearer
WHOLE = 0.7  # share of an object's clustered voxels that its named cluster has, if it is not split


@dataclass(frozen=True, slots=True)
class Scene:
    """What a frame shows of each row of its truth, whatever any stage makes of it.

    Attributes:
        number: (K,) of the object.
        points: (K,) LiDAR points on it.
        blocked: (K,) share of the rays that would meet it, were it alone in the world, that meet something
            before it; only told where it has few points, NaN where no ray would.
        in_view: (K,) share of its surface that lies in the direction of the image, whatever is before it.
        pixels: (K, 4) image box around its pixels, NaN where it has none.
        silhouette: (K, 4) image box around all of it, as if nothing were before it; NaN where out of view.
    """

    number: I32
    points: I32
    blocked: F64
    in_view: F64
    pixels: F32
    silhouette: F32


@dataclass(frozen=True, slots=True)
class Cause:
    """What the rule says of an object."""

    reason: ReasonKind
    reported: bool


def scene_of(source: SyntheticSource, shot: Snapshot) -> Scene:
    """Look at each object of the truth by itself."""
    frame = shot.frame
    pose, camera = frame.pose, frame.cameras[0]
    assert camera.world_from_camera is not None and camera.intrinsics is not None
    time = (frame.stamp - START) * 1e-9
    at_scan = _meshes(source, time, pose)
    at_image = _meshes(source, time + IMAGE_DELAY * 1e-9, pose)
    count = len(shot.truth_object)
    blocked, in_view = np.full(count, np.nan), np.zeros(count)
    beams = _Beams(shot)
    pixels = np.full((count, 4), np.nan, np.float32)
    silhouette = pixels.copy()
    height, width = shot.pixel_object.shape
    limit = np.array([width - 0.5, height - 0.5])
    for row, number in enumerate(shot.truth_object.tolist()):
        mesh = at_image[number]
        seen = geometry.apply(geometry.inverse(camera.world_from_camera), mesh.vertices)
        uv, _ = geometry.project(seen, camera.intrinsics)
        ahead = np.clip(uv[np.isfinite(uv).all(axis=1)], -0.5, limit)
        with np.errstate(invalid="ignore"):
            inside = np.asarray(((uv >= -0.5) & (uv < limit)).all(axis=1))
        a, b, c = (mesh.vertices[mesh.triangles[:, i]] for i in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        in_view[row] = (area * inside[mesh.triangles].mean(axis=1)).sum() / area.sum()
        if in_view[row] >= IN_VIEW and shot.truth_hits[row] < FEW:
            blocked[row] = beams.blocked(at_scan[number], pose)
        if in_view[row] > 0:
            silhouette[row] = *ahead.min(0), *ahead.max(0)
        ys, xs = np.nonzero(shot.pixel_object == number)
        if len(xs):
            pixels[row] = xs.min() - 0.5, ys.min() - 0.5, xs.max() + 0.5, ys.max() + 0.5
    return Scene(shot.truth_object, shot.truth_hits, blocked, in_view, pixels, silhouette)


class _Beams:
    """How far each beam of a scan has come."""

    def __init__(self, shot: Snapshot) -> None:
        fields = shot.frame.fields
        self.range = np.full((Lidar().azimuths, Lidar().beams), np.inf)
        self.range[_azimuth(fields["time"]), fields["ring"]] = np.linalg.norm(shot.frame.points, axis=1)

    def blocked(self, mesh: Mesh, pose: F64) -> float:
        """Share of the beams that would meet the mesh and have come less far."""
        shining = replace(mesh, material=np.full_like(mesh.material, Material.SIGN))  # no echo is too weak
        alone = Lidar().scan(RaycastView(Caster(shining), merge([])), pose, np.random.default_rng(0))
        come = self.range[_azimuth(alone.time), alone.ring]
        return float((come < np.linalg.norm(alone.xyz, axis=1) - NEARER).mean()) if len(come) else np.nan


def _azimuth(time: NDArray[Any]) -> NDArray[Any]:
    """Which of the LiDAR's steps around a beam was fired at."""
    return np.rint(time / (0.1 / Lidar().azimuths)).astype(np.int64)


def _meshes(source: SyntheticSource, time: float, pose: F64) -> dict[int, Mesh]:
    found = source.world.objects(time, pose[:3, 3], TRUTH_RANGE + 10.0)
    return {actor.number: mesh for actor, mesh, _ in found}


class Rule:
    """Where each object of one frame was lost.

    Args:
        shot: the frame.
        scene: of the same frame.
        result: what the stages made of it, with one camera and bevviz's own stages.
    """

    def __init__(self, shot: Snapshot, scene: Scene, result: FrameResult) -> None:
        assert shot.frame.truth is not None and result.voxels is not None and result.ground is not None
        assert result.clusters is not None and result.objects is not None
        camera = result.cameras[0]
        assert camera.detections is not None and camera.fusion is not None
        self.scene, self.labels = scene, shot.frame.truth.labels
        self.result, self.clusters, self.objects = result, result.clusters, result.objects
        self.detections: Detections = camera.detections
        self.fusion: Fusion = camera.fusion
        voxel_object = _majority(result.voxels.inverse, shot.point_object, len(result.voxels.points))
        self.ground = result.ground.mask
        self.obstacle_object = voxel_object[~self.ground]
        self.ground_object = voxel_object[self.ground]
        self.owner = self._owners()
        self.partner = judge(self.objects, truth_of(shot.frame, shot.frame.truth)).partner

    def _owners(self) -> I64:
        """(D,) row of the truth that each detection is of, whatever its class; -1: none.

        Detectors box what is seen of an object, or guess the whole of it.
        """
        seen = np.isfinite(self.scene.pixels[:, 0])
        overlap = np.zeros((len(self.detections), len(seen)), np.float32)
        for boxes in (self.scene.pixels, self.scene.silhouette):
            fit = geometry.iou(self.detections.xyxy, np.nan_to_num(boxes, nan=-1.0))
            overlap = np.maximum(overlap, np.where(seen, fit, 0.0))
        best = overlap.argmax(axis=1)
        return np.where(overlap.max(axis=1) >= OWN, best, -1)

    # --- LiDAR ---------------------------------------------------------------------------------

    def _of(self, row: int) -> I32:
        """Labels of the object's obstacle voxels."""
        labels: I32 = self.clusters.labels[self.obstacle_object == self.scene.number[row]]
        return labels

    def _is_in(self, row: int, k: int) -> bool:
        """Whether cluster k is one of the object's."""
        labels = self._of(row)
        return int((labels == k).sum()) >= max(FEW, PART * len(labels))

    def _mates(self, row: int, k: int) -> list[int]:
        """Other objects of the truth that cluster k is of."""
        there = np.unique(self.obstacle_object[self.clusters.labels == k])
        rows = np.flatnonzero(np.isin(self.scene.number, there))
        return [r for r in rows.tolist() if r != row and self._is_in(r, k)]

    def _purity(self, row: int, k: int) -> float:
        return float((self._of(row) == k).sum() / self.clusters.count[k])

    # --- the rule ------------------------------------------------------------------------------

    def cause(self, row: int) -> Cause:
        """Judge one row of the ground truth. It is reported if ``evaluate`` counts an object for it."""
        for j in np.flatnonzero(self.partner == row).tolist():
            return Cause(self._flaw(row, j, int(self.objects.cluster[j])), True)
        for name_matters in (True, False):
            for j, k in enumerate(self.objects.cluster.tolist()):
                right = self.objects.names[j] == self.labels[row]
                if right == name_matters and self._is_in(row, k) and self._stands_for(row, j, k):
                    if right:
                        return Cause(self._not_counted(row, j, k), False)
                    if not self._own(row, DetectionState.KEPT):
                        return Cause(ReasonKind.MISNAMED, False)
        return Cause(self._loss(row), False)

    def _not_counted(self, row: int, j: int, k: int) -> ReasonKind:
        """Return why object j, which stands for this one, is not counted for it."""
        flaw = self._flaw(row, j, k)
        if self.partner[j] >= 0:
            return ReasonKind.MERGED if flaw is ReasonKind.MERGED else ReasonKind.BORROWED
        return flaw if flaw in (ReasonKind.MERGED, ReasonKind.SPLIT) else ReasonKind.MISPLACED

    def _stands_for(self, row: int, j: int, k: int) -> bool:
        """Whether object j, made of cluster k, is this one and not another that is in the same cluster."""
        mates = self._mates(row, k)
        owner = int(self.owner[self.objects.detection[j]])
        if owner == row or not mates:
            return True
        if owner in mates:
            return False
        return all(self._purity(row, k) > self._purity(mate, k) for mate in mates)

    def _flaw(self, row: int, j: int, k: int) -> ReasonKind:
        d = int(self.objects.detection[j])
        matched = self.fusion.cluster_decision == Decision.MATCHED
        names_several = int((matched & (self.fusion.cluster_detection == d)).sum()) > 1
        if self._mates(row, k) or self._purity(row, k) < MOST:
            return ReasonKind.MERGED
        if self.owner[d] != row:
            return ReasonKind.BORROWED
        if names_several:
            return ReasonKind.SHARED_BOX
        labels = self._of(row)
        clustered = labels[labels >= 0]
        if (clustered == k).sum() < WHOLE * len(clustered):
            return ReasonKind.SPLIT
        return ReasonKind.REPORTED

    def _loss(self, row: int) -> ReasonKind:
        scene, labels = self.scene, self._of(row)
        if scene.in_view[row] < IN_VIEW:
            return ReasonKind.OUT_OF_VIEW
        if scene.points[row] < FEW:
            return ReasonKind.HIDDEN if scene.blocked[row] > MOST else ReasonKind.NO_POINTS
        ground, noise = int((self.ground_object == scene.number[row]).sum()), int((labels < 0).sum())
        found = np.flatnonzero([self._is_in(row, k) for k in range(len(self.clusters))])
        kept = found[self.clusters.state[found] == ClusterState.KEPT]
        if len(kept) == 0:
            held = [int((labels == k).sum()) for k in found]
            if not held or max(held) < max(ground, noise):
                return ReasonKind.GROUND if ground >= noise else ReasonKind.NOISE
            small = self.clusters.state[found[int(np.argmax(held))]] == ClusterState.TOO_SMALL
            return ReasonKind.TOO_SMALL if small else ReasonKind.TOO_LARGE
        weak = self._weakness(row)
        if weak is not None:
            return weak
        main = int(kept[np.argmax([(labels == k).sum() for k in kept])])
        return self._refusal(row, main, ground, noise)

    def _own(self, row: int, state: DetectionState) -> list[int]:
        """Return the detections of the object that have its label."""
        rows = np.flatnonzero((self.owner == row) & (self.detections.state == state)).tolist()
        return [d for d in rows if self.detections.names[d] == self.labels[row]]

    def _weakness(self, row: int) -> ReasonKind | None:
        """Return what the detector did wrong, or None."""
        if self._own(row, DetectionState.KEPT):
            return None
        least = self.result.config.detector.conf_threshold
        suppressed = self._own(row, DetectionState.SUPPRESSED)
        if any(self.detections.score[d] >= least for d in suppressed):
            return ReasonKind.SUPPRESSED
        if suppressed or self._own(row, DetectionState.BELOW_THRESHOLD):
            return ReasonKind.BELOW_THRESHOLD
        return ReasonKind.NOT_DETECTED

    def _refusal(self, row: int, main: int, ground: int, noise: int) -> ReasonKind:
        """Of what has a cluster and a detection."""
        d = self._own(row, DetectionState.KEPT)[0]
        labels = self._of(row)
        if self._purity(row, main) < MOST:
            return ReasonKind.MERGED
        inside, total = int((labels == main).sum()), len(labels) + ground
        taken = int(self.fusion.cluster_detection[main])
        if self.fusion.cluster_decision[main] == Decision.MATCHED and self.owner[taken] in self._mates(
            row, main
        ):
            return ReasonKind.MERGED
        reason = self._pair(d, main)
        if reason in (ReasonKind.LOW_OVERLAP, ReasonKind.TOO_FEW_POINTS) and inside < MOST * total:
            other = total - inside - ground - noise
            worst = max((ground, ReasonKind.GROUND), (noise, ReasonKind.NOISE), (other, ReasonKind.SPLIT))
            return worst[1]
        return reason

    def _pair(self, d: int, k: int) -> ReasonKind:
        """Return what the fusion's rules say about a detection and a cluster."""
        config, pairs = self.result.config.fusion, self.fusion.pairs
        (rows,) = np.nonzero((pairs.detection == d) & (pairs.cluster == k))
        if config.method == "centroid":
            far = len(rows) == 0 or pairs.distance[rows[0]] > config.match_radius
            return ReasonKind.TOO_FAR if far else ReasonKind.TAKEN
        if len(rows) == 0 or pairs.points[rows[0]] < config.min_points:
            return ReasonKind.TOO_FEW_POINTS
        if pairs.depth[rows[0]] > config.max_depth:
            return ReasonKind.TOO_FAR
        if pairs.iou[rows[0]] < config.min_iou:
            return ReasonKind.LOW_OVERLAP
        if self.fusion.detection_decision[d] == Decision.MISFIT:
            return ReasonKind.MISFIT
        return (
            ReasonKind.OTHER_CLUSTER
            if self.fusion.detection_decision[d] == Decision.MATCHED
            else ReasonKind.TAKEN
        )


def _majority(voxel: I32, owner: I32, count: int) -> I32:
    """(count,) the object that most points of each voxel are of."""
    pairs, points = np.unique(np.stack([voxel, owner]), axis=1, return_counts=True)
    best = np.full(count, 0, np.int32)
    order = np.argsort(points, kind="stable")
    best[pairs[0, order]] = pairs[1, order]
    return best
