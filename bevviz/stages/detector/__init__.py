"""2D object detection with ONNX files of many families, through onnxruntime."""

from bevviz.stages.detector.detector import MAX_CANDIDATES, Detector, Inference
from bevviz.stages.detector.names import COCO, read_names
from bevviz.stages.detector.suppression import nms

__all__ = ["COCO", "MAX_CANDIDATES", "Detector", "Inference", "nms", "read_names"]
