"""Fits of detections: how well each detection of a camera fits each object of the ground truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bevviz.model import geometry
from bevviz.model.frame import F32, I64, Bool
from bevviz.model.results import Detections
from bevviz.why.subject import LINK

SAME_CLASS = 1.3  # factor on the fit of a detection to an object of its class
AS_WELL = 0.7  # share of its best fit from which a detection fits another object about equally well
TWIN = 0.8  # IoU with the detection that suppressed it from which both are boxes of one object


@dataclass(frozen=True, slots=True)
class Fits:
    """Fits of a camera's detections. A detection may fit several objects, and is the box of at most one.

    Attributes:
        overlap: (D, K) IoU with the projected object or with the image box around its points, the larger one.
        fit: (D, K) both in one number.
        owner: (D,) row of the object that the detection is the box of, -1: none.
        alone: (D,) whether a detection is the box of its owner alone: it is kept, or a twin of a kept one.
    """

    overlap: F32
    fit: F32
    owner: I64
    alone: Bool

    def belongs(self, detection: int, row: int) -> bool:
        """Return whether a detection is one of an object. A weak one may belong to two that it fits alike."""
        owner, fit = self.owner[detection], self.fit[detection]
        if owner == row or (owner >= 0 and self.alone[detection]):
            return bool(owner == row)
        return bool(self.overlap[detection, row] >= LINK and fit[row] >= AS_WELL * fit.max())


def find_fits(detections: Detections, whole: F32, seen: F32, accepted: Bool) -> Fits:
    """Compare the detections of a camera with the objects of the ground truth.

    Some detectors box the visible part of an object, others guess all of it. So the fit combines two IoU:
    with the projected box of the object, and with the image box around its own points, which other objects do
    not cover. The larger IoU weighs three times as much.

    Args:
        detections: all detections of a camera.
        whole: (K, 4) projected boxes of the objects, NaN out of view.
        seen: (K, 4) image boxes around their points, NaN without enough points.
        accepted: (D, K) whether the class of a detection is right for an object.
    """
    if not len(whole) or not len(detections):
        nothing = np.zeros((len(detections), len(whole)), np.float32)
        none = np.full(len(detections), -1, np.int64)
        return Fits(nothing, nothing, none, detections.kept)
    both = (
        np.nan_to_num(geometry.iou(detections.xyxy, whole)),
        np.nan_to_num(geometry.iou(detections.xyxy, seen)),
    )
    overlap = np.maximum(*both).astype(np.float32)
    fit = (0.75 * overlap + 0.25 * np.minimum(*both)).astype(np.float32)
    unseen = np.isnan(seen[:, 0])
    fit[:, unseen] = both[0][:, unseen] / 2
    owner = _owners(np.where(fit >= LINK, fit * np.where(accepted, SAME_CLASS, 1.0), 0.0), detections.kept)
    alone = detections.kept.copy()
    twins = np.flatnonzero((detections.suppressed_by >= 0) & (detections.overlap >= TWIN))
    owner[twins] = owner[detections.suppressed_by[twins]]
    alone[twins] = True
    return Fits(overlap, fit, owner, alone)


def _owners(fit: F32, is_kept: Bool) -> I64:
    """Return the (D,) row of the object that each detection is the box of, -1: none.

    Each detection goes to the object that it fits best. A kept one goes to another object instead if that
    object has none, the first has a better one, and the box fits both about equally well.
    """
    owner: I64 = np.where(fit.max(axis=1) > 0, fit.argmax(axis=1), -1).astype(np.int64)
    kept = np.flatnonzero(is_kept & (owner >= 0))
    for row in kept[np.argsort(-fit[kept].max(axis=1), kind="stable")].tolist():
        rivals = kept[(owner[kept] == owner[row]) & (kept != row)]
        if not (fit[rivals, owner[row]] > fit[row, owner[row]]).any():
            continue
        free = np.where(np.isin(np.arange(fit.shape[1]), owner[kept]), 0.0, fit[row])
        if free.max() >= AS_WELL * fit[row].max():
            owner[row] = int(free.argmax())
    return owner
