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


def noisy(bgr: U8, sigma: float, seed: int = 0) -> U8:
    """Add noise of ``sigma`` grey values."""
    noise = np.rint(np.random.default_rng(seed).normal(0, sigma, bgr.shape)).astype(np.int16)
    return np.asarray(np.clip(bgr.astype(np.int16) + noise, 0, 255), np.uint8)


def recompressed(bgr: U8, quality: int) -> U8:
    """Compress an image as JPEG and decode it."""
    code = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(code, cv2.IMREAD_COLOR), np.uint8)


def covered(bgr: U8, share: float = 0.4, grey: int = 30) -> U8:
    """Cover the left part of the lens."""
    image = bgr.copy()
    image[:, : int(share * bgr.shape[1])] = grey
    return noisy(image, 2)


def defocused(bgr: U8, sigma: float = 12) -> U8:
    return np.asarray(cv2.GaussianBlur(bgr, (0, 0), sigma), np.uint8)


def muddy(bgr: U8, seed: int) -> U8:
    """Splash twelve blots of mud on the lens."""
    random, (height, width) = np.random.default_rng(seed), bgr.shape[:2]
    mud = np.zeros((height, width), np.float32)
    for _ in range(12):
        place = int(random.uniform(0, width)), int(random.uniform(0.2 * height, height))
        size = int(random.uniform(0.03, 0.1) * width), int(random.uniform(0.03, 0.1) * width)
        cv2.ellipse(mud, place, size, float(random.uniform(0, 180)), 0, 360, 1.0, -1)
    share = 0.95 * np.asarray(cv2.GaussianBlur(mud, (0, 0), 0.008 * width))[..., None]
    blots = 0.4 * cv2.GaussianBlur(bgr, (0, 0), 0.03 * width) + 0.6 * np.array([40, 60, 80])
    return noisy((bgr * (1 - share) + share * blots).astype(np.uint8), 2)


def without_image(result: FrameResult) -> FrameResult:
    return with_camera(result, replace(result.frame.cameras[0], image=None))


def without_far_returns(result: FrameResult, reach: float = 15.0) -> FrameResult:
    points = result.frame.points
    return with_scan(result, points[np.hypot(points[:, 0], points[:, 1]) < reach])


def thinned(result: FrameResult, share: float, seed: int = 0) -> FrameResult:
    """Keep a share of the returns, by chance."""
    points = result.frame.points
    return with_scan(result, points[np.random.default_rng(seed).random(len(points)) < share])


def jittered(result: FrameResult, points: F32, seed: int, sigma: float = 0.01) -> FrameResult:
    """Return a result with other points, whose ranges have new noise of ``sigma`` metres."""
    distance = np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1)
    noise = np.random.default_rng(seed).normal(0, sigma, (len(points), 1)) / distance
    return with_scan(result, np.asarray(points * (1 + noise), np.float32))


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


def blocked_sector(result: FrameResult, left: float = 0.0) -> FrameResult:
    """Remove 35 degrees of a scan, to the right, but for the share ``left`` of their returns."""
    xyz = result.frame.points
    azimuth = np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0]))
    stays = np.random.default_rng(0).random(len(xyz)) < left
    return with_scan(result, xyz[(azimuth < -48) | (azimuth > -13) | stays])
