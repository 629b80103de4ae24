"""Estimation of the up direction at a LiDAR, so that ground and boxes are not computed in a tilted frame.

REP 103 makes z of every body frame point up. The frame of a LiDAR that hangs upside down, of one that is
pitched towards the road, and of a depth camera does not. Its points are turned upright. The sources of the
direction, best first:

1. the transforms to ``source.base_frame``, which is upright by definition (REP 105),
2. the transforms to the fixed frame,
3. gravity, by an accelerometer with transforms to the LiDAR,
4. the ground in the scans of the LiDAR,
5. none: z of the LiDAR's frame is assumed to point up.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field

import cv2
import numpy as np

from bevviz.messages.transforms import Acceleration
from bevviz.model.frame import F32, F64, Cloud
from bevviz.sync.transform_tree import TransformBuffer, TransformError

TILT = math.radians(2.0)  # least tilt of a LiDAR on its robot that is corrected
SLOPE = math.radians(8.0)  # the same without a transform to the robot: a road may be as steep
DISAGREEMENT = math.radians(12.0)  # between transforms and ground; more means that one of them is wrong
# The same for the mounting on the robot, by several scans: radians, scans, and seconds between two of them.
LEVEL, LEVEL_SCANS, LEVEL_TIME = math.radians(5.0), 4, 1.0
ALIKE = math.radians(3.0)  # between these scans; more means that the robot swings, or rough ground
# Metres above the robot that no LiDAR is, and the units that such a transform may be in.
TALL, SMALL_UNITS = 10.0, {100: "centimetres", 1000: "millimetres"}
GRAVITY_TIME = 2.0  # seconds of smoothing: braking is no slope
# Metres from the LiDAR, points and planes of the search for the ground.
NEAR, POINTS, PLANES = 25.0, 4000, 400
FEWEST = 200  # near points in cubes of their own; a plane fits fewer by chance
LOW = 0.2  # share of points, the lowest by z, from which more planes are drawn
THICKNESS = 0.12  # metres between the ground's points and its plane
SUPPORT, BELOW = 0.15, 0.02  # shares of the near points: least in the ground, most below it
# The same for the floor of a hall, and its least depth in metres.
FLOOR, UNDER, LOWEST = 0.05, 0.01, 0.5
ASTRAY, SURE = math.radians(45.0), 0.25  # angle to z at which a plane may be a wall, and its SUPPORT
HEIGHTS = 0.15, 6.0  # metres from the ground to a LiDAR
# Metres: side of a column of points, from its lowest point to the floor that it stands on, and least distance
# of a LiDAR from a ceiling.
COLUMN, TOUCH, CLOSE = 0.5, 0.7, 0.7
SECTORS, OPEN = 36, 0.2  # of a turn, and share of them in which a room has no wall, at most
INSIDE = 0.75  # share of the distance to the wall within which objects stand
LOOSE, STANDING = 0.3, 0.7  # shares of the columns that touch: most for a ceiling, least for a floor
TRIES = 5  # scans that are searched for the ground

_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # FLU from RDF (REP 103)
_Z = np.array([0.0, 0.0, 1.0])


@dataclass(slots=True)
class VerticalEstimate:
    """Estimate of the vertical during a drive.

    Args:
        tf: the transforms.
        base_frame: base frame of the robot.
        tolerance: seconds, see ``TransformBuffer.lookup``.

    Attributes:
        warnings: a sentence for each LiDAR frame with a doubtful vertical.
        needs_gravity: whether an Imu could improve the estimate.
        checked: LiDAR frames whose stated vertical is not compared with the ground once more. None: none are.
            Sources of single frames share it, because the search for the ground takes longer than the rest.
    """

    tf: TransformBuffer
    base_frame: str
    tolerance: float
    warnings: dict[str, str] = field(default_factory=dict)
    needs_gravity: bool = True
    checked: set[str] | None = None
    _gravity: dict[str, tuple[int, F64]] = field(default_factory=dict)  # stamp and mean acceleration by frame
    _ground: dict[str, F64] = field(default_factory=dict)  # up direction by LiDAR frame, from the ground
    _tries: dict[str, int] = field(default_factory=dict)
    # Stamp of the last scan that was compared with the robot, by LiDAR frame, and up on the robot by each.
    _compared: dict[str, tuple[int, tuple[F64, ...]]] = field(default_factory=dict)
    # LiDAR frames that are turned; they stay so during the drive.
    _tilted: set[str] = field(default_factory=set)

    def add_acceleration(self, sample: Acceleration) -> None:
        """Add an acceleration of an Imu. At rest it points up."""
        norm = float(np.linalg.norm(sample.acceleration))
        if not math.isfinite(norm) or norm == 0:
            return
        frame, now = sample.frame_id.lstrip("/"), sample.acceleration / norm
        stamp, mean = self._gravity.get(frame, (sample.stamp, now))
        share = min(1.0, max(0.0, (sample.stamp - stamp) * 1e-9 / GRAVITY_TIME))
        self._gravity[frame] = sample.stamp, mean + share * (now - mean)

    def turn(self, cloud: Cloud, fixed_frame: str) -> F64 | None:
        """Return the (4, 4) rotation that makes the points of a LiDAR upright; None if they are.

        Args:
            cloud: points in the LiDAR's frame.
            fixed_frame: fixed frame above it in the transforms; empty: there is none.
        """
        frame = cloud.frame_id.lstrip("/")
        base = self._rotation(self.base_frame, frame, cloud.stamp)
        up, source = (
            (base[2], f"'{self.base_frame}'") if base is not None else self._up(cloud, frame, fixed_frame)
        )
        self.needs_gravity = up is None or source.startswith("gravity")
        if up is None:
            return self._turn_by_ground(frame, self._seen_ground(cloud, frame))
        ground = None if frame in (self.checked or ()) else self._seen_ground(cloud, frame)
        if ground is not None and self.checked is not None:
            self.checked.add(frame)
        if ground is not None and _angle(up, ground) > DISAGREEMENT:
            self.warnings[frame] = (
                f"the ground that LiDAR frame '{frame}' sees is tilted by {_degrees(up, ground):.0f} degrees "
                f"against the vertical of {source}: one of them is wrong "
                "(source.extrinsics states transforms)"
            )
        elif base is not None and self.checked is None:
            self._compare(cloud, frame, base)
        if base is not None and ground is not None:
            self._check_unit(cloud, frame, ground)
        if _angle(up, _Z) > (TILT if base is not None else SLOPE):
            self._tilted.add(frame)
        if frame not in self._tilted:
            return None
        return _homogeneous(base if base is not None else _least_turn(frame, up))

    def _compare(self, cloud: Cloud, frame: str, base: F64) -> None:
        """Compare a stated mounting with the ground of several scans, on which the robot stands upright."""
        stamp, ups = self._compared.get(frame, (0, ()))
        if len(ups) == LEVEL_SCANS or 0 <= cloud.stamp - stamp < LEVEL_TIME * 1e9:
            return
        ground = ground_normal(cloud.xyz)
        ups = ups if ground is None else (*ups, base @ ground)
        self._compared[frame] = cloud.stamp, ups
        mean = np.sum(ups, axis=0) / max(len(ups), 1)
        if len(ups) < LEVEL_SCANS or _angle(mean, _Z) < LEVEL or max(_angle(up, mean) for up in ups) > ALIKE:
            return
        roll, pitch = (round(math.degrees(math.atan2(mean[axis], mean[2]))) for axis in (1, 0))
        self.warnings[frame] = (
            f"the ground that LiDAR frame '{frame}' sees is tilted by {_degrees(mean, _Z):.0f} degrees in "
            f"'{self.base_frame}', in {len(ups)} scans: its transform is wrong, and would fit with a further "
            f"roll of {roll} and pitch of {-pitch} degrees (source.extrinsics states transforms)"
        )

    def _check_unit(self, cloud: Cloud, frame: str, ground: F64) -> None:
        """Compare the stated height of a LiDAR on the robot with its height above the ground."""
        stated = abs(float(self.tf.lookup(self.base_frame, frame, cloud.stamp, self.tolerance).matrix[2, 3]))
        if stated < TALL:
            return
        height = abs(float(np.quantile(cloud.xyz @ ground, 0.05)))
        divisor = 10 ** round(math.log10(stated / max(height, 0.01)))
        if divisor in SMALL_UNITS:
            self.warnings[frame] = (
                f"LiDAR frame '{frame}' is {stated:.0f} m from '{self.base_frame}' in height, and "
                f"{height:.1f} m above the ground: its transform is in {SMALL_UNITS[divisor]}; divide the "
                f"translation by {divisor} (source.extrinsics states transforms)"
            )

    def _up(self, cloud: Cloud, frame: str, fixed_frame: str) -> tuple[F64 | None, str]:
        """Return up in a LiDAR's frame, by the fixed frame or by gravity, and the name of the source."""
        world = self._rotation(fixed_frame, frame, cloud.stamp) if fixed_frame else None
        if world is not None:
            down = "ned" in re.split(r"[/_]", fixed_frame.lower())
            return (-world[2] if down else world[2]), f"'{fixed_frame}'"
        for imu_frame, (_, acceleration) in self._gravity.items():
            rotation = np.eye(3) if imu_frame == frame else self._rotation(frame, imu_frame, cloud.stamp)
            if rotation is not None:
                up = rotation @ acceleration
                return up / np.linalg.norm(up), f"gravity, as '{imu_frame}' feels it"
        return None, ""

    def _turn_by_ground(self, frame: str, ground: F64 | None) -> F64 | None:
        """Return the rotation that makes the ground level. Warn, because no transform states it."""
        if ground is None:
            if self._tries[frame] == TRIES:
                self.warnings[frame] = (
                    f"no transform, no Imu and no ground tells which way is up at LiDAR frame '{frame}': "
                    f"z is taken; source.extrinsics '{self.base_frame} {frame}' states it"
                )
            return None
        self.warnings.pop(frame, None)
        if _angle(ground, _Z) <= SLOPE:
            return None
        self.warnings[frame] = (
            f"z of LiDAR frame '{frame}' does not point up: it is turned by {_degrees(ground, _Z):.0f} "
            f"degrees, by the ground in its scans, as no transform tells it; source.extrinsics "
            f"'{self.base_frame} {frame}' does"
        )
        return _homogeneous(_least_turn(frame, ground))

    def _rotation(self, target: str, source: str, stamp: int) -> F64 | None:
        if not self.tf.knows(target, source):
            return None
        try:
            return self.tf.lookup(target, source, stamp, self.tolerance).matrix[:3, :3]
        except TransformError:
            return None

    def _seen_ground(self, cloud: Cloud, frame: str) -> F64 | None:
        """Return the up direction by the ground. Only the first scans of a LiDAR are searched for it."""
        if frame not in self._ground and self._tries.setdefault(frame, 0) < TRIES:
            self._tries[frame] += 1
            normal = ground_normal(cloud.xyz)
            if normal is not None:
                self._ground[frame] = normal
        return self._ground.get(frame)


