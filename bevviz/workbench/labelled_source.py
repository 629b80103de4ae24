"""Source of a bag whose frames carry a stated ground truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from bevviz.bags.source import BagSource
from bevviz.model.frame import Frame, LabelledBoxes3D, Scene

if TYPE_CHECKING:
    from bevviz.evaluate.ground_truth import TruthLookup


class LabelledSource(BagSource):
    """Bag whose frames carry the ground truth of a topic or of label files.

    Attributes:
        truth_of: returns the ground truth of a frame. None: the frames stay as they are.
    """

    truth_of: TruthLookup | None = None

    @property
    def scene(self) -> Scene:
        """Names that entities and blueprints are made from."""
        return super().scene if self.truth_of is None else replace(super().scene, truth=True)

    def __iter__(self) -> Iterator[Frame]:
        return map(self._labelled, super().__iter__())

    def frame(self, number: int) -> Frame | None:
        """Return a frame with its ground truth."""
        frame = super().frame(number)
        return None if frame is None else self._labelled(frame)

    def _labelled(self, frame: Frame) -> Frame:
        truth = None if self.truth_of is None else self.truth_of(frame)
        if truth is None:
            return frame
        scores = np.ones(len(truth.labels), np.float32)
        boxes = LabelledBoxes3D(
            "",
            frame.stamp,
            frame.points_frame,
            truth.boxes,
            truth.labels,
            scores,
            frame.pose,
            ids=truth.ids,
            image=truth.image,
        )
        return replace(frame, truth=boxes)
