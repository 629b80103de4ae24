"""Log tracks: boxes, trails, and a fixed number of lanes for their states and speeds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import rerun as rr

from bevviz import anomalies
from bevviz.config import BevConfig
from bevviz.model import geometry
from bevviz.model.frame import F32, I64, Frame
from bevviz.model.results import Tracks
from bevviz.recording import entities
from bevviz.recording.annotations import class_annotations
from bevviz.recording.bev import bev_pixels, ground_outlines
from bevviz.recording.entities import TRACK_COLORS, ClassId
from bevviz.recording.labels import choose_named_in_bev
from bevviz.recording.primitives import OUTLINE, boxes3d, strips
from bevviz.recording.writer import Writer

TRACK_LANES = 12  # tracks with a lane for state and speed; the viewer never frees an entity


def log_track_style(to: Writer) -> None:
    """Log the static style of tracks and trails, in 3D and over the bird's-eye image."""
    style = rr.Boxes3D.from_fields(radii=rr.Radius.ui_points(0.75), show_labels=False, fill_mode=OUTLINE)
    for path in (entities.TRACKS, entities.UNSEEN):
        to.static(path, style)
    to.static(entities.TRAILS, rr.LineStrips3D.from_fields(radii=rr.Radius.ui_points(1.5)))
    to.static(entities.TRACK_SPEEDS, rr.SeriesLines(names=[f"{n:02}" for n in range(TRACK_LANES)]))
    for name, radius in (("tracks", 1.0), ("trails", 1.5)):
        to.static(
            entities.overlay(name),
            class_annotations(),
            rr.LineStrips2D.from_fields(radii=rr.Radius.ui_points(radius), draw_order=20.0),
        )


def log_tracks(to: Writer, frame: Frame, tracks: Tracks, config: BevConfig) -> None:
    """Log tracks in the fixed frame and over the bird's-eye image."""
    rows = confirmed_rows(tracks)
    named = tracks.object[rows] >= 0
    for path, chosen, text in (
        (entities.TRACKS, rows[named], label),
        (entities.UNSEEN, rows[~named], unseen_label),
    ):
        if len(chosen):
            labels = [text(tracks, row) for row in chosen.tolist()]
            to.put(path, boxes3d(tracks.boxes, chosen, labels, class_ids=class_ids(tracks.id[chosen])))
    if len(rows) == 0:
        return
    colors, points_from_world = class_ids(tracks.id[rows]), geometry.inverse(frame.pose)
    trail, lengths = trails(tracks, rows)
    to.put(entities.TRAILS, rr.LineStrips3D(strips(trail, lengths), class_ids=colors))
    pixels = bev_pixels(config, points_from_world, trail)
    to.put(entities.overlay("trails"), rr.LineStrips2D(strips(pixels, lengths), class_ids=colors))
    outlines = ground_outlines(geometry.corners(tracks.boxes)[rows])
    is_named = choose_named_in_bev(geometry.apply(points_from_world, tracks.boxes.center[rows]))
    to.put(
        entities.overlay("tracks"),
        rr.LineStrips2D(
            bev_pixels(config, points_from_world, outlines),
            class_ids=colors,
            labels=[
                label(tracks, row) if is_shown else "" for row, is_shown in zip(rows, is_named, strict=True)
            ],
            show_labels=True,
        ),
    )


def log_speeds(to: Writer, tracks: Tracks, rows: Mapping[int, int]) -> None:
    """Log the speed of each lane's track. ``rows`` is lane -> row of its track."""
    speeds = np.full(TRACK_LANES, np.nan)
    speeds[list(rows)] = tracks.speed[list(rows.values())]
    to.write(entities.TRACK_SPEEDS, rr.Scalars(speeds))


class TrackLanes:
    """Assignment of tracks to ``TRACK_LANES`` lanes. A track keeps its lane until it ends."""

    def __init__(self) -> None:
        self._lane_of: dict[int, int] = {}  # id -> lane

    def update(self, tracks: Tracks | None) -> Mapping[int, int]:
        """Return lane -> row of its track. If all lanes are taken, the latest tracks have no lane."""
        row_of = (
            {} if tracks is None else {int(tracks.id[row]): row for row in confirmed_rows(tracks).tolist()}
        )
        self._lane_of = {number: lane for number, lane in self._lane_of.items() if number in row_of}
        free = self._free()
        for number in row_of:
            if number not in self._lane_of and (lane := next(free, None)) is not None:
                self._lane_of[number] = lane
        return {lane: row_of[number] for number, lane in self._lane_of.items()}

    def _free(self) -> Iterator[int]:
        taken = set(self._lane_of.values())
        return (lane for lane in range(TRACK_LANES) if lane not in taken)


# --- words and colours -------------------------------------------------------------------------


def confirmed_rows(tracks: Tracks | None) -> I64:
    """Return the rows of confirmed tracks. Only these are drawn."""
    return np.zeros(0, np.int64) if tracks is None else np.flatnonzero(tracks.confirmed)


def label(tracks: Tracks, row: int) -> str:
    """Return a track's label, such as ``person #12 1.4 m/s``."""
    return f"{anomalies.label(tracks, row)} {tracks.speed[row]:.1f} m/s"


def unseen_label(tracks: Tracks, row: int) -> str:
    """Return a label that says why a confirmed track has no object in this frame."""
    if tracks.cluster[row] >= 0:
        return f"{anomalies.label(tracks, row)}, not named"
    return f"{anomalies.label(tracks, row)}, unseen for {tracks.coasting[row]:.1f} s"


def class_ids(ids: I64) -> np.ndarray[tuple[int], np.dtype[np.uint16]]:
    """Return the class ids that colour these tracks."""
    return (ClassId.TRACK + ids % TRACK_COLORS).astype(np.uint16)


def track_ids_of_clusters(tracks: Tracks | None, count: int) -> I64:
    """Return the (count,) track id of each cluster. A cluster without a track gets its own row."""
    ids = np.arange(count)
    if tracks is not None:
        has_cluster = tracks.cluster >= 0
        ids[tracks.cluster[has_cluster]] = tracks.id[has_cluster]
    return ids


def track_rows_of_objects(tracks: Tracks | None, count: int) -> list[int | None]:
    """Return the row of each object's track. None: the object has no confirmed track."""
    rows: list[int | None] = [None] * count
    if tracks is not None:
        for row in confirmed_rows(tracks).tolist():
            if (object_row := int(tracks.object[row])) >= 0:
                rows[object_row] = row
    return rows


def trails(tracks: Tracks, rows: I64) -> tuple[F32, I64]:
    """Return the trails, oldest position first.

    Returns:
        (N, 3) points, one track after the other, and the number of points of each track.
    """
    positions = tracks.trail[rows]
    known = np.isfinite(positions[:, :, 0])
    return positions[known], known.sum(axis=1)
