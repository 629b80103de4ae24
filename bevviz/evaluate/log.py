"""Logs an evaluation: true, false and missed objects in their colours, counts, and the tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr

from bevviz.colors import TRUTH
from bevviz.evaluate.evaluation import Evaluation
from bevviz.evaluate.tables import page
from bevviz.evaluate.truth import Truth
from bevviz.frame import Boxes3D, FrameResult
from bevviz.logging import entities
from bevviz.logging.pieces import boxes3d, document, transform
from bevviz.logging.spoken import log_spoken, log_spoken_looks, named_in_space
from bevviz.logging.writer import WAIT, Writer
from bevviz.run import Items, Observer
from bevviz.text import markdown


class EvaluationRecorder(Observer[FrameResult]):
    """Writes what an evaluation says of each frame beside the run; it must have seen the frame before.

    Args:
        recording: where to.
        evaluation: an observer of the same run.
    """

    def __init__(self, recording: rr.RecordingStream, evaluation: Evaluation) -> None:
        self._evaluation = evaluation
        self._writer = Writer(recording, wait=WAIT)

    def begin(self, items: Items[object]) -> None:
        for what, color in TRUTH.items():
            looks = rr.Boxes3D.from_fields(colors=[color], radii=rr.Radius.ui_points(0.5), show_labels=False)
            self._writer.static(entities.judged(what), looks)
            log_spoken_looks(self._writer, entities.judged(what))
            series = rr.SeriesLines(colors=[color], names=[what], widths=[2])
            self._writer.static(entities.judged_count(what), series)

    def see(self, result: FrameResult) -> None:
        if self._evaluation.last is None:
            return
        writer, frame = self._writer, result.frame
        writer.begin(frame.index, frame.stamp, frame.received)
        _, truth, matches = self._evaluation.last
        names = self._evaluation.names
        if (objects := result.objects) is not None:
            false = [j for j in np.flatnonzero(matches.false).tolist() if objects.names[j].lower() in names]
            self._boxes(result, "true", objects.boxes, np.flatnonzero(matches.true).tolist(), objects.names)
            self._boxes(result, "false", objects.boxes, false, objects.names)
        self._boxes(result, "missed", truth.boxes, np.flatnonzero(matches.missed).tolist(), truth.labels)
        said = self._evaluation.now
        words = {what: said[what] for what in ("missed", "false", "true")}
        for what, texts in words.items():
            writer.scalar(entities.judged_count(what), float(len(texts)))
        writer.put(entities.EVALUATE, document(_page(frame.index, truth, words)))
        wrong = [("ERROR", f"{what} {text}") for what in ("missed", "false") for text in words[what]]
        writer.lines(entities.EVALUATE_LOG, wrong)
        writer.end()

    def _boxes(
        self,
        result: FrameResult,
        what: str,
        boxes: Boxes3D,
        rows: Sequence[int],
        names: Sequence[str],
    ) -> None:
        if not rows:
            return
        chosen = np.asarray(rows)
        labels = [f"{what}: {names[row]}" for row in rows]
        logged, path = boxes3d(boxes, chosen, labels), entities.judged(what)
        self._writer.put(path, transform(result.frame.pose), logged)
        # What is right is named where the pointer is.
        named = named_in_space(boxes.center[chosen]) & (what != "true")
        shown = [label if is_named else "" for label, is_named in zip(labels, named, strict=True)]
        away = np.hypot(*boxes.center[chosen, :2].T).tolist()
        said = [f"{label}, {metres:.1f} m away" for label, metres in zip(labels, away, strict=True)]
        log_spoken(self._writer, path, boxes.chosen(chosen), shown, said, [TRUTH[what]] * len(rows))

    def end(self) -> None:
        self._writer.static(entities.EVALUATE_ABOUT, document(f"# Evaluation\n\n{page(self._evaluation)}"))
        self._writer.close()


def _page(index: int, truth: Truth, words: dict[str, Sequence[str]]) -> str:
    lines = [f"### Frame {index}", "", f"{int(truth.must.sum())} objects had to be found"]
    for what, texts in words.items():
        if texts:
            lines += ["", f"#### {what[0].upper()}{what[1:]}: {len(texts)}", ""]
            lines += [f"- {markdown(text)}" for text in texts]
    return "\n".join(lines)
