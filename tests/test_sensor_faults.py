"""Faults planted in the sensors of a real drive: each is told by its name, within 0.3 s of its beginning."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import bevviz
from bevviz.anomalies import AnomalyDetector
from bevviz.anomalies.calibration_drift import LEAST_PAST, PlacementWatch, find_error, score_rotations
from bevviz.anomalies.mounting_changes import MountingWatch
from bevviz.anomalies.sensor_faults import ImageWatch, RegionWatch
from bevviz.anomalies.sensors import SensorWatch
from bevviz.config import AnomaliesConfig
from bevviz.model.frame import Camera, Image, Intrinsics
from bevviz.model.results import Anomaly, FrameResult
from tests.support.sensor_plants import (
    Results,
    blocked_sector,
    covered,
    defocused,
    jittered,
    muddy,
    noisy,
    pixels,
    recompressed,
    thinned,
    turned_camera,
    turned_lidar,
    turned_transform,
    with_image,
    with_scan,
    without_far_returns,
    without_image,
)

FIRST, LAST = 8, 18  # frames with the fault
CAMERA, LIDAR = "camera image_2", "LiDAR velodyne"


@pytest.fixture(scope="module")
def drive(shared: Path) -> Results:
    """Results of a real drive without a detector."""
    with bevviz.open(shared / "kitti_drive") as opened:
        session = opened.new_session()
        return [session.perceive(frame) for frame in opened.frames]


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


@pytest.mark.long
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
        (f"{CAMERA}: frozen image", 2, lambda d, i: with_image(d[i], recompressed(pixels(d[FIRST]), 60 + i))),
        (f"{CAMERA}: frozen image", 2, lambda d, i: with_image(d[i], noisy(pixels(d[FIRST]), 0.7, i))),
        (f"{CAMERA}: late image", 1, lambda d, i: with_image(d[i], recompressed(pixels(d[i - 1]), 80))),
        (f"{CAMERA}: covered lens", 3, lambda d, i: with_image(d[i], covered(pixels(d[i])))),
        (f"{CAMERA}: covered lens", 3, lambda d, i: with_image(d[i], muddy(pixels(d[i]), 3))),
        (f"{CAMERA}: blurred image", 3, lambda d, i: with_image(d[i], defocused(pixels(d[i])))),
        (f"{LIDAR}: far returns lost", 2, lambda d, i: without_far_returns(d[i])),
        (f"{LIDAR}: fewer returns", 2, lambda d, i: thinned(d[i], 0.5, i)),
        (f"{LIDAR}: blocked sector", 2, lambda d, i: blocked_sector(d[i], 0.05)),
        (f"{LIDAR}: frozen scan", 2, lambda d, i: jittered(d[i], d[FIRST].frame.points, i)),
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


def test_images_are_late_after_a_missing_one(drive: Results) -> None:
    def plant(row: int) -> FrameResult:
        late = with_image(drive[row], pixels(drive[row - 1]).copy())
        return without_image(late) if row == FIRST else late

    told = faults(drive, plant)
    assert list(told) == [f"{CAMERA}: late image"]
    row, anomaly = told[f"{CAMERA}: late image"]
    assert row == FIRST + 1 and anomaly.text.endswith(
        "an image is missing, and those after it may be late by one"
    )


def test_a_camera_that_swings_is_not_covered(drive: Results) -> None:
    """It looks at the sky once in 1.7 s; before that it has not seen all that is usual."""
    watch = RegionWatch(CAMERA)
    for row, result in enumerate(drive):
        image = pixels(result)
        room = np.array(image.shape[:2]) - (250, 400)
        top, left = (room / 2 * (1 + np.sin(np.array([3.7, 2.7]) * row / 10))).astype(int)
        gray = cv2.cvtColor(image[top : top + 250, left : left + 400], cv2.COLOR_BGR2GRAY)
        assert list(watch.update(row * 100_000_000, np.asarray(gray, np.uint8))) == []


def test_a_cover_is_named_with_its_place(drive: Results) -> None:
    told = faults(drive, lambda row: with_image(drive[row], covered(pixels(drive[row]))))
    assert ", left part: " in told[f"{CAMERA}: covered lens"][1].text


def test_returns_that_fade_are_told(drive: Results) -> None:
    """3 % of the returns are lost with each frame from the eighth on."""
    detector, told = AnomalyDetector(), list[tuple[int, Anomaly]]()
    for row, result in enumerate(drive):
        faded = thinned(result, 1 - 0.03 * max(row - FIRST, 0), row)
        told += [(row, anomaly) for anomaly in detector.update(faded, AnomaliesConfig())]
    assert {anomaly.subject for _, anomaly in told} == {f"{LIDAR}: fewer returns"}
    assert told[0][0] <= FIRST + 16


@pytest.mark.long
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


def test_runs_that_share_a_watch_tell_the_same(drive: Results) -> None:
    """A frozen image would begin at the second run of each frame if that were another frame."""
    watch, hold = SensorWatch(), AnomaliesConfig(hold=0.0)
    first, second = AnomalyDetector(watch), AnomalyDetector(watch)
    told = []
    for i, result in enumerate(drive):
        planted = with_image(result, pixels(drive[FIRST]).copy()) if FIRST <= i < LAST else result
        anomalies = [[one.text for one in side.update(planted, hold)] for side in (first, second)]
        assert anomalies[0] == anomalies[1]
        told.append(bool(anomalies[0]))
    assert not any(told[: FIRST + 1]) and all(told[FIRST + 2 : LAST])


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


# --- calibrations that are wrong from the first frame on ---------------------------------------


MISPLACED = f"{CAMERA}: not where its transform says"


def drifts(results: Results, degrees: Callable[[int], float], axis: int) -> dict[str, tuple[int, Anomaly]]:
    """Return the faults of a drive whose stated transform is off by ``degrees`` of each frame."""
    detector, seen = AnomalyDetector(), dict[str, tuple[int, Anomaly]]()
    for row, result in enumerate(results):
        wrong = turned_transform(result, axis, degrees(row))
        for anomaly in detector.update(wrong, AnomaliesConfig()):
            if anomaly.kind == "sensor":
                seen.setdefault(anomaly.subject, (row, anomaly))
    return seen


@pytest.mark.long
@pytest.mark.parametrize("degrees", [3.0, -3.0])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_transform_that_was_always_wrong_is_told(drive: Results, axis: int, degrees: float) -> None:
    seen = drifts(drive, lambda row: degrees, axis)
    assert list(seen) == [MISPLACED]
    row, anomaly = seen[MISPLACED]
    assert row <= 24
    assert anomaly.text == f"{MISPLACED} since 0.0 s, by about 3 degrees against {LIDAR}"


@pytest.mark.long
@pytest.mark.parametrize(("flip", "name"), [(-1, "image upside down"), (1, "mirrored image")])
def test_flipped_image_is_told(drive: Results, flip: int, name: str) -> None:
    faults_now = []
    with ThreadPoolExecutor(1) as worker:
        watch = PlacementWatch(worker)
        for result in drive[:-4]:
            frame = with_image(result, np.asarray(cv2.flip(pixels(result), flip), np.uint8)).frame
            faults_now = list(watch.update(frame, frame.clouds, ()))
        assert not faults_now
        frame = with_image(drive[-1], np.asarray(cv2.flip(pixels(drive[-1]), flip), np.uint8)).frame
        faults_now = list(watch.update(frame, frame.clouds, ()))
    assert [(fault.sensor, fault.name) for fault in faults_now] == [(CAMERA, name)]


@pytest.mark.long
@pytest.mark.parametrize(
    ("is_raw", "stated_raw", "name"),
    [
        (False, True, "distortion is corrected twice"),
        (True, False, "distortion is not corrected"),
        (True, True, ""),
        (False, False, ""),
    ],
)
def test_distortion_that_is_not_the_stated_one_is_told(
    drive: Results, is_raw: bool, stated_raw: bool, name: str
) -> None:
    """The images of KITTI are rectified. The coefficients are those of its raw images."""
    D = np.array([-0.3728755, 0.2037299, 0.002219027, 0.001383707, -0.07233722])
    faults_now = []
    with ThreadPoolExecutor(1) as worker:
        watch = PlacementWatch(worker)
        for result in (*drive[:-4], drive[-1]):
            (camera,) = result.frame.cameras
            assert camera.intrinsics is not None
            K, bgr = camera.intrinsics.K, pixels(result)
            if is_raw:
                v, u = np.mgrid[: bgr.shape[0], : bgr.shape[1]].astype(np.float32)
                pixel = np.stack([u, v], -1).reshape(-1, 1, 2)
                x, y = cv2.undistortPoints(pixel, K, D, P=K).reshape(*bgr.shape[:2], 2).transpose(2, 0, 1)
                bgr = np.asarray(cv2.remap(bgr, x.copy(), y.copy(), cv2.INTER_LINEAR), np.uint8)
            raw = replace(camera.intrinsics, distortion_model="plumb_bob", D=D)
            stated = raw if stated_raw else replace(camera.intrinsics, raw=raw)
            frame = with_image(result, bgr).frame
            frame = replace(frame, cameras=(replace(frame.cameras[0], intrinsics=stated),))
            faults_now = list(watch.update(frame, frame.clouds, ()))
    assert [fault.name for fault in faults_now] == [name] * bool(name)


def restamped(results: Results) -> Results:
    """Return the results at 10 Hz."""
    moved = []
    for row, result in enumerate(results):
        frame, stamp = result.frame, (row + 1) * 100_000_000
        camera = frame.cameras[0]
        assert camera.image is not None
        camera = replace(camera, image=replace(camera.image, stamp=stamp))
        clouds = (replace(frame.clouds[0], stamp=stamp),)
        moved.append(replace(result, frame=replace(frame, stamp=stamp, cameras=(camera,), clouds=clouds)))
    return moved


@pytest.mark.long
def test_transform_that_drifts_slowly_is_told(drive: Results) -> None:
    """It drifts by 0.06 degrees a frame, too little for a jump, while the drive runs forth and back."""
    there_and_back = [*drive, *drive[-2:0:-1]]
    seen = drifts(restamped(there_and_back * 2), lambda row: min(0.06 * row, 3.0), 1)
    assert list(seen) == [MISPLACED]


@pytest.mark.long
def test_long_clean_drive_has_no_sensor_fault(drive: Results) -> None:
    assert drifts(restamped([*drive, *drive[-2:0:-1]] * 2), lambda row: 0.0, 0) == {}


@pytest.mark.long
@pytest.mark.parametrize("name", ["kitti", "kitti_more"])
def test_right_transform_of_single_frames_is_left_alone(shared: Path, name: str) -> None:
    checks = []
    with bevviz.open(shared / name) as opened:
        for frame in opened.frames:
            scores = score_rotations(frame.cameras[0], frame.clouds[0], frame.points_from_clouds[0])
            assert scores is not None
            checks.append(scores)
    for count in range(LEAST_PAST, len(checks) + 1):
        assert find_error(np.array(checks[:count])) is None


def test_image_and_cloud_of_different_places_tell_no_error(shared: Path) -> None:
    with bevviz.open(shared / "kitti") as opened:
        frames = list(opened.frames)
    checks = [
        score_rotations(a.cameras[0], b.clouds[0], b.points_from_clouds[0])
        for a, b in zip(frames, frames[1:] + frames[:1], strict=True)
    ]
    known = [scores for scores in checks if scores is not None]
    for count in range(LEAST_PAST, len(known) + 1):
        assert find_error(np.array(known[:count])) is None


@pytest.mark.parametrize(
    ("behind", "amplitude"), [(0.3, 12.0), (-0.25, 12.0), (0.0, 12.0), (0.1, 12.0), (0.3, 1.0)]
)
def test_a_clock_that_is_off_is_told_by_the_turns(drive: Results, behind: float, amplitude: float) -> None:
    """The camera looks around in a real image, and its stamps are behind those of the scans."""
    focal, wide = 300.0, pixels(drive[0])
    optical = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    K = np.array([[focal, 0, 160], [0, focal, 120], [0, 0, 1]])
    watch, told = MountingWatch("front", "top"), set[str]()
    for i in range(60):
        yaw, before, seen = (amplitude * np.sin(0.2 * (i + steps)) for steps in (0, -1, 10 * behind))
        column = wide.shape[1] / 2 - 160 - focal * float(np.tan(np.radians(seen)))
        view = cv2.getRectSubPix(wide, (320, 240), (column + 160, 180.0))
        image = Image((i + 1) * 100_000_000, "front", np.asarray(view, np.uint8), topic="/front/image_raw")
        camera = Camera("front", image, Intrinsics(320, 240, K), optical, None)
        gray = np.asarray(cv2.cvtColor(image.bgr, cv2.COLOR_BGR2GRAY), np.uint8)
        scene = np.array([0.0, 0.0, before - yaw])
        told |= {
            f"{fault.name}{fault.detail}" for fault in watch.update(camera, gray, scene, image.stamp, True)
        }
    if abs(behind) < 0.2 or amplitude < 5:
        assert not told
        return
    (text,) = told
    side = "behind" if behind > 0 else "ahead of"
    assert text == (
        f"clock is off, {abs(behind):.2f} s {side} LiDAR top by the turns of the drive; "
        f"--set sync.offsets='{{/front/image_raw: {behind:.2f}}}' sets it right"
    )
