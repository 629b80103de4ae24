"""Log states over time in lanes: pipeline, cameras and their classes, anomalies, tracks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import rerun as rr

from bevviz import anomalies
from bevviz.anomalies import KINDS
from bevviz.model.reasons import ReasonKind, kind_of
from bevviz.model.results import CameraResult, Decision, FrameResult, Tracks
from bevviz.recording import entities
from bevviz.recording.writer import Writer
from bevviz.support.colors import Color, StateColor

COLORS: Mapping[str, Color] = {
    "ok": StateColor.GOOD.value,
    ReasonKind.MATCHED.value: StateColor.GOOD.value,
    "degraded": StateColor.DOUBTFUL.value,
    "no detector": StateColor.UNKNOWN.value,
    "failed": StateColor.BAD.value,
    ReasonKind.NO_CLUSTER.value: StateColor.BAD.value,
    ReasonKind.TOO_FEW_POINTS.value: StateColor.DOUBTFUL.value,
    ReasonKind.LOW_OVERLAP.value: StateColor.DOUBTFUL.value,
    ReasonKind.MISFIT.value: StateColor.DOUBTFUL.value,
    ReasonKind.TAKEN.value: StateColor.OTHER.value,
    ReasonKind.TOO_FAR.value: StateColor.UNKNOWN.value,
    ReasonKind.NOT_FUSED.value: StateColor.UNKNOWN.value,
    "silent": StateColor.BAD.value,
    "unusable": StateColor.BAD.value,
    "no publisher": StateColor.BAD.value,
    "warning": StateColor.DOUBTFUL.value,  # level in the robot's diagnostics
    "error": StateColor.BAD.value,
    "stale": StateColor.UNKNOWN.value,
}


class StateLanes:
    """Writer of state lanes. It logs a lane's state when it changes. A lane without a state becomes empty.

    Args:
        colors: colour of each state. Other states get the viewer's colour.
        plain_lanes: entity above lanes that have one colour for all their states.
    """

    def __init__(self, colors: Mapping[Any, Color], plain_lanes: str = "") -> None:
        self._values, self._colors, self._plain_lanes = list(colors), list(colors.values()), plain_lanes
        self._plain_states: dict[str, list[str]] = {}  # lane of one colour -> its states so far
        self.states: Mapping[str, str] = {}  # lane -> its latest state

    def log(self, to: Writer, states: Mapping[str, str]) -> None:
        """Log the states of a frame, by the entity of their lane."""
        current = {lane: state for lane, state in states.items() if state or lane in self.states}
        states = dict.fromkeys(self.states, "") | current
        for lane, state in states.items():
            self._log_colors(to, lane, state)
            if self.states.get(lane, "") != state:  # a lane begins with its first state
                to.write(lane, rr.StateChange(state=state))
        self.states = states

    def _log_colors(self, to: Writer, lane: str, state: str) -> None:
        if self._plain_lanes and lane.startswith(self._plain_lanes):
            known = self._plain_states.setdefault(lane, [])
            if state and state not in known:
                known.append(state)
                colors = [StateColor.DOUBTFUL.value] * len(known)
                to.static(lane, rr.StateConfiguration(values=known, colors=colors))
        elif state and lane not in self.states:
            to.static(lane, rr.StateConfiguration(values=self._values, colors=self._colors))


def states_of(result: FrameResult) -> dict[str, str]:
    """Return lane -> state of the pipeline, of each camera and its classes, and of each anomaly kind."""
    degraded = result.frame.problems or any(camera_result.camera.problems for camera_result in result.cameras)
    has_detector = not result.cameras or any(camera.detections is not None for camera in result.cameras)
    state = "ok" if has_detector else "no detector"
    states = {
        entities.STATE.path("pipeline"): "failed" if result.failures else "degraded" if degraded else state
    }
    if result.frame.around is not None and result.frame.around.marks:
        states[entities.STATE.path("marks")] = "; ".join(result.frame.around.marks)
    for camera in result.cameras:
        name = camera.camera.name
        is_fused = camera.detections is not None and camera.fusion is not None
        states[entities.STATE.path(name)] = (
            "degraded" if camera.camera.problems else "ok" if is_fused else ReasonKind.NOT_FUSED.value
        )
        for class_name, decision in _best_decisions(camera):
            states[entities.CLASS_STATE.path(name, class_name)] = decision
    for kind in KINDS:
        # Each state of a lane needs a colour, so states have no track numbers. The log has them.
        subjects = [
            anomaly.subject.partition(" #")[0] for anomaly in result.anomalies if anomaly.kind == kind
        ]
        suffix = f" +{len(subjects) - 1}" if subjects[1:] else ""
        states[entities.ANOMALY_STATE.path(kind)] = f"{subjects[0]}{suffix}" if subjects else ""
    return states


def track_states(tracks: Tracks, rows: Mapping[int, int]) -> dict[str, str]:
    """Return lane -> label of its track. ``rows`` is lane -> row of its track."""
    return {
        entities.TRACK_STATE.path(f"{lane:02}"): anomalies.label(tracks, row) for lane, row in rows.items()
    }


def _best_decisions(camera: CameraResult) -> Iterator[tuple[str, str]]:
    """Yield each class of a camera with the decision about its best kept detection."""
    if camera.detections is None or camera.fusion is None:
        return
    detections, seen_classes = camera.detections, set()
    for row in np.flatnonzero(detections.kept).tolist():
        if detections.names[row] not in seen_classes:
            seen_classes.add(detections.names[row])
            decision = Decision(int(camera.fusion.detection_decision[row]))
            yield detections.names[row], kind_of(decision).value