def ground_normal(points: F32) -> F64 | None:
    """Estimate the up direction from the ground under a LiDAR with any orientation.

    The ground is the plane through many of the near points that has almost no points below it. Walls and
    ceilings may have no points behind them either, and in a hall they have most of the points. Therefore a
    plane that z of the frame agrees with is preferred; if there is none, the plane with most points. A plane
    that stands to z like a wall needs more points and no parallel plane opposite. Even a small floor that z
    agrees with is preferred to it.

    Planes are drawn at random (RANSAC: Fischler and Bolles 1981) with a fixed seed.

    Args:
        points: (N, 3) metres, the LiDAR at the origin.

    Returns:
        (3,) unit vector; z if a small floor agrees with it; None if there is no ground.
    """
    near = points[np.einsum("ij,ij->i", points, points) < NEAR**2]
    if len(near) < FEWEST:
        return None
    random = np.random.default_rng(0)
    sample = near[random.integers(0, len(near), POINTS)].astype(np.float64)
    # Each cube of 0.3 m counts once. Otherwise the dense rings near the LiDAR would decide.
    _, first = np.unique(np.floor(sample / 0.3).astype(np.int64), axis=0, return_index=True)
    sample = sample[first]
    if len(sample) < FEWEST:
        return None
    # Otherwise few planes of a small floor are drawn.
    low = sample[sample[:, 2] <= np.quantile(sample[:, 2], LOW)]
    normals, heights = (
        np.concatenate(pair)
        for pair in zip(*(_planes(drawn, random) for drawn in (sample, low)), strict=True)
    )
    if not len(normals):
        return None
    distance = sample @ normals.T + heights  # (points, planes) height above the plane
    support = (np.abs(distance) < THICKNESS).mean(axis=0)
    below = (distance < -2 * THICKNESS).mean(axis=0)
    floor = (support > FLOOR) & (below < UNDER) & (heights > LOWEST) & (heights < HEIGHTS[1])
    opposite = (normals @ normals[floor].T < -math.cos(DISAGREEMENT)).any(axis=1)
    astray = normals[:, 2] < math.cos(ASTRAY)
    fit = (support > np.where(astray, SURE, SUPPORT)) & (below < BELOW)
    fit &= (heights > HEIGHTS[0]) & (heights < HEIGHTS[1])
    upwards = normals[:, 2] > math.cos(DISAGREEMENT)
    downwards = fit & (normals[:, 2] < -math.cos(DISAGREEMENT))
    usual = fit & upwards
    if downwards.any() and not usual.any():
        best = int(np.argmax(np.where(downwards, support, -1.0)))
        carries = _carries_objects(sample, normals[best], distance[:, best], heights[best])
        if carries is not None:
            fit &= downwards if carries else ~downwards
            floor &= not carries
            opposite &= not carries
    fit &= ~(astray & opposite)
    best = int(np.argmax(np.where(usual if usual.any() else fit, support, -1.0)))
    if (astray[best] or not fit[best]) and (floor & upwards).any():
        return _Z
    if not fit[best]:
        return None
    inliers = sample[np.abs(distance[:, best]) < THICKNESS]
    _, _, axes = np.linalg.svd(inliers - inliers.mean(axis=0), full_matrices=False)
    normal: F64 = axes[2] * np.sign(axes[2] @ normals[best])
    return normal


