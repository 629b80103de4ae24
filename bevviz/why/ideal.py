"""Ideal results of single stages at missed objects, and which of them bring an object back.

A stage is the cause of a miss if its ideal result alone brings the object back. The ideal comes from the
ground truth: the object's points are no ground, they are one cluster of their own, a detection frames it, or
the fusion matches both.
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import replace

import numpy as np

from bevviz.config import Config
from bevviz.evaluate.matching import image_boxes_of
from bevviz.model import geometry
from bevviz.model.frame import F32, I64, Boxes3D, Camera
from bevviz.model.results import (
    CameraResult,
    Claims,
    Clusters,
    ClusterState,
    Detections,
    DetectionState,
    Ground,
    Objects,
    Voxels,
)
from bevviz.pipeline.stage_log import Memo
from bevviz.stages.clustering import describe_clusters
from bevviz.stages.frustum_fusion import claim_clusters
from bevviz.why.frame_index import FEW, FrameIndex
from bevviz.why.subject import LINK

STAGES = ("ground", "clustering", "detector", "fusion")  # in the order in which they run
SURE = 0.99  # score of an ideal detection
NO_LIMITS = {"min_iou": 0.0, "min_points": 1, "min_rating": 0.0, "max_depth": 1e4}  # of the fusion

StageSet = tuple[str, ...]  # stages whose ideal results are needed together, in their order


class IdealStages:
    """Stage edits that replace the results of some stages at some objects by the ideal ones.

    Args:
        traces: index of the frame's result.
        rows: objects of the ground truth.
        stages: stages to replace.
        memo: shared results of the frame's stages; each ideal result is made once.
    """

    def __init__(self, traces: FrameIndex, rows: tuple[int, ...], stages: StageSet, memo: Memo) -> None:
        self._traces, self._rows, self._stages, self._memo = traces, rows, frozenset(stages), memo

    def ground(self, voxels: Voxels, ground: Ground) -> Ground:
        """Return the ground without the points of the objects."""
        if "ground" in self._stages:
            ground = self._memo.call(_without_objects, self._traces, self._rows, voxels, ground)
        self._voxels, self._ground = voxels, ground
        return ground

    def clusters(self, obstacles: F32, clusters: Clusters) -> Clusters:
        """Return the clusters with one more for each object, which holds all of its obstacle points."""
        self._own = self._memo.call(_obstacles_of, self._traces, self._rows, self._voxels, self._ground)
        if "clustering" in self._stages:
            clusters = self._memo.call(_with_own_clusters, self._traces, self._own, obstacles, clusters)
        self._clusters = clusters
        return clusters

    def detections(self, camera: Camera, detections: Detections) -> Detections:
        """Return the detections with an ideal one of each object in the image."""
        if "detector" not in self._stages:
            return detections
        return self._memo.call(_with_own_detections, self._traces, self._rows, camera, detections)

    def objects(self, obstacles: F32, cameras: Sequence[CameraResult], objects: Objects) -> Objects:
        """Return the objects with one for each object that has a detection and points.

        Its detection gets the points of the object that the clustering left to the fusion: those of its
        largest cluster, or, where detections split clusters, those of all kept clusters and the noise.
        """
        for row, own in zip(self._rows if "fusion" in self._stages else (), self._own, strict=False):
            for camera in cameras:
                detection = self._own_detection(camera, row)
                if detection >= 0 and (box := self._fused_box(obstacles, own, camera, detection)) is not None:
                    objects = _with_object(objects, camera, detection, box)
                    break
        return objects

    def _own_detection(self, camera: CameraResult, row: int) -> int:
        """Return the kept detection of an object with a right class, -1: none."""
        detections, subject, truth = (
            camera.detections,
            self._traces.truth[row],
            self._traces.labels_in_evaluate,
        )
        if detections is None or camera.uv is None or truth is None:
            return -1
        overlap = np.nan_to_num(geometry.iou(image_boxes_of(truth, camera.camera)[[row]], detections.xyxy)[0])
        accepted = np.array([subject.accepts(name) for name in detections.names], np.bool_)
        overlap[~detections.kept | ~accepted] = 0
        return int(overlap.argmax()) if overlap.max(initial=0.0) >= LINK else -1

    def _fused_box(self, obstacles: F32, own: I64, camera: CameraResult, detection: int) -> Boxes3D | None:
        """Return the box that the fusion fits to an object's points without its limits; None: none."""
        config, clusters = self._traces.result.config, self._clusters
        labels = clusters.labels[own]
        if config.fusion.method == "frustum" and config.fusion.split:
            rows = own[np.append(clusters.kept, True)[labels]]
            return self._claimed_box(obstacles, rows, camera, detection) if len(rows) >= FEW else None
        kept = labels[np.append(clusters.kept, False)[labels]]
        return (
            clusters.boxes(config.clustering).chosen([int(np.bincount(kept).argmax())]) if len(kept) else None
        )

    def _claimed_box(self, obstacles: F32, rows: I64, camera: CameraResult, detection: int) -> Boxes3D | None:
        """Return the box that a detection gets if it may claim some points, and no others."""
        detections = camera.detections
        assert detections is not None and camera.uv is not None and camera.depth is not None
        one = slice(detection, detection + 1)
        alone = Detections.of_boxes(detections.xyxy[one], detections.score[one], detections.names[one])
        asked = CameraResult(camera.camera, alone, None, camera.uv[rows], camera.depth[rows])
        height = self._ground.height.compress(~self._ground.mask)[rows]
        config = ideal_config(self._traces.result.config, self._stages)
        claims = claim_freely(obstacles[rows], height, asked, config)
        return None if claims is None or claims.cluster[0] < 0 else claims.boxes.chosen([0])


