"""Stages of the pipeline as functions of arrays. Imports `model` and below, neither ROS nor Rerun."""
