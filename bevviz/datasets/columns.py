"""Estimates of the layout of raw numbers from their values."""

from __future__ import annotations

import numpy as np

from bevviz.model.frame import F32, F64, I64

MAX_COLUMNS = 12
BINS = 64
MIN_VALUES = 1000  # values; fewer give no estimate
MIN_INFORMATION = 0.1  # nats; below it no number of columns stands out
CLOSE_TO_BEST = 0.7  # share of the best information: a multiple of the right number has slightly more
NEARLY_ZERO = 1e-30  # Integers below some hundred millions are smaller if read as float32.
MAX_ODD_SHARE = 0.1  # share of physically impossible values above which the numbers have another type


def count_columns(values: F32) -> int | None:
    """Estimate the number of columns of a flattened point table; None if the values give no estimate.

    With the right number, each column has its own distribution (heights are not distances). With another
    number, they are mixed. The score is the mutual information of column and value, minus its bias (Miller
    1955). The order of the points does not matter.

    Args:
        values: (N,) float32 values, row after row.
    """
    finite = values[np.isfinite(values)]
    if len(finite) < MIN_VALUES:
        return None
    edges = np.unique(np.quantile(finite, np.linspace(0, 1, BINS + 1)[1:-1]))
    bins = np.searchsorted(edges, values, side="right")  # NaN is in the last bin.
    information = np.array(
        [_information(bins, columns, len(edges) + 1) for columns in range(3, MAX_COLUMNS + 1)]
    )
    if information.max() < MIN_INFORMATION:
        return None
    return 3 + int(np.argmax(information >= CLOSE_TO_BEST * information.max()))


def are_doubles(data: bytes) -> bool:
    """Tell whether numbers are float64: as float32, many would be too large or too small for a sensor."""
    whole = data[: len(data) // 8 * 8]
    return (
        _odd_share(np.frombuffer(whole, "<f4")) > MAX_ODD_SHARE > 10 * _odd_share(np.frombuffer(whole, "<f8"))
    )


def are_whole(data: bytes) -> bool:
    """Tell whether numbers are integers such as labels: read as float32, they would be almost zero."""
    size = np.abs(np.frombuffer(data[: len(data) // 4 * 4], "<f4"))
    nonzero = size > 0
    return bool(nonzero.any()) and float(np.mean(size[nonzero] < NEARLY_ZERO)) > 0.5


def _odd_share(values: F32 | F64) -> float:
    size = np.abs(values[np.isfinite(values)])
    return float(np.mean((size > 1e10) | ((size < 1e-10) & (size > 0)))) if len(size) else 0.0


def _information(bins: I64, columns: int, count: int) -> float:
    """Return the mutual information in nats of the column and the bin of a value."""
    rows = len(bins) // columns
    cells = bins[: rows * columns].reshape(rows, columns) + np.arange(columns) * count
    joint = np.bincount(cells.ravel(), minlength=columns * count).reshape(columns, count) / cells.size
    independent = joint.sum(axis=1, keepdims=True) * joint.sum(axis=0, keepdims=True)
    nonzero = joint > 0
    information = float((joint[nonzero] * np.log(joint[nonzero] / independent[nonzero])).sum())
    return information - (columns - 1) * (count - 1) / (2 * cells.size)
