"""Fused boxes, with the reason of their match."""

from __future__ import annotations

import numpy as np
import rerun as rr

from bevviz.colors import class_color
from bevviz.frame import SIDES, FrameResult, Objects
from bevviz.logging import entities, tracks
from bevviz.logging.pieces import boxes3d, scored, transform
from bevviz.logging.writer import Writer


def log_objects_looks(to: Writer) -> None:
    to.static(entities.FUSED, rr.Boxes3D.from_fields(radii=rr.Radius.ui_points(2.0), show_labels=True))
    to.static(entities.MEASURED, rr.Boxes3D.from_fields(radii=rr.Radius.ui_points(1.0), show_labels=False))


def log_objects(to: Writer, result: FrameResult) -> None:
    """Boxes by class, and everything that is known of each as values beside it; in thin what was seen."""
    objects, tracked = result.objects, result.tracks
    if objects is None or not len(objects):
        return
    reasons = {(e.camera, e.row): e.text for e in result.explanations if e.subject == "detection"}
    labels = scored(objects.names, objects.score)
    ids, speeds = np.full(len(objects), -1), np.full(len(objects), np.nan, np.float32)
    for j, row in enumerate(tracks.of_objects(tracked, len(objects))):
        if row is not None and tracked is not None:
            labels[j] = tracks.label(tracked, row)
            ids[j], speeds[j] = tracked.id[row], tracked.speed[row]
    matches = zip(objects.camera, objects.detection.tolist(), strict=True)
    to.put(
        entities.FUSED,
        transform(result.frame.pose),
        boxes3d(
            objects.boxes, np.arange(len(objects)), labels, colors=[class_color(n) for n in objects.names]
        ),
        rr.AnyValues(
            class_name=list(objects.names),
            score=objects.score,
            track=ids,
            speed=speeds,
            cluster=objects.cluster,
            camera=list(objects.camera),
            seen=sides(objects),
            reason=[reasons.get(match, "") for match in matches],
        ),
    )
    if objects.measured is not None:
        rows = np.flatnonzero((objects.measured.size != objects.boxes.size).any(axis=1))
        if len(rows):
            colors = [class_color(objects.names[j]) for j in rows]
            to.put(
                entities.MEASURED,
                transform(result.frame.pose),
                boxes3d(objects.measured, rows, [labels[j] for j in rows], colors=colors),
            )


def sides(objects: Objects) -> list[str]:
    """The sides of each box that were seen, in words; empty where that is not known."""
    if objects.seen is None:
        return [""] * len(objects)
    return [
        ", ".join(side for side, seen in zip(SIDES, row, strict=True) if seen)
        for row in objects.seen.tolist()
    ]
