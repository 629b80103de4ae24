"""Engines that run tasks: processes of this machine, or workers of a cluster."""
