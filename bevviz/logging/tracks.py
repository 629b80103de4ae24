"""What tracks look like in Rerun: boxes, trails, and a fixed number of lanes for their states and speeds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from bevviz import anomalies
from bevviz.frame import F32, I64, Tracks
from bevviz.logging.entities import TRACK_COLORS, ClassId

LANES = 12  # tracks with a state lane and a speed of their own: entities that come and go are never freed


def shown(tracks: Tracks | None) -> I64:
    """Rows of what is drawn."""
    return np.zeros(0, np.int64) if tracks is None else np.flatnonzero(tracks.confirmed)


def label(tracks: Tracks, row: int) -> str:
    """``person #12 1.4 m/s``."""
    return f"{anomalies.label(tracks, row)} {tracks.speed[row]:.1f} m/s"


def unseen(tracks: Tracks, row: int) -> str:
    """Why a track that is shown has no object in this frame."""
    if tracks.cluster[row] >= 0:
        return f"{anomalies.label(tracks, row)}, not named"
    return f"{anomalies.label(tracks, row)}, unseen for {tracks.coasting[row]:.1f} s"


def class_ids(ids: I64) -> np.ndarray[tuple[int], np.dtype[np.uint16]]:
    """The colours of these tracks, as class ids."""
    return (ClassId.TRACK + ids % TRACK_COLORS).astype(np.uint16)


def of_clusters(tracks: Tracks | None, count: int) -> I64:
    """(count,) id of each cluster's track; without tracks, or without its own, the cluster's row."""
    ids = np.arange(count)
    if tracks is not None:
        seen = tracks.cluster >= 0
        ids[tracks.cluster[seen]] = tracks.id[seen]
    return ids


def of_objects(tracks: Tracks | None, count: int) -> list[int | None]:
    """Row of the track of each object, None where it has none that is shown."""
    rows: list[int | None] = [None] * count
    if tracks is not None:
        for row in shown(tracks).tolist():
            if (j := int(tracks.object[row])) >= 0:
                rows[j] = row
    return rows


def trails(tracks: Tracks, rows: I64) -> list[F32]:
    """Where each was, oldest first."""
    return [trail[np.isfinite(trail[:, 0])] for trail in tracks.trail[rows]]


class Lanes:
    """Gives each track that is shown one of ``LANES`` numbers, which it keeps until it ends."""

    def __init__(self) -> None:
        self._lane_of: dict[int, int] = {}  # id -> lane

    def update(self, tracks: Tracks | None) -> Mapping[int, int]:
        """Lane -> row of its track. Where there are more tracks than lanes, the latest have none."""
        row_of = {} if tracks is None else {int(tracks.id[row]): row for row in shown(tracks).tolist()}
        self._lane_of = {number: lane for number, lane in self._lane_of.items() if number in row_of}
        free = self._free()
        for number in row_of:
            if number not in self._lane_of and (lane := next(free, None)) is not None:
                self._lane_of[number] = lane
        return {lane: row_of[number] for number, lane in self._lane_of.items()}

    def _free(self) -> Iterator[int]:
        taken = set(self._lane_of.values())
        return (lane for lane in range(LANES) if lane not in taken)
