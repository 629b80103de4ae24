"""`bevviz sweep`: every value of one or two parameters on the same frames."""

from bevviz.extras.sweep.run import Parameter, Sweep, SweepOutcome, combine, parse

__all__ = ["Parameter", "Sweep", "SweepOutcome", "combine", "parse"]
