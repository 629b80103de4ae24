"""3D detectors on pillars: PointPillars and CenterPoint as ONNX files."""

from bevviz.stages.pillars.network import ObjectNetwork, PillarNetwork

__all__ = ["ObjectNetwork", "PillarNetwork"]
