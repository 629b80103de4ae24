"""Where frames come from: a bag, the synthetic drive, or a running robot."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from bevviz.frame import Frame


@dataclass(frozen=True, slots=True)
class Scene:
    """What a source will deliver: the names that entities and blueprints are made from."""

    name: str  # of the bag or drive, for the recording's title
    lidar: str  # entity name of Frame.points
    lidars: tuple[str, ...] = ()  # entity name of each LiDAR; the same as lidar where there is one
    cameras: tuple[str, ...] = ()
    robot: bool = False  # the robot's own results come along
    truth: bool = False  # ground truth comes along


class Source(Protocol):
    """An iterable of frames, in order of stamp."""

    @property
    def scene(self) -> Scene: ...

    @property
    def total(self) -> int | None:
        """Frames to expect, for a progress bar; None where unknown."""
        ...

    @property
    def warnings(self) -> Sequence[str]:
        """What was lost or looked wrong so far, one sentence each."""
        ...

    def __iter__(self) -> Iterator[Frame]: ...
