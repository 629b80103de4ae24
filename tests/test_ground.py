"""Ground: streets whose truth is known, real scans, and the reference's plane beside Open3D's."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from bevviz.config import GroundConfig
from bevviz.extras.demo.sensors import load_open3d
from bevviz.model.frame import F32, F64, Bool
from bevviz.model.results import Ground
from bevviz.stages.clustering import dbscan
from bevviz.stages.ground import RING_COUNT, RING_SCALE, _sort_into_bins, segment_ground
from tests.support import rooms

Terrain = Callable[[F64, F64], F64]

# --- streets -----------------------------------------------------------------------------------

CAR = (4.4, 1.8, 0.75, 0.2)  # length, width, height, clearance: a flat one
PERSON = (0.5, 0.5, 1.7, 0.0)
KERB = 0.13


@dataclass(frozen=True)
class Scan:
    points: F32  # in the sensor's frame
    height: F32  # above the terrain
    is_ground: Bool


def scan(
    terrain: Terrain,
    things: list[tuple[float, float, tuple[float, float, float, float]]],
    sensor: float = 1.7,
    beams: int = 64,
    noise: float = 0.015,
) -> Scan:
    """Ray-cast a turning LiDAR ``sensor`` metres above the terrain's origin."""
    o3d = load_open3d()
    x = np.arange(-90.0, 90.1, 1.0)
    y = np.sort(np.concatenate([np.arange(-60.0, 60.1, 1.0), [-4.001, 4.001]]))
    gx, gy = np.meshgrid(x, y, indexing="ij")
    corner = (np.arange(len(x) - 1)[:, None] * len(y) + np.arange(len(y) - 1)).ravel()
    right, ahead = corner + 1, corner + len(y)
    faces = np.concatenate([np.stack([corner, ahead, right], 1), np.stack([right, ahead, ahead + 1], 1)])
    vertices = np.stack([gx, gy, terrain(gx, gy)], -1).reshape(-1, 3)
    world = o3d.t.geometry.RaycastingScene()
    world.add_triangles(vertices.astype(np.float32), faces.astype(np.uint32))
    for cx, cy, (length, width, height, clearance) in things:
        box = o3d.geometry.TriangleMesh.create_box(length, width, height)
        foot = float(terrain(np.array(cx), np.array(cy))) + clearance
        box.translate([cx - length / 2, cy - width / 2, foot])
        world.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(box))
    down = np.radians(np.linspace(-25, 3, beams))[:, None]
    azimuth = np.linspace(-np.pi, np.pi, 1200, endpoint=False)[None]
    up = np.sin(down) + 0 * azimuth
    rays = np.stack([np.cos(down) * np.cos(azimuth), np.cos(down) * np.sin(azimuth), up], -1).reshape(-1, 3)
    eye = np.array([0, 0, float(terrain(np.array(0.0), np.array(0.0))) + sensor])
    answer = world.cast_rays(np.hstack([np.broadcast_to(eye, rays.shape), rays]).astype(np.float32))
    reach = answer["t_hit"].numpy().astype(np.float64)
    seen = np.isfinite(reach)
    reach += np.random.default_rng(0).normal(0, noise, len(reach))
    points = rays[seen] * reach[seen, None]
    height = points[:, 2] + eye[2] - terrain(points[:, 0], points[:, 1])
    return Scan(
        points.astype(np.float32), height.astype(np.float32), answer["geometry_ids"].numpy()[seen] == 0
    )


def flat(x: F64, y: F64) -> F64:
    return 0.0 * x * y


def tilted(x: F64, y: F64) -> F64:
    return 0.06 * x - 0.04 * y


def street(x: F64, y: F64) -> F64:
    """Level, then 8% up from 12 m on, 5% down behind; pavements a kerb higher beyond 4 m to each side."""
    return 0.08 * np.maximum(x - 12, 0) + 0.05 * np.minimum(x + 10, 0) + KERB * (np.abs(y) > 4.0005)


def crest(x: F64, y: F64) -> F64:
    return -0.002 * x * x / (1 + np.abs(x) / 40) + 0.01 * y


TERRAINS = [flat, tilted, street, crest]
THINGS = [(9.0, -2.5, CAR), (-8.0, 2.5, CAR), (18.0, 2.0, CAR), (7.0, 5.0, PERSON), (25.0, -5.5, PERSON)]


