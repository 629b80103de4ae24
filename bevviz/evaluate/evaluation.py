"""Metrics of a drive, and their tables: objects by class and range, average precision, tracks, ground."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from bevviz.errors import printable
from bevviz.evaluate.average_precision import OVERLAPS, RECALL_POINTS, VIEWS, AveragePrecision, scored_objects
from bevviz.evaluate.ground_truth import MAX_DISTANCE, Truth, TruthLookup
from bevviz.evaluate.matching import Matches, ObjectScore, position_text, rates, share
from bevviz.evaluate.metrics import LimitResult, base_of, ranges
from bevviz.evaluate.tracking_score import TrackScore
from bevviz.model.frame import Frame
from bevviz.model.protocols import Observer
from bevviz.model.reasons import Reason
from bevviz.model.results import FrameResult, Objects
from bevviz.model.tables import Columns, Tabular
from bevviz.stages.voxel import spread_to_points
from bevviz.support import table
from bevviz.support.json_form import json_form

UNUSABLE = 10  # number of unusable labels in the JSON
WORST = 10  # number of frames in the table
EXAMPLES = 3  # number of objects shown for each of them
# Numbers of SemanticKITTI's classes (Behley et al. 2019), stored in the field ``label`` of a cloud.
GROUND_LABELS = (40, 44, 48, 49, 60, 72)  # road, parking, pavement, other ground, marking, terrain
OBJECT_LABELS = (10, 11, 13, 15, 16, 18, 20, 30, 31, 32, 99, *range(252, 260))
UNLABELLED = (0, 1)

Row = tuple[str, ...]
CauseLookup: TypeAlias = "Callable[[FrameResult, Truth, Matches], Mapping[int, Reason]]"


@dataclass(frozen=True, slots=True)
class FrameOutcome:
    """Objects of a frame in words."""

    frame: int
    """number of the scan"""
    stamp: int
    """nanoseconds since 1970"""
    true: Sequence[str]
    missed: Sequence[str]
    false: Sequence[str]


@json_form
@dataclass(frozen=True, slots=True)
class EvaluationResult:
    """Metrics against ground truth, and the gate."""

    frames: int
    """judged frames"""
    frames_without_truth: int
    unusable_labels: int
    """labels that are left out"""
    unusable_examples: Sequence[str]
    """the first ten, with the reason"""
    metrics: Mapping[str, float | None]
    """metrics of docs/reference.md by name; null: not measured"""
    false_causes: Mapping[str, int]
    """false objects by cause"""
    worst: Sequence[FrameOutcome]
    """frames with missed or false objects, the worst first"""
    limits: Sequence[LimitResult]


class Evaluation(Observer[FrameResult], Tabular):
    """Observer that compares every frame of a run with the ground truth.

    Args:
        truth: returns the ground truth of a frame. None: it is not known.
        causes: returns the causes of the false objects of a frame by row. None: they are not asked for.

    Attributes:
        score: every true, missed and false object.
        last: result, ground truth and matches of the last frame.
        causes: causes of its false objects, by row.
        judged: objects of each frame as text.
        false_causes: number of false objects by cause. Empty: the causes were not asked for.

    Example:
        >>> evaluation = drive.evaluate()
        >>> evaluation.metrics["recall.person"]
    """

    def __init__(self, truth: TruthLookup, causes: CauseLookup | None = None) -> None:
        self._truth, self._causes = truth, causes
        self.causes: Mapping[int, Reason] = {}
        self.judged: list[FrameOutcome] = []
        self.false_causes: Counter[str] = Counter()  # number of false objects by cause
        self.without = 0  # frames without ground truth
        self.unusable: list[str] = []  # one sentence for each label that cannot be used
        self.last: tuple[FrameResult, Truth, Matches] | None = None
        self.score = ObjectScore()
        self._precision = AveragePrecision()
        self._tracks = TrackScore()
        self._detections = ObjectScore(self.score.accepted)
        self._ground: Counter[str] = Counter()
        # Missed labels by label and name of the object there.
        self._misnamed: Counter[tuple[str, str]] = Counter()
        self._metrics: dict[str, float] | None = None

    def observe(self, result: FrameResult) -> None:
        """Compare a frame with its ground truth."""
        truth = self._truth(result.frame)
        self._metrics, self.last = None, None
        if truth is None:
            self.without += 1
            return
        self.unusable += [f"frame {result.frame.index}: {reason}" for reason in truth.unusable]
        objects = result.objects or Objects.empty()
        matches = self.score.add(objects, truth, result.cameras)
        self.last = result, truth, matches
        self._misnamed.update(_misnamed(objects, truth, matches))
        self.causes = {} if self._causes is None else self._causes(result, truth, matches)
        self.false_causes.update(cause.kind.value for cause in self.causes.values())
        self.judged.append(_outcome(result.frame, objects, truth, matches, self.causes))
        if result.objects is not None:
            self._precision.add(scored_objects(result, truth), truth)
        self._tracks.add(result, truth, self.score.accepted)
        for camera in result.cameras:
            self._detections.add_detections(camera, truth)
        count_ground(self._ground, result)

    # --- numbers -------------------------------------------------------------------------------

    @property
    def metrics(self) -> Mapping[str, float]:
        """Every metric that could be measured, by its name ``METRIC[.CLASS][@RANGE]``."""
        if self._metrics is None:
            self._metrics = dict(self._all_metrics())
        return self._metrics

    def _all_metrics(self) -> Iterator[tuple[str, float]]:
        frames = max(len(self.judged), 1)
        for cls in ("", *self.classes):
            counts = self.score.counts(cls)
            if not counts.total():
                continue
            tail = f".{cls}" if cls else ""
            yield from _rates(counts, tail)
            if errors := self.score.errors(cls):
                yield f"error_m{tail}", float(np.median(errors))
                yield f"error_90_m{tail}", float(np.quantile(errors, 0.9))
            for low, high in ranges():
                range_counts = self.score.counts(cls, low, high)
                if range_counts.total():
                    yield from _rates(range_counts, f"{tail}@{low}-{high}")
        total = self.score.total
        yield "missed_per_frame", total["missed"] / frames
        yield "false_per_frame", total["false"] / frames
        for (view, overlap, cls, difficulty), value in self._precision.results().items():
            yield f"ap_{view}_{overlap}.{cls}" + (f".{difficulty}" if difficulty else ""), value
        for cls, values in self._tracks.results().items():
            for name, value in values.items():
                yield (f"{name}.{cls}" if cls else name), value
        if (total := self._detections.total).total():
            for cls, counts in sorted({"": total, **self._detections.classes}.items()):
                tail, shares = f".{cls}" if cls else "", rates(counts)
                yield f"detection_recall{tail}", shares["recall"]
                yield f"detection_precision{tail}", shares["precision"]
        if ground := self._ground:
            shares = rates(ground)
            yield "ground_precision", shares["precision"]
            yield "ground_recall", shares["recall"]
            yield "ground_iou", share(ground["true"], ground["false"] + ground["missed"])
            yield "object_points_kept", share(ground["kept"], ground["lost"])

    @property
    def classes(self) -> list[str]:
        """Classes of the labels and of the judged false objects."""
        return sorted(self.score.classes)

    @property
    def labels(self) -> Mapping[str, int]:
        """Number of labels for the average precision, by ``CLASS`` or ``CLASS.DIFFICULTY``."""
        labels = self._precision.labels
        return {f"{c}.{d}" if d else c: number for (c, d), number in labels.items()}

    @property
    def now(self) -> FrameOutcome:
        """Objects of the last frame, as text."""
        return self.judged[-1]

    @property
    def worst(self) -> list[FrameOutcome]:
        """Frames with missed or false objects, those with most of them first."""
        wrong = [frame for frame in self.judged if frame.missed or frame.false]
        return sorted(wrong, key=lambda f: (-len(f.missed) - len(f.false), f.frame))

    @property
    def warnings(self) -> list[str]:
        """A sentence for each label of which none was found, but mostly objects of one other name."""
        sentences = []
        for (label, name), number in self._misnamed.items():
            counts = self.score.counts(label.lower())
            if not counts["true"] and 2 * number > counts["missed"]:
                instead = (
                    f"{number} of {counts['missed']} have an object named '{name}' within {MAX_DISTANCE:g} m"
                )
                rule = f"--set 'source.labels={json.dumps({label: [name]})}'"
                sentences.append(f"no '{label}' was found, but {instead}: if that is the same, {rule}")
        return sentences

    # --- how it is shown -----------------------------------------------------------------------

    def table(self) -> str:
        """Return the evaluation for the terminal."""
        return "\n".join(map(printable, _lines(self, table.lines)))

    def result(self, limits: Sequence[LimitResult] = ()) -> EvaluationResult:
        """Return every metric, the frames with errors and the outcome of the limits."""
        return EvaluationResult(
            frames=len(self.judged),
            frames_without_truth=self.without,
            unusable_labels=len(self.unusable),
            unusable_examples=self.unusable[:UNUSABLE],
            metrics={
                name: None if math.isnan(value) else round(value, 6) for name, value in self.metrics.items()
            },
            false_causes=dict(self.false_causes.most_common()),
            worst=self.worst,
            limits=limits,
        )

    def _columns(self) -> Columns:
        """Return a row for each metric: name, class, range and value."""
        rows = []
        for name, value in self.metrics.items():
            base = base_of(name) or name
            cls, _, range_name = name.removeprefix(base).removeprefix(".").partition("@")
            rows.append({"metric": base, "class": cls, "range": range_name, "value": value})
        return rows


def _rates(counts: Counter[str], tail: str) -> Iterator[tuple[str, float]]:
    yield from ((f"{name}{tail}", value) for name, value in rates(counts).items())
    yield f"missed{tail}", float(counts["missed"])
    yield f"false{tail}", float(counts["false"])


def count_ground(counts: Counter[str], result: FrameResult) -> None:
    """Count the points of a frame by label and by ground mask. The cloud needs a field ``label``."""
    labels = result.frame.fields.get("label")
    if labels is None or labels.dtype.kind not in "ui" or result.ground is None or result.voxels is None:
        return
    kind = labels.astype(np.int64) & 0xFFFF
    known = ~np.isin(kind, UNLABELLED)
    is_ground = spread_to_points(result.ground.mask, result.voxels.inverse)
    ground_points, object_points = np.isin(kind, GROUND_LABELS), np.isin(kind, OBJECT_LABELS)
    counts["true"] += int((is_ground & ground_points).sum())
    counts["false"] += int((is_ground & ~ground_points & known).sum())
    counts["missed"] += int((~is_ground & ground_points).sum())
    counts["kept"] += int((~is_ground & object_points).sum())
    counts["lost"] += int((is_ground & object_points).sum())


def _misnamed(objects: Objects, truth: Truth, matches: Matches) -> Iterator[tuple[str, str]]:
    """Yield each missed label with the name of the nearest object there that no label accepts."""
    free = np.flatnonzero(matches.partner < 0)
    for row in np.flatnonzero(matches.missed).tolist() if len(free) else ():
        offset = objects.boxes.center[free, :2] - truth.boxes.center[row, :2]
        distance = np.linalg.norm(offset, axis=1)
        if distance.min() <= MAX_DISTANCE:
            yield truth.labels[row], objects.names[free[distance.argmin()]].lower()


# --- words -------------------------------------------------------------------------------------


def _outcome(
    frame: Frame, objects: Objects, truth: Truth, matches: Matches, causes: Mapping[int, Reason]
) -> FrameOutcome:
    """Return the objects of a frame as text, as ``person at 12.3 m, 4° left``."""

    def label_text(k: int) -> str:
        return f"{truth.labels[k].lower()} {position_text(truth.boxes, k)}"

    def false_text(j: int) -> str:
        text = f"{objects.names[j].lower()} {position_text(objects.boxes, j)}"
        return f"{text}: {causes[j].kind.value}" if j in causes else text

    return FrameOutcome(
        frame.index,
        frame.stamp,
        tuple(label_text(int(matches.partner[j])) for j in np.flatnonzero(matches.true)),
        tuple(map(label_text, np.flatnonzero(matches.missed).tolist())),
        tuple(map(false_text, np.flatnonzero(matches.false).tolist())),
    )


# --- tables ------------------------------------------------------------------------------------


def page(evaluation: Evaluation) -> str:
    """Return the tables in Markdown."""
    return "\n".join(_lines(evaluation, lambda rows: [table.markdown(rows)], "- "))


def _lines(
    evaluation: Evaluation, laid_out: Callable[[list[Row]], Iterable[str]], bullet: str = "  "
) -> Iterator[str]:
    totals = evaluation.score.total
    without = f", {evaluation.without} without truth left out" if evaluation.without else ""
    labels = totals["true"] + totals["missed"]
    yield f"{len(evaluation.judged)} frames{without}; {labels} objects had to be found"
    if evaluation.unusable:
        count = "1 label is" if len(evaluation.unusable) == 1 else f"{len(evaluation.unusable)} labels are"
        yield f"{count} left out, the first: {evaluation.unusable[0]}"
    yield from evaluation.warnings
    for rows in tables(evaluation):
        yield ""
        yield from laid_out(rows)
    if any(labels <= RECALL_POINTS for labels in evaluation.labels.values()):
        few = f"of {RECALL_POINTS} labels or fewer"
        yield f"({few} an average precision is (labels - 1) / {RECALL_POINTS} at best, by KITTI's rule)"
    worst = evaluation.worst
    yield ""
    if not worst:
        yield "nothing missed, nothing false"
        return
    yield f"{len(worst)} of {len(evaluation.judged)} frames have something missed or false; the worst:"
    for frame in worst[:WORST]:
        outcomes = {"missed": frame.missed, "false": frame.false}
        wrong = [f"{kind} {text}" for kind, texts in outcomes.items() for text in texts]
        more = "; ..." if wrong[EXAMPLES:] else ""
        counts = ", ".join(f"{len(texts)} {kind}" for kind, texts in outcomes.items() if texts)
        yield f"{bullet}frame {frame.frame}: {counts} ({'; '.join(wrong[:EXAMPLES])}{more})"


def tables(evaluation: Evaluation) -> Iterator[list[Row]]:
    """Yield the rows of each table, headings first. Tables without metrics are left out."""
    heads: Row = ("objects", "there", "found", "missed", "false", "precision", "recall", "error m", "90 % m")
    yield [
        heads,
        *(_row(evaluation, name or "all", f".{name}" if name else "") for name in (*evaluation.classes, "")),
    ]
    by_range = (_row(evaluation, f"{low} to {high} m", f"@{low}-{high}")[:7] for low, high in ranges())
    yield [("range", *heads[1:7]), *by_range]
    if causes := evaluation.false_causes:
        yield [("false objects", "number"), *((cause, str(count)) for cause, count in causes.most_common())]
    metrics = evaluation.metrics
    if labels := evaluation.labels:
        columns = [f"ap_{view}_{overlap}" for view in VIEWS for overlap in OVERLAPS]
        rows = [
            (n.replace(".", ", "), str(labels[n]), *(_number(metrics, f"{c}.{n}") for c in columns))
            for n in sorted(labels, key=_by_difficulty)
        ]
        yield [("average precision", "labels", *(f"{v.upper()} {o}" for v in VIEWS for o in OVERLAPS)), *rows]
    tracked = ("hota", "deta", "assa", "mota", "motp_m", "idf1", "id_switches")
    if "hota" in metrics:
        heads = ("tracks", "HOTA", "DetA", "AssA", "MOTA", "MOTP m", "IDF1", "id switches")
        yield [heads, *_by_class(metrics, tracked)]
    detected = ("detection_precision", "detection_recall")
    if "detection_recall" in metrics:
        yield [("image boxes, IoU 0.5", "precision", "recall"), *_by_class(metrics, detected)]
    if "ground_iou" in metrics:
        ground = ("ground_precision", "ground_recall", "ground_iou", "object_points_kept")
        heads = ("points", "precision", "recall", "IoU", "object points kept")
        yield [heads, ("ground", *(_number(metrics, name) for name in ground))]


def _row(evaluation: Evaluation, title: str, tail: str) -> Row:
    cls, _, range_name = tail.removeprefix(".").partition("@")
    low, _, high = range_name.partition("-")
    counts = evaluation.score.counts(cls, float(low or 0), float(high or "inf"))
    numbers = (counts["true"] + counts["missed"], counts["true"], counts["missed"], counts["false"])
    rates = (
        _number(evaluation.metrics, f"{n}{tail}") for n in ("precision", "recall", "error_m", "error_90_m")
    )
    return (title, *map(str, numbers), *rates)


def _by_class(metrics: Mapping[str, float], names: tuple[str, ...]) -> Iterator[Row]:
    """Yield a row for each class that has the first metric. The row of all classes comes last."""
    classes = [name.partition(".")[2] for name in metrics if name.partition(".")[0] == names[0]]
    for cls in sorted(classes, key=lambda cls: (not cls, cls)):
        yield (cls or "all", *(_number(metrics, f"{name}.{cls}" if cls else name) for name in names))


def _by_difficulty(name: str) -> tuple[str, int]:
    order = ("easy", "moderate", "hard")
    cls, _, difficulty = name.partition(".")
    return cls, order.index(difficulty) if difficulty in order else -1


def _number(metrics: Mapping[str, float], name: str) -> str:
    value = metrics.get(name, math.nan)
    if math.isnan(value):
        return "-"
    base = base_of(name)
    digits = 0 if base in ("id_switches", "fragmentations") else 2 if (base or "").endswith("_m") else 3
    return f"{value:.{digits}f}"
