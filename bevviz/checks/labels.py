"""Checks of ground truth and result files: boxes without points, and boxes that their points do not fit."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from bevviz.checks.read_input import ReadInput
from bevviz.messages.topics import RESULT_TOPICS
from bevviz.model.box_points import inside_each
from bevviz.model.frame import F64, Boxes3D, Frame, LabelledBoxes3D
from bevviz.model.input_findings import InputFinding, Remedy
from bevviz.stages.robot_results import in_points_frame

TRUTH = "ground truth"
NEAR = 20.0  # metres; a LiDAR has points on most labelled objects that are nearer
FOOT = 0.25  # lowest share of a box, which holds points of the ground wherever it is
FEW, ENOUGH, MOST = 3, 10, 300  # fewest labels that tell if all are odd, fewest boxes that tell, most
SHARE = 2 / 3  # share of odd boxes; of sound labels those of hidden objects have no points
POINTS = 10  # fewest points that tell how a box fits
ABOVE = 0.3  # share of the points of an object that are above a box with z at its bottom; 0.4 are usual
LONG = 1.5  # ratio of length and width from which a turn by 90 degrees matters
BETTER = 1.1  # ratio of the points that a turned box holds

# Number of judged boxes, number of odd ones, what is odd, and the remedy.
_ODD = (
    (
        "near",
        "empty",
        f"boxes within {NEAR:.0f} m hold no point of the LiDAR",
        "check their frame, the signs of their axes, and whether z is the centre of the box",
    ),
    (
        "filled",
        "low",
        "boxes have the upper half of their object above them",
        "their z is the bottom of the box: write z of the centre, half the height more",
    ),
    (
        "long",
        "turned",
        "long boxes hold more points if they are turned by 90 degrees",
        "swap their length and width, or check the axis from which their yaw counts",
    ),
)


def wrong_labels(read: ReadInput) -> Iterator[InputFinding]:
    """Yield topics most of whose near boxes do not fit the points, as in another convention."""
    for (source, labels), (of, odd, what, remedy) in itertools.product(read.labels.items(), _ODD):
        total, count = labels[of], labels[odd]
        # One odd object that is labelled in several frames tells nothing.
        is_few = source == TRUTH and labels["at once"] >= FEW and count == total >= FEW
        if is_few or (total >= ENOUGH and count > SHARE * total):
            yield InputFinding("truth", source, f"{source}: {count} of {total} {what}", Remedy(remedy))


def count_labels(labels: dict[str, Counter[str]], frame: Frame) -> None:
    """Count the near boxes of ground truth and of result files in a frame, and those that are odd."""
    if frame.truth is not None:
        _count_boxes(labels[TRUTH], frame, frame.truth)
    for boxes in frame.robot_boxes:
        if boxes.topic.startswith(RESULT_TOPICS):
            _count_boxes(labels[boxes.topic], frame, boxes)


def _count_boxes(labels: Counter[str], frame: Frame, labelled: LabelledBoxes3D) -> None:
    if not len(frame.points) or labels["near"] >= MOST:
        return
    boxes = in_points_frame(frame.pose, labelled)
    boxes = boxes.chosen(boxes.distance < NEAR)
    inside = _count(frame, boxes, FOOT, 1)
    above = _count(frame, boxes, 1, 1.5)
    across = _count(frame, replace(boxes, size=boxes.size[:, [1, 0, 2]]), FOOT, 1)
    filled = inside + above >= POINTS
    is_long = boxes.size[:, :2].max(axis=1, initial=0) > LONG * boxes.size[:, :2].min(axis=1, initial=np.inf)
    is_long &= inside + across >= POINTS
    labels["near"] += len(boxes)
    labels["at once"] = max(labels["at once"], len(boxes))
    labels["empty"] += int((inside == 0).sum())
    labels["filled"] += int(filled.sum())
    labels["low"] += int((filled & (above > ABOVE * (inside + above))).sum())
    labels["long"] += int(is_long.sum())
    labels["turned"] += int((is_long & (across > BETTER * inside)).sum())


def _count(frame: Frame, boxes: Boxes3D, low: float, high: float) -> F64:
    """Return the number of points in each box between two shares of its height above its bottom."""
    height = boxes.size[:, 2:] * np.array([0, 0, 1], np.float32)  # (K, 3)
    center, size = boxes.center + height * ((low + high - 1) / 2), boxes.size + height * (high - low - 1)
    layers = replace(boxes, center=center, size=size)
    return np.array([len(rows) for _, rows in inside_each(frame.points, layers)], np.float64)
