"""Thinning of frames and points on purpose, to reduce the load."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pyarrow as pa
import rerun as rr

from bevviz.config import Config
from bevviz.model.frame import I64, Frame, LateBoxes, Scene, Source, UserMark
from bevviz.recording.cloud import ColoredPoints


class Thinned:
    """Source that leaves out frames and points as the configuration asks.

    Args:
        source: source of the frames. If it has a method ``stop``, that ends it.
        config: returns the current configuration.
        clock: returns seconds, for tests.
    """

    def __init__(
        self, source: Source, config: Callable[[], Config], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.thinned = 0
        self._source, self._config, self._clock = source, config, clock

    @property
    def scene(self) -> Scene:
        """Names of the sensors."""
        return self._source.scene

    @property
    def total(self) -> int | None:
        """Number of frames of the source, if known."""
        return self._source.total

    @property
    def warnings(self) -> Sequence[str]:
        """Warnings of the source."""
        return self._source.warnings

    @property
    def dropped(self) -> int:
        """Frames that the source itself has dropped."""
        return int(getattr(self._source, "dropped", 0))

    @property
    def states(self) -> Mapping[str, str]:
        """State of each topic, if the source has topics."""
        return getattr(self._source, "states", {})

    def overtaken(self) -> tuple[LateBoxes, ...]:
        """Return the robot's results that came too late for their frames, since the last call."""
        overtaken = getattr(self._source, "overtaken", None)
        return () if overtaken is None else tuple(overtaken())

    def marks(self, index: int) -> tuple[UserMark, ...]:
        """Return the users' marks up to the frame of this index, since the last call."""
        marks = getattr(self._source, "marks", None)
        return () if marks is None else tuple(marks(index))

    def stop(self) -> None:
        """End the iteration of the source."""
        stop = getattr(self._source, "stop", None)
        if stop is not None:
            stop()

    def __iter__(self) -> Iterator[Frame]:
        earliest = 0.0
        for number, frame in enumerate(self._source):
            live, now = self._config().live, self._clock()
            if number % live.every or now < earliest:
                self.thinned += 1
                continue
            if live.max_rate is not None:
                # A frame that comes a little early keeps its turn. A pause permits no burst afterwards.
                earliest = max(earliest + 1 / live.max_rate, now - 0.5 / live.max_rate)
            yield thin(frame, live.points)


def thin(frame: Frame, points: int | None) -> Frame:
    """Return the frame with at most ``points`` points, chosen at random as in ``chosen``.

    A fixed step would choose the same ring of the LiDAR again and again.
    """
    count = len(frame.points)
    if points is None or count <= points:
        return frame
    rows = chosen(count, points, frame.index)
    ends = np.cumsum([len(cloud.xyz) for cloud in frame.clouds])
    clouds = []
    for cloud, end in zip(frame.clouds, ends.tolist(), strict=True):
        kept = rows[(rows >= end - len(cloud.xyz)) & (rows < end)] - (end - len(cloud.xyz))
        fields = {name: values[kept] for name, values in cloud.fields.items()}
        clouds.append(replace(cloud, xyz=cloud.xyz[kept], fields=fields))
    return replace(
        frame,
        points=frame.points[rows],
        fields={name: values[rows] for name, values in frame.fields.items()},
        clouds=tuple(clouds),
    )


def chosen(count: int, points: int, seed: int) -> I64:
    """Return the rows of a random sample, in order.

    The rows are divided into ``points`` equal runs, and each run gives one row. If there are fewer rows than
    that, all are returned. The same seed gives the same rows.
    """
    if count <= points:
        return np.arange(count)
    edges = np.arange(points + 1) * count // points
    rows: I64 = np.random.default_rng(seed).integers(edges[:-1], edges[1:])
    return rows


def is_cloud(logged: rr.AsComponents, points: int) -> bool:
    """Return whether an archetype is a cloud with more than ``points`` points."""
    return isinstance(logged, rr.Points3D | rr.Points2D | ColoredPoints) and _count(logged) > points


def thin_cloud(cloud: rr.AsComponents, points: int, seed: int) -> list[rr.DescribedComponentBatch]:
    """Return the components of the ``chosen`` points of a cloud."""
    count = _count(cloud)
    rows = pa.array(chosen(count, points, seed))
    thinned = []
    for batch in cloud.as_component_batches():
        values = batch.as_arrow_array()
        kept = _Values(values.take(rows) if len(values) == count else values)
        thinned.append(rr.DescribedComponentBatch(kept, batch.component_descriptor()))
    return thinned


def _count(cloud: rr.AsComponents) -> int:
    """Return the number of points of a cloud."""
    return max((len(batch.as_arrow_array()) for batch in cloud.as_component_batches()), default=0)


class _Values:
    """Arrow array in the form of a Rerun component."""

    def __init__(self, values: pa.Array) -> None:
        self._values = values

    def as_arrow_array(self) -> pa.Array:
        """Return the array."""
        return self._values
