"""What everything that logs frame after frame has in common: the clocks, and that nothing old stays."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import rerun as rr

from bevviz.logging import entities


class Writer:
    """Writes frames to a recording, on the timelines ``stamp``, ``frame`` and ``received``.

    Args:
        recording: where to; it may have any number of sinks.
        root: entity that everything goes under; empty: paths are as they are.
    """

    def __init__(self, recording: rr.RecordingStream, root: str = "") -> None:
        self._recording = recording
        self._root = root
        self._known: set[str] = set()  # entities that any frame had
        self._shown: set[str] = set()  # entities with something of the frame before
        self._now: set[str] = set()
        self.sequences: Mapping[str, int] = {}  # further timelines, and where on them what comes next is

    def _begin(self, index: int, stamp: int, received: int) -> None:
        """Start a frame. Stamps in nanoseconds, ``received`` 0 where it is not known."""
        self._now = set()
        self._set_time(index, stamp, received)

    def _end(self) -> None:
        """Clear what the frame before had and this one has not."""
        self._known |= self._now
        for path in self._shown - self._now:
            self._log(path, rr.Clear(recursive=False))
        self._shown = self._now

    def _static(self, path: str, *archetypes: rr.AsComponents) -> None:
        for archetype in archetypes:
            self._recording.log(self._root + path, archetype, static=True)

    def _put(self, path: str, *archetypes: rr.AsComponents) -> None:
        """Something of this frame alone."""
        self._log(path, *archetypes)
        self._now.add(path)

    def _log(self, path: str, *archetypes: rr.AsComponents) -> None:
        self._recording.log(self._root + path, *archetypes)

    def _set_time(self, index: int, stamp: int, received: int) -> None:
        self._recording.reset_time()
        self._recording.set_time(entities.FRAME, sequence=index)
        self._recording.set_time(entities.STAMP, timestamp=np.datetime64(stamp, "ns"))
        if received:
            self._recording.set_time(entities.RECEIVED, timestamp=np.datetime64(received, "ns"))
        for name, number in self.sequences.items():
            self._recording.set_time(name, sequence=number)
