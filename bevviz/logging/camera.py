"""A camera: where it is, how it sees, its image, and over it detections and obstacle points."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import rerun as rr

from bevviz import geometry
from bevviz.colors import bins, class_color
from bevviz.frame import F64, CameraResult, Detections, DetectionState, Frame, Image, Intrinsics
from bevviz.logging import entities
from bevviz.logging.annotations import FAINT, depth_annotations
from bevviz.logging.pieces import CORNER, boxes2d, encode_image, scored, transform
from bevviz.logging.writer import Writer


def log_camera_looks(to: Writer, cameras: Iterable[str]) -> None:
    for camera in cameras:
        to.static(
            entities.projected(camera),
            depth_annotations(),
            rr.Points2D.from_fields(radii=rr.Radius.ui_points(1.5), show_labels=False, draw_order=10.0),
        )
        to.static(entities.detections(camera), rr.Boxes2D.from_fields(draw_order=30.0))
        if to.root:
            log_shared_image(to, camera)
        to.static(
            entities.weak(camera),
            rr.Boxes2D.from_fields(
                colors=[FAINT], radii=rr.Radius.ui_points(0.5), show_labels=False, draw_order=20.0
            ),
        )


def log_shared_image(to: Writer, camera: str) -> None:
    """What is under a root is drawn over the one image that there is."""
    for path in (entities.projected(camera), entities.detections(camera), entities.weak(camera)):
        to.static(path, over_image(camera))


def over_image(camera: str) -> rr.CoordinateFrame:
    """In the space of the camera's image, wherever the entity is."""
    return rr.CoordinateFrame(f"tf#{entities.image(camera)}")


def camera_pose(frame: Frame, result: CameraResult) -> F64 | None:
    """(4, 4) ``world_from_camera``, None where nothing says."""
    camera = result.camera
    if camera.world_from_camera is not None:
        return camera.world_from_camera
    if camera.camera_from_points is not None:
        return frame.pose @ geometry.inverse(camera.camera_from_points)
    return None


def log_camera(to: Writer, frame: Frame, result: CameraResult, quality: int) -> None:
    """Pose and image; the intrinsics are static, see ``log_intrinsics``."""
    camera, world_from_camera = result.camera, camera_pose(frame, result)
    if world_from_camera is not None:
        to.put(entities.sensor(camera.name), transform(world_from_camera))
    if camera.image is not None:
        log_image(to, camera.name, camera.image, quality)


def log_intrinsics(to: Writer, name: str, intrinsics: Intrinsics) -> None:
    """Static, so that a viewer that joins late has it."""
    to.static(
        entities.sensor(name),
        rr.Pinhole(
            image_from_camera=intrinsics.K + np.array([[0, 0, CORNER], [0, 0, CORNER], [0, 0, 0]]),
            resolution=[intrinsics.width, intrinsics.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=1.5,
        ),
    )


def log_image(to: Writer, name: str, image: Image, quality: int) -> None:
    """Once for each image: a camera may be slower than the LiDAR."""
    path = entities.image(name)
    if to.keep(path, image.stamp):
        return
    if image.clip is not None and to.streams_video:
        to.video(path, image.clip)
    else:
        to.put(path, encode_image(image, quality))


def log_detections(to: Writer, name: str, detections: Detections) -> None:
    """Those that went on to the fusion in the colour of their class, the others faint."""
    is_kept = detections.kept
    for path, rows in (
        (entities.detections(name), np.flatnonzero(is_kept)),
        (entities.weak(name), np.flatnonzero(~is_kept)),
    ):
        if len(rows) == 0:
            continue
        names = [detections.names[d] for d in rows]
        to.put(
            path,
            boxes2d(
                detections.xyxy[rows],
                scored(names, detections.score[rows]),
                colors=[class_color(n) for n in names] if path == entities.detections(name) else None,
                class_ids=[entities.DETECTION_CLASS[DetectionState(s)] for s in detections.state[rows]],
            ),
        )


def log_projected_points(to: Writer, result: CameraResult) -> None:
    """The obstacle points in the image, by depth."""
    if result.uv is None or result.depth is None:
        return
    seen = np.isfinite(result.uv[:, 0])
    if seen.any():
        depth = bins(result.depth[seen], 0, entities.DEPTH_RANGE, entities.DEPTH_BINS)
        to.put(entities.projected(result.camera.name), rr.Points2D(result.uv[seen] + CORNER, class_ids=depth))
