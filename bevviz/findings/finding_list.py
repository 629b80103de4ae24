"""List of the findings of a drive. One that lasts several frames is one group."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import takewhile
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import BeforeValidator, PlainSerializer
from typing_extensions import TypedDict  # pydantic needs this one before Python 3.12

from bevviz.findings.frame_findings import KINDS, Finding, Position
from bevviz.model import geometry
from bevviz.model.frame import F32
from bevviz.model.reasons import ReasonKind
from bevviz.support.json_form import message_form

REACH = 2.5  # metres that an object may have moved since the last frame with this finding
GAP = 5  # frames without the finding after which a new group begins
CELL = 64  # frames that single frames of an overview are grouped over
SAME_BOX = 0.3  # IoU of the image boxes of one detection in two frames

DIFFERENCES = {  # kind -> remark
    "fixed": "The tried values report it.",
    "broken": "The tried values lose it, without them it is right.",
    "new false": "The tried values make it, without them it is not there.",
    "false gone": "The tried values remove it.",
    "new": "The tried values make it.",
    "gone": "The tried values lose it.",
}
_SENSOR = "Nothing was tried: no parameter of a stage mends"
_ANOMALIES = {  # kind -> remark
    "sensor": f"{_SENSOR} a sensor.",
    "sync": f"{_SENSOR} the clocks of two sensors.",
    "tf": f"{_SENSOR} a transform.",
    "stage": "Nothing was tried: a stage fails or is slow.",
    "one sensor": "Nothing was tried: it lasts several frames, click an object of it to ask.",
    "jump": "Nothing was tried: it lasts several frames, click the object to ask.",
    "flicker": "Nothing was tried: it lasts several frames, click the object to ask.",
}
REMARKS = DIFFERENCES | _ANOMALIES
SEVERITIES = {**KINDS, "broken": 1.0, "new false": 1.0}  # others: 0
NEAR = 10.0  # metres
LONG = 500_000_000  # nanoseconds until it is seen again
_EVERYTHING = ("sensor", "sync", "tf", "stage")  # anomalies that concern all objects
_UNKNOWN = 99.0  # metres: a finding without a distance comes after the others


def _page_distance(distance: float) -> float | None:
    """Return a distance as the page gets it. None: it is unknown."""
    return None if math.isnan(distance) else round(distance, 1)


def _known_distance(distance: float | None) -> float:
    """Return a distance of a message of the page. NaN: it is unknown."""
    return math.nan if distance is None else distance


@message_form
@dataclass(frozen=True, slots=True)
class FindingFrame:
    """One frame of a finding.

    The page gets the stamp as text, because JavaScript numbers cannot hold it.

    Attributes:
        frame: number of the scan.
        stamp: stamp of the scan, in nanoseconds.
        distance: distance in metres. NaN: unknown.
        pick: text of the selection that asks about it. Empty: there is nothing to ask.
        tried: whether the tried side shows it, rather than the drive as it was opened.
        text: reason in this frame.
        remark: one sentence where no hint can be searched.
        in_way: whether it is in the way of the robot.
    """

    frame: int
    stamp: Annotated[int, PlainSerializer(str, return_type=str)]
    distance: Annotated[
        float, PlainSerializer(_page_distance, return_type=float | None), BeforeValidator(_known_distance)
    ]
    pick: str
    tried: bool = False
    text: str = ""
    remark: str = ""
    in_way: bool = False


class Entry(TypedDict):
    """A group of findings as the page gets it, with the frames that the page does not have yet.

    Lists are in the order of ``rank``. ``reasons`` say why it comes early.
    """

    number: int
    what: str
    name: str
    reasons: list[str]
    rank: tuple[float, ...]
    sights: list[FindingFrame]


class StoredGroup(NamedTuple):
    """Group of findings as it is stored."""

    what: str
    name: str
    frames: list[FindingFrame]


@dataclass(slots=True)
class FindingGroup:
    """One finding in all of its frames. ``add`` sums them up, since a page hears of it after each frame."""

    number: int
    what: str
    name: str
    frames: list[FindingFrame] = field(default_factory=list)
    position: Position | None = None  # position in the last frame
    box: F32 | None = None
    subject: str = ""  # of an anomaly
    stamps: tuple[float, float] = math.inf, -math.inf  # the earliest and the latest one
    nearest: float = math.inf  # metres; infinite: unknown
    is_in_way: bool = False  # in any frame
    is_second_name: bool = True  # in every frame

    def add(self, frame: FindingFrame) -> None:
        """Add a frame."""
        self.frames.append(frame)
        self.stamps = min(self.stamps[0], frame.stamp), max(self.stamps[1], frame.stamp)
        self.nearest = self.nearest if math.isnan(frame.distance) else min(self.nearest, frame.distance)
        self.is_in_way |= frame.in_way
        self.is_second_name &= frame.text == ReasonKind.SECOND_NAME

    @property
    def reasons(self) -> list[str]:
        """Reasons to look at it first. Each counts once."""
        if self.what == "anomaly":
            return ["concerns everything that the sensors see"] * (self.name in _EVERYTHING)
        if self.is_second_name:
            return []
        lasts = self.stamps[1] - self.stamps[0]
        reasons = ["in the way of the robot"] * self.is_in_way
        reasons += [f"nearer than {NEAR:g} m"] * (self.distance <= NEAR)
        return reasons + [f"lasts {lasts / 1e9:.1f} s"] * (lasts >= LONG)

    @property
    def distance(self) -> float:
        """Metres to it in its nearest frame."""
        return _UNKNOWN if math.isinf(self.nearest) else self.nearest

    @property
    def rank(self) -> tuple[float, ...]:
        """Key of the order of lists: number of reasons, severity of its kind, distance and time."""
        most = 3 if self.what == "anomaly" else 1
        severity = SEVERITIES.get(self.what, 0.0)
        first = self.frames[0].stamp if self.frames else 0
        return -most * len(self.reasons), -severity, self.distance, first / 1e9


class FindingList:
    """All groups of findings. One thread at a time may add to it, any thread may read it."""

    def __init__(self) -> None:
        self._groups: dict[int, FindingGroup] = {}  # by number, in the order of their last changes
        self._recent: dict[tuple[str, str], list[FindingGroup]] = {}
        self._overview: dict[int, list[FindingGroup]] = {}  # groups of single frames, by cell of the drive
        self._anomalies: set[str] = set()  # numbers of those that have begun
        self._number = 0
        self._lock = threading.Lock()

    def add(self, findings: Iterable[Finding], *, tried: bool = False) -> None:
        """Add the findings of the next frame.

        A finding near a recent one of the same kind and name joins its group. Of an anomaly the frame in
        which it begins is listed.
        """
        with self._lock:
            taken_groups: set[int] = set()
            for finding in findings:
                if finding.what == "anomaly":
                    if finding.number in self._anomalies:
                        continue
                    self._anomalies.add(finding.number)
                group = self._same(finding, taken_groups) or self._new_recent(finding.what, finding.name)
                self._extend(group, finding, taken_groups, tried)

    def add_overview(self, frame: int, findings: Iterable[Finding]) -> None:
        """Add the findings of a single frame. They stay until ``end_overview`` reaches the frame.

        A finding near one of the same kind and name joins its group, within ``CELL`` frames. There an anomaly
        is listed once.
        """
        with self._lock:
            groups, taken_groups = self._overview.setdefault(frame // CELL, []), set[int]()
            for finding in findings:
                kind = finding.what, finding.name
                subject = finding.subject
                if subject and any((one.what, one.subject) == ("anomaly", subject) for one in groups):
                    continue
                near = _nearest(
                    (one for one in groups if (one.what, one.name) == kind), finding, taken_groups
                )
                if near is None:
                    groups.append(near := self._new(*kind))
                self._extend(near, finding, taken_groups)

    def end_overview(self, frame: int) -> None:
        """Remove the findings of single frames up to the cell of a frame. The run in order has reached it."""
        with self._lock:
            for cell in [cell for cell in self._overview if cell <= frame // CELL]:
                for group in self._overview.pop(cell):
                    del self._groups[group.number]

    def _extend(
        self, group: FindingGroup, finding: Finding, taken_groups: set[int], tried: bool = False
    ) -> None:
        """Add one finding to a group."""
        taken_groups.add(group.number)
        self._groups[group.number] = self._groups.pop(group.number)
        group.position, group.box, group.subject = finding.position, finding.box, finding.subject
        group.add(
            FindingFrame(
                finding.frame,
                finding.stamp,
                finding.distance,
                "" if finding.selection is None else str(finding.selection),
                tried,
                finding.text if finding.what == "anomaly" else finding.reason,
                REMARKS.get(finding.name if finding.what == "anomaly" else finding.what, ""),
                finding.in_way,
            )
        )

    def _same(self, finding: Finding, taken_groups: set[int]) -> FindingGroup | None:
        groups = self._recent.get((finding.what, finding.name), [])
        groups[:] = [group for group in groups if 0 <= finding.frame - group.frames[-1].frame <= GAP]
        return _nearest(groups, finding, taken_groups)

    def _new_recent(self, kind: str, name: str) -> FindingGroup:
        group = self._new(kind, name)
        self._recent.setdefault((kind, name), []).append(group)
        return group

    def _new(self, kind: str, name: str) -> FindingGroup:
        self._number += 1
        group = FindingGroup(self._number, kind, name)
        self._groups[group.number] = group
        return group

    def content(self) -> list[StoredGroup]:
        """Return the groups as they are stored."""
        with self._lock:
            groups = sorted(self._groups.values(), key=lambda group: group.number)
            return [StoredGroup(group.what, group.name, list(group.frames)) for group in groups]

    def restore(self, groups: Iterable[StoredGroup], *, stay: bool = True) -> None:
        """Add whole groups of an earlier run. Those that do not stay are removed as an overview is."""
        with self._lock:
            for kind, name, frames in groups:
                group = self._new(kind, name)
                for frame in frames:
                    group.add(frame)
                if not stay:
                    self._overview.setdefault(frames[0].frame // CELL, []).append(group)

    def replace(self, kinds: Sequence[str]) -> None:
        """Remove all findings of these kinds, before new ones are added."""
        with self._lock:
            if "anomaly" in kinds:
                self._anomalies.clear()
            for number in [number for number, group in self._groups.items() if group.what in kinds]:
                del self._groups[number]
            for key in [key for key in self._recent if key[0] in kinds]:
                del self._recent[key]

    def reasons(self) -> dict[tuple[int, str], str]:
        """Return the reasons of the findings of the drive as opened, by frame and text of the selection."""
        with self._lock:
            frames = [one for group in self._groups.values() for one in group.frames]
        return {(one.frame, one.pick): one.text for one in frames if not one.tried}

    def news(self, sent_counts: dict[int, int]) -> tuple[list[Entry], list[int]]:
        """Return what is new for a page: groups, and numbers of those that are gone.

        Args:
            sent_counts: number of the frames that the page has of each group. It is updated.
        """
        with self._lock:
            # A group that the page has whole ends the search: all before it changed earlier.
            changed_groups = [
                *takewhile(
                    lambda group: len(group.frames) > sent_counts.get(group.number, 0),
                    reversed(self._groups.values()),
                )
            ]
            changed_groups.sort(key=lambda group: group.number)
            entries: list[Entry] = [
                {
                    "number": group.number,
                    "what": group.what,
                    "name": group.name,
                    "reasons": group.reasons,
                    "rank": group.rank,
                    "sights": group.frames[sent_counts.get(group.number, 0) :],
                }
                for group in changed_groups
            ]
            sent_counts.update((group.number, len(group.frames)) for group in changed_groups)
            gone: list[int] = []
            if len(sent_counts) > len(self._groups):
                gone = [number for number in sent_counts if number not in self._groups]
        for number in gone:
            del sent_counts[number]
        return entries, gone


def _nearest(groups: Iterable[FindingGroup], finding: Finding, taken_groups: set[int]) -> FindingGroup | None:
    """Return the nearest group that a finding may join. None: there is none."""
    candidates = [
        (_relative_distance(group, finding), group.number, group)
        for group in groups
        if group.number not in taken_groups
    ]
    best, _, group = min(candidates, default=(math.inf, -1, None))
    return group if best <= 1 else None


def _relative_distance(group: FindingGroup, finding: Finding) -> float:
    """Return the distance from the last position of a group, divided by the largest allowed distance."""
    if group.position is not None and finding.position is not None:
        return float(np.linalg.norm(np.subtract(group.position, finding.position))) / REACH
    if group.box is not None and finding.box is not None:
        return 1.0 if geometry.iou(group.box[None], finding.box[None])[0, 0] >= SAME_BOX else math.inf
    return math.inf
