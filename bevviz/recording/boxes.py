"""Log boxes: fused objects, tracks, ground truth, and boxes that the robot published."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import rerun as rr

from bevviz import anomalies
from bevviz.config import BevConfig
from bevviz.model import geometry
from bevviz.model.frame import F64, I64, Frame, LabelledBoxes2D, LabelledBoxes3D, LateBoxes
from bevviz.model.results import BOX_SIDES, FrameResult, Objects, Opinion, Tracks, texts_by_row
from bevviz.recording import entities
from bevviz.recording.addresses import Rows
from bevviz.recording.components import Components
from bevviz.recording.entities import TRACK_COLORS, ClassId
from bevviz.recording.labels import choose_named_in_3d, shown
from bevviz.recording.layers import Layer, Style, callouts, draw
from bevviz.recording.opinions import outline_colors
from bevviz.recording.primitives import scored, transform
from bevviz.recording.projection import bev_outlines, bev_pixels, ground_outlines
from bevviz.recording.writer import Writer
from bevviz.support.colors import CONTEXT, SERIES_COLORS, class_color


def log_objects(to: Writer, result: FrameResult) -> None:
    """Log objects as boxes coloured by class, with all their values. Measured boxes are drawn thin."""
    objects, tracked = result.objects, result.tracks
    if objects is None or not len(objects):
        return
    match_reasons = {
        (explanation.camera, explanation.row): explanation.text
        for explanation in result.explanations
        if explanation.subject == "detection"
    }
    labels = scored(objects.names, objects.score)
    unusual_subjects = {anomaly.subject for anomaly in result.anomalies}
    is_unusual = np.zeros(len(objects), bool)
    ids, speeds = np.full(len(objects), -1), np.full(len(objects), np.nan, np.float32)
    for row, track in enumerate(track_rows_of_objects(tracked, len(objects))):
        if track is not None and tracked is not None:
            labels[row] = track_label(tracked, track)
            is_unusual[row] = anomalies.label(tracked, track) in unusual_subjects
            ids[row], speeds[row] = tracked.id[track], tracked.speed[track]
    matches = zip(objects.camera, objects.detection.tolist(), strict=True)
    reasons = [match_reasons.get(pair, "") for pair in matches]
    opinions, values = result.opinions, dict[str, Any]()
    if opinions is not None:
        opinion_texts = texts_by_row(result.explanations, "object")
        reasons = [opinion_texts.get(row, "") for row in range(len(objects))]
        values["opinion"] = [Opinion(value).word for value in opinions.opinion.tolist()]
        is_unusual |= opinions.opinion == Opinion.CONTRADICTED
    colors = [class_color(name) for name in objects.names]
    is_named = choose_named_in_3d(objects.boxes.center, is_unusual) & is_unusual
    addresses = Rows("object", range(len(objects)))
    draw(
        to,
        Layer(
            entities.FUSED,
            objects.boxes,
            Style(width=0.5, labels=False),
            labels=labels,
            colors=colors,
            values={
                "class_name": list(objects.names),
                "score": objects.score,
                "track": ids,
                "speed": speeds,
                "cluster": objects.cluster,
                "camera": list(objects.camera),
                "seen": _sides(objects),
                "reason": reasons,
                **values,
            },
            frame=transform(result.frame.pose),
            rows=addresses,
        ),
        *callouts(
            entities.FUSED,
            objects.boxes,
            [
                f"{label}, {metres:.1f} m away: {reason.partition(': ')[2] or 'an object'}"
                for label, metres, reason in zip(labels, objects.boxes.distance, reasons, strict=True)
            ],
            shown(_with_doubts(labels, result), is_named),
            outline_colors(result, colors),
            rows=addresses,
        ),
    )
    if objects.measured is not None:
        rows = np.flatnonzero((objects.measured.size != objects.boxes.size).any(axis=1))
        measured, looks = objects.measured.chosen(rows), [colors[row] for row in rows]
        # The entity above has the pose.
        style, texts = Style(width=1.0, labels=False), [labels[row] for row in rows]
        addresses = Rows("object", rows)
        draw(to, Layer(entities.MEASURED, measured, style, labels=texts, colors=looks, rows=addresses))


def _with_doubts(labels: list[str], result: FrameResult) -> list[str]:
    """Return the labels, with the opinion of a camera that contradicts the object or its class."""
    if result.opinions is None:
        return labels
    opinions = map(Opinion, result.opinions.opinion.tolist())
    doubts = Opinion.CONTRADICTED, Opinion.NAMED_OTHERWISE
    return [
        f"{label}, {opinion.word}" if opinion in doubts else label
        for label, opinion in zip(labels, opinions, strict=True)
    ]


def _sides(objects: Objects) -> list[str]:
    """Return the visible sides of each box in words. The text is empty if they are unknown."""
    if objects.seen is None:
        return [""] * len(objects)
    return [
        ", ".join(side for side, seen in zip(BOX_SIDES, row, strict=True) if seen)
        for row in objects.seen.tolist()
    ]


# --- tracks ------------------------------------------------------------------------------------

TRACK_LANES = 12  # tracks with a lane for state and speed; the viewer never frees an entity


def log_tracks(to: Writer, frame: Frame, tracks: Tracks, config: BevConfig) -> None:
    """Log tracks in the fixed frame and over the bird's-eye image."""
    rows = confirmed_rows(tracks)
    if len(rows) == 0:
        return
    named, colors = tracks.object[rows] >= 0, track_class_ids(tracks.id[rows])
    for path, is_drawn, text in (
        (entities.TRACKS, named, track_label),
        (entities.UNSEEN, ~named, _unseen_label),
    ):
        boxes = tracks.boxes.chosen(rows[is_drawn])
        labels = [text(tracks, row) for row in rows[is_drawn].tolist()]
        style = Style(width=0.75, labels=False, wire=True)
        addresses = Rows("track", tracks.id[rows[is_drawn]])
        draw(to, Layer(path, boxes, style, labels=labels, class_ids=colors[is_drawn], rows=addresses))
    points_from_world = geometry.inverse(frame.pose)
    trails = [positions[np.isfinite(positions[:, 0])] for positions in tracks.trail[rows]]
    above = [bev_pixels(config, points_from_world, trail) for trail in trails]
    rims = ground_outlines(geometry.corners(tracks.boxes)[rows])
    addresses = Rows("track", tracks.id[rows])
    draw(
        to,
        Layer(entities.TRAILS, trails, Style(width=1.5), class_ids=colors, rows=addresses),
        Layer(
            entities.OVERLAY.path("trails"),
            above,
            Style(width=1.5, order=20.0),
            class_ids=colors,
            rows=addresses,
        ),
        Layer(
            entities.OVERLAY.path("tracks"),
            bev_pixels(config, points_from_world, rims),
            # The bird's-eye image has the names of objects.
            Style(width=1.0, labels=False, order=20.0),
            labels=[track_label(tracks, row) for row in rows.tolist()],
            class_ids=colors,
            rows=addresses,
        ),
    )


