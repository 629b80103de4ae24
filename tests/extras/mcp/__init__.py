"""Tests of `bevviz mcp`."""
