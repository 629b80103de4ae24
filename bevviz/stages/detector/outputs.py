"""Read boxes and scores from a model's outputs, and check whether the numbers are plausible."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from bevviz.model.frame import F32, I32, I64
from bevviz.stages.detector.names import MAX_CLASSES

SCORE_TOLERANCE = 0.01  # tolerance above 1 of scores in half precision or after quantisation
MIN_SCORE = -1e-3  # the same below 0
MAX_FRACTION_BOX = 2.0  # boxes that all lie within this many pixels are not in pixels
CONFIDENT = 0.25  # least score of a candidate whose box must be one
UNTRAINED = 0.05  # largest spread of class scores that were not trained
BYTE, FEW_STEPS = 256, 8  # values of a quantised number, and values that tell nothing
MAX_MEDIAN_SCORE = 0.2  # for an image without objects, no class has a higher median score over all positions


class BoxFormat(Enum):
    """Format of the four numbers of a box."""

    CENTRE = "centre and size in pixels of the input"
    CORNERS = "corners in pixels of the input"
    FRACTIONS = "centre and size as fractions of the input"
    CELLS = "centre relative to the grid cell, logarithm of the size, both in strides"


class ScoredBoxes(NamedTuple):
    """Boxes with a score of each class."""

    boxes: Any  # (N, 4)
    scores: Any  # (N, classes)
    objectness: Any = None  # (N,) factor of the scores


class ListedBoxes(NamedTuple):
    """Boxes with one class each. Padding rows have a score of 0 or less."""

    boxes: Any  # (N, 4)
    score: Any  # (N,)
    class_id: Any  # (N,)


class Candidates(NamedTuple):
    """Candidates of a network in pixels of its input. They may extend beyond its border."""

    xyxy: F32  # (N, 4)
    score: F32  # (N,)
    class_id: I32  # (N,)
    row: I64  # (N,) row in the network's table


# --- selecting columns -------------------------------------------------------------------------
# Each function takes the number of classes and the outputs for one image.


def columns(classes: int | None, table: Any) -> ScoredBoxes:
    """Split a table with one column for each candidate."""
    return ScoredBoxes(table[:4].T, table[4:].T[:, :classes])


def rows(classes: int | None, table: Any) -> ScoredBoxes:
    """Split a table with one row for each candidate."""
    return ScoredBoxes(table[:, :4], table[:, 4:][:, :classes])


def rows_with_objectness(classes: int | None, table: Any) -> ScoredBoxes:
    """Split a table with box, objectness and class scores in each row."""
    return ScoredBoxes(table[:, :4], table[:, 5:][:, :classes], table[:, 4])


def two_tables(classes: int | None, boxes: Any, scores: Any) -> ScoredBoxes:
    """Split a table of boxes and a table of class scores."""
    return ScoredBoxes(boxes, scores[:, :classes])


def three_lists(_: int | None, boxes: Any, score: Any, class_id: Any) -> ListedBoxes:
    """Combine lists of boxes, scores and classes."""
    return ListedBoxes(boxes, score, class_id)


def one_list(box: int, score: int, class_id: int) -> Callable[[int | None, Any], ListedBoxes]:
    """Return a function that reads a list with these columns. ``box`` is the first of four columns."""
    return lambda _, table: ListedBoxes(table[:, box : box + 4], table[:, score], table[:, class_id])


def queries(classes: int | None, boxes: Any, logits: Any) -> ListedBoxes:
    """Return the best pairs of query and class, as many as there are queries (RF-DETR's ``PostProcess``)."""
    score = 1 / (1 + np.exp(-logits[:, :classes].astype(np.float32)))
    best = np.argsort(-score, axis=None, kind="stable")[: len(boxes)]
    query, class_id = np.divmod(best, score.shape[1])
    return ListedBoxes(boxes[query], score[query, class_id], class_id)


# --- decoding ----------------------------------------------------------------------------------


def cells(size: tuple[int, int]) -> dict[int, tuple[int, ...]]:
    """Return number of grid cells -> strides, for every run of adjacent strides that divide the input."""
    height, width = size
    whole = [s for s in (4, 8, 16, 32, 64) if height % s == 0 and width % s == 0]
    runs = [tuple(whole[i:j]) for i in range(len(whole)) for j in range(i + 1, len(whole) + 1)]
    return {sum((height // s) * (width // s) for s in run): run for run in runs}


def candidates(
    split: ScoredBoxes | ListedBoxes, boxes: BoxFormat, size: tuple[int, int], least: float
) -> Candidates:
    """Return all candidates with a score of ``least`` or more, for an input of this height and width."""
    if isinstance(split, ListedBoxes):
        row = np.flatnonzero(split.score >= least)
        score, class_id = split.score[row], split.class_id[row]
    else:
        row, score, class_id = _best_classes(split, least)
    xyxy = _corners(boxes, split.boxes[row], row, len(split.boxes), size)
    return Candidates(xyxy, score.astype(np.float32), class_id.astype(np.int32), row)


def _best_classes(split: ScoredBoxes, least: float) -> tuple[Any, Any, Any]:
    """Return the rows whose best class has at least that score, with the score and the class."""
    if split.objectness is None:
        row = np.flatnonzero(split.scores.max(axis=1) >= least)
        scores = split.scores[row]
    else:  # the product with a class score is never higher than the objectness
        row = np.flatnonzero(split.objectness >= least)
        scores = split.scores[row] * split.objectness[row, None]
    class_id = scores.argmax(axis=1)
    score = np.take_along_axis(scores, class_id[:, None], axis=1)[:, 0]
    strong = score >= least
    return row[strong], score[strong], class_id[strong]


def _corners(kind: BoxFormat, boxes: Any, row: Any, count: int, size: tuple[int, int]) -> F32:
    """Convert boxes to corners in pixels. Half precision is added in half precision, as the exporters do."""
    xyxy: F32
    if kind is BoxFormat.CORNERS:
        xyxy = boxes.astype(np.float32)
        return xyxy
    center, extent = boxes[:, :2], boxes[:, 2:]
    if kind is BoxFormat.CELLS:
        cell, stride = _grid(size, cells(size)[count])
        center, extent = (center + cell[row]) * stride[row], np.exp(extent) * stride[row]
    half = extent / 2
    xyxy = np.hstack([center - half, center + half]).astype(np.float32)
    if kind is BoxFormat.FRACTIONS:
        xyxy *= np.array(size[::-1] * 2, np.float32)
    return xyxy


def _grid(size: tuple[int, int], strides: tuple[int, ...]) -> tuple[F32, F32]:
    """Return (N, 2) column and row and (N, 1) stride of each cell, in the order of YOLOX's output."""
    cell, stride = [], []
    for s in strides:
        at = np.indices((size[0] // s, size[1] // s), np.float32)[::-1].reshape(2, -1).T
        cell.append(at)
        stride.append(np.full((len(at), 1), s, np.float32))
    return np.concatenate(cell), np.concatenate(stride)


# --- plausibility ------------------------------------------------------------------------------


def wrong_list(score: Any, class_id: Any, names: tuple[str, ...]) -> str:
    """Return why these numbers cannot be scores and classes, empty if they can."""
    if score.size and score.max() > 1 + SCORE_TOLERANCE:
        return f"it has scores up to {score.max():.3g}"
    if class_id.size and class_id.max() > MAX_CLASSES:
        return f"it has class {class_id.max():.3g}, and no more than {MAX_CLASSES:,} are read"
    odd = class_id[(class_id != np.rint(class_id)) | (class_id < 0)]
    if odd.size:
        return f"it has classes such as {odd[0]:.3g}"
    if names and class_id.size and class_id.max() >= len(names):
        return f"it has class {class_id.max():.0f}, but {len(names)} class names"
    return ""


def wrong_candidates(boxes: Any, score: Any, kind: BoxFormat, trusted: bool) -> str:
    """Return why the candidates of an image cannot be boxes, empty if they can.

    Args:
        boxes: (N, 4) numbers of the boxes, as the network gives them.
        score: (N,) their scores.
        kind: how the numbers are read.
        trusted: whether the file tells that the boxes are corners.
    """
    strong = boxes[score >= CONFIDENT]
    strong = strong[np.isfinite(strong).all(axis=1)]
    if not len(strong) or kind in (BoxFormat.FRACTIONS, BoxFormat.CELLS):
        return ""
    if np.abs(strong).max() <= MAX_FRACTION_BOX:
        return f"its boxes are not in pixels, but numbers up to {np.abs(strong).max():.3g}"
    inverted = strong[(strong[:, 2:] < strong[:, :2] - 1).any(axis=1)]
    if kind is BoxFormat.CORNERS and len(inverted) and not trusted:
        x0, y0, x1, y1 = inverted[0].tolist()
        return (
            f"its boxes are not corners, but perhaps centre and size: the second corner ({x1:.0f}, {y1:.0f}) "
            f"lies to the left of the first ({x0:.0f}, {y0:.0f}), or above"
        )
    return ""


def swapped_columns(score: Any, class_id: Any) -> str:
    """Return why a list has score and class in each other's column, empty if it has not."""
    odd = (score == 0) & (class_id > 0) & (class_id < 1)
    if odd.any():
        return f"it has a score of 0 beside class {class_id[odd][0]:.3g}: score and class are exchanged"
    return ""


def coarse_scores(split: ScoredBoxes) -> str:
    """Return why the scores can only be 0, because boxes and scores share one quantisation; else empty."""
    steps = np.unique(split.boxes)
    if split.scores.any() or not FEW_STEPS < len(steps) <= BYTE < len(split.boxes):
        return ""
    counts = np.arange(1, BYTE)
    shares = steps[:, None] / (np.abs(steps).max() / counts)
    fitting = counts[np.abs(shares - np.rint(shares)).max(axis=0) < 0.01]
    step = float(np.abs(steps).max() / fitting[0]) if len(fitting) else 0.0
    if step < 1 or abs(step - round(step)) < 0.01:  # whole pixels are those of a grid
        return ""
    return (
        f"its scores are all 0, because they have steps of {step:.2g} as its boxes have: quantise boxes and "
        "scores apart, or leave the last layers as floats"
    )


def has_unused_class(split: ScoredBoxes) -> bool:
    """Return whether the score of the only class says nothing, so that the objectness is the score.

    YOLOv7 does not train it where there is one class, and leaves it out of its own NMS.
    """
    scores = split.scores
    return split.objectness is not None and scores.shape[1] == 1 and bool(np.ptp(scores) < UNTRAINED)


def wrong_scores(split: ScoredBoxes, counted: bool) -> str:
    """Return why these numbers cannot be scores for an image without objects, empty if they can.

    ``counted``: whether another source confirms the number of classes.
    """
    tables = [split.scores] if split.objectness is None else [split.scores, split.objectness]
    if not all(table.size for table in tables):
        return "it has no boxes, or no scores"
    low, high = np.min([t.min() for t in tables]), np.max([t.max() for t in tables])
    if np.isnan(low):
        return "some of its scores are no numbers (NaN)"
    if low < MIN_SCORE or high > 1 + SCORE_TOLERANCE:
        return f"it has scores from {low:.3g} to {high:.3g}"
    if split.objectness is None and not counted and np.median(split.scores[:, -1]) > MAX_MEDIAN_SCORE:
        return (
            "its last class is everywhere, like angles of oriented boxes; where it is one, set detector.names"
        )
    return ""


def wrong_boxes(boxes: Any, kind: BoxFormat, trusted: bool) -> str:
    """Return why these numbers cannot be boxes, empty if they can."""
    if boxes.size and not np.isfinite(boxes).any():
        return "none of its boxes has numbers that are finite"
    largest = np.abs(boxes).max() if boxes.size else 0.0
    if kind in (BoxFormat.CENTRE, BoxFormat.CORNERS) and 0 < largest <= MAX_FRACTION_BOX:
        return f"its boxes are not in pixels, but numbers up to {largest:.3g}"
    if kind is BoxFormat.FRACTIONS and largest > 10:
        return f"its boxes are not fractions of the image, but numbers up to {largest:.3g}"
    inverted = boxes.size and (boxes[:, 2:] < boxes[:, :2]).any(axis=1).mean() > 0.1
    if kind is BoxFormat.CORNERS and inverted and not trusted:
        return "its boxes are not corners: the second lies to the left of the first, or above"
    return ""
