"""Log fused boxes with the reason of their match."""

from __future__ import annotations

from typing import Any

import numpy as np
import rerun as rr

from bevviz import anomalies
from bevviz.model.colors import class_color
from bevviz.model.results import BOX_SIDES, FrameResult, Objects, Opinion
from bevviz.recording import entities, tracks
from bevviz.recording.labels import choose_named_in_3d, log_box_label_style, log_box_labels
from bevviz.recording.opinions import outline_colors
from bevviz.recording.primitives import boxes3d, scored, texts_by_row, transform
from bevviz.recording.writer import Writer


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
    for row, track in enumerate(tracks.track_rows_of_objects(tracked, len(objects))):
        if track is not None and tracked is not None:
            labels[row] = tracks.label(tracked, track)
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
            seen=sides(objects),
            reason=reasons,
            **values,
        ),
    )
    distances = np.hypot(*objects.boxes.center[:, :2].T)
    is_named = choose_named_in_3d(objects.boxes.center, is_unusual)
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
            to.put(entities.MEASURED, transform(result.frame.pose), measured)


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


def sides(objects: Objects) -> list[str]:
    """Return the visible sides of each box in words. The text is empty if they are unknown."""
    if objects.seen is None:
        return [""] * len(objects)
    return [
        ", ".join(side for side, seen in zip(BOX_SIDES, row, strict=True) if seen)
        for row in objects.seen.tolist()
    ]
