"""Log boxes: fused objects, tracks, ground truth, and boxes that the robot published."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import rerun as rr

from bevviz import anomalies
from bevviz.config import BevConfig
from bevviz.model import geometry
from bevviz.model.frame import F32, F64, I64, Frame, LabelledBoxes2D, LabelledBoxes3D, LateBoxes
from bevviz.model.results import BOX_SIDES, FrameResult, Objects, Opinion, Tracks
from bevviz.recording import entities
from bevviz.recording.entities import TRACK_COLORS, ClassId
from bevviz.recording.images import bev_pixels, ground_outlines, image_frame
from bevviz.recording.labels import choose_named_in_3d, log_box_label_style, log_box_labels
from bevviz.recording.opinions import outline_colors
from bevviz.recording.primitives import (
    OUTLINE,
    boxes2d,
    boxes3d,
    class_annotations,
    scored,
    strips,
    texts_by_row,
    transform,
)
from bevviz.recording.writer import Writer
from bevviz.support.colors import CONTEXT, SERIES_COLORS, Color, class_color


def log_object_style(to: Writer) -> None:
    """Log the static style of fused boxes, their labels and their measured boxes."""
    to.static(entities.FUSED, rr.Boxes3D.from_fields(radii=rr.Radius.ui_points(0.5), show_labels=False))
    log_box_label_style(to, entities.FUSED)
    to.static(entities.MEASURED, rr.Boxes3D.from_fields(radii=rr.Radius.ui_points(1.0), show_labels=False))


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
    to.put(
        entities.FUSED,
        transform(result.frame.pose),
        boxes3d(objects.boxes, np.arange(len(objects)), labels, colors=colors),
        rr.AnyValues(
            class_name=list(objects.names),
            score=objects.score,
            track=ids,
            speed=speeds,
            cluster=objects.cluster,
            camera=list(objects.camera),
            seen=_sides(objects),
            reason=reasons,
            **values,
        ),
    )
    distances = objects.boxes.distance
    is_named = choose_named_in_3d(objects.boxes.center, is_unusual) & is_unusual
    log_box_labels(
        to,
        entities.FUSED,
        objects.boxes,
        [label if named else "" for label, named in zip(_with_doubts(labels, result), is_named, strict=True)],
        [
            f"{label}, {metres:.1f} m away: {reason.partition(': ')[2] or 'an object'}"
            for label, metres, reason in zip(labels, distances, reasons, strict=True)
        ],
        outline_colors(result, colors),
    )
    if objects.measured is not None:
        rows = np.flatnonzero((objects.measured.size != objects.boxes.size).any(axis=1))
        if len(rows):
            measured = boxes3d(
                objects.measured, rows, [labels[row] for row in rows], colors=[colors[row] for row in rows]
            )
            to.put(entities.MEASURED, measured)  # The entity above has the pose.


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


def log_track_style(to: Writer) -> None:
    """Log the static style of tracks and trails, in 3D and over the bird's-eye image."""
    style = rr.Boxes3D.from_fields(radii=rr.Radius.ui_points(0.75), show_labels=False, fill_mode=OUTLINE)
    for path in (entities.TRACKS, entities.UNSEEN):
        to.static(path, style)
    to.static(entities.TRAILS, rr.LineStrips3D.from_fields(radii=rr.Radius.ui_points(1.5)))
    to.static(entities.TRACK_SPEEDS, rr.SeriesLines(names=[f"{n:02}" for n in range(TRACK_LANES)]))
    for name, radius in (("tracks", 1.0), ("trails", 1.5)):
        to.static(
            entities.OVERLAY.path(name),
            class_annotations(),
            rr.LineStrips2D.from_fields(radii=rr.Radius.ui_points(radius), draw_order=20.0),
        )


