"""Log a sweep: its table, every metric over the parameters, and the layout that shows them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from bevviz.model.frame import F64
from bevviz.recording import entities
from bevviz.recording.primitives import document
from bevviz.support import table
from bevviz.support.text import markdown
from bevviz.sweep.chart import chart_view, log_chart, log_map
from bevviz.sweep.run import COUNTS, OPINIONS, SCORES, STAGES, Parameter, Sweep, Values


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
    page = f"# {sweep.title}\n\n{markdown(name)}\n\n{columns}"
    recording.log(entities.SWEEP, document(page), static=True)
    for title, series in _plots(sweep).items():
        numbers = {
            metric: np.array([outcome.metrics.get(metric, math.nan) for outcome in sweep.outcomes.values()])
            for metric in series
        }
        if len(sweep.parameters) == 1:
            _log_curves(recording, entities.sweep(title), sweep, numbers, present)
            continue
        for metric, values in numbers.items():
            _log_map(recording, entities.sweep(metric), sweep, values, present)


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
    log_map(recording, path, (written[0], written[1]), numbers, marks)


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
            across, up = (parameter.key for parameter in sweep.parameters)
            plots += [
                chart_view(f"{metric}: {across} across, {up} up", entities.sweep(metric), right=20.0)
                for metric in series
            ]
        else:
            plots.append(chart_view(f"{name}, over {sweep.parameters[0].key}", entities.sweep(name)))
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
