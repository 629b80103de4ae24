"""Parameter sweeps, and tuning on one frame. Imports `evaluate` and below."""

from bevviz.sweep.parameters import Parameter, combine, parse
from bevviz.sweep.run import Sweep, SweepOutcome

__all__ = ["Parameter", "Sweep", "SweepOutcome", "combine", "parse"]
