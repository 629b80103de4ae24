"""Logging of the differences of two sides: coloured boxes, counts, texts and states."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Set

import numpy as np
import rerun as rr

from bevviz.compare.sides import ComparedFrame
from bevviz.compare.summary import ComparisonSummary
from bevviz.config import Config
from bevviz.evaluate.differences import (
    DIFFERENT,
    WORST_FIRST,
    BeforeAfter,
    Change,
    Difference,
    FrameDifferences,
)
from bevviz.evaluate.ground_truth import Truth
from bevviz.model.frame import F64
from bevviz.model.protocols import Items, Observer
from bevviz.recording import entities
from bevviz.recording.frame_logger import FrameLogger
from bevviz.recording.labels import choose_named_in_3d, shown
from bevviz.recording.layers import Layer, Style, draw
from bevviz.recording.primitives import document, transform
from bevviz.recording.states import StateLanes
from bevviz.recording.writer import Writer
from bevviz.support import table
from bevviz.support.colors import SIDE_COLORS, StateColor
from bevviz.support.text import markdown, section

COLORS = {
    Change.SAME: SIDE_COLORS["same"],
    Change.MOVED: SIDE_COLORS["moved"],
    Change.CLASS: SIDE_COLORS["class"],
    Change.ONLY_A: SIDE_COLORS["only A"],
    Change.ONLY_B: SIDE_COLORS["only B"],
}
_OUTCOME_COLORS = {"broken": StateColor.BAD.value, "fixed": StateColor.GOOD.value}
HEIGHT = 0.57  # height of a view of one side, as a share of a 3D view's height in other layouts


class DifferenceLogger(Writer):
    """Writer of differences to the recording that also holds the two sides.

    Args:
        recording: target.
        names: names of the two sides.
        summary: Markdown text about the two configurations.
    """

    def __init__(self, recording: rr.RecordingStream, names: tuple[str, str], summary: str) -> None:
        super().__init__(recording)
        self._lanes = StateLanes(COLORS)  # one lane for each class, with its worst change
        self.recording.send_property("compare", rr.AnyValues(a=names[0], b=names[1]))
        a, b = map(markdown, names)
        text = f"# What was compared\n\n- **A**: {a}\n- **B**: {b}\n\n{summary}"
        self.static(entities.COMPARE_ABOUT, document(text))
        for change in DIFFERENT:
            self.static(
                entities.DIFFERENCE_COUNT.path(change),
                rr.SeriesLines(colors=[COLORS[change]], names=[change], widths=[2]),
            )
        for side, color in (("a", COLORS[Change.ONLY_A]), ("b", COLORS[Change.ONLY_B])):
            for series in ("objects", "clusters"):
                self.static(
                    entities.DIFFERENCE_COUNT.path(f"{series}_{side}"),
                    rr.SeriesLines(colors=[color], names=[f"{series} {side.upper()}"]),
                )

    def refresh(self, known: Set[str] = frozenset()) -> None:
        """Refresh the writer and log the state of every class anew."""
        super().refresh(known)
        self._lanes.states = {}

    def log(self, differences: FrameDifferences) -> None:
        """Log the differences of one frame."""
        frame = differences.a
        self.begin(frame.index, frame.stamp, frame.received)
        for change in DIFFERENT:
            changed_objects = [d for d in differences.objects if d.change is change]
            if changed_objects:
                self._log_boxes(change, changed_objects, differences)
        if differences.effects.truth is not None:
            self._log_judged(differences.effects, differences.effects.truth, frame.pose)
        for camera, pairs in differences.images.items():
            self._log_image(camera, pairs, differences)
        for name, value in _counts(differences).items():
            self.scalar(entities.DIFFERENCE_COUNT.path(name), float(value))
        self.put(entities.COMPARE, document(differences_page(differences)))
        changed = [d for d in differences.objects if d.change is not Change.SAME]
        self.lines(
            entities.COMPARE_LOG, [("INFO", f"{d.text} {differences.position_of(d)}") for d in changed]
        )
        worst = worst_of_each_class(differences.objects)
        self._lanes.log(
            self, {entities.DIFFERENCE_STATE.path(name): change for name, change in worst.items()}
        )
        self.end()

    def _log_boxes(self, change: Change, objects: list[Difference], differences: FrameDifferences) -> None:
        effects = differences.effects
        side, rows = effects.a, [d.row_a for d in objects]
        if change is not Change.ONLY_A:
            side, rows = effects.b, [d.row_b for d in objects]
        boxes = side.boxes.chosen(rows)
        path = entities.DIFFERENCE.path(change)
        # If the ground truth is known, only objects that one side alone finds get a name. They matter more.
        is_named = choose_named_in_3d(boxes.center, height=HEIGHT)
        labels = [_label(d) if effects.truth is None and is_named[i] else "" for i, d in enumerate(objects)]
        style, pose = Style(COLORS[change], 2.5, labels=True), transform(differences.a.pose)
        draw(self, Layer(path, boxes, style, labels, frame=pose))
        if change is Change.MOVED:
            start = effects.a.boxes.center[[d.row_a for d in objects]]
            arrows = rr.Arrows3D(origins=start, vectors=boxes.center - start, colors=[COLORS[change]])
            self.put(entities.FROM_A, arrows)

    def _log_judged(self, effects: BeforeAfter, truth: Truth, world_from_points: F64) -> None:
        labels_of, all_boxes = truth.labels, truth.boxes
        rows = np.array([*effects.broken, *effects.fixed], np.int64)
        is_broken = np.arange(len(rows)) < len(effects.broken)
        is_named = choose_named_in_3d(all_boxes.center[rows], is_broken, HEIGHT)
        for outcome, selected in (("broken", is_broken), ("fixed", ~is_broken)):
            names = [f"{outcome}: {labels_of[row]}" for row in rows[selected].tolist()]
            labels, boxes = shown(names, is_named[selected]), all_boxes.chosen(rows[selected])
            style = Style(_OUTCOME_COLORS[outcome], 3.5, labels=True, wire=True)
            path, pose = entities.DIFFERENCE.path(outcome), transform(world_from_points)
            draw(self, Layer(path, boxes, style, labels, frame=pose))

    def _log_image(self, camera: str, pairs: tuple[Difference, ...], differences: FrameDifferences) -> None:
        for change in (Change.CLASS, Change.ONLY_A, Change.ONLY_B):
            selected = [d for d in pairs if d.change is change]
            if not selected:
                continue
            if change is Change.ONLY_A:
                boxes = differences.a.images[camera].xyxy[[d.row_a for d in selected]]
            else:
                boxes = differences.b.images[camera].xyxy[[d.row_b for d in selected]]
            path, style = (
                entities.IMAGE_DIFFERENCE.path(camera, change),
                Style(COLORS[change], 2.5, order=40.0),
            )
            draw(self, Layer(path, boxes, style, [_label(d) for d in selected], frame=camera))


class ComparisonRecorder(Observer[ComparedFrame]):
    """Observer that logs both sides and their differences.

    Entities of A have the same paths as in a single run. Those of B are under ``/b``.

    Args:
        recording: target.
        a, b: the configurations.
        summary: of the same comparison.
    """

    def __init__(
        self, recording: rr.RecordingStream, a: Config, b: Config, summary: ComparisonSummary
    ) -> None:
        self._recording, self._configs, self._summary = recording, (a, b), summary

    def begin(self, items: Items[object]) -> None:
        """Log the static entities of both sides."""
        a, b = self._configs
        self._loggers = (
            FrameLogger(self._recording, a, items.scene),
            FrameLogger(self._recording, b, items.scene, entities.B),
        )
        for logger in self._loggers:
            logger.log_static()
        self._differences = DifferenceLogger(self._recording, self._summary.names, self._summary.about)

    def observe(self, compared: ComparedFrame) -> None:
        """Log both sides and their differences for a frame."""
        for logger, result in zip(self._loggers, (compared.a, compared.b), strict=True):
            if result is not None:
                logger.log(result)
        if compared.found is not None:
            self._differences.log(compared.found)


def worst_of_each_class(objects: tuple[Difference, ...]) -> Mapping[str, Change]:
    """Return the worst change of each class of either side. A missing object is worse than one that moved."""
    worst: dict[str, Change] = {}
    for difference in sorted(objects, key=lambda d: WORST_FIRST.index(d.change)):
        for name in {difference.name_a, difference.name_b} - {""}:
            worst.setdefault(name, difference.change)
    return worst


def differences_page(differences: FrameDifferences) -> str:
    """Return the differences of one frame as Markdown."""
    head, effects = f"### Frame {differences.a.index}", differences.effects
    lines = [head, "", table.markdown([("", "A", "B"), *_totals(differences)])]
    for title, objects in (("Broken by B", effects.broken), ("Fixed by B", effects.fixed)):
        lines += section(f"{title}: {len(objects)}", [markdown(effects.label_text(row)) for row in objects])
    for change in (*DIFFERENT, Change.SAME):
        selected = [d for d in differences.objects if d.change is change]
        title = f"{change[0].upper()}{change[1:]}: {len(selected)}"
        lines += section(title, [f"{markdown(_item(d))} {differences.position_of(d)}" for d in selected])
    for camera, pairs in differences.images.items():
        texts = [markdown(d.text) for d in pairs if d.change is not Change.SAME]
        lines += section(f"Detections, {markdown(camera)}", texts)
    return "\n".join(lines)


def _totals(differences: FrameDifferences) -> Iterator[tuple[str, str, str]]:
    """Yield table rows: title, number in A, number in B."""
    a, b = differences.a, differences.b
    yield "objects", str(len(a.objects)), str(len(b.objects))
    if a.clusters is not None or b.clusters is not None:
        yield (
            "clusters",
            "-" if a.clusters is None else str(a.clusters),
            "-" if b.clusters is None else str(b.clusters),
        )
    if differences.effects.truth is not None:
        there, *found = differences.effects.found
        yield f"found of {there} that are there", str(found[0]), str(found[1])
    for camera in differences.images:
        yield f"detections, {camera}", str(len(a.images[camera].names)), str(len(b.images[camera].names))


def _item(difference: Difference) -> str:
    if difference.change in (Change.ONLY_A, Change.ONLY_B, Change.SAME):
        return difference.name_a or difference.name_b
    return difference.text


def _label(difference: Difference) -> str:
    if difference.change is Change.CLASS:
        return f"{difference.name_a} -> {difference.name_b}"
    if difference.change is Change.MOVED:
        return f"{difference.name_b} moved {difference.distance:.2f} m"
    return f"{difference.name_a or difference.name_b}: {difference.change}"


def _counts(differences: FrameDifferences) -> dict[str, int]:
    counts: dict[str, int] = {change: differences.counts[change] for change in DIFFERENT}
    for side_name, side in (("a", differences.a), ("b", differences.b)):
        counts[f"objects_{side_name}"] = len(side.objects)
        if side.clusters is not None:
            counts[f"clusters_{side_name}"] = side.clusters
    return counts
