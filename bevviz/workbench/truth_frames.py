"""Frames that hold the truth, wherever it comes from: whatever asks about a frame finds it there."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from bevviz.evaluate import Truth
from bevviz.model.frame import I64, Frame, LabelledBoxes3D, Scene
from bevviz.model.protocols import Frames

TruthOf = Callable[[Frame], Truth | None]


class Labelled:
    """A source whose frames have their truth.

    Args:
        frames: the source.
        truth_of: what is known to be there.
    """

    def __init__(self, frames: Frames, truth_of: TruthOf) -> None:
        self._frames, self._truth_of = frames, truth_of

    @property
    def scene(self) -> Scene:
        return self._frames.scene

    @property
    def total(self) -> int:
        return self._frames.total

    @property
    def warnings(self) -> Sequence[str]:
        return self._frames.warnings

    @property
    def scans(self) -> I64:
        return self._frames.scans

    def __iter__(self) -> Iterator[Frame]:
        return map(self._labelled, self._frames)

    def number_at(self, time: str | float) -> int:
        return self._frames.number_at(time)

    def frame(self, number: int) -> Frame | None:
        found = self._frames.frame(number)
        return None if found is None else self._labelled(found)

    def close(self) -> None:
        self._frames.close()

    def _labelled(self, frame: Frame) -> Frame:
        truth = self._truth_of(frame)
        if truth is None:
            return frame
        scores = np.ones(len(truth.labels), np.float32)
        stated = LabelledBoxes3D(
            "", frame.stamp, frame.points_frame, truth.boxes, truth.labels, scores, frame.pose
        )
        return replace(frame, truth=stated)
