"""Log the result of ``bevviz calib``, and the views of it: points over the image, and the score curves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from bevviz.config import LoggingConfig
from bevviz.extras.calib.result import AXES, TIME, AxisFinding, Calibration, error_pose
from bevviz.extras.calib.score import Shot
from bevviz.model import geometry
from bevviz.model.frame import F32, F64, Bool, Intrinsics
from bevviz.recording import entities
from bevviz.recording.primitives import CORNER, depth_annotations, document, encode_image
from bevviz.support import table
from bevviz.support.colors import StateColor, color_rows
from bevviz.support.text import fenced, markdown

_STATED, _CORRECTED = StateColor.BAD.value, StateColor.GOOD.value
_COLORS = {
    AxisFinding.FINE: StateColor.GOOD.value,
    AxisFinding.OFF: StateColor.BAD.value,
    AxisFinding.UNKNOWN: StateColor.UNKNOWN.value,
    AxisFinding.CONFLICT: StateColor.DOUBTFUL.value,
}


def log_calibration(
    recording: rr.RecordingStream, result: Calibration, shots: Sequence[Shot], config: LoggingConfig
) -> None:
    """Log the result for one camera.

    Args:
        recording: recording to log to.
        result: calibration of the camera.
        shots: images and clouds that gave the result.
        config: quality of the images.
    """
    camera = result.camera
    recording.log(entities.CALIB_RESULT.path(camera), document(_page(result)), static=True)
    for axis in result.axes:
        path = entities.CALIB_CURVE.path(camera, axis.axis.name)
        width = np.full(len(axis.score), axis.abscissa[1] - axis.abscissa[0], np.float32)
        height = axis.score - min(curve.score.min() for curve in result.axes)
        bars = rr.BarChart(height, abscissa=axis.abscissa, widths=width, color=_COLORS[axis.finding])
        recording.log(path, bars, static=True)
    for path in (entities.CALIB_STATED.path(camera), entities.CALIB_CORRECTED.path(camera)):
        recording.log(f"{path}/points", depth_annotations(), static=True)
    correction = error_pose(result.correction)
    for shot in shots:
        recording.set_time(entities.STAMP, timestamp=np.datetime64(shot.frame.stamp, "ns"))
        recording.set_time(entities.FRAME, sequence=shot.frame.index)
        stated = shot.camera_from_points(0.0)
        corrected = correction @ shot.camera_from_points(float(result.correction[TIME]))
        _log_pair(recording, entities.CALIB_STATED.path(camera), shot, stated, config, _STATED)
        _log_pair(recording, entities.CALIB_CORRECTED.path(camera), shot, corrected, config, _CORRECTED)


def _log_pair(
    recording: rr.RecordingStream,
    path: str,
    shot: Shot,
    camera_from_points: F64,
    config: LoggingConfig,
    color: tuple[int, int, int],
) -> None:
    """Log the image, all points over it by depth, and the edges of the cloud."""
    assert shot.camera.image is not None and shot.camera.intrinsics is not None
    recording.log(f"{path}/image", encode_image(shot.camera.image, config.jpeg_quality))
    intrinsics = shot.camera.intrinsics
    uv, depth = geometry.project(geometry.apply(camera_from_points, shot.frame.points), intrinsics)
    seen = _inside(uv, intrinsics)
    classes = color_rows(depth[seen], 0, entities.DEPTH_RANGE, entities.DEPTH_BINS)
    recording.log(
        f"{path}/points",
        rr.Points2D(
            uv[seen] + CORNER,
            class_ids=classes,
            radii=rr.Radius.ui_points(1.0),
            show_labels=False,
            draw_order=10.0,
        ),
    )
    uv, _ = geometry.project(geometry.apply(camera_from_points, shot.xyz), intrinsics)
    recording.log(
        f"{path}/edges",
        rr.Points2D(
            uv[_inside(uv, intrinsics)] + CORNER,
            colors=[color],
            radii=rr.Radius.ui_points(1.5),
            draw_order=20.0,
        ),
    )


def _inside(uv: F32, intrinsics: Intrinsics) -> Bool:
    """Return (N,) which pixels are inside the image."""
    with np.errstate(invalid="ignore"):
        return np.asarray(((uv > -CORNER) & (uv < [intrinsics.width, intrinsics.height])).all(axis=1))


def _page(result: Calibration) -> str:
    """Return the page of the result in Markdown."""
    rows = [(axis.axis.name, axis.measured, axis.text) for axis in result.axes]
    return "\n".join(
        [
            f"## {markdown(result.answer)}\n",
            table.markdown([("axis", "offset of what is stated", "finding"), *rows], "lll"),
            f"\n{result.measured_from}. Score {result.score_stated:.3f} as stated, "
            f"{result.score_corrected:.3f} as corrected.\n",
            *map(markdown, result.notes),
            f"\n{fenced(result.config, 'yaml')}" if result.moved else "",
        ]
    )


# --- views for the layout ----------------------------------------------------------------------


def alignment(camera: str) -> rrb.Tabs:
    """Return tabs with the image, the points by depth and the edges of the cloud, as stated and corrected."""
    return rrb.Tabs(
        rrb.Spatial2DView(name=f"{camera}, as stated", origin=entities.CALIB_STATED.path(camera)),
        rrb.Spatial2DView(name=f"{camera}, corrected", origin=entities.CALIB_CORRECTED.path(camera)),
    )


def calibration(camera: str) -> rrb.TextDocumentView:
    """Return the view of the result page of 'bevviz calib'."""
    return rrb.TextDocumentView(name="Calibration", origin=entities.CALIB_RESULT.path(camera))


def score_curves(camera: str) -> rrb.Grid:
    """Return bar charts of the score over the offset along each axis."""
    return rrb.Grid(
        *(
            rrb.BarChartView(
                name=f"{axis.short}, {axis.unit}",
                origin=entities.CALIB_CURVE.path(camera, axis.name),
                plot_legend=rrb.PlotLegend(visible=False),
            )
            for axis in AXES
        ),
        grid_columns=2,
    )