def log_speeds(to: Writer, tracks: Tracks, rows: Mapping[int, int]) -> None:
    """Log the speed of each lane's track. ``rows`` is lane -> row of its track."""
    to.static_once(
        entities.TRACK_SPEEDS, lambda: rr.SeriesLines(names=[f"{n:02}" for n in range(TRACK_LANES)])
    )
    speeds = np.full(TRACK_LANES, np.nan)
    speeds[list(rows)] = tracks.speed[list(rows.values())]
    to.write(entities.TRACK_SPEEDS, Components(rr.Scalars, {"scalars": speeds}))


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


def track_label(tracks: Tracks, row: int) -> str:
    """Return a track's label, such as ``person #12 1.4 m/s``."""
    return f"{anomalies.label(tracks, row)} {tracks.speed[row]:.1f} m/s"


def _unseen_label(tracks: Tracks, row: int) -> str:
    """Return a label that says why a confirmed track has no object in this frame."""
    if tracks.cluster[row] >= 0:
        return f"{anomalies.label(tracks, row)}, not named"
    return f"{anomalies.label(tracks, row)}, unseen for {tracks.coasting[row]:.1f} s"


def track_class_ids(ids: I64) -> np.ndarray[tuple[int], np.dtype[np.uint16]]:
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


# --- ground truth, and boxes of the robot ------------------------------------------------------

