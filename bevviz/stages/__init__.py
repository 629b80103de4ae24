"""Stages of the pipeline as functions of arrays. They import `model` and below, neither ROS nor Rerun."""
