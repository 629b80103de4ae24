"""Comparison of the results with the robot's during a live run, like ``bevviz compare --robot`` for a bag."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bevviz.compare.sides import published_result, robot_topic
from bevviz.config import LiveConfig
from bevviz.errors import UserError
from bevviz.evaluate.differences import (
    Change,
    Difference,
    FrameDifferences,
    ImageBoxes,
    SideResult,
    differences,
    seen,
)
from bevviz.model import geometry
from bevviz.model.frame import F64, LabelledBoxes2D, LabelledBoxes3D
from bevviz.model.results import FrameResult

SECOND = 1_000_000_000
WAITING = 50  # frames that may wait for the robot's boxes


@dataclass(frozen=True, slots=True)
class OurFrame:
    """Our result of one frame, reduced to the data for the comparison."""

    index: int
    stamp: int
    received: int
    world_from_points: F64
    seen: SideResult
    images: Mapping[str, ImageBoxes]  # by camera, the robot's image boxes that came with the frame


@dataclass(frozen=True, slots=True)
class TimedDifferences:
    """Differences in one frame, with its time of receipt and its pose."""

    differences: FrameDifferences
    received: int
    world_from_points: F64


class RobotComparison:
    """Comparison of each frame with the robot's boxes of the same stamp, when they come.

    Frames without boxes of the robot are left out. So are frames in which a failed stage left no objects of
    ours. The robot's image boxes are compared if they come before its 3D boxes. Later ones are counted. Only
    one thread may use it.

    Args:
        asked: the robot's Detection3DArray topic. Empty: the topic is recognised by its name.
        config: limits from which both differ.
    """

    def __init__(self, asked: str, config: LiveConfig) -> None:
        self.config = config
        self.topic = ""  # empty until the robot has published boxes
        self.frames = self.differing = 0
        self.without_ours = 0  # frames left out because there are no objects of ours
        self.problem = ""  # reason why nothing is compared
        self.late_images = 0  # image boxes of the robot that came after the comparison of their frame
        self._asked = asked
        self._topics: set[str] = set()
        self._waiting: dict[int, OurFrame] = {}  # stamp -> frame that waits for the robot's boxes
        self._late: dict[int, LabelledBoxes3D] = {}  # stamp of the frame -> boxes that wait for our result
        self._images: dict[int, dict[str, ImageBoxes]] = {}  # stamp -> camera -> boxes
        self._compared: deque[int] = deque(maxlen=WAITING)  # stamps
        self._since: int | None = None  # stamp since which both differ in every frame
        self._fired = False
        self._reason = ""

    @property
    def names(self) -> tuple[str, str]:
        """Names of the two sides."""
        return "bevviz", f"the robot's {self.topic or self._asked or 'fused boxes'}"

    def compare(
        self, result: FrameResult, late: Sequence[tuple[int, LabelledBoxes2D | LabelledBoxes3D]] = ()
    ) -> list[TimedDifferences]:
        """Take in a frame.

        Args:
            result: result of the frame.
            late: boxes of the robot that came after their frame was complete, with the stamp of that frame.

        Returns:
            The comparisons that are possible now.
        """
        frame = result.frame
        in_space = {stamp: boxes for stamp, boxes in late if isinstance(boxes, LabelledBoxes3D)}
        for labelled in (*frame.robot_boxes, *in_space.values()):
            self._choose(labelled.topic)
        images = {
            labelled_boxes.camera: _image_boxes(labelled_boxes)
            for labelled_boxes in frame.robot_detections
            if labelled_boxes.camera
        }
        if result.objects is None:
            self.without_ours += 1
        else:
            about = frame.index, frame.stamp, frame.received, frame.pose
            self._waiting[frame.stamp] = OurFrame(*about, seen(result), images)
        for stamp, labelled_boxes in late:
            if isinstance(labelled_boxes, LabelledBoxes2D):
                self._add_images(stamp, labelled_boxes)
        self._late |= {stamp: boxes for stamp, boxes in in_space.items() if boxes.topic == self.topic}
        compared = []
        theirs = published_result(frame, self.topic, result.config) if self.topic else None
        if theirs is not None and frame.stamp in self._waiting:
            compared.append(self._compare(self._waiting.pop(frame.stamp), seen(theirs)))
        for stamp in sorted(self._late.keys() & self._waiting.keys()):
            ours, boxes = self._waiting.pop(stamp), self._late.pop(stamp)
            compared.append(self._compare(ours, _placed(boxes, ours.world_from_points)))
        waiting: dict[int, Any]
        for waiting in (self._waiting, self._late, self._images):
            while len(waiting) > WAITING:
                del waiting[next(iter(waiting))]
        return sorted(compared, key=lambda one: one.differences.stamp)

    def reason(self) -> str | None:
        """Return the reason to save the flight recorder, or None.

        There is one if both have differed for ``live.robot_time``. It is returned once.
        """
        reason, self._reason = self._reason, ""
        return reason or None

    def _add_images(self, stamp: int, boxes: LabelledBoxes2D) -> None:
        """Keep late image boxes, or count them if their frame is compared already."""
        if stamp in self._compared or not boxes.camera:
            self.late_images += 1
        else:
            self._images.setdefault(stamp, {})[boxes.camera] = _image_boxes(boxes)

    def _choose(self, topic: str) -> None:
        """Choose the topic to compare with, after a new topic has appeared."""
        if topic in self._topics:
            return
        self._topics.add(topic)
        try:
            self.topic, self.problem = robot_topic(tuple(sorted(self._topics)), self._asked), ""
        except UserError as error:
            self.topic, self.problem = "", str(error)

    def _compare(self, ours: OurFrame, theirs: SideResult) -> TimedDifferences:
        """Compare one frame. Set the reason to save if the difference has lasted."""
        self._compared.append(ours.stamp)
        images = {**ours.images, **theirs.images, **self._images.pop(ours.stamp, {})}
        frame_differences = differences(ours.index, ours.stamp, ours.seen, replace(theirs, images=images))
        different = [d for d in frame_differences.objects if self._differs(d)]
        self.frames += 1
        self.differing += bool(different)
        if not different:
            self._since, self._fired = None, False
        elif self._since is None or ours.stamp < self._since:
            self._since = ours.stamp
        if self._since is not None and self.config.robot_time is not None and not self._fired:
            lasted = (ours.stamp - self._since) / SECOND
            if lasted >= self.config.robot_time:
                self._fired = True
                words = ", ".join(f"{_words(d)} {frame_differences.position_of(d)}" for d in different[:3])
                more = f" and {len(different) - 3} more" if different[3:] else ""
                self._reason = f"robot and ours differ for {lasted:.1f} s: {words}{more}"
        return TimedDifferences(frame_differences, ours.received, ours.world_from_points)

    def _differs(self, difference: Difference) -> bool:
        """Return whether a difference is large enough to count."""
        if difference.change is Change.MOVED:
            return difference.distance > self.config.robot_tolerance
        return difference.change is not Change.SAME


def _words(difference: Difference) -> str:
    if difference.change is Change.ONLY_A:
        return f"{difference.name_a} of ours alone"
    if difference.change is Change.ONLY_B:
        return f"{difference.name_b} of the robot alone"
    if difference.change is Change.CLASS:
        return f"our {difference.name_a} is the robot's {difference.name_b}"
    return f"{difference.name_a} {difference.distance:.2f} m apart"


def _image_boxes(boxes: LabelledBoxes2D) -> ImageBoxes:
    """Return the robot's image boxes for the comparison."""
    return ImageBoxes(boxes.xyxy, boxes.labels)


def _placed(labelled: LabelledBoxes3D, world_from_points: F64) -> SideResult:
    """Move the robot's boxes to the points frame of an earlier frame."""
    world = np.eye(4) if labelled.world_from_boxes is None else labelled.world_from_boxes
    boxes = geometry.transform_boxes(labelled.boxes, geometry.inverse(world_from_points) @ world)
    return SideResult(boxes, labelled.labels, labelled.scores)
