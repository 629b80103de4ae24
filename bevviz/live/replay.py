"""Frames played in real time, over and over: a robot to try the live mode on, and to measure it with."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

from bevviz.model.frame import Frame, Scene


class Replay:
    """Plays the frames forth and back, so that nothing jumps, at a steady rate: a source without end.

    Stamps and times of receipt are those of a sensor that works now.

    Args:
        frames: in order of time.
        scene: what they show.
        rate: frames a second.
        total: frames after which it ends; None: never.
    """

    def __init__(
        self, frames: Sequence[Frame], scene: Scene, *, rate: float = 10.0, total: int | None = None
    ) -> None:
        self.scene = scene
        self.total = total
        self.warnings: tuple[str, ...] = ()
        self._frames = [*frames, *frames[-2:0:-1]]
        self._period = 1 / rate
        self._stopped = threading.Event()

    def stop(self) -> None:
        """End the iteration, from any thread."""
        self._stopped.set()

    def __iter__(self) -> Iterator[Frame]:
        start = time.monotonic()
        index = 0
        while self.total is None or index < self.total:
            if self._stopped.wait(max(0.0, start + index * self._period - time.monotonic())):
                return
            yield _at(self._frames[index % len(self._frames)], index, time.time_ns())
            index += 1


def _at(frame: Frame, index: int, now: int) -> Frame:
    """The frame as if its cloud were received now."""
    shift = now - frame.received
    stamp = frame.stamp + shift
    cameras = [
        replace(c, image=c.image and replace(c.image, stamp=c.image.stamp + shift, received=now))
        for c in frame.cameras
    ]
    return replace(
        frame,
        index=index,
        stamp=stamp,
        received=now,
        clouds=tuple(replace(c, stamp=c.stamp + shift, received=now) for c in frame.clouds),
        cameras=tuple(cameras),
        robot_boxes=tuple(replace(b, stamp=b.stamp + shift) for b in frame.robot_boxes),
        robot_detections=tuple(replace(d, stamp=d.stamp + shift) for d in frame.robot_detections),
        truth=frame.truth and replace(frame.truth, stamp=frame.truth.stamp + shift),
    )
