"""Comparison of the results with the robot's during a live run, like ``bevviz compare --robot`` for a bag."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from bevviz.compare.sides import robot_objects, robot_topic
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
from bevviz.model.frame import LabelledBoxes2D, LabelledBoxes3D
from bevviz.model.results import FrameResult

SECOND = 1_000_000_000
WAITING = 50  # frames that may wait for the robot's boxes


class RobotComparison:
    """Comparison of each frame with the robot's boxes of the same stamp, when they come.

    Frames without boxes of the robot are left out. So are frames in which a failed stage left no objects of
    ours. The robot's image boxes are compared if they come before its 3D boxes. Later ones are counted. Only
    one thread may use it.

    Args:
        asked: the robot's Detection3DArray topic. Empty: the topic is recognised by its name.
    """

    def __init__(self, asked: str) -> None:
        self.topic = ""  # empty until the robot has published boxes
        self.frames = self.differing = 0
        self.without_ours = 0  # frames left out because there are no objects of ours
        self.problem = ""  # reason why nothing is compared
        self.late_images = 0  # image boxes of the robot that came after the comparison of their frame
        self._asked = asked
        self._topics: set[str] = set()
        self._waiting: dict[int, SideResult] = {}  # stamp -> our result that waits for the robot's boxes
        self._boxes: dict[int, LabelledBoxes3D] = {}  # stamp of the frame -> boxes that wait for our result
        self._images: dict[int, dict[str, ImageBoxes]] = {}  # stamp of the frame -> camera -> boxes
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
    ) -> list[FrameDifferences]:
        """Take in a frame.

        Args:
            result: result of the frame.
            late: boxes of the robot that came after their frame was complete, with the stamp of that frame.

        Returns:
            The comparisons that are possible now.
        """
        frame = result.frame
        published: list[tuple[int, LabelledBoxes2D | LabelledBoxes3D]]
        published = [(frame.stamp, boxes) for boxes in frame.robot_boxes]
        published += [(frame.stamp, boxes) for boxes in frame.robot_detections if boxes.camera]
        published += late
        for _, boxes in published:
            if isinstance(boxes, LabelledBoxes3D):
                self._choose(boxes.topic)
        if result.objects is None:
            self.without_ours += 1
        else:
            self._waiting[frame.stamp] = seen(result)
        for stamp, boxes in published:
            if isinstance(boxes, LabelledBoxes2D):
                self._add_images(stamp, boxes)
            elif boxes.topic == self.topic:
                self._boxes[stamp] = boxes
        stamps = sorted(self._boxes.keys() & self._waiting.keys())
        pairs = [(self._waiting.pop(stamp), self._boxes.pop(stamp)) for stamp in stamps]
        compared = [self._compare(*pair, result.config.live) for pair in pairs]
        waiting: dict[int, Any]
        for waiting in (self._waiting, self._boxes, self._images):
            while len(waiting) > WAITING:
                del waiting[next(iter(waiting))]
        return compared

    def reason(self) -> str | None:
        """Return the reason to save the flight recorder, or None.

        There is one if both have differed for ``live.robot_time``. It is returned once.
        """
        reason, self._reason = self._reason, ""
        return reason or None

    def _add_images(self, stamp: int, boxes: LabelledBoxes2D) -> None:
        """Keep image boxes, or count them if their frame is compared already."""
        if stamp in self._compared or not boxes.camera:
            self.late_images += 1
        else:
            self._images.setdefault(stamp, {})[boxes.camera] = ImageBoxes(boxes.xyxy, boxes.labels)

    def _choose(self, topic: str) -> None:
        """Choose the topic to compare with, after a new topic has appeared."""
        if topic in self._topics:
            return
        self._topics.add(topic)
        try:
            self.topic, self.problem = robot_topic(tuple(sorted(self._topics)), self._asked), ""
        except UserError as error:
            self.topic, self.problem = "", str(error)

    def _compare(self, ours: SideResult, boxes: LabelledBoxes3D, limits: LiveConfig) -> FrameDifferences:
        """Compare one frame. Set the reason to save if the difference has lasted."""
        self._compared.append(ours.stamp)
        objects, images = robot_objects(ours.pose, boxes), self._images.pop(ours.stamp, {})
        frame_differences = differences(ours, replace(ours, objects=objects, images=images, clusters=None))
        different = [d for d in frame_differences.objects if _differs(d, limits)]
        self.frames += 1
        self.differing += bool(different)
        if not different:
            self._since, self._fired = None, False
        elif self._since is None or ours.stamp < self._since:
            self._since = ours.stamp
        if self._since is not None and limits.robot_time is not None and not self._fired:
            lasted = (ours.stamp - self._since) / SECOND
            if lasted >= limits.robot_time:
                self._fired = True
                words = ", ".join(f"{_words(d)} {frame_differences.position_of(d)}" for d in different[:3])
                more = f" and {len(different) - 3} more" if different[3:] else ""
                self._reason = f"robot and ours differ for {lasted:.1f} s: {words}{more}"
        return frame_differences


def _differs(difference: Difference, limits: LiveConfig) -> bool:
    """Return whether a difference is large enough to count."""
    if difference.change is Change.MOVED:
        return difference.distance > limits.robot_tolerance
    return difference.change is not Change.SAME


def _words(difference: Difference) -> str:
    if difference.change is Change.ONLY_A:
        return f"{difference.name_a} of ours alone"
    if difference.change is Change.ONLY_B:
        return f"{difference.name_b} of the robot alone"
    if difference.change is Change.CLASS:
        return f"our {difference.name_a} is the robot's {difference.name_b}"
    return f"{difference.name_a} {difference.distance:.2f} m apart"
