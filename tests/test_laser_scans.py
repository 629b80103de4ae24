"""Scans of one plane (LaserScan) as the cloud of a LiDAR."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import bevviz
from bevviz.config import SourceConfig, load
from bevviz.messages.roles import find_roles
from bevviz.messages.topics import Topic
from bevviz.model.frame import Camera, Cloud, Frame, Image, Intrinsics
from bevviz.model.results import Detections, FrameResult, Objects
from bevviz.pipeline.perceive import suited_to_planes
from bevviz.pipeline.session import Session
from bevviz.stages.clustering import cluster
from bevviz.stages.planar_boxes import whole_boxes
from tests.support import bags

SCAN = "sensor_msgs/msg/LaserScan"
RAYS = 720


def room(number: int) -> list[float]:
    """Return the ranges in a room of 10 m with a pillar 3 m ahead, and nothing behind the sensor."""
    angles = np.linspace(-np.pi, np.pi, RAYS, endpoint=False)
    walls = 5 / np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))
    walls[np.abs(angles) > 3] = np.inf
    walls[np.abs(angles) < 0.1] = 3.0 + 0.01 * number
    return [float(value) for value in walls]


def test_a_scan_of_one_plane_has_clusters_and_no_ground(tmp_path: Path) -> None:
    made, items = bags.Messages(), []
    for number in range(3):
        stamp = bags.START + number * bags.PERIOD
        scan = made.make(
            SCAN,
            header=made.header(stamp, "laser"),
            angle_min=-np.pi,
            angle_max=np.pi,
            angle_increment=2 * np.pi / RAYS,
            time_increment=1e-4,
            scan_time=0.1,
            range_min=0.1,
            range_max=30.0,
            ranges=np.array(room(number), np.float32),
            intensities=np.zeros(0, np.float32),
        )
        items.append(bags.Item("/scan", SCAN, stamp, scan))
    drive = bevviz.open(bags.write(tmp_path / "drive", items, made), set={"clustering.min_points": 3})
    result = drive.at(frame=1)
    assert result.failures == () and len(drive) == 3
    frame, clusters, ground = result.frame, result.clusters, result.ground
    assert clusters is not None and ground is not None and not ground.mask.any()
    assert frame.is_planar and frame.lidar == "laser"
    assert len(frame.points) == np.isfinite(room(1)).sum()
    np.testing.assert_allclose(frame.fields["time"][:2], np.arange(17, 19) * 1e-4, atol=1e-6)
    away = np.linalg.norm(clusters.centroid - [3.01, 0, 0], axis=1)
    assert (away < 0.1).sum() == 1, "the pillar is a cluster of its own"


def test_scans_of_one_plane_are_the_lidar_without_clouds() -> None:
    scan, cloud = (
        Topic("/scan", SCAN, 9, "laser"),
        Topic("/points", "sensor_msgs/msg/PointCloud2", 9, "lidar"),
    )
    filtered = Topic("/scan_filtered", SCAN, 9, "laser")
    alone = find_roles([scan, filtered], SourceConfig())
    assert alone.lidars == ("/scan",) and [name for name, *_ in alone.around] == ["/scan_filtered"]
    assert find_roles([scan, cloud], SourceConfig()).lidars == ("/points",)
    stated = find_roles([scan, cloud], SourceConfig(lidar_topics=("/scan",)))
    assert stated.lidars == ("/scan",) and stated.around == ()


def seen_in_room(*legs: tuple[float, float]) -> FrameResult:
    """Run a scan of a room with legs 0.2 m above the floor, and a camera that sees one person at 3 m."""
    angles = np.radians(np.arange(-180, 180, 0.25))
    cos, sin = np.cos(angles), np.sin(angles)
    ranges = 5 / np.maximum(np.abs(cos), np.abs(sin))
    for x, y in legs:  # of radius 0.08 m
        along = cos * x + sin * y
        inside = along**2 - (x * x + y * y - 0.08**2)
        hit = (inside > 0) & (along > 0)
        ranges[hit] = np.minimum(ranges, along - np.sqrt(np.maximum(inside, 0)))[hit]
    points = np.column_stack([ranges * cos, ranges * sin, 0 * ranges]).astype(np.float32)
    image = Image(0, "camera", np.full((480, 640, 3), 90, np.uint8))
    lens = Intrinsics(640, 480, np.array([[450.0, 0, 320], [0, 450, 240], [0, 0, 1]]))
    pose = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0.2], [1, 0, 0, 0], [0, 0, 0, 1]])
    camera = Camera("camera", image, lens, pose, np.eye(4))
    cloud = Cloud(0, "laser", points, {}, name="laser")
    frame = Frame(0, 0, 0, "laser", points, "laser", clouds=(cloud,), cameras=(camera,))
    zeros, box = np.zeros(1, np.int32), np.array([[210, 37, 281, 301]], np.float32)
    score = np.array([0.9], np.float32)
    person = Detections(box, score, zeros, ("person",), zeros, zeros - 1, np.zeros(1, np.float32))
    return Session(load(), lambda _: person).run_single(frame)


def test_a_person_of_two_legs_is_found_by_default() -> None:
    """A plane shows no height, so that the widths are compared; a leg has few points."""
    result = seen_in_room((3, 0.4), (3, 0.6))
    assert result.objects is not None and result.objects.names == ("person",)
    np.testing.assert_allclose(result.objects.boxes.center[0, :2], [2.95, 0.5], atol=0.05)
    assert result.config.clustering.min_points == 4, "the answers name the values in use"


def test_a_stated_value_holds_for_scans_of_one_plane() -> None:
    stated = load(settings=["clustering.min_points=10", "voxel.size=0.05"])
    suited = suited_to_planes(stated)
    assert (suited.clustering.min_points, suited.voxel.size) == (10, 0.05)
    assert suited.clustering.min_cluster_points == 4


def test_a_car_of_which_the_rear_is_seen_is_whole() -> None:
    """Its centre is half a length behind the points."""
    rear = np.column_stack([np.full(40, 10.0), np.linspace(-0.9, 0.9, 40), np.zeros(40)]).astype(np.float32)
    clusters = cluster(rear, load().clustering)
    zero, score = np.zeros(1, np.int32), np.array([0.9], np.float32)
    seen = Objects(clusters.obb, ("car",), score, zero, ("camera",), zero, measured=clusters.obb)
    whole = whole_boxes(seen, rear, clusters, load().objects.sizes)
    assert seen.boxes.center[0, 0] == pytest.approx(10)
    assert 11.5 < whole.boxes.center[0, 0] < 13 and abs(whole.boxes.center[0, 1]) < 0.2
    assert whole.boxes.size[0, 0] > 3 and whole.measured is clusters.obb
    person = whole_boxes(replace(seen, names=("person",)), rear, clusters, load().objects.sizes)
    np.testing.assert_array_equal(person.boxes.center, seen.boxes.center)
