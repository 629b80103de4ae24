"""Summaries of a drive: anomalies that began, and stages that failed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from bevviz.model.protocols import Observer
from bevviz.model.results import Anomaly, FrameResult


class Onsets:
    """Filter for the anomalies that begin in a frame. It works even where frames are left out."""

    def __init__(self) -> None:
        self._known: set[tuple[str, str, int]] = set()

    def of(self, anomalies: Sequence[Anomaly]) -> list[Anomaly]:
        """Return the anomalies that the previous call did not have."""
        known, self._known = self._known, {(a.kind, a.subject, a.since) for a in anomalies}
        return [a for a in anomalies if (a.kind, a.subject, a.since) not in known]


class AnomalySummary(Observer[FrameResult]):
    """Counter of the anomalies of each kind in a drive, with the time of the first."""

    def __init__(self) -> None:
        self._onsets = Onsets()
        self._start: int | None = None
        self._count: Counter[str] = Counter()
        self._first: dict[str, tuple[str, int]] = {}  # kind -> subject, nanoseconds from the start

    def observe(self, result: FrameResult) -> None:
        """Count the anomalies that begin in this frame."""
        self._start = result.frame.stamp if self._start is None else self._start
        for anomaly in self._onsets.of(result.anomalies):
            self._count[anomaly.kind] += 1
            self._first.setdefault(anomaly.kind, (anomaly.subject, anomaly.since - self._start))

    def __str__(self) -> str:
        """Return one line, most frequent kind first. Times are in seconds from the first frame."""
        kinds = []
        for kind, count in self._count.most_common():
            subject, time = self._first[kind]
            first = f"{'first: ' if count > 1 else ''}{subject} at {1e-9 * time:.1f} s"
            kinds.append(f"{count} {kind.replace('_', ' ')} ({first})")
        return ", ".join(kinds) or "none"


class FailureSummary(Observer[FrameResult]):
    """Counter of the failures of each stage in a drive, with the reason of the first."""

    def __init__(self) -> None:
        self._frames = 0
        self._count: Counter[str] = Counter()
        self._first: dict[str, str] = {}

    def observe(self, result: FrameResult) -> None:
        """Count the failures of this frame."""
        self._frames += 1
        for failure in result.failures:
            self._count[failure.stage] += 1
            self._first.setdefault(failure.stage, failure.reason)

    @property
    def warnings(self) -> list[str]:
        """One sentence for each stage that failed."""
        return [
            f"{stage} failed in {count} of {self._frames} frames, first: {self._first[stage]}"
            for stage, count in self._count.items()
        ]
