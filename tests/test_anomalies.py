"""Planted anomalies: each is found, once, with its numbers; a quiet drive has none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bevviz.anomalies import AnomalyDetector, AnomalySummary, Onsets
from bevviz.config import AnomaliesConfig, load
from bevviz.frame import (
    Anomaly,
    Camera,
    CameraResult,
    Decision,
    Detections,
    Failure,
    FrameResult,
    Fusion,
    Image,
    Pairs,
)
from bevviz.stages.fusion import in_view
from bevviz.stages.tracking import Tracker
from tests.test_tracking import CAR, PERSON, scene

CONFIG = load()
TRACKING = CONFIG.tracking
NO_PAIRS = Pairs(*(np.zeros(0, np.int32),) * 3, *(np.zeros(0, np.float32),) * 4)
IMAGE = Image(0, "zed", np.zeros((2, 2, 3), np.uint8))
CAMERA = Camera("zed", IMAGE, None, np.eye(4), np.eye(4), sync_error=0.01, tf_age=0.001)


class Drive:
    """Frames one by one through tracker and detector; ``said``: what began, with the number of its frame."""

    def __init__(self, **limits: Any) -> None:
        self.config = AnomaliesConfig(**limits)
        self.said: list[tuple[int, str, str]] = []
        self.summary = AnomalySummary()
        self._tracker, self._detector, self._onsets = Tracker(), AnomalyDetector(), Onsets()
        self._index = -1

    def frame(
        self,
        places: Any = (),
        sizes: Any = PERSON,
        names: tuple[str, ...] = (),
        *,
        alone: tuple[str, ...] = (),
        camera: Camera | None = CAMERA,
        seen: bool = True,
        box: float = 0.0,
        **changes: Any,
    ) -> tuple[Anomaly, ...]:
        """Clusters of which the first are named, and detections without a cluster."""
        self._index += 1
        frame, clusters, objects = scene(self._index, places, sizes, names)
        frame = replace(frame, cameras=() if camera is None else (camera,), tf_age=0.0)
        n, rows = len(alone), np.zeros(len(alone), np.int32)
        found = Detections(
            np.tile(np.array([[10, 10, 30, 50]], np.float32), (n, 1)) + np.float32(box),
            np.full(n, 0.7, np.float32), rows, alone, rows, rows - 1, np.zeros(n, np.float32),
        )  # fmt: skip
        of_clusters = np.full(len(places), Decision.NO_DETECTION if seen else Decision.OUT_OF_VIEW, np.int32)
        of_clusters[: len(names)] = Decision.MATCHED
        nowhere = np.zeros((len(places), 4), np.float32)
        alone_rows = np.full(n, Decision.NO_CLUSTER, np.int32)
        fusion = Fusion(alone_rows, rows - 1, rows, of_clusters, of_clusters * 0, NO_PAIRS, nowhere)
        cameras = () if camera is None else (CameraResult(camera, found, fusion),)
        result = FrameResult(frame, CONFIG, None, None, None, clusters, cameras, objects, None)
        looked_at = in_view(cameras, len(clusters))
        tracks = self._tracker.update(frame, clusters, looked_at, objects, TRACKING)
        result = replace(result, tracks=tracks, **changes)
        result = replace(result, anomalies=self._detector.update(result, self.config))
        self.said += [(self._index, a.kind, a.text) for a in self._onsets.of(result.anomalies)]
        self.summary.see(result)
        return result.anomalies

    def person(self, frames: int, **more: Any) -> None:
        for _ in range(frames):
            self.frame([(8, 0, 0)], PERSON, ("person",), **more)


def test_a_quiet_drive_has_none() -> None:
    drive = Drive()
    for i in range(20):
        drive.frame([(10, 0.14 * i, 0), (30 - 0.8 * i, 3, 0)], [PERSON, CAR], ("person", "car"))
    assert drive.said == []
    assert str(drive.summary) == "none"


def test_an_object_that_the_detector_misses_for_two_frames() -> None:
    drive = Drive()
    drive.person(8)
    drive.frame([(8, 0, 0)])
    drive.frame([(8, 0, 0)])
    drive.person(3)
    assert drive.said == [(10, "flicker", "person #0: gone for 2 frames (no detection of it), and back")]


def test_an_object_that_the_lidar_misses() -> None:
    drive = Drive()
    drive.person(8)
    drive.frame()
    drive.person(1)
    assert drive.said == [(9, "flicker", "person #0: gone for 1 frame (no cluster of it), and back")]


@pytest.mark.parametrize(("before", "gap", "seen"), [(3, 1, True), (8, 8, True), (8, 2, False)])
def test_no_flicker_of_what_is_new_long_gone_or_out_of_view(before: int, gap: int, seen: bool) -> None:
    drive = Drive(alone_frames=100)
    drive.person(before)
    for _ in range(gap):
        drive.frame([(8, 0, 0)], seen=seen)
    drive.person(3)
    assert drive.said == []


def test_a_class_that_changes() -> None:
    drive = Drive()
    drive.person(5)
    drive.frame([(8, 0, 0)], PERSON, ("bicycle",))
    assert drive.said == [(5, "flicker", "person #0: called bicycle 0.80, before person")]


def test_a_box_that_jumps() -> None:
    drive = Drive()
    drive.person(8)
    drive.frame([(8, 1.2, 0)], PERSON, ("person",))
    assert drive.said == [(8, "jump", "person #0: 1.2 m from where it was expected")]


def test_a_box_that_grows_as_when_two_are_merged() -> None:
    drive = Drive()
    drive.person(8)
    drive.frame([(8, 0.7, 0)], (0.6, 1.9, 1.7), ("person",))
    assert drive.said == [(8, "jump", "person #0: its box is 1.9 m long, and was 0.6 m")]


def test_what_only_the_camera_sees() -> None:
    drive = Drive(alone_frames=3)
    for i in range(6):
        drive.frame(alone=("person",), box=float(i))
    assert drive.said == [(2, "one_sensor", "zed: person 0.70, for 3 frames")]


def test_detections_at_other_places_are_not_one_object() -> None:
    drive = Drive(alone_frames=3)
    for i in range(6):
        drive.frame(alone=("person",), box=100.0 * i)
    assert drive.said == []


def test_what_the_camera_no_longer_sees() -> None:
    drive = Drive(alone_frames=3)
    drive.person(8)
    for _ in range(4):
        drive.frame([(8, 0, 0)])
    (said,) = drive.said
    assert said[:2] == (10, "one_sensor")
    assert said[2].startswith("person #0: a cluster in view, 0.6 x 0.5 x 1.7 m, 0.0 m/s, without a detection")


@pytest.mark.parametrize(
    ("speed", "size", "found"), [(1.4, PERSON, 1), (0.0, PERSON, 0), (1.4, (9, 1, 3), 0)]
)
def test_what_moves_and_was_never_detected(speed: float, size: tuple[float, ...], found: int) -> None:
    drive = Drive()
    for i in range(15):
        drive.frame([(10, 0.1 * speed * i, 0)], size)
    assert [kind for _, kind, _ in drive.said] == ["one_sensor"] * found


def test_clocks_and_images() -> None:
    drive = Drive()
    late = replace(CAMERA, sync_error=-0.06)
    for camera in (CAMERA, late, late, replace(CAMERA, image=None, sync_error=float("nan"))):
        drive.frame(camera=camera)
    assert drive.said == [(1, "sync", "zed is -60 ms off the cloud")]
    assert [a.text for a in drive.frame()] == ["zed has no image at the time of the cloud"]


def test_transforms_that_are_lost_or_old() -> None:
    drive = Drive(hold=0.1)
    lost = replace(CAMERA, camera_from_points=None)
    drive.frame(camera=lost)  # it was never there
    drive.frame()
    assert [a.severity for a in drive.frame(camera=lost)] == ["ERROR"]
    for camera in (CAMERA, CAMERA, CAMERA, replace(CAMERA, tf_age=0.15)):
        drive.frame(camera=camera)
    assert drive.said == [
        (2, "tf", "the transform of zed is lost"),
        (6, "tf", "the transform of zed is 150 ms old"),
    ]


def test_stages_that_fail_or_take_long() -> None:
    drive = Drive(stage_time=0.1)
    drive.frame(timings={"ground": 0.05})
    drive.frame(timings={"ground": 0.2}, failures=(Failure("fusion", "ZeroDivisionError: planted"),))
    assert drive.said == [
        (1, "stage", "fusion: ZeroDivisionError: planted"),
        (1, "stage", "ground took 200 ms"),
    ]


def test_what_lasts_is_one_and_is_held_for_a_while() -> None:
    drive = Drive(hold=0.3)
    late = replace(CAMERA, sync_error=0.08)
    shown = [len(drive.frame(camera=late if i in (1, 3) else CAMERA)) for i in range(10)]
    assert shown == [0, 1, 1, 1, 1, 1, 1, 0, 0, 0]
    assert [index for index, _, _ in drive.said] == [1]
    drive.frame(camera=late)
    assert [index for index, _, _ in drive.said] == [1, 10]
    assert str(drive.summary) == "2 sync (first at 0.1 s)"


def test_news_is_told_once_also_where_its_first_frame_was_left_out() -> None:
    onsets = Onsets()
    one, two = Anomaly("tf", "zed", "lost", since=5), Anomaly("sync", "zed", "late", since=6)
    assert onsets.of([]) == []
    assert onsets.of([one]) == [one]
    assert onsets.of([one, two]) == [two]
    assert onsets.of([two]) == []
    assert onsets.of([replace(two, since=9)]) == [replace(two, since=9)]


def test_a_drive_that_starts_anew() -> None:
    drive = Drive()
    late = replace(CAMERA, sync_error=0.08)
    drive.frame(camera=late)
    drive._index = -20
    assert drive.frame() == ()
