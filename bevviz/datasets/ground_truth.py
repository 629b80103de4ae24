"""Ground truth of data sets as streams of messages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bevviz.datasets.dataset import Stream
from bevviz.messages.encode import encode_boxes_3d, make_message
from bevviz.model.frame import I64, Boxes3D, LabelledBoxes3D

BOXES = "vision_msgs/msg/Detection3DArray"
BOXES_WITH_IMAGE = "bevviz_msgs/msg/Detection3DArray"


def truth_stream(
    times: I64, frame_id: str, label: Callable[[int], LabelledBoxes3D], kind: str = BOXES
) -> Stream:
    """Return the stream of ground truth.

    Args:
        times: (N,) sorted stamps in nanoseconds.
        frame_id: frame of the boxes.
        label: returns the labels of a row.
        kind: ``BOXES``, or ``BOXES_WITH_IMAGE`` for labels with an ``image``.
    """
    return Stream("/ground_truth", kind, times, lambda row: _encode(int(times[row]), frame_id, label(row)))


def truth_boxes(boxes: Boxes3D, labels: Sequence[str], ids: Sequence[str], file: str = "") -> LabelledBoxes3D:
    """Return boxes with their classes and ids, as ``file`` labels them."""
    scores = np.ones(len(labels), np.float32)
    return LabelledBoxes3D(file, 0, "", boxes, tuple(labels), scores, ids=tuple(ids))


def _encode(stamp: int, frame_id: str, truth: LabelledBoxes3D) -> Any:
    """Make the message of labelled boxes: of vision_msgs, or of bevviz_msgs if there is an ``image``.

    Only the latter holds what was left out as unusable.
    """
    results = [[(label, 1.0)] for label in truth.labels]
    message = encode_boxes_3d(stamp, frame_id, truth.boxes, results, ids=truth.ids)
    if (image := truth.image) is None:
        return message
    return make_message(
        BOXES_WITH_IMAGE,
        header=message.header,
        detections=message.detections,
        image_boxes=image.xyxy.astype(np.float32).reshape(-1),
        truncated=image.truncated.astype(np.float32),
        occluded=image.occluded.astype(np.int32),
        dont_care=image.dont_care.astype(np.float32).reshape(-1),
        unusable=list(truth.unusable),
    )
