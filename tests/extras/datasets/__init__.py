"""Tests of the extra datasets."""
