"""Clickable boxes of missed, false and unnamed objects in every view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
import rerun as rr

from bevviz.config import BevConfig
from bevviz.model import geometry
from bevviz.model.frame import Boxes3D
from bevviz.model.results import FrameResult
from bevviz.recording import entities
from bevviz.recording.bev import footprints, seen_from_above
from bevviz.recording.camera import over_image
from bevviz.recording.labels import named_in_space
from bevviz.recording.primitives import OUTLINE, boxes2d, boxes3d, transform
from bevviz.recording.writer import Writer
from bevviz.stages.robot_results import in_points_frame
from bevviz.why.frame_index import joined
from bevviz.why.subject import one_of, projected
from bevviz.workbench.findings import Find

Color = tuple[int, int, int]
Layer: TypeAlias = Mapping[str, Sequence[Find]]  # findings of an entity, one per logged row

LAYERS = {
    "missed": (entities.MISSED, (255, 80, 70)),
    "false": (entities.FALSE, (240, 165, 50)),
    "unnamed": (entities.UNNAMED, (250, 120, 190)),
}


def log_layer(to: Writer, result: FrameResult, found: Sequence[Find]) -> Layer:
    """Log the boxes in space, in the bird's-eye view and in every image.

    Call this within a frame of the writer.

    Returns:
        The findings behind the rows of each entity.
    """
    layer: dict[str, Sequence[Find]] = {}
    for what, (path, color) in LAYERS.items():
        rows = [find for find in found if find.what == what]
        if not rows:
            continue
        boxes = joined([_box(result, find) for find in rows])
        labels = [f"{find.name} {what}{f': {find.reason}' if find.reason else ''}" for find in rows]
        beside = named_in_space(boxes.center).tolist() if what == "missed" else [False] * len(rows)
        to.put(
            path,
            transform(result.frame.pose),
            boxes3d(
                boxes,
                np.arange(len(rows)),
                [label if named else "" for label, named in zip(labels, beside, strict=True)],
                colors=[color],
                radii=rr.Radius.ui_points(1.5),
                show_labels=what == "missed",
                fill_mode=OUTLINE,
            ),
            rr.AnyValues(says=labels),
        )
        layer[path] = rows
        for camera in result.frame.cameras:
            around = [projected(one_of(boxes, row), camera) for row in range(len(rows))]
            there = [row for row, box in enumerate(around) if box is not None]
            if there:
                image = f"{entities.image(camera.name)}/{what}"
                xyxy = np.array([around[row] for row in there])
                looks = {"colors": [color], "draw_order": 35.0, "show_labels": False}
                to.put(image, over_image(camera.name), boxes2d(xyxy, [labels[row] for row in there], **looks))
                layer[image] = [rows[row] for row in there]
        above = entities.overlay(what)
        if inside := _log_above(to, above, boxes, labels, color, result.config.bev):
            layer[above] = [rows[row] for row in inside]
    return layer


def _box(result: FrameResult, find: Find) -> Boxes3D:
    """Return the box of a finding in the frame of the points, as one row."""
    row = find.pick.row
    if find.pick.kind == "object" and result.objects is not None:
        return one_of(result.objects.boxes, row)
    if find.pick.kind == "cluster" and result.clusters is not None:
        return one_of(result.clusters.boxes(result.config.clustering), row)
    assert result.frame.truth is not None
    return one_of(in_points_frame(result.frame, result.frame.truth), row)


def _log_above(
    to: Writer, path: str, boxes: Boxes3D, labels: Sequence[str], color: Color, config: BevConfig
) -> Sequence[int]:
    """Log the boxes whose centre is in the bird's-eye image, and return their rows."""
    reach = np.array([config.range_x, config.range_y], np.float32)
    inside: list[int] = np.flatnonzero((np.abs(boxes.center[:, :2]) < reach).all(axis=1)).tolist()
    if inside:
        outlines = footprints(geometry.corners(boxes)[inside])
        to.put(
            path,
            rr.LineStrips2D(
                seen_from_above(config, np.eye(4), outlines),
                colors=[color],
                radii=rr.Radius.ui_points(1.5),
                labels=[labels[row] for row in inside],
                show_labels=False,
                draw_order=30.0,
            ),
        )
    return inside
