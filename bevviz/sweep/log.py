"""Log a sweep: its table, curves over one parameter, maps over two, and the layout that shows them.

The viewer's own plots only plot over time. Its bar charts and tensors do not show the values on their axes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from bevviz.model.frame import F64, U8
from bevviz.recording import entities
from bevviz.recording.primitives import document, png
from bevviz.support import table
from bevviz.support.colors import SERIES_COLORS, Color, StateColor
from bevviz.support.text import markdown
from bevviz.sweep.run import COUNTS, OPINIONS, SCORES, STAGES, Parameter, Sweep, Values

Log = Callable[..., None]  # name of the entity below the chart, archetypes

WIDTH, HEIGHT = 640.0, 420.0  # size of the area inside the axes, in units of the view
_LEFT, _RIGHT, _TOP, _BOTTOM = 70.0, 190.0, 120.0, 60.0  # room beside the axes
_AXIS, _GRID, _TEXT = (150, 155, 165), (48, 50, 58), (200, 204, 212)
_MAP_BOTTOM = 150.0  # room below the cells of a map: their values, the parameters, and the range
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
        color, across, above = _mark_color(word), float(x(at)), -_LINE * (number + 1)
        upright = [[(across, above + _LINE / 2), (across, HEIGHT)]]
        thin = rr.Radius.ui_points(0.75)
        log(f"mark_{number}", rr.LineStrips2D(upright, colors=[color], radii=thin, draw_order=5.0))
        _log_words(log, f"mark_{number}/word", [(across, above)], [word], color)


def log_map(
    recording: rr.RecordingStream,
    path: str,
    keys: Sequence[str],
    values: tuple[Sequence[str], Sequence[str]],
    numbers: F64,
    marks: Mapping[str, tuple[float, float]],
) -> None:
    """Log grey cells (dark: 0), each with its number, and frames around the marked cells.

    Args:
        recording: recording to log to, as static data.
        path: entity of the map.
        keys: keys of the two parameters: across, and up.
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

    log("cells", rr.Transform3D(scale=[width / _CELL, height / _CELL, 1.0]), png(cell_picture(numbers)))
    cells = [(i, j) for i in range(across) for j in range(up)]
    texts = ["-" if math.isnan(number) else f"{number:.3g}" for number in numbers.ravel().tolist()]
    hover_texts = [
        f"{text} at {values[0][i]}, {values[1][j]}" for (i, j), text in zip(cells, texts, strict=True)
    ]
    known = numbers[np.isfinite(numbers)]
    about = [f"{keys[0]} across, {keys[1]} up"]
    about += [f"{known.min():.3g} to {known.max():.3g}"] if len(known) else []
    _log_words(log, "range", [(WIDTH / 2, HEIGHT + _LINE * (i + 1)) for i in range(len(about))], about)
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
        color, (x, y) = _mark_color(word), middle(*at)
        # One cell may have both marks, so the second frame is smaller.
        half = np.array([width, height]) / 2 - 6.0 * number
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * half + (x, y)
        frame = rr.LineStrips2D([corners], colors=[color], radii=rr.Radius.ui_points(2.0), draw_order=10.0)
        log(f"mark_{number}", frame)
        _log_words(log, f"mark_{number}/word", [(x, -_LINE * (number + 1))], [word], color)


def _mark_color(word: str) -> Color:
    """Return the colour of a mark: blue for the best value, yellow for the present one."""
    return StateColor.GOOD.value if word.startswith("best") else StateColor.DOUBTFUL.value


def cell_picture(numbers: F64) -> U8:
    """Return the (up, across, 3) image of the cells; a cell is a block of pixels, dark grey if unknown.

    Greys start from 0. From the smallest number, they would exaggerate small differences.
    """
    known = numbers[np.isfinite(numbers)]
    low, high = float(known.min(initial=0.0)), float(known.max(initial=0.0))
    grey = 35.0 + 105.0 * (numbers - low) / ((high - low) or 1.0)
    picture = np.where(np.isfinite(numbers), grey, 13.0).astype(np.uint8).T[::-1]
    cells: U8 = np.repeat(np.kron(picture, np.ones((_CELL, _CELL), np.uint8))[:, :, None], 3, axis=2)
    return cells


