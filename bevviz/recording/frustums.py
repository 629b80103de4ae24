"""Log the frustum of each detection, clipped to the depth of its match."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr

from bevviz.model import geometry
from bevviz.model.colors import class_color
from bevviz.model.frame import F32, Frame
from bevviz.model.results import CameraResult, Decision
from bevviz.recording import entities
from bevviz.recording.camera import camera_pose
from bevviz.recording.primitives import edges, scored
from bevviz.recording.writer import Writer

_NEAR = 0.3  # metres from the camera
_UNMATCHED_COLOR = (80, 80, 92)
_UNMATCHED_DEPTH = 20.0  # metres to the far end of an unmatched detection's frustum


def log_frustums(to: Writer, frame: Frame, cameras: Sequence[CameraResult]) -> None:
    """Log the frustum of every kept detection in the fixed frame. Unmatched ones are grey."""
    strips: list[F32] = []
    colors: list[tuple[int, ...]] = []
    labels: list[str] = []
    for camera in cameras:
        pose, intrinsics = camera_pose(frame, camera), camera.camera.intrinsics
        detections, fusion = camera.detections, camera.fusion
        if pose is None or intrinsics is None or detections is None or fusion is None:
            continue
        rows = np.flatnonzero(detections.kept)
        if len(rows) == 0:
            continue
        far = np.full(len(detections), _UNMATCHED_DEPTH, np.float32)
        matched = fusion.detection_decision == Decision.MATCHED
        pairs = fusion.pairs
        is_best = matched[pairs.detection] & (fusion.detection_cluster[pairs.detection] == pairs.cluster)
        far[pairs.detection[is_best]] = pairs.depth[is_best]
        near = np.full(len(rows), _NEAR, np.float32)
        corners = geometry.frustum(detections.xyxy[rows], intrinsics, near, far[rows])
        corners = geometry.apply(pose, corners.reshape(-1, 3)).reshape(-1, 8, 3)
        names = [detections.names[row] for row in rows]
        strips.append(edges(corners))
        colors += [
            class_color(name) if is_matched else _UNMATCHED_COLOR
            for name, is_matched in zip(names, matched[rows], strict=True)
        ]
        labels += scored(names, detections.score[rows])
    if strips:
        to.put(
            entities.FRUSTUMS,
            rr.LineStrips3D(
                np.concatenate(strips),
                colors=colors,
                labels=labels,
                radii=rr.Radius.ui_points(1.0),
                show_labels=False,
            ),
        )
