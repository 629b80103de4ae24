"""Summary of the differences in all frames: table, JSON and CSV."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

import numpy as np

from bevviz.compare.sides import ComparedFrame
from bevviz.config import ParameterChange
from bevviz.errors import printable
from bevviz.evaluate import ObjectScore
from bevviz.evaluate.differences import (
    DIFFERENT,
    WORST_FIRST,
    BeforeAfter,
    Change,
    Difference,
    FrameDifferences,
)
from bevviz.model.protocols import Observer
from bevviz.support import table
from bevviz.support.json_form import json_form
from bevviz.support.text import fenced

WORST = 10  # number of frames in the table
EXAMPLES = 2  # number of objects shown for each frame
COLUMNS = ("objects A", "objects B", *(change.value for change in (Change.SAME, *DIFFERENT)))


@dataclass(frozen=True, slots=True)
class ImageDifference:
    """A detection that differs."""

    change: str
    class_a: str
    class_b: str
    camera: str
    text: str
    place: str


@dataclass(frozen=True, slots=True)
class ObjectDifference:
    """An object that differs."""

    change: str
    class_a: str
    class_b: str
    x: float | None
    """metres in the frame of the points"""
    y: float | None
    z: float | None
    distance: float | None
    """metres between both sides"""
    iou: float | None
    text: str
    place: str


@dataclass(frozen=True, slots=True)
class DifferingFrame:
    """Differences of one frame."""

    frame: int
    """number of the scan"""
    stamp: int
    """nanoseconds since 1970"""
    number: int
    """differences"""
    fixed: Sequence[str]
    """labelled objects that only B finds"""
    broke: Sequence[str]
    """labelled objects that only A finds"""
    objects: Sequence[ObjectDifference]
    detections: Sequence[ImageDifference]


@dataclass(frozen=True, slots=True)
class SideCounts:
    """A number for each side."""

    A: int
    B: int


@dataclass(frozen=True, slots=True)
class TruthCounts:
    """Both sides against the ground truth."""

    classes: Mapping[str, Mapping[str, int]]
    """labelled objects: there, found by A and B, fixed and broken by B"""
    wrong: SideCounts
    """objects that are none"""


@json_form
@dataclass(frozen=True, slots=True)
class ComparisonResult:
    """Differences of two runs."""

    a: str
    b: str
    config: Mapping[str, str]
    """parameters that differ: before -> after"""
    objects: Mapping[str, Mapping[str, int]]
    """counts by class and change"""
    detections: Mapping[str, Mapping[str, int]]
    """counts by class and change"""
    clusters: SideCounts
    """number in all frames"""
    truth: TruthCounts | None
    """null: no ground truth"""
    frames: Sequence[DifferingFrame]


class ComparisonSummary(Observer[ComparedFrame]):
    """Observer that counts differences over all frames.

    Args:
        names: names of the two sides.
        config: dotted key -> how its value differs.
    """

    def __init__(self, names: tuple[str, str], config: Mapping[str, ParameterChange]) -> None:
        self.names, self.config = names, {key: str(change) for key, change in config.items()}
        self.without = 0  # frames for which a side has no result
        self.frames: list[DifferingFrame] = []
        self._classes: dict[str, Counter[str]] = defaultdict(Counter)
        self._detections: dict[str, Counter[str]] = defaultdict(Counter)
        self._clusters: Counter[str] = Counter()
        self._other_clusters = 0  # frames in which the number of clusters differs
        self._detected = False
        self._scores = {"A": ObjectScore(), "B": ObjectScore()}
        self._changes: dict[str, Counter[str]] = defaultdict(Counter)  # by class of the ground truth
        self._moved: list[float] = []

    @property
    def about(self) -> str:
        """Differences of the configurations, in Markdown."""
        return fenced("\n".join(parameters(self.config)))

    def observe(self, compared: ComparedFrame) -> None:
        """Count a frame, or note that a side has no result."""
        if compared.found is None:
            self.without += 1
        else:
            self.add(compared.found)

    def add(self, differences: FrameDifferences) -> None:
        """Count the differences of a frame."""
        for difference in differences.objects:
            _count(self._classes, difference)
            if difference.change is Change.MOVED:
                self._moved.append(difference.distance)
        for pairs in differences.images.values():
            for difference in pairs:
                _count(self._detections, difference)
        for side, key in ((differences.a, "objects A"), (differences.b, "objects B")):
            if side.clusters is not None:
                self._clusters[key] += side.clusters
        self._other_clusters += differences.a.clusters != differences.b.clusters
        self._detected |= bool(differences.a.images or differences.b.images)
        effects = differences.effects
        self._judge(effects)
        differing = [d for d in differences.objects if d.change is not Change.SAME]
        self.frames.append(
            DifferingFrame(
                frame=differences.a.index,
                stamp=differences.a.stamp,
                number=differences.number,
                fixed=[*map(effects.label_text, effects.fixed)],
                broke=[*map(effects.label_text, effects.broken)],
                objects=[_row(d, differences) for d in differing],
                detections=[
                    ImageDifference(d.change.value, d.name_a, d.name_b, camera, d.text, f"in {camera}")
                    for camera, pairs in differences.images.items()
                    for d in pairs
                    if d.change is not Change.SAME
                ],
            )
        )

    def _judge(self, effects: BeforeAfter) -> None:
        if (truth := effects.truth) is None:
            return
        for side, objects, matches in (("A", effects.a, effects.before), ("B", effects.b, effects.after)):
            assert matches is not None
            self._scores[side].count(objects, truth, matches)
        for outcome, rows in (("fixed", effects.fixed), ("broke", effects.broken)):
            for row in rows:
                self._changes[truth.labels[row].lower()][outcome] += 1

    @property
    def truth(self) -> TruthCounts | None:
        """Labelled objects that each side finds, by class, and the number of false ones. None: no truth."""
        of_sides = {side: score.classes for side, score in self._scores.items()}
        classes = {}
        for name, counts in of_sides["A"].items():
            if there := counts["true"] + counts["missed"]:
                found = {side: of_side[name]["true"] for side, of_side in of_sides.items()}
                classes[name] = Counter(there=there, **found, **self._changes[name])
        if not classes:
            return None
        wrong = {side: score.total["false"] for side, score in self._scores.items()}
        return TruthCounts(classes, SideCounts(**wrong))

    @property
    def worst(self) -> Sequence[DifferingFrame]:
        """Frames that differ. Frames in which B loses an object come first, then those with most changes."""
        return sorted(
            (f for f in self.frames if f.number),
            key=lambda f: (-len(f.broke), -f.number, f.frame),
        )

    def table(self) -> str:
        """Return the summary for the terminal."""
        return "\n".join(map(printable, self._lines()))

    def _lines(self) -> Iterator[str]:
        yield f"A: {self.names[0]}"
        yield f"B: {self.names[1]}"
        yield from parameters(self.config)
        yield ""
        yield from table.lines([("objects", *COLUMNS), *_rows(self._classes)])
        if self._moved:
            yield f"moved: {np.median(self._moved):.2f} m (median), {max(self._moved):.2f} m at most"
        if self._detections:
            yield ""
            without = tuple(c for c in COLUMNS if c != Change.MOVED)
            yield from table.lines([("detections", *without), *_rows(self._detections, without)])
        if self._clusters:
            yield ""
            yield f"clusters: {self._clusters['objects A']} in A, {self._clusters['objects B']} in B"
        yield from self._truth_lines()
        yield ""
        worst = self.worst
        if not worst:
            yield self._no_difference()
            return
        yield f"{len(worst)} of {len(self.frames)} frames differ; the worst:"
        for frame in worst[:WORST]:
            differences: list[ObjectDifference | ImageDifference] = [*frame.objects, *frame.detections]
            counts = Counter(d.change for d in differences)
            change_counts = ", ".join(
                f"{counts[change]} {change}" for change in WORST_FIRST if counts[change]
            )
            differences.sort(key=lambda d: WORST_FIRST.index(d.change))
            examples = [
                *(f"broke {text}" for text in frame.broke),
                *(f"fixed {text}" for text in frame.fixed),
            ]
            examples = examples or [f"{d.text} {d.place}" for d in differences]
            more = "; ..." if examples[EXAMPLES:] else ""
            yield f"  frame {frame.frame}: {change_counts} ({'; '.join(examples[:EXAMPLES])}{more})"

    def _truth_lines(self) -> Iterator[str]:
        truth = self.truth
        if truth is None or not self._detected:
            return
        columns = ("there", "A", "B", "fixed", "broke")
        rows = [*_rows({name: Counter(counts) for name, counts in truth.classes.items()}, columns)]
        *_, fixed, broke = rows[-1]
        heads = ("of the truth", "there", "found by A", "found by B", "fixed by B", "broken by B")
        yield ""
        yield from table.lines([heads, *rows])
        wrong = f"{truth.wrong.A} in A, {truth.wrong.B} in B"
        yield f"B fixed {fixed}, broke {broke}; objects that are none: {wrong}"

    def _no_difference(self) -> str:
        frames = f"{len(self.frames)} frames"
        if not self._other_clusters:
            return f"no difference in {frames}"
        objects = "no object differs" if self._detected else "no detector (--model FILE.onnx), so no objects"
        return f"{objects}; the number of clusters differs in {self._other_clusters} of {frames}"

    def result(self) -> ComparisonResult:
        """Return the counts and every difference."""
        return ComparisonResult(
            *self.names,
            config=self.config,
            objects=self._classes,
            detections=self._detections,
            clusters=SideCounts(self._clusters["objects A"], self._clusters["objects B"]),
            truth=self.truth,
            frames=self.frames,
        )

    def write_csv(self, path: Path) -> None:
        """Write a row for each object that differs.

        Raises:
            UserError: the file cannot be written.
        """
        header = ("frame", "stamp", "change", "class_a", "class_b", "x", "y", "z", "distance", "iou")
        of_object = attrgetter(*header[2:])
        rows = [(one.frame, one.stamp, *of_object(row)) for one in self.frames for row in one.objects]
        table.save_csv(path, [header, *rows], "--csv")


def parameters(config: Mapping[str, str]) -> Iterator[str]:
    """Yield the parameters that differ, one in each line."""
    if not config:
        yield "parameters: no difference"
        return
    yield "parameters that differ, A -> B:"
    yield from (f"  {line}" for line in table.lines(list(config.items()), "ll"))


def _count(counts: Mapping[str, Counter[str]], difference: Difference) -> None:
    """Count a difference under B's class, or under A's if B lacks the object."""
    counts[difference.name_b or difference.name_a][difference.change.value] += 1
    if difference.name_a:
        counts[difference.name_a]["objects A"] += 1
    if difference.name_b:
        counts[difference.name_b]["objects B"] += 1


def _rows(counts: Mapping[str, Counter[str]], which: Sequence[str] = COLUMNS) -> Iterator[tuple[str, ...]]:
    for name in sorted(counts):
        yield (name, *(str(counts[name][column]) for column in which))
    total: Counter[str] = sum(counts.values(), Counter())
    yield ("all", *(str(total[column]) for column in which))


def _row(difference: Difference, differences: FrameDifferences) -> ObjectDifference:
    x, y, z = (round(v, 3) for v in differences.box_of(difference).center[0].tolist())
    pair = difference.row_a >= 0 and difference.row_b >= 0
    return ObjectDifference(
        change=difference.change.value,
        class_a=difference.name_a,
        class_b=difference.name_b,
        x=x,
        y=y,
        z=z,
        distance=round(difference.distance, 3) if pair else None,
        iou=round(difference.iou, 3) if pair else None,
        text=difference.text,
        place=differences.position_of(difference),
    )
