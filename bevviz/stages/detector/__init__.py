"""2D object detection with any YOLO-like ONNX file, through onnxruntime."""

from bevviz.stages.detector.detector import DEMO_MODEL, Detector, Inference, Layout, find_layout
from bevviz.stages.detector.names import COCO, read_names
from bevviz.stages.detector.suppression import nms

__all__ = ["COCO", "DEMO_MODEL", "Detector", "Inference", "Layout", "find_layout", "nms", "read_names"]
