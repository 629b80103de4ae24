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
from bevviz.sweep.chart import chart_view, log_chart
from bevviz.sweep.parameters import Parameter
from bevviz.sweep.run import COUNTS, SCORES, STAGES, Sweep
from bevviz.text import markdown


def log_sweep(recording: rr.RecordingStream, sweep: Sweep, name: str, present: Mapping[str, str]) -> None:
    """The table, and every number over the parameter: curves, or over two parameters a heat map.

    Args:
        recording: where to; static.
        sweep: with its outcomes.
        name: of the drive.
        present: parameter -> its value without the sweep.
    """
    recording.send_recording_name(name)
    columns = table.markdown([*sweep.rows("time ms")])
    page = f"# {sweep.title}\n\n{markdown(name)}\n\n{columns}"
    recording.log(entities.SWEEP, document(page), static=True)
    for title, series in _plots(sweep).items():
        found = {m: np.array([o.metrics.get(m, math.nan) for o in sweep.outcomes.values()]) for m in series}
        if len(sweep.parameters) == 1:
            _log_curves(recording, entities.sweep(title), sweep, found, present)
            continue
        for metric, values in found.items():
            recording.log(entities.sweep(metric), _heat_map(sweep.parameters, values), static=True)


def _heat_map(parameters: Sequence[Parameter], values: F64) -> rr.Tensor:
    shape = [len(parameter.values) for parameter in parameters]
    names = [f"{p.key}: {p.values[0]} ... {p.values[-1]}" for p in parameters]
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    span = [low, high if high > low else low + 1.0]
    return rr.Tensor(values.reshape(shape), dim_names=names, value_range=span)


def _log_curves(
    recording: rr.RecordingStream,
    path: str,
    sweep: Sweep,
    curves: Mapping[str, F64],
    present: Mapping[str, str],
) -> None:
    [parameter] = sweep.parameters
    at = parameter.numbers
    order = np.argsort(at, kind="stable")
    marks: dict[str, float] = {}
    if sweep.best is not None:
        marks[f"best: {sweep.best[0]}"] = float(at[parameter.values.index(sweep.best[0])])
    now = present.get(parameter.key, "")
    if (place := parameter.place(now)) is not None:
        marks[f"now: {now}"] = place
    values = [parameter.values[i] for i in order]
    log_chart(recording, path, at[order], values, {m: c[order] for m, c in curves.items()}, marks)


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
            plots.append(chart_view(f"{name}, over {sweep.parameters[0].key}", entities.sweep(name)))
    words = rrb.TextDocumentView(name="Table", origin=entities.SWEEP, contents=["$origin"])
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Grid(*plots, grid_columns=2), words, column_shares=[5, 4]),
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
