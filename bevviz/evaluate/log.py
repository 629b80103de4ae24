"""Logging of an evaluation: true, false and missed objects in their colours, counts, and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr

from bevviz.evaluate.evaluation import Evaluation, page
from bevviz.evaluate.ground_truth import Truth
from bevviz.model.frame import Bool, Boxes3D
from bevviz.model.protocols import Items, Observer
from bevviz.model.reasons import Reason
from bevviz.model.results import FrameResult, Objects
from bevviz.recording import entities
from bevviz.recording.layers import Layer, Style, callouts, draw
from bevviz.recording.primitives import document, transform
from bevviz.recording.writer import SCALAR_WAIT, Writer
from bevviz.support.colors import TRUTH_COLORS
from bevviz.support.text import markdown, section

_WRONG = ("missed", "false")  # outcomes whose objects have marks


class EvaluationRecorder(Observer[FrameResult]):
    """Observer that logs the evaluation of each frame, without the marks of ``findings.marks``.

    The evaluation must see the frame first.

    Args:
        recording: target.
        evaluation: observer of the same run.
    """

    def __init__(self, recording: rr.RecordingStream, evaluation: Evaluation) -> None:
        self._evaluation = evaluation
        self._writer = Writer(recording, wait=SCALAR_WAIT)

    def begin(self, items: Items[object]) -> None:
        """Log the colours and the names of the plots."""
        for outcome, color in TRUTH_COLORS.items():
            series = rr.SeriesLines(colors=[color], names=[outcome], widths=[2])
            self._writer.static(entities.JUDGED_COUNT.path(outcome), series)

    def observe(self, result: FrameResult) -> None:
        """Log the evaluation of a frame."""
        if self._evaluation.last is None:
            return
        writer, frame = self._writer, result.frame
        writer.begin(frame.index, frame.stamp, frame.received)
        _, truth, matches = self._evaluation.last
        objects = result.objects or Objects.empty()
        self._boxes(result, "missed", truth.boxes, matches.missed, truth.labels)
        self._boxes(result, "false", objects.boxes, matches.false, objects.names)
        self._boxes(result, "true", objects.boxes, matches.true, objects.names)
        judged = self._evaluation.now
        texts_by_outcome = {"missed": judged.missed, "false": judged.false, "true": judged.true}
        for outcome, texts in texts_by_outcome.items():
            writer.scalar(entities.JUDGED_COUNT.path(outcome), float(len(texts)))
        writer.put(entities.EVALUATE, document(_page(frame.index, truth, texts_by_outcome)))
        wrong = [("ERROR", f"{outcome} {text}") for outcome in _WRONG for text in texts_by_outcome[outcome]]
        writer.lines(entities.EVALUATE_LOG, wrong)
        writer.end()

    def _boxes(
        self, result: FrameResult, outcome: str, boxes: Boxes3D, is_own: Bool, names: Sequence[str]
    ) -> None:
        """Log the boxes of an outcome, with names under the pointer."""
        rows = np.flatnonzero(is_own).tolist()
        if not rows:
            return
        chosen, path = boxes.chosen(rows), entities.JUDGED.path(outcome)
        causes = self._evaluation.causes if outcome == "false" else {}
        labels = [f"{outcome}: {names[row]}{_cause(causes, row)}" for row in rows]
        distances = chosen.distance.tolist()
        says = [f"{label}, {metres:.1f} m away" for label, metres in zip(labels, distances, strict=True)]
        color, pose = TRUTH_COLORS[outcome], transform(result.frame.pose)
        draw(
            self._writer,
            Layer(path, chosen, Style(color, 0.5, labels=False), labels, frame=pose),
            *callouts(path, chosen, says, (), [color] * len(rows)),
        )

    def end(self) -> None:
        """Log the tables of the whole run."""
        self._writer.static(entities.EVALUATE_ABOUT, document(f"# Evaluation\n\n{page(self._evaluation)}"))
        self._writer.close()


def _cause(causes: Mapping[int, Reason], row: int) -> str:
    """Return the cause of a false object for its label; empty: unknown."""
    return f", {causes[row].kind.value}" if row in causes else ""


def _page(index: int, truth: Truth, texts_by_outcome: dict[str, Sequence[str]]) -> str:
    lines = [f"### Frame {index}", "", f"{int(truth.must.sum())} objects had to be found"]
    for outcome, texts in texts_by_outcome.items():
        lines += section(f"{outcome.capitalize()}: {len(texts)}", [*map(markdown, texts)])
    return "\n".join(lines)
