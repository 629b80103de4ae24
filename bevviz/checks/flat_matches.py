"""Matches of image boxes with the clusters of a 2D LiDAR, by both methods of the fusion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bevviz.model.frame import I32
from bevviz.model.results import CameraResult, Decision, FrameResult
from bevviz.stages.fusion import fuse

MOST = 50  # detections that are tried


@dataclass(slots=True)
class FlatMatches:
    """Matches of detections with the clusters of a flat cloud, by the method in use and by the other one."""

    lidar: str = ""
    detections: int = 0
    matched: int = 0
    by_centroid: int = 0

    def add(self, result: FrameResult, camera: CameraResult) -> None:
        """Match the detections of an image by the other method, too."""
        fusion, detections, clusters, sensor = (
            camera.fusion,
            camera.detections,
            result.clusters,
            camera.camera,
        )
        config = result.config.fusion
        if (
            fusion is None
            or detections is None
            or clusters is None
            or camera.uv is None
            or camera.depth is None
        ):
            return
        if config.method != "frustum" or self.detections >= MOST or not detections.kept.any():
            return
        if sensor.intrinsics is None or sensor.camera_from_points is None:
            return
        centroid = config.model_copy(update={"method": "centroid"})
        pose = sensor.camera_from_points
        uv, depth = camera.uv, camera.depth
        other = fuse(uv, depth, clusters, detections, sensor.intrinsics, pose, centroid)
        self.lidar = result.frame.lidar
        self.detections += int(detections.kept.sum())
        self.matched += _matches(fusion.detection_decision)
        self.by_centroid += _matches(other.detection_decision)


def _matches(decision: I32) -> int:
    return int(np.count_nonzero(np.equal(decision, Decision.MATCHED)))
