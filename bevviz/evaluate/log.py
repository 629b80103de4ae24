"""Logging of an evaluation: true, false and missed objects in their colours, counts, and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import TypeAlias

import numpy as np
import rerun as rr

from bevviz.evaluate.evaluation import Evaluation, page
from bevviz.evaluate.ground_truth import Truth
from bevviz.model.frame import Boxes3D, Camera
from bevviz.model.protocols import Items, Observer
from bevviz.model.reasons import Reason
from bevviz.model.results import FrameResult
from bevviz.recording import entities
from bevviz.recording.labels import (
    IN_IMAGE,
    LETTER_WIDTH,
    choose_named,
    choose_named_in_3d,
    log_box_label_style,
    log_box_labels,
    log_labelled_outlines,
    log_name_style,
)
from bevviz.recording.primitives import CORNER, boxes3d, document, image_outlines, transform
from bevviz.recording.writer import SCALAR_WAIT, Writer
from bevviz.support.colors import TRUTH_COLORS
from bevviz.support.text import markdown

# Outcome, boxes, rows with this outcome, names of all boxes.
BoxGroup: TypeAlias = tuple[str, Boxes3D, Sequence[int], Sequence[str]]
_WRONG = ("missed", "false")  # outcomes whose objects have names, and outlines in the images


class EvaluationRecorder(Observer[FrameResult]):
    """Observer that logs the evaluation of each frame. The evaluation must see the frame first.

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
            looks = rr.Boxes3D.from_fields(colors=[color], radii=rr.Radius.ui_points(0.5), show_labels=False)
            self._writer.static(entities.judged(outcome), looks)
            log_box_label_style(self._writer, entities.judged(outcome))
            series = rr.SeriesLines(colors=[color], names=[outcome], widths=[2])
            self._writer.static(entities.judged_count(outcome), series)
        for camera, outcome in product(items.scene.cameras, _WRONG):
            path, color = entities.image_judged(camera, outcome), TRUTH_COLORS[outcome]
            lines = rr.LineStrips2D.from_fields(
                colors=[color], radii=rr.Radius.ui_points(2.0), draw_order=36.0
            )
            self._writer.static(path, lines)
            log_name_style(self._writer, path, 37.0)

    def observe(self, result: FrameResult) -> None:
        """Log the evaluation of a frame."""
        if self._evaluation.last is None:
            return
        writer, frame = self._writer, result.frame
        writer.begin(frame.index, frame.stamp, frame.received)
        _, truth, matches = self._evaluation.last
        judges = self._evaluation.judges
        groups: list[BoxGroup] = [
            ("missed", truth.boxes, np.flatnonzero(matches.missed).tolist(), truth.labels)
        ]
        if (objects := result.objects) is not None:
            false = [j for j in np.flatnonzero(matches.false).tolist() if judges(objects.names[j].lower())]
            groups.append(("false", objects.boxes, false, objects.names))
            groups.append(("true", objects.boxes, np.flatnonzero(matches.true).tolist(), objects.names))
        groups = [group for group in groups if group[2]]
        self._boxes(result, groups)
        for camera in result.cameras:
            self._outlines(camera.camera, [group for group in groups if group[0] in _WRONG])
        judged = self._evaluation.now
        texts_by_outcome = {outcome: judged[outcome] for outcome in (*_WRONG, "true")}
        for outcome, texts in texts_by_outcome.items():
            writer.scalar(entities.judged_count(outcome), float(len(texts)))
        writer.put(entities.EVALUATE, document(_page(frame.index, truth, texts_by_outcome)))
        wrong = [("ERROR", f"{outcome} {text}") for outcome in _WRONG for text in texts_by_outcome[outcome]]
        writer.lines(entities.EVALUATE_LOG, wrong)
        writer.end()

    def _boxes(self, result: FrameResult, groups: Sequence[BoxGroup]) -> None:
        """Log the boxes. A right object shows its name only under the pointer.

        So does a wrong one without enough room for a label.
        """
        centers = np.concatenate(
            [np.zeros((0, 3), np.float32), *(b.center[rows] for _, b, rows, _ in groups)]
        )
        wrong = np.repeat(
            [outcome != "true" for outcome, *_ in groups], [len(rows) for *_, rows, _ in groups]
        )
        named = iter((choose_named_in_3d(centers, wrong) & wrong).tolist() if len(wrong) else [])
        for outcome, boxes, rows, names in groups:
            chosen, path = boxes.chosen(rows), entities.judged(outcome)
            causes = self._evaluation.causes if outcome == "false" else {}
            labels = [f"{outcome}: {names[row]}{_cause(causes, row)}" for row in rows]
            logged = boxes3d(boxes, np.asarray(rows), labels)
            self._writer.put(path, transform(result.frame.pose), logged)
            visible_labels = [label if next(named) else "" for label in labels]
            distances = chosen.distance.tolist()
            descriptions = [
                f"{label}, {metres:.1f} m away" for label, metres in zip(labels, distances, strict=True)
            ]
            log_box_labels(
                self._writer, path, chosen, visible_labels, descriptions, [TRUTH_COLORS[outcome]] * len(rows)
            )

    def _outlines(self, camera: Camera, groups: Sequence[BoxGroup]) -> None:
        """Log the outlines of wrong objects over an image, the nearest with names that do not overlap."""
        if camera.intrinsics is None:
            return
        found = [
            (outcome, stroke, f"{outcome}: {names[row]}", float(metres))
            for outcome, boxes, rows, names in groups
            for row, metres, stroke in zip(
                rows, boxes.distance[rows], image_outlines(boxes.chosen(rows), camera), strict=True
            )
            if len(stroke)
        ]
        if not found:
            return
        width, (across, up) = camera.intrinsics.width, IN_IMAGE
        # Names stand above the objects, because detections have theirs below.
        places = np.array(
            [(stroke[:, 0].mean(), max(stroke[:, 1].min() - up * width, 0)) for _, stroke, *_ in found],
            np.float32,
        )
        letters = np.array([len(label) for _, _, label, _ in found], np.float64)
        distances = np.array([metres for *_, metres in found], np.float32)
        named = choose_named(places / width, distances, (np.maximum(across, LETTER_WIDTH * letters), up))
        for outcome in _WRONG:
            chosen = [row for row, (word, *_) in enumerate(found) if word == outcome]
            if chosen:
                log_labelled_outlines(
                    self._writer,
                    entities.image_judged(camera.name, outcome),
                    [found[row][1] + np.float32(CORNER) for row in chosen],
                    [found[row][2] if named[row] else "" for row in chosen],
                    [f"{found[row][2]}, {found[row][3]:.1f} m away" for row in chosen],
                    places[chosen],
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
        if texts:
            lines += ["", f"#### {outcome[0].upper()}{outcome[1:]}: {len(texts)}", ""]
            lines += [f"- {markdown(text)}" for text in texts]
    return "\n".join(lines)
