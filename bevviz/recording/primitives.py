"""Building blocks of logged data: poses, lines, images, documents, colours of class ids."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from bevviz.model import geometry
from bevviz.model.frame import F32, F64, U8, Image
from bevviz.model.results import ClusterState, DetectionState
from bevviz.recording import entities
from bevviz.recording.components import Components
from bevviz.recording.entities import ClassId
from bevviz.recording.writer import Writer
from bevviz.support.colors import CONTEXT, FAINT, GROUND, UNNAMED, turbo
from bevviz.support.numba_kernel import kernel

CORNER = 0.5  # pixels: Rerun counts from the corner of the first pixel, bevviz from its centre


def transform(world_from_entity: F64) -> Components:
    """Convert a (4, 4) pose to a Rerun transform."""
    translation, quaternion = world_from_entity[:3, 3], geometry.quaternion(world_from_entity)
    return Components(rr.Transform3D, {"translation": translation, "quaternion": quaternion})


def strips(points: F32, lengths: NDArray[np.integer]) -> pa.Array:
    """Convert lines to Rerun's Arrow layout in one piece, which is faster than line by line.

    Args:
        points: (N, 2) or (N, 3) points, one line after the other.
        lengths: number of points in each line.
    """
    point = pa.list_(pa.field("item", pa.float32(), nullable=False), points.shape[1])
    line = pa.list_(pa.field("item", point, nullable=False))
    offsets = pa.array(np.append(0, np.cumsum(lengths)).astype(np.int32))
    values = pa.FixedSizeListArray.from_arrays(pa.array(points.ravel()), type=point)
    return pa.ListArray.from_arrays(offsets, values, type=line)


def scored(names: Iterable[str], scores: Iterable[Any]) -> list[str]:
    """Format each name with its score, as in ``person 0.90``."""
    numbers = scores.tolist() if isinstance(scores, np.ndarray) else scores  # Python's are formatted faster
    return [f"{name} {score:.2f}" for name, score in zip(names, numbers, strict=True)]


def document(text: str) -> Components:
    """Return a Markdown page."""
    return Components(rr.TextDocument, {"text": [text], "media_type": ["text/markdown"]})


def encode_image(image: Image, quality: int) -> rr.EncodedImage:
    """Return the image as it came if it is encoded already, else as JPEG of that quality."""
    if image.encoded is not None:
        return rr.EncodedImage(contents=image.encoded, media_type=image.media_type or None)
    return jpeg(image.bgr, quality)


def jpeg(bgr: U8, quality: int) -> rr.EncodedImage:
    """Encode an image as JPEG."""
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return rr.EncodedImage(contents=blob(data), media_type="image/jpeg")


def png(bgr: U8) -> rr.EncodedImage:
    """Encode an image as PNG with fast compression."""
    _, data = cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return rr.EncodedImage(contents=blob(data), media_type="image/png")


def blob(data: U8) -> pa.Array:
    """Convert (N,) bytes to Rerun's Arrow layout without the copies that Rerun would make."""
    byte_list = pa.list_(pa.field("item", pa.uint8(), nullable=False))
    return pa.ListArray.from_arrays(pa.array([0, len(data)], pa.int32()), pa.array(data), type=byte_list)


@kernel
def rounded(points: F32, scale: float) -> F32:
    """Round points to the nearest 1 / scale in one pass. It runs on every frame."""
    result, factor = np.empty_like(points), np.float32(scale)
    for i in range(len(points)):
        for axis in range(3):
            result[i, axis] = np.rint(points[i, axis] * factor) / factor
    return result


# --- class ids ---------------------------------------------------------------------------------


def log_world(to: Writer) -> None:
    """Log the axes of the fixed frame, and the names and colours of class ids. Both are static."""
    to.static(entities.WORLD, rr.ViewCoordinates.FLU, class_annotations())
    to.static(entities.BEV, class_annotations())


def class_annotations() -> rr.AnnotationContext:
    """Return the names and colours of the class ids of points and boxes."""
    classes: list[tuple[int, str, tuple[int, ...]]] = [
        (entities.DETECTION_CLASS[DetectionState.KEPT], "kept", (255, 255, 255)),
        (entities.DETECTION_CLASS[DetectionState.BELOW_THRESHOLD], "below threshold", FAINT),
        (entities.DETECTION_CLASS[DetectionState.SUPPRESSED], "suppressed", FAINT),
        (entities.CLUSTER_CLASS[ClusterState.TOO_SMALL], "too small", UNNAMED),
        (entities.CLUSTER_CLASS[ClusterState.TOO_LARGE], "too large", UNNAMED),
    ]
    return rr.AnnotationContext(
        [
            *point_classes(),
            *(rr.AnnotationInfo(id=i, label=label, color=color) for i, label, color in classes),
            *(rr.AnnotationInfo(id=ClassId.TRACK + i, color=UNNAMED) for i in range(entities.TRACK_COLORS)),
        ]
    )


def point_classes() -> list[rr.AnnotationInfo]:
    """Return the names and colours of the class ids of raw points and voxels."""
    return [
        rr.AnnotationInfo(id=ClassId.UNCLASSIFIED, color=UNNAMED),
        rr.AnnotationInfo(id=ClassId.GROUND, label="ground", color=GROUND),
        rr.AnnotationInfo(id=ClassId.OBSTACLE, label="obstacle", color=CONTEXT),
    ]


def depth_annotations() -> rr.AnnotationContext:
    """Return colours and labels of points in an image by depth: red is near, blue is far."""
    width = entities.DEPTH_RANGE / entities.DEPTH_BINS
    near_is_red = turbo(entities.DEPTH_BINS)[::-1].tolist()
    return rr.AnnotationContext(
        [
            rr.AnnotationInfo(id=i, label=f"{i * width:.1f} m", color=color)
            for i, color in enumerate(near_is_red)
        ]
    )