def assert_true(found: Scan, config: GroundConfig = GroundConfig(), within: float = 40.0) -> None:  # noqa: B008
    ground = segment_ground(found.points, config)
    near = np.hypot(found.points[:, 0], found.points[:, 1]) < within
    assert ground.mask[near & found.is_ground].mean() > 0.99
    standing = near & ~found.is_ground & (found.height > config.distance_threshold + 0.1)
    assert (~ground.mask[standing]).mean() > 0.99
    error = np.abs(ground.height - found.height)[near]
    assert np.median(error) < 0.02
    assert np.quantile(error, 0.98) < 0.15


@pytest.mark.parametrize("terrain", TERRAINS)
def test_polar_follows_slopes_and_kerbs(terrain: Terrain) -> None:
    assert_true(scan(terrain, THINGS))


@pytest.mark.parametrize("sensor", [0.4, 1.0, 2.5])
def test_height_of_the_sensor_is_found(sensor: float) -> None:
    assert_true(scan(street, THINGS, sensor=sensor), within=20)
    assert_true(scan(street, THINGS, sensor=sensor), GroundConfig(sensor_height=sensor), within=20)


def test_ground_is_found_with_few_beams() -> None:
    assert_true(scan(street, THINGS, beams=16), within=25)


def test_reflections_below_the_road_are_ignored() -> None:
    found = scan(street, THINGS)
    rng = np.random.default_rng(0)
    below = found.points[found.is_ground][rng.integers(0, found.is_ground.sum(), 4000)]
    below[:, 2] -= rng.uniform(0.5, 4, len(below)).astype(np.float32)
    found = Scan(
        np.vstack([found.points, below]),
        np.append(found.height, np.full(len(below), np.nan, np.float32)),
        np.append(found.is_ground, np.zeros(len(below), bool)),
    )
    ground = segment_ground(found.points, GroundConfig())
    real = np.isfinite(found.height)
    assert_true(Scan(found.points[real], found.height[real], found.is_ground[real]))
    assert ground.mask[~real].all()
    error = np.abs(ground.height - found.height)[real & (np.hypot(*found.points[:, :2].T) < 40)]
    assert np.median(error) < 0.02
    assert np.quantile(error, 0.98) < 0.15


def test_missing_sectors_are_bridged() -> None:
    """The wedges that a mast hides near the sensor, and all beyond them but a strip far away."""
    found = scan(street, THINGS)
    turn = np.degrees(np.arctan2(found.points[:, 1], found.points[:, 0]))
    hidden = (np.abs(np.abs(turn) - 60) < 25) & (np.hypot(found.points[:, 0], found.points[:, 1]) < 12)
    hidden |= np.abs(turn) > 170
    assert_true(Scan(found.points[~hidden], found.height[~hidden], found.is_ground[~hidden]))


def test_a_kerb_makes_no_cluster() -> None:
    found = scan(street, [])
    near = np.hypot(found.points[:, 0], found.points[:, 1]) < 30
    ground = segment_ground(found.points, GroundConfig())
    assert dbscan(found.points[near & ~ground.mask], 0.5, 10).max(initial=-1) == -1


coordinates = st.floats(-99, 99, width=32)


@settings(deadline=None)
@given(hnp.arrays(np.float32, st.tuples(st.integers(1, 50), st.just(3)), elements=coordinates))
def test_points_fall_into_their_polar_cells(points: F32) -> None:
    rings, sectors = 30, 180
    ring, sector, order, start = _sort_into_bins(points, rings, sectors)
    assert ring.dtype == sector.dtype == np.float32
    assert ((sector >= 0) & (sector < sectors)).all()
    for (x, y, _), r, s in zip(points.tolist(), ring.tolist(), sector.tolist(), strict=True):
        assert r == pytest.approx(RING_COUNT * math.asinh(math.hypot(x, y) / RING_SCALE), rel=1e-4, abs=1e-4)
        turn = abs(s - math.atan2(y, x) % math.tau / math.tau * sectors)
        assert min(turn, sectors - turn) < 1e-3
    bins = np.minimum(ring.astype(int), rings - 1) * sectors + sector.astype(int)
    assert sorted(order.tolist()) == list(range(len(points)))
    assert bins[order].tolist() == np.repeat(np.arange(rings * sectors), np.diff(start)).tolist()


@settings(deadline=None, max_examples=15)
@given(st.floats(-0.12, 0.12), st.floats(-0.12, 0.12), st.floats(0.5, 3.0))
def test_any_plane_is_found(along: float, across: float, sensor: float) -> None:
    found = scan(lambda x, y: along * x + across * y, [(9.0, 2.0, PERSON)], sensor=sensor, beams=32)
    ground = segment_ground(found.points, GroundConfig())
    assert ground.mask[found.is_ground].mean() > 0.995
    assert np.median(np.abs(ground.height - found.height)) < 0.02


