"""Boxes in ROS messages: detections of a robot and ground truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from bevviz.messages.decoders import either, frame_name, stamp_ns
from bevviz.messages.foreign_boxes import BoxRow, box_columns, boxes_2d, boxes_3d, decode_objects
from bevviz.messages.poses import quaternion_of, vector_of
from bevviz.model.frame import Bool, ImageLabels, LabelledBoxes2D, LabelledBoxes3D


def decode_detections_2d(msg: Any, topic: str, received: int) -> LabelledBoxes2D:
    """Decode the image boxes of a vision_msgs/Detection2DArray, of ROS 1 or any version of ROS 2.

    A rotated box becomes the upright box around it. Boxes that are not finite or have a negative size are
    left out and listed in ``unusable``.
    """

    def numbers(detection: Any) -> tuple[float, ...]:
        center, box = detection.bbox.center, detection.bbox
        position = getattr(center, "position", center)  # without the position up to ROS 2 Galactic
        return position.x, position.y, center.theta, box.size_x, box.size_y, 0.0

    columns = box_columns(_rows(msg, numbers), 6)
    frame_id = frame_name(msg.header.frame_id) or next(iter(columns.frames), "")
    return boxes_2d(columns, topic, received, stamp_ns(msg.header.stamp), frame_id)


def decode_boxes(msg: Any, topic: str, received: int, stated: Mapping[str, str]) -> LabelledBoxes3D:
    """Decode the boxes of a Detection3DArray or of another message, see ``bevviz.messages.foreign_boxes``.

    Raises:
        MessageError: the message has no boxes that can be found.
    """
    if isinstance(msg, LabelledBoxes3D) or (hasattr(msg, "detections") and not stated):
        return decode_detections_3d(msg, topic, received)
    return decode_objects(msg, topic, received, stated)


def decode_detections_3d(msg: Any, topic: str, received: int) -> LabelledBoxes3D:
    """Decode the boxes of a Detection3DArray: vision_msgs of ROS 1 or any version of ROS 2, or bevviz_msgs.

    An orientation of zero is no rotation. Boxes that are not finite or have a negative size are left out and
    listed in ``unusable``. If the header of the array has no frame, the frames of the detections are used.
    ``msg`` may also be the boxes that the decoder of a message type returned.
    """
    if isinstance(msg, LabelledBoxes3D):
        stamp = msg.stamp or (0 if len(msg.boxes) else received)
        return replace(msg, topic=topic, received=received, stamp=stamp)

    def numbers(detection: Any) -> tuple[float, ...]:
        center, size = detection.bbox.center, detection.bbox.size
        return (*vector_of(center.position), *vector_of(size), *quaternion_of(center.orientation))

    columns = box_columns(_rows(msg, numbers), 10)
    stated = frame_name(msg.header.frame_id)
    frame_id = stated or next(iter(columns.frames), "")
    stamp = stamp_ns(msg.header.stamp) or (0 if len(columns.values) else received)
    if stated:
        columns = columns._replace(frames=())
    boxes = boxes_3d(columns, topic, received, stamp, frame_id)
    unusable = (*map(str, getattr(msg, "unusable", ())), *columns.unusable)
    return replace(boxes, image=_image_labels(msg, columns.usable), unusable=unusable)


def _image_labels(msg: Any, usable: Bool) -> ImageLabels | None:
    """Return the labels of the image in a bevviz_msgs/Detection3DArray; None if the message has none."""
    if not hasattr(msg, "image_boxes") or len(msg.truncated) != len(usable):
        return None
    return ImageLabels(
        np.array(msg.image_boxes, np.float32).reshape(-1, 4)[usable],
        np.array(msg.truncated, np.float32)[usable],
        np.array(msg.occluded, np.int32)[usable],
        np.array(msg.dont_care, np.float32).reshape(-1, 4),
    )


def _rows(msg: Any, numbers: Callable[[Any], tuple[float, ...]]) -> list[BoxRow]:
    """Read the detections of a message. ``numbers`` returns the numbers of a detection."""
    return [BoxRow(numbers(d), *_hypothesis(d.results), _identity(d), _frame(d)) for d in msg.detections]


def _frame(detection: Any) -> str:
    return frame_name(getattr(getattr(detection, "header", None), "frame_id", ""))


def _identity(detection: Any) -> str:
    # Tracking_id up to ROS 2 Foxy.
    return str(getattr(detection, "id", getattr(detection, "tracking_id", "")))


def _hypothesis(results: Iterable[Any]) -> tuple[str, float]:
    """Return label and score of the best result.

    Fusion nodes append the class to the results of the cluster. The cluster's own label ``cluster_<i>`` has
    score 1. It counts only if there is no other label.
    """
    # Without the hypothesis up to ROS 2 Foxy.
    hypotheses = [getattr(result, "hypothesis", result) for result in results]
    if not hypotheses:
        return "", 0.0
    labels = [(str(either(h, "class_id", "id")), float(h.score)) for h in hypotheses]
    named = [item for item in labels if not item[0].startswith("cluster_")]
    return max(named, key=lambda item: 0.0 if math.isnan(item[1]) else item[1]) if named else labels[0]
