"""Sets with the tables of nuScenes: Autoware's T4, as t4-devkit and its writers have it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bevviz
from tests.support import datasets


def rewrite(table: Path, change: Any) -> None:
    rows = json.loads(table.read_text())
    for row in rows:
        change(row)
    table.write_text(json.dumps(rows))


@pytest.mark.parametrize(
    ("distortion", "model"),
    [
        ([-0.3, 0.1, 0.001, 0.0, 0.0], "plumb_bob"),
        ([0.2, 0.1, 0.0, 0.0, 0.01, 0.5, 0.1, 0.02], "rational_polynomial"),
        ([0.0, 0.0, 0.0, 0.0, 0.0], ""),
        ([], ""),
    ],
)
def test_t4_has_distortion_and_categories_of_its_own(
    tmp_path: Path, distortion: list[float], model: str
) -> None:
    root = datasets.nuscenes(tmp_path / "t4")
    (tables,) = root.glob("v*")
    tables = tables.rename(root / "annotation")
    names = {"vehicle.car": "car", "animal": "animal"}
    rewrite(tables / "category.json", lambda row: row.update(name=names[row["name"]], index=None))
    rewrite(
        tables / "calibrated_sensor.json",
        lambda row: row.update(camera_distortion=distortion if row["camera_intrinsic"] else []),
    )
    with bevviz.open(root, set={"source.sequence": "scene-0061"}) as drive:
        frame = next(iter(drive.frames))
        assert frame.truth is not None and frame.truth.labels == ("car",)
        (camera,) = frame.cameras
        assert camera.intrinsics is not None
        assert camera.intrinsics.distortion_model == model
        np.testing.assert_array_equal(camera.intrinsics.D, distortion if model else [])
