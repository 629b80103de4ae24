"""Parameter sweeps, and tuning on one frame. Imports `evaluate` and below."""

from bevviz.sweep.parameters import Parameter, combine, parse
from bevviz.sweep.run import Outcome, Sweep

__all__ = ["Outcome", "Parameter", "Sweep", "combine", "parse"]
