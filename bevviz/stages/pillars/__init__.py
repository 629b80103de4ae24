"""3D detectors on pillars: PointPillars and CenterPoint as ONNX files."""

from bevviz.stages.pillars.network import ObjectNetwork, PillarNetwork, run_directly

__all__ = ["ObjectNetwork", "PillarNetwork", "run_directly"]
