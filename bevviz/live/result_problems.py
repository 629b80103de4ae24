"""Checks of the results of a live run: stages that fail, and sensors that look faulty in several frames."""

from __future__ import annotations

from collections.abc import Iterator

from bevviz.live.problems import CurrentProblems
from bevviz.model.results import FrameResult

LASTING = 3  # frames in a row with an anomaly from which on it is told
OVER = 5  # frames in a row without it after which it is over
SENSOR_KINDS = ("sensor", "sync", "tf", "stage")  # kinds of anomalies that are about the input or the run


class ResultProblems:
    """Current problems in the results. Anomalies of objects and tracks are events of a frame, and left out.

    Args:
        problems: takes the problems.
    """

    def __init__(self, problems: CurrentProblems) -> None:
        self._problems = problems
        self._known: set[tuple[str, str]] = set()  # kind and subject of each problem so far

    def observe(self, result: FrameResult) -> None:
        """Check the result of a frame."""
        found = dict(self._found(result))
        self._known |= found.keys()
        for key in self._known:
            self._problems.set(*key, found.get(key, ""), begins=LASTING, ends=OVER)

    def _found(self, result: FrameResult) -> Iterator[tuple[tuple[str, str], str]]:
        """Yield kind and subject with the sentence of each problem in a frame."""
        for failure in result.failures:
            yield ("failure", failure.stage), f"{failure.stage} fails: {failure.reason}"
        for anomaly in result.anomalies:
            if anomaly.kind in SENSOR_KINDS:
                yield (anomaly.kind, anomaly.subject), anomaly.text
