"""Charts of metrics over one parameter, and maps over two, drawn as 2D entities.

The viewer's own plots only plot over time. Its bar charts and tensors do not show the values on their axes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from bevviz.model.frame import F64, U8
from bevviz.recording.primitives import png
from bevviz.support.colors import SERIES_COLORS, Color, StateColor

Log = Callable[..., None]  # name of the entity below the chart, archetypes

WIDTH, HEIGHT = 640.0, 420.0  # size of the area inside the axes, in units of the view
_LEFT, _RIGHT, _TOP, _BOTTOM = 70.0, 190.0, 120.0, 60.0  # room beside the axes
_MARKS = (StateColor.GOOD.value, StateColor.DOUBTFUL.value)
_AXIS, _GRID, _TEXT = (150, 155, 165), (48, 50, 58), (200, 204, 212)
_LINE = 46.0  # least distance of names, so that they do not overlap
_TICKS = 5  # ticks on the upright axis, about
_LABELS = 9  # values written below the axis, at most
_CELL = 8  # pixels of one cell of a map, each way
_NUMBERED = 42  # cells, at most, whose numbers are always written; larger maps show a number on hovering


def log_chart(
    recording: rr.RecordingStream,
    path: str,
    places: F64,
    values: Sequence[str],
    curves: Mapping[str, F64],
    marks: Mapping[str, int | float],
) -> None:
    """Log axes, one curve for each metric with its name at the end, and marks.

    Args:
        recording: recording to log to, as static data.
        path: entity of the chart.
        places: (N,) positions of the values on the axis, ascending.
        values: (N,) the values as text.
        curves: metric -> (N,) numbers; NaN: unknown.
        marks: word -> position of an upright line, such as that of the best value; at most two.
    """
    known = np.concatenate([curve[np.isfinite(curve)] for curve in curves.values()])
    low, high, step = axis_scale(float(known.min(initial=0.0)), float(known.max(initial=0.0)))
    span = float(places[-1] - places[0]) or 1.0

    def x(at: F64 | float) -> F64:
        """Return the x coordinate of a position on the axis."""
        return np.asarray((at - places[0]) / span * WIDTH if len(places) > 1 else WIDTH / 2 + 0 * at)

    def y(at: F64 | float) -> F64:
        """Return the y coordinate of a number."""
        return np.asarray(HEIGHT - (at - low) / (high - low) * HEIGHT)

    def log(name: str, *what: rr.AsComponents) -> None:
        """Log static archetypes below the chart."""
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
    for (metric, curve), color in zip(curves.items(), SERIES_COLORS, strict=False):
        finite = np.isfinite(curve)
        if not finite.any():
            continue
        points = np.column_stack([x(places), y(curve)])[finite]
        name = metric.replace(" ", "_")
        line = rr.LineStrips2D([points], colors=[color], radii=rr.Radius.ui_points(1.5), draw_order=10.0)
        log(f"{name}/curve", line)
        hover_texts = [
            f"{metric} {number:.4g} at {value}"
            for number, value in zip(curve[finite], np.array(values)[finite], strict=True)
        ]
        dots = rr.Points2D(points, colors=[color], radii=rr.Radius.ui_points(4.0), draw_order=11.0)
        log(f"{name}/points", dots, rr.AnyValues(says=hover_texts))
        ends.append((metric, color, float(points[-1, 1])))
    _log_names(log, ends)
    for number, (word, at) in enumerate(marks.items()):
        color, across, above = _MARKS[number], float(x(at)), -_LINE * (number + 1)
        upright = [[(across, above + _LINE / 2), (across, HEIGHT)]]
        thin = rr.Radius.ui_points(0.75)
        log(f"mark_{number}", rr.LineStrips2D(upright, colors=[color], radii=thin, draw_order=5.0))
        _log_words(log, f"mark_{number}/word", [(across, above)], [word], color)


def log_map(
    recording: rr.RecordingStream,
    path: str,
    values: tuple[Sequence[str], Sequence[str]],
    numbers: F64,
    marks: Mapping[str, tuple[float, float]],
) -> None:
    """Log grey cells (dark: the smallest number), each with its number, and frames around the marked cells.

    Args:
        recording: recording to log to, as static data.
        path: entity of the map.
        values: values of the two parameters as text: across from the left, and up from the bottom.
        numbers: (across, up); NaN: unknown.
        marks: word -> position of a cell, counted from 0 across and up; at most two.
    """
    across, up = numbers.shape
    width, height = WIDTH / across, HEIGHT / up

    def log(name: str, *what: rr.AsComponents) -> None:
        """Log static archetypes below the map."""
        recording.log(f"{path}/{name}", *what, static=True)

    def middle(i: float, j: float) -> tuple[float, float]:
        """Return the x, y of the middle of a cell."""
        return (i + 0.5) * width, HEIGHT - (j + 0.5) * height

    log("cells", rr.Transform3D(scale=[width / _CELL, height / _CELL, 1.0]), png(_cells(numbers)))
    cells = [(i, j) for i in range(across) for j in range(up)]
    texts = ["-" if math.isnan(number) else f"{number:.3g}" for number in numbers.ravel().tolist()]
    hover_texts = [
        f"{text} at {values[0][i]}, {values[1][j]}" for (i, j), text in zip(cells, texts, strict=True)
    ]
    dots = rr.Points2D(
        [middle(i, j) for i, j in cells],
        labels=texts,
        colors=[_TEXT],
        radii=rr.Radius.ui_points(1.0),
        show_labels=len(cells) <= _NUMBERED,
        draw_order=11.0,
    )
    log("numbers", dots, rr.AnyValues(says=hover_texts if len(hover_texts) > 1 else hover_texts * 2))
    for name, words, places in (
        ("values_across", values[0], [(middle(i, 0)[0], HEIGHT + 2) for i in range(across)]),
        ("values_up", values[1], [(-36, middle(0, j)[1] - 14) for j in range(up)]),
    ):
        shown = range(0, len(words), math.ceil(len(words) / _LABELS))
        _log_words(log, name, [places[i] for i in shown], [words[i] for i in shown])
    for number, (word, at) in enumerate(marks.items()):
        color, (x, y) = _MARKS[number], middle(*at)
        # One cell may have both marks, so the second frame is smaller.
        half = np.array([width, height]) / 2 - 6.0 * number
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * half + (x, y)
        frame = rr.LineStrips2D([corners], colors=[color], radii=rr.Radius.ui_points(2.0), draw_order=10.0)
        log(f"mark_{number}", frame)
        _log_words(log, f"mark_{number}/word", [(x, -_LINE * (number + 1))], [word], color)


def _cells(numbers: F64) -> U8:
    """Return the (up, across, 3) image of the cells; a cell is a block of pixels, dark grey if unknown."""
    known = numbers[np.isfinite(numbers)]
    low, high = float(known.min(initial=math.inf)), float(known.max(initial=-math.inf))
    grey = 35.0 + 105.0 * (numbers - low) / ((high - low) or 1.0)
    picture = np.where(np.isfinite(numbers), grey, 13.0).astype(np.uint8).T[::-1]
    cells: U8 = np.repeat(np.kron(picture, np.ones((_CELL, _CELL), np.uint8))[:, :, None], 3, axis=2)
    return cells


def chart_view(name: str, path: str, right: float = _RIGHT) -> rrb.Spatial2DView:
    """Return the view of a chart. ``right`` is the room for names beside it."""
    bounds = rrb.VisualBounds2D(x_range=(-_LEFT, WIDTH + right), y_range=(-_TOP, HEIGHT + _BOTTOM))
    return rrb.Spatial2DView(name=name, origin=path, visual_bounds=bounds)


def _log_words(
    log: Log,
    name: str,
    places: Sequence[tuple[float | F64, float | F64]],
    words: Sequence[str],
    color: Color = _TEXT,
) -> None:
    """Log words centred below these positions."""
    points = np.array([[float(x), float(y)] for x, y in places])
    radii = rr.Radius.ui_points(0.0)
    log(name, rr.Points2D(points, labels=words, colors=[color], radii=radii, show_labels=True))


def _log_names(log: Log, ends: Sequence[tuple[str, Color, float]]) -> None:
    """Log the name of each curve beside its end, without overlaps."""
    below = -math.inf
    for metric, color, height in sorted(ends, key=lambda end: end[2]):
        below = max(height - 20, below + _LINE)
        _log_words(log, f"{metric.replace(' ', '_')}/name", [(WIDTH + 90, below)], [metric], color)


def axis_scale(low: float, high: float) -> tuple[float, float, float]:
    """Return start, end and step of an axis. It starts at 0 if that wastes at most about half of it."""
    low = 0.0 if low >= 0 and low < 0.6 * high else low
    if high - low < 1e-300:  # The logarithm of zero is undefined.
        low, high = low - 0.5, high + 0.5
    raw = (high - low) / _TICKS
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1, 2, 2.5, 5, 10) if factor * power >= raw)
    return math.floor(low / step) * step, math.ceil(high / step - 1e-9) * step, step
