"""Clusters: boxes and coloured points of those within the size limits, boxes of the others."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from bevviz.config import ClusteringConfig
from bevviz.frame import F32, I32, I64, Bool, Frame
from bevviz.logging import entities, keep, tracks
from bevviz.logging.cloud import coarse
from bevviz.logging.pieces import OUTLINE, boxes3d
from bevviz.logging.writer import Writer
from bevviz.results import Clusters, ClusterState, Tracks


def log_clusters_looks(to: Writer, lidars: Iterable[str]) -> None:
    for lidar in lidars:
        to.static(
            entities.clusters(lidar),
            rr.Points3D.from_fields(radii=rr.Radius.ui_points(2.0), show_labels=False),
            rr.Boxes3D.from_fields(radii=rr.Radius.ui_points(1.0), fill_mode=OUTLINE, show_labels=False),
        )
        to.static(entities.set_aside(lidar), rr.Boxes3D.from_fields(show_labels=False))


def log_clusters(
    to: Writer,
    frame: Frame,
    clusters: Clusters,
    tracked: Tracks | None,
    obstacles: F32,
    config: ClusteringConfig,
    colored: bool = True,
    packed: float | None = None,
) -> None:
    """In the colours of their tracks. ``obstacles``: (P, 3), as of ``clusters.labels``.

    Without colours, they are for ``log_cluster_colors`` to log. ``packed``: cluster by cluster, rounded to so
    many steps in a metre (0: not), as where less is kept.
    """
    boxes = clusters.boxes(config)
    kept, others = np.flatnonzero(clusters.kept), np.flatnonzero(~clusters.kept)
    if len(kept):
        member = in_kept(clusters)
        points, labels = obstacles.compress(member, axis=0), clusters.labels.compress(member)
        if packed is not None:
            rows = keep.sorted_rows(points, packed, labels)
            points, labels = coarse(points.take(rows, axis=0), packed), labels.take(rows)
        of_points, of_boxes = _colors(clusters, tracked, labels, kept) if colored else (None, None)
        to.put(
            entities.clusters(frame.lidar),
            rr.Points3D(points, class_ids=of_points),
            boxes3d(boxes, kept, [f"{k}" for k in kept], class_ids=of_boxes),
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


def log_cluster_colors(
    to: Writer, frame: Frame, clusters: Clusters, tracked: Tracks | None, *, packed: bool = False
) -> None:
    """Of a frame that ``log_clusters`` logged without."""
    kept = np.flatnonzero(clusters.kept)
    if len(kept):
        labels = clusters.labels.compress(in_kept(clusters))
        of_points, of_boxes = _colors(clusters, tracked, np.sort(labels) if packed else labels, kept)
        to.write(
            entities.clusters(frame.lidar),
            rr.Points3D.from_fields(class_ids=of_points),
            rr.Boxes3D.from_fields(class_ids=of_boxes),
        )


def in_kept(clusters: Clusters) -> Bool:
    """(P,) obstacle points of the clusters that were kept."""
    return np.append(clusters.kept, False).take(clusters.labels)  # -1 is noise


def _colors(
    clusters: Clusters, tracked: Tracks | None, labels: I32, kept: I64
) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
    """Class ids of points of these clusters, and of the boxes of the clusters that were kept."""
    colors = tracks.class_ids(tracks.of_clusters(tracked, len(clusters)))
    return colors.take(labels), colors[kept]
