"""Score of the detections in images against the ground truth."""

from __future__ import annotations

from collections import Counter, defaultdict

import numpy as np

from bevviz.evaluate.ground_truth import Truth
from bevviz.evaluate.matching import AcceptedNames, accepts, pair_in_order
from bevviz.model import geometry
from bevviz.model.frame import F32, Bool
from bevviz.model.results import CameraResult

DETECTION_OVERLAP = 0.5  # least IoU of a detection and its label in the image


class DetectionScore:
    """Counts of detections over frames: true and missed ones by label, false ones by name."""

    def __init__(self) -> None:
        self._labels: dict[str, Counter[str]] = defaultdict(Counter)
        self._false: Counter[str] = Counter()

    def classes(self, judged: AcceptedNames) -> dict[str, Counter[str]]:
        """Return the counts ``true``, ``false`` and ``missed`` of each class."""
        return judged.with_false(self._labels, self._false, "false")

    def add(self, result: CameraResult, truth: Truth) -> None:
        """Match one camera's detections with the labelled image boxes, best score first, and count."""
        detections, camera = result.detections, result.camera
        if detections is None or camera.intrinsics is None or camera.camera_from_points is None:
            return
        boxes = _image_boxes(truth, result)
        kept = np.flatnonzero(detections.kept)
        kept = kept[np.argsort(-detections.score[kept], kind="stable")]
        names = [detections.names[d].lower() for d in kept]
        overlap = geometry.iou(detections.xyxy[kept], boxes)
        cost = np.where(accepts(truth, names) & (overlap >= DETECTION_OVERLAP), 1 - overlap, np.inf)
        partner, free = pair_in_order(cost, 1.0)
        excused = _in_regions(detections.xyxy[kept], truth)
        to_find = truth.must & np.isfinite(boxes).all(axis=1)
        for name, k, is_excused in zip(names, partner.tolist(), excused.tolist(), strict=True):
            if k >= 0 and to_find[k]:
                self._labels[truth.labels[k].lower()]["true"] += 1
            elif k < 0 and not is_excused:
                self._false[name] += 1
        for row in np.flatnonzero(free & to_find).tolist():
            self._labels[truth.labels[row].lower()]["missed"] += 1


def _image_boxes(truth: Truth, result: CameraResult) -> F32:
    """Return (K, 4) image boxes of the labels.

    They are labelled, or enclose the visible part of the projected 3D box. NaN if the box is not visible.
    """
    camera = result.camera
    if truth.image is not None and truth.camera is not None and truth.camera.name == camera.name:
        return truth.image.xyxy
    assert camera.intrinsics is not None
    assert camera.camera_from_points is not None
    corners = geometry.apply(camera.camera_from_points, geometry.corners(truth.boxes).reshape(-1, 3))
    uv, depth = geometry.project(corners, camera.intrinsics)
    uv, ahead = uv.reshape(-1, 8, 2), depth.reshape(-1, 8).min(axis=1) > geometry.MIN_DEPTH
    boxes = np.full((len(ahead), 4), np.nan, np.float32)
    size = np.array([camera.intrinsics.width, camera.intrinsics.height], np.float32)
    inside = np.clip(uv[ahead], -0.5, size - 0.5)
    boxes[ahead] = np.hstack([inside.min(axis=1), inside.max(axis=1)])
    boxes[(boxes[:, 2:] <= boxes[:, :2]).any(axis=1)] = np.nan
    return boxes


def _in_regions(xyxy: F32, truth: Truth) -> Bool:
    """Return (D,) whether more than half of an image box lies in a region without labels."""
    none = np.zeros(len(xyxy), bool)
    if truth.image is None or len(truth.image.dont_care) == 0 or len(xyxy) == 0:
        return none
    regions = truth.image.dont_care
    low = np.maximum(xyxy[:, None, :2], regions[None, :, :2])
    high = np.minimum(xyxy[:, None, 2:], regions[None, :, 2:])
    shared = np.prod(np.clip(high - low, 0, None), axis=2)
    area = np.prod(xyxy[:, 2:] - xyxy[:, :2], axis=1)
    return np.asarray(shared.max(axis=1) > DETECTION_OVERLAP * area, bool)
