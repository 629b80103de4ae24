"""What the tutorial's nodes call for each frame: the reference that bevviz is timed against."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bevviz.extras.demo.sensors import load_open3d
from bevviz.model.results import Objects


def read_points(message: Any) -> Iterator[tuple[float, float, float]]:
    """x, y, z of each point of a PointCloud2, one at a time, NaN and infinite ones dropped."""
    offsets = {field.name: field.offset for field in message.fields}
    x, y, z = (offsets[name] for name in "xyz")
    data = bytes(message.data)
    unpack = struct.Struct("<f").unpack_from
    for start in range(0, len(data), message.point_step):
        point = (unpack(data, start + x)[0], unpack(data, start + y)[0], unpack(data, start + z)[0])
        if all(math.isfinite(value) for value in point):
            yield point


def decode(message: Any) -> NDArray[np.float32]:
    """(N, 3) float32 points through the generator."""
    flat = (value for point in read_points(message) for value in point)
    return np.fromiter(flat, np.float32).reshape(-1, 3)


class Stages:
    """The Open3D calls of lidar_cluster_node with its default parameters."""

    def __init__(self) -> None:
        self.o3d = load_open3d()

    def voxel(self, points: NDArray[np.float32]) -> Any:
        return self.cloud(points).voxel_down_sample(0.05)

    def ground(self, cloud: Any) -> Any:
        _, inliers = cloud.segment_plane(0.5, 3, 100)
        return cloud.select_by_index(inliers, invert=True)

    def clustering(self, cloud: Any) -> list[Any]:
        labels = self.labels(cloud)
        return [
            cloud.select_by_index(np.flatnonzero(labels == label)).get_axis_aligned_bounding_box()
            for label in range(labels.max(initial=-1) + 1)
        ]

    def cloud(self, points: NDArray[np.float32]) -> Any:
        vector = self.o3d.utility.Vector3dVector(points.astype(np.float64))
        return self.o3d.geometry.PointCloud(vector)

    def labels(self, cloud: Any) -> NDArray[np.int32]:
        return np.asarray(cloud.cluster_dbscan(0.5, 50), np.int32)


def bev(points: NDArray[np.float32], objects: Objects | None) -> NDArray[np.uint8]:
    """Draw the image of bev_visualizer_node with its default parameters."""
    range_x, range_y, resolution = 10.0, 10.0, 0.05
    width, height = int(2 * range_y / resolution), int(2 * range_x / resolution)
    image = np.zeros((height, width, 3), np.uint8)
    mask = (np.abs(points[:, 0]) < range_x) & (np.abs(points[:, 1]) < range_y)
    inside = points[mask]
    u = ((range_y - inside[:, 1]) / resolution).astype(int)
    v = ((range_x - inside[:, 0]) / resolution).astype(int)
    valid = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    image[v[valid], u[valid]] = (200, 200, 200)
    if objects is not None:
        for name, (x, y, _), (length, breadth, _) in zip(
            objects.names, objects.boxes.center, objects.boxes.size, strict=True
        ):
            u, v = math.floor((range_y - y) / resolution), math.floor((range_x - x) / resolution)
            w, h = int(breadth / resolution) // 2, int(length / resolution) // 2
            cv2.rectangle(image, (u - w, v - h), (u + w, v + h), (0, 0, 255), 2)
            font = cv2.FONT_HERSHEY_SIMPLEX
            cv2.putText(image, f"ID:{name}", (u - w, v - h - 5), font, 0.4, (0, 255, 0), 1)
    return image
