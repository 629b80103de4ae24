"""Log reference boxes: ground truth, and boxes that the robot published."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import rerun as rr

from bevviz.config import BevConfig
from bevviz.model import geometry
from bevviz.model.frame import F64, Frame, LabelledBoxes2D, LabelledBoxes3D, LateBoxes
from bevviz.recording import entities
from bevviz.recording.bev import bev_pixels, ground_outlines
from bevviz.recording.camera import image_frame
from bevviz.recording.primitives import OUTLINE, boxes2d, boxes3d, scored, transform
from bevviz.recording.writer import Writer

Color = tuple[int, int, int]
Put = Callable[..., None]  # ``Writer.put`` or ``Writer.write``

_TRUTH_COLOR = (215, 215, 215)
_ROBOT_COLOR = (255, 210, 0)


def log_truth_style(to: Writer) -> None:
    """Log the static style of the ground truth."""
    to.static(
        entities.TRUTH,
        rr.Boxes3D.from_fields(
            colors=[_TRUTH_COLOR],
            radii=rr.Radius.ui_points(0.5),
            show_labels=False,
            fill_mode=OUTLINE,
        ),
    )


def log_truth(to: Writer, frame: Frame, config: BevConfig) -> None:
    """Log the ground truth boxes in 3D and over the bird's-eye image."""
    if frame.truth is not None and len(frame.truth.boxes):
        _log_boxes(to.put, entities.TRUTH, frame.truth, None)
        path = entities.overlay("ground_truth")
        _log_outlines(to.put, path, frame.pose, frame.truth, config, _TRUTH_COLOR)


def log_robot(to: Writer, frame: Frame, config: BevConfig) -> None:
    """Log the robot's boxes and detections under the names of their topics."""
    for labelled in frame.robot_boxes:
        if len(labelled.boxes):
            _log_boxes(to.put, entities.robot(labelled.topic), labelled, _ROBOT_COLOR)
            path = entities.robot_overlay(labelled.topic)
            _log_outlines(to.put, path, frame.pose, labelled, config, _ROBOT_COLOR)
    for detections in frame.robot_detections:
        if len(detections.xyxy):
            _log_image_boxes(to.put, detections)


def log_late(to: Writer, late: LateBoxes, config: BevConfig) -> None:
    """Log a result that came too late for its frame, at its own stamp.

    It stays visible until the next result or ``clear_late``.
    """
    boxes = late.boxes
    to.set_time(late.index, boxes.stamp, boxes.received)
    if isinstance(boxes, LabelledBoxes2D):
        _log_image_boxes(to.write, boxes)
        return
    _log_boxes(to.write, entities.robot(boxes.topic), boxes, _ROBOT_COLOR)
    path = entities.robot_overlay(boxes.topic)
    if not _log_outlines(to.write, path, late.pose, boxes, config, _ROBOT_COLOR):
        to.write(path, rr.Clear(recursive=False))


def clear_late(to: Writer, topic: str) -> None:
    """Clear the boxes of a topic."""
    for path in (entities.robot(topic), entities.robot_overlay(topic)):
        to.write(path, rr.Clear(recursive=False))


def _log_boxes(put: Put, path: str, labelled: LabelledBoxes3D, color: Color | None) -> None:
    put(
        path,
        transform(_pose(labelled)),
        boxes3d(
            labelled.boxes,
            np.arange(len(labelled.boxes)),
            scored(labelled.labels, labelled.scores),
            colors=None if color is None else [color],
        ),
    )


def _log_image_boxes(put: Put, detections: LabelledBoxes2D) -> None:
    """Log detections under /robot. They have the coordinate frame of the image, so that it can show them."""
    put(
        entities.robot(detections.topic),
        *([image_frame(detections.camera)] if detections.camera else []),
        boxes2d(
            detections.xyxy,
            scored(detections.labels, detections.scores),
            colors=[_ROBOT_COLOR],
            draw_order=25.0,
        ),
    )


def _log_outlines(
    put: Put, path: str, pose: F64, labelled: LabelledBoxes3D, config: BevConfig, color: Color
) -> bool:
    """Log outlines of the boxes with their centre in the bird's-eye view. Return whether there are any."""
    points_from_boxes = geometry.inverse(pose) @ _pose(labelled)
    reach = np.array([config.range_x, config.range_y], np.float32)
    inside = (np.abs(geometry.apply(points_from_boxes, labelled.boxes.center)[:, :2]) < reach).all(axis=1)
    if not inside.any():
        return False
    outlines = ground_outlines(geometry.corners(labelled.boxes)[inside])
    put(
        path,
        rr.LineStrips2D(
            bev_pixels(config, points_from_boxes, outlines),
            colors=[color],
            radii=rr.Radius.ui_points(0.75),
            labels=[labelled.labels[row] for row in np.flatnonzero(inside)],
            show_labels=False,
            draw_order=10.0,
        ),
    )
    return True


def _pose(labelled: LabelledBoxes3D) -> F64:
    return np.eye(4) if labelled.world_from_boxes is None else labelled.world_from_boxes
