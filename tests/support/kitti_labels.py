"""Labelled objects of KITTI's frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bevviz.model import geometry
from bevviz.model.frame import F64
from tests.support import bags

CLASSES = {
    "Pedestrian": {"person"},
    "Cyclist": {"person", "bicycle"},
    "Car": {"car"},
    "Truck": {"truck", "car"},
}


def labels(shared: Path, name: str) -> list[tuple[str, F64]]:
    """Class of each labelled object, and its centre in the LiDAR's frame."""
    kitti = bags.kitti(shared, name)
    lidar_from_camera = geometry.inverse(kitti.camera_from_lidar)
    # Labels are in the rectified reference camera; image_2 is shifted from it by K^-1 of P2's last column.
    rows = (shared / "kitti/calib" / f"{name}.txt").read_text().splitlines()
    p2 = np.array(next(r for r in rows if r.startswith("P2:")).split()[1:], float).reshape(3, 4)
    shift = np.linalg.solve(p2[:, :3], p2[:, 3])
    found = []
    for line in (shared / "kitti/label_2" / f"{name}.txt").read_text().splitlines():
        kind, *numbers = line.split()
        if kind in CLASSES:
            values = np.array(numbers, float)
            height, bottom = values[7], values[10:13]
            centre = bottom + shift - [0, height / 2, 0]
            found.append((kind, (lidar_from_camera @ [*centre, 1])[:3]))
    return found
