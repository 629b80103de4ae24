"""The one list of findings about the input, for every command."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator

from bevviz.anomalies import Onsets
from bevviz.anomalies.sensors import SensorWatch
from bevviz.checks.read_input import ReadInput
from bevviz.config import Config
from bevviz.model.frame import Frame
from bevviz.model.input_findings import InputFinding
from bevviz.model.protocols import Items, Observer
from bevviz.model.results import Anomaly, FrameResult

Check = Callable[[ReadInput], Iterable[InputFinding]]

SENSOR_KINDS = ("sensor", "sync", "tf")  # kinds of anomalies that are about the input


def source_warnings(read: ReadInput) -> Iterator[InputFinding]:
    """Yield what the source counted while it was read."""
    for text in read.source.warnings:
        yield InputFinding("source", "", text)


def sensor_faults(read: ReadInput) -> Iterator[InputFinding]:
    """Yield each kind of fault of each sensor, with the first time and the number of times."""
    for key, anomaly in read.faults.first.items():
        count = read.faults.count[key]
        text = f"{anomaly.text}; {count} times in all" if count > 1 else anomaly.text
        yield InputFinding(anomaly.kind, anomaly.subject, text)


CHECKS: tuple[Check, ...] = (source_warnings, sensor_faults)


class InputChecks(Observer[FrameResult]):
    """Collector of what the checks judge, and the list of their findings.

    It is an observer of a run. ``observe_frame`` takes frames without results instead.

    Args:
        source: the frames.
        config: configuration of the run.
    """

    def __init__(self, source: Items[object], config: Config) -> None:
        self._read = ReadInput(source, config)
        self._lock = threading.Lock()  # A page or a topic may ask for the list during a run.
        self._onsets = Onsets()
        self._watch = SensorWatch()

    def observe(self, result: FrameResult) -> None:
        """Collect what the checks need of one result."""
        self._collect(result, self._onsets.of(result.anomalies))

    def observe_frame(self, frame: Frame, follows: bool = True) -> None:
        """Collect what the checks need of a frame on which no stage ran.

        Args:
            frame: the frame.
            follows: it follows the frame before, so that sensors are compared with their past.
        """
        result = FrameResult.unprocessed(frame, self._read.config)
        self._collect(result, self._onsets.of([*self._watch.update(result)] if follows else []))

    def _collect(self, result: FrameResult, new: Iterable[Anomaly]) -> None:
        """Collect what the checks need of one frame, with the anomalies that began in it."""
        with self._lock:
            for anomaly in new:
                if anomaly.kind in SENSOR_KINDS:
                    key = anomaly.kind, anomaly.subject
                    self._read.faults.first.setdefault(key, anomaly)
                    self._read.faults.count[key] += 1

    @property
    def findings(self) -> list[InputFinding]:
        """All findings so far. A sentence is listed once."""
        with self._lock:
            findings = {str(finding): finding for check in CHECKS for finding in check(self._read)}
        return list(findings.values())

    @property
    def warnings(self) -> list[str]:
        """The same as sentences."""
        return [str(finding) for finding in self.findings]
