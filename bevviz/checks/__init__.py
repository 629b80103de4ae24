"""Checks of the input: what is suspicious about a bag, its sensors and the detector.

Imports `anomalies` and below. A check is a function of what was read that yields findings. `CHECKS` lists all
checks, in the order in which their findings are shown. `InputChecks` collects what the checks need in a run.
"""

from bevviz.checks.input_checks import CHECKS, InputChecks
from bevviz.checks.read_input import ReadInput

__all__ = ["CHECKS", "InputChecks", "ReadInput"]
