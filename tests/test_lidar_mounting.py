"""A LiDAR that is mounted upside down, rolled or pitched sees the same world as an upright one."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from bevviz.config import load
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.messages.clouds import decode_cloud
from bevviz.messages.encode import encode_boxes_3d, encode_cloud
from bevviz.messages.roles import Roles, find_roles
from bevviz.messages.topics import Topic
from bevviz.messages.transforms import Acceleration, StampedTransform
from bevviz.model import geometry
from bevviz.model.frame import F32, F64, Cloud, Frame
from bevviz.model.results import FrameResult
from bevviz.pipeline.perceive import perceive
from bevviz.pipeline.stage_loader import StageLoader
from bevviz.sync.gravity import _least_turn, ground_normal
from bevviz.sync.synchronizer import Synchronizer
from tests.support import rooms

LIDAR, BASE, ODOM, IMU = "rslidar", "base_link", "odom", "imu_link"
ROLES = Roles(lidars=("/points",), lidar_names=(LIDAR,))
CONFIG = load()


def turned(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> F64:
    """(4, 4) by degrees about each axis, in turn."""
    matrix = np.eye(4)
    for axis, angle in enumerate((x, y, z)):
        matrix[:3, :3] = cv2.Rodrigues(np.eye(3)[axis] * np.radians(angle))[0] @ matrix[:3, :3]
    return matrix


OPTICAL = np.eye(4)
OPTICAL[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # body from optical
MOUNTINGS = {
    "upside down": turned(x=180),
    "upside down and back to front": turned(y=180),
    "rolled": turned(x=90),
    "pitched": turned(y=20),
    "optical": OPTICAL,
}


@pytest.fixture(scope="module")
def scan() -> Cloud:
    return SyntheticSource(frames=20).snapshot(10).frame.clouds[0]


def built(
    cloud: Cloud, mounting: F64, tell: Callable[[Synchronizer, F64], None], frame: str = LIDAR
) -> tuple[Frame, Synchronizer]:
    """Return the frame of the scan, as a LiDAR with this mounting records it."""
    points = geometry.apply(geometry.inverse(mounting), cloud.xyz)
    sync = Synchronizer(ROLES, CONFIG)
    tell(sync, mounting)
    sync.add_cloud(replace(cloud, xyz=points, topic="/points", frame_id=frame))
    (made,) = sync.flush()
    return made, sync


def static(sync: Synchronizer, parent: str, child: str, matrix: F64) -> None:
    sync.add_transform(StampedTransform(0, parent, child, matrix), static=True)


def by_base(sync: Synchronizer, mounting: F64) -> None:
    static(sync, BASE, LIDAR, mounting)


def by_fixed_frame(sync: Synchronizer, mounting: F64) -> None:
    static(sync, ODOM, LIDAR, turned(z=130) @ mounting)


def by_gravity(sync: Synchronizer, mounting: F64) -> None:
    static(sync, "sensor_kit", LIDAR, turned(30, 40, 50) @ mounting)
    static(sync, "sensor_kit", IMU, turned(30, 40, 50) @ turned(x=77))
    felt = turned(x=-77)[:3, :3] @ [0.2, -0.1, 9.8]
    for i in range(30):
        sync.upright.add_acceleration(Acceleration(i * 20_000_000, IMU, felt))


def by_ground(sync: Synchronizer, mounting: F64) -> None:
    """Nothing tells but the scan itself."""


def seen(frame: Frame) -> FrameResult:
    return perceive(frame, CONFIG, StageLoader().load(CONFIG))


@pytest.mark.long
@pytest.mark.parametrize("tell", [by_base, by_fixed_frame, by_gravity, by_ground])
@pytest.mark.parametrize("mounting", list(MOUNTINGS))
def test_ground_and_clusters_are_those_of_an_upright_lidar(
    scan: Cloud, mounting: str, tell: Callable[[Synchronizer, F64], None]
) -> None:
    plain = seen(built(scan, np.eye(4), by_base)[0])
    frame, _ = built(scan, MOUNTINGS[mounting], tell)
    assert frame.upright is not None
    up = (frame.upright @ geometry.inverse(MOUNTINGS[mounting]))[:3, :3] @ [0, 0, 1]
    assert np.degrees(np.arccos(up[2])) < 3.0
    result = seen(frame)
    assert result.obstacles is not None and plain.obstacles is not None
    assert result.clusters is not None and plain.clusters is not None
    assert len(result.obstacles) == pytest.approx(len(plain.obstacles), rel=0.1)
    assert result.clusters.kept.sum() == pytest.approx(plain.clusters.kept.sum(), rel=0.15)
    assert result.clusters.obb.size[:, 2].max() < plain.clusters.obb.size[:, 2].max() + 0.5


def in_a_hall(size: tuple[float, float, float], elevations: F64) -> F32:
    """(N, 3) points of a LiDAR at a height of 1.9 m on the walls, the floor and the ceiling, in its frame."""
    lidar = np.array([6.0, 0.47 * size[1], 1.9])
    azimuth, elevation = np.meshgrid(np.radians(np.arange(0.05, 360, 0.4)), np.radians(elevations))
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1).reshape(-1, 3)
    away = np.where(rays > 0, np.array(size) - lidar, -lidar) / rays
    return np.asarray(rays * away.min(axis=1)[:, None], np.float32)


@pytest.mark.parametrize("size", [(14.0, 7.0, 8.0), (14.0, 7.0, 2.7), (20.0, 3.0, 2.7)])
@pytest.mark.parametrize("mounting", [np.eye(4), turned(z=70)])
def test_walls_and_ceilings_are_no_ground(size: tuple[float, float, float], mounting: F64) -> None:
    """In a hall most points are on them, nothing is behind, and few are on the floor."""
    seen = geometry.apply(geometry.inverse(mounting), in_a_hall(size, np.linspace(-15, 15, 16)))
    up = ground_normal(seen)
    assert up is not None and np.degrees(np.arccos(min(1.0, up[2]))) < 5


def test_walls_alone_tell_no_mounting() -> None:
    assert ground_normal(in_a_hall((14.0, 7.0, 8.0), np.linspace(-7, 52, 32))) is None


def test_few_points_in_a_small_place_tell_no_mounting() -> None:
    cubes = [np.random.default_rng(seed).uniform(0, 1, (200, 3)) for seed in range(50)]
    assert all(ground_normal(cube.astype(np.float32)) is None for cube in cubes)


def test_the_base_frame_tells_what_is_ahead_too(scan: Cloud) -> None:
    frame, sync = built(scan, turned(x=180, z=90), by_base)
    assert np.abs(frame.points - scan.xyz).max() < 1e-3
    assert frame.points_frame == LIDAR and not sync.report.warnings()[1:], "only that no frame is fixed"


def test_an_upright_lidar_is_left_as_it_is(scan: Cloud) -> None:
    for mounting in (np.eye(4), turned(z=70), turned(y=1.5)):
        for tell in (by_base, by_ground):
            frame, _ = built(scan, mounting, tell)
            assert frame.upright is None
            assert frame.points is frame.clouds[0].xyz, "not even copied"


def test_a_robot_on_a_slope_stays_in_its_own_frame(scan: Cloud) -> None:
    def drive(sync: Synchronizer, mounting: F64) -> None:
        static(sync, BASE, LIDAR, mounting)
        static(sync, ODOM, BASE, turned(y=-15))

    assert built(scan, np.eye(4), drive)[0].upright is None


def test_points_and_poses_follow_the_mounting(scan: Cloud) -> None:
    """Where points are in the world, and where the LiDAR is among them."""
    mounting = turned(y=25)
    mounting[:3, 3] = 0.3, 0.0, 1.2

    def tell(sync: Synchronizer, mounting: F64) -> None:
        static(sync, BASE, LIDAR, mounting)
        static(sync, ODOM, BASE, turned(z=33))

    frame, sync = built(scan, mounting, tell)
    assert frame.upright is not None
    (own,) = frame.clouds
    (points_from_cloud,) = frame.points_from_clouds
    assert np.allclose(geometry.apply(points_from_cloud, own.xyz), frame.points, atol=1e-4)
    odom_from_lidar = turned(z=33) @ mounting
    assert np.allclose(
        geometry.apply(frame.pose, frame.points), geometry.apply(odom_from_lidar, own.xyz), atol=1e-3
    )
    pose = sync.placing.pose(frame, frame.stamp)
    assert pose is not None and np.allclose(pose, frame.pose)


def test_the_robot_gets_boxes_in_its_own_frame(scan: Cloud) -> None:
    mounting = turned(x=180)
    frame, _ = built(scan, mounting, by_base)
    assert frame.upright is not None
    result = seen(frame)
    assert result.clusters is not None
    boxes = result.clusters.obb
    sent = encode_boxes_3d(
        0, LIDAR, boxes, [[("x", 1.0)]] * len(boxes), geometry.inverse(frame.upright)
    ).detections
    for message, corners in zip(sent, geometry.corners(boxes), strict=True):
        place, turn = message.bbox.center.position, message.bbox.center.orientation
        pose = geometry.transform((place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w))
        half = np.array([message.bbox.size.x, message.bbox.size.y, message.bbox.size.z]) / 2
        corner = geometry.apply(mounting @ pose, half[None].astype(np.float32))
        assert np.abs(corners - corner).max(axis=1).min() < 1e-2, "one of its corners"


def test_a_conflict_of_frame_and_ground_is_reported(scan: Cloud) -> None:
    _, sync = built(scan, np.eye(4), lambda sync, _: by_base(sync, turned(y=20)))
    (text,) = [text for text in sync.report.warnings() if "ground" in text]
    assert "'rslidar' sees is tilted by 20 degrees against the vertical of 'base_link'" in text
    assert "source.extrinsics" in text


@pytest.mark.parametrize(("real", "stated"), [(10, 0), (0, -8), (0, 0), (-10, -10), (2, 0)])
def test_several_scans_tell_of_a_small_tilt(scan: Cloud, real: float, stated: float) -> None:
    sync = Synchronizer(ROLES, CONFIG)
    by_base(sync, turned(y=stated))
    points = geometry.apply(geometry.inverse(turned(y=real)), scan.xyz)
    for second in range(5):
        stamp = scan.stamp + second * 1_000_000_000
        sync.add_cloud(replace(scan, xyz=points, topic="/points", frame_id=LIDAR, stamp=stamp))
    assert len(list(sync.flush())) > 2
    told = [text for text in sync.report.warnings() if "ground" in text]
    if abs(real - stated) < 5:
        assert not told
        return
    (text,) = told
    assert f"'rslidar' sees is tilted by {abs(real - stated)} degrees in 'base_link', in 4 scans" in text
    assert f"with a further roll of 0 and pitch of {real - stated} degrees" in text


@pytest.mark.parametrize(("divisor", "unit"), [(1, ""), (100, "centimetres"), (1000, "millimetres")])
def test_the_unit_of_a_transform_is_told_by_the_ground(scan: Cloud, divisor: int, unit: str) -> None:
    mounting = np.eye(4)
    mounting[2, 3] = 1.8 * divisor
    _, sync = built(scan, np.eye(4), lambda sync, _: by_base(sync, mounting))
    told = [text for text in sync.report.warnings() if "ground" in text]
    assert [f"is in {unit}; divide the translation by {divisor} " in text for text in told] == [True] * bool(
        unit
    )


def test_an_unknown_mounting_is_assumed_and_reported() -> None:
    points = np.random.default_rng(0).normal(size=(2000, 3)).astype(np.float32) * 5
    sync = Synchronizer(ROLES, CONFIG)
    for i in range(8):
        sync.add_cloud(Cloud(i * 100_000_000 + 1, LIDAR, points, topic="/points", received=i))
    frames = list(sync.flush())
    assert all(frame.upright is None for frame in frames)
    assert any("nothing" in t or "no transform, no Imu and no ground" in t for t in sync.report.warnings())


def test_a_mounting_from_the_ground_alone_is_reported(scan: Cloud) -> None:
    _, sync = built(scan, turned(x=180), by_ground)
    (text,) = [text for text in sync.report.warnings() if "does not point up" in text]
    assert re.search(r"it is turned by 1(79|80) degrees, by the ground in its scans", text)


@given(hnp.arrays(np.float64, 3, elements=st.floats(-1, 1)).filter(lambda v: np.linalg.norm(v) > 1e-3))
@example(np.array([2e-9, 0.0, -1.0]))
@example(np.array([1e-9, -1.0, 2e-9]))
@example(np.array([1e-170, 0.0, -1.0]))
@example(np.array([1e-170, 1e-200, 1.0]))
def test_a_least_turn_points_up(direction: F64) -> None:
    up = direction / np.linalg.norm(direction)
    for frame in (LIDAR, "camera_optical_frame"):
        turn = _least_turn(frame, up)
        assert np.allclose(turn @ up, [0, 0, 1], atol=1e-9)
        assert np.allclose(turn @ turn.T, np.eye(3), atol=1e-9) and np.linalg.det(turn) > 0


@pytest.mark.parametrize("tilt", [0.0, 1e-16, 1e-9, 1e-7])
def test_a_nearly_inverted_lidar_still_faces_ahead(tilt: float) -> None:
    for up in ([tilt, 0.0, -1.0], [-tilt, tilt, -1.0]):
        assert _least_turn(LIDAR, np.array(up)) == pytest.approx(np.diag([1.0, -1.0, -1.0]), abs=1e-6)


@pytest.mark.long
@given(hnp.arrays(np.float64, 3, elements=st.floats(-np.pi, np.pi)))
def test_the_ground_is_found_whatever_way_the_lidar_is_turned(turn: F64) -> None:
    scan = SCAN
    rotation = cv2.Rodrigues(turn)[0]
    found = ground_normal((scan @ rotation.T).astype(np.float32))
    assert found is not None and found @ rotation[:, 2] > np.cos(np.radians(4))


SCAN = SyntheticSource(frames=3).snapshot(1).frame.points


def test_a_wall_alone_is_no_ground() -> None:
    random = np.random.default_rng(0)
    wall = random.uniform(-20, 20, (5000, 3)).astype(np.float32)
    wall[:, 0] = 12.0
    assert ground_normal(wall) is None, "it is farther away than a LiDAR is high"


def test_imus_have_a_role_and_one_without_acceleration_is_named() -> None:
    topics = [Topic("/points", "sensor_msgs/msg/PointCloud2"), Topic("/imu/data", "sensor_msgs/msg/Imu")]
    roles = find_roles(topics, CONFIG.source)
    assert roles.imus == ("/imu/data",) and "gravity" in roles.notes["/imu/data"]


def test_beams_without_a_return_are_no_points() -> None:
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    points[::5] = 0.0
    points[1] = 1.0, 0.0, -1.0  # its coordinates add up to zero, and it is one
    message: Any = encode_cloud(Cloud(1, LIDAR, points, {"ring": np.arange(50, dtype=np.uint16)}))
    cloud = decode_cloud(message, "/points", 0)
    assert cloud.dropped == 10 and len(cloud.xyz) == 40
    assert np.array_equal(cloud.fields["ring"], [i for i in range(50) if i % 5])


def test_a_cloud_within_one_cube_has_no_ground() -> None:
    """No plane can be drawn through a single point: the clouds of a depth camera are that dense."""
    assert ground_normal(np.random.default_rng(0).uniform(0.01, 0.02, (500, 3)).astype(np.float32)) is None


PERSONS = [((2.0, 0.0),), ((1.5, 1.0), (-1.8, 1.2), (0.5, -2.0))]


@pytest.mark.parametrize("persons", PERSONS)
@pytest.mark.parametrize("half", [4.0, 6.0, 8.0])
@pytest.mark.parametrize("height", [0.6, 1.0, 1.4])
def test_a_solid_state_lidar_upside_down_in_a_room_is_turned(
    height: float, half: float, persons: tuple[tuple[float, float], ...]
) -> None:
    points, is_person = rooms.scan(height, half, 3.0, persons, upside_down=True)
    normal = ground_normal(points)
    assert normal is not None and normal[2] < -0.99
    frame, sync = built(Cloud(0, LIDAR, points), np.eye(4), by_ground)
    assert any("turned by 180 degrees" in warning for warning in sync.upright.warnings.values())
    result = seen(frame)
    assert result.ground is not None and result.voxels is not None
    level = result.voxels.points[:, 2] - result.ground.height
    assert np.median(level) == pytest.approx(-height, abs=0.1)
    high = is_person & (frame.points[:, 2] > 0.3 - height)
    assert not result.ground.mask[result.voxels.inverse[high]].any()


@pytest.mark.parametrize("persons", [*PERSONS, ()])
@pytest.mark.parametrize("half", [2.5, 4.0, 6.0, 8.0])
@pytest.mark.parametrize("height", [0.3, 0.6, 1.0, 1.4])
def test_a_ceiling_does_not_turn_a_lidar(
    height: float, half: float, persons: tuple[tuple[float, float], ...]
) -> None:
    """The floor lies below the view of the LiDAR, and objects do not reach the ceiling."""
    normal = ground_normal(rooms.scan(height, half, 2.6, persons)[0])
    assert normal is None or normal[2] > 0.97
