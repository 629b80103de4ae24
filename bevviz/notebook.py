"""Rerun's viewer in the cell of a notebook, and the clicks in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr
from rerun.blueprint import Blueprint

from bevviz.errors import UserError
from bevviz.model.frame import Scene
from bevviz.model.results import FrameResult, Tracks
from bevviz.recording import blueprints, entities
from bevviz.recording.addresses import RowCache
from bevviz.recording.frame_logger import FrameLogger, logged_rows
from bevviz.recording.recorder import Recorder
from bevviz.recording.stream import RecordingStream
from bevviz.why.click import select_click
from bevviz.why.log import mark_answers
from bevviz.why.selection import Selection

if TYPE_CHECKING:
    from rerun.notebook import Viewer, ViewerEvent

    from bevviz.config import Config
    from bevviz.why import Answer, Selection

MARKED = 5  # number of answers marked at once


def in_notebook() -> bool:
    """Return whether a cell can show a viewer. A plain IPython terminal cannot."""
    try:
        from IPython.core.getipython import get_ipython
    except ImportError:
        return False
    shell: Any = get_ipython()  # type: ignore[no-untyped-call, unused-ignore]
    return shell is not None and getattr(shell, "kernel", None) is not None


@dataclass(frozen=True, slots=True)
class Selected:
    """Click in the viewer.

    Attributes:
        frame: number of the scan shown.
        pick: the object or the position; None: it cannot be asked about.
        path: entity that was clicked.
        place: centre of an object identified by its row: x, y, z in metres of the points' frame, or u, v in
            pixels.
    """

    frame: int
    pick: Selection | None
    path: str
    place: tuple[float, ...] = ()

    def selection(self, same: bool) -> Selection:
        """Return the selection to ask about.

        Args:
            same: whether results have the rows that were shown. If not, the selection uses the position.

        Raises:
            UserError: the click cannot be asked about.
        """
        if self.pick is None:
            raise UserError(f"nothing can be asked about {self.path}: click on a box, a point or a pixel")
        if same or not self.place:
            return self.pick
        if len(self.place) == 2:
            return Selection(box=self.place, camera=self.pick.camera)
        return Selection(point=self.place)


TIMELINES = (entities.FRAME, entities.STAMP, entities.RECEIVED)


class NotebookViewer(Recorder):
    """Viewer in the current cell. It shows a run and remembers the last click.

    Args:
        scene: names of the sensors.
        config: of the run.
        blueprint: layout.

    Attributes:
        viewer: Rerun's viewer.
        config: configuration of the shown rows.

    Raises:
        UserError: rerun-notebook is not installed, or there is no such blueprint.
    """

    def __init__(self, scene: Scene, config: Config, blueprint: str | Blueprint) -> None:
        layout = blueprints.load(blueprint, scene, config) if isinstance(blueprint, str) else blueprint
        recording = RecordingStream(blueprints.application_id(blueprint, scene, config))
        recording.set_log_time_enabled(False)
        super().__init__(recording, config)
        self.config = config
        self.viewer = _viewer(recording, layout)
        self._marker = FrameLogger(recording, config, scene)
        self._times: list[tuple[int, int, int]] = []  # of each frame on TIMELINES
        self._tracks: dict[int, Tracks] = {}
        self._rows = RowCache()
        self._timeline, self._time = entities.STAMP, 0.0
        self._click: tuple[int, Any] | None = None  # shown frame, and clicked item
        self.viewer.on_event(self._on_event)
        self.viewer.display()

    def observe(self, result: FrameResult) -> None:
        """Log a frame and store its times and tracks."""
        super().observe(result)
        self._times.append((result.frame.index, result.frame.stamp, result.frame.received))
        self._rows.put(result.frame.index, self.logger.rows)
        if result.tracks is not None:
            no_trail = np.zeros((len(result.tracks), 0, 3), np.float32)
            self._tracks[result.frame.index] = replace(result.tracks, trail=no_trail)

    @property
    def frame(self) -> int | None:
        """Number of the scan shown. None: none was run."""
        if not self._times or self._timeline not in TIMELINES:
            return None
        values = np.array(self._times, np.float64)[:, TIMELINES.index(self._timeline)]
        earlier = values <= self._time + entities.TIME_TOLERANCE * (self._timeline != entities.FRAME)
        row = np.where(earlier, values, -np.inf).argmax() if earlier.any() else values.argmin()
        return self._times[row][0]

    @property
    def clicked(self) -> int | None:
        """Number of the scan that was clicked last. None: there was no click."""
        return None if self._click is None else self._click[0]

    def selected(self, result: FrameResult) -> Selected | None:
        """Return the last click.

        Args:
            result: of the frame ``clicked``, made with ``config``.
        """
        if self._click is None:
            return None
        frame, item = self._click
        rows, tracks = self._rows.get(frame) or logged_rows(result), self._tracks.get(frame)
        position = [v for v in item.position or () if v is not None]
        picked = select_click(result, tracks, rows, item.entity_path, item.instance_id, position)
        return Selected(frame, picked, item.entity_path, _place(result, picked))

    def mark(self, result: FrameResult, answers: Sequence[Answer]) -> None:
        """Mark the objects of answers in the viewer, and show their frame."""
        frame = result.frame
        if frame.index not in [number for number, _, _ in self._times]:
            return
        mark_answers(self._marker, frame, answers[:MARKED], result.config.bev)
        self.recording.flush()
        if frame.index != self.frame:
            timestamp = np.datetime64(frame.stamp, "ns")
            self.viewer.set_time_ctrl(timeline=entities.STAMP, timestamp=timestamp)

    def _on_event(self, event: ViewerEvent) -> None:
        """Handle an event of the viewer. The notebook passes it on between two cells."""
        if event.type == "timeline_change":
            self._timeline, self._time = event.timeline, event.time
        elif event.type == "time_update":
            self._time = event.time
        elif event.type == "selection_change":
            item = next((candidate for candidate in event.items if candidate.type == "entity"), None)
            frame = self.frame
            self._click = None if item is None or frame is None else (frame, item)


def _viewer(recording: rr.RecordingStream, layout: Blueprint) -> Viewer:
    try:
        from rerun.notebook import Viewer

        return Viewer(recording=recording, blueprint=layout, width="auto", height=720)
    except (ImportError, rr.error_utils.RerunMissingDependencyError):
        raise UserError(
            "a viewer in a notebook needs one more package: pip install 'bevviz[notebook]'"
        ) from None


def _place(result: FrameResult, picked: Selection | None) -> tuple[float, ...]:
    """Return the centre of an object identified by its row in a result. Empty for any other pick."""
    if picked is None:
        return ()
    if picked.kind == "object" and result.objects is not None:
        return tuple(map(float, result.objects.boxes.center[picked.row]))
    if picked.kind == "cluster" and result.clusters is not None:
        return tuple(map(float, result.clusters.centroid[picked.row]))
    camera = result.camera(picked.camera)
    if picked.kind == "detection" and camera is not None and camera.detections is not None:
        u0, v0, u1, v1 = map(float, camera.detections.xyxy[picked.row])
        return (u0 + u1) / 2, (v0 + v1) / 2
    return ()