@pytest.mark.parametrize("method", ["polar", "plane"])
@pytest.mark.parametrize("count", [0, 1, 2, 50])
def test_too_few_points_have_no_plane(method: str, count: int) -> None:
    line = np.linspace(1, 5, count)[:, None] * np.ones((1, 3))
    ground = segment_ground(line.astype(np.float32), GroundConfig.model_validate({"method": method}))
    assert not ground.mask.any()
    assert np.isnan(ground.height).all()
    assert ground.mask.shape == ground.height.shape == (count,)


# --- real scans --------------------------------------------------------------------------------


def kitti(shared: Path, frame: str) -> F32:
    points = np.fromfile(shared / "kitti" / "velodyne" / f"{frame}.bin", np.float32).reshape(-1, 4)
    return np.ascontiguousarray(points[:, :3])


def labelled_boxes(shared: Path, frame: str) -> list[tuple[str, F64, F64]]:
    """Class, centre of the foot and (length, width, height) of each label, in the LiDAR's frame."""
    lines = (shared / "kitti" / "calib" / f"{frame}.txt").read_text().splitlines()
    calib = {k: np.array(v.split(), float) for k, v in (line.split(":") for line in lines if ":" in line)}
    camera_from_lidar = np.vstack([calib["Tr_velo_to_cam"].reshape(3, 4), [0, 0, 0, 1]])
    rectify = np.eye(4)
    rectify[:3, :3] = calib["R0_rect"].reshape(3, 3)
    lidar_from_camera = np.linalg.inv(rectify @ camera_from_lidar)
    boxes = []
    for line in (shared / "kitti" / "label_2" / f"{frame}.txt").read_text().splitlines():
        name, *numbers = line.split()
        h, w, length, x, y, z = map(float, numbers[7:13])
        if name != "DontCare":
            boxes.append((name, (lidar_from_camera @ [x, y, z, 1])[:3], np.array([length, w, h])))
    return boxes


def test_pedestrian_keeps_its_points(shared: Path) -> None:
    points = kitti(shared, "000000")
    [(name, foot, size)] = labelled_boxes(shared, "000000")
    assert name == "Pedestrian"
    ground = segment_ground(points, GroundConfig())
    inside = np.hypot(*(points[:, :2] - foot[:2]).T) < size[0] / 2
    body = inside & (points[:, 2] > foot[2] + 0.3) & (points[:, 2] < foot[2] + size[2])
    assert body.sum() > 100
    assert (~ground.mask[body]).mean() > 0.99
    # The ground under its feet is where the label stands.
    surface = points[inside, 2] - ground.height[inside]
    assert abs(np.median(surface) - foot[2]) < 0.15


def test_labels_stand_on_the_ground(shared: Path) -> None:
    points = kitti(shared, "000001")
    ground = segment_ground(points, GroundConfig())
    for _, foot, size in labelled_boxes(shared, "000001"):
        around = np.hypot(*(points[:, :2] - foot[:2]).T) < size[0] / 2 + 1
        assert abs(np.median(points[around, 2] - ground.height[around]) - foot[2]) < 0.5


def test_road_is_ground(shared: Path) -> None:
    """Ahead of the car of frame 000001 the road is free for 40 m: below 20 cm, nothing is left of it."""
    points = kitti(shared, "000001")
    road = (points[:, 0] > 4) & (points[:, 0] < 40) & (points[:, 1] > -1) & (points[:, 1] < 4)
    ground = segment_ground(points, GroundConfig())
    assert road.sum() > 8000
    assert ground.mask[road].mean() > 0.99


@pytest.mark.parametrize("angle", [15, 20, 25])
def test_a_bank_beside_the_road_is_ground(angle: float) -> None:
    """From 8 m to the left on, 3 m high, with grass on it; 30 m of it alongside."""
    ground, bank = _beside(angle, 30.0)
    assert ground.mask[bank].mean() > 0.9


def test_a_short_slope_is_an_obstacle() -> None:
    """As a car's bonnet: what is as steep and a car's width alongside stays above the ground."""
    ground, bank = _beside(30, 1.8)
    assert ground.mask[bank].mean() < 0.4


def _beside(angle: float, length: float) -> tuple[Ground, Bool]:
    rng = np.random.default_rng(0)
    road = np.column_stack([rng.uniform(-20, 20, 60_000), rng.uniform(-8, 8, 60_000), np.full(60_000, -1.7)])
    wide = min(3.0 / np.tan(np.radians(angle)), 2.0 if length < 5 else 12.0)
    count = int(length * wide * 80)
    across = rng.uniform(0, wide, count)
    rising = np.column_stack(
        [
            rng.uniform(-length / 2, length / 2, count),
            8 + across,
            -1.7 + np.tan(np.radians(angle)) * across + 0.03 * rng.standard_normal(count),
        ]
    )
    points = np.vstack([road, rising]).astype(np.float32)
    bank = np.arange(len(points)) >= len(road)
    bank[bank] = points[bank, 2] > -1.4  # above where its foot would be called ground anyway
    return segment_ground(points, GroundConfig()), bank


