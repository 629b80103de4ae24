"""Data of a calibration: the edges of image and cloud in each frame, and the motion of the robot."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from bevviz.model import geometry
from bevviz.model.frame import F32, F64, I32, U8, Bool, Camera, Frame, Intrinsics
from bevviz.stages.edges import Edges, cloud_edges, edges_in_view, image_edges, shrink, undistort

CELLS = (8, 4)  # parts of the image along u and v; the edges of one part have the same errors
PIXELS = 500_000  # larger images are scaled down to this size
REACH = np.radians(3.5)  # radians outside the image; edges up to there may still move into it
STEPS = np.arange(-15, 16) * 10_000_000  # nanoseconds from the image's stamp at which the pose is looked up

Pose = Callable[[Frame, int], F64 | None]  # fixed_from_points at a stamp; None: unknown


@dataclass(frozen=True, slots=True)
class Shot:
    """One image with the edges of the cloud of its frame."""

    frame: Frame
    camera: Camera
    K: F64  # (3, 3) of the undistorted and scaled image that ``maps`` is made from
    maps: U8  # (4, H, W) see ``image_edges``
    xyz: F32  # (E, 3) edges of the cloud, in Frame.points_frame
    change: U8  # (E,) expected change of the image at each edge: a row of ``edges.CHANGES``
    cell: I32  # (E,) part of the image that each edge projects to, as stated
    mounting: F64  # (4, 4) camera_from_points as stated, for a robot that stands still
    motion: F64 | None  # (T, 4, 4) points at the image's stamp + STEPS from points at the cloud's stamp

    def camera_from_points(self, late: float) -> F64:
        """Return the stated (4, 4) pose for an image that was taken ``late`` seconds before its stamp."""
        if self.motion is None:
            return self.mounting
        at = min(max((-late * 1e9 - STEPS[0]) / (STEPS[1] - STEPS[0]), 0.0), len(STEPS) - 1.0)
        i = min(int(at), len(STEPS) - 2)
        # The poses are 10 ms apart, so that their mean is almost rigid.
        moved = (i + 1 - at) * self.motion[i] + (at - i) * self.motion[i + 1]
        return np.asarray(self.mounting @ moved, np.float64)


@dataclass(slots=True)
class Shots:
    """All shots of one camera, and the reasons why other frames gave none."""

    camera: str
    shots: list[Shot] = field(default_factory=list)
    refused: Counter[str] = field(default_factory=Counter)

    @property
    def edges(self) -> int:
        """Number of edges of the cloud in all shots."""
        return sum(len(shot.xyz) for shot in self.shots)


def gather(frames: Iterable[Frame], cameras: Iterable[str], pose: Pose) -> dict[str, Shots]:
    """Find the edges in all frames.

    Args:
        frames: frames in order of stamp.
        cameras: names of the cameras to calibrate.
        pose: returns fixed_from_points at a stamp up to 0.15 s from that of an image. It is called for a
            frame after the next frame has come, so that a source that reads a bag has the later transforms.

    Returns:
        the shots of each camera, by name.
    """
    shots_by_camera = {name: Shots(name) for name in cameras}
    last: Frame | None = None
    for frame in frames:
        if last is not None:
            _take(last, shots_by_camera, pose)
        last = frame
    if last is not None:
        _take(last, shots_by_camera, pose)
    return shots_by_camera


def _take(frame: Frame, shots_by_camera: dict[str, Shots], pose: Pose) -> None:
    """Add a shot of the frame to each camera, or the reason why there is none."""
    parts = []
    for cloud, points_from_cloud in zip(frame.clouds, frame.points_from_clouds, strict=True):
        edges = cloud_edges(cloud)
        parts.append(
            Edges(
                geometry.apply(points_from_cloud, edges.xyz),
                edges.towards @ points_from_cloud[:3, :3].T.astype(np.float32),
                edges.bright,
            )
        )
    together = Edges(*(np.concatenate(columns) for columns in zip(*map(_columns, parts), strict=True)))
    for camera in frame.cameras:
        if camera.name not in shots_by_camera:
            continue
        shots = shots_by_camera[camera.name]
        if camera.image is None or camera.intrinsics is None or camera.camera_from_points is None:
            reason = camera.problems[0] if camera.problems else "no image, calibration or transform"
            shots.refused[reason] += 1
            continue
        shots.shots.append(_shot(frame, camera, together, pose))


def _columns(edges: Edges) -> tuple[F32, F32, Bool]:
    """Return the arrays of the edges in the order of the class."""
    return edges.xyz, edges.towards, edges.bright


def _shot(frame: Frame, camera: Camera, edges: Edges, pose: Pose) -> Shot:
    """Return the shot of one camera, with the edges that project into the image or near it."""
    assert camera.image is not None and camera.intrinsics is not None
    assert camera.camera_from_points is not None
    motion = _motion(frame, camera.image.stamp, pose)
    mounting = camera.camera_from_points
    if camera.motion_compensated and motion is not None:
        mounting = mounting @ geometry.inverse(motion[len(STEPS) // 2])
    flat_image = undistort(camera.image.bgr, camera.intrinsics)
    picture, K = shrink(flat_image, camera.intrinsics.K, PIXELS)
    height, width = picture.shape[:2]
    view = Intrinsics(width, height, K)
    xyz, uv, change = edges_in_view(edges, camera.camera_from_points, view, REACH)
    size = np.array([width, height], np.float32)
    column, row = np.clip(uv / size * CELLS, 0, np.array(CELLS) - 1).astype(np.int32).T
    cell = row * CELLS[0] + column
    return Shot(frame, camera, K, image_edges(picture), xyz, change, cell, mounting, motion)


def _motion(frame: Frame, stamp: int, pose: Pose) -> F64 | None:
    """Return the (T, 4, 4) motion around the stamp of an image, None where a pose is unknown."""
    here = pose(frame, frame.stamp)
    poses = [pose(frame, stamp + int(step)) for step in STEPS] if here is not None else []
    known = [geometry.inverse(then) @ here for then in poses if then is not None and here is not None]
    return np.stack(known) if len(known) == len(STEPS) else None
