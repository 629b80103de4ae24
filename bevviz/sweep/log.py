"""Logs a sweep: its table, and every number over the parameters, with the layout that shows them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from bevviz import table
from bevviz.frame import F64
from bevviz.logging import entities
from bevviz.logging.pieces import document
from bevviz.sweep.parameters import Parameter
from bevviz.sweep.run import COUNTS, SCORES, STAGES, Sweep
from bevviz.text import markdown

BAR = 0.8  # of the distance between two values


def log_sweep(recording: rr.RecordingStream, sweep: Sweep, name: str) -> None:
    """The table, and every number over the parameter: bars, or over two parameters a heat map."""
    recording.send_recording_name(name)
    columns = table.markdown([*sweep.rows("time ms")])
    page = f"# {sweep.title}\n\n{markdown(name)}\n\n{columns}"
    recording.log(entities.SWEEP, document(page), static=True)
    for series in _plots(sweep).values():
        for place, metric in enumerate(series):
            values = np.array([o.metrics.get(metric, math.nan) for o in sweep.outcomes.values()])
            if len(sweep.parameters) == 2:
                shown: rr.Tensor | rr.BarChart = _heat_map(sweep.parameters, values)
            else:
                shown = _bars(sweep.parameters[0], values, place, len(series))
            recording.log(entities.sweep(metric), shown, static=True)


def _heat_map(parameters: Sequence[Parameter], values: F64) -> rr.Tensor:
    shape = [len(parameter.values) for parameter in parameters]
    names = [f"{p.key}: {p.values[0]} ... {p.values[-1]}" for p in parameters]
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    span = [low, high if high > low else low + 1.0]
    return rr.Tensor(values.reshape(shape), dim_names=names, value_range=span)


def _bars(parameter: Parameter, values: F64, place: int, series: int) -> rr.BarChart:
    """Those of one series of several, beside each other."""
    at = parameter.numbers
    step = float(np.diff(at).min()) if len(at) > 1 else 1.0
    width = BAR * abs(step) / series
    at = at + (place - (series - 1) / 2) * width
    return rr.BarChart(np.nan_to_num(values), abscissa=at, widths=np.full(len(at), width))


def layout(sweep: Sweep) -> rrb.Blueprint:
    """The plots beside the table."""
    plots: list[rrb.View] = []
    for name, series in _plots(sweep).items():
        if len(sweep.parameters) == 2:
            plots += [
                rrb.TensorView(
                    name=metric,
                    origin=entities.sweep(metric),
                    scalar_mapping=rrb.TensorScalarMapping(colormap="viridis", mag_filter="nearest"),
                    view_fit="fill",
                )
                for metric in series
            ]
        else:
            paths = [entities.sweep(metric) for metric in series]
            plots.append(rrb.BarChartView(name=name, origin=entities.SWEEP, contents=paths))
    words = rrb.TextDocumentView(name="Table", origin=entities.SWEEP, contents=["$origin"])
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Grid(*plots, grid_columns=2), words, column_shares=[3, 2]),
        rrb.TimePanel(state="hidden"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _plots(sweep: Sweep) -> Mapping[str, Sequence[str]]:
    """What is shown in one plot."""
    one = len(sweep.parameters) == 1
    plots: dict[str, Sequence[str]] = {}
    if sweep.truth:
        plots["Precision, recall, F1"] = SCORES[:3]
    plots["Detections, matches, objects"] = COUNTS[1:] if one else COUNTS[3:]
    plots["Clusters"] = COUNTS[:1]
    plots["Time, ms"] = [f"{stage} ms" for stage in STAGES] if one else ["time ms"]
    return plots
