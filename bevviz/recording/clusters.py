"""Log clusters: boxes and coloured points of kept clusters, boxes of clusters outside the size limits."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from bevviz.config import ClusteringConfig
from bevviz.model.frame import F32, I32, I64, Bool, Frame
from bevviz.model.results import Clusters, ClusterState, Tracks
from bevviz.recording import entities, retention, tracks
from bevviz.recording.cloud import round_points
from bevviz.recording.primitives import OUTLINE, boxes3d
from bevviz.recording.writer import Writer


def log_cluster_style(to: Writer, lidars: Iterable[str]) -> None:
    """Log the static style of the clusters of each LiDAR."""
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
    packed: float | None = None,
) -> None:
    """Log clusters in the colours of their tracks.

    Args:
        to: writer of the recording.
        frame: frame of the clusters.
        clusters: all clusters of the frame.
        tracked: tracks that give the colours; None: there are no tracks.
        obstacles: (P, 3) points, in the order of ``clusters.labels``.
        config: parameters of the clustering.
        packed: steps per metre to which points are rounded (0: no rounding). Points are also sorted by
            cluster. None: points are logged unchanged.
    """
    boxes = clusters.boxes(config)
    kept, others = np.flatnonzero(clusters.kept), np.flatnonzero(~clusters.kept)
    if len(kept):
        member = in_kept_clusters(clusters)
        points, labels = obstacles.compress(member, axis=0), clusters.labels.compress(member)
        if packed is not None:
            rows = retention.sorted_rows(points, packed, labels)
            points, labels = round_points(points.take(rows, axis=0), packed), labels.take(rows)
        point_ids, box_ids = _colors(clusters, tracked, labels, kept)
        to.put(
            entities.clusters(frame.lidar),
            rr.Points3D(points, class_ids=point_ids),
            boxes3d(boxes, kept, [f"{row}" for row in kept], class_ids=box_ids),
        )
    if len(others):
        states = [ClusterState(state) for state in clusters.state[others].tolist()]
        to.put(
            entities.set_aside(frame.lidar),
            boxes3d(
                boxes,
                others,
                [f"{row}: {count} points" for row, count in zip(others, clusters.count[others], strict=True)],
                class_ids=[entities.CLUSTER_CLASS[state] for state in states],
            ),
        )


def in_kept_clusters(clusters: Clusters) -> Bool:
    """Return the (P,) mask of obstacle points in kept clusters."""
    return np.append(clusters.kept, False).take(clusters.labels)  # the label -1 is noise


def _colors(
    clusters: Clusters, tracked: Tracks | None, labels: I32, kept: I64
) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
    """Return class ids of the points with these labels, and of the boxes of the kept clusters."""
    colors = tracks.class_ids(tracks.track_ids_of_clusters(tracked, len(clusters)))
    return colors.take(labels), colors[kept]
