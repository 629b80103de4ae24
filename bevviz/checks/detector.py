"""Checks of the detector: one that never answers."""

from __future__ import annotations

from collections.abc import Iterator

from bevviz.checks.read_input import ReadInput
from bevviz.model.input_findings import InputFinding, Remedy

ENOUGH = 5  # images without a candidate that tell


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
