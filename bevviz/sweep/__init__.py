"""Parameter sweeps. Imports `why` and below."""

from bevviz.sweep.run import Parameter, Sweep, SweepOutcome, combine, parse

__all__ = ["Parameter", "Sweep", "SweepOutcome", "combine", "parse"]
