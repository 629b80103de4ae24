"""What the robot says around its perception, until the next frame takes it along."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from bevviz.frame import F64, Around, Shape, Status

MANY = 200  # statuses and shapes that are kept; the oldest goes
MARKS = 100  # that wait for a frame


class Surroundings:
    """Marks belong to the one frame that comes next; statuses and shapes hold until there are others."""

    def __init__(self) -> None:
        self._marks: list[str] = []
        self._statuses: dict[str, Status] = {}  # by name
        self._shapes: dict[str, list[Shape]] = {}  # by topic

    def add_mark(self, text: str) -> None:
        self._marks.append(text)
        del self._marks[:-MARKS]

    def add_statuses(self, statuses: Sequence[Status]) -> None:
        for status in statuses:
            self._statuses.pop(status.name, None)
            self._statuses[status.name] = status
        while len(self._statuses) > MANY:
            del self._statuses[next(iter(self._statuses))]

    def add_shapes(self, topic: str, shapes: list[Shape]) -> None:
        self._shapes[topic] = shapes[-MANY:]

    def take(self, place: Callable[[str], F64 | None]) -> Around | None:
        """All of it, for a frame; None: there is nothing.

        Args:
            place: (4, 4) world from a frame at the time of the cloud; None: not connected.
        """
        if not (self._marks or self._statuses or self._shapes):
            return None
        shapes = [shape for found in self._shapes.values() for shape in found]
        places = {frame: place(frame) for frame in dict.fromkeys(shape.frame_id for shape in shapes)}
        around = Around(
            marks=tuple(self._marks),
            statuses=tuple(self._statuses.values()),
            shapes=tuple(replace(shape, world_from_shape=places[shape.frame_id]) for shape in shapes),
        )
        self._marks = []
        return around
