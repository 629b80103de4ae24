"""Planted anomalies: each is found, once, with its numbers; a quiet drive has none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bevviz.anomalies import AnomalyDetector, AnomalySummary, Onsets
from bevviz.config import AnomaliesConfig, load
from bevviz.model import geometry
from bevviz.model.frame import F32, Boxes3D, Camera, Image, Intrinsics
from bevviz.model.results import (
    Anomaly,
    CameraResult,
    Decision,
    Detections,
    Failure,
    FrameResult,
    Fusion,
    Pairs,
)
from bevviz.stages.fusion import clusters_in_view
from bevviz.stages.tracking import Tracker
from tests.support.tracking_scenes import CAR, PERSON, scene

CONFIG = load()
TRACKING = CONFIG.tracking
NO_PAIRS = Pairs(*(np.zeros(0, np.int32),) * 3, *(np.zeros(0, np.float32),) * 4)
IMAGE = Image(0, "zed", np.tile(np.arange(0, 250, 5, dtype=np.uint8)[:, None], (50, 1, 3)))
OPTICAL = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])  # from x ahead, z up
LENS = Intrinsics(640, 480, np.array([[300.0, 0, 320], [0, 300, 240], [0, 0, 1]]))
CAMERA = Camera("zed", IMAGE, LENS, OPTICAL, np.eye(4), sync_error=0.01, tf_age=0.001)


def in_image(places: Any) -> F32:
    """(N, 4) around people at these places."""
    center = np.array([(x, y, 0) for x, y in places], np.float32).reshape(-1, 3)
    boxes = Boxes3D(
        center, np.tile(np.array(PERSON, np.float32), (len(center), 1)), np.zeros(len(center), np.float32)
    )
    corners = geometry.apply(OPTICAL, geometry.corners(boxes).reshape(-1, 3))
    uv = geometry.project(corners, LENS)[0].reshape(-1, 8, 2)
    return np.hstack([uv.min(axis=1), uv.max(axis=1)])


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
        alone: tuple[tuple[str, float, float, float], ...] = (),
        points: Any = (),
        camera: Camera | None = CAMERA,
        seen: bool = True,
        **changes: Any,
    ) -> tuple[Anomaly, ...]:
        """Clusters of which the first are named; detections without a cluster, as class, place and score."""
        self._index += 1
        frame, clusters, objects = scene(self._index, places, sizes, names)
        cloud = np.array(points, np.float32).reshape(-1, 3) + np.float32(1e-4 * self._index)  # no frozen scan
        frame = replace(frame, cameras=() if camera is None else (camera,), tf_age=0.0, points=cloud)
        n, rows = len(alone), np.zeros(len(alone), np.int32)
        score = np.array([a[3] for a in alone], np.float32)
        found = Detections(
            in_image([(a[1], a[2]) for a in alone]), score, rows, tuple(a[0] for a in alone),
            (score < 0.25).astype(np.int32), rows - 1, np.zeros(n, np.float32),
        )  # fmt: skip
        of_clusters = np.full(len(places), Decision.NO_DETECTION if seen else Decision.OUT_OF_VIEW, np.int32)
        of_clusters[: len(names)] = Decision.MATCHED
        nowhere = np.zeros((len(places), 4), np.float32)
        alone_rows = np.where(found.kept, Decision.NO_CLUSTER, Decision.NOT_KEPT).astype(np.int32)
        fusion = Fusion(alone_rows, rows - 1, rows, of_clusters, of_clusters * 0, NO_PAIRS, nowhere)
        cameras = () if camera is None else (CameraResult(camera, found, fusion),)
        obstacles = np.zeros((0, 3), np.float32)
        result = FrameResult(frame, CONFIG, None, None, obstacles, clusters, cameras, objects, None)
        looked_at = clusters_in_view(cameras, len(clusters))
        tracks = self._tracker.update(frame, clusters, looked_at, objects, TRACKING)
        result = replace(result, tracks=tracks, **changes)
        result = replace(result, anomalies=self._detector.update(result, self.config))
        self.said += [(self._index, a.kind, a.text) for a in self._onsets.of(result.anomalies)]
        self.summary.observe(result)
        return result.anomalies

    def person(self, frames: int, **more: Any) -> None:
        for _ in range(frames):
            self.frame([(8, 0, 0)], PERSON, ("person",), **more)


def test_a_quiet_drive_has_no_anomalies() -> None:
    drive = Drive()
    for i in range(20):
        drive.frame([(10, 0.14 * i, 0), (30 - 0.8 * i, 3, 0)], [PERSON, CAR], ("person", "car"))
    assert drive.said == []
    assert str(drive.summary) == "none"


def test_an_object_lost_by_the_detector_is_found() -> None:
    drive = Drive()
    drive.person(12)
    for _ in range(6):
        drive.frame([(8, 0, 0)])
    text = "person #0: a cluster in plain view, 0.6 x 0.5 x 1.7 m, without a detection for 4 frames"
    assert drive.said == [(15, "one_sensor", text)]


def test_a_near_car_that_the_image_border_cuts_is_found() -> None:
    """A quarter of the car is outside of the image, and no detection shows it for ten frames."""
    drive = Drive()
    for _ in range(12):
        drive.frame([(6.5, -4.5, 0)], CAR, ("car",))
    for _ in range(10):
        drive.frame([(6.5, -4.5, 0)], CAR)
    ((row, kind, text),) = drive.said
    assert row <= 12 + 4 and kind == "one_sensor"
    assert text.startswith("car #0: a cluster in plain view")


def test_the_loss_of_a_longer_track_is_reported_sooner() -> None:
    told = []
    for frames in (8, 12, 40):
        drive = Drive()
        drive.person(frames)
        for _ in range(6):
            drive.frame([(8, 0, 0)])
        told.append(drive.said[0][0] - frames)
    assert told == sorted(told, reverse=True)
    assert told[-1] == 2  # in the third frame


def test_a_loss_that_earlier_frames_explain_is_none() -> None:
    """An object that is found in every other frame is not missed."""
    drive = Drive()
    for i in range(30):
        drive.frame([(8, 0, 0)], PERSON, ("person",) if i % 2 else ())
    assert drive.said == []


WALL = [(4.0, y, z) for y in np.linspace(-1, 1, 80) for z in np.linspace(-1.5, 1.5, 80)]


@pytest.mark.parametrize(
    "excuse",
    [
        {"points": WALL},  # half hidden
        {"seen": False},
        {"alone": (("person", 8.0, 0.0, 0.2),)},  # near the detector's threshold
        {"camera": replace(CAMERA, camera_from_points=geometry.transform((0, 0, 0), (0, 0, 0, 1)))},
    ],
)
def test_excused_losses_are_no_anomalies(excuse: dict[str, Any]) -> None:
    drive = Drive()
    drive.person(12)
    for _ in range(6):
        drive.frame([(8, 0, 0)], **excuse)
    assert [kind for _, kind, _ in drive.said if kind not in ("tf", "sensor")] == []


def test_a_class_that_disappears_is_reported_sooner() -> None:
    drive = Drive()
    places = [(8, 0, 0), (10, 2, 0), (12, -2, 0)]
    for _ in range(12):
        drive.frame(places, PERSON, ("person",) * 3)
    for _ in range(5):
        drive.frame(places)
    assert drive.said[0] == (
        13, "flicker", "no person is detected any more: 3 are in plain view for 2 frames"
    )  # fmt: skip


def test_an_object_lost_by_the_lidar_is_found() -> None:
    drive = Drive()
    drive.person(12)
    for _ in range(6):
        drive.frame(alone=(("person", 8, 0, 0.8),))
    text = "person #0: detected where the LiDAR sees nothing, and nothing that hides it, for 4 frames"
    assert (15, "one_sensor", text) in drive.said


def test_a_box_that_jumps_is_found() -> None:
    drive = Drive()
    drive.person(12)
    drive.frame([(8, 1.4, 0)], PERSON, ("person",))
    assert drive.said == [(12, "jump", "person #0: 1.4 m from where it was expected")]


def test_a_box_that_jumps_out_of_its_track_is_found() -> None:
    drive = Drive()
    drive.person(12)
    drive.frame([(10, 0, 0)], PERSON, ("person",))
    drive.frame([(10, 0, 0)], PERSON, ("person",))
    drive.frame([(10, 0, 0)], PERSON, ("person",))
    assert drive.said == [(12, "jump", "person #0: 2.0 m from where it was expected, as a new track")]


def test_a_changed_box_length_is_no_jump() -> None:
    """Two that are merged, or a car of which more comes into view."""
    drive = Drive()
    drive.person(12)
    drive.frame([(8, 0.7, 0)], (0.6, 1.9, 1.7), ("person",))
    assert drive.said == []


def test_objects_that_only_the_camera_sees_are_found() -> None:
    """The LiDAR sees the wall behind it; where it sees nothing of what is near, nothing can be said."""
    behind = [(20.0, y, z) for y in np.linspace(-2, 2, 80) for z in np.linspace(-2, 2, 80)]
    for points, said in ((behind, 1), (WALL, 0), ((), 0)):
        drive = Drive(alone_frames=3)
        for _ in range(6):
            drive.frame(alone=(("person", 8, 0, 0.7),), points=points)
        assert [(index, kind) for index, kind, _ in drive.said] == [(2, "one_sensor")] * said


def test_detections_at_other_places_are_not_one_object() -> None:
    behind = [(20.0, y, z) for y in np.linspace(-2, 2, 80) for z in np.linspace(-2, 2, 80)]
    drive = Drive(alone_frames=3)
    for i in range(6):
        drive.frame(alone=(("person", 8, 1.5 * (i % 2), 0.7),), points=behind)
    assert drive.said == []


def test_the_worst_anomaly_comes_first() -> None:
    drive = Drive()
    drive.person(12)
    late = replace(CAMERA, sync_error=-0.06, camera_from_points=None)
    drive.frame([(8, 1.4, 0)], PERSON, ("person",), camera=late)
    kinds = [anomaly.kind for anomaly in drive.frame(camera=late)]
    assert kinds[:2] == ["tf", "sync"]


def test_wrong_clocks_and_late_images_are_found() -> None:
    drive = Drive()
    late = replace(CAMERA, sync_error=-0.06)
    for camera in (CAMERA, late, late, replace(CAMERA, image=None, sync_error=float("nan"))):
        drive.frame(camera=camera)
    assert drive.said == [(1, "sync", "zed is -60 ms off the cloud")]
    assert [a.text for a in drive.frame()] == ["zed has no image at the time of the cloud"]


def test_lost_and_old_transforms_are_found() -> None:
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


def test_failing_and_slow_stages_are_found() -> None:
    drive = Drive(stage_time=0.1)
    drive.frame(timings={"ground": 0.05})
    drive.frame(timings={"ground": 0.2}, failures=(Failure("fusion", "ZeroDivisionError: planted"),))
    assert drive.said == [
        (1, "stage", "fusion: ZeroDivisionError: planted"),
        (1, "stage", "ground took 200 ms"),
    ]


def test_a_lasting_anomaly_is_one_and_is_held() -> None:
    drive = Drive(hold=0.3)
    late = replace(CAMERA, sync_error=0.08)
    shown = [len(drive.frame(camera=late if i in (1, 3) else CAMERA)) for i in range(10)]
    assert shown == [0, 1, 1, 1, 1, 1, 1, 0, 0, 0]
    assert [index for index, _, _ in drive.said] == [1]
    drive.frame(camera=late)
    assert [index for index, _, _ in drive.said] == [1, 10]
    assert str(drive.summary) == "2 sync (first: zed at 0.1 s)"


def test_news_is_told_once_if_its_first_frame_was_skipped() -> None:
    onsets = Onsets()
    one, two = Anomaly("tf", "zed", "lost", since=5), Anomaly("sync", "zed", "late", since=6)
    assert onsets.of([]) == []
    assert onsets.of([one]) == [one]
    assert onsets.of([one, two]) == [two]
    assert onsets.of([two]) == []
    assert onsets.of([replace(two, since=9)]) == [replace(two, since=9)]


def test_a_new_drive_forgets_the_old_one() -> None:
    drive = Drive()
    late = replace(CAMERA, sync_error=0.08)
    drive.frame(camera=late)
    drive._index = -20
    assert drive.frame() == ()
