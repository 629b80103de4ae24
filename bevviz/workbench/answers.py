"""What ``bevviz why`` answers about a pick."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bevviz.errors import UserError
from bevviz.frame import FrameResult
from bevviz.perceive import StageLoader
from bevviz.why import Answer, Selection, why
from bevviz.workbench.pick import Pick

RADIUS = 0.5  # metres around a point


class Answers:
    """Answers questions about one frame.

    Args:
        result: what was made of the frame, described.
        loader: that has the networks already.
        classes: names that the detector knows.
    """

    def __init__(self, result: FrameResult, loader: StageLoader, classes: Sequence[str]) -> None:
        self.result, self._loader, self._classes = result, loader, classes

    def ask(self, pick: Pick, hints: bool = False) -> Answer:
        """The answer. With ``hints`` other configurations are run, which takes a while.

        Raises:
            UserError: the frame has no such thing.
        """
        selection, row = self._selection(pick)
        answers = why(self.result, selection, self._classes, hints=0, loader=self._loader)
        if row is not None:
            answers = [a for a in answers if (a.subject.kind, a.subject.row) == ("truth", row)]
        if not answers:
            raise UserError(f"there is nothing to say about {pick}")
        if not hints:
            return answers[0]
        wanted = answers[0].subject.key
        count = 1 if row is None else len(self._truth_labels)
        tried = why(self.result, selection, self._classes, hints=count, loader=self._loader)
        return next(answer for answer in tried if answer.subject.key == wanted)

    @property
    def _truth_labels(self) -> Sequence[str]:
        truth = self.result.frame.truth
        return truth.labels if truth is not None else ()

    def _selection(self, pick: Pick) -> tuple[Selection, int | None]:
        """The selection, and the row of the ground truth where it is of one."""
        result = self.result
        if pick.kind == "truth":
            if not 0 <= pick.row < len(self._truth_labels):
                raise UserError(f"the ground truth of this frame has no object {pick.row}")
            return Selection(label=self._truth_labels[pick.row]), pick.row
        if pick.kind == "object":
            objects = result.objects
            if objects is None or not 0 <= pick.row < len(objects):
                raise UserError(f"there is no object {pick.row} in this frame")
            pick = Pick("detection", int(objects.detection[pick.row]), objects.camera[pick.row])
        if pick.kind == "detection":
            found = next((c.detections for c in result.cameras if c.camera.name == pick.camera), None)
            if found is None or not 0 <= pick.row < len(found):
                raise UserError(f"there is no detection {pick.row} of {pick.camera} in this frame")
            return Selection(box=tuple(map(float, found.xyxy[pick.row])), camera=pick.camera), None
        if pick.kind == "pixel":
            return Selection(box=pick.place, camera=pick.camera), None
        if pick.kind == "cluster":
            clusters = result.clusters
            if clusters is None or not 0 <= pick.row < len(clusters):
                raise UserError(f"there is no cluster {pick.row} in this frame")
            radius = max(RADIUS, float(np.linalg.norm(clusters.obb.size[pick.row])) / 2)
            return Selection(point=_floats(clusters.obb.center[pick.row]), radius=radius), None
        return Selection(
            point=pick.place if pick.kind == "point" else self._column(pick), radius=RADIUS
        ), None

    def _column(self, pick: Pick) -> tuple[float, ...]:
        """The highest obstacle in a cell of the bird's-eye view, else the ground there."""
        config, points = self.result.config.bev, self.result.frame.points
        row, column = pick.place
        x = config.range_x - (row + 0.5) * config.resolution
        y = config.range_y - (column + 0.5) * config.resolution
        if self.result.obstacles is not None and len(self.result.obstacles):
            near = np.hypot(self.result.obstacles[:, 0] - x, self.result.obstacles[:, 1] - y) < RADIUS
            points = self.result.obstacles if near.any() else points
        away = np.hypot(points[:, 0] - x, points[:, 1] - y)
        near = away < RADIUS
        z = float(np.median(points[near, 2])) if near.any() else 0.0
        return x, y, z


def _floats(values: np.ndarray[tuple[int], np.dtype[np.floating]]) -> tuple[float, ...]:
    return tuple(map(float, values))
