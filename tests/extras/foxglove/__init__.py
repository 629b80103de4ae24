"""Tests of the server for Foxglove."""
