"""Curves over the values of a parameter, drawn in the plane.

The viewer's own plots are over time alone, and its bars do not say values that are no whole numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from bevviz.colors import SERIES, Color, State
from bevviz.frame import F64

Log = Callable[..., None]  # name below the chart, archetypes

WIDTH, HEIGHT = 640.0, 420.0  # of what is inside the axes
_LEFT, _RIGHT, _TOP, _BOTTOM = 70.0, 190.0, 120.0, 60.0  # beside them
_MARKS = (State.GOOD.value, State.DOUBTFUL.value)
_AXIS, _GRID, _TEXT = (150, 155, 165), (48, 50, 58), (200, 204, 212)
_LINE = 46.0  # between names that would cover one another
_TICKS = 5  # about so many on the upright axis
_LABELS = 9  # so many values at most are written below


def log_chart(
    recording: rr.RecordingStream,
    path: str,
    places: F64,
    values: Sequence[str],
    curves: Mapping[str, F64],
    marks: Mapping[str, int | float],
) -> None:
    """Axes, a curve for each metric with its name where it ends, and marks.

    Args:
        recording: where to; static.
        path: entity of the chart.
        places: (N,) of the values on the axis, rising.
        values: (N,) as they are written.
        curves: metric -> (N,) numbers; NaN where there is none.
        marks: word -> place of an upright line, such as that of the best value; two at most.
    """
    known = np.concatenate([c[np.isfinite(c)] for c in curves.values()])
    low, high, step = scale(float(known.min(initial=0.0)), float(known.max(initial=0.0)))
    span = float(places[-1] - places[0]) or 1.0

    def x(at: F64 | float) -> F64:
        return np.asarray((at - places[0]) / span * WIDTH if len(places) > 1 else WIDTH / 2 + 0 * at)

    def y(at: F64 | float) -> F64:
        return np.asarray(HEIGHT - (at - low) / (high - low) * HEIGHT)

    def log(name: str, *what: rr.AsComponents) -> None:
        recording.log(f"{path}/{name}", *what, static=True)

    ticks = np.arange(low, high + step / 2, step)
    grid = [[(0.0, float(y(tick))), (WIDTH, float(y(tick)))] for tick in ticks]
    log("grid", rr.LineStrips2D(grid, colors=[_GRID], radii=rr.Radius.ui_points(0.5)))
    frame = [[(0, 0), (0, HEIGHT), (WIDTH, HEIGHT)]]
    log("axes", rr.LineStrips2D(frame, colors=[_AXIS], radii=rr.Radius.ui_points(0.75)))
    shown = range(0, len(places), math.ceil(len(places) / _LABELS))
    _log_words(log, "values", [(x(places[i]), HEIGHT + 2) for i in shown], [values[i] for i in shown])
    _log_words(log, "numbers", [(-26, y(tick) - 14) for tick in ticks], [f"{tick:.6g}" for tick in ticks])
    ends = []
    for (metric, curve), color in zip(curves.items(), SERIES, strict=False):
        there = np.isfinite(curve)
        if not there.any():
            continue
        points = np.column_stack([x(places), y(curve)])[there]
        name = metric.replace(" ", "_")
        line = rr.LineStrips2D([points], colors=[color], radii=rr.Radius.ui_points(1.5), draw_order=10.0)
        log(f"{name}/curve", line)
        told = [
            f"{metric} {n:.4g} at {v}" for n, v in zip(curve[there], np.array(values)[there], strict=True)
        ]
        dots = rr.Points2D(points, colors=[color], radii=rr.Radius.ui_points(4.0), draw_order=11.0)
        log(f"{name}/points", dots, rr.AnyValues(says=told))
        ends.append((metric, color, float(points[-1, 1])))
    _log_names(log, ends)
    for number, (word, at) in enumerate(marks.items()):
        color, across, above = _MARKS[number], float(x(at)), -_LINE * (number + 1)
        upright = [[(across, above + _LINE / 2), (across, HEIGHT)]]
        thin = rr.Radius.ui_points(0.75)
        log(f"mark_{number}", rr.LineStrips2D(upright, colors=[color], radii=thin, draw_order=5.0))
        _log_words(log, f"mark_{number}/word", [(across, above)], [word], color)


def chart_view(name: str, path: str) -> rrb.Spatial2DView:
    bounds = rrb.VisualBounds2D(x_range=(-_LEFT, WIDTH + _RIGHT), y_range=(-_TOP, HEIGHT + _BOTTOM))
    return rrb.Spatial2DView(name=name, origin=path, visual_bounds=bounds)


def _log_words(
    log: Log,
    name: str,
    places: Sequence[tuple[float | F64, float | F64]],
    words: Sequence[str],
    color: Color = _TEXT,
) -> None:
    """Below these places, in the middle."""
    points = np.array([[float(x), float(y)] for x, y in places])
    radii = rr.Radius.ui_points(0.0)
    log(name, rr.Points2D(points, labels=words, colors=[color], radii=radii, show_labels=True))


def _log_names(log: Log, ends: Sequence[tuple[str, Color, float]]) -> None:
    """Behind the ends of the curves, and not over one another."""
    below = -math.inf
    for metric, color, height in sorted(ends, key=lambda end: end[2]):
        below = max(height - 20, below + _LINE)
        _log_words(log, f"{metric.replace(' ', '_')}/name", [(WIDTH + 90, below)], [metric], color)


def scale(low: float, high: float) -> tuple[float, float, float]:
    """From, to and by what an axis goes: from 0 where that wastes no more than about half of it."""
    low = 0.0 if low >= 0 and low < 0.6 * high else low
    if high <= low:
        low, high = low - 0.5, high + 0.5
    raw = (high - low) / _TICKS
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1, 2, 2.5, 5, 10) if factor * power >= raw)
    return math.floor(low / step) * step, math.ceil(high / step - 1e-9) * step, step