def chart_view(name: str, path: str, right: float = _RIGHT, below: float = _BOTTOM) -> rrb.Spatial2DView:
    """Return the view of a chart. ``right`` and ``below`` are the room for names beside it."""
    bounds = rrb.VisualBounds2D(x_range=(-_LEFT, WIDTH + right), y_range=(-_TOP, HEIGHT + below))
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
    """Log the table, and every metric over the parameter: curves, or a heat map over two parameters.

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
        if len(sweep.parameters) == 1:
            _log_curves(recording, entities.SWEEP_CHART.path(title), sweep, numbers, present)
            continue
        for metric, values in numbers.items():
            _log_map(recording, entities.SWEEP_CHART.path(metric), sweep, values, present)


def _log_map(
    recording: rr.RecordingStream, path: str, sweep: Sweep, values: F64, present: Mapping[str, str]
) -> None:
    """Log one metric over two parameters as a map."""
    across, up = sweep.parameters
    orders = [np.argsort(parameter.numbers, kind="stable") for parameter in (across, up)]
    written = [
        [parameter.values[i] for i in order] for parameter, order in zip((across, up), orders, strict=True)
    ]
    marks = {}
    for word, chosen in _marked(sweep, present).items():
        marks[word] = (_cell(across, chosen[0]), _cell(up, chosen[1]))
    numbers = values.reshape(len(across.values), len(up.values))[np.ix_(*orders)]
    log_map(recording, path, (across.key, up.key), (written[0], written[1]), numbers, marks)


def _cell(parameter: Parameter, value: str) -> float:
    """Return the position of a value on the axis of cells, counted from the smallest value."""
    place = parameter.place(value)
    numbers = np.sort(parameter.numbers)
    return float(np.interp(math.nan if place is None else place, numbers, np.arange(len(numbers))))


def _marked(sweep: Sweep, present: Mapping[str, str]) -> Mapping[str, Values]:
    """Return word -> the values to mark, one for each parameter: the best values and the present ones."""
    marks = {}
    if sweep.best is not None:
        marks[f"best: {', '.join(sweep.best)}"] = sweep.best
    present_values = tuple(present.get(parameter.key, "") for parameter in sweep.parameters)
    if all(
        parameter.place(value) is not None
        for parameter, value in zip(sweep.parameters, present_values, strict=True)
    ):
        marks[f"now: {', '.join(present_values)}"] = present_values
    return marks


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
    marks: dict[str, float] = {}
    for word, (value,) in _marked(sweep, present).items():
        if (place := parameter.place(value)) is not None:
            marks[word] = place
    values = [parameter.values[i] for i in order]
    log_chart(
        recording, path, at[order], values, {metric: curve[order] for metric, curve in curves.items()}, marks
    )


def layout(sweep: Sweep) -> rrb.Blueprint:
    """Return the blueprint: the plots beside the table."""
    plots: list[rrb.View] = []
    for name, series in _plots(sweep).items():
        if len(sweep.parameters) == 2:
            plots += [
                chart_view(metric, entities.SWEEP_CHART.path(metric), right=20.0, below=_MAP_BOTTOM)
                for metric in series
            ]
        else:
            plots.append(
                chart_view(f"{name}, over {sweep.parameters[0].key}", entities.SWEEP_CHART.path(name))
            )
    words = rrb.TextDocumentView(name="Table", origin=entities.SWEEP, contents=["$origin"])
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Grid(*plots, grid_columns=2), words, column_shares=[5, 4]),
        rrb.TimePanel(state="hidden"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _plots(sweep: Sweep) -> Mapping[str, Sequence[str]]:
    """Return the metrics of each plot, by its title."""
    is_single = len(sweep.parameters) == 1
    plots: dict[str, Sequence[str]] = {}
    if sweep.truth:
        plots["Precision, recall, F1"] = SCORES[:3]
    plots["Detections, matches, objects"] = COUNTS[1:] if is_single else COUNTS[3:]
    plots["Clusters"] = COUNTS[:1]
    if any(config.objects.method != "frustum" for config in sweep.configs.values()):
        plots["Objects, by cameras and our fusion"] = [*OPINIONS.values()] if is_single else ["contradicted"]
    plots["Time, ms"] = [f"{stage} ms" for stage in STAGES] if is_single else ["time ms"]
    return plots