def claim_freely(points: F32, height: F32 | None, camera: CameraResult, config: Config) -> Claims | None:
    """Return what the detections of a camera claim of some points without the limits of the fusion.

    Args:
        points: (N, 3) points in no cluster.
        height: (N,) metres above the local ground. None: unknown.
        camera: the detections, and the points in the image.
        config: configuration of the fusion.
    """
    noise = describe_clusters(points, np.full(len(points), -1, np.int32), config.clustering)
    fusion = config.fusion.model_copy(update=NO_LIMITS)
    _, (claims,), _ = claim_clusters(
        points, height, noise, (camera,), fusion, config.objects, config.clustering
    )
    return claims


def ideal_config(config: Config, stages: Container[str]) -> Config:
    """Return the configuration of a run with ideal stages: no limit removes an ideal cluster."""
    if "clustering" not in stages:
        return config
    clustering = config.clustering.model_copy(update={"min_cluster_points": 1})
    return config.model_copy(update={"clustering": clustering})


def _with_own_detections(
    traces: FrameIndex, rows: tuple[int, ...], camera: Camera, detections: Detections
) -> Detections:
    """Return the detections with an ideal one of each object in the image, in place of its own ones."""
    truth = traces.labels_in_evaluate
    assert truth is not None
    boxes = image_boxes_of(truth, camera)
    shown = [row for row in rows if np.isfinite(boxes[row]).all()]
    result, state = traces.result.camera(camera.name), detections.state.copy()
    if result is not None and result.detections is not None and len(result.detections) == len(detections):
        state[np.isin(traces.owners(result), shown)] = DetectionState.BELOW_THRESHOLD
    names = [_name(traces, row, detections) for row in shown]
    own = Detections.of_boxes(boxes[shown].astype(np.float32), np.full(len(shown), SURE, np.float32), names)
    return Detections.joined([replace(detections, state=state), own])


def _name(traces: FrameIndex, row: int, detections: Detections) -> str:
    """Return a class name that is right for an object, one that the detector uses if possible."""
    subject = traces.truth[row]
    known = (name for name in (*detections.names, *traces.classes) if subject.accepts(name))
    return next(known, None) or min(subject.accepted, default=subject.label.lower())


def _with_object(objects: Objects, camera: CameraResult, detection: int, box: Boxes3D) -> Objects:
    """Return the objects with one more, which takes the place of another one of its detection."""
    detections, name = camera.detections, camera.camera.name
    assert detections is not None
    sources = zip(objects.camera, objects.detection.tolist(), strict=True)
    rest = [row for row, source in enumerate(sources) if source != (name, detection)]
    return Objects(
        boxes=Boxes3D.joined([objects.boxes.chosen(rest), box]),
        names=(*(objects.names[row] for row in rest), detections.names[detection]),
        score=np.append(objects.score[rest], detections.score[detection]),
        cluster=np.append(objects.cluster[rest], np.int32(-1)),
        camera=(*(objects.camera[row] for row in rest), name),
        detection=np.append(objects.detection[rest], np.int32(detection)),
    )


def _voxels_of(traces: FrameIndex, row: int, voxels: Voxels) -> I64:
    """Return the voxels of an object."""
    rows: I64 = np.unique(voxels.inverse[traces.place(traces.truth[row])]).astype(np.int64)
    return rows


def _without_objects(traces: FrameIndex, rows: tuple[int, ...], voxels: Voxels, ground: Ground) -> Ground:
    """Return a ground without the points of some objects."""
    mask = ground.mask.copy()
    for row in rows:
        mask[_voxels_of(traces, row, voxels)] = False
    return replace(ground, mask=mask)


def _obstacles_of(
    traces: FrameIndex, rows: tuple[int, ...], voxels: Voxels, ground: Ground
) -> tuple[I64, ...]:
    """Return the obstacle points of some objects."""
    obstacle = np.where(ground.mask, -1, np.cumsum(~ground.mask) - 1)
    own = (obstacle[_voxels_of(traces, row, voxels)] for row in rows)
    return tuple(points[points >= 0] for points in own)


def _with_own_clusters(
    traces: FrameIndex, own: tuple[I64, ...], obstacles: F32, clusters: Clusters
) -> Clusters:
    """Return the clusters with one more for each object, which is kept whatever its size."""
    labels, first = clusters.labels.copy(), len(clusters)
    for label, rows in enumerate((rows for rows in own if len(rows) >= FEW), first):
        labels[rows] = label
    used, inverse = np.unique(labels[labels >= 0], return_inverse=True)
    labels[labels >= 0] = inverse.astype(np.int32)
    described = describe_clusters(obstacles, labels, traces.result.config.clustering)
    state = described.state.copy()
    state[used >= first] = ClusterState.KEPT
    return replace(described, state=state)


def takes_from_ground(traces: FrameIndex, row: int) -> bool:
    """Return whether a point of an object was taken for ground. Else the ground is ideal already."""
    voxels, ground = traces.result.voxels, traces.result.ground
    if voxels is None or ground is None:
        return False
    return bool(ground.mask[_voxels_of(traces, row, voxels)].any())
