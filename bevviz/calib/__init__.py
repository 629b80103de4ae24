"""Check of extrinsic calibration and clocks. Imports `pipeline` and below."""

from bevviz.calib.result import AXES, Axis, AxisFinding, AxisResult, Calibration
from bevviz.calib.score import Shot, Shots, gather
from bevviz.calib.solve import calibrate

__all__ = ["AXES", "Axis", "AxisFinding", "AxisResult", "Calibration", "Shot", "Shots", "calibrate", "gather"]
