"""Checks of the detector: one that never answers, and boxes that are not of the images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np

from bevviz.checks.read_input import ReadInput
from bevviz.config.plugins import TOPIC
from bevviz.model.input_findings import InputFinding, Remedy
from bevviz.model.results import CameraResult

ENOUGH = 5  # images without a candidate, or boxes, that tell
POINT = 2.0  # pixels; no detector boxes a smaller object
REACH = 0.1  # share of the image's size; a box that is not clipped reaches less far out of the image


def silent_detector(read: ReadInput) -> Iterator[InputFinding]:
    """Yield a detector whose network has no candidate in any image, however weak."""
    config = read.config.detector
    if read.answered or read.images < ENOUGH or not config.model.endswith(".onnx"):
        return
    classes = f" of {', '.join(config.classes)}" if config.classes else ""
    text = (
        f"detector.model {config.model}: no candidate{classes} with a score of {config.explain_threshold:g} "
        f"or more in {read.images} of {read.images} images"
    )
    remedy = (
        "run it with its own tool on one of these images: the export may have lost its scores, or it wants "
        "other images (docs/models.md)"
    )
    yield InputFinding("detector", config.model, text, Remedy(remedy))


def misplaced_boxes(read: ReadInput) -> Iterator[InputFinding]:
    """Yield a detector most of whose boxes are no pixels of its images, or whose classes are numbers."""
    model, count = read.config.detector.model, read.boxes
    total = count["kept"]
    if total < ENOUGH:
        return
    names = "let its node publish names" if model.startswith(TOPIC) else "detector.names names them"
    for kind, what, remedy in (
        ("point", "are smaller than two pixels", "publish pixels, not shares of the image"),
        (
            "outside",
            "reach far out of the image",
            "publish pixels of the image that source.camera_topics names",
        ),
        ("number", "have a number for a class, so no size is known", names),
    ):
        if count[kind] > total / 2:
            text = f"detector.model {model}: {count[kind]} of {total} boxes {what}"
            yield InputFinding("detector", model, text, Remedy(remedy))


def count_boxes(boxes: Counter[str], camera: CameraResult) -> None:
    """Count the kept detections of an image, and those that are odd."""
    image, detections = camera.camera.image, camera.detections
    if image is None or detections is None or not detections.kept.any():
        return
    xyxy = detections.xyxy[detections.kept]
    height, width = image.bgr.shape[:2]
    size = np.array([width, height])
    boxes["kept"] += len(xyxy)
    boxes["point"] += int(((xyxy[:, 2:] - xyxy[:, :2]) < POINT).all(axis=1).sum())
    boxes["outside"] += int((np.maximum(-xyxy[:, :2], xyxy[:, 2:] - size) > REACH * size).any(axis=1).sum())
    names = (name for name, kept in zip(detections.names, detections.kept, strict=True) if kept)
    boxes["number"] += sum(name.isdigit() for name in names)
