"""Log a sweep: its table, curves over one parameter, and the layout that shows them.

The viewer's own plots only plot over time. Its bar charts and tensors do not show the values on their axes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from bevviz.extras.sweep.run import COUNTS, OPINIONS, SCORES, STAGES, Sweep
from bevviz.model.frame import F64
from bevviz.recording import entities
from bevviz.recording.primitives import document
from bevviz.support import table
from bevviz.support.colors import SERIES_COLORS, Color, StateColor
from bevviz.support.text import markdown

Log = Callable[..., None]  # name of the entity below the chart, archetypes

WIDTH, HEIGHT = 640.0, 420.0  # size of the area inside the axes, in units of the view
_LEFT, _RIGHT, _TOP, _BOTTOM = 70.0, 190.0, 120.0, 60.0  # room beside the axes
_AXIS, _GRID, _TEXT = (150, 155, 165), (48, 50, 58), (200, 204, 212)
_LINE = 46.0  # least distance of names, so that they do not overlap
_TICKS = 5  # ticks on the upright axis, about
_LABELS = 9  # values written below the axis, at most


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
        color, across, above = _mark_color(word), float(x(at)), -_LINE * (number + 1)
        upright = [[(across, above + _LINE / 2), (across, HEIGHT)]]
        thin = rr.Radius.ui_points(0.75)
        log(f"mark_{number}", rr.LineStrips2D(upright, colors=[color], radii=thin, draw_order=5.0))
        _log_words(log, f"mark_{number}/word", [(across, above)], [word], color)


def _mark_color(word: str) -> Color:
    """Return the colour of a mark: blue for the best value, yellow for the present one."""
    return StateColor.GOOD.value if word.startswith("best") else StateColor.DOUBTFUL.value


def _chart_view(name: str, path: str) -> rrb.Spatial2DView:
    """Return the view of a chart, with room for names beside it."""
    bounds = rrb.VisualBounds2D(x_range=(-_LEFT, WIDTH + _RIGHT), y_range=(-_TOP, HEIGHT + _BOTTOM))
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


def log_sweep(recording: rr.RecordingStream, sweep: Sweep, name: str, present: Mapping[str, str]) -> None:
    """Log the table, and curves of every metric over a single parameter.

    Args:
        recording: recording to log to, as static data.
        sweep: the sweep with its outcomes.
        name: name of the swept recording.
        present: parameter -> its value without the sweep.
    """
    recording.send_recording_name(name)
    columns = table.markdown([*sweep.rows("time ms")])
    verdict = f"**{markdown(sweep.verdict)}**\n\n" if sweep.verdict else ""
    page = f"# {sweep.title}\n\n{markdown(name)}\n\n{verdict}{columns}"
    recording.log(entities.SWEEP, document(page), static=True)
    for title, series in _plots(sweep).items():
        numbers = {
            metric: np.array([outcome.metrics.get(metric, math.nan) for outcome in sweep.outcomes.values()])
            for metric in series
        }
        _log_curves(recording, entities.SWEEP_CHART.path(title), sweep, numbers, present)


def _log_curves(
    recording: rr.RecordingStream,
    path: str,
    sweep: Sweep,
    curves: Mapping[str, F64],
    present: Mapping[str, str],
) -> None:
    """Log curves over one parameter."""
    [parameter] = sweep.parameters
    at = parameter.numbers
    order = np.argsort(at, kind="stable")
    marked = {} if sweep.best is None else {"best": sweep.best[0]}
    marked["now"] = present.get(parameter.key, "")
    marks = {
        f"{word}: {value}": place
        for word, value in marked.items()
        if (place := parameter.place(value)) is not None
    }
    values = [parameter.values[i] for i in order]
    log_chart(
        recording, path, at[order], values, {metric: curve[order] for metric, curve in curves.items()}, marks
    )


def layout(sweep: Sweep) -> rrb.Blueprint:
    """Return the blueprint: the plots, if there are any, beside the table."""
    plots = [
        _chart_view(f"{name}, over {sweep.parameters[0].key}", entities.SWEEP_CHART.path(name))
        for name in _plots(sweep)
    ]
    words = rrb.TextDocumentView(name="Table", origin=entities.SWEEP, contents=["$origin"])
    grid = rrb.Grid(*plots, grid_columns=2)
    return rrb.Blueprint(
        rrb.Horizontal(grid, words, column_shares=[5, 4]) if plots else words,
        rrb.TimePanel(state="hidden"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _plots(sweep: Sweep) -> Mapping[str, Sequence[str]]:
    """Return the metrics of each plot, by its title. Only a sweep over one parameter has plots."""
    plots: dict[str, Sequence[str]] = {}
    if len(sweep.parameters) > 1:
        return plots
    if sweep.truth:
        plots["Precision, recall, F1"] = SCORES[:3]
    plots["Detections, matches, objects"] = COUNTS[1:]
    plots["Clusters"] = COUNTS[:1]
    if any(config.objects.method != "frustum" for config in sweep.configs.values()):
        plots["Objects, by cameras and our fusion"] = [*OPINIONS.values()]
    plots["Time, ms"] = [f"{stage} ms" for stage in STAGES]
    return plots
