"""Comparison of two results of the same frames. Imports `evaluate` and below."""
