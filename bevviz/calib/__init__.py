"""Is it the calibration or the clock? Where the edges of cloud and image meet best, and how surely."""

from bevviz.calib.axes import AXES, Axis
from bevviz.calib.result import AxisResult, Calibration, Finding
from bevviz.calib.shots import Shot, Shots, gather
from bevviz.calib.solve import calibrate

__all__ = [
    "AXES",
    "Axis",
    "AxisResult",
    "Calibration",
    "Finding",
    "Shot",
    "Shots",
    "calibrate",
    "gather",
]
