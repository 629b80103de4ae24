"""Logging of an evaluation: true, false and missed objects in their colours, counts, and tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import rerun as rr

from bevviz.evaluate.evaluation import Evaluation
from bevviz.evaluate.ground_truth import Truth
from bevviz.evaluate.tables import page
from bevviz.model.colors import TRUTH
from bevviz.model.frame import Boxes3D
from bevviz.model.protocols import Items, Observer
from bevviz.model.results import FrameResult
from bevviz.recording import entities
from bevviz.recording.labels import log_spoken, log_spoken_looks, named_in_space
from bevviz.recording.primitives import boxes3d, document, transform
from bevviz.recording.writer import WAIT, Writer
from bevviz.support.text import markdown

# Outcome, boxes, rows with this outcome, names of all boxes.
Judged: TypeAlias = tuple[str, Boxes3D, Sequence[int], Sequence[str]]


class EvaluationRecorder(Observer[FrameResult]):
    """Observer that logs the evaluation of each frame. The evaluation must see the frame first.

    Args:
        recording: target.
        evaluation: observer of the same run.
    """

    def __init__(self, recording: rr.RecordingStream, evaluation: Evaluation) -> None:
        self._evaluation = evaluation
        self._writer = Writer(recording, wait=WAIT)

    def begin(self, items: Items[object]) -> None:
        """Log the colours and the names of the plots."""
        for what, color in TRUTH.items():
            looks = rr.Boxes3D.from_fields(colors=[color], radii=rr.Radius.ui_points(0.5), show_labels=False)
            self._writer.static(entities.judged(what), looks)
            log_spoken_looks(self._writer, entities.judged(what))
            series = rr.SeriesLines(colors=[color], names=[what], widths=[2])
            self._writer.static(entities.judged_count(what), series)

    def see(self, result: FrameResult) -> None:
        """Log the evaluation of a frame."""
        if self._evaluation.last is None:
            return
        writer, frame = self._writer, result.frame
        writer.begin(frame.index, frame.stamp, frame.received)
        _, truth, matches = self._evaluation.last
        judges = self._evaluation.judges
        parts: list[Judged] = [("missed", truth.boxes, np.flatnonzero(matches.missed).tolist(), truth.labels)]
        if (objects := result.objects) is not None:
            false = [j for j in np.flatnonzero(matches.false).tolist() if judges(objects.names[j].lower())]
            parts.append(("false", objects.boxes, false, objects.names))
            parts.append(("true", objects.boxes, np.flatnonzero(matches.true).tolist(), objects.names))
        self._boxes(result, [part for part in parts if part[2]])
        said = self._evaluation.now
        words = {what: said[what] for what in ("missed", "false", "true")}
        for what, texts in words.items():
            writer.scalar(entities.judged_count(what), float(len(texts)))
        writer.put(entities.EVALUATE, document(_page(frame.index, truth, words)))
        wrong = [("ERROR", f"{what} {text}") for what in ("missed", "false") for text in words[what]]
        writer.lines(entities.EVALUATE_LOG, wrong)
        writer.end()

    def _boxes(self, result: FrameResult, parts: Sequence[Judged]) -> None:
        """Log the boxes. A right object shows its name only under the pointer.

        So does a wrong one without enough room for a label.
        """
        centers = np.concatenate([np.zeros((0, 3), np.float32), *(b.center[rows] for _, b, rows, _ in parts)])
        wrong = np.repeat([what != "true" for what, *_ in parts], [len(rows) for *_, rows, _ in parts])
        named = iter((named_in_space(centers, wrong) & wrong).tolist() if len(wrong) else [])
        for what, boxes, rows, names in parts:
            chosen, path = boxes.chosen(rows), entities.judged(what)
            labels = [f"{what}: {names[row]}" for row in rows]
            logged = boxes3d(boxes, np.asarray(rows), labels)
            self._writer.put(path, transform(result.frame.pose), logged)
            shown = [label if next(named) else "" for label in labels]
            away = np.hypot(*chosen.center[:, :2].T).tolist()
            said = [f"{label}, {metres:.1f} m away" for label, metres in zip(labels, away, strict=True)]
            log_spoken(self._writer, path, chosen, shown, said, [TRUTH[what]] * len(rows))

    def end(self) -> None:
        """Log the tables of the whole run."""
        self._writer.static(entities.EVALUATE_ABOUT, document(f"# Evaluation\n\n{page(self._evaluation)}"))
        self._writer.close()


def _page(index: int, truth: Truth, words: dict[str, Sequence[str]]) -> str:
    lines = [f"### Frame {index}", "", f"{int(truth.must.sum())} objects had to be found"]
    for what, texts in words.items():
        if texts:
            lines += ["", f"#### {what[0].upper()}{what[1:]}: {len(texts)}", ""]
            lines += [f"- {markdown(text)}" for text in texts]
    return "\n".join(lines)