def log_tracks(to: Writer, frame: Frame, tracks: Tracks, config: BevConfig) -> None:
    """Log tracks in the fixed frame and over the bird's-eye image."""
    rows = confirmed_rows(tracks)
    named = tracks.object[rows] >= 0
    for path, chosen, text in (
        (entities.TRACKS, rows[named], track_label),
        (entities.UNSEEN, rows[~named], _unseen_label),
    ):
        if len(chosen):
            labels = [text(tracks, row) for row in chosen.tolist()]
            to.put(path, boxes3d(tracks.boxes, chosen, labels, class_ids=track_class_ids(tracks.id[chosen])))
    if len(rows) == 0:
        return
    colors, points_from_world = track_class_ids(tracks.id[rows]), geometry.inverse(frame.pose)
    trail, lengths = _trails(tracks, rows)
    to.put(entities.TRAILS, rr.LineStrips3D(strips(trail, lengths), class_ids=colors))
    pixels = bev_pixels(config, points_from_world, trail)
    to.put(entities.OVERLAY.path("trails"), rr.LineStrips2D(strips(pixels, lengths), class_ids=colors))
    outlines = ground_outlines(geometry.corners(tracks.boxes)[rows])
    to.put(
        entities.OVERLAY.path("tracks"),
        rr.LineStrips2D(
            bev_pixels(config, points_from_world, outlines),
            class_ids=colors,
            labels=[track_label(tracks, row) for row in rows.tolist()],
            show_labels=False,  # the bird's-eye image has the names of objects
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


def _trails(tracks: Tracks, rows: I64) -> tuple[F32, I64]:
    """Return the trails, oldest position first.

    Returns:
        (N, 3) points, one track after the other, and the number of points of each track.
    """
    positions = tracks.trail[rows]
    known = np.isfinite(positions[:, :, 0])
    return positions[known], known.sum(axis=1)


# --- ground truth, and boxes of the robot ------------------------------------------------------

Put = Callable[..., None]  # ``Writer.put`` or ``Writer.write``

_TRUTH_COLOR, _ROBOT_COLOR = CONTEXT, SERIES_COLORS[4]


def log_truth_style(to: Writer) -> None:
    """Log the static style of the ground truth."""
    to.static(
        entities.TRUTH,
        rr.Boxes3D.from_fields(
            colors=[_TRUTH_COLOR], radii=rr.Radius.ui_points(0.5), show_labels=False, fill_mode=OUTLINE
        ),
    )


def log_truth(to: Writer, frame: Frame, config: BevConfig) -> None:
    """Log the ground truth boxes in 3D and over the bird's-eye image."""
    if frame.truth is not None and len(frame.truth.boxes):
        _log_labelled_boxes(to.put, entities.TRUTH, frame.truth, None)
        path = entities.OVERLAY.path("ground_truth")
        _log_bev_outlines(to.put, path, frame.pose, frame.truth, config, _TRUTH_COLOR)


def log_robot(to: Writer, frame: Frame, config: BevConfig) -> None:
    """Log the robot's boxes and detections under the names of their topics."""
    for labelled in frame.robot_boxes:
        if len(labelled.boxes):
            _log_labelled_boxes(to.put, entities.ROBOT.path(labelled.topic), labelled, _ROBOT_COLOR)
            path = entities.ROBOT_OVERLAY.path(labelled.topic)
            _log_bev_outlines(to.put, path, frame.pose, labelled, config, _ROBOT_COLOR)
    for detections in frame.robot_detections:
        if len(detections.xyxy):
            _log_image_boxes(to.put, detections)


def log_late(to: Writer, late: LateBoxes, config: BevConfig) -> None:
    """Log a result that came too late for its frame, at its own stamp.

    It stays visible until the next result or ``clear_late``.
    """
    boxes = late.boxes
    to.set_time(late.index, boxes.stamp, boxes.received)
    if isinstance(boxes, LabelledBoxes2D):
        _log_image_boxes(to.write, boxes)
        return
    _log_labelled_boxes(to.write, entities.ROBOT.path(boxes.topic), boxes, _ROBOT_COLOR)
    path = entities.ROBOT_OVERLAY.path(boxes.topic)
    if not _log_bev_outlines(to.write, path, late.pose, boxes, config, _ROBOT_COLOR):
        to.write(path, rr.Clear(recursive=False))


def clear_late(to: Writer, topic: str) -> None:
    """Clear the boxes of a topic."""
    for path in (entities.ROBOT.path(topic), entities.ROBOT_OVERLAY.path(topic)):
        to.write(path, rr.Clear(recursive=False))


def _log_labelled_boxes(put: Put, path: str, labelled: LabelledBoxes3D, color: Color | None) -> None:
    put(
        path,
        transform(_pose(labelled)),
        boxes3d(
            labelled.boxes,
            np.arange(len(labelled.boxes)),
            scored(labelled.labels, labelled.scores),
            colors=None if color is None else [color],
        ),
    )


def _log_image_boxes(put: Put, detections: LabelledBoxes2D) -> None:
    """Log detections under /robot. They have the coordinate frame of the image, so that it can show them."""
    put(
        entities.ROBOT.path(detections.topic),
        *([image_frame(detections.camera)] if detections.camera else []),
        boxes2d(
            detections.xyxy,
            scored(detections.labels, detections.scores),
            colors=[_ROBOT_COLOR],
            draw_order=25.0,
        ),
    )


def _log_bev_outlines(
    put: Put, path: str, pose: F64, labelled: LabelledBoxes3D, config: BevConfig, color: Color
) -> bool:
    """Log outlines of the boxes with their centre in the bird's-eye view. Return whether there are any."""
    points_from_boxes = geometry.inverse(pose) @ _pose(labelled)
    reach = np.array([config.range_x, config.range_y], np.float32)
    inside = (np.abs(geometry.apply(points_from_boxes, labelled.boxes.center)[:, :2]) < reach).all(axis=1)
    if not inside.any():
        return False
    outlines = ground_outlines(geometry.corners(labelled.boxes)[inside])
    put(
        path,
        rr.LineStrips2D(
            bev_pixels(config, points_from_boxes, outlines),
            colors=[color],
            radii=rr.Radius.ui_points(0.75),
            labels=[labelled.labels[row] for row in np.flatnonzero(inside)],
            show_labels=False,
            draw_order=10.0,
        ),
    )
    return True


def _pose(labelled: LabelledBoxes3D) -> F64:
    return np.eye(4) if labelled.world_from_boxes is None else labelled.world_from_boxes
