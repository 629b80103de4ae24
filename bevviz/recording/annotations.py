"""Names and colours of the class ids."""

from __future__ import annotations

import rerun as rr

from bevviz.model.colors import palette, turbo
from bevviz.model.results import ClusterState, DetectionState
from bevviz.recording import entities
from bevviz.recording.entities import ClassId
from bevviz.recording.writer import Writer

FAINT_COLOR = (150, 150, 160, 110)


def log_world(to: Writer) -> None:
    """Log the axes of the fixed frame, and the names and colours of class ids. Both are static."""
    to.static(entities.WORLD, rr.ViewCoordinates.FLU, class_annotations())


def class_annotations() -> rr.AnnotationContext:
    """Return the names and colours of the class ids of points and boxes."""
    classes: list[tuple[int, str, tuple[int, ...]]] = [
        (entities.DETECTION_CLASS[DetectionState.KEPT], "kept", (255, 255, 255)),
        (entities.DETECTION_CLASS[DetectionState.BELOW_THRESHOLD], "below threshold", FAINT_COLOR),
        (entities.DETECTION_CLASS[DetectionState.SUPPRESSED], "suppressed", FAINT_COLOR),
        (entities.CLUSTER_CLASS[ClusterState.TOO_SMALL], "too small", (120, 120, 130)),
        (entities.CLUSTER_CLASS[ClusterState.TOO_LARGE], "too large", (140, 100, 100)),
    ]
    colors = palette(entities.TRACK_COLORS).tolist()
    return rr.AnnotationContext(
        [
            *point_classes(),
            *(rr.AnnotationInfo(id=i, label=label, color=color) for i, label, color in classes),
            *(rr.AnnotationInfo(id=ClassId.TRACK + i, color=color) for i, color in enumerate(colors)),
        ]
    )


def point_classes() -> list[rr.AnnotationInfo]:
    """Return the names and colours of the class ids of raw points and voxels."""
    return [
        rr.AnnotationInfo(id=ClassId.UNCLASSIFIED, color=(130, 130, 140)),
        rr.AnnotationInfo(id=ClassId.GROUND, label="ground", color=(92, 84, 76)),
        rr.AnnotationInfo(id=ClassId.OBSTACLE, label="obstacle", color=(170, 175, 190)),
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
