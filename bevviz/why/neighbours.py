"""Effect of a change on the frames before and after."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cached_property

from pydantic import ValidationError

from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.evaluate import judge, truth_of
from bevviz.model.frame import Frame
from bevviz.model.protocols import FrameSource
from bevviz.model.results import Decision
from bevviz.pipeline.perceive import perceive
from bevviz.pipeline.stage_loader import StageLoader
from bevviz.pipeline.stage_log import Memo
from bevviz.why.changes import Change, with_changes
from bevviz.why.false_objects import false_reasons
from bevviz.why.frame_index import FrameIndex

FrameLookup = Callable[[], Iterable[Frame]]


def frames_beside(source: FrameSource, number: int) -> FrameLookup:
    """Return a function that reads the frames before and after one of a source."""

    def read() -> list[Frame]:
        numbers = (beside for beside in (number - 1, number + 1) if 0 <= beside < len(source.scans))
        return [frame for beside in numbers if (frame := source.frame(beside)) is not None]

    return read


class NeighbourRuns:
    """Runs of the frames before and after, which tell whether a change helps them, too.

    Args:
        frames: returns these frames. They are read at the first question.
        config: configuration in force.
        loader: stage loader with the networks already loaded.
    """

    def __init__(self, frames: FrameLookup, config: Config, loader: StageLoader) -> None:
        self._read, self._config, self._loader = frames, config, loader

    @cached_property
    def _frames(self) -> list[tuple[Frame, Memo, int]]:
        """The frames, with the results of their stages and their score before any change."""
        frames = []
        for frame in self._read():
            memo = Memo()
            frames.append((frame, memo, self._score(frame, memo, self._config)))
        return frames

    def balance(self, change: Change) -> int | None:
        """Return how many more objects a change fixes there than it breaks. None: there are no such frames.

        Without ground truth, doubtful objects and detections without an object count as broken.
        """
        if not self._frames:
            return None
        try:
            config = with_changes(self._config, change)
            return sum(self._score(frame, memo, config) - before for frame, memo, before in self._frames)
        except (UserError, ValidationError):
            return None

    def _score(self, frame: Frame, memo: Memo, config: Config) -> int:
        """Return the number of right objects minus that of wrong ones."""
        result = perceive(frame, config, self._loader.load(config), memo)
        if frame.truth is not None and result.objects is not None:
            matches = judge(result.objects, truth_of(frame, frame.truth), result.cameras)
            return int(matches.true.sum()) - int(matches.false.sum())
        unmatched = sum(
            int((camera.fusion.detection_decision[camera.detections.kept] != Decision.MATCHED).sum())
            for camera in result.cameras
            if camera.fusion is not None and camera.detections is not None
        )
        return -unmatched - len(false_reasons(FrameIndex(result)))
