"""Preview of a frame's results in a notebook: the images with boxes, the view from above, and numbers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import cv2
import numpy as np

from bevviz.model.frame import U8
from bevviz.support.html import render

if TYPE_CHECKING:
    from bevviz.model.results import CameraResult, FrameResult

HEIGHT = 320  # pixels of each picture
BOX_COLOR = (0, 220, 0)  # BGR
MAX_CAMERAS = 3  # pictures of cameras
MAX_OBJECTS = 12  # rows of the table


def preview(result: FrameResult) -> str:
    """Return HTML without references to other files."""
    cameras = [camera for camera in result.cameras if camera.camera.image is not None]
    images = [_with_boxes(camera) for camera in cameras[:MAX_CAMERAS]]
    images += [result.bev.image] if result.bev is not None else []
    more = 0 if result.objects is None else len(result.objects) - MAX_OBJECTS
    return render(
        "preview.html",
        summary=repr(result)[1:-1],
        pictures=[_encoded(image) for image in images if image.size],
        objects=list(_rows(result)),
        notes=[
            *([f"and {more} more objects"] if more > 0 else []),
            *(f"{failure.stage} failed: {failure.reason}" for failure in result.failures),
        ],
    )


def _with_boxes(camera: CameraResult) -> U8:
    """Return the image of a camera with the kept detections."""
    assert camera.camera.image is not None
    image = camera.camera.image.bgr.copy()
    detections = camera.detections
    if detections is None:
        return image
    thickness = max(1, image.shape[0] // 300)
    for row in np.flatnonzero(detections.kept):
        x0, y0, x1, y1 = np.round(detections.xyxy[row]).astype(int).tolist()
        cv2.rectangle(image, (x0, y0), (x1, y1), BOX_COLOR, thickness)
        text = f"{detections.names[row]} {detections.score[row]:.2f}"
        place = (x0, max(y0 - 2 * thickness, 12))
        cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5 * thickness, BOX_COLOR, thickness)
    return image


def _encoded(image: U8) -> bytes:
    """Return an image of limited height as JPEG."""
    height, width = image.shape[:2]
    if height > HEIGHT:
        size = max(1, width * HEIGHT // height), HEIGHT
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return cv2.imencode(".jpg", image)[1].tobytes()


def _rows(result: FrameResult) -> Iterator[tuple[str, ...]]:
    """Yield name, score, distance and camera of each of the nearest objects."""
    objects = result.objects
    if objects is None:
        return
    distance = np.hypot(objects.boxes.center[:, 0], objects.boxes.center[:, 1])
    for row in np.argsort(distance)[:MAX_OBJECTS].tolist():
        name, camera = objects.names[row], objects.camera[row]
        yield name, f"{objects.score[row]:.2f}", f"{distance[row]:.1f} m", camera
