"""Views of a calibration for layouts; see ``bevviz.recording.views``."""

from __future__ import annotations

import rerun.blueprint as rrb

from bevviz.calib.offsets import AXES
from bevviz.recording import entities


def alignment(camera: str) -> rrb.Tabs:
    """Return tabs with the image, the points by depth and the edges of the cloud, as stated and corrected."""
    return rrb.Tabs(
        rrb.Spatial2DView(name=f"{camera}, as stated", origin=entities.calib_stated(camera)),
        rrb.Spatial2DView(name=f"{camera}, corrected", origin=entities.calib_corrected(camera)),
    )


def calibration(camera: str) -> rrb.TextDocumentView:
    """Return the view of the result page of 'bevviz calib'."""
    return rrb.TextDocumentView(name="Calibration", origin=entities.calib_result(camera))


def score_curves(camera: str) -> rrb.Grid:
    """Return bar charts of the score over the offset along each axis."""
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