def _carries_objects(points: F64, normal: F64, rise: F64, height: float) -> bool | None:
    """Return whether a plane with walls around it is the floor of the room, and not its ceiling.

    The walls touch both. Objects before the walls stand on the floor. In an empty room a plane above the
    LiDAR is its ceiling, unless a LiDAR is hardly mounted so close to one.

    Args:
        points: (N, 3) points.
        normal: (3,) normal of the plane, towards the sensor.
        rise: (N,) heights of the points above the plane.
        height: distance from the sensor to the plane in metres.

    Returns:
        None: there are no walls around the plane, or the objects do not tell.
    """
    place = points @ np.linalg.svd(normal[None])[2][1:].T
    reach = np.hypot(*place.T)
    sector = ((np.arctan2(place[:, 1], place[:, 0]) / math.tau + 0.5) * SECTORS).astype(np.int64) % SECTORS
    off = rise > 2 * THICKNESS
    wall, edge = np.zeros(SECTORS), np.zeros(SECTORS)
    np.maximum.at(wall, sector[off], reach[off])
    np.maximum.at(edge, sector[~off], reach[~off])
    if (wall < edge - COLUMN).mean() > OPEN:
        return None
    _, column = np.unique(np.floor(place[off] / COLUMN).astype(np.int64), axis=0, return_inverse=True)
    column = column.reshape(-1)
    foot = np.full(column.max() + 1, np.inf)
    np.minimum.at(foot, column, rise[off])
    inside = np.unique(column[reach[off] < INSIDE * wall[sector[off]]])
    if not len(inside):
        return height < CLOSE
    standing = float((foot[inside] < TOUCH).mean())
    return None if LOOSE <= standing <= STANDING else standing > STANDING


