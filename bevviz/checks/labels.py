"""Checks of the ground truth: boxes where the LiDAR has no points."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from bevviz.checks.read_input import ReadInput
from bevviz.model.box_points import inside_each
from bevviz.model.frame import Frame
from bevviz.model.input_findings import InputFinding, Remedy
from bevviz.stages.robot_results import in_points_frame

NEAR = 20.0  # metres; a LiDAR has points on most labelled objects that are nearer
FOOT = 0.25  # lowest share of a box, which holds points of the ground wherever it is
ENOUGH, MOST = 10, 300  # fewest and most boxes that are judged
EMPTY = 2 / 3  # share of boxes without a point; of sound labels those of hidden objects have none


def empty_labels(read: ReadInput) -> Iterator[InputFinding]:
    """Yield ground truth most of whose near boxes hold no point, as in another frame or on another side."""
    near, empty = read.labels["near"], read.labels["empty"]
    if near >= ENOUGH and empty > EMPTY * near:
        text = f"ground truth: {empty} of {near} boxes within {NEAR:.0f} m hold no point of the LiDAR"
        remedy = "check their frame, the signs of their axes, and whether z is the centre of the box"
        yield InputFinding("truth", "ground truth", text, Remedy(remedy))


def count_labels(labels: Counter[str], frame: Frame) -> None:
    """Count the near boxes of the ground truth of a frame, and those without points."""
    if frame.truth is None or not len(frame.points) or labels["near"] >= MOST:
        return
    boxes = in_points_frame(frame.pose, frame.truth)
    boxes = boxes.chosen(boxes.distance < NEAR)
    foot = boxes.size[:, 2:] * FOOT * np.array([0, 0, 1], np.float32)  # (K, 3)
    boxes = replace(boxes, center=boxes.center + foot / 2, size=boxes.size - foot)
    labels["near"] += len(boxes)
    labels["empty"] += sum(not len(rows) for _, rows in inside_each(frame.points, boxes))
