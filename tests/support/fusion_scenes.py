"""Clusters, detections and a camera whose fusion is known."""

from __future__ import annotations

import numpy as np

from bevviz.config import ClusteringConfig, FusionConfig, ObjectsConfig
from bevviz.model.frame import F32, F64, Boxes3D, Camera, Intrinsics
from bevviz.model.geometry import apply, project
from bevviz.model.results import (
    CameraResult,
    Claims,
    Clusters,
    Detections,
    Splits,
)
from bevviz.stages.frustum_fusion import claim_clusters

K = np.array([[300.0, 0, 320], [0, 300, 180], [0, 0, 1]])
CAMERA = Intrinsics(640, 360, K)
CAMERA_FROM_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def slab(x: float, y: float, z: float, width: float, height: float, step: float = 0.1) -> F32:
    """Points of an upright surface that faces the sensor, x ahead, with its centre at y, z."""
    ys = np.arange(-width / 2, width / 2 + 1e-6, step) + y
    zs = np.arange(-height / 2, height / 2 + 1e-6, step) + z
    grid = np.stack(np.meshgrid([x], ys, zs, indexing="ij"), -1).reshape(-1, 3)
    return np.asarray(grid, np.float32)


def clusters_of(parts: list[F32], noise: F32 | None = None) -> tuple[F32, Clusters]:
    points = np.concatenate([*parts, np.zeros((0, 3), np.float32) if noise is None else noise])
    labels = np.full(len(points), -1, np.int32)
    count = np.array([len(p) for p in parts], np.int32)
    labels[: count.sum()] = np.repeat(np.arange(len(parts)), count)
    low = np.array([p.min(axis=0) for p in parts], np.float32).reshape(-1, 3)
    high = np.array([p.max(axis=0) for p in parts], np.float32).reshape(-1, 3)
    boxes = Boxes3D(np.asarray((low + high) / 2, np.float32), high - low, np.zeros(len(parts), np.float32))
    centroid = np.array([p.mean(axis=0) for p in parts], np.float32).reshape(-1, 3)
    return points, Clusters(labels, np.zeros(len(parts), np.int32), count, centroid, boxes, boxes)


def detections_of(boxes: list[F32], scores: list[float] | None = None, names: str = "person") -> Detections:
    count = len(boxes)
    return Detections(
        xyxy=np.array(boxes, np.float32).reshape(-1, 4),
        score=np.array(scores or [0.9 - 0.01 * i for i in range(count)], np.float32),
        class_id=np.zeros(count, np.int32),
        names=tuple(names.split() * count)[:count],
        state=np.zeros(count, np.int32),
        suppressed_by=np.full(count, -1, np.int32),
        overlap=np.zeros(count, np.float32),
    )


def silhouette(points: F32, across: float = 2.0, along: float = 2.0) -> F32:
    """Return the box that a perfect detector would give, with a margin."""
    margin = np.array([across, along])
    uv, _ = project(apply(CAMERA_FROM_LIDAR, points), CAMERA)
    box = np.concatenate([uv.min(axis=0) - margin, uv.max(axis=0) + margin])
    return np.asarray(np.clip(box, -0.5, [639.5, 359.5, 639.5, 359.5]), np.float32)


PERSON = slab(8, 0, -0.5, 0.6, 1.8)
CLUSTERING = ClusteringConfig()
ClaimResult = tuple[Clusters, tuple[Claims | None, ...], Splits]


def project_to_camera(
    points: F32, detections: Detections, turn: F64 = CAMERA_FROM_LIDAR, name: str = "front"
) -> CameraResult:
    """Project the points into a camera."""
    uv, depth = project(apply(turn, points), CAMERA)
    outside = ~((uv >= -0.5) & (uv < [CAMERA.width - 0.5, CAMERA.height - 0.5])).all(axis=1)
    uv[outside] = np.nan
    return CameraResult(Camera(name, None, CAMERA, turn, None), detections, None, uv, depth)


def claim(
    points: F32, clusters: Clusters, *cameras: CameraResult, config: FusionConfig | None = None
) -> ClaimResult:
    return claim_clusters(
        points, None, clusters, cameras, config or FusionConfig(), ObjectsConfig(), CLUSTERING
    )
