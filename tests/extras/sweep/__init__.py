"""Tests of `bevviz sweep`."""
