"""States over time, in lanes: of the pipeline, the cameras and what they see, anomalies, tracks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import rerun as rr

from bevviz import anomalies
from bevviz.anomalies import KINDS
from bevviz.model.colors import Color, State
from bevviz.model.results import CameraResult, Decision, FrameResult, Tracks
from bevviz.recording import entities
from bevviz.recording.writer import Writer

COLORS: Mapping[str, Color] = {
    "ok": State.GOOD.value,
    "matched": State.GOOD.value,
    "degraded": State.DOUBTFUL.value,
    "failed": State.BAD.value,
    "no cluster": State.BAD.value,
    "too few points": State.DOUBTFUL.value,
    "low overlap": State.DOUBTFUL.value,
    "misfit": State.DOUBTFUL.value,
    "taken": State.OTHER.value,
    "too far": State.UNKNOWN.value,
    "not fused": State.UNKNOWN.value,
    "silent": State.BAD.value,
    "unusable": State.BAD.value,
    "no publisher": State.BAD.value,
    "warning": State.DOUBTFUL.value,  # of the robot's diagnostics
    "error": State.BAD.value,
    "stale": State.UNKNOWN.value,
}


class StateLanes:
    """Logs a lane's state where it changes. A lane without a state in a frame goes empty.

    Args:
        colors: of the states, which are text; others get the viewer's own.
        plain_lanes: entity of lanes that have one colour for all their states, whatever these are.
    """

    def __init__(self, colors: Mapping[Any, Color], plain_lanes: str = "") -> None:
        self._values, self._colors, self._plain_lanes = list(colors), list(colors.values()), plain_lanes
        self._known: dict[str, list[str]] = {}  # lane of one colour -> its states so far
        self.states: Mapping[str, str] = {}  # lane -> its latest state

    def log(self, to: Writer, states: Mapping[str, str]) -> None:
        """The states of a frame, by the entity of their lane."""
        now = {lane: state for lane, state in states.items() if state or lane in self.states}
        states = dict.fromkeys(self.states, "") | now
        for lane, state in states.items():
            self._log_colors(to, lane, state)
            if self.states.get(lane, "") != state:  # a lane is there from its first state on
                to.write(lane, rr.StateChange(state=state))
        self.states = states

    def _log_colors(self, to: Writer, lane: str, state: str) -> None:
        if self._plain_lanes and lane.startswith(self._plain_lanes):
            known = self._known.setdefault(lane, [])
            if state and state not in known:
                known.append(state)
                colors = [State.DOUBTFUL.value] * len(known)
                to.static(lane, rr.StateConfiguration(values=known, colors=colors))
        elif state and lane not in self.states:
            to.static(lane, rr.StateConfiguration(values=self._values, colors=self._colors))


def states_of(result: FrameResult) -> dict[str, str]:
    """Lane -> state of the pipeline, of each camera and its classes, and of each kind of anomaly."""
    degraded = result.frame.problems or any(c.camera.problems for c in result.cameras)
    states = {entities.state("pipeline"): "failed" if result.failures else "degraded" if degraded else "ok"}
    if result.frame.around is not None and result.frame.around.marks:
        states[entities.state("marks")] = "; ".join(result.frame.around.marks)
    for camera in result.cameras:
        name = camera.camera.name
        is_fused = camera.detections is not None and camera.fusion is not None
        states[entities.state(name)] = (
            "degraded" if camera.camera.problems else "ok" if is_fused else "not fused"
        )
        for class_name, decision in _best_decisions(camera):
            states[entities.class_state(name, class_name)] = decision
    for kind in KINDS:
        # Without the numbers of tracks, which the log has: each state has to be given its colour.
        subjects = [a.subject.partition(" #")[0] for a in result.anomalies if a.kind == kind]
        more = f" +{len(subjects) - 1}" if subjects[1:] else ""
        states[entities.anomaly_state(kind)] = f"{subjects[0]}{more}" if subjects else ""
    return states


def track_states(tracks: Tracks, rows: Mapping[int, int]) -> dict[str, str]:
    """``rows``: lane -> row of its track."""
    return {entities.track_state(lane): anomalies.label(tracks, row) for lane, row in rows.items()}


def _best_decisions(camera: CameraResult) -> Iterator[tuple[str, str]]:
    """For each class, what became of its best kept detection."""
    if camera.detections is None or camera.fusion is None:
        return
    found, seen = camera.detections, set()
    for d in np.flatnonzero(found.kept).tolist():
        if found.names[d] not in seen:
            seen.add(found.names[d])
            decision = Decision(int(camera.fusion.detection_decision[d]))
            yield found.names[d], decision.name.lower().replace("_", " ")
