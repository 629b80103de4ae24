"""Face of a live run on the robot's graph: result topics, /diagnostics, parameters and a service."""
