"""Findings of a drive: missed, false and unexplained objects, and the kept list. Imports `why` and below."""
