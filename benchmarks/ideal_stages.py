"""What a missed object lacks: one or two stages are given the ideal result at the object, the others run.

Nothing of ``bevviz.why`` is used. The labels say what is ideal:

- ground: voxels in the object's box are obstacles;
- clustering: its obstacles are a cluster of their own, which no size limit removes;
- detection: a detection of the right class has the box of what is visible, and no other one shows the object;
- fusion: its best detection gets the cluster that holds most of it, or, where fusion splits clusters, its
  points in kept clusters and in noise. No limit of the fusion applies, and no other detection takes part.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import combinations
from typing import Any, TypeVar, TypeVarTuple, cast

import numpy as np

from benchmarks.ideal_data import LabelledFrame
from bevviz.config import ClusteringConfig, Config
from bevviz.evaluate import judge
from bevviz.model import geometry
from bevviz.model.frame import F32, I64, Bool, Boxes3D, Camera
from bevviz.model.results import (
    CameraResult,
    Clusters,
    ClusterState,
    Detections,
    DetectionState,
    FrameResult,
    Ground,
    Objects,
)
from bevviz.pipeline.perceive import perceive
from bevviz.pipeline.stage_loader import Stages
from bevviz.pipeline.stage_log import Memo
from bevviz.stages.clustering import describe_clusters
from bevviz.stages.frustum_fusion import claim_clusters
from bevviz.stages.visibility import image_boxes

T = TypeVar("T")
Ts = TypeVarTuple("Ts")

GROUND, CLUSTERING, DETECTION, FUSION = STAGES = "ground", "clustering", "detection", "fusion"
MARGIN = 0.05  # metres around a labelled box that still belong to the object
FOOT = 0.08  # metres above the bottom of a labelled box that belong to the road
OWN = 0.3  # least IoU of a detection and the image box of its object
SCORE = 0.99  # of an ideal detection


class MissedObject:
    """An object that had to be found, and was not.

    Args:
        labelled: the frame.
        row: row in its ground truth.
        result: of the frame.
        stages: with which the result was made.
        classes: names that the detector knows.
        memo: results of stages on this frame.
    """

    def __init__(
        self,
        labelled: LabelledFrame,
        row: int,
        result: FrameResult,
        stages: Stages,
        classes: Iterable[str],
        memo: Memo,
    ) -> None:
        self.labelled, self.row, self.result, self.memo = labelled, row, result, memo
        self.truth, self._stages = labelled.truth, stages
        self._known = {name.lower() for name in classes}

    def restored_by(self) -> tuple[list[str], list[tuple[str, str]]]:
        """Return the stages that restore the object alone; where there is none, the pairs that do."""
        alone = [stage for stage in STAGES if self.is_found_with({stage})]
        if alone:
            return alone, []
        return [], [pair for pair in combinations(STAGES, 2) if self.is_found_with(set(pair))]

    def is_found_with(self, ideal: set[str]) -> bool:
        """Return whether the object is found if these stages are ideal at the object.

        Raises:
            RuntimeError: a stage that is to be replaced did not run, or a stage failed.
        """
        config, memo = self.result.config, _IdealMemo(self, ideal)
        by_camera = {
            camera.camera.name: self._ideal_detections(camera) if DETECTION in ideal else camera.detections
            for camera in self.result.cameras
        }
        stages = replace(
            self._stages, network=None, detector=None, detect=lambda camera: by_camera[camera.name]
        )
        result = perceive(self.labelled.frame, config, stages, memo)
        if result.failures or (ideal - {DETECTION, FUSION}) - memo.replaced:
            raise RuntimeError(f"{ideal} were not replaced, or a stage failed: {result.failures}")
        objects = result.objects
        if FUSION in ideal and memo.clusters is not None and objects is not None:
            objects = self._ideal_objects(result, memo.clusters, objects)
        return objects is not None and not judge(objects, self.truth).missed[self.row]

    # --- ideal results -------------------------------------------------------------------------

    def holds(self, points: F32) -> Bool:
        """Return the (N,) mask of the points on the object."""
        boxes, row = self.truth.boxes, self.row
        x, y, z = (points - boxes.center[row]).T
        c, s = np.cos(boxes.yaw[row]), np.sin(boxes.yaw[row])
        length, width, height = (boxes.size[row] / 2).tolist()
        inside = (np.abs(c * x + s * y) <= length + MARGIN) & (np.abs(c * y - s * x) <= width + MARGIN)
        return np.asarray(inside & (z > FOOT - height) & (z <= height + MARGIN), np.bool_)

    def ideal_ground(self, points: F32, ground: Ground) -> Ground:
        """Return the ground without the voxels of the object."""
        return replace(ground, mask=ground.mask & ~self.holds(points))

    def ideal_clusters(self, points: F32, clusters: Clusters, config: ClusteringConfig) -> Clusters:
        """Return the clusters with one that is the object."""
        own = self.holds(points)
        if not own.any():
            return clusters
        labels = clusters.labels.copy()
        labels[own] = len(clusters)
        used = np.unique(labels[labels >= 0])
        number = np.full(len(clusters) + 2, -1, np.int32)  # its last element is that of noise
        number[used] = np.arange(len(used))
        made = describe_clusters(points, number[labels], config)
        made.state[len(used) - 1] = ClusterState.KEPT
        return made

    def _ideal_detections(self, result: CameraResult) -> Detections | None:
        """Return the detections of a camera with one of the object, and no other one of it."""
        detections, box = result.detections, self.image_boxes(result.camera)[self.row]
        if detections is None or not np.isfinite(box).all():
            return detections
        state = detections.state.copy()
        state[self._owners(result) == self.row] = DetectionState.BELOW_THRESHOLD
        masks = detections.masks
        if masks is not None:
            masks = replace(masks, place=np.vstack([masks.place, np.zeros((1, 4), np.int32)]))

        def added(values: Any, value: Any) -> Any:
            return np.append(values, np.array([value], values.dtype), axis=0)

        return Detections(
            added(detections.xyxy, box),
            added(detections.score, SCORE),
            added(detections.class_id, 0),
            (*detections.names, self._name()),
            added(state, DetectionState.KEPT),
            added(detections.suppressed_by, -1),
            added(detections.overlap, 0),
            masks,
        )

    def _ideal_objects(self, result: FrameResult, clusters: Clusters, objects: Objects) -> Objects:
        """Return the objects with one of the best detection and cluster of the object.

        Args:
            result: of the other stages.
            clusters: before detections split them.
            objects: of the result.
        """
        accepted = self.truth.accepted[self.row]
        for camera in result.cameras:
            detections = camera.detections
            if detections is None or camera.uv is None or camera.depth is None:
                continue
            right = np.array([name.lower() in accepted for name in detections.names], np.bool_)
            own = np.flatnonzero(detections.kept & right & (self._owners(camera) == self.row))
            if not len(own):
                continue
            boxes = self.image_boxes(camera.camera)[[self.row]]
            d = int(own[geometry.iou(detections.xyxy[own], boxes)[:, 0].argmax()])
            k, box = self._fused_box(result, camera, d, clusters)
            if box is None:
                return objects
            freed = [
                j
                for j in range(len(objects))
                if (objects.camera[j], int(objects.detection[j])) != (camera.camera.name, d)
            ]
            return _with_object(objects, freed, box, detections, d, camera.camera.name, k)
        return objects

    def _fused_box(
        self, result: FrameResult, camera: CameraResult, d: int, clusters: Clusters
    ) -> tuple[int, Boxes3D | None]:
        """Return the cluster that an ideal fusion gives to a detection, and the box that it makes of both.

        A fusion that splits clusters takes the object's points from kept clusters and from noise.
        """
        assert result.obstacles is not None
        config, own = result.config, np.flatnonzero(self.holds(result.obstacles))
        labels = clusters.labels[own]
        kept = labels[np.append(clusters.kept, False)[labels]]
        k = int(np.bincount(kept).argmax()) if len(kept) else -1
        if config.fusion.method == "frustum" and config.fusion.split:
            box = self._split_box(result, camera, d, own[np.append(clusters.kept, True)[labels]])
            if box is not None:
                return k, box
        return k, clusters.boxes(config.clustering).chosen([k]) if k >= 0 else None

    def _split_box(self, result: FrameResult, camera: CameraResult, d: int, rows: I64) -> Boxes3D | None:
        """Return the box that the fusion makes of a detection and some points without its own limits.

        It makes no cluster that is smaller than the limit of the clustering; then the result is None.
        """
        assert result.obstacles is not None and result.ground is not None
        assert camera.detections is not None and camera.uv is not None and camera.depth is not None
        config, points = result.config, result.obstacles[rows]
        fusion = config.fusion.model_copy(
            update={"min_iou": 0.0, "min_points": 1, "min_rating": 0.0, "max_depth": 1e4}
        )
        height = result.ground.height.compress(~result.ground.mask)[rows]
        detection = _single(camera.detections, d)
        seen = replace(camera, detections=detection, uv=camera.uv[rows], depth=camera.depth[rows])
        noise = describe_clusters(points, np.full(len(rows), -1, np.int32), config.clustering)
        _, (claims,), _ = claim_clusters(
            points, height, noise, (seen,), fusion, config.objects, config.clustering
        )
        return None if claims is None or claims.cluster[0] < 0 else claims.boxes.chosen([0])

    # --- the object in images ------------------------------------------------------------------

    def image_boxes(self, camera: Camera) -> F32:
        """Return (K, 4) image boxes of all labels, NaN where out of view."""
        projected = image_boxes(self.truth.boxes, camera)
        if camera.name != self.labelled.frame.cameras[0].name:
            return projected
        known = np.isfinite(self.labelled.visible[:, 0])
        projected[known] = self.labelled.visible[known]
        return projected

    def _owners(self, result: CameraResult) -> Any:
        """Return (D,) the row of the label that each detection shows, whatever its class; -1: none."""
        assert result.detections is not None
        boxes = self.image_boxes(result.camera)
        seen = np.isfinite(boxes).all(axis=1)
        overlap = np.where(seen, geometry.iou(result.detections.xyxy, np.nan_to_num(boxes, nan=-1.0)), 0.0)
        return np.where(overlap.max(axis=1, initial=0) >= OWN, overlap.argmax(axis=1), -1)

    def _name(self) -> str:
        """Return the right name: of the accepted ones, that whose class is as large as the object."""
        accepted = sorted(self.truth.accepted[self.row])
        names = [name for name in accepted if name in self._known] or accepted
        sizes, own = self.result.config.objects.sizes, self.truth.boxes.size[self.row]

        def misfit(name: str) -> float:
            size = sizes.get(name)
            return float("inf") if size is None else float(np.abs(np.log(np.array(size[:3]) / own)).sum())

        return min(names, key=misfit)


class _IdealMemo(Memo):
    """Results of stages that are ideal at one object. The other results come from the frame's memo.

    Attributes:
        replaced: stages that were replaced.
        clusters: clusters before detections split them.
    """

    def __init__(self, missed: MissedObject, ideal: set[str]) -> None:
        super().__init__()
        self._missed, self._ideal = missed, ideal
        self.replaced: set[str] = set()
        self.clusters: Clusters | None = None

    def call(self, function: Callable[[*Ts], T], *args: *Ts) -> T:
        """Return the result of a stage."""
        missed, ideal, name = self._missed, self._ideal, getattr(function, "__name__", "")
        values = list[Any](args)
        if name == "claim_clusters" and CLUSTERING in ideal:
            # The fusion applies the size limit to the points in the frustum, too.
            values[-1] = values[-1].model_copy(update={"min_cluster_points": 1})
        result: Any = missed.memo.call(cast("Callable[..., Any]", function), *values)
        if name == "segment_ground" and GROUND in ideal:
            self.replaced.add(GROUND)
            result = missed.ideal_ground(values[0], result)
        if name == "cluster":
            if CLUSTERING in ideal:
                self.replaced.add(CLUSTERING)
                result = missed.ideal_clusters(values[0], result, values[1])
            self.clusters = result
        return cast(T, result)


def _single(detections: Detections, d: int) -> Detections:
    """Return one of the detections, without its mask."""
    return Detections(
        detections.xyxy[[d]],
        detections.score[[d]],
        detections.class_id[[d]],
        (detections.names[d],),
        detections.state[[d]],
        detections.suppressed_by[[d]],
        detections.overlap[[d]],
    )


def _with_object(
    objects: Objects, rows: list[int], box: Boxes3D, detections: Detections, d: int, camera: str, k: int
) -> Objects:
    """Return some of the objects, and one more."""
    return Objects(
        Boxes3D.joined([objects.boxes.chosen(rows), box]),
        (*(objects.names[j] for j in rows), detections.names[d]),
        np.append(objects.score[rows], detections.score[d]),
        np.append(objects.cluster[rows], np.int32(k)),
        (*(objects.camera[j] for j in rows), camera),
        np.append(objects.detection[rows], np.int32(d)),
    )


def missed_rows(result: FrameResult, labelled: LabelledFrame) -> list[int]:
    """Return the rows of the ground truth that had to be found, and were not."""
    if result.objects is None:
        return np.flatnonzero(labelled.truth.must).tolist()
    return np.flatnonzero(judge(result.objects, labelled.truth).missed).tolist()


def counts(
    labelled: LabelledFrame, judged: frozenset[str], config: Config, stages: Stages, memo: Memo
) -> tuple[int, int]:
    """Return the numbers of right and false objects with a configuration.

    Args:
        labelled: the frame.
        judged: names of which a false object counts.
        config: the configuration.
        stages: its stages.
        memo: results of stages on the frame.
    """
    objects = perceive(labelled.frame, config, stages, memo).objects
    if objects is None:
        return 0, 0
    matches = judge(objects, labelled.truth)
    counted = np.array([name.lower() in judged for name in objects.names], np.bool_)
    return int(matches.true.sum()), int((matches.false & counted).sum())
