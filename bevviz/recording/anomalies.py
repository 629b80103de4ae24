"""Log anomalies: one line when an anomaly begins, and counts over time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import rerun as rr

from bevviz.anomalies import KINDS
from bevviz.model.results import Anomaly, FrameResult
from bevviz.recording import entities
from bevviz.recording.writer import Writer


def log_anomaly_style(to: Writer) -> None:
    """Log the static names of the anomaly count curves."""
    to.static(entities.ANOMALY_COUNTS, rr.SeriesLines(names=list(KINDS)))


def log_anomalies(to: Writer, result: FrameResult, started: Sequence[Anomaly]) -> None:
    """Log new anomalies as lines, and the number of anomalies of each kind.

    Args:
        to: writer of the recording.
        result: results of the frame.
        started: anomalies that begin in this frame.
    """
    to.lines(
        entities.ANOMALY_LOG,
        [(new_anomaly.severity, f"{new_anomaly.kind}: {new_anomaly.text}") for new_anomaly in started],
    )
    count = Counter(anomaly.kind for anomaly in result.anomalies)
    to.write(entities.ANOMALY_COUNTS, rr.Scalars([float(count[kind]) for kind in KINDS]))
