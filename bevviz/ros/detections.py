"""Boxes of ROS messages: what a robot has found, or what is known to be there."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from bevviz.frame import F32, F64, ImageLabels, LabelledBoxes2D, LabelledBoxes3D
from bevviz.ros.messages import either, frame_name, stamp_ns
from bevviz.ros.objects import decode_objects, turned_boxes


def decode_detections_2d(msg: Any, topic: str, received: int) -> LabelledBoxes2D:
    """The image boxes of a vision_msgs/Detection2DArray, of ROS 1 or any version of ROS 2.

    A turned box becomes the upright one around it. Boxes that are not finite are left out.

    Raises:
        MessageError: not laid out as any known version of the message.
    """

    def row(detection: Any) -> tuple[float, ...]:
        center, box = detection.bbox.center, detection.bbox
        position = getattr(center, "position", center)  # flat up to ROS 2 Galactic
        return position.x, position.y, center.theta, box.size_x, box.size_y

    values, labels, scores, _, frames = _rows(msg, row, 5, topic)
    x, y, theta, w, h = values.T
    cos, sin = np.abs(np.cos(theta)), np.abs(np.sin(theta))
    dx, dy = (w * cos + h * sin) / 2, (w * sin + h * cos) / 2
    return LabelledBoxes2D(
        topic=topic,
        stamp=stamp_ns(msg.header.stamp),
        frame_id=frame_name(msg.header.frame_id) or next(iter(frames), ""),
        xyxy=np.stack([x - dx, y - dy, x + dx, y + dy], axis=1).astype(np.float32),
        labels=labels,
        scores=scores,
        received=received,
    )


def decode_boxes(msg: Any, topic: str, received: int, stated: Mapping[str, str]) -> LabelledBoxes3D:
    """The boxes of a Detection3DArray, or of another message, see ``bevviz.ros.objects``.

    Raises:
        MessageError: they cannot be found in it.
    """
    if hasattr(msg, "detections") and not stated:
        return decode_detections_3d(msg, topic, received)
    return decode_objects(msg, topic, received, stated)


def decode_detections_3d(msg: Any, topic: str, received: int) -> LabelledBoxes3D:
    """The boxes of a vision_msgs/Detection3DArray, of ROS 1 or any version of ROS 2, or of bevviz_msgs.

    An orientation left at zero is none. Boxes that are not finite are left out. Where the array's header
    states no frame, those of the detections count.

    Raises:
        MessageError: not laid out as any known version of the message.
    """

    def row(detection: Any) -> tuple[float, ...]:
        center, size = detection.bbox.center, detection.bbox.size
        p, q = center.position, center.orientation
        return p.x, p.y, p.z, size.x, size.y, size.z, q.x, q.y, q.z, q.w

    values, labels, scores, ids, frames = _rows(msg, row, 10, topic)
    stated = frame_name(msg.header.frame_id)
    boxes, turns = turned_boxes(values)
    return LabelledBoxes3D(
        topic=topic,
        stamp=stamp_ns(msg.header.stamp) or (0 if len(boxes) else received),
        frame_id=stated or next(iter(frames), ""),
        boxes=boxes,
        labels=labels,
        scores=scores,
        received=received,
        ids=ids if all(ids) else (),
        image=_image_labels(msg, len(labels)),
        turns=turns,
        frames=frames if not stated and len(set(frames)) > 1 else (),
    )


def _image_labels(msg: Any, boxes: int) -> ImageLabels | None:
    """What a data set says of the image, see ``encode_labels``; None: it says nothing."""
    if not hasattr(msg, "image_boxes") or len(msg.truncated) != boxes:
        return None
    return ImageLabels(
        np.array(msg.image_boxes, np.float32).reshape(boxes, 4),
        np.array(msg.truncated, np.float32),
        np.array(msg.occluded, np.int32),
        np.array(msg.dont_care, np.float32).reshape(-1, 4),
    )


def _rows(
    msg: Any, row: Callable[[Any], tuple[float, ...]], width: int, topic: str
) -> tuple[F64, tuple[str, ...], F32, tuple[str, ...], tuple[str, ...]]:
    """(K, width) numbers, labels, scores, ids and frames of the detections whose numbers are all finite."""
    rows = [(row(d), *_hypothesis(d.results), _identity(d), _frame(d)) for d in msg.detections]
    rows = [r for r in rows if all(map(math.isfinite, r[0]))]
    values = np.array([r[0] for r in rows], np.float64).reshape(-1, width)
    scores = np.nan_to_num(np.array([r[2] for r in rows], np.float32))
    return values, tuple(r[1] for r in rows), scores, tuple(r[3] for r in rows), tuple(r[4] for r in rows)


def _frame(detection: Any) -> str:
    return frame_name(getattr(getattr(detection, "header", None), "frame_id", ""))


def _identity(detection: Any) -> str:
    return str(getattr(detection, "id", getattr(detection, "tracking_id", "")))  # the latter up to ROS 2 Foxy


def _hypothesis(results: Iterable[Any]) -> tuple[str, float]:
    """Label and score of the best result.

    Fusion nodes append the class to the hypotheses of the cluster, whose own ``cluster_<i>`` has score 1:
    such a name counts only where there is no other.
    """
    hypotheses = [getattr(result, "hypothesis", result) for result in results]  # flat up to ROS 2 Foxy
    if not hypotheses:
        return "", 0.0
    labels = [(str(either(h, "class_id", "id")), float(h.score)) for h in hypotheses]
    named = [item for item in labels if not item[0].startswith("cluster_")]
    return max(named, key=lambda item: 0.0 if math.isnan(item[1]) else item[1]) if named else labels[0]
