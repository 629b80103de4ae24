"""Clickable boxes of missed, false and unnamed objects in every view."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bevviz.findings.frame_findings import Finding
from bevviz.model.frame import Boxes3D
from bevviz.model.results import FrameResult
from bevviz.recording import entities
from bevviz.recording.addresses import Rows
from bevviz.recording.labels import choose_named_in_3d, shown
from bevviz.recording.layers import Layer, Style, draw
from bevviz.recording.primitives import transform
from bevviz.recording.projection import bev_outlines
from bevviz.recording.writer import Writer
from bevviz.stages.robot_results import in_points_frame
from bevviz.support.colors import StateColor
from bevviz.why.subject import projected_boxes, single_box

LAYERS = {
    "missed": (entities.MARKED.path("missed"), StateColor.BAD.value),
    "false": (entities.MARKED.path("false"), StateColor.DOUBTFUL.value),
    "unnamed": (entities.MARKED.path("unnamed"), StateColor.UNKNOWN.value),
}
DRAWN_AS = {"doubtful": "false"}


def log_layer(writer: Writer, result: FrameResult, findings: Sequence[Finding]) -> None:
    """Log the boxes in space, in the bird's-eye view and in every image.

    Call this within a frame of the writer.
    """
    for kind, (path, color) in LAYERS.items():
        layer_findings = [finding for finding in findings if DRAWN_AS.get(finding.what, finding.what) == kind]
        if not layer_findings:
            continue
        boxes = Boxes3D.joined([_box(result, finding) for finding in layer_findings])
        labels = [
            f"{finding.name} {finding.what}{f': {finding.reason}' if finding.reason else ''}"
            for finding in layer_findings
        ]
        is_missed = kind == "missed"
        is_named = choose_named_in_3d(boxes.center) & is_missed
        pose = transform(result.frame.pose)
        style = Style(color, 1.5, labels=is_missed, wire=True)
        texts = shown(labels, is_named)
        draw(writer, Layer(path, boxes, style, texts, says=labels, frame=pose, rows=_rows(layer_findings)))
        single_boxes = [single_box(boxes, row) for row in range(len(boxes))]
        for camera in result.frame.cameras:
            xyxy = dict(enumerate(projected_boxes(single_boxes, camera)))
            image_boxes = {row: box for row, box in xyxy.items() if box is not None}
            if image_boxes:
                image, style = (
                    entities.IMAGE_MARK.path(camera.name, kind),
                    Style(color, labels=False, order=35.0),
                )
                texts = [labels[row] for row in image_boxes]
                addresses = _rows([layer_findings[row] for row in image_boxes])
                items = np.array([*image_boxes.values()])
                draw(writer, Layer(image, items, style, texts, frame=camera.name, rows=addresses))
        above, (rows, outlines) = entities.OVERLAY.path(kind), bev_outlines(result.config.bev, boxes)
        if len(rows):
            style, texts = Style(color, 1.5, labels=False, order=30.0), [labels[row] for row in rows]
            addresses = _rows([layer_findings[row] for row in rows])
            draw(writer, Layer(above, outlines, style, texts, rows=addresses))


def _rows(findings: Sequence[Finding]) -> Rows:
    """Return the rows that findings are about."""
    selections = [finding.selection for finding in findings]
    return Rows([one.kind for one in selections], [one.row for one in selections])


def _box(result: FrameResult, finding: Finding) -> Boxes3D:
    """Return the box of a finding in the frame of the points, as one row."""
    selection = finding.selection
    if selection.object is not None and result.objects is not None:
        return single_box(result.objects.boxes, selection.object)
    if selection.cluster is not None and result.clusters is not None:
        return single_box(result.clusters.boxes(result.config.clustering), selection.cluster)
    assert selection.truth is not None and result.frame.truth is not None
    return single_box(in_points_frame(result.frame, result.frame.truth), selection.truth)
