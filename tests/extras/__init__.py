"""Tests of the extras, a folder each."""
