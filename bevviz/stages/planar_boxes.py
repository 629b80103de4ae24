"""Boxes of whole objects around clusters of scans of one plane, which show one or two sides."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from bevviz.model.frame import F32, F64, Boxes3D
from bevviz.model.results import Clusters, Objects
from bevviz.stages.frustum_points import fit_from

LONG = 1.2  # metres, least length of a class whose hidden sides matter
PLACE, EDGES = np.zeros(2), np.full(2, 0.15)  # metres, one sigma of an object's left and right outline


def whole_boxes(
    objects: Objects, points: F32, clusters: Clusters, sizes: Mapping[str, tuple[float, ...] | None]
) -> Objects:
    """Return the objects with boxes of the size of their class behind the sides that the scan shows.

    Args:
        objects: objects of whole clusters.
        points: points of the clusters.
        clusters: all clusters.
        sizes: sizes of the classes, see ``objects.sizes``.
    """
    center, size, yaw = (
        values.copy() for values in (objects.boxes.center, objects.boxes.size, objects.boxes.yaw)
    )
    for row, (name, cluster) in enumerate(zip(objects.names, objects.cluster.tolist(), strict=True)):
        stated = sizes.get(name.lower())
        if stated is None or stated[0] < LONG:
            continue
        rows = np.flatnonzero(clusters.labels == cluster)
        modes = np.reshape(stated, (-1, 6))
        bounds = np.log(modes[:, 3:]).sum(axis=1)
        order = np.argsort(bounds, kind="stable")
        normals, free = _outline(points[rows]), np.nan
        flat, _, _ = fit_from(points, rows, PLACE, normals, EDGES, modes[order], bounds[order], free, free)
        center[row, :2], size[row, :2], yaw[row] = flat[:2], flat[2:4], flat[4]
    return replace(objects, boxes=Boxes3D(center, np.asarray(size, np.float32), np.asarray(yaw, np.float32)))


def _outline(points: F32) -> F64:
    """Return the (2, 2) outward normals of the planes through the sensor and the outermost points."""
    middle = np.arctan2(points[:, 1].mean(), points[:, 0].mean())
    angle = np.arctan2(points[:, 1], points[:, 0]) - middle
    angle = (angle + np.pi) % (2 * np.pi) - np.pi
    left, right = middle + angle.max(), middle + angle.min()
    return np.array([[-np.sin(left), np.cos(left)], [np.sin(right), -np.cos(right)]], np.float64)
