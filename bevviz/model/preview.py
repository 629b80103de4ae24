"""Preview of a frame's results in a notebook: the images with boxes, the view from above, and numbers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import cv2
import numpy as np

from bevviz.model.frame import F32, U8
from bevviz.support.html import render

HEIGHT = 320  # pixels of each picture
BOX_COLOR = (0, 220, 0)  # BGR
MAX_CAMERAS = 3  # pictures of cameras
MAX_OBJECTS = 12  # rows of the table


def preview(
    summary: str, pictures: Sequence[U8], objects: Sequence[Sequence[str]], failures: Sequence[str]
) -> str:
    """Return HTML without references to other files.

    Args:
        summary: the result in a line.
        pictures: BGR images.
        objects: name, score, distance and camera of each object, the nearest first.
        failures: sentences about the stages that failed.
    """
    more = len(objects) - MAX_OBJECTS
    return render(
        "preview.html",
        summary=summary,
        pictures=[_encoded(image) for image in pictures if image.size],
        objects=objects[:MAX_OBJECTS],
        notes=[*([f"and {more} more objects"] if more > 0 else []), *failures],
    )


def draw_boxes(image: U8, boxes: Iterable[tuple[F32, str]]) -> U8:
    """Return a copy of an image with boxes (x0, y0, x1, y1 in pixels) and the label of each."""
    image = image.copy()
    thickness = max(1, image.shape[0] // 300)
    for corners, label in boxes:
        x0, y0, x1, y1 = np.round(corners).astype(int).tolist()
        cv2.rectangle(image, (x0, y0), (x1, y1), BOX_COLOR, thickness)
        place = (x0, max(y0 - 2 * thickness, 12))
        cv2.putText(image, label, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5 * thickness, BOX_COLOR, thickness)
    return image


def _encoded(image: U8) -> bytes:
    """Return an image of limited height as JPEG."""
    height, width = image.shape[:2]
    if height > HEIGHT:
        size = max(1, width * HEIGHT // height), HEIGHT
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return cv2.imencode(".jpg", image)[1].tobytes()
