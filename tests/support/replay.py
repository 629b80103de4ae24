"""Frames replayed as of a robot. As a program, ``replay.py N live ...`` runs ``bevviz live`` on N scans."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from bevviz.live.problems import CurrentProblems
from bevviz.model.frame import Frame, LateBoxes, Scene, UserMark

if TYPE_CHECKING:
    from bevviz.cli.live import LiveOptions
    from bevviz.config.reloading import ReloadableConfig
    from bevviz.live.companions import Companion
    from bevviz.live.raw_recorder import RawRecorder
    from bevviz.live.run_outputs import Outputs
    from bevviz.live.status import Notes
    from bevviz.pipeline.stage_loader import StageLoader


class Replay:
    """Endless source that plays frames forward and backward at a steady rate, so that nothing jumps.

    Stamps and times of receipt are shifted to the current time. It has no topics and takes no marks.

    Args:
        frames: frames in order of time.
        scene: names of the sensors.
        rate: frames a second.
        total: frames until it ends. None: it does not end.
    """

    dropped = 0
    states: Mapping[str, str] = MappingProxyType({})

    def __init__(
        self, frames: Sequence[Frame], scene: Scene, *, rate: float = 10.0, total: int | None = None
    ) -> None:
        self.scene = replace(scene, bag=(), topics=())  # A robot has no bag.
        self.total = total
        self.warnings: tuple[str, ...] = ()
        self.problems = CurrentProblems(lambda text: None)
        self.raw: RawRecorder | None = None
        self._frames = [*frames, *frames[-2:0:-1]]
        self._period = 1 / rate
        self._stopped = threading.Event()

    def overtaken(self) -> tuple[LateBoxes, ...]:
        """Return no results that came too late."""
        return ()

    def marks(self, index: int) -> tuple[UserMark, ...]:
        """Return no marks."""
        return ()

    def mark(self, text: str) -> None:
        """Leave a mark out."""

    def stop(self) -> None:
        """End the iteration. Any thread may call it."""
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
    """Return the frame with its times shifted, so that its cloud is received now."""
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


def main() -> int:
    """Run ``bevviz live`` on scans of the synthetic drive in place of a robot."""
    from bevviz.cli import live
    from bevviz.cli import main as run_command
    from bevviz.errors import UserError
    from bevviz.extras.demo.drive import SyntheticSource
    from bevviz.live.requests import Control

    count, *arguments = sys.argv[1:]

    def run(
        settings: ReloadableConfig,
        options: LiveOptions,
        outputs: Outputs,
        notes: Notes,
        loader: StageLoader,
        companions: Sequence[Companion],
    ) -> int:
        simulated = SyntheticSource(int(count))
        source = Replay(list(simulated), simulated.scene)
        source.problems.tell = notes.warn

        def refuse(path: Path | None) -> Path:
            raise UserError("the run has not begun")

        with Control(refuse, notes.warn) as control:
            return live._watch(source, settings, options, outputs, notes, loader, companions, control)

    live._run = run
    return run_command(arguments)


if __name__ == "__main__":
    sys.exit(main())
