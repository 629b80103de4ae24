"""Clusters: boxes and coloured points of those within the size limits, boxes of the others."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import rerun as rr

from bevviz.config import ClusteringConfig
from bevviz.frame import F32, Clusters, ClusterState, Frame, Tracks
from bevviz.logging import entities, tracks
from bevviz.logging.pieces import OUTLINE, boxes3d
from bevviz.logging.writer import Writer


def log_clusters_looks(to: Writer, lidars: Iterable[str]) -> None:
    for lidar in lidars:
        to.static(
            entities.clusters(lidar),
            rr.Points3D.from_fields(radii=rr.Radius.ui_points(2.0), show_labels=False),
            rr.Boxes3D.from_fields(radii=rr.Radius.ui_points(1.0), fill_mode=OUTLINE),
        )
        to.static(entities.set_aside(lidar), rr.Boxes3D.from_fields(show_labels=False))


def log_clusters(
    to: Writer,
    frame: Frame,
    clusters: Clusters,
    tracked: Tracks | None,
    obstacles: F32,
    config: ClusteringConfig,
) -> None:
    """In the colours of their tracks. ``obstacles``: (P, 3), as of ``clusters.labels``."""
    boxes = clusters.boxes(config)
    colors = tracks.class_ids(tracks.of_clusters(tracked, len(clusters)))
    is_kept = clusters.kept
    kept, others = np.flatnonzero(is_kept), np.flatnonzero(~is_kept)
    if len(kept):
        member = np.append(is_kept, False).take(clusters.labels)  # -1 is noise
        to.put(
            entities.clusters(frame.lidar),
            rr.Points3D(
                obstacles.compress(member, axis=0),
                class_ids=colors.take(clusters.labels.compress(member)),
            ),
            boxes3d(boxes, kept, [f"{k}" for k in kept], class_ids=colors[kept]),
        )
    if len(others):
        states = [ClusterState(s) for s in clusters.state[others].tolist()]
        to.put(
            entities.set_aside(frame.lidar),
            boxes3d(
                boxes,
                others,
                [f"{k}: {n} points" for k, n in zip(others, clusters.count[others], strict=True)],
                class_ids=[entities.CLUSTER_CLASS[s] for s in states],
            ),
        )
