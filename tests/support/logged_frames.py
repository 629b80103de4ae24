"""A frame result that has something of everything that is logged."""

from __future__ import annotations

import dataclasses
from typing import Any

import cv2
import numpy as np

from bevviz.config import load
from bevviz.model import geometry
from bevviz.model.decisions import explain
from bevviz.model.frame import (
    U8,
    Boxes3D,
    Camera,
    Cloud,
    Frame,
    Image,
    Intrinsics,
    Scene,
)
from bevviz.model.results import (
    CameraResult,
    Clusters,
    Decision,
    Detections,
    DetectionState,
    FrameResult,
    Fusion,
    Ground,
    Objects,
    Pairs,
    Voxels,
)
from bevviz.stages.bev import bev

SCENE = Scene("drive", "lidar", ("lidar",), ("zed",), robot=True, truth=True)
START = 1_700_000_000_123_456_789
JPEG = cv2.imencode(".jpg", np.full((36, 64, 3), 90, np.uint8))[1].tobytes()


def frame_with_image(number: int, bgr: U8) -> Frame:
    """Return a frame of a drive at 10 Hz that holds one image and no points."""
    stamp = START + number * 100_000_000
    camera = Camera("front", Image(stamp, "front", bgr), None, None, None)
    return Frame(number, stamp, 0, "", np.zeros((0, 3), np.float32), "base", cameras=(camera,))


WORLD_FROM_LIDAR = geometry.transform(np.array([5.0, -2.0, 1.7]), np.array([0, 0, 0.3, 0.95]))
LIDAR_FROM_CAMERA = geometry.transform(np.array([0.3, 0.0, -0.2]), np.array([-0.5, 0.5, -0.5, 0.5]))
WORLD_FROM_CAMERA = WORLD_FROM_LIDAR @ LIDAR_FROM_CAMERA
INTRINSICS = Intrinsics(64, 36, np.array([[40.0, 0, 31.5], [0, 40.0, 17.5], [0, 0, 1]]))


def f32(*rows: Any) -> Any:
    return np.array(rows, np.float32)


def make(index: int = 0, **changes: Any) -> FrameResult:
    """One frame in which a person at 8 m is matched, a car is not, and a third box is too weak."""
    config = changes.pop("config", load())
    stamp = START + index * 100_000_000
    rng = np.random.default_rng(index)
    person = rng.normal((8, 0.5, -0.8), 0.1, (20, 3))
    bush = rng.normal((12, -6, -1), 0.1, (15, 3))
    road = np.column_stack([rng.uniform(3, 30, 100), rng.uniform(-10, 10, 100), np.full(100, -1.7)])
    points = np.concatenate([road, person, bush, [[20.0, 9.0, 0.0]]]).astype(np.float32)
    ground = np.arange(len(points)) < 100
    obstacles = points[~ground]
    labels = np.repeat(np.array([0, 1, -1], np.int32), [20, 15, 1])
    boxes = Boxes3D(f32([8, 0.5, -0.8], [12, -6, -1]), f32([0.6, 0.5, 1.7], [2, 1, 1]), f32(0, 0.4))
    zero = np.zeros(2, np.int32)
    clusters = Clusters(
        labels, zero, np.array([20, 15], np.int32), boxes.center.astype(np.float32), boxes, boxes
    )
    detections = Detections(
        f32([20, 10, 30, 30], [40, 15, 60, 25], [0, 0, 5, 5]),
        f32(0.9, 0.5, 0.1),
        np.array([0, 2, 2], np.int32),
        ("person", "car", "car"),
        np.array([DetectionState.KEPT, DetectionState.KEPT, DetectionState.BELOW_THRESHOLD], np.int32),
        np.full(3, -1, np.int32),
        np.zeros(3, np.float32),
    )
    one = np.array([0], np.int32)
    pairs = Pairs(one, one, one + 14, f32(7.8), f32(0.61), f32(3), f32(0.4))
    fusion = Fusion(
        np.array([Decision.MATCHED, Decision.NO_CLUSTER, Decision.NOT_KEPT], np.int32),
        np.array([0, -1, -1], np.int32),
        np.array([14, 3, 0], np.int32),
        np.array([Decision.MATCHED, Decision.OUT_OF_VIEW], np.int32),
        np.array([0, -1], np.int32),
        pairs,
        f32([20, 10, 30, 30], [np.nan] * 4),
    )
    camera_from_lidar = geometry.inverse(LIDAR_FROM_CAMERA)
    uv, depth = geometry.project(geometry.apply(camera_from_lidar, obstacles), INTRINSICS)
    uv[20:] = np.nan
    bgr = np.full((36, 64, 3), 90, np.uint8)
    image = Image(stamp + 20_000_000, "zed", bgr, JPEG, "image/jpeg")
    camera = Camera("zed", image, INTRINSICS, camera_from_lidar, WORLD_FROM_CAMERA, 0.02, 0.005)
    cameras = (CameraResult(camera, detections, fusion, uv, depth),)
    cloud = Cloud(stamp, "lidar", points, {}, "/points", stamp + 30_000_000, dropped=7, name="lidar")
    frame = Frame(
        index=index,
        stamp=stamp,
        received=stamp + 30_000_000,
        lidar="lidar",
        points=points,
        points_frame="lidar",
        world_frame="map",
        world_from_points=WORLD_FROM_LIDAR,
        clouds=(cloud,),
        points_from_clouds=(np.eye(4),),
        cameras=(camera,),
        tf_age=0.004,
    )
    objects = Objects(
        Boxes3D(boxes.center[:1], boxes.size[:1], boxes.yaw[:1]), ("person",), f32(0.9), one, ("zed",), one
    )
    result = FrameResult(
        frame=frame,
        config=config,
        voxels=Voxels(points, np.arange(len(points), dtype=np.int32)),
        ground=Ground(ground, points[:, 2] + np.float32(1.7)),
        obstacles=obstacles,
        clusters=clusters,
        cameras=cameras,
        objects=objects,
        bev=bev(points, None, ground, objects, clusters, config.bev),
        explanations=explain(cameras, clusters, config),
        timings={"voxel": 0.004, "total": 0.02},
    )
    return dataclasses.replace(result, **changes)
