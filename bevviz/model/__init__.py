"""Frames, results and geometry as frozen dataclasses of arrays. Imports `config` and `support`."""
