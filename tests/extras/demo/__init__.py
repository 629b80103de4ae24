"""Tests of the simulator and of `bevviz demo`."""
