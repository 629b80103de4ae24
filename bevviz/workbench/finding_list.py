"""List of findings over the drive. A finding that lasts several frames is one group."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bevviz.model.frame import F32
from bevviz.model.geometry import iou
from bevviz.model.results import Anomaly
from bevviz.workbench.findings import Find, Place

REACH = 2.5  # metres that an object may have moved since the last frame with this finding
GAP = 5  # frames without the finding after which a new group begins
SAME_BOX = 0.3  # IoU of the image boxes of one detection in two frames


@dataclass(frozen=True, slots=True)
class Sight:
    """One frame of a finding.

    Attributes:
        frame: number of the scan.
        stamp: stamp of the scan, in nanoseconds.
        distance: distance in metres. NaN: unknown.
        pick: pick that asks about it. Empty: there is nothing to ask.
        tried: whether the tried side shows it, rather than the drive as it was opened.
        text: reason in this frame.
    """

    frame: int
    stamp: int
    distance: float
    pick: str
    tried: bool = False
    text: str = ""

    def as_list(self) -> list[Any]:
        """Return the values for the page. The stamp is text: JavaScript numbers cannot hold it."""
        away = None if math.isnan(self.distance) else round(self.distance, 1)
        return [self.frame, str(self.stamp), away, self.pick, self.tried, self.text]


@dataclass(slots=True)
class Entry:
    """One finding in all of its frames."""

    number: int
    what: str
    name: str
    sights: list[Sight] = field(default_factory=list)
    place: Place | None = None  # position in the last frame
    box: F32 | None = None


class Entries:
    """All groups of findings. One thread at a time may add to it, any thread may read it."""

    def __init__(self) -> None:
        self._entries: dict[int, Entry] = {}
        self._open: dict[tuple[str, str], list[Entry]] = {}
        self._number = 0
        self._lock = threading.Lock()

    def add(self, found: Iterable[Find], *, tried: bool = False) -> None:
        """Add the findings of the next frame.

        A finding near a recent one of the same kind and name joins its group.
        """
        with self._lock:
            taken: set[int] = set()
            for find in found:
                entry = self._same(find, taken) or self._new(find.what, find.name)
                taken.add(entry.number)
                entry.place, entry.box = find.place, find.box
                pick = str(find.pick)
                entry.sights.append(Sight(find.frame, find.stamp, find.distance, pick, tried, find.reason))

    def _same(self, find: Find, taken: set[int]) -> Entry | None:
        entries = self._open.get((find.what, find.name), [])
        entries[:] = [e for e in entries if 0 <= find.frame - e.sights[-1].frame <= GAP]
        near = [(_away(e, find), e.number) for e in entries if e.number not in taken]
        best, number = min(near, default=(math.inf, -1))
        return self._entries[number] if best <= 1 else None

    def _new(self, what: str, name: str) -> Entry:
        self._number += 1
        entry = Entry(self._number, what, name)
        self._entries[entry.number] = entry
        self._open.setdefault((what, name), []).append(entry)
        return entry

    def add_anomalies(self, frame: int, stamp: int, new: Sequence[Anomaly]) -> None:
        """Add the anomalies that begin in a frame."""
        with self._lock:
            for anomaly in new:
                kind = anomaly.kind.replace("_", " ")
                sight = Sight(frame, stamp, math.nan, "", text=anomaly.text)
                self._new("anomaly", kind).sights.append(sight)

    def replace(self, whats: Sequence[str]) -> None:
        """Remove all findings of these kinds, before new ones are added."""
        with self._lock:
            for number in [n for n, entry in self._entries.items() if entry.what in whats]:
                del self._entries[number]
            for key in [key for key in self._open if key[0] in whats]:
                del self._open[key]

    def news(self, told: dict[int, int]) -> Iterator[dict[str, Any]]:
        """Yield the news for a page. ``told`` counts the frames that it has of each group."""
        with self._lock:
            gone = [number for number in told if number not in self._entries]
            new = [entry for entry in self._entries.values() if len(entry.sights) > told.get(entry.number, 0)]
            found = [
                {
                    "number": entry.number,
                    "what": entry.what,
                    "name": entry.name,
                    "sights": [sight.as_list() for sight in entry.sights[told.get(entry.number, 0) :]],
                }
                for entry in new
            ]
            told.update((entry.number, len(entry.sights)) for entry in new)
        for number in gone:
            del told[number]
        if gone or found:
            yield {"type": "entries", "entries": found, "gone": gone}


def _away(entry: Entry, find: Find) -> float:
    """Return the distance from the last position of a group, divided by the largest allowed distance."""
    if entry.place is not None and find.place is not None:
        return float(np.linalg.norm(np.subtract(entry.place, find.place))) / REACH
    if entry.box is not None and find.box is not None:
        return 1.0 if iou(entry.box[None], find.box[None])[0, 0] >= SAME_BOX else math.inf
    return math.inf
