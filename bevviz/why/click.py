"""Select what a click in a view is on: the row that the item shows, or the place."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bevviz.model import geometry
from bevviz.model.frame import F32, Camera
from bevviz.model.results import FrameResult, Tracks
from bevviz.recording import entities
from bevviz.recording.addresses import Address, EntityRows
from bevviz.recording.primitives import CORNER
from bevviz.why.selection import Selection
from bevviz.why.subject import points_in_box

NEAR_BOX = 0.1  # metres from a box that a click on its edge may be off


def select_click(
    result: FrameResult,
    tracks: Tracks | None,
    rows: EntityRows,
    path: str,
    instance: int | None,
    position: Sequence[float],
) -> Selection | None:
    """Return the object or place at a click in a view; None: nothing that can be explained.

    Args:
        result: result of the shown frame.
        tracks: tracks of the whole run in that frame.
        rows: rows behind the entities of the frame, as its logger noted them.
        path: entity that was clicked.
        instance: row of the clicked box or point; None: the whole entity.
        position: 2 pixels in a view of an image, or 3 metres of ``Frame.points_frame``, which 3D views show.
    """
    address = rows[path].at(instance) if instance is not None and path in rows else None
    if address is not None:
        return _at_address(result, tracks, address)
    for camera in result.cameras:
        name = camera.camera.name
        image, is_camera = entities.IMAGE.path(name), path == entities.SENSOR.path(name)
        below = f"{image}/", entities.WHY_PART.path(f"{name}/")
        if is_camera or path == image or path.startswith(below):
            # The image also stands in front of its camera in 3D views.
            pixel = _pixel(camera.camera, position) if len(position) == 3 else position
            if len(pixel) == 2:
                return Selection(box=(pixel[0] - CORNER, pixel[1] - CORNER), camera=name)
        if is_camera:
            return None  # A line of its frustum is nowhere in the scene.
    if path == entities.BEV or path.startswith(f"{entities.BEV}/"):
        return _cell(result, position) if len(position) >= 2 else None
    if len(position) != 3:
        return None
    place = np.array(position, np.float32)
    return _box_at(result, place) or _point(place)


def _at_address(result: FrameResult, tracks: Tracks | None, address: Address) -> Selection | None:
    """Return the selection of a row. That of a track is its cluster, or the place where it is expected."""
    if address.table == "point":
        return _point(result.frame.points[address.row])
    if address.table != "track":
        return Selection.of(address.table, address.row, address.camera)
    if tracks is None or address.row not in tracks.id:
        return None
    row = int(np.flatnonzero(tracks.id == address.row)[0])
    if tracks.cluster[row] >= 0:
        return Selection(cluster=int(tracks.cluster[row]))
    center = tracks.boxes.center[row]
    return _point(
        geometry.apply(geometry.inverse(result.frame.pose), center[None])[0] if tracks.absolute else center
    )


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


def _box_at(result: FrameResult, place: F32) -> Selection | None:
    """Return the object, or else the cluster, whose box holds a place in Frame.points_frame."""
    objects, clusters = result.objects, result.clusters
    for kind, boxes in (
        ("object", None if objects is None else objects.boxes),
        ("object", None if objects is None else objects.measured),
        ("cluster", None if clusters is None else clusters.boxes(result.config.clustering)),
    ):
        for row in range(0 if boxes is None else len(boxes)):
            if boxes is not None and points_in_box(boxes.chosen([row]), place[None], NEAR_BOX).any():
                return Selection.of(kind, row)
    return None


def _point(xyz: np.ndarray[tuple[int], np.dtype[np.floating]]) -> Selection:
    """Return a point in Frame.points_frame."""
    x, y, z = map(float, xyz)
    return Selection(point=(x, y, z))
