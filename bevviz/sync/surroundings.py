"""Buffer of the robot's messages around its perception, until the next frame takes them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from bevviz.model.frame import F64, ComponentStatus, ImuSamples, PlacedShape, RobotContext

_Sample: TypeAlias = tuple[int, int, Sequence[float], Sequence[float]]

MANY = 200  # most statuses and shapes; the oldest is dropped
SAMPLES = 5000  # most Imu samples between two frames; the oldest is dropped
MARKS = 100  # most marks between two frames


class SurroundingsBuffer:
    """Buffer of marks, statuses, shapes and Imu samples.

    A mark or a sample belongs to the next frame only. Statuses and shapes hold until newer ones come.
    """

    def __init__(self) -> None:
        self._marks: list[str] = []
        self._statuses: dict[str, ComponentStatus] = {}  # by name
        self._shapes: dict[str, list[PlacedShape]] = {}  # by topic
        self._samples: dict[str, deque[_Sample]] = {}  # by topic

    def add_mark(self, text: str) -> None:
        """Add a mark."""
        self._marks.append(text)
        del self._marks[:-MARKS]

    def add_motion(
        self, topic: str, stamp: int, received: int, rotation: Sequence[float], acceleration: Sequence[float]
    ) -> None:
        """Add a sample of an Imu: rotation rate and acceleration."""
        samples = self._samples.setdefault(topic, deque(maxlen=SAMPLES))
        samples.append((stamp, received, rotation, acceleration))

    def add_statuses(self, statuses: Sequence[ComponentStatus]) -> None:
        """Add statuses. Each replaces the status of the same name."""
        for status in statuses:
            self._statuses.pop(status.name, None)
            self._statuses[status.name] = status
        while len(self._statuses) > MANY:
            del self._statuses[next(iter(self._statuses))]

    def add_shapes(self, topic: str, shapes: list[PlacedShape]) -> None:
        """Replace the shapes of a topic."""
        self._shapes[topic] = shapes[-MANY:]

    def take(self, pose_of: Callable[[str], F64 | None]) -> RobotContext | None:
        """Return the surroundings for a frame; None if there are none.

        Args:
            pose_of: returns (4, 4) world from a frame at the stamp of the cloud; None: not connected.
        """
        if not (self._marks or self._statuses or self._shapes or self._samples):
            return None
        shapes = [shape for topic_shapes in self._shapes.values() for shape in topic_shapes]
        poses = {frame: pose_of(frame) for frame in dict.fromkeys(shape.frame_id for shape in shapes)}
        around = RobotContext(
            marks=tuple(self._marks),
            statuses=tuple(self._statuses.values()),
            shapes=tuple(replace(shape, world_from_shape=poses[shape.frame_id]) for shape in shapes),
            motions=tuple(_motion(topic, samples) for topic, samples in self._samples.items()),
        )
        self._marks, self._samples = [], {}
        return around


def _motion(topic: str, samples: Iterable[_Sample]) -> ImuSamples:
    stamp, received, rotation, acceleration = zip(*samples, strict=True)
    times = np.array(stamp, np.int64), np.array(received, np.int64)
    return ImuSamples(topic, *times, np.array(rotation, np.float64), np.array(acceleration, np.float64))
