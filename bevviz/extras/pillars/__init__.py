"""3D detectors on pillars: PointPillars and CenterPoint as ONNX files, for ``objects.method=FILE.onnx``."""
