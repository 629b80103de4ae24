"""Edges of images and clouds, and the score of how well they meet, with its gradient.

The edges of an image, blurred by ``sigma`` pixels, are a density of mean 1. A ``SHARE`` of the projected
edges of the cloud is drawn from this density, and the others fall anywhere. So the score of an edge is the
logarithm of 1 - SHARE + SHARE * density. An edge outside the image scores 0. This makes the scores of
different poses and of different images comparable. The score has the same peak as the inverse distance
transform of Levinson and Thrun, is smooth, and needs no threshold. Its gradient, with the information of the
edges that fit, gives one step of expectation-maximisation, with which a climb can start.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from bevviz.extras.calib.result import AXES, TIME, error_pose
from bevviz.model import geometry
from bevviz.model.frame import F32, F64, I32, I64, U8, Bool, Camera, Frame, Intrinsics
from bevviz.stages.edges import (
    SHARE,
    Edges,
    cloud_edges,
    densities,
    edges_in_view,
    image_edges,
    shrink,
    undistort,
)
from bevviz.support.numba_kernel import kernel

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


PIXEL = 1.5  # pixels^2, variance of the edges themselves
MOMENT = 0.01  # seconds over which the motion of the robot is differenced
PARTS = CELLS[0] * CELLS[1]


@dataclass(frozen=True, slots=True)
class Sums:
    """Score and slopes summed over the edges in each part of each shot.

    Shots and parts can be compared and left out.
    """

    score: F64  # (S, PARTS)
    count: F64  # (S, PARTS)
    gradient: F64  # (S, PARTS, 7)
    information: F64  # (7, 7) of the edges that fit

    @property
    def mean(self) -> float:
        """Mean score of an edge."""
        return float(self.score.sum() / max(float(self.count.sum()), 1.0))


class Scorer:
    """The score of all shots of one camera, at one blur.

    Args:
        shots: shots of the camera.
        sigma: blur in pixels.
    """

    def __init__(self, shots: Sequence[Shot], sigma: float) -> None:
        self.shots = shots
        self.sigma = sigma
        self.variance = sigma * sigma + PIXEL
        self.edges = sum(len(shot.xyz) for shot in shots)
        self._densities = [densities(shot.change, shot.maps, sigma) for shot in shots]

    def __call__(self, offsets: F64, slopes: bool = True, information: bool = False) -> Sums:
        """Return the sums at (7,) offsets in radians, metres and seconds. Sums not asked for are zero."""
        size = len(AXES)
        score, count = np.zeros((2, len(self.shots), PARTS))
        gradient, fitting = np.zeros((len(self.shots), PARTS, size)), np.zeros((size, size))
        error, late = error_pose(offsets), float(offsets[TIME])
        for i, (shot, (density, row, along_v)) in enumerate(zip(self.shots, self._densities, strict=True)):
            pose, change = error @ shot.camera_from_points(late), np.zeros((4, 4))
            if slopes and shot.motion is not None:
                before, after = (shot.camera_from_points(late + t) for t in (-MOMENT / 2, MOMENT / 2))
                change = error @ (after - before) / MOMENT
            _add(
                shot.xyz,
                row,
                along_v,
                shot.cell,
                pose,
                change,
                shot.K,
                density,
                self.variance,
                slopes,
                information,
                score[i],
                count[i],
                gradient[i],
                fitting,
            )
        return Sums(score, count, gradient, fitting)


@kernel
def _add(
    xyz: F32,
    density_row: I64,
    along_v: Bool,
    cell: I32,
    pose: F64,
    change: F64,
    K: F64,
    density: F32,
    variance: float,
    slopes: bool,
    information: bool,
    score: F64,
    count: F64,
    gradient: F64,
    fitting: F64,
) -> None:
    """Add the edges of one shot. ``change`` is the change of ``pose`` per second of time offset."""
    height, width = density.shape[1:]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    ju, jv, p, speed = np.zeros(7), np.zeros(7), np.zeros(3), np.zeros(3)
    for i in range(len(xyz)):
        for a in range(3):
            p[a] = pose[a, 0] * xyz[i, 0] + pose[a, 1] * xyz[i, 1] + pose[a, 2] * xyz[i, 2] + pose[a, 3]
        g = cell[i]
        count[g] += 1
        if p[2] < 1.0:
            continue
        x, y = p[0] / p[2], p[1] / p[2]
        u, v = fx * x + cx, fy * y + cy
        if not (0 <= u < width - 1 and 0 <= v < height - 1):
            continue
        col, row, k = int(u), int(v), density_row[i]
        s, t = u - col, v - row
        d00, d01 = density[k, row, col], density[k, row, col + 1]
        d10, d11 = density[k, row + 1, col], density[k, row + 1, col + 1]
        d = (1 - t) * ((1 - s) * d00 + s * d01) + t * ((1 - s) * d10 + s * d11)
        fit = 1 - SHARE + SHARE * d
        score[g] += np.log(fit)
        if not slopes:
            continue
        du = (1 - t) * (d01 - d00) + t * (d11 - d10)
        dv = (1 - s) * (d10 - d00) + s * (d11 - d01)
        for a in range(3):
            speed[a] = change[a, 3]
            speed[a] += change[a, 0] * xyz[i, 0] + change[a, 1] * xyz[i, 1] + change[a, 2] * xyz[i, 2]
        ju[0], jv[0] = -fx * x * y, -fy * (1 + y * y)
        ju[1], jv[1] = fx * (1 + x * x), fy * x * y
        ju[2], jv[2] = -fx * y, fy * x
        ju[3], jv[4] = fx / p[2], fy / p[2]
        ju[5], jv[5] = -fx * x / p[2], -fy * y / p[2]
        ju[6] = fx * (speed[0] - x * speed[2]) / p[2]
        jv[6] = fy * (speed[1] - y * speed[2]) / p[2]
        du, dv = SHARE / fit * du, SHARE / fit * dv
        for a in range(7):
            gradient[g, a] += du * ju[a] + dv * jv[a]
        if not information:
            continue
        j, weight = jv if along_v[k] else ju, SHARE * d / fit / variance
        for a in range(7):
            for b in range(7):
                fitting[a, b] += weight * j[a] * j[b]
