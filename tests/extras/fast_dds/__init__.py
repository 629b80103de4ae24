"""Tests of the questions about the robot's own nodes."""
