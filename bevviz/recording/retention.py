"""How much a recording keeps: everything, what an inspection needs, or what a report needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevviz.config import Config, LoggingConfig
from bevviz.model.frame import F32, I64

FINE = 4  # steps in a voxel, at most, that the points of clusters are rounded to where less is kept
COARSE = 2  # the same of the ground and of what is in no cluster
PIXEL = 2  # steps of a pixel that obstacle points in the image are rounded to
BEV_QUALITY = 60  # JPEG, of the bird's-eye view: no detail of it is any but the points'
LOSSY = ("image/jpeg", "image/webp")


def is_whole(config: Config) -> bool:
    return config.logging.keep == "everything"


def left_out(config: LoggingConfig) -> tuple[str, ...]:
    """What a recording lacks, one sentence each, for whoever looks at it."""
    if config.keep == "everything":
        return ()
    raw = (
        f"raw clouds: there is that of each {config.raw_every}th frame, and those within "
        f"{config.raw_around:g} s of where an anomaly begins, a person's mark, or where the state of the "
        "pipeline, of a camera or the configuration changes; where anomalies and states come thick, of "
        f"{100 * config.raw_share:g} % of all frames"
        if config.keep == "inspect"
        else "raw clouds, the voxels of the ground and of what is in no cluster, the obstacle points over "
        "the images and the grid on the ground"
    )
    return (
        raw,
        "voxels are rounded, to half a voxel at most in clusters and to a whole one elsewhere, and are there "
        "once: those of clusters with the clusters, not among the obstacles",
        "images that came raw or without loss: they are H.264, and the bird's-eye view is JPEG of quality "
        f"{BEV_QUALITY}",
        "what is missing is in the bag: 'bevviz open' and 'bevviz why' with this recording read it there",
    )


# --- order -------------------------------------------------------------------------------------


def step(voxel_size: float, parts: int) -> float:
    """Steps in a metre, a power of two: so many in a voxel, or up to half as many. 0: not rounded."""
    return 0.0 if voxel_size == 0 else float(2.0 ** np.floor(np.log2(parts / voxel_size)))


def sorted_rows(points: F32, scale: float, first: I64 | None = None) -> I64:
    """Rows of (N, 2) or (N, 3) points so that neighbours share their last, then their middle coordinate.

    LZ4, which recordings are packed with, has no entropy coding: it gains from what is repeated.

    Args:
        points: any.
        scale: steps in a unit that they are rounded to.
        first: (N,) numbers that go before the coordinates.
    """
    cells = np.clip(np.rint(points * np.float32(scale or 32.0)), -(1 << 14), (1 << 14) - 1).astype(np.int64)
    key = np.zeros(len(points), np.int64) if first is None else first.astype(np.int64)
    for axis in reversed(range(points.shape[1])):
        key = (key << 15) + cells[:, axis] + (1 << 14)
    return np.argsort(key)


# --- raw clouds --------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Held:
    """A frame whose raw clouds may be wanted yet."""

    clock: tuple[int, int, int]  # index, stamp and received
    clouds: Sequence[tuple[str, F32, NDArray[np.uint16]]]  # entity, points, class id of each


class Around:
    """Which frames' raw clouds are kept: so many are held as fit into ``raw_around`` seconds, and no more.

    What begins of itself, again and again where a sensor fails, has those around it only while all that were
    kept for that reason are fewer than ``raw_share`` of the frames so far; the first time it has them.

    Attributes:
        left_out: times that something began and did not have them.
    """

    LONGEST = 100  # frames that are held at most, however fast they come

    def __init__(self) -> None:
        self.left_out = 0
        self._held: list[Held] = []
        self._until = -1
        self._count = self._spent = 0

    @property
    def held(self) -> int:
        """Frames that may be wanted yet."""
        return len(self._held)

    def see(
        self, frame: Held, config: LoggingConfig, *, strange: bool, wanted: bool = False
    ) -> Sequence[Held]:
        """Those to be logged now, oldest first.

        Args:
            frame: the next one.
            config: how many.
            strange: whether something begins here.
            wanted: whether somebody has seen to it that it does.
        """
        stamp, around = frame.clock[1], round(config.raw_around * 1e9)
        if self._held and stamp < self._held[-1].clock[1]:
            self._held, self._until = [], -1
        self._held = [one for one in self._held[-self.LONGEST :] if stamp - one.clock[1] <= around]
        nth = self._count % config.raw_every == 0
        self._count += 1
        if strange and not wanted:
            strange = not self._spent or self._spent < config.raw_share * self._count
            self.left_out += not strange
        if strange or wanted:
            self._until = stamp + around
            found, self._held = [*self._held, frame], []
            self._spent += len(found) - nth
            return found
        if nth or stamp <= self._until:
            self._spent += not nth
            return [frame]
        self._held.append(frame)
        return []
