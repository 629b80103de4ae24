"""The drive that ships with bevviz: a street with ground truth, for tests that do not need the simulator."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import bevviz
from bevviz.bags.source import BagSource
from bevviz.config import load
from bevviz.model.frame import Frame, Scene

BAG = Path(bevviz.__file__).parent / "data" / "demo.mcap"
FRAMES = 16
CHILD = 5  # frame in which the planted child is seen best


@cache
def frames() -> tuple[Frame, ...]:
    """Return the frames of the drive, read once for all tests of a process."""
    with BagSource([BAG], load()) as source:
        return tuple(source)


@cache
def scene() -> Scene:
    """Return the scene of the drive."""
    with BagSource([BAG], load()) as source:
        return source.scene


def frame(number: int = CHILD) -> Frame:
    """Return one frame of the drive."""
    return frames()[number]
