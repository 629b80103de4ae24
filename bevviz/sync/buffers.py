"""Buffers of messages until a frame takes them: those of a topic by stamp, and those around perception."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Generic, TypeAlias, TypeVar

import numpy as np

from bevviz.model.frame import F64, ComponentStatus, ImuSamples, PlacedShape, RobotContext

T = TypeVar("T")

# Nanoseconds. A stamp that is older than its topic's newest by more means that the clock was reset.
JUMP = 1_000_000_000


class TopicBuffer(Generic[T]):
    """Buffer of the messages of one topic, in order of stamp. It keeps the last ``horizon`` nanoseconds."""

    def __init__(self, horizon: int) -> None:
        self._horizon = horizon
        self._stamps: list[int] = []
        self._items: list[T] = []

    def __len__(self) -> int:
        return len(self._items)

    @property
    def newest(self) -> int | None:
        """Newest stamp; None: the buffer is empty."""
        return self._stamps[-1] if self._stamps else None

    @property
    def oldest(self) -> int | None:
        """Oldest stamp; None: the buffer is empty."""
        return self._stamps[0] if self._stamps else None

    def add(self, stamp: int, item: T) -> bool:
        """Add a message. Return whether it replaces one with the same stamp."""
        if self._stamps and stamp < self._stamps[-1] - JUMP:
            self.keep(0, -1)
        i = bisect_left(self._stamps, stamp)
        if i < len(self._stamps) and self._stamps[i] == stamp:
            self._items[i] = item
            return True
        self._stamps.insert(i, stamp)
        self._items.insert(i, item)
        self.forget(self._stamps[-1] - self._horizon)
        return False

    def nearest(self, stamp: int) -> tuple[int, T] | None:
        """Return stamp and message nearest to a stamp; None if the buffer is empty."""
        near = bisect_left(self._stamps, stamp)
        best = min(range(near - 1, near + 1), key=lambda i: self._distance(i, stamp))
        return (self._stamps[best], self._items[best]) if 0 <= best < len(self) else None

    def _distance(self, i: int, stamp: int) -> float:
        return abs(self._stamps[i] - stamp) if 0 <= i < len(self) else float("inf")

    def take(self, stamp: int, first: int, last: int) -> T | None:
        """Remove and return the message within [first, last] that is nearest to ``stamp``."""
        inside = [i for i, s in enumerate(self._stamps) if first <= s <= last]
        if not inside:
            return None
        best = min(inside, key=lambda i: self._distance(i, stamp))
        del self._stamps[best]
        return self._items.pop(best)

    def shed(self, last: int) -> list[T]:
        """Remove and return the messages up to a stamp."""
        end = bisect_left(self._stamps, last + 1)
        removed, self._items = self._items[:end], self._items[end:]
        del self._stamps[:end]
        return removed

    def forget(self, before: int) -> None:
        """Drop older messages, except the last of them: it may be the nearest to the next cloud."""
        first = max(0, bisect_left(self._stamps, before) - 1)
        del self._stamps[:first], self._items[:first]

    def keep(self, first: int, last: int) -> None:
        """Drop the messages outside [first, last]."""
        low, high = bisect_left(self._stamps, first), bisect_left(self._stamps, last + 1)
        self._stamps, self._items = self._stamps[low:high], self._items[low:high]


def describe_distance(nearest: tuple[int, object] | None, stamp: int, tolerance: int) -> str:
    """Describe how far the nearest message is from a stamp (nanoseconds), for the end of a sentence."""
    within = f"within {tolerance * 1e-9:.2f} s"
    if nearest is None:
        return f"{within}: none at all around this time"
    away = (nearest[0] - stamp) * 1e-9
    return f"{within}: nearest is {abs(away):.2f} s {'later' if away > 0 else 'earlier'}"


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
