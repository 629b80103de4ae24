"""What everything that logs frame after frame has in common: the clocks, and that nothing old stays."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Self

import numpy as np
import rerun as rr

from bevviz.logging import entities

STAMPS = (entities.STAMP, entities.RECEIVED)  # timelines in nanoseconds; the others count
WAIT = 1.0  # seconds, for a recording rather than for a robot's operator


class Writer:
    """Writes frames to a recording, on the timelines ``stamp``, ``frame`` and ``received``.

    Args:
        recording: where to; it may have any number of sinks.
        root: entity that everything goes under; empty: paths are as they are.
        wait: seconds that numbers to plot may wait for those of the next frames: sent together, as columns,
            they take a fraction of the time. Then use it as a context manager, which sends the last of them.
    """

    def __init__(self, recording: rr.RecordingStream, root: str = "", wait: float = 0.0) -> None:
        self._recording = recording
        self._root = root
        self._wait = wait
        self._clock: dict[str, int] = {}  # timeline -> where on it this frame is
        self._scalars: dict[str, list[tuple[dict[str, int], float]]] = defaultdict(list)
        self._sent = time.monotonic()
        self._known: set[str] = set()  # entities that any frame had
        self._shown: set[str] = set()  # entities with something of the frame before
        self._now: set[str] = set()
        self.sequences: Mapping[str, int] = {}  # further timelines, and where on them what comes next is

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.flush()

    def _begin(self, index: int, stamp: int, received: int) -> None:
        """Start a frame. Stamps in nanoseconds, ``received`` 0 where it is not known."""
        self._now = set()
        before = self._clock
        self._set_time(index, stamp, received)
        if before.keys() != self._clock.keys():
            self.flush()  # a column has the same timelines from end to end

    def _end(self) -> None:
        """Clear what the frame before had and this one has not."""
        self._known |= self._now
        for path in self._shown - self._now:
            self._log(path, rr.Clear(recursive=False))
        self._shown = self._now
        if time.monotonic() - self._sent >= self._wait:
            self.flush()

    def flush(self) -> None:
        """Send what waits for more of its kind."""
        for path, rows in self._scalars.items():
            clocks, values = zip(*rows, strict=True)
            self._columns(path, clocks, rr.Scalars.columns(scalars=values))
        self._scalars.clear()
        self._sent = time.monotonic()

    def _static(self, path: str, *archetypes: rr.AsComponents) -> None:
        for archetype in archetypes:
            self._recording.log(self._root + path, archetype, static=True)

    def _put(self, path: str, *archetypes: rr.AsComponents) -> None:
        """Something of this frame alone."""
        self._log(path, *archetypes)
        self._now.add(path)

    def _log(self, path: str, *archetypes: rr.AsComponents) -> None:
        self._recording.log(self._root + path, *archetypes)

    def _scalar(self, path: str, value: float) -> None:
        if self._wait > 0:
            self._scalars[path].append((self._clock, value))
        else:
            self._log(path, rr.Scalars(value))

    def _columns(self, path: str, clocks: Sequence[dict[str, int]], columns: rr.ComponentColumnList) -> None:
        """Several rows of one entity, each with its place on the timelines."""
        times = []
        for name in clocks[0]:
            numbers = [clock[name] for clock in clocks]
            if name in STAMPS:
                times.append(rr.TimeColumn(name, timestamp=np.array(numbers, "datetime64[ns]")))
            else:
                times.append(rr.TimeColumn(name, sequence=numbers))
        rr.send_columns(self._root + path, times, columns, recording=self._recording)

    def _set_time(self, index: int, stamp: int, received: int) -> None:
        self._clock = {entities.FRAME: index, entities.STAMP: stamp}
        if received:
            self._clock[entities.RECEIVED] = received
        self._clock |= self.sequences
        self._recording.reset_time()
        for name, number in self._clock.items():
            if name in STAMPS:
                self._recording.set_time(name, timestamp=np.datetime64(number, "ns"))
            else:
                self._recording.set_time(name, sequence=number)
