"""Greedy non-maximum suppression that keeps the same boxes as torchvision, and gives reasons."""

from __future__ import annotations

import numpy as np

from bevviz.model.frame import F32, I32, I64
from bevviz.support.numba_kernel import kernel


def nms(xyxy: F32, class_id: I32, threshold: float, class_offset: float = 0.0) -> tuple[I32, F32]:
    """Greedy class-wise non-maximum suppression (Neubeck and Van Gool 2006).

    Keep exactly the boxes that ``torchvision.ops.nms`` keeps after boxes are shifted by ``class_offset`` for
    each class. Ultralytics separates classes in this way. In float32 the shift rounds the corners of boxes by
    up to 1/32 of a pixel, which occasionally changes the result.

    Args:
        xyxy: (N, 4) boxes, best score first.
        class_id: (N,) classes. Only boxes of the same class suppress each other.
        threshold: IoU above which the weaker box is suppressed.
        class_offset: pixels from one class to the next.

    Returns:
        suppressor: (N,) row of the surviving box that suppressed this one, -1 for survivors.
        overlap: (N,) IoU with it, 0 for survivors.
    """
    moved = xyxy + class_id[:, None].astype(np.float32) * np.float32(class_offset)
    rows = np.argsort(class_id, kind="stable")  # classes one after the other, each best first
    ends = np.flatnonzero(np.diff(class_id[rows])) + 1
    suppressor, overlap = np.full(len(xyxy), -1, np.int32), np.zeros(len(xyxy), np.float32)
    _suppress(moved, rows, np.append(ends, len(rows)), threshold, suppressor, overlap)
    return suppressor, overlap


@kernel
def _suppress(boxes: F32, rows: I64, ends: I64, threshold: float, suppressor: I32, overlap: F32) -> None:
    """Suppress boxes within each class, in the order of operations of torchvision.

    ``ends`` are the ends of the classes in ``rows``.
    """
    zero = np.float32(0)
    begin = 0
    for end in ends:
        for k in range(begin, end):
            i = rows[k]
            if suppressor[i] >= 0:
                continue
            x0, y0, x1, y1 = boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3]
            area = (x1 - x0) * (y1 - y0)
            for m in range(k + 1, end):
                j = rows[m]
                if suppressor[j] >= 0:
                    continue
                width = max(zero, min(x1, boxes[j, 2]) - max(x0, boxes[j, 0]))
                height = max(zero, min(y1, boxes[j, 3]) - max(y0, boxes[j, 1]))
                shared = width * height
                other = (boxes[j, 2] - boxes[j, 0]) * (boxes[j, 3] - boxes[j, 1])
                value = shared / (area + other - shared)
                if value > threshold:
                    suppressor[j] = i
                    overlap[j] = value
        begin = end
