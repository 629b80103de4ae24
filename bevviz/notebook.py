"""Rerun's viewer in the cell of a notebook, and what is clicked in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr
from rerun.blueprint import Blueprint

from bevviz.errors import UserError
from bevviz.model.frame import Scene
from bevviz.model.results import FrameResult, Tracks
from bevviz.recording import blueprints, entities
from bevviz.recording.frame_logger import Logger
from bevviz.recording.recorder import Recorder
from bevviz.recording.sinks import APPLICATION
from bevviz.why.log import mark_answers
from bevviz.why.pick import Pick, pick
from bevviz.why.pick_answers import selection

if TYPE_CHECKING:
    from rerun.notebook import Viewer, ViewerEvent

    from bevviz.config import Config
    from bevviz.why import Answer, Selection

MARKED = 5  # answers that are drawn at once


def in_notebook() -> bool:
    """Whether a cell could show a viewer: a plain IPython terminal cannot."""
    try:
        from IPython.core.getipython import get_ipython
    except ImportError:
        return False
    shell: Any = get_ipython()  # type: ignore[no-untyped-call, unused-ignore]
    return shell is not None and getattr(shell, "kernel", None) is not None


@dataclass(frozen=True, slots=True)
class Selected:
    """What was clicked in the viewer.

    Attributes:
        frame: number of the scan that was shown.
        pick: the thing or the place; None: nothing that could be asked about.
        path: entity that was clicked.
        place: of a thing that is known by its row: its middle, x, y, z in metres of the points' frame, or
            u, v in pixels.
    """

    frame: int
    pick: Pick | None
    path: str
    place: tuple[float, ...] = ()

    def selection(self, same: bool) -> Selection:
        """What to ask about it; ``same``: of results with the rows that were shown, else about its place.

        Raises:
            UserError: nothing can be asked about it.
        """
        if self.pick is None:
            raise UserError(f"nothing can be asked about {self.path}: click on a box, a point or a pixel")
        if same or not self.place:
            return selection(self.pick)
        if len(self.place) == 2:
            return selection(Pick("pixel", camera=self.pick.camera, place=self.place))
        return selection(Pick("point", place=self.place))


@dataclass(frozen=True, slots=True)
class _Click:
    frame: int
    path: str
    instance: int | None
    position: tuple[float, ...]


@dataclass(slots=True)
class _Times:
    """Where each frame is on the timelines."""

    numbers: list[int] = field(default_factory=list)
    at: dict[str, list[int]] = field(default_factory=dict)

    def add(self, result: FrameResult) -> None:
        frame = result.frame
        self.numbers.append(frame.index)
        for timeline, value in (
            (entities.FRAME, frame.index),
            (entities.STAMP, frame.stamp),
            (entities.RECEIVED, frame.received),
        ):
            self.at.setdefault(timeline, []).append(value)

    def number(self, timeline: str, time: float) -> int | None:
        """Of the frame that a viewer shows there; None: none."""
        values = np.array(self.at.get(timeline, ()), np.float64)
        before = np.flatnonzero(values <= time + entities.SLACK * (timeline != entities.FRAME))
        if not len(values):
            return None
        row = int(before[values[before].argmax()]) if len(before) else int(values.argmin())
        return self.numbers[row]


class NotebookViewer(Recorder):
    """A viewer in the current cell that a drive is run into; it remembers what is clicked.

    Args:
        scene: names of the sensors.
        config: of the run.
        blueprint: layout.

    Attributes:
        viewer: Rerun's own.
        config: what its rows are rows of.

    Raises:
        UserError: rerun-notebook is not installed, or there is no such blueprint.
    """

    def __init__(self, scene: Scene, config: Config, blueprint: str | Blueprint) -> None:
        layout = blueprints.load(blueprint, scene, config) if isinstance(blueprint, str) else blueprint
        recording = rr.RecordingStream(APPLICATION)
        recording.set_log_time_enabled(False)
        super().__init__(recording, config)
        self.config = config
        self.viewer = _viewer(recording, layout)
        self._marker = Logger(recording, config, scene)
        self._frames = _Times()
        self._tracks: dict[int, Tracks] = {}
        self._timeline, self._time = entities.STAMP, 0.0
        self._click: _Click | None = None
        self.viewer.on_event(self._told)
        self.viewer.display()

    def see(self, result: FrameResult) -> None:
        super().see(result)
        self._frames.add(result)
        if result.tracks is not None:
            bare = np.zeros((len(result.tracks), 0, 3), np.float32)
            self._tracks[result.frame.index] = replace(result.tracks, trail=bare)

    @property
    def frame(self) -> int | None:
        """Number of the scan that is shown; None: none was run."""
        return self._frames.number(self._timeline, self._time)

    @property
    def clicked(self) -> int | None:
        """Number of the scan in which something was clicked last; None: nothing was."""
        return None if self._click is None else self._click.frame

    def selected(self, result: FrameResult) -> Selected | None:
        """What was clicked last.

        Args:
            result: of the frame ``clicked``, made with ``config``.
        """
        click = self._click
        if click is None:
            return None
        found = pick(result, self._tracks.get(click.frame), click.path, click.instance, click.position)
        return Selected(click.frame, found, click.path, _place(result, found))

    def mark(self, result: FrameResult, answers: Sequence[Answer]) -> None:
        """Show what answers are about, and the frame that they are of."""
        frame = result.frame
        if frame.index not in self._frames.numbers:
            return
        mark_answers(self._marker, frame, answers[:MARKED], result.config.bev)
        self.recording.flush()
        if frame.index != self.frame:
            when = np.datetime64(frame.stamp, "ns")
            self.viewer.set_time_ctrl(timeline=entities.STAMP, timestamp=when)

    def _told(self, event: ViewerEvent) -> None:
        """An event of the viewer: between two cells, as the notebook hands it on."""
        if event.type == "timeline_change":
            self._timeline, self._time = event.timeline, event.time
        elif event.type == "time_update":
            self._time = event.time
        elif event.type == "selection_change":
            item = next((one for one in event.items if one.type == "entity"), None)
            frame = self.frame
            self._click = None
            if item is not None and frame is not None:
                position = tuple(v for v in item.position or () if v is not None)
                self._click = _Click(frame, item.entity_path, item.instance_id, position)


def _viewer(recording: rr.RecordingStream, layout: Blueprint) -> Viewer:
    try:
        from rerun.notebook import Viewer

        return Viewer(recording=recording, blueprint=layout, width="auto", height=720)
    except (ImportError, rr.error_utils.RerunMissingDependencyError):
        raise UserError(
            "a viewer in a notebook needs one more package: pip install 'bevviz[notebook]'"
        ) from None


def _place(result: FrameResult, found: Pick | None) -> tuple[float, ...]:
    """The middle of a thing that is known by its row in a result."""
    if found is None:
        return ()
    if found.kind == "object" and result.objects is not None:
        return tuple(map(float, result.objects.boxes.center[found.row]))
    if found.kind == "cluster" and result.clusters is not None:
        return tuple(map(float, result.clusters.centroid[found.row]))
    if found.kind == "detection":
        for camera in result.cameras:
            if camera.camera.name == found.camera and camera.detections is not None:
                u0, v0, u1, v1 = map(float, camera.detections.xyxy[found.row])
                return (u0 + u1) / 2, (v0 + v1) / 2
    return ()
