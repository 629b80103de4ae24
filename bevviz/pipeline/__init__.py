"""Perception of one frame, sessions, and the run over many frames. Imports `recording` and below."""
