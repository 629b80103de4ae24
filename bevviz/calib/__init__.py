"""Check of extrinsic calibration and clocks. Imports `pipeline` and below."""

from bevviz.calib.offsets import AXES, Axis
from bevviz.calib.result import AxisFinding, AxisResult, Calibration
from bevviz.calib.samples import Shot, Shots, gather
from bevviz.calib.solve import calibrate

__all__ = [
    "AXES",
    "Axis",
    "AxisFinding",
    "AxisResult",
    "Calibration",
    "Shot",
    "Shots",
    "calibrate",
    "gather",
]
