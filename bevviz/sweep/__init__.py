"""A parameter or two over a range: every value on the same frames, counted, timed and held against truth."""

from bevviz.sweep.parameters import Parameter, combine, parse
from bevviz.sweep.run import Outcome, Sweep

__all__ = ["Outcome", "Parameter", "Sweep", "combine", "parse"]
