"""What raw numbers are, by the numbers alone."""

from __future__ import annotations

import numpy as np

from bevviz.model.frame import F32, F64, I64

MOST = 12
BINS = 64
ENOUGH = 1000  # values; fewer tell nothing
TELLING = 0.1  # nats, below which no number of columns stands out
NEAR = 0.7  # of the best: a multiple of the right number tells a little more
NOTHING = 1e-30  # as float32: a whole number below some hundred millions is less
ODD = 0.1  # share of values that no sensor measures, from which on numbers are of another type


def count_columns(values: F32) -> int | None:
    """Columns of a table of points that is given as one row of numbers; None: they do not tell.

    In the right number of columns each has a distribution of its own (heights are not distances), in another
    they are mixed. What counts is the mutual information of column and value, less what chance gives
    (Miller 1955); the order of the points does not matter.

    Args:
        values: (N,) of float32, row after row.
    """
    finite = values[np.isfinite(values)]
    if len(finite) < ENOUGH:
        return None
    edges = np.unique(np.quantile(finite, np.linspace(0, 1, BINS + 1)[1:-1]))
    bins = np.searchsorted(edges, values, side="right")  # NaN is in the last one
    told = np.array([_information(bins, columns, len(edges) + 1) for columns in range(3, MOST + 1)])
    if told.max() < TELLING:
        return None
    return 3 + int(np.argmax(told >= NEAR * told.max()))


def are_doubles(data: bytes) -> bool:
    """Whether numbers are float64: as float32 many would be too large or too small to be measured."""
    whole = data[: len(data) // 8 * 8]
    return _odd(np.frombuffer(whole, "<f4")) > ODD > 10 * _odd(np.frombuffer(whole, "<f8"))


def are_whole(data: bytes) -> bool:
    """Whether numbers are whole ones, such as labels: as float32 they would be next to nothing."""
    size = np.abs(np.frombuffer(data[: len(data) // 4 * 4], "<f4"))
    there = size > 0
    return bool(there.any()) and float(np.mean(size[there] < NOTHING)) > 0.5


def _odd(values: F32 | F64) -> float:
    size = np.abs(values[np.isfinite(values)])
    return float(np.mean((size > 1e10) | ((size < 1e-10) & (size > 0)))) if len(size) else 0.0


def _information(bins: I64, columns: int, count: int) -> float:
    """Nats that the column of a value tells of its bin."""
    rows = len(bins) // columns
    cells = bins[: rows * columns].reshape(rows, columns) + np.arange(columns) * count
    joint = np.bincount(cells.ravel(), minlength=columns * count).reshape(columns, count) / cells.size
    alone = joint.sum(axis=1, keepdims=True) * joint.sum(axis=0, keepdims=True)
    there = joint > 0
    information = float((joint[there] * np.log(joint[there] / alone[there])).sum())
    return information - (columns - 1) * (count - 1) / (2 * cells.size)