# --- the reference's plane ---------------------------------------------------------------------


@pytest.mark.parametrize("frame", ["000000", "000001"])
def test_the_plane_equals_open3ds(shared: Path, frame: str) -> None:
    o3d = load_open3d()
    points = kitti(shared, frame)
    ground = segment_ground(points, GroundConfig(method="plane", distance_threshold=0.5, iterations=300))
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))
    o3d.utility.random.seed(0)
    plane, inliers = cloud.segment_plane(0.5, 3, 300)
    plane = np.asarray(plane) * np.sign(plane[2])
    assert ground.plane is not None
    assert abs(ground.plane[:3] @ plane[:3]) > np.cos(np.radians(1.5))
    assert abs(ground.plane[3] - plane[3]) < 0.1
    assert ground.mask.sum() > 0.98 * len(inliers)


def test_plane_refits_as_open3d() -> None:
    """With every point an inlier there is one plane to find, whatever the samples."""
    o3d = load_open3d()
    rng = np.random.default_rng(0)
    points = rng.uniform([-10, -10, 4.8], [10, 10, 5.2], (2000, 3)).astype(np.float32)
    points[:, 2] += np.float32(0.1) * points[:, 0]
    ground = segment_ground(points, GroundConfig(method="plane", distance_threshold=5, iterations=10))
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))
    plane, inliers = cloud.segment_plane(5, 3, 10)
    assert ground.plane is not None
    assert ground.mask.sum() == len(inliers) == len(points)
    np.testing.assert_allclose(ground.plane, np.asarray(plane) * np.sign(plane[2]), atol=1e-6)
    np.testing.assert_allclose(ground.height, points @ ground.plane[:3] + ground.plane[3], atol=1e-4)


def test_plane_takes_a_wall_as_the_reference_does() -> None:
    rng = np.random.default_rng(0)
    wall = np.column_stack([np.full(3000, 5.0), rng.uniform(-9, 9, 3000), rng.uniform(0, 6, 3000)])
    floor = np.column_stack([rng.uniform(-9, 4, 500), rng.uniform(-9, 9, 500), np.zeros(500)])
    points = np.vstack([wall, floor]).astype(np.float32)
    ground = segment_ground(points, GroundConfig(method="plane", distance_threshold=0.1))
    assert ground.mask[:3000].mean() > 0.5
    assert ground.mask[3000:].mean() < 0.1


def test_plane_is_repeatable() -> None:
    points = scan(street, THINGS, beams=16).points
    config = GroundConfig(method="plane", iterations=5, seed=3)
    np.testing.assert_array_equal(segment_ground(points, config).mask, segment_ground(points, config).mask)
    other = segment_ground(points, config.model_copy(update={"seed": 4}))
    assert (other.mask != segment_ground(points, config).mask).any()


@pytest.mark.parametrize("ceiling", [2.6, 4.0])
@pytest.mark.parametrize("half", [4.0, 6.0, 8.0])
@pytest.mark.parametrize("height", [0.6, 1.0, 1.4])
def test_a_ceiling_is_no_ground(height: float, half: float, ceiling: float) -> None:
    """A solid-state LiDAR sees most of the ceiling and little of the floor, or none."""
    points, is_person = rooms.scan(height, half, ceiling)
    ground = segment_ground(points, GroundConfig())
    level = points[:, 2] - ground.height
    assert not np.nanmax(level, initial=-np.inf) > 0, "no ground lies above the sensor"
    assert ground.mask[is_person].mean() <= 0.15


def test_a_road_above_the_origin_of_its_frame_is_ground() -> None:
    """Points in a map's frame lie at its heights. What stands on the road lies above it."""
    x, y = np.meshgrid(np.arange(-15, 15, 0.3), np.arange(-15, 15, 0.3))
    road = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], -1)
    car = np.random.default_rng(0).uniform([4, -1, 0.3], [8, 1, 1.5], (2000, 3))
    points = (np.concatenate([road, car]) + np.array([0, 0, 12])).astype(np.float32)
    ground = segment_ground(points, GroundConfig())
    assert ground.mask[: len(road)].mean() > 0.95
    assert not ground.mask[len(road) :].any()