_TRUTH = Style(CONTEXT, 0.5, labels=False, wire=True)
_ROBOT = Style(SERIES_COLORS[4])


def log_truth(to: Writer, frame: Frame, config: BevConfig) -> None:
    """Log the ground truth boxes in 3D and over the bird's-eye image."""
    if frame.truth is not None:
        path = entities.OVERLAY.path("ground_truth")
        draw(to, *_labelled_layers(frame.truth, entities.TRUTH, path, frame.pose, config, _TRUTH, "truth"))


def log_robot(to: Writer, frame: Frame, config: BevConfig) -> None:
    """Log the robot's boxes and detections under the names of their topics."""
    results: list[LabelledBoxes3D | LabelledBoxes2D] = [*frame.robot_boxes, *frame.robot_detections]
    for boxes in results:
        draw(to, *_robot_layers(boxes, frame.pose, config))


def log_late(to: Writer, late: LateBoxes, config: BevConfig) -> None:
    """Log a result that came too late for its frame, at its own stamp.

    It stays visible until the next result or ``clear_late``.
    """
    to.set_time(late.index, late.boxes.stamp, late.boxes.received)
    layers = _robot_layers(late.boxes, late.pose, config)
    for layer in layers:
        if not len(layer.items):
            to.write(layer.path, rr.Clear(recursive=False))
    draw(to, *layers, put=to.write)


def clear_late(to: Writer, topic: str) -> None:
    """Clear the boxes of a topic."""
    for path in (entities.ROBOT.path(topic), entities.ROBOT_OVERLAY.path(topic)):
        to.write(path, rr.Clear(recursive=False))


def _robot_layers(boxes: LabelledBoxes3D | LabelledBoxes2D, pose: F64, config: BevConfig) -> list[Layer]:
    """Return the layers of a topic's boxes: in space and from above, or over the image."""
    path = entities.ROBOT.path(boxes.topic)
    if isinstance(boxes, LabelledBoxes3D):
        overlay = entities.ROBOT_OVERLAY.path(boxes.topic)
        return _labelled_layers(boxes, path, overlay, pose, config, _ROBOT)
    labels, style = scored(boxes.labels, boxes.scores), replace(_ROBOT, order=25.0)
    return [Layer(path, boxes.xyxy, style, labels=labels, frame=boxes.camera or None)]


def _labelled_layers(
    labelled: LabelledBoxes3D,
    path: str,
    overlay: str,
    pose: F64,
    config: BevConfig,
    style: Style,
    table: str = "",
) -> list[Layer]:
    """Return the layers of boxes in space, and of the outlines of those in the bird's-eye view.

    ``table``: table of the frame that has the boxes; empty: none.
    """
    labels, world_from_boxes = scored(labelled.labels, labelled.scores), _pose(labelled)
    rows, outlines = bev_outlines(config, labelled.boxes, geometry.inverse(pose) @ world_from_boxes)
    above = Style(style.color, 0.75, labels=False, order=10.0)
    return [
        Layer(
            path,
            labelled.boxes,
            style,
            labels=labels,
            frame=transform(world_from_boxes),
            rows=Rows(table, range(len(labelled.boxes))) if table else None,
        ),
        Layer(
            overlay,
            outlines,
            above,
            labels=[labelled.labels[row] for row in rows],
            rows=Rows(table, rows) if table else None,
        ),
    ]


def _pose(labelled: LabelledBoxes3D) -> F64:
    return np.eye(4) if labelled.world_from_boxes is None else labelled.world_from_boxes
