"""Resolve a click in a view to the selection that the user asks about."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bevviz.model import geometry
from bevviz.model.frame import F32, Camera
from bevviz.model.results import CameraResult, FrameResult, Tracks
from bevviz.recording import entities
from bevviz.recording.boxes import confirmed_rows
from bevviz.recording.images import camera_pose
from bevviz.recording.labels import box_row
from bevviz.recording.opinions import MISSED, opinion_outlines_in_bev, opinion_outlines_in_image
from bevviz.recording.primitives import CORNER
from bevviz.why.selection import Selection
from bevviz.why.subject import points_in_box, single_box

NEAR_BOX = 0.1  # metres from a box that a click on its edge may be off


def select_click(
    result: FrameResult, tracks: Tracks | None, path: str, instance: int | None, position: Sequence[float]
) -> Selection | None:
    """Return the object or place at a click in a view; None: nothing that can be explained.

    Args:
        result: result of the shown frame.
        tracks: tracks of the whole run in that frame.
        path: entity that was clicked.
        instance: row of the clicked box or point; None: the whole entity.
        position: 2 pixels in a view of an image, or 3 metres of ``Frame.points_frame``, which 3D views show.
    """
    row, path = -1 if instance is None else instance, entities.boxes_of(path)
    if hit := _object_with_opinion(result, path, row):
        return hit
    for camera in result.cameras:
        if hit := _in_image(camera, path, row, position):
            return hit
        if path == entities.SENSOR.path(camera.camera.name):
            return None  # A line of its frustum is nowhere in the scene.
    if tracks is not None and row >= 0 and (hit := _drawn_track(result, tracks, path, row)):
        return hit
    if path == entities.BEV or path.startswith(f"{entities.BEV}/"):
        return _cell(result, position) if len(position) >= 2 else None
    if hit := _in_space(result, path, row):
        return hit
    if len(position) != 3:
        return None
    place = np.array(position, np.float32)
    return _box_at(result, place) or _point(place)


def _object_with_opinion(result: FrameResult, path: str, row: int) -> Selection | None:
    """Return an object with an opinion of the cameras, drawn over an image or the bird's-eye view."""
    views = [opinion_outlines_in_bev(result)] if path.startswith(f"{entities.BEV}/") else []
    views += [
        opinion_outlines_in_image(result, camera.camera)
        for camera in result.cameras
        if path.startswith(f"{entities.IMAGE.path(camera.camera.name)}/")
    ]
    for view in views:
        if path in view and 0 <= (row := box_row(row, len(view[path].rows))) < len(view[path].rows):
            object_row = view[path].rows[row]
            is_missed = view[path].opinion == MISSED
            return _fused_detection(result, object_row) if is_missed else Selection(object=object_row)
    return None


def _fused_detection(result: FrameResult, row: int) -> Selection | None:
    """Return the detection of an object of our fusion, where the objects are not ours."""
    if result.opinions is None:
        return None
    fused = result.opinions.fused
    if (row := box_row(row, len(fused))) >= len(fused):
        return None
    return Selection(detection=int(fused.detection[row]), camera=fused.camera[row])


def _in_image(camera: CameraResult, path: str, row: int, position: Sequence[float]) -> Selection | None:
    """Return a detection or pixel of a camera."""
    name = camera.camera.name
    if camera.detections is not None and row >= 0:
        kept = camera.detections.kept
        for where, rows in ((entities.DETECTIONS.path(name), kept), (entities.WEAK.path(name), ~kept)):
            listed = np.flatnonzero(rows)
            if path == where and (row := box_row(row, len(listed))) < len(listed):
                return Selection(detection=int(listed[row]), camera=name)
    inside = path in (entities.SENSOR.path(name), entities.IMAGE.path(name)) or path.startswith(
        (f"{entities.IMAGE.path(name)}/", entities.WHY_PART.path(f"{name}/"))
    )
    if inside and len(position) == 3:  # The image also stands in front of its camera in 3D views.
        position = _pixel(camera.camera, position)
    if not inside or len(position) != 2:
        return None
    return Selection(box=(position[0] - CORNER, position[1] - CORNER), camera=name)


