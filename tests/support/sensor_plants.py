"""Faults of sensors, planted in the results of a drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from bevviz.model import geometry
from bevviz.model.frame import F32, F64, U8, Camera
from bevviz.model.results import FrameResult

Results = Sequence[FrameResult]


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
    camera, turn = result.frame.cameras[0], rotation(axis, degrees)
    assert camera.camera_from_points is not None
    mounting = None if camera.mounting is None else turn @ camera.mounting
    moved = replace(camera, camera_from_points=turn @ camera.camera_from_points, mounting=mounting)
    return with_camera(result, moved)


def blocked_sector(result: FrameResult) -> FrameResult:
    """Remove 35 degrees of a scan, to the right."""
    xyz = result.frame.points
    azimuth = np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0]))
    return with_scan(result, xyz[(azimuth < -48) | (azimuth > -13)])
