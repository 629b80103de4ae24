"""What a calibration is made from: for each frame and camera the edges of both, and how the robot moved."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import cv2
import numpy as np

from bevviz import geometry
from bevviz.calib.edges import cloud_edges, image_edges
from bevviz.frame import F32, F64, I32, U8, Camera, Frame, Intrinsics

GROUPS = 8  # parts of the data that are compared with each other
STRIPS = 4  # a frame is cut into so many upright parts where there are fewer frames than groups
PIXELS = 500_000  # larger images are scaled down to this size
MARGIN = 0.05  # edges that project this share of the image outside may still come in
NEAREST, FARTHEST = 2.0, 60.0  # metres: the robot itself; an edge of more than a pixel
STEPS = np.arange(-15, 16) * 10_000_000  # nanoseconds around the image at which the pose is looked up

Pose = Callable[[Frame, int], F64 | None]  # fixed_from_points at a stamp; None: not known


@dataclass(frozen=True, slots=True)
class Shot:
    """One image and the cloud that goes with it."""

    frame: Frame
    camera: Camera
    K: F64  # (3, 3) of the image that the edges are from, free of distortion
    maps: F32  # (2, H, W) see ``image_edges``
    xyz: F32  # (E, 3) edges of the cloud, in Frame.points_frame
    across: U8  # (E,) map that each edge is compared with
    group: I32  # (E,) below GROUPS
    mounting: F64  # (4, 4) camera_from_points as stated, the robot standing still
    motion: F64 | None  # (T, 4, 4) points at the image's stamp + STEPS from points at the cloud's

    def camera_from_points(self, late: float) -> F64:
        """As stated, for an image that was taken ``late`` seconds before its stamp."""
        if self.motion is None:
            return self.mounting
        at = float(np.clip((-late * 1e9 - STEPS[0]) / (STEPS[1] - STEPS[0]), 0, len(STEPS) - 1))
        i = min(int(at), len(STEPS) - 2)
        return self.mounting @ geometry.interpolate(self.motion[i], self.motion[i + 1], at - i)


@dataclass(slots=True)
class Shots:
    """All shots of one camera, and why other frames gave none."""

    camera: str
    shots: list[Shot] = field(default_factory=list)
    refused: Counter[str] = field(default_factory=Counter)

    @property
    def edges(self) -> int:
        return sum(len(shot.xyz) for shot in self.shots)


def gather(frames: Iterable[Frame], cameras: Iterable[str], pose: Pose) -> dict[str, Shots]:
    """Find the edges in all frames.

    Args:
        frames: in order of stamp.
        cameras: names of those that are looked at.
        pose: where the points' frame was at a stamp up to 0.15 s from an image's; asked for a frame only when
            the next one has come, so that a source that reads a bag has the transforms after it.

    Returns:
        the shots of each camera, by name.
    """
    found = {name: Shots(name) for name in cameras}
    last: Frame | None = None
    for frame in frames:
        if last is not None:
            _take(last, found, pose)
        last = frame
    if last is not None:
        _take(last, found, pose)
    for shots in found.values():
        _group(shots.shots)
    return found


def _take(frame: Frame, found: dict[str, Shots], pose: Pose) -> None:
    edges = [cloud_edges(cloud) for cloud in frame.clouds]
    xyz = np.concatenate(
        [geometry.apply(p, e.xyz) for e, p in zip(edges, frame.points_from_clouds, strict=True)]
    )
    across = np.concatenate([e.across for e in edges])
    for camera in frame.cameras:
        if camera.name not in found:
            continue
        shots = found[camera.name]
        if camera.image is None or camera.intrinsics is None or camera.camera_from_points is None:
            reason = camera.problems[0] if camera.problems else "no image, calibration or transform"
            shots.refused[reason] += 1
            continue
        shots.shots.append(_shot(frame, camera, xyz, across, pose))


def _shot(frame: Frame, camera: Camera, xyz: F32, across: U8, pose: Pose) -> Shot:
    assert camera.image is not None and camera.intrinsics is not None
    assert camera.camera_from_points is not None
    motion = _motion(frame, camera.image.stamp, pose)
    mounting = camera.camera_from_points
    if camera.motion_compensated and motion is not None:
        mounting = mounting @ geometry.inverse(motion[len(STEPS) // 2])
    picture, K = _flatten(camera.image.bgr, camera.intrinsics)
    height, width = picture.shape[:2]
    seen = geometry.apply(camera.camera_from_points, xyz)
    uv, depth = geometry.project(seen, Intrinsics(width, height, K))
    margin = np.array([width, height], np.float32) * MARGIN
    with np.errstate(invalid="ignore"):
        inside = ((uv > -margin) & (uv < np.array([width, height]) + margin)).all(axis=1)
    inside &= (depth > NEAREST) & (depth < FARTHEST)
    strip = np.clip(uv[inside, 0] / width * STRIPS, 0, STRIPS - 1).astype(np.int32)
    return Shot(frame, camera, K, image_edges(picture), xyz[inside], across[inside], strip, mounting, motion)


def _motion(frame: Frame, stamp: int, pose: Pose) -> F64 | None:
    """None where the way of the robot is not known all around the image's stamp."""
    here = pose(frame, frame.stamp)
    there = [pose(frame, stamp + int(step)) for step in STEPS] if here is not None else []
    known = [geometry.inverse(p) @ here for p in there if p is not None and here is not None]
    return np.stack(known) if len(known) == len(STEPS) else None


def _flatten(bgr: U8, intrinsics: Intrinsics) -> tuple[U8, F64]:
    """The image without distortion and not larger than need be, and its camera matrix."""
    picture, K = bgr, intrinsics.K
    if np.any(intrinsics.D):
        if intrinsics.distortion_model in geometry.FISHEYE:
            picture = cv2.fisheye.undistortImage(picture, K, intrinsics.D[:4], Knew=K)
        else:
            picture = cv2.undistort(picture, K, intrinsics.D)
    height, width = picture.shape[:2]
    scale = np.sqrt(PIXELS / (height * width))
    if scale >= 1:
        return picture, K
    size = round(width * scale), round(height * scale)
    sx, sy = size[0] / width, size[1] / height
    shrink = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]])
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA), shrink @ K


def _group(shots: list[Shot]) -> None:
    """Deal the edges out: whole frames in turn where there are enough of them, else strips of frames."""
    for number, shot in enumerate(shots):
        shot.group[:] = number if len(shots) >= GROUPS else number * STRIPS + shot.group
        shot.group[:] %= GROUPS
