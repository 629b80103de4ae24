"""Tests of `bevviz calib`."""
