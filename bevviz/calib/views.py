"""The views of a calibration, for layouts; see ``bevviz.recording.views``."""

from __future__ import annotations

import rerun.blueprint as rrb

from bevviz.calib.offsets import AXES
from bevviz.recording import entities


def alignment(camera: str) -> rrb.Tabs:
    """Points by depth and the edges of the cloud over the image, before and after at the same place."""
    return rrb.Tabs(
        rrb.Spatial2DView(name=f"{camera}, as stated", origin=entities.calib_stated(camera)),
        rrb.Spatial2DView(name=f"{camera}, corrected", origin=entities.calib_corrected(camera)),
    )


def calibration(camera: str) -> rrb.TextDocumentView:
    """What 'bevviz calib' found."""
    return rrb.TextDocumentView(name="Calibration", origin=entities.calib_result(camera))


def score_curves(camera: str) -> rrb.Grid:
    """How well the edges meet over the offset along each axis."""
    return rrb.Grid(
        *(
            rrb.BarChartView(
                name=f"{axis.short}, {axis.unit}",
                origin=entities.calib_curve(camera, axis.name),
                plot_legend=rrb.PlotLegend(visible=False),
            )
            for axis in AXES
        ),
        grid_columns=2,
    )
