"""Comparison of two results of the same frames. Imports `why` and below."""
