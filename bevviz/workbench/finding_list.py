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
from bevviz.workbench.findings import Finding, Position

REACH = 2.5  # metres that an object may have moved since the last frame with this finding
GAP = 5  # frames without the finding after which a new group begins
SAME_BOX = 0.3  # IoU of the image boxes of one detection in two frames


@dataclass(frozen=True, slots=True)
class FindingFrame:
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
        distance = None if math.isnan(self.distance) else round(self.distance, 1)
        return [self.frame, str(self.stamp), distance, self.pick, self.tried, self.text]


@dataclass(slots=True)
class FindingGroup:
    """One finding in all of its frames."""

    number: int
    what: str
    name: str
    frames: list[FindingFrame] = field(default_factory=list)
    position: Position | None = None  # position in the last frame
    box: F32 | None = None


class FindingList:
    """All groups of findings. One thread at a time may add to it, any thread may read it."""

    def __init__(self) -> None:
        self._groups: dict[int, FindingGroup] = {}
        self._recent: dict[tuple[str, str], list[FindingGroup]] = {}
        self._number = 0
        self._lock = threading.Lock()

    def add(self, findings: Iterable[Finding], *, tried: bool = False) -> None:
        """Add the findings of the next frame.

        A finding near a recent one of the same kind and name joins its group.
        """
        with self._lock:
            taken_groups: set[int] = set()
            for finding in findings:
                group = self._same(finding, taken_groups) or self._new(finding.what, finding.name)
                taken_groups.add(group.number)
                group.position, group.box = finding.position, finding.box
                pick = str(finding.pick)
                group.frames.append(
                    FindingFrame(finding.frame, finding.stamp, finding.distance, pick, tried, finding.reason)
                )

    def _same(self, finding: Finding, taken_groups: set[int]) -> FindingGroup | None:
        groups = self._recent.get((finding.what, finding.name), [])
        groups[:] = [group for group in groups if 0 <= finding.frame - group.frames[-1].frame <= GAP]
        candidates = [
            (_relative_distance(group, finding), group.number)
            for group in groups
            if group.number not in taken_groups
        ]
        best, number = min(candidates, default=(math.inf, -1))
        return self._groups[number] if best <= 1 else None

    def _new(self, kind: str, name: str) -> FindingGroup:
        self._number += 1
        group = FindingGroup(self._number, kind, name)
        self._groups[group.number] = group
        self._recent.setdefault((kind, name), []).append(group)
        return group

    def add_anomalies(self, frame: int, stamp: int, anomalies: Sequence[Anomaly]) -> None:
        """Add the anomalies that begin in a frame."""
        with self._lock:
            for anomaly in anomalies:
                kind = anomaly.kind.replace("_", " ")
                finding_frame = FindingFrame(frame, stamp, math.nan, "", text=anomaly.text)
                self._new("anomaly", kind).frames.append(finding_frame)

    def replace(self, kinds: Sequence[str]) -> None:
        """Remove all findings of these kinds, before new ones are added."""
        with self._lock:
            for number in [number for number, group in self._groups.items() if group.what in kinds]:
                del self._groups[number]
            for key in [key for key in self._recent if key[0] in kinds]:
                del self._recent[key]

    def news(self, sent_counts: dict[int, int]) -> Iterator[dict[str, Any]]:
        """Yield the news for a page. ``sent_counts`` counts the frames that it has of each group."""
        with self._lock:
            gone = [number for number in sent_counts if number not in self._groups]
            changed_groups = [
                group
                for group in self._groups.values()
                if len(group.frames) > sent_counts.get(group.number, 0)
            ]
            new_items = [
                {
                    "number": group.number,
                    "what": group.what,
                    "name": group.name,
                    "sights": [frame.as_list() for frame in group.frames[sent_counts.get(group.number, 0) :]],
                }
                for group in changed_groups
            ]
            sent_counts.update((group.number, len(group.frames)) for group in changed_groups)
        for number in gone:
            del sent_counts[number]
        if gone or new_items:
            yield {"type": "entries", "entries": new_items, "gone": gone}


def _relative_distance(group: FindingGroup, finding: Finding) -> float:
    """Return the distance from the last position of a group, divided by the largest allowed distance."""
    if group.position is not None and finding.position is not None:
        return float(np.linalg.norm(np.subtract(group.position, finding.position))) / REACH
    if group.box is not None and finding.box is not None:
        return 1.0 if iou(group.box[None], finding.box[None])[0, 0] >= SAME_BOX else math.inf
    return math.inf
