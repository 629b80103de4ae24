"""Ours against the robot's, while both run: what ``bevviz compare --robot`` tells of a bag."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from bevviz.compare.differences import (
    Change,
    Difference,
    FrameDifferences,
    ImageBoxes,
    Seen,
    differences,
    seen,
)
from bevviz.compare.log import place
from bevviz.compare.sides import published, robot_topic
from bevviz.config import LiveConfig
from bevviz.errors import UserError
from bevviz.model import geometry
from bevviz.model.frame import F64, LabelledBoxes2D, LabelledBoxes3D
from bevviz.model.results import FrameResult

SECOND = 1_000_000_000
T = TypeVar("T")
WAITING = 50  # frames that the robot may still say something of


@dataclass(frozen=True, slots=True)
class Ours:
    """What is remembered of a frame: small."""

    index: int
    stamp: int
    received: int
    world_from_points: F64
    seen: Seen
    images: Mapping[str, ImageBoxes]  # by camera, what the robot has said of them with the frame


@dataclass(frozen=True, slots=True)
class Compared:
    """How both differ in a frame."""

    found: FrameDifferences
    received: int
    world_from_points: F64


class AgainstRobot:
    """Compares each frame with what the robot published of it, when it did.

    A frame that the robot says nothing of is left out, and so is one that a failed stage of ours made no
    objects of: that says nothing of what is there. The robot's boxes in the images are compared where they
    come before its boxes in space do, else counted. For one thread, but for ``reason``.

    Args:
        asked: the robot's Detection3DArray topic; empty: the one whose name says so.
        config: from what on both differ.
    """

    def __init__(self, asked: str, config: LiveConfig) -> None:
        self.config = config
        self.topic = ""  # known when the robot has said something
        self.frames = self.differing = 0
        self.without_ours = 0  # frames that are left out as there are no objects of ours
        self.problem = ""  # why nothing is compared
        self.late_images = 0  # of the robot's image boxes that came when their frame was compared already
        self._asked = asked
        self._topics: set[str] = set()
        self._waiting: dict[int, Ours] = {}  # by stamp: frames that the robot has said nothing of yet
        self._late: dict[int, LabelledBoxes3D] = {}  # by stamp of their frame, whose result is yet to come
        self._images: dict[int, dict[str, ImageBoxes]] = {}  # the same of its image boxes, by camera
        self._compared: deque[int] = deque(maxlen=WAITING)  # stamps
        self._since: int | None = None  # stamp from which on both differ in every frame
        self._fired = False
        self._reason = ""
        self._lock = threading.Lock()

    @property
    def names(self) -> tuple[str, str]:
        """Of the two sides."""
        return "bevviz", f"the robot's {self.topic or self._asked or 'fused boxes'}"

    def see(
        self, result: FrameResult, late: Sequence[tuple[int, LabelledBoxes2D | LabelledBoxes3D]] = ()
    ) -> list[Compared]:
        """Take in a frame.

        Args:
            result: of it.
            late: the robot's boxes that came too late for their frame, with the stamp of that frame.

        Returns:
            What can be compared now.
        """
        frame = result.frame
        in_space = {stamp: boxes for stamp, boxes in late if isinstance(boxes, LabelledBoxes3D)}
        for labelled in (*frame.robot_boxes, *in_space.values()):
            self._choose(labelled.topic)
        images = {found.camera: _image_boxes(found) for found in frame.robot_detections if found.camera}
        if result.objects is None:
            self.without_ours += 1
        else:
            about = frame.index, frame.stamp, frame.received, frame.pose
            self._waiting[frame.stamp] = Ours(*about, seen(result), images)
        for stamp, found in late:
            if isinstance(found, LabelledBoxes2D):
                self._add_images(stamp, found)
        self._late |= {stamp: boxes for stamp, boxes in in_space.items() if boxes.topic == self.topic}
        compared = []
        theirs = published(frame, self.topic, result.config) if self.topic else None
        if theirs is not None and frame.stamp in self._waiting:
            compared.append(self._compare(self._waiting.pop(frame.stamp), seen(theirs)))
        for stamp in sorted(self._late.keys() & self._waiting.keys()):
            ours, boxes = self._waiting.pop(stamp), self._late.pop(stamp)
            compared.append(self._compare(ours, _placed(boxes, ours.world_from_points)))
        _forget(self._waiting)
        _forget(self._late)
        _forget(self._images)
        return sorted(compared, key=lambda one: one.found.stamp)

    def reason(self) -> str | None:
        """Why the flight recorder should save: both have differed for ``live.robot_time``; once each time."""
        with self._lock:
            reason, self._reason = self._reason, ""
        return reason or None

    def _add_images(self, stamp: int, found: LabelledBoxes2D) -> None:
        if stamp in self._compared or not found.camera:
            self.late_images += 1
        else:
            self._images.setdefault(stamp, {})[found.camera] = _image_boxes(found)

    def _choose(self, topic: str) -> None:
        if topic in self._topics:
            return
        self._topics.add(topic)
        try:
            self.topic, self.problem = robot_topic(tuple(sorted(self._topics)), self._asked), ""
        except UserError as error:
            self.topic, self.problem = "", str(error)

    def _compare(self, ours: Ours, theirs: Seen) -> Compared:
        self._compared.append(ours.stamp)
        images = {**ours.images, **theirs.images, **self._images.pop(ours.stamp, {})}
        found = differences(ours.index, ours.stamp, ours.seen, replace(theirs, images=images))
        different = [d for d in found.objects if self._differs(d)]
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
                words = ", ".join(f"{_words(d)} {place(d, found)}" for d in different[:3])
                more = f" and {len(different) - 3} more" if different[3:] else ""
                with self._lock:
                    self._reason = f"robot and ours differ for {lasted:.1f} s: {words}{more}"
        return Compared(found, ours.received, ours.world_from_points)

    def _differs(self, difference: Difference) -> bool:
        if difference.change is Change.MOVED:
            return difference.distance > self.config.robot_tolerance
        return difference.change is not Change.SAME


def _forget(waiting: dict[int, T]) -> None:
    while len(waiting) > WAITING:
        del waiting[next(iter(waiting))]


def _words(difference: Difference) -> str:
    if difference.change is Change.ONLY_A:
        return f"{difference.name_a} of ours alone"
    if difference.change is Change.ONLY_B:
        return f"{difference.name_b} of the robot alone"
    if difference.change is Change.CLASS:
        return f"our {difference.name_a} is the robot's {difference.name_b}"
    return f"{difference.name_a} {difference.distance:.2f} m apart"


def _image_boxes(found: LabelledBoxes2D) -> ImageBoxes:
    return ImageBoxes(found.xyxy, found.labels)


def _placed(labelled: LabelledBoxes3D, world_from_points: F64) -> Seen:
    """The robot's boxes in the frame of the points of a former frame."""
    world = np.eye(4) if labelled.world_from_boxes is None else labelled.world_from_boxes
    boxes = geometry.moved(labelled.boxes, geometry.inverse(world_from_points) @ world)
    return Seen(boxes, labelled.labels, labelled.scores)
