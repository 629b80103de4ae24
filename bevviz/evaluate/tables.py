"""Tables of an evaluation, for a terminal and for a page."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING

from bevviz.evaluate.average_precision import OVERLAPS, RECALL_POINTS, VIEWS
from bevviz.evaluate.metrics import base_of, ranges
from bevviz.evaluate.tracking_score import HINT
from bevviz.support import table
from bevviz.support.text import printable

if TYPE_CHECKING:
    from bevviz.evaluate.evaluation import Evaluation

WORST = 10  # number of frames in the table
EXAMPLES = 3  # number of objects shown for each frame

Row = tuple[str, ...]


def text(evaluation: Evaluation) -> str:
    """Return the tables for the terminal."""
    return "\n".join(map(printable, _lines(evaluation, table.lines)))


def page(evaluation: Evaluation) -> str:
    """Return the tables in Markdown."""
    return "\n".join(_lines(evaluation, lambda rows: [table.markdown(rows)], "- "))


def _lines(
    evaluation: Evaluation, laid_out: Callable[[list[Row]], Iterable[str]], bullet: str = "  "
) -> Iterator[str]:
    totals = evaluation.counts()
    without = f", {evaluation.without} without truth left out" if evaluation.without else ""
    labels = totals["true"] + totals["missed"]
    yield f"{len(evaluation.judged)} frames{without}; {labels} objects had to be found"
    if evaluation.unusable:
        count = "1 label is" if len(evaluation.unusable) == 1 else f"{len(evaluation.unusable)} labels are"
        yield f"{count} left out, the first: {evaluation.unusable[0]}"
    for rows in tables(evaluation):
        yield ""
        yield from laid_out(rows)
    if any(labels <= RECALL_POINTS for labels in evaluation.labels.values()):
        few = f"of {RECALL_POINTS} labels or fewer"
        yield f"({few} an average precision is (labels - 1) / {RECALL_POINTS} at best, by KITTI's rule)"
    if "hota" in evaluation.metrics and "mota" not in evaluation.metrics:
        yield f"({HINT})"
    worst = evaluation.worst
    yield ""
    if not worst:
        yield "nothing missed, nothing false"
        return
    yield f"{len(worst)} of {len(evaluation.judged)} frames have something missed or false; the worst:"
    for frame in worst[:WORST]:
        wrong = [f"{kind} {what}" for kind in ("missed", "false") for what in frame[kind]]
        more = "; ..." if wrong[EXAMPLES:] else ""
        counts = ", ".join(f"{len(frame[k])} {k}" for k in ("missed", "false") if frame[k])
        yield f"{bullet}frame {frame['frame']}: {counts} ({'; '.join(wrong[:EXAMPLES])}{more})"


def tables(evaluation: Evaluation) -> Iterator[list[Row]]:
    """Yield the rows of each table, headings first. Tables without metrics are left out."""
    heads: Row = ("objects", "there", "found", "missed", "false", "precision", "recall", "error m", "90 % m")
    yield [
        heads,
        *(_row(evaluation, name or "all", f".{name}" if name else "") for name in (*evaluation.classes, "")),
    ]
    by_range = (_row(evaluation, f"{low} to {high} m", f"@{low}-{high}")[:7] for low, high in ranges())
    yield [("range", *heads[1:7]), *by_range]
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
    counts = evaluation.counts(cls, float(low or 0), float(high or "inf"))
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
