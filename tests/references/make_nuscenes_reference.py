"""Write what nuscenes-devkit reads from the folder of ``tests/support/datasets.py``.

Needs an environment with nuscenes-devkit 1.2.0 (and its older NumPy), not that of bevviz::

    python -c "from pathlib import Path; from tests.support import datasets; datasets.nuscenes(Path('made'))"
    cd tests/references
    DEVKIT/bin/python make_nuscenes_reference.py ../../made metrics/nuscenes_devkit.json
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np


def pose(row: dict[str, Any]) -> Any:
    """(4, 4) of a record."""
    from pyquaternion import Quaternion

    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Quaternion(row["rotation"]).rotation_matrix, row["translation"]
    return matrix


def make(root: str) -> dict[str, Any]:
    """By stamp: some points of the scan in the map and in the camera, and the boxes of its classes."""
    from nuscenes.eval.detection.utils import category_to_detection_name  # type: ignore[import-not-found]
    from nuscenes.nuscenes import NuScenes  # type: ignore[import-not-found]
    from nuscenes.utils.data_classes import LidarPointCloud  # type: ignore[import-not-found]

    tables, found = NuScenes("v1.0-mini", root, verbose=False), {}

    def world(row: dict[str, Any]) -> Any:
        mounting = tables.get("calibrated_sensor", row["calibrated_sensor_token"])
        return pose(tables.get("ego_pose", row["ego_pose_token"])) @ pose(mounting)

    for scan in tables.sample_data:
        if scan["channel"] != "LIDAR_TOP" or not scan["token"].startswith("LIDAR_TOP-0-"):
            continue
        points = LidarPointCloud.from_file(str(Path(root, scan["filename"]))).points[:, ::40][:, :5]
        there = world(scan) @ np.vstack([points[:3], np.ones(points.shape[1])])
        image = tables.get("sample_data", scan["token"].replace("LIDAR_TOP", "CAM_FRONT"))
        seen = np.linalg.inv(world(image)) @ there
        boxes = [
            {
                "name": category_to_detection_name(box.name),
                "corners": box.corners().T.round(6).tolist(),
                "instance": tables.get("sample_annotation", box.token)["instance_token"],
            }
            for box in (tables.get_boxes(scan["token"]) if scan["is_key_frame"] else ())
            if category_to_detection_name(box.name)
        ]
        found[str(scan["timestamp"])] = {
            "map": there[:3].T.round(6).tolist(),
            "camera": seen[:3].T.round(6).tolist(),
            "boxes": boxes,
        }
    return found


if __name__ == "__main__":
    Path(sys.argv[2]).write_text(json.dumps(make(sys.argv[1])) + "\n")
