"""How a frame went, as numbers to plot: times, rates, counts, clocks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from bevviz.counts import counts_of
from bevviz.frame import Frame, FrameResult
from bevviz.logging import entities
from bevviz.logging.writer import Writer


def log_health(to: Writer, result: FrameResult, last: Frame | None, more: Mapping[str, float]) -> None:
    """``last``: the frame before it; ``more``: further scalars, by entity."""
    for path, value in (*health(result, last), *more.items()):
        if np.isfinite(value):
            to.scalar(path, float(value))


def health(result: FrameResult, last: Frame | None) -> Iterator[tuple[str, float]]:
    """Entity and value of every scalar of a frame; ``last`` is the frame before it. NaN: not known."""
    frame = result.frame
    for stage, seconds in result.timings.items():
        yield entities.stage_time(stage), seconds * 1e3
    if result.timings.get("total"):
        yield entities.rate("pipeline"), 1 / result.timings["total"]
    if last is not None:
        if frame.stamp > last.stamp:
            yield entities.rate("sensor"), 1e9 / (frame.stamp - last.stamp)
        if frame.received > last.received > 0:
            yield entities.rate("received"), 1e9 / (frame.received - last.received)
    for what, number in counts_of(result, last).items():
        yield entities.count(what), number
    yield entities.tf_age(frame.lidar), frame.tf_age * 1e3
    for camera in result.cameras:
        yield entities.sync_error(camera.camera.name), camera.camera.sync_error * 1e3
        yield entities.tf_age(camera.camera.name), camera.camera.tf_age * 1e3
