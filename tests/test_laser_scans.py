"""Scans of one plane (LaserScan) as the cloud of a LiDAR."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import bevviz
from bevviz.config import SourceConfig
from bevviz.messages.roles import find_roles
from bevviz.messages.topics import Topic
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
