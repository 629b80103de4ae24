"""A log of Argoverse 2 as its documents specify it, written with pyarrow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather

import bevviz
from bevviz.cli import main
from tests.support import datasets

START, STEP = 315_966_253_060_000_000, 100_000_000
STRAIGHT = {"qw": 1.0, "qx": 0.0, "qy": 0.0, "qz": 0.0}
CAMERA = {"qw": 0.5, "qx": -0.5, "qy": 0.5, "qz": -0.5}  # optical axis ahead


def write(path: Path, rows: list[dict[str, Any]], **kinds: pa.DataType) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    table = pa.Table.from_pylist(rows)
    for name, kind in kinds.items():
        place = table.column_names.index(name)
        table = table.set_column(place, name, table.column(name).cast(pa.float32()).cast(kind))
    feather.write_feather(table, str(path), compression="zstd")


def place(x: float, y: float, z: float) -> dict[str, float]:
    return {"tx_m": x, "ty_m": y, "tz_m": z}


@pytest.fixture
def log(tmp_path: Path) -> Path:
    root = tmp_path / "val" / "02678d04"
    stamps = [START + STEP * i for i in range(3)]
    for number, stamp in enumerate(stamps):
        points = datasets.scan(number)
        rows = [
            {"x": x, "y": y, "z": z, "intensity": int(255 * w), "laser_number": i % 64, "offset_ns": 1000 * i}
            for i, (x, y, z, w) in enumerate(points.tolist())
        ]
        write(root / f"sensors/lidar/{stamp}.feather", rows, x=pa.float16(), y=pa.float16(), z=pa.float16())
        datasets.image(root / f"sensors/cameras/ring_front_center/{stamp + 7_000_000}.jpg", 90)
    sensors = [
        {"sensor_name": "ring_front_center", **CAMERA, **place(1.6, 0.0, 1.4)},
        {"sensor_name": "up_lidar", **STRAIGHT, **place(1.3, 0.0, 1.6)},
    ]
    write(root / "calibration/egovehicle_SE3_sensor.feather", sensors)
    lens = {"fx_px": 72.0, "fy_px": 72.0, "cx_px": 61.0, "cy_px": 17.0, "k1": -0.2, "k2": 0.1, "k3": 0.05}
    lenses = [{"sensor_name": "ring_front_center", **lens, "height_px": 38, "width_px": 124}]
    write(root / "calibration/intrinsics.feather", lenses)
    poses = [{"timestamp_ns": stamp, **STRAIGHT, **place(i, 0, 0)} for i, stamp in enumerate(stamps)]
    write(root / "city_SE3_egovehicle.feather", poses)
    size = {"length_m": 4.0, "width_m": 1.6, "height_m": 1.5}
    labels = [
        {
            "timestamp_ns": stamps[1],
            "track_uuid": "a",
            "category": kind,
            **size,
            **STRAIGHT,
            **place(13, y, -0.9),
        }
        for kind, y in (("REGULAR_VEHICLE", 0), ("BOLLARD", 5))
    ]
    write(root / "annotations.feather", labels)
    return root


def test_a_log_has_its_sensors_poses_and_labels(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drive = bevviz.open(log.parent)
    assert len(drive) == 3 and drive.scene.cameras == ("ring_front_center",)
    frame = drive.raw(1)
    assert frame.stamp == START + STEP and frame.world_from_points is not None
    np.testing.assert_allclose(frame.world_from_points[:3, 3], [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(frame.points, datasets.scan(1)[:, :3], atol=0.02)  # half precision
    assert frame.fields["ring"].max() == 63
    np.testing.assert_allclose(frame.fields["time"][:2], [0, 1e-6], atol=1e-9)
    (camera,) = frame.cameras
    assert camera.intrinsics is not None and camera.camera_from_points is not None
    assert camera.intrinsics.D.tolist() == [-0.2, 0.1, 0, 0, 0.05]
    np.testing.assert_allclose(
        camera.camera_from_points @ [10, 0, 1.4, 1], [0, 0, 8.4 - 0.07 * 10, 1], atol=0.8
    )
    assert frame.truth is not None and frame.truth.labels == ("car", "bollard")
    np.testing.assert_allclose(frame.truth.boxes.center[0], [13, 0, -0.9])
    inside = np.abs(frame.points - frame.truth.boxes.center[0]) < frame.truth.boxes.size[0] / 2 + 0.02
    assert inside.all(axis=1).sum() == 200
    assert main(["info", str(log)]) == 0
    assert "ring_front_center: 124 x 38 image/jpeg" in capsys.readouterr().out


def test_a_damaged_log_names_the_file(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (log / "calibration/intrinsics.feather").write_bytes(b"no table")
    assert main(["info", str(log)]) == 2
    assert "intrinsics.feather: cannot be read as a Feather table" in capsys.readouterr().err
