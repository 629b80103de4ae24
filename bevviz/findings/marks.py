"""Marks of findings in every view of a recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr

from bevviz.findings.frame_findings import Finding, findings_of
from bevviz.model import geometry
from bevviz.model.frame import F32
from bevviz.model.protocols import Observer
from bevviz.model.results import FrameResult
from bevviz.recording.addresses import Address
from bevviz.recording.marks import Mark, MarkState, log_marks
from bevviz.recording.writer import Writer
from bevviz.why import RunExplainer

NEAR, UNMATCHED_DEPTH = 0.5, 20.0  # metres to both ends of the frustum of a detection without an object
STATES: Mapping[str, MarkState] = {  # kind -> state that it is drawn as
    "missed": "missed",
    "false": "false",
    "contradicted": "false",
    "doubtful": "false",
    "lost": "unexplained",
    "unmatched": "unexplained",
    "unnamed": "unnamed",
}


class MarkRecorder(Observer[FrameResult]):
    """Observer that marks the findings of each frame.

    Args:
        recording: target, which also has the frames.
        explainer: explainer of the run, which other observers share.
    """

    def __init__(self, recording: rr.RecordingStream, explainer: RunExplainer | None = None) -> None:
        self._writer, self._explainer = Writer(recording), explainer or RunExplainer()

    def observe(self, result: FrameResult) -> None:
        """Log the marks of a frame."""
        self.log(result, findings_of(self._explainer.of(result).traces))

    def log(self, result: FrameResult, findings: Sequence[Finding]) -> None:
        """Log the marks of findings that are known already."""
        frame = result.frame
        self._writer.begin(frame.index, frame.stamp, frame.received)
        log_findings(self._writer, result, findings)
        self._writer.end()


def log_findings(
    to: Writer, result: FrameResult, findings: Sequence[Finding], *, dashed: bool = True
) -> None:
    """Log the marks of findings, within a frame of the writer. Anomalies have marks of their own.

    Args:
        to: writer of the recording.
        result: result of the frame.
        findings: its findings.
        dashed: as in ``log_marks``.
    """
    log_marks(to, result, [mark for one in findings if (mark := _mark(result, one))], dashed=dashed)


def _mark(result: FrameResult, finding: Finding) -> Mark | None:
    """Return the mark of a finding; None: it has no place."""
    selection, corners = finding.selection, _corners(result, finding)
    if selection is None or corners is None:
        return None
    address = Address(selection.kind, selection.row, selection.camera)
    state, name, sentence = STATES[finding.what], _name(finding), _sentence(finding)
    return Mark(state, name, sentence, corners, address, finding.shape)


def _corners(result: FrameResult, finding: Finding) -> F32 | None:
    """Return the (8, 3) corners of the box of a finding, or of the frustum of its detection."""
    if finding.shape is not None:
        box_corners: F32 = geometry.corners(finding.shape)[0]
        return box_corners
    if finding.selection is None or finding.box is None:
        return None
    camera = next(c.camera for c in result.cameras if c.camera.name == finding.selection.camera)
    if camera.intrinsics is None or camera.camera_from_points is None:
        return None
    frustum = geometry.frustum(finding.box[None], camera.intrinsics, NEAR, UNMATCHED_DEPTH)
    points_from_camera = geometry.inverse(camera.camera_from_points)
    corners: F32 = geometry.apply(points_from_camera, frustum.reshape(-1, 3)).reshape(8, 3)
    return corners


def _name(finding: Finding) -> str:
    """Return the text beside a mark. Clusters have none: they would cover the scene."""
    return "" if finding.what == "unnamed" else f"{finding.what}: {finding.name}"


def _sentence(finding: Finding) -> str:
    """Return the sentence of a mark's tooltip."""
    if finding.text:
        return f"{finding.what}: {finding.text}"
    distance = "" if np.isnan(finding.distance) else f", {finding.distance:.1f} m away"
    return f"{finding.what}: {finding.name}{distance}"