def _pixel(camera: Camera, position: Sequence[float]) -> Sequence[float]:
    """Return the pixel of a camera at a place in Frame.points_frame; empty: it is outside the image."""
    if camera.camera_from_points is None or camera.intrinsics is None:
        return ()
    points = geometry.apply(camera.camera_from_points, np.array([position]))
    pixel = geometry.project(points, camera.intrinsics)[0][0] + CORNER
    inside = (pixel >= 0).all() and (pixel <= (camera.intrinsics.width, camera.intrinsics.height)).all()
    return tuple(map(float, pixel)) if inside else ()


def _cell(result: FrameResult, position: Sequence[float]) -> Selection | None:
    """Return a cell of the bird's-eye view."""
    if result.bev is None:
        return None
    column, row = (int(np.floor(v)) for v in position[:2])
    height, width = result.bev.image.shape[:2]
    return Selection(cell=(row, column)) if 0 <= row < height and 0 <= column < width else None


def _in_space(result: FrameResult, path: str, row: int) -> Selection | None:
    """Return the object, cluster or point that was clicked in a 3D view."""
    frame = result.frame
    if row < 0:
        return None
    if path == entities.POINTS.path(frame.lidar) and len(frame.clouds) <= 1 and row < len(frame.points):
        return _point(frame.points[row])
    if path == entities.FUSED and (objects := result.objects) is not None:
        row = box_row(row, len(objects))
        return Selection(object=row) if row < len(objects) else None
    if path == entities.MEASURED and (objects := result.objects) is not None and objects.measured is not None:
        drawn = np.flatnonzero((objects.measured.size != objects.boxes.size).any(axis=1))
        row = box_row(row, len(drawn))
        return Selection(object=int(drawn[row])) if row < len(drawn) else None
    if path == entities.FUSION:
        return _fused_detection(result, row)
    if path == entities.FRUSTUMS:
        return _frustum(result, row)
    if path == entities.TRUTH and frame.truth is not None and row < len(frame.truth.boxes):
        return Selection(truth=row)
    if path == entities.SET_ASIDE.path(frame.lidar) and result.clusters is not None:
        aside = np.flatnonzero(~result.clusters.kept)
        return Selection(cluster=int(aside[row])) if row < len(aside) else None
    return None


def _frustum(result: FrameResult, row: int) -> Selection | None:
    """Return the detection of a frustum. Those of all cameras are drawn in one entity."""
    for camera in result.cameras:
        detections = camera.detections
        has_pose = camera_pose(result.frame, camera) is not None and camera.camera.intrinsics is not None
        if detections is None or camera.fusion is None or not has_pose:
            continue
        kept = np.flatnonzero(detections.kept)
        if row < len(kept):
            return Selection(detection=int(kept[row]), camera=camera.camera.name)
        row -= len(kept)
    return None


def _drawn_track(result: FrameResult, tracks: Tracks, path: str, row: int) -> Selection | None:
    """Return the track that a box, a trail or an outline in the bird's-eye view shows."""
    rows = confirmed_rows(tracks)
    named = tracks.object[rows] >= 0
    listed = {
        entities.TRACKS: rows[named],
        entities.UNSEEN: rows[~named],
        entities.TRAILS: rows,
        entities.OVERLAY.path("trails"): rows,
        entities.OVERLAY.path("tracks"): rows,
    }.get(path, rows[:0])
    return _track(result, tracks, int(listed[row])) if row < len(listed) else None


def _track(result: FrameResult, tracks: Tracks, row: int) -> Selection | None:
    """Return the cluster of a track, or the place where the track is expected."""
    if tracks.cluster[row] >= 0:
        return Selection(cluster=int(tracks.cluster[row]))
    center = tracks.boxes.center[row]
    return _point(
        geometry.apply(geometry.inverse(result.frame.pose), center[None])[0] if tracks.absolute else center
    )


def _box_at(result: FrameResult, place: F32) -> Selection | None:
    """Return the object, or else the cluster, whose box holds a place in Frame.points_frame."""
    objects, clusters = result.objects, result.clusters
    for kind, boxes in (
        ("object", None if objects is None else objects.boxes),
        ("object", None if objects is None else objects.measured),
        ("cluster", None if clusters is None else clusters.boxes(result.config.clustering)),
    ):
        for row in range(0 if boxes is None else len(boxes)):
            if boxes is not None and points_in_box(single_box(boxes, row), place[None], NEAR_BOX).any():
                return Selection.of(kind, row)
    return None


def _point(xyz: np.ndarray[tuple[int], np.dtype[np.floating]]) -> Selection:
    """Return a point in Frame.points_frame."""
    x, y, z = map(float, xyz)
    return Selection(point=(x, y, z))
