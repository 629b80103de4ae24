"""bevviz: see what a LiDAR-camera perception pipeline saw, made and decided, frame by frame, in Rerun."""

__version__ = "0.1.0"
