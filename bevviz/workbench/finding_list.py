"""The list of what is worth a look: one entry for one thing, however many frames it lasts."""

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

REACH = 2.5  # metres that a thing may have moved since the last frame that it was found in
GAP = 5  # frames that it may have been away for
SAME_BOX = 0.3  # IoU of the image boxes of one detection in two frames


@dataclass(frozen=True, slots=True)
class Sight:
    """One frame that an entry is of.

    Attributes:
        frame: number of its scan.
        stamp: of that, nanoseconds.
        distance: metres; NaN where it is not known.
        pick: that asks about it; empty: nothing to ask.
        tried: whether it is to be seen with what was changed, rather than as the drive was opened.
        text: why it is so in this frame.
    """

    frame: int
    stamp: int
    distance: float
    pick: str
    tried: bool = False
    text: str = ""

    def as_list(self) -> list[Any]:
        """For the page, which counts in doubles."""
        away = None if math.isnan(self.distance) else round(self.distance, 1)
        return [self.frame, str(self.stamp), away, self.pick, self.tried, self.text]


@dataclass(slots=True)
class Entry:
    """One thing in all of its frames."""

    number: int
    what: str
    name: str
    sights: list[Sight] = field(default_factory=list)
    place: Place | None = None  # where it was last
    box: F32 | None = None


class Entries:
    """All of them; written by one thread at a time, read by any."""

    def __init__(self) -> None:
        self._entries: dict[int, Entry] = {}
        self._open: dict[tuple[str, str], list[Entry]] = {}
        self._number = 0
        self._lock = threading.Lock()

    def add(self, found: Iterable[Find], *, tried: bool = False) -> None:
        """Of the next frame. A thing of the same kind and name near where one just was is that one."""
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
        """Those that began with a frame."""
        with self._lock:
            for anomaly in new:
                kind = anomaly.kind.replace("_", " ")
                sight = Sight(frame, stamp, math.nan, "", text=anomaly.text)
                self._new("anomaly", kind).sights.append(sight)

    def replace(self, whats: Sequence[str]) -> None:
        """Drop all of these kinds: others are to come."""
        with self._lock:
            for number in [n for n, entry in self._entries.items() if entry.what in whats]:
                del self._entries[number]
            for key in [key for key in self._open if key[0] in whats]:
                del self._open[key]

    def news(self, told: dict[int, int]) -> Iterator[dict[str, Any]]:
        """What a page has not been told; ``told``: how many frames of each entry it has been."""
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
    """How far it is from where the entry last was, of how far it may be."""
    if entry.place is not None and find.place is not None:
        return float(np.linalg.norm(np.subtract(entry.place, find.place))) / REACH
    if entry.box is not None and find.box is not None:
        return 1.0 if iou(entry.box[None], find.box[None])[0, 0] >= SAME_BOX else math.inf
    return math.inf
