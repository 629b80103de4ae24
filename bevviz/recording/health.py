"""Log numbers of a frame over time: times, rates, counts, clock errors, anomalies."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from math import isfinite

import rerun as rr

from bevviz.anomalies import KINDS
from bevviz.model.counts import OPINIONS, count_results
from bevviz.model.frame import Frame
from bevviz.model.results import Anomaly, FrameResult
from bevviz.recording import entities
from bevviz.recording.components import Components
from bevviz.recording.writer import Writer
from bevviz.support.colors import SERIES_COLORS, Color

# Curves of one plot, in the order of their colours. The viewer's automatic colours may repeat.
STAGES = (
    *("detector", "clustering", "bev", "ground", "fusion", "tracking", "projection", "voxel", "explain"),
    "total",
)
COUNTS = ("detections", "clusters", "matches", "problems", "failures")

_COLORS: Mapping[str, Color] = {  # by the entity of the curve
    path: color
    for entity, names in ((entities.STAGE_TIME, STAGES), (entities.COUNT, (*COUNTS, *OPINIONS)))
    for path, color in zip(map(entity.path, names), SERIES_COLORS, strict=False)
}
RATE_WINDOW = 1_000_000_000  # nanoseconds that a rate is counted over
MIN_RATE_SPAN = 250_000_000  # nanoseconds, minimum time span for a rate


class FrameRates:
    """Rates at which frames arrive, over the last second.

    A rate needs a minimum time span, because two frames that arrive together have no frequency.
    """

    def __init__(self) -> None:
        self._times: dict[str, deque[int]] = {"sensor": deque(), "received": deque()}

    def add(self, frame: Frame) -> None:
        """Count a frame."""
        for times, stamp in zip(self._times.values(), (frame.stamp, frame.received), strict=True):
            if times and stamp < times[-1]:
                times.clear()
            times.append(stamp)
            while len(times) > 2 and times[1] <= stamp - RATE_WINDOW:
                times.popleft()

    def __iter__(self) -> Iterator[tuple[str, float]]:
        """By what was counted, in Hz; nothing as long as little is known."""
        for clock, times in self._times.items():
            if len(times) > 1 and times[-1] - times[0] >= MIN_RATE_SPAN:
                yield clock, (len(times) - 1) * 1e9 / (times[-1] - times[0])


def log_health(
    to: Writer, result: FrameResult, last: Frame | None, rates: FrameRates, extra_scalars: Mapping[str, float]
) -> None:
    """Log every health scalar of a frame.

    Args:
        to: writer of the recording.
        result: results of the frame.
        last: previous frame.
        rates: rates up to this frame.
        extra_scalars: further scalars, by entity.
    """
    for path, value in (*health(result, last, rates), *extra_scalars.items()):
        if isfinite(value):
            if (color := _COLORS.get(path)) is not None:
                to.static_once(path, partial(rr.SeriesLines, colors=[color], widths=[1.5]))
            to.scalar(path, float(value))


def health(result: FrameResult, last: Frame | None, rates: FrameRates) -> Iterator[tuple[str, float]]:
    """Yield entity and value of every scalar of a frame. NaN means unknown.

    Args:
        result: results of the frame.
        last: previous frame.
        rates: rates up to this frame.
    """
    frame = result.frame
    for stage, seconds in result.timings.items():
        yield entities.STAGE_TIME.path(stage), seconds * 1e3
    if result.timings.get("total"):
        yield entities.RATE.path("pipeline"), 1 / result.timings["total"]
    for name, rate in rates:
        yield entities.RATE.path(name), rate
    for name, number in count_results(result, last).items():
        yield entities.COUNT.path(name), number
    if frame.lidar:
        yield entities.TF_AGE.path(frame.lidar), frame.tf_age * 1e3
    for camera in result.cameras:
        yield entities.SYNC_ERROR.path(camera.camera.name), camera.camera.sync_error * 1e3
        yield entities.TF_AGE.path(camera.camera.name), camera.camera.tf_age * 1e3


# --- anomalies ---------------------------------------------------------------------------------


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
    to.static_once(entities.ANOMALY_COUNTS, lambda: rr.SeriesLines(names=list(KINDS)))
    count = Counter(anomaly.kind for anomaly in result.anomalies)
    counts = [float(count[kind]) for kind in KINDS]
    to.write(entities.ANOMALY_COUNTS, Components(rr.Scalars, {"scalars": counts}))
