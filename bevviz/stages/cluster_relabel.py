"""Relabel clusters after detections claimed some of their points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bevviz.config import ClusteringConfig
from bevviz.model.frame import F32, I32, I64
from bevviz.model.results import Clusters, Splits
from bevviz.stages.clustering import update_clusters


@dataclass(slots=True)
class ClaimedPoints:
    """Points that one detection claimed.

    Attributes:
        camera: row of the camera.
        detection: row of the detection among the detections of the camera.
        rows: rows of the points.
    """

    camera: int
    detection: int
    rows: I64


def relabel_claimed(
    points: F32, clusters: Clusters, parts: list[ClaimedPoints], cameras: list[str], config: ClusteringConfig
) -> tuple[Clusters, I32, Splits]:
    """Make each part a cluster of its own.

    Returns:
        The new clusters.
        The cluster row of each part, with -1 appended.
        The splits: which clusters lost how many points to which detection.
    """
    before, fresh = len(clusters), 0
    origins = []
    for part in parts:
        counts = np.bincount(clusters.labels[part.rows] + 1)
        sources = np.flatnonzero(counts)
        origins.append((sources - 1, counts[sources]))
    remaining = clusters.count.astype(np.int64)
    for sources, counts in origins:
        known = sources >= 0
        remaining[sources[known]] -= counts[known]
    unchanged, alive = remaining == clusters.count, remaining > 0
    number = np.empty(len(parts), np.int64)
    moves: list[tuple[int, int, int]] = []  # part, source cluster, points
    for j, (sources, counts) in enumerate(origins):
        pairs = list(zip(sources.tolist(), counts.tolist(), strict=True))
        whole = [(n, k) for k, n in pairs if k >= 0 and n == clusters.count[k]]
        if whole:  # A part that holds all points of a cluster keeps the number of the cluster.
            number[j] = max(whole)[1]
            alive[number[j]] = True
            unchanged[number[j]] = len(pairs) == 1
        else:
            number[j] = before + fresh
            fresh += 1
        if not whole or len(pairs) > 1:
            moves += [(j, k, n) for k, n in pairs]
    if not moves:
        return clusters, np.append(number, -1).astype(np.int32), Splits.none()

    labels = clusters.labels.copy()
    for part, k in zip(parts, number.tolist(), strict=True):
        labels[part.rows] = k
    alive = np.concatenate([alive, np.ones(fresh, np.bool_)])
    row = np.append(np.where(alive, np.cumsum(alive) - 1, -1), -1).astype(np.int32)
    if not alive.all():
        labels = row[labels]
    kept = np.concatenate([np.where(unchanged, np.arange(before), -1), np.full(fresh, -1)])[alive]
    rows = np.append(row[number], -1).astype(np.int32)
    now = update_clusters(points, labels, clusters, kept, rows[:-1], config)
    part_of, source, moved_points = np.array(moves, np.int32).T
    was_noise = source < 0
    return (
        now,
        rows,
        Splits(
            camera=tuple(cameras[parts[j].camera] for j in part_of),
            detection=np.array([parts[j].detection for j in part_of], np.int32),
            cluster=rows[part_of],
            rest=np.where(~was_noise & (np.append(remaining, 0)[source] > 0), row[source], -1).astype(
                np.int32
            ),
            is_noise=was_noise,
            points=moved_points,
            of=np.where(was_noise, moved_points, np.append(clusters.count, 0)[source]).astype(np.int32),
        ),
    )
