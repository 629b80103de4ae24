"""Line plots, laid out for the SVG in a page's template."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

Series = Sequence[tuple[float, float]]  # (x, y) pairs

WIDTH, HEIGHT = 560, 190
LEFT, RIGHT, TOP, BOTTOM = 52, 18, 10, 24  # margins around the lines, pixels


@dataclass(frozen=True, slots=True)
class Tick:
    """A tick of an axis, at a pixel."""

    at: float
    label: str


@dataclass(frozen=True, slots=True)
class Line:
    """A line in pixels, with the name of its series."""

    name: str
    points: Sequence[tuple[float, float]]


@dataclass(frozen=True, slots=True)
class Plot:
    """A plot. All lengths are in pixels from the top left corner."""

    title: str
    lines: Sequence[Line]
    x_ticks: Sequence[Tick]
    y_ticks: Sequence[Tick]
    mark: float  # column of the marked time
    width: int = WIDTH
    height: int = HEIGHT
    left: int = LEFT  # edge of the area of the lines
    right: int = WIDTH - RIGHT
    top: int = TOP
    bottom: int = HEIGHT - BOTTOM


def plot(title: str, series: Mapping[str, Series], at: float) -> Plot | None:
    """Lay out one line per series over seconds, with a mark at the time ``at``. None: there is no data."""
    nonempty = {name: points for name, points in series.items() if points}
    if not nonempty:
        return None
    x, y = np.array([point for points in nonempty.values() for point in points], np.float64).T
    bottom, top = min(y.min(), 0.0), max(y.max(), 0.0)
    x_ticks, y_ticks = ticks(x.min(), x.max(), 6), ticks(bottom, top if top > bottom else 1.0, 4)
    left, right = min(x.min(), at), max(x.max(), at, x.min() + 1e-9)
    low, high = y_ticks[0], y_ticks[-1]

    def column(value: float) -> float:
        return round(float(LEFT + (value - left) / (right - left) * (WIDTH - LEFT - RIGHT)), 1)

    def row(value: float) -> float:
        return round(float(HEIGHT - BOTTOM - (value - low) / (high - low) * (HEIGHT - TOP - BOTTOM)), 1)

    return Plot(
        title=title,
        lines=[
            Line(name, [(column(seconds), row(number)) for seconds, number in points])
            for name, points in nonempty.items()
        ],
        x_ticks=[Tick(column(tick), f"{tick:g} s") for tick in x_ticks if left <= tick <= right],
        y_ticks=[Tick(row(tick), f"{tick:g}") for tick in y_ticks],
        mark=column(at),
    )


def ticks(low: float, high: float, count: int) -> list[float]:
    """Return about ``count`` round numbers that enclose ``low`` to ``high``, at least two.

    >>> ticks(0, 9.3, 4)
    [0.0, 2.5, 5.0, 7.5, 10.0]
    """
    span = max(float(high - low), abs(float(high)) * 1e-9, 1e-9)
    power = 10.0 ** np.floor(np.log10(span / count))
    step = float(
        power * next(factor for factor in (1, 2, 2.5, 5, 10, 20) if factor * power * count >= span * 0.999)
    )
    first, last = int(np.floor(low / step + 1e-9)), int(np.ceil(high / step - 1e-9))
    return [round(n * step, 12) for n in range(first, max(last, first + 1) + 1)]
