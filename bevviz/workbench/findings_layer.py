"""Clickable boxes of missed, false and unnamed objects in every view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
import rerun as rr

from bevviz.config import BevConfig
from bevviz.findings.frame_findings import Finding
from bevviz.model import geometry
from bevviz.model.frame import Boxes3D
from bevviz.model.results import FrameResult
from bevviz.recording import entities
from bevviz.recording.images import bev_pixels, ground_outlines, image_frame
from bevviz.recording.labels import choose_named_in_3d
from bevviz.recording.primitives import OUTLINE, boxes2d, boxes3d, transform
from bevviz.recording.writer import Writer
from bevviz.stages.robot_results import in_points_frame
from bevviz.support.colors import Color, StateColor
from bevviz.why.subject import projected_box, single_box

FindingRows: TypeAlias = Mapping[str, Sequence[Finding]]  # findings of an entity, one per logged row

LAYERS = {
    "missed": (entities.MARKED.path("missed"), StateColor.BAD.value),
    "false": (entities.MARKED.path("false"), StateColor.DOUBTFUL.value),
    "unnamed": (entities.MARKED.path("unnamed"), StateColor.UNKNOWN.value),
}
DRAWN_AS = {"doubtful": "false"}


def log_layer(writer: Writer, result: FrameResult, findings: Sequence[Finding]) -> FindingRows:
    """Log the boxes in space, in the bird's-eye view and in every image.

    Call this within a frame of the writer.

    Returns:
        The findings behind the rows of each entity.
    """
    layer: dict[str, Sequence[Finding]] = {}
    for kind, (path, color) in LAYERS.items():
        layer_findings = [finding for finding in findings if DRAWN_AS.get(finding.what, finding.what) == kind]
        if not layer_findings:
            continue
        boxes = Boxes3D.joined([_box(result, finding) for finding in layer_findings])
        labels = [
            f"{finding.name} {finding.what}{f': {finding.reason}' if finding.reason else ''}"
            for finding in layer_findings
        ]
        shows_label = (
            choose_named_in_3d(boxes.center).tolist() if kind == "missed" else [False] * len(layer_findings)
        )
        writer.put(
            path,
            transform(result.frame.pose),
            boxes3d(
                boxes,
                np.arange(len(layer_findings)),
                [label if named else "" for label, named in zip(labels, shows_label, strict=True)],
                colors=[color],
                radii=rr.Radius.ui_points(1.5),
                show_labels=kind == "missed",
                fill_mode=OUTLINE,
            ),
            rr.AnyValues(says=labels),
        )
        layer[path] = layer_findings
        for camera in result.frame.cameras:
            image_boxes = [
                projected_box(single_box(boxes, index), camera) for index in range(len(layer_findings))
            ]
            visible_rows = [index for index, box in enumerate(image_boxes) if box is not None]
            if visible_rows:
                image = f"{entities.IMAGE.path(camera.name)}/{kind}"
                xyxy = np.array([image_boxes[index] for index in visible_rows])
                style = {"colors": [color], "draw_order": 35.0, "show_labels": False}
                writer.put(
                    image,
                    image_frame(camera.name),
                    boxes2d(xyxy, [labels[index] for index in visible_rows], **style),
                )
                layer[image] = [layer_findings[index] for index in visible_rows]
        above = entities.OVERLAY.path(kind)
        if inside := _log_above(writer, above, boxes, labels, color, result.config.bev):
            layer[above] = [layer_findings[index] for index in inside]
    return layer


def _box(result: FrameResult, finding: Finding) -> Boxes3D:
    """Return the box of a finding in the frame of the points, as one row."""
    selection = finding.selection
    if selection.object is not None and result.objects is not None:
        return single_box(result.objects.boxes, selection.object)
    if selection.cluster is not None and result.clusters is not None:
        return single_box(result.clusters.boxes(result.config.clustering), selection.cluster)
    assert selection.truth is not None and result.frame.truth is not None
    return single_box(in_points_frame(result.frame, result.frame.truth), selection.truth)


def _log_above(
    writer: Writer, path: str, boxes: Boxes3D, labels: Sequence[str], color: Color, config: BevConfig
) -> Sequence[int]:
    """Log the boxes whose centre is in the bird's-eye image, and return their rows."""
    reach = np.array([config.range_x, config.range_y], np.float32)
    inside: list[int] = np.flatnonzero((np.abs(boxes.center[:, :2]) < reach).all(axis=1)).tolist()
    if inside:
        outlines = ground_outlines(geometry.corners(boxes)[inside])
        writer.put(
            path,
            rr.LineStrips2D(
                bev_pixels(config, np.eye(4), outlines),
                colors=[color],
                radii=rr.Radius.ui_points(1.5),
                labels=[labels[row] for row in inside],
                show_labels=False,
                draw_order=30.0,
            ),
        )
    return inside
