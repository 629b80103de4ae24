"""Gives each cluster a number that it keeps for as long as it is seen, so that it keeps its colour."""

from __future__ import annotations

import numpy as np

from bevviz.frame import F32, I64


class Tracks:
    """Nearest neighbours between two frames, mutual and within a gate. For colours, not for tracking.

    Args:
        gate: metres that a centroid may move from one frame to the next.
    """

    def __init__(self, gate: float = 1.5) -> None:
        self._gate = gate
        self._centroids: F32 = np.zeros((0, 3), np.float32)
        self._ids: I64 = np.zeros(0, np.int64)
        self._next = 0

    def update(self, centroids: F32) -> I64:
        """(K,) numbers of the clusters with these (K, 3) centroids, which are in the fixed frame."""
        ids = np.full(len(centroids), -1, np.int64)
        if len(centroids) and len(self._centroids):
            squared = ((centroids[:, None] - self._centroids[None]) ** 2).sum(2)
            before, now = squared.argmin(1), squared.argmin(0)
            rows = np.arange(len(centroids))
            same = (now[before] == rows) & (squared[rows, before] < self._gate**2)
            ids[same] = self._ids[before[same]]
        new = ids < 0
        ids[new] = self._next + np.arange(new.sum())
        self._next += int(new.sum())
        self._centroids, self._ids = centroids, ids
        return ids
