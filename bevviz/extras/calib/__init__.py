"""`bevviz calib`: errors of extrinsics and clocks, by the edges of clouds and images."""

from bevviz.extras.calib.result import AXES, Axis, AxisFinding, AxisResult, Calibration
from bevviz.extras.calib.score import Shot, Shots, gather
from bevviz.extras.calib.solve import calibrate

__all__ = ["AXES", "Axis", "AxisFinding", "AxisResult", "Calibration", "Shot", "Shots", "calibrate", "gather"]
