"""Faults planted in the sensors of a real drive: each is told by its name, within 0.3 s of its beginning."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import bevviz
from bevviz.anomalies import AnomalyDetector
from bevviz.anomalies.sensor_faults import ImageWatch
from bevviz.config import AnomaliesConfig
from bevviz.model import geometry
from bevviz.model.frame import F32, F64, U8, Camera, Image
from bevviz.model.results import Anomaly, FrameResult

FIRST, LAST = 8, 18  # frames with the fault
CAMERA, LIDAR = "camera image_2", "LiDAR velodyne"

Results = Sequence[FrameResult]


@pytest.fixture(scope="module")
def drive(shared: Path) -> Results:
    """Results of a real drive without a detector."""
    with bevviz.open(shared / "kitti_drive") as opened:
        session = opened.new_session()
        return [session.perceive(frame) for frame in opened.frames]


def pixels(result: FrameResult) -> U8:
    image = result.frame.cameras[0].image
    assert image is not None
    return image.bgr


def with_camera(result: FrameResult, camera: Camera) -> FrameResult:
    return replace(result, frame=replace(result.frame, cameras=(camera,)))


def with_image(result: FrameResult, bgr: U8) -> FrameResult:
    camera = result.frame.cameras[0]
    assert camera.image is not None
    return with_camera(result, replace(camera, image=replace(camera.image, bgr=bgr)))


def with_scan(result: FrameResult, xyz: F32) -> FrameResult:
    frame = result.frame
    cloud = replace(frame.clouds[0], xyz=xyz, fields={})
    return replace(result, frame=replace(frame, points=xyz, fields={}, clouds=(cloud,)))


def rotation(axis: int, degrees: float) -> F64:
    """(4, 4) rotation about x, y or z."""
    vector = np.zeros(3)
    vector[axis] = np.radians(degrees)
    turned = np.eye(4)
    turned[:3, :3] = cv2.Rodrigues(vector)[0]
    return turned


def turned_camera(result: FrameResult, axis: int, degrees: float) -> FrameResult:
    intrinsics, bgr = result.frame.cameras[0].intrinsics, pixels(result)
    assert intrinsics is not None
    homography = intrinsics.K @ rotation(axis, degrees)[:3, :3] @ np.linalg.inv(intrinsics.K)
    size = bgr.shape[1], bgr.shape[0]
    return with_image(result, np.asarray(cv2.warpPerspective(bgr, homography, size), np.uint8))


def turned_lidar(result: FrameResult, axis: int, degrees: float) -> FrameResult:
    turn, voxels = rotation(axis, degrees), result.voxels
    assert voxels is not None
    voxels = replace(voxels, points=geometry.apply(turn, voxels.points))
    return replace(with_scan(result, geometry.apply(turn, result.frame.points)), voxels=voxels)


def turned_transform(result: FrameResult, axis: int, degrees: float) -> FrameResult:
    camera = result.frame.cameras[0]
    assert camera.camera_from_points is not None
    return with_camera(
        result, replace(camera, camera_from_points=rotation(axis, degrees) @ camera.camera_from_points)
    )


def blocked_sector(result: FrameResult) -> FrameResult:
    xyz = result.frame.points
    azimuth = np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0]))
    return with_scan(result, xyz[(azimuth < -48) | (azimuth > -13)])


def faults(results: Results, plant: Callable[[int], FrameResult]) -> dict[str, tuple[int, Anomaly]]:
    """Return the faults of sensors by subject, with the number of the frame that tells them first."""
    detector, told = AnomalyDetector(), dict[str, tuple[int, Anomaly]]()
    for row, result in enumerate(results):
        planted = plant(row) if FIRST <= row < LAST else result
        for anomaly in detector.update(planted, AnomaliesConfig()):
            if anomaly.kind == "sensor":
                told.setdefault(anomaly.subject, (row, anomaly))
    return told


def test_clean_real_drive_has_no_sensor_fault(drive: Results) -> None:
    assert faults(drive, lambda row: drive[row]) == {}


@pytest.mark.parametrize(
    ("subject", "within", "plant"),
    [
        (f"{CAMERA}: black image", 0, lambda d, i: with_image(d[i], np.zeros_like(pixels(d[i])))),
        (f"{CAMERA}: dark image", 0, lambda d, i: with_image(d[i], pixels(d[i]) // 8)),
        (f"{CAMERA}: white image", 0, lambda d, i: with_image(d[i], pixels(d[i]) // 64 + 250)),
        (f"{CAMERA}: blank image", 0, lambda d, i: with_image(d[i], pixels(d[i]) // 16 + 90)),
        (f"{CAMERA}: frozen image", 2, lambda d, i: with_image(d[i], pixels(d[FIRST]).copy())),
        (f"{CAMERA}: late image", 1, lambda d, i: with_image(d[i], pixels(d[i - 1]).copy())),
        (f"{LIDAR}: blocked sector", 2, lambda d, i: blocked_sector(d[i])),
        (f"{LIDAR}: returns lost", 2, lambda d, i: with_scan(d[i], d[i].frame.points[:2000])),
        (f"{LIDAR}: frozen scan", 2, lambda d, i: with_scan(d[i], d[FIRST].frame.points.copy())),
        (f"{CAMERA}: transform from {LIDAR} jumped", 0, lambda d, i: turned_transform(d[i], 1, 3)),
    ],
    ids=lambda value: value.split(": ")[1].replace(" ", "_") if isinstance(value, str) else "",
)
def test_planted_fault_is_told_by_name(
    drive: Results, subject: str, within: int, plant: Callable[[Results, int], FrameResult]
) -> None:
    told = faults(drive, lambda row: plant(drive, row))
    assert list(told) == [subject]
    row, anomaly = told[subject]
    assert row <= FIRST + within
    assert anomaly.severity == "ERROR"
    began = 0.7 if subject.endswith("late image") else 0.8
    assert anomaly.text.startswith(f"{subject} since {began} s")


@pytest.mark.parametrize("degrees", [3.0, -3.0])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(("sensor", "plant"), [(CAMERA, turned_camera), (LIDAR, turned_lidar)])
def test_turned_sensor_is_told_by_name(
    drive: Results,
    sensor: str,
    plant: Callable[[FrameResult, int, float], FrameResult],
    axis: int,
    degrees: float,
) -> None:
    told = faults(drive, lambda row: plant(drive[row], axis, degrees))
    assert list(told) == [f"{sensor}: turned in its mounting"]
    row, anomaly = told[f"{sensor}: turned in its mounting"]
    assert row == FIRST + 1
    assert float(anomaly.text.partition("by ")[2].partition(" degrees")[0]) == pytest.approx(3, abs=0.3)


def test_sensor_fault_ends_with_its_cause(drive: Results) -> None:
    detector, hold = AnomalyDetector(), AnomaliesConfig(hold=0.0)
    last = [
        list(detector.update(turned_camera(r, 1, 3) if FIRST <= i < LAST else r, hold))
        for i, r in enumerate(drive)
    ]
    assert [bool(frame) for frame in last[FIRST + 1 : LAST]] == [True] * (LAST - FIRST - 1)
    assert not any(last[LAST + 1 :])


def test_image_shared_by_two_frames_is_not_frozen() -> None:
    watch, noise = ImageWatch("camera"), np.random.default_rng(1)
    for stamp in range(10):
        image = Image(stamp // 2, "camera", noise.integers(0, 255, (48, 64, 3), np.uint8))
        assert watch.update(image) == ()
