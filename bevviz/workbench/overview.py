"""Overview of a long drive: single frames in an order that covers the whole drive early."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import replace

from bevviz.anomalies.detector import AnomalyDetector
from bevviz.model.frame import Frame, Scene
from bevviz.model.protocols import FrameSource
from bevviz.model.results import FrameResult
from bevviz.pipeline.perceive import add_explanations, perceive
from bevviz.pipeline.session import Session

LEAST = 128  # frames of a drive that gets an overview; a shorter one is run in order almost as soon
STEP = 8  # frames from one to the next at the end of the overview, which takes an eighth of the whole run


def overview_order(total: int) -> list[int]:
    """Return every eighth frame number. Any beginning of the list is spread evenly over the drive."""
    step = 1 << max(total - 1, 0).bit_length()
    numbers = list(range(0, total, step))
    while step > STEP:
        step //= 2
        numbers += range(step, total, 2 * step)
    return numbers


class NumberedFrames:
    """Some frames of a drive as the items of a run. Those that cannot be read are left out.

    Args:
        source: the drive.
        numbers: numbers of the frames.
    """

    def __init__(self, source: FrameSource, numbers: Sequence[int]) -> None:
        self._source, self._numbers = source, numbers

    @property
    def scene(self) -> Scene:
        """Names that entities and blueprints are made from."""
        return self._source.scene

    @property
    def total(self) -> int:
        """Number of the frames."""
        return len(self._numbers)

    @property
    def warnings(self) -> Sequence[str]:
        """Losses and suspicious data so far, one sentence each."""
        return self._source.warnings

    def __iter__(self) -> Iterator[Frame]:
        for number in self._numbers:
            if (frame := self._source.frame(number)) is not None:
                yield frame


class SingleFrames:
    """Processor of frames in any order, without tracks and the anomalies that need the frames before.

    Args:
        session: session with the configuration and the networks.
    """

    def __init__(self, session: Session) -> None:
        self._session, self._anomalies = session, AnomalyDetector()

    def perceive(self, frame: Frame, network: Executor | None = None) -> FrameResult:
        """Run the stages on a frame."""
        return perceive(frame, self._session.config, self._session.stages, network=network)

    def finish(self, result: FrameResult) -> FrameResult:
        """Add the explanations and anomalies to a result."""
        result = add_explanations(result, seen=False)
        return replace(result, anomalies=self._anomalies.update_alone(result, result.config.anomalies))
