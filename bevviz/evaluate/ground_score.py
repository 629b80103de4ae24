"""Score of the ground stage against labelled points."""

from __future__ import annotations

from collections import Counter

import numpy as np

from bevviz.model.results import FrameResult
from bevviz.stages.voxel import spread_to_points

# Numbers of SemanticKITTI's classes (Behley et al. 2019), stored in the field ``label`` of a cloud.
GROUND_LABELS = (40, 44, 48, 49, 60, 72)  # road, parking, pavement, other ground, marking, terrain
OBJECT_LABELS = (10, 11, 13, 15, 16, 18, 20, 30, 31, 32, 99, *range(252, 260))
UNLABELLED = (0, 1)


def count_ground(counts: Counter[str], result: FrameResult) -> None:
    """Count the points of a frame by label and by ground mask. The cloud needs a field ``label``."""
    labels = result.frame.fields.get("label")
    if labels is None or labels.dtype.kind not in "ui" or result.ground is None or result.voxels is None:
        return
    kind = labels.astype(np.int64) & 0xFFFF
    known = ~np.isin(kind, UNLABELLED)
    is_ground = spread_to_points(result.ground.mask, result.voxels.inverse)
    ground_points, object_points = np.isin(kind, GROUND_LABELS), np.isin(kind, OBJECT_LABELS)
    counts["true"] += int((is_ground & ground_points).sum())
    counts["false"] += int((is_ground & ~ground_points & known).sum())
    counts["missed"] += int((~is_ground & ground_points).sum())
    counts["kept"] += int((~is_ground & object_points).sum())
    counts["lost"] += int((is_ground & object_points).sum())
