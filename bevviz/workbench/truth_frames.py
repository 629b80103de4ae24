"""Frames with ground truth, from any origin."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from bevviz.evaluate import Truth
from bevviz.model.frame import I64, Frame, LabelledBoxes3D, Scene
from bevviz.model.protocols import FrameSource

TruthOf = Callable[[Frame], Truth | None]


class LabelledFrames:
    """A source of frames that adds the ground truth to each frame.

    Args:
        frames: the source.
        truth_of: returns the ground truth of a frame.
    """

    def __init__(self, frames: FrameSource, truth_of: TruthOf) -> None:
        self._frames, self._truth_of = frames, truth_of

    @property
    def scene(self) -> Scene:
        """Scene of the source."""
        return self._frames.scene

    @property
    def total(self) -> int:
        """Number of frames."""
        return self._frames.total

    @property
    def warnings(self) -> Sequence[str]:
        """Warnings of the source."""
        return self._frames.warnings

    @property
    def scans(self) -> I64:
        """Log times of the scans, in nanoseconds."""
        return self._frames.scans

    def __iter__(self) -> Iterator[Frame]:
        return map(self._labelled, self._frames)

    def number_at(self, time: str | float) -> int:
        """Return the number of the frame at a time."""
        return self._frames.number_at(time)

    def frame(self, number: int) -> Frame | None:
        """Return a frame with its ground truth."""
        frame = self._frames.frame(number)
        return None if frame is None else self._labelled(frame)

    def close(self) -> None:
        """Close the source."""
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