def _planes(points: F64, random: np.random.Generator) -> tuple[F64, F64]:
    """Return (P, 3) normals, facing the origin, and (P,) distances of planes through three random points."""
    a, b, c = (points[random.integers(0, len(points), PLANES)] for _ in range(3))
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    normals, origins = normals[lengths > 0.5] / lengths[lengths > 0.5, None], a[lengths > 0.5]
    height = np.einsum("ij,ij->i", normals, origins)
    normals[height > 0] *= -1  # the LiDAR is above the ground
    return normals, np.abs(height)


def _least_turn(frame: str, up: F64) -> F64:
    """Return the smallest (3, 3) rotation that turns ``up`` to z, so that ahead stays ahead.

    The optical frame of a depth camera looks along z. It is turned to look along x first.
    """
    start = _OPTICAL if "optical" in frame.lower() else np.eye(3)
    x, y, z = start @ up
    if z < 0 and math.hypot(x, y) < 1e-6:
        # Upside down, every horizontal axis is equally good. A turn about x keeps the forward
        # direction. The remaining turn follows.
        start = np.diag([1.0, -1.0, -1.0]) @ start
    axis = np.cross(start @ up, _Z)
    sine, cosine = float(np.linalg.norm(axis)), float((start @ up)[2])
    turn, _ = cv2.Rodrigues(axis * (math.atan2(sine, cosine) / sine if sine else 1.0))
    return np.asarray(turn @ start)


def _homogeneous(rotation: F64) -> F64:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    return matrix


def _angle(a: F64, b: F64) -> float:
    return math.atan2(float(np.linalg.norm(np.cross(a, b))), float(a @ b))


def _degrees(a: F64, b: F64) -> float:
    return math.degrees(_angle(a, b))
