"""From messages in the order of receipt to frames in the order of stamp."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bevviz.config import Config, SyncConfig, load
from bevviz.errors import UserError
from bevviz.messages.decoders import MessageError
from bevviz.messages.roles import Roles
from bevviz.messages.topics import CameraRole
from bevviz.messages.transforms import StampedTransform
from bevviz.model import geometry
from bevviz.model.frame import (
    F64,
    Boxes3D,
    Cloud,
    Frame,
    Image,
    Intrinsics,
    LabelledBoxes2D,
    LabelledBoxes3D,
)
from bevviz.sync.clocks import Clocks
from bevviz.sync.feed import make_handlers
from bevviz.sync.synchronizer import Synchronizer

SECOND = 1_000_000_000
T0 = 1_700_000_000 * SECOND  # stamps as a robot has them
OPTICAL = geometry.transform(np.zeros(3), np.array([-0.5, 0.5, -0.5, 0.5]))
K = np.array([[320.0, 0, 319.5], [0, 320.0, 179.5], [0, 0, 1]])
LEFT = CameraRole("zed", "/zed/image", "/zed/camera_info", True, "Image")
REAR = CameraRole("rear", "/rear/image", "/rear/camera_info", True, "Image")
ONE = Roles(lidars=("/rslidar_points",), lidar_names=("rslidar",), cameras=(LEFT,))


def ns(seconds: float) -> int:
    return T0 + round(seconds * SECOND)


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> F64:
    return geometry.transform(np.array([x, y, z]), np.array([0, 0, np.sin(yaw / 2), np.cos(yaw / 2)]))


def cloud(
    seconds: float,
    topic: str = "/rslidar_points",
    frame: str = "rslidar",
    points: Any = ((10.0, 1.0, 0.0),),
    late: float = 0.0,
    **fields: Any,
) -> Cloud:
    xyz = np.asarray(points, np.float32).reshape(-1, 3)
    return Cloud(ns(seconds), frame, xyz, fields, topic, ns(seconds + late))


def boxes(seconds: float, topic: str = "/detection/fused_3d", frame: str = "rslidar") -> LabelledBoxes3D:
    one = Boxes3D(np.ones((1, 3), np.float32), np.ones((1, 3), np.float32), np.zeros(1, np.float32))
    return LabelledBoxes3D(
        topic, ns(seconds), frame, one, ("car",), np.ones(1, np.float32), None, ns(seconds)
    )


def edge(parent: str, child: str, matrix: F64, seconds: float = 0.0) -> StampedTransform:
    return StampedTransform(ns(seconds), parent, child, matrix)


class Feed:
    """A synchroniser with short hands."""

    def __init__(self, roles: Roles = ONE, *settings: str, preset: Any = None) -> None:
        self.config: Config = load(settings=settings, preset=preset)
        self.sync = Synchronizer(roles, self.config)
        self.decoded: list[int] = []

    def image(
        self,
        seconds: float,
        camera: CameraRole = LEFT,
        frame: str = "optical",
        size: tuple[int, int] = (640, 360),
        late: float = 0.0,
        error: str = "",
    ) -> None:
        def decode() -> Image:
            self.decoded.append(ns(seconds))
            if error:
                raise UserError(error)
            return Image(ns(seconds), frame, np.zeros((size[1], size[0], 3), np.uint8), topic=camera.topic)

        self.sync.add_image(camera.topic, ns(seconds), frame, ns(seconds + late), decode)

    def info(
        self,
        camera: CameraRole = LEFT,
        width: int = 640,
        height: int = 360,
        at: float = 0.0,
        zoom: float = 1.0,
    ) -> None:
        intrinsics = Intrinsics(width, height, np.diag([zoom, zoom, 1.0]) @ K)
        self.sync.add_camera_info(camera.info_topic, intrinsics, ns(at), ns(at))

    def calibration(self) -> None:
        self.sync.add_transform(edge("base_link", "rslidar", pose(0.3, 0, 1.2)), static=True)
        self.sync.add_transform(edge("base_link", "optical", pose(0.5, 0.06, 0.9) @ OPTICAL), static=True)

    def odometry(self, of: Callable[[float], F64], start: float, end: float, **how: Any) -> None:
        for t in np.arange(start, end + 1e-9, 0.02):
            self.sync.add_transform(edge("odom", "base_link", of(t), t), **how)

    def clouds(self, *seconds: float) -> list[Frame]:
        frames: list[Frame] = []
        for t in seconds:
            self.sync.add_cloud(cloud(t))
            frames += self.sync.ready()
        return frames


def turning(t: float) -> F64:
    return pose(2.0 * t, 0.0, 0.0, yaw=0.8 * t)


def test_nearest_image_is_awaited_and_only_that_one_is_decoded() -> None:
    feed = Feed()
    feed.calibration()
    feed.info()
    feed.image(-0.01)
    feed.sync.add_cloud(cloud(0.0))
    assert list(feed.sync.ready()) == []  # a nearer image may come
    feed.image(0.004)
    (frame,) = feed.sync.ready()
    (camera,) = frame.cameras
    assert camera.image is not None and camera.image.stamp == ns(0.004)
    assert feed.decoded == [ns(0.004)]
    assert camera.sync_error == pytest.approx(0.004)
    assert frame.index == 0 and frame.stamp == T0 and frame.lidar == "rslidar"
    assert camera.problems == () and frame.problems == ()
    assert feed.sync.report.frames == 1


def test_one_lidar_is_passed_on_untouched() -> None:
    feed = Feed(replace(ONE, cameras=()))
    scan = cloud(0.0, intensity=np.array([7.0], np.float32))
    feed.sync.add_cloud(scan)
    (frame,) = feed.sync.ready()
    assert frame.points is scan.xyz and frame.fields is scan.fields
    assert frame.points_frame == frame.world_frame == "rslidar" and frame.world_from_points is None
    np.testing.assert_array_equal(frame.points_from_clouds[0], np.eye(4))


@pytest.mark.parametrize("compensated", [True, False])
def test_static_point_seen_from_a_turning_robot_projects_right(compensated: bool) -> None:
    feed = Feed(ONE, f"sync.motion_compensation={compensated}")
    feed.calibration()
    feed.info()
    feed.odometry(turning, 0.0, 2.0)
    fixed = np.array([22.0, 16.0, 1.0, 1.0])  # a pole's point in the world
    scan_time, image_time = 1.00, 1.06
    in_lidar = geometry.inverse(turning(scan_time) @ pose(0.3, 0, 1.2)) @ fixed
    feed.sync.add_cloud(cloud(scan_time, points=in_lidar[:3]))
    feed.image(image_time)
    (frame,) = feed.sync.ready()
    (camera,) = frame.cameras
    assert camera.camera_from_points is not None and camera.intrinsics is not None
    in_camera = geometry.inverse(turning(image_time) @ pose(0.5, 0.06, 0.9) @ OPTICAL) @ fixed
    true, _ = geometry.project(in_camera[None, :3], camera.intrinsics)
    ours, _ = geometry.project(geometry.apply(camera.camera_from_points, frame.points), camera.intrinsics)
    assert np.isfinite(true).all()
    assert camera.motion_compensated is compensated
    error = float(np.linalg.norm(ours - true))
    assert error < 0.01 if compensated else error > 10
    assert frame.world_frame == "odom" and frame.world_from_points is not None
    np.testing.assert_allclose(
        (frame.world_from_points @ np.append(frame.points[0], 1))[:3], fixed[:3], atol=1e-5
    )
    assert camera.world_from_camera is not None
    if compensated:
        seen = turning(image_time) @ pose(0.5, 0.06, 0.9) @ OPTICAL
        np.testing.assert_allclose(camera.world_from_camera, seen, atol=1e-9)


def test_frames_wait_for_transforms_to_interpolate_the_pose() -> None:
    feed = Feed(replace(ONE, cameras=(), tf=("/tf",)))
    feed.calibration()
    feed.odometry(turning, 0.0, 0.98)
    assert feed.clouds(1.01) == []
    feed.odometry(turning, 1.0, 1.02)
    (frame,) = feed.sync.ready()
    assert frame.tf_age == pytest.approx(0.01) and frame.world_from_points is not None
    np.testing.assert_allclose(frame.world_from_points, turning(1.01) @ pose(0.3, 0, 1.2), atol=1e-4)


def test_a_frame_waits_for_max_wait_and_names_what_was_missing() -> None:
    feed = Feed(ONE, "sync.max_wait=0.3")
    feed.calibration()
    feed.info()
    feed.image(-0.34)
    feed.sync.add_cloud(cloud(0.0))
    assert list(feed.sync.ready(ns(0.29))) == []
    (frame,) = feed.sync.ready(ns(0.31))
    (camera,) = frame.cameras
    assert camera.image is None and camera.problems == (
        "no image of camera 'zed' within 0.10 s: nearest is 0.34 s earlier",
    )
    assert camera.camera_from_points is not None  # the pose does not depend on the image
    assert np.isnan(camera.sync_error)
    assert feed.sync.report.without_image == {"zed": 1}
    assert feed.sync.report.warnings()[0] == "1 of 1 frames have no image of camera 'zed'"


def test_topics_without_a_publisher_are_not_waited_for() -> None:
    feed = Feed(replace(ONE, tf=("/tf",)), "sync.max_wait=10")
    feed.calibration()
    feed.info()
    feed.image(0.0)
    feed.odometry(lambda t: pose(t), 0.0, 0.0)
    assert len(feed.clouds(0.0)) == 1
    assert feed.clouds(0.1) == [], "the next image and transform are awaited"
    feed.sync.absent = frozenset({LEFT.topic})
    assert list(feed.sync.ready()) == [], "the transform still is"
    feed.sync.absent = frozenset({LEFT.topic, "/tf"})
    (frame,) = feed.sync.ready()
    assert frame.stamp == ns(0.1)


def test_transforms_that_end_too_early_are_reported() -> None:
    feed = Feed()
    feed.calibration()
    feed.info()
    feed.odometry(turning, 0.0, 1.0)
    feed.sync.add_cloud(cloud(3.0))
    feed.image(3.05)
    (frame,) = feed.sync.flush()
    (camera,) = frame.cameras
    assert frame.world_frame == "odom" and frame.world_from_points is None
    assert "'odom' -> 'base_link' ends 2.00 s before the asked stamp" in frame.problems[0]
    assert camera.camera_from_points is not None and not camera.motion_compensated  # the mounting is known
    assert camera.problems == ("no motion compensation: 'odom' is out of reach",)


def test_undecodable_image_is_a_problem_of_its_camera() -> None:
    feed = Feed()
    feed.calibration()
    feed.info()
    feed.sync.add_cloud(cloud(0.0))
    feed.image(0.0, error="/zed/image: encoding 'yuv9' is not known")
    (frame,) = feed.sync.ready()
    assert frame.cameras[0].image is None
    assert frame.cameras[0].problems == ("/zed/image: encoding 'yuv9' is not known",)
    assert feed.sync.report.undecodable.counts == {"zed": 1}
    said = "could not be decoded once, the first: /zed/image: encoding 'yuv9' is not known"
    assert feed.sync.report.warnings()[0] == f"camera 'zed': an image {said}"


def test_a_frame_without_transforms_names_the_option() -> None:
    feed = Feed()
    feed.info()
    feed.sync.add_cloud(cloud(0.0))
    feed.image(0.0)
    (frame,) = feed.sync.flush()
    (camera,) = frame.cameras
    assert camera.camera_from_points is None and camera.world_from_camera is None
    (problem,) = camera.problems
    assert problem.startswith("no transform from 'optical' to 'rslidar': frame 'optical' is unknown; ")
    assert "source.extrinsics" in problem
    stated = Feed(ONE, "source.extrinsics={'rslidar optical': [0.2, 0.06, -0.3, -0.5, 0.5, -0.5, 0.5]}")
    stated.info()
    stated.sync.add_cloud(cloud(0.0))
    stated.image(0.0)
    (frame,) = stated.sync.ready()
    assert frame.cameras[0].problems == () and frame.cameras[0].camera_from_points is not None
    expected = geometry.inverse(pose(0.2, 0.06, -0.3) @ OPTICAL)
    np.testing.assert_allclose(frame.cameras[0].camera_from_points, expected, atol=1e-12)
    assert frame.cameras[0].world_from_camera is not None  # the world is the LiDAR's frame
    np.testing.assert_allclose(frame.cameras[0].world_from_camera, geometry.inverse(expected), atol=1e-12)


@pytest.mark.parametrize("names", ["rslidar", "{'a b': [0, 0, 0, 0, 0, 0, 0]}"])
def test_wrong_extrinsics_are_one_clear_line(names: str) -> None:
    value = names if names.startswith("{") else "{'" + names + "': [0, 0, 0, 0, 0, 0, 1]}"
    with pytest.raises(UserError, match=r"source\.extrinsics"):
        Feed(ONE, f"source.extrinsics={value}")


def test_a_missing_camera_info_is_reported() -> None:
    feed = Feed()
    feed.calibration()
    feed.sync.add_cloud(cloud(0.0))
    feed.image(0.0)
    assert list(feed.sync.ready()) == []  # it may still come
    (frame,) = feed.sync.flush()
    assert frame.cameras[0].intrinsics is None
    assert "no CameraInfo on /zed/camera_info" in frame.cameras[0].problems[0]
    assert frame.cameras[0].problems[0].endswith("; record one")

    other = Feed(replace(ONE, camera_infos=("/zed/camera_info", "/zed/left/camera_info")))
    other.sync.add_cloud(cloud(0.0))
    other.image(0.0)
    (frame,) = other.sync.flush()
    offered = f"--set source.camera_info_topics='{{{LEFT.topic}: /zed/left/camera_info}}'"
    assert any(problem.endswith(offered) for problem in frame.cameras[0].problems)

    tutorial = Feed(ONE, preset="reference")
    tutorial.calibration()
    tutorial.sync.add_cloud(cloud(0.0))
    tutorial.image(0.0)
    (frame,) = tutorial.sync.flush()
    assumed = frame.cameras[0].intrinsics
    assert assumed is not None and assumed.assumed and (assumed.width, assumed.height) == (640, 360)
    np.testing.assert_array_equal(assumed.K, [[267, 0, 320], [0, 267, 180], [0, 0, 1]])
    assert "using fx = fy = 267, cx 320, cy 180" in frame.cameras[0].problems[0]


def test_camera_info_follows_the_image_size_and_later_changes() -> None:
    feed = Feed()
    feed.calibration()
    feed.info()
    frames: list[Frame] = []
    for t, size in ((0.0, (1280, 720)), (0.1, (640, 480)), (0.2, (640, 360))):
        if t == 0.2:
            feed.info(at=0.2, zoom=2.0)
        feed.sync.add_cloud(cloud(t))
        feed.image(t, size=size)
        frames += feed.sync.ready()
    scaled, wrong, changed = (f.cameras[0].intrinsics for f in frames)
    assert scaled is not None and (scaled.width, scaled.height) == (1280, 720)
    ray = np.array([[0.3, -0.2, 1.0]])
    small, large = (geometry.project(ray, i)[0][0] for i in (Intrinsics(640, 360, K), scaled))
    np.testing.assert_allclose((large + 0.5) / 2, small + 0.5, atol=1e-4)  # measured from the image's corner
    assert wrong is None
    assert "is for 640 x 360 pixels, the image has 640 x 480" in frames[1].cameras[0].problems[0]
    assert changed is not None and changed.K[0, 0] == 640


def test_duplicates_and_late_clouds_are_dropped() -> None:
    feed = Feed()
    feed.calibration()
    feed.info()
    for t in (0.0, 0.2, 0.1, 0.1):
        feed.sync.add_cloud(cloud(t))
    for t in np.arange(0, 0.31, 0.05):
        feed.image(t)
    frames = list(feed.sync.ready())
    assert [f.stamp for f in frames] == [ns(0.0), ns(0.1), ns(0.2)]
    assert [f.index for f in frames] == [0, 1, 2]
    feed.sync.add_cloud(cloud(0.15))
    feed.sync.add_cloud(cloud(0.2))
    assert list(feed.sync.flush()) == []
    report = feed.sync.report
    assert (report.clouds, report.reordered, report.duplicates, report.late) == (6, 1, 2, 1)
    assert report.warnings()[:3] == (
        "1 cloud came out of order and was put back in order",
        "1 cloud came after a newer one had gone on and was dropped",
        "2 clouds had the stamp of another one and were dropped",
    )


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(0, 900), min_size=1, max_size=40))
def test_frames_come_in_order_and_every_cloud_is_accounted_for(milliseconds: list[int]) -> None:
    feed = Feed(replace(ONE, cameras=()))
    frames = feed.clouds(*(ms / 1000 for ms in milliseconds))
    frames += feed.sync.flush()
    stamps = [f.stamp for f in frames]
    assert stamps == sorted(set(stamps))
    report = feed.sync.report
    assert report.frames + report.late + report.duplicates == report.clouds == len(milliseconds)


def test_a_jump_back_of_stamps_resets_poses() -> None:
    feed = Feed(replace(ONE, cameras=()))
    feed.sync.add_transform(edge("base_link", "rslidar", pose(0.3)), static=True)
    feed.odometry(turning, 99.0, 104.0)
    feed.clouds(100.0, 100.1, 103.6)
    assert feed.sync.report.gaps == 1 and feed.sync.report.longest_gap == pytest.approx(3.5)
    feed.odometry(lambda t: pose(-7.0), 2.0, 3.0)  # played again, with another way
    (frame,) = feed.clouds(2.5)
    assert frame.index == 3 and frame.world_from_points is not None
    assert frame.world_from_points[0, 3] == pytest.approx(-6.7)
    assert feed.sync.report.resets == 1 and feed.sync.report.late == 0
    told = feed.sync.report.warnings()
    assert "the stamps of the clouds jumped back once" in told
    assert "the stamps of the clouds have 1 gap, the longest 3.50 s" in told


def test_short_jump_back_does_not_mix_old_and_new_poses() -> None:
    feed = Feed(replace(ONE, cameras=(), tf=("/tf",)))
    feed.sync.add_transform(edge("base_link", "rslidar", pose()), static=True)
    feed.odometry(lambda t: pose(100.0), 9.0, 12.0)
    feed.clouds(10.0)
    feed.odometry(lambda t: pose(1.0), 2.0, 3.0)
    (frame,) = feed.clouds(2.5)
    assert frame.world_from_points is not None and frame.world_from_points[0, 3] == 1.0
    assert feed.clouds(3.05) == []  # the pose is not there yet, for all that was said of 9 s and later
    (frame,) = feed.sync.flush()
    assert frame.world_from_points is not None and frame.world_from_points[0, 3] == 1.0
    assert frame.tf_age == pytest.approx(0.05)


def test_what_waits_when_the_clock_is_reset_is_delivered_first() -> None:
    feed = Feed()
    feed.calibration()
    feed.info()
    feed.image(50.0)
    feed.sync.add_cloud(cloud(50.02))
    feed.sync.add_cloud(cloud(1.0))
    frames = list(feed.sync.ready())
    assert len(frames) == 1  # the image of before the reset is not taken for a later one
    feed.image(1.01)
    frames += feed.sync.ready()
    assert [f.stamp for f in frames] == [ns(50.02), ns(1.0)]
    taken = [f.cameras[0].image for f in frames]
    assert [image.stamp for image in taken if image is not None] == [ns(50.0), ns(1.01)]


def test_stamp_zero_is_replaced_by_the_time_of_receipt() -> None:
    feed = Feed()
    feed.calibration()
    feed.info()
    feed.sync.add_cloud(replace(cloud(0.0), stamp=0, received=ns(5.0)))
    feed.image(5.01)
    (frame,) = feed.sync.ready()
    assert frame.stamp == ns(5.0) and frame.cameras[0].image is not None
    assert "/rslidar_points: no stamp in the header once, time of receipt used instead" in (
        feed.sync.report.warnings()
    )


def test_every_tenth_scan_is_no_gap_but_a_missing_one_is() -> None:
    feed = Feed(replace(ONE, cameras=()))
    feed.clouds(*np.arange(0, 20, 2.0))
    assert feed.sync.report.gaps == 0
    feed.clouds(30.0)
    assert feed.sync.report.gaps == 1


def test_full_queue_sends_the_oldest_on() -> None:
    feed = Feed(ONE, "sync.queue=3", "sync.max_wait=60")
    frames = feed.clouds(*np.arange(0, 1, 0.1))
    assert len(frames) == 7 and feed.sync.report.unwaited == 7
    assert len(list(feed.sync.flush())) == 3


def test_two_cameras_with_their_own_poses_and_images() -> None:
    feed = Feed(replace(ONE, cameras=(LEFT, REAR)))
    feed.calibration()
    feed.sync.add_transform(edge("base_link", "rear", pose(-0.5, 0, 0.9, yaw=np.pi) @ OPTICAL), static=True)
    feed.info()
    feed.info(REAR)
    feed.sync.add_cloud(cloud(0.0))
    feed.image(0.0)
    assert list(feed.sync.ready()) == []
    feed.image(0.03, REAR, frame="rear")
    (frame,) = feed.sync.ready()
    front, rear = frame.cameras
    assert (front.name, rear.name) == ("zed", "rear")
    assert rear.sync_error == pytest.approx(0.03)
    depth = [geometry.apply(c.camera_from_points, frame.points)[0, 2] for c in (front, rear)]  # type: ignore[arg-type]
    np.testing.assert_allclose(depth, [10 - 0.2, -10 - 0.8], atol=1e-5)


def two_lidars(*settings: str) -> Feed:
    feed = Feed(Roles(lidars=("/front", "/back"), lidar_names=("front", "back")), *settings)
    feed.sync.add_transform(edge("base_link", "front", pose(1.0)), static=True)
    feed.sync.add_transform(edge("base_link", "back", pose(-1.0, yaw=np.pi)), static=True)
    return feed


def test_two_lidars_are_merged_in_the_base_frame() -> None:
    feed = two_lidars()
    feed.odometry(turning, 0.0, 1.5)
    fixed = np.array([[20.0, 5.0, 1.0, 1.0], [-20.0, 3.0, 0.5, 1.0]])
    early, late = 1.0, 1.04
    ahead = geometry.inverse(turning(early) @ pose(1.0)) @ fixed[0]
    behind = geometry.inverse(turning(late) @ pose(-1.0, yaw=np.pi)) @ fixed[1]
    ring, intensity = np.array([3], np.uint16), np.array([0.5], np.float32)
    feed.sync.add_cloud(cloud(early, "/front", "front", ahead[:3], intensity=intensity, ring=ring))
    assert list(feed.sync.ready()) == []
    feed.sync.add_cloud(cloud(late, "/back", "back", behind[:3], intensity=2 * intensity))
    (frame,) = feed.sync.ready()
    assert frame.lidar == "lidars" and frame.points_frame == "base_link" and frame.stamp == ns(early)
    assert frame.world_from_points is not None
    np.testing.assert_allclose(geometry.apply(frame.world_from_points, frame.points), fixed[:, :3], atol=1e-3)
    assert list(frame.fields) == ["intensity"]
    np.testing.assert_array_equal(frame.fields["intensity"], [0.5, 1.0])
    assert [c.topic for c in frame.clouds] == ["/front", "/back"]
    rows = [geometry.apply(p, c.xyz) for c, p in zip(frame.clouds, frame.points_from_clouds, strict=True)]
    np.testing.assert_array_equal(np.concatenate(rows), frame.points)
    assert frame.problems == ()


def test_the_base_frame_is_awaited() -> None:
    feed = Feed(Roles(lidars=("/front", "/back"), lidar_names=("front", "back")))
    for topic in ("/front", "/back"):
        feed.sync.add_cloud(cloud(0.0, topic, topic[1:]))
    assert list(feed.sync.ready()) == []
    for child in ("front", "back"):
        feed.sync.add_transform(edge("base_link", child, pose(1.0)), static=True)
    (frame,) = feed.sync.ready()
    assert frame.points_frame == "base_link" and frame.problems == ()
    np.testing.assert_array_equal(frame.points, [[11, 1, 0], [11, 1, 0]])


def test_lidars_that_do_not_fit_together_are_told() -> None:
    feed = two_lidars("source.base_frame=chassis")
    feed.sync.add_cloud(cloud(0.0, "/front", "front"))
    feed.sync.add_cloud(cloud(0.3, "/back", "back"))
    (frame,) = feed.sync.flush()
    assert frame.points_frame == "front" and len(frame.points) == 1
    assert "source.base_frame 'chassis'" in frame.problems[0] and "merged in 'front'" in frame.problems[0]
    assert frame.problems[1] == "no cloud of LiDAR /back within 0.10 s: nearest is 0.30 s later"


def test_frames_are_made_if_only_the_second_lidar_delivers() -> None:
    feed = two_lidars()
    feed.sync.add_cloud(cloud(0.0, "/back", "back"))
    assert list(feed.sync.flush()) == []
    assert "no cloud on /front, which should drive" in feed.sync.report.warnings()[0]


def test_odometry_stands_in_for_tf() -> None:
    feed = Feed(replace(ONE, cameras=(), odometry="/odometry"))
    feed.sync.add_transform(edge("base_link", "rslidar", pose(0.3)), static=True)
    assert feed.clouds(0.5) == []  # the pose is yet to come
    for t in (0.4, 0.6):
        feed.sync.add_transform(edge("start", "base_link", pose(10 * t), t), fallback=True)
    (frame,) = feed.sync.ready()
    assert frame.world_frame == "start" and frame.world_from_points is not None
    assert frame.world_from_points[0, 3] == pytest.approx(5.3)
    feed.odometry(lambda t: pose(-t), 0.4, 1.0)  # /tf has it after all, and holds
    feed.sync.add_transform(edge("start", "base_link", pose(10.0), 0.9), fallback=True)
    (frame,) = feed.clouds(0.8)
    assert frame.world_frame == "odom" and frame.world_from_points is not None
    assert frame.world_from_points[0, 3] == pytest.approx(-0.5)


def test_world_is_the_map_and_never_the_globe() -> None:
    feed = Feed(replace(ONE, cameras=()))
    for parent, child in (("earth", "map"), ("map", "odom"), ("odom", "base_link"), ("base_link", "rslidar")):
        feed.sync.add_transform(edge(parent, child, pose(1.0)), static=True)
    assert feed.clouds(0.0)[0].world_frame == "map"
    stated = Feed(replace(ONE, cameras=()), "source.fixed_frame=odom")
    for parent, child in (("map", "odom"), ("odom", "rslidar")):
        stated.sync.add_transform(edge(parent, child, pose(1.0)), static=True)
    assert stated.clouds(0.0)[0].world_frame == "odom"


def test_truth_that_cannot_be_decoded_is_as_if_it_had_not_come() -> None:
    feed = Feed(replace(ONE, cameras=(), truth="/ground_truth"))
    feed.calibration()
    feed.odometry(turning, -0.1, 1.0)

    def broken() -> LabelledBoxes3D:
        raise MessageError("/ground_truth: not a Detection3DArray: cut")

    near = boxes(0.02, "/ground_truth", "base_link")
    feed.sync.add_truth("/ground_truth", ns(0.0), 0, broken)
    feed.sync.add_truth("/ground_truth", near.stamp, 0, partial(replace, near))
    feed.sync.add_cloud(cloud(0.0))
    (frame,) = feed.sync.flush()
    assert frame.truth is not None and frame.truth.stamp == near.stamp
    assert "1 message(s) of /ground_truth could not be used" in " ".join(feed.sync.report.warnings())


def test_results_of_the_robot_go_to_the_one_nearest_frame() -> None:
    feed = Feed(replace(ONE, cameras=(), robot_detections_3d=("/detection/fused_3d",), truth="/ground_truth"))
    feed.calibration()
    feed.odometry(turning, -0.1, 1.0)
    frames: list[Frame] = []
    for t in (0.0, 0.1, 0.2, 0.3):
        feed.sync.add_cloud(cloud(t))
        frames += feed.sync.ready()
    for t in (0.0, 0.12, 0.14, 0.3):  # that of 0.14 belongs to a cloud that has a nearer one
        feed.sync.add_boxes(boxes(t))
        truth = boxes(t, "/ground_truth", "base_link")
        feed.sync.add_truth(truth.topic, truth.stamp, 0, partial(replace, truth))
        frames += feed.sync.ready()
    frames += feed.sync.flush()
    assert [[b.stamp for b in f.robot_boxes] for f in frames] == [[ns(0.0)], [ns(0.12)], [], [ns(0.3)]]
    assert [f.truth is not None for f in frames] == [True, True, False, True]
    (box,) = frames[1].robot_boxes
    assert box.world_from_boxes is not None and frames[1].truth is not None
    np.testing.assert_allclose(box.world_from_boxes, turning(0.12) @ pose(0.3, 0, 1.2), atol=1e-9)
    np.testing.assert_allclose(frames[1].truth.world_from_boxes, turning(0.12), atol=1e-9)  # type: ignore[arg-type]


def test_beside_a_robot_no_frame_waits_for_its_results() -> None:
    topic = "/detection/fused_3d"
    roles = replace(ONE, cameras=(), robot_detections_3d=(topic,))
    sync = Synchronizer(roles, load(), beside=[topic])
    sync.add_transform(edge("odom", "rslidar", pose(1.0)), static=True)
    frames: list[Frame] = []
    for t in (0.0, 0.1, 0.2):
        sync.add_cloud(cloud(t))
        frames += sync.ready()
        assert frames[-1].stamp == ns(t)
        sync.add_boxes(boxes(t + 0.012))  # after every scan, as from a detector that is a little late
    assert not any(frame.robot_boxes for frame in frames)
    first, second, third = sync.overtaken()
    assert [late.boxes.stamp for late in (first, second, third)] == [ns(0.012), ns(0.112), ns(0.212)]
    assert [late.frame_stamp for late in (first, second, third)] == [ns(0.0), ns(0.1), ns(0.2)]
    np.testing.assert_array_equal(first.boxes.world_from_boxes, pose(1.0))  # type: ignore[union-attr]
    assert sync.overtaken() == ()

    sync.add_boxes(boxes(0.3))  # one that is there before its scan goes with it
    sync.add_boxes(boxes(0.31))  # a second one of the same time does not
    sync.add_cloud(cloud(0.3))
    (frame,) = sync.ready()
    assert [b.stamp for b in frame.robot_boxes] == [ns(0.3)]
    assert [late.boxes.stamp for late in sync.overtaken()] == [ns(0.31)]
    (said,) = (text for text in sync.report.warnings() if topic in text)
    assert said.startswith(f"{topic}: 4 results came when the frame of that time had gone on")


def test_detections_of_the_robot_know_their_camera() -> None:
    feed = Feed()
    feed.calibration()
    feed.info()
    empty = np.zeros((0, 4), np.float32)
    feed.sync.add_detections(
        LabelledBoxes2D(
            "/detection/camera_2d", ns(0.01), "optical", empty, (), empty[:, 0], received=ns(0.01)
        )
    )
    feed.sync.add_cloud(cloud(0.0))
    feed.image(0.01)
    (frame,) = feed.sync.flush()
    assert [d.camera for d in frame.robot_detections] == ["zed"]


@pytest.mark.long
def test_memory_is_bounded() -> None:
    feed = Feed(Roles(lidars=("/rslidar_points", "/back"), lidar_names=("rslidar", "back"), cameras=(LEFT,)))
    feed.calibration()
    feed.info()

    def held() -> Iterator[int]:
        yield len(feed.sync._clouds) + len(feed.sync._done)
        yield from (len(track) for _, track in feed.sync._buffers())
        yield from (len(edge.poses) for edge in feed.sync.tf._edges.values())

    frames = most = most_images = 0
    for i in range(10_000):
        t = i * 0.1
        feed.sync.add_transform(edge("odom", "base_link", pose(t), t))
        feed.sync.add_cloud(cloud(t))
        feed.sync.add_boxes(boxes(t))
        if i < 5_000:  # then the camera and the second LiDAR die
            feed.image(t)
            feed.sync.add_cloud(cloud(t, "/back"))
        frames += sum(1 for _ in feed.sync.ready())
        most = max(most, *held())
        most_images = max(most_images, len(feed.sync.cameras.images[LEFT.topic]))
    assert frames >= 9_990 and most <= 376  # 30 s of transforms, a quarter of slack
    assert most_images <= 4  # those within the tolerance of a cloud, and one older
    for i in range(10_000):  # now only the camera is alive
        feed.image(1000 + i * 0.03)
    assert len(feed.sync.cameras.images[LEFT.topic]) < 100


def test_odometry_is_decoded_only_while_tf_says_nothing() -> None:
    sync = Synchronizer(replace(ONE, odometry="/odometry"), Config())
    decoded = []

    def decode(message: Any) -> Any:
        decoded.append(message.received)
        stamp = SimpleNamespace(sec=message.received, nanosec=0)
        place = SimpleNamespace(
            position=SimpleNamespace(x=1.0, y=2.0, z=0.0), orientation=SimpleNamespace(x=0, y=0, z=0, w=1)
        )
        return SimpleNamespace(
            header=SimpleNamespace(stamp=stamp, frame_id="odom"),
            child_frame_id="base_link",
            pose=SimpleNamespace(pose=place),
        )

    handle: Any = make_handlers(sync, replace(ONE, odometry="/odometry"), decode)["/odometry"]
    for second in (1, 2):
        handle(SimpleNamespace(topic="/odometry", received=second))
    assert decoded == [1, 2]
    assert sync.tf.needs_odometry("base_link")
    sync.add_transform(StampedTransform(2 * SECOND, "odom", "base_link", pose(3.0)))
    handle(SimpleNamespace(topic="/odometry", received=3))
    assert decoded == [1, 2]
    assert sync.tf.lookup("odom", "base_link", 2 * SECOND, 0.0).matrix[0, 3] == 3.0
    sync.tf.forget_after(0)  # the clock went back, and /tf may not come again
    handle(SimpleNamespace(topic="/odometry", received=1))
    assert decoded == [1, 2, 1]


# --- clocks ------------------------------------------------------------------------------------


def of_clocks(offset: float, *settings: str, frames: int = 40) -> tuple[list[Frame], Synchronizer]:
    """Run a drive whose camera clock is ``offset`` seconds behind. Images arrive 30 ms after the exposure."""
    feed = Feed(ONE, *settings)
    feed.calibration()
    feed.info()
    made: list[Frame] = []
    for i in range(frames):
        t = i * 0.1
        feed.sync.add_cloud(cloud(t, late=0.1))
        feed.image(t + 0.015 - offset, late=offset + 0.03)
        made += feed.sync.ready()
    return [*made, *feed.sync.flush()], feed.sync


@pytest.mark.parametrize("offset", [1.5, -1.5])
def test_a_clock_that_is_off_is_named_and_can_be_set_right(offset: float) -> None:
    frames, sync = of_clocks(offset)
    (doubt,) = [text for text in sync.report.warnings() if "clock" in text and "sync.offsets" in text]
    where = "behind" if offset > 0 else "ahead of"
    assert re.match(rf"/zed/image: its clock is 1\.[45]\d s {where} that of /rslidar_points", doubt)
    fused = [f.cameras[0] for f in frames[5:] if f.cameras[0].image is not None]
    assert bool(fused) == (offset < 0), "images of a clock that is ahead are near in stamp"
    assert all("its image is of another time" in " ".join(c.problems) for c in fused)

    setting = re.search(r"--set (sync\.offsets='\{.*?\}')", doubt)
    assert setting is not None
    frames, sync = of_clocks(offset, setting[1].replace("'", ""))
    assert not [text for text in sync.report.warnings() if "clock" in text]
    errors = [abs(f.cameras[0].sync_error) for f in frames if f.cameras[0].image is not None]
    assert len(errors) >= len(frames) - 1 and max(errors) < 0.11


def test_late_images_have_a_remedy_if_roles_came_later() -> None:
    """Beside a robot, the first synchroniser knows no sensor yet."""
    empty, feed = Synchronizer(Roles(), load(), lapse=1.5), Feed(ONE)
    feed.sync = Synchronizer(ONE, load(), lapse=1.5)
    feed.sync.take_over(empty)
    feed.calibration()
    feed.info()
    for i in range(40):
        feed.sync.add_cloud(cloud(0.1 * i, late=0.01))
        feed.image(0.1 * i, late=0.9)
        list(feed.sync.ready())
    (doubt,) = feed.sync.clocks.doubts(["/rslidar_points", "/zed/image"])
    assert "come 0.89 s later" in doubt
    assert "--set sync.max_wait=1 --set sync.queue=11 waits for them" in doubt


def test_times_of_receipt_can_replace_stamps() -> None:
    frames, sync = of_clocks(1.5, "sync.by=received")
    assert not [text for text in sync.report.warnings() if "clock" in text]
    assert [f.stamp for f in frames[:2]] == [ns(0.1), ns(0.2)]
    assert all(f.cameras[0].image is not None for f in frames[:-1])


def test_a_slow_connection_is_no_wrong_clock() -> None:
    for offset in (0.3, -0.09):
        _, sync = of_clocks(offset)
        assert not [text for text in sync.report.warnings() if "clock" in text]


@pytest.mark.parametrize(
    ("offset", "words"),
    [
        (1.7e9, "count from when its clock was started, not from 1970; --set sync.by=received"),
        (-37.0, "37 s ahead of that of /rslidar_points, as TAI is of UTC; --set sync.offsets"),
    ],
)
def test_other_epochs_are_named(offset: float, words: str) -> None:
    clocks = Clocks(SyncConfig(), "/rslidar_points")
    for i in range(5):
        clocks.stamp("/rslidar_points", ns(i), ns(i + 0.1))
        clocks.stamp("/zed/image", ns(i - offset), ns(i + 0.03))
    (doubt,) = clocks.doubts(["/rslidar_points", "/zed/image"])
    assert words in doubt


def test_too_few_messages_tell_nothing() -> None:
    clocks = Clocks(SyncConfig(), "/rslidar_points")
    clocks.stamp("/a", ns(0), ns(9))
    clocks.stamp("/b", ns(0), ns(0))
    assert clocks.lag("/a") is None and not list(clocks.doubts(["/a", "/b"]))


# --- calibration by stamp ----------------------------------------------------------------------


def test_a_zoom_that_is_told_just_after_its_image() -> None:
    feed = Feed()
    feed.calibration()
    frames: list[Frame] = []
    for i in range(10):
        zoom = 1.0 if i < 5 else 2.0
        feed.sync.add_cloud(cloud(0.1 * i))
        feed.image(0.1 * i)
        frames += feed.sync.ready()
        feed.info(at=0.1 * i, zoom=zoom)
        frames += feed.sync.ready()
    frames += feed.sync.flush()
    found = [f.cameras[0].intrinsics for f in frames]
    assert [i.K[0, 0] for i in found if i is not None] == [320.0] * 5 + [640.0] * 5


def test_a_calibration_that_was_sent_once_is_not_awaited_again() -> None:
    feed = Feed()
    feed.calibration()
    feed.info()
    for i in range(5):
        feed.sync.add_cloud(cloud(0.1 * i))
        feed.image(0.1 * i)
        assert len(list(feed.sync.ready())) == 1


# --- what cannot be, and is said ---------------------------------------------------------------


def test_points_in_millimetres_are_said() -> None:
    feed = Feed()
    far = np.random.default_rng(0).normal(size=(4000, 3)) * 20_000
    feed.sync.add_cloud(cloud(0.0, points=far))
    list(feed.sync.flush())
    (text,) = [text for text in feed.sync.report.warnings() if "millimetres" in text]
    assert text.startswith("/rslidar_points: half of its points are farther than")


def test_a_camera_without_a_frame_is_not_at_the_lidar() -> None:
    feed = Feed()
    feed.info()
    feed.sync.add_cloud(cloud(0.0, frame=""))
    feed.image(0.0, frame="")
    (frame,) = feed.sync.flush()
    assert frame.cameras[0].camera_from_points is None
    assert "a message states no frame_id; source.frames can state it" in " ".join(frame.cameras[0].problems)


def test_a_static_transform_sent_once_on_tf_holds() -> None:
    feed = Feed()
    feed.info()
    feed.sync.add_transform(edge("base_link", "rslidar", pose(0.3, 0, 1.2)), static=True)
    feed.sync.add_transform(edge("base_link", "optical", pose(0.5, 0.06, 0.9) @ OPTICAL, 0.0))
    feed.sync.add_cloud(cloud(5.0))
    feed.image(5.0)
    (frame,) = feed.sync.flush()
    text = " ".join(frame.cameras[0].problems)
    assert "5.00 s before the asked stamp (it was sent once, as if it were static: sync.tf_tolerance" in text


def test_the_baseline_of_a_stereo_pair_is_used() -> None:
    """In the frame of the first one it is a baseline beside it; in a frame of its own it is where TF says."""
    right = CameraRole("right", "/right/image", "/right/camera_info", True, "Image")
    roles = Roles(lidars=ONE.lidars, lidar_names=ONE.lidar_names, cameras=(LEFT, right))
    places = {}
    for frame in ("optical", "right_optical"):
        feed = Feed(roles)
        feed.calibration()
        feed.sync.add_transform(
            edge("base_link", "right_optical", pose(0.5, -0.06, 0.9) @ OPTICAL), static=True
        )
        feed.info()
        beside = Intrinsics(640, 360, K, baseline=(0.12, 0.0))
        feed.sync.add_camera_info(right.info_topic, beside, ns(0), ns(0))
        feed.sync.add_cloud(cloud(0.0))
        feed.image(0.0)
        feed.image(0.0, camera=right, frame=frame)
        (made,) = feed.sync.flush()
        matrix = made.cameras[1].camera_from_points
        assert matrix is not None
        places[frame] = matrix
        assert any("'right_optical' is taken as its own" in str(t) for t in feed.sync.report.doubts()) == (
            frame == "right_optical"
        )
    np.testing.assert_allclose(places["optical"], places["right_optical"], atol=1e-9)
