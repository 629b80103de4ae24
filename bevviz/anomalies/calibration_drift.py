"""Faults of a calibration: a camera that is not where its transform says, always or by slow drift.

Where the range jumps between neighbouring beams, the image should have an edge (Levinson and Thrun 2013). The
edges of single frames are scored at the stated mounting and at small rotations around it. A rotation that
beats the stated mounting clearly, over several frames, is the error of the transform. The image turned by 180
degrees and its mirror image are scored too: a driver may turn an image where the transform does not. The same
holds for the image with its distortion: a driver may have removed it, and still state the coefficients. An
image that is said to be rectified may be raw.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from bevviz.anomalies.sensor_faults import SensorFault
from bevviz.model import geometry
from bevviz.model.frame import F32, F64, I64, U8, Bool, Camera, Cloud, Frame, Intrinsics
from bevviz.stages.edges import (
    add_scores,
    cloud_edges,
    densities,
    edges_in_view,
    image_edges,
    log_densities,
    shrink,
    undistort,
)
from bevviz.support.numba_kernel import kernel

EVERY = 10  # frames from one check to the next, each of one camera with one LiDAR
PAST = 6  # checks that are judged together: 6 s at 10 Hz with one camera
LEAST_PAST = 3
PIXELS = 80_000  # larger images are scaled down to this size
EDGES = 800  # most edges of a cloud that are scored
LEAST_EDGES = 150  # fewer tell nothing
BLUR = np.radians(0.35)  # radians

STEP = 0.75  # degrees about x and y of the camera, from one rotation to the next
ROLL = 1.5  # degrees about z, where a rotation moves the middle of the image little
STEPS, ROLLS = 6, 3  # to both sides
LEAST = 1.6  # degrees, least error that is a fault
CLEAR = 2.0  # spreads of the score by which the best rotation beats the stated mounting
UNIQUE = 1.25  # spreads by which it beats all rotations that differ by more than LEAST
MOST = 0.7  # share of the checks in which it beats the stated mounting


def _rotations() -> tuple[F64, F64]:
    """Return the (R, 3) turns in degrees about the camera's axes, and their (R, 3, 3) matrices."""
    across, roll = np.arange(-STEPS, STEPS + 1) * STEP, np.arange(-ROLLS, ROLLS + 1) * ROLL
    turns = np.stack(np.meshgrid(across, across, roll, indexing="ij"), -1).reshape(-1, 3)
    return turns, np.stack([cv2.Rodrigues(np.radians(turn))[0] for turn in turns])


@dataclass(frozen=True, slots=True)
class _Variant:
    """Image that the camera may have sent in place of the stated one, and the fault that it would be.

    Attributes:
        fault: name of the fault.
        detail: how the fault is known and mended.
    """

    fault: str
    detail: str


VARIANTS = (
    _Variant(
        "image upside down",
        "turned by 180 degrees it fits LiDAR {lidar}; turn the image, or roll its transform",
    ),
    _Variant(
        "mirrored image",
        "flipped left to right it fits LiDAR {lidar}; flip the image, or the y of the points",
    ),
    _Variant(
        "distortion is corrected twice",
        "without the coefficients of its CameraInfo it fits LiDAR {lidar}; "
        "--set source.rectified=yes takes it as it is",
    ),
    _Variant(
        "distortion is not corrected",
        "with the coefficients of its CameraInfo it fits LiDAR {lidar}; "
        "--set source.rectified=no takes it as a raw image",
    ),
)
TURNS, MATRICES = _rotations()
ROTATIONS = len(TURNS)
STATED = np.flatnonzero(np.linalg.norm(TURNS, axis=1) < 1.5 * STEP)  # rotations at the stated mounting
# A row of the scores is a rotation of the stated image, or one at the stated mounting of a variant.
_SIZES = [ROTATIONS, *[len(STATED)] * len(VARIANTS)]
ROWS = [slice(int(end) - size, int(end)) for size, end in zip(_SIZES, np.cumsum(_SIZES), strict=True)]
ROTATION: I64 = np.concatenate([np.arange(ROTATIONS), *[STATED] * len(VARIANTS)])  # of each row
IMAGE: I64 = np.repeat(np.arange(len(_SIZES)), _SIZES)  # of each row; 0: the stated one


@dataclass(slots=True)
class _Pair:
    """Checks of one camera with one LiDAR."""

    scores: deque[F64] = field(default_factory=lambda: deque(maxlen=PAST))  # (R,) of each check
    stamps: deque[int] = field(default_factory=lambda: deque(maxlen=PAST))
    fault: SensorFault | None = None


class PlacementWatch:
    """Detector of cameras that are not where their transform says.

    A check takes longer than all other rules together, so that ``worker`` works on it until the next frame.
    """

    def __init__(self, worker: Executor) -> None:
        self._frames = 0
        self._pairs: dict[tuple[str, str], _Pair] = defaultdict(_Pair)
        self._worker = worker
        # Stamp of the frame, names of camera and LiDAR, and the scores.
        self._check: tuple[int, str, str, Future[F64 | None]] | None = None

    def update(
        self, frame: Frame, clouds: Sequence[Cloud], distrusted: Collection[str]
    ) -> Iterator[SensorFault]:
        """Yield the faults up to the frame before. One camera is checked in every ``EVERY``-th frame.

        Args:
            frame: the frame.
            clouds: its clouds by sensor.
            distrusted: names of cameras whose image is known to be wrong.
        """
        self._finish_check()
        turn, rest = divmod(self._frames, EVERY)
        self._frames += 1
        if rest == 0 and clouds and frame.cameras:
            number, of_camera = divmod(turn, len(frame.cameras))
            camera, row = frame.cameras[of_camera], number % len(clouds)
            if camera.name not in distrusted:
                points_from_cloud = frame.points_from_clouds[row] if frame.clouds else np.eye(4)
                scores = self._worker.submit(score_rotations, camera, clouds[row], points_from_cloud)
                self._check = frame.stamp, camera.name, clouds[row].name, scores
        for pair in self._pairs.values():
            if pair.fault is not None:
                yield pair.fault

    def _finish_check(self) -> None:
        """Judge the pair whose check began in the frame before."""
        if self._check is None:
            return
        stamp, camera, lidar, check = self._check
        self._check, scores = None, check.result()
        if scores is None:
            return
        pair = self._pairs[camera, lidar]
        pair.scores.append(scores)
        pair.stamps.append(stamp)
        best = find_error(np.array(pair.scores))
        if best is None:
            pair.fault = None
            return
        since = pair.stamps[0] if pair.fault is None else pair.fault.since
        if IMAGE[best] == 0:
            fault = "not where its transform says"
            detail = f", by about {np.linalg.norm(TURNS[best]):.0f} degrees against LiDAR {lidar}"
        else:
            variant = VARIANTS[IMAGE[best] - 1]
            fault, detail = variant.fault, ": " + variant.detail.format(lidar=lidar)
        pair.fault = SensorFault(f"camera {camera}", fault, since, detail)


def find_error(scores: F64) -> int | None:
    """Return the row of the scores that corrects the stated one. None: it is right, or nobody can tell.

    Args:
        scores: (C, R) score of each rotation and of each variant of the image, in each check.
    """
    if len(scores) < LEAST_PAST:
        return None
    total = scores.sum(axis=0)
    best, spread = int(total.argmax()), float(total[:ROTATIONS].std())
    turns = TURNS[ROTATION]
    apart = np.where(IMAGE[best] == IMAGE, np.linalg.norm(turns - turns[best], axis=1), np.inf)
    stated = scores[:, STATED].max(axis=1)
    better = scores[:, apart < STEP + 0.1].max(axis=1) > stated
    if (
        (IMAGE[best] == 0 and np.linalg.norm(turns[best]) < LEAST)
        or total[best] - total[STATED].max() < CLEAR * spread
        or total[best] - total[apart > LEAST].max() < UNIQUE * spread
        or better.mean() < MOST
    ):
        return None
    return best


def score_rotations(camera: Camera, cloud: Cloud, points_from_cloud: F64) -> F64 | None:
    """Return the (R,) scores of one frame. None: too few edges, or nothing to compare."""
    if camera.image is None or camera.intrinsics is None or camera.camera_from_points is None:
        return None
    small, K = shrink(cv2.cvtColor(camera.image.bgr, cv2.COLOR_BGR2GRAY), camera.intrinsics.K, PIXELS)
    view = replace(camera.intrinsics, width=small.shape[1], height=small.shape[0], K=K)
    image = undistort(small, view)
    view = Intrinsics(view.width, view.height, K)  # without distortion
    camera_from_cloud = np.asarray(camera.camera_from_points @ points_from_cloud, np.float64)
    reach = np.radians(STEPS * STEP)
    part = _in_view(cloud.xyz, camera_from_cloud, view, reach)
    xyz, _, change = edges_in_view(cloud_edges(cloud, part), camera_from_cloud, view, reach)
    if len(xyz) < LEAST_EDGES:
        return None
    every = -(-len(xyz) // EDGES)
    xyz, change = xyz[::every], change[::every]
    xyz = geometry.apply(camera_from_cloud, xyz)
    # The stated image, and its variants in their order. None: the same as the stated one.
    images: list[tuple[U8, F64] | None] = [(image, K)]
    images += [(np.asarray(cv2.flip(image, code), np.uint8), K) for code in (-1, 1)]
    images.append(None if image is small else (small, K))
    raw = camera.intrinsics.raw
    if raw is None:
        images.append(None)
    else:
        raw_K = K @ np.linalg.inv(camera.intrinsics.K) @ raw.K
        raw_view = replace(raw, width=view.width, height=view.height, K=raw_K)
        images.append((undistort(small, raw_view), raw_K))
    scores = np.zeros(len(ROTATION))
    for shown, rows in zip(images, ROWS, strict=True):
        if shown is None:
            scores[rows] = scores[STATED]
            continue
        from_camera = (shown[1] @ MATRICES[ROTATION[rows]]).astype(np.float32)
        edges = image_edges(shown[0])
        density, row, _ = densities(change, edges, float(K[0, 0]) * BLUR)
        shift = np.zeros(3, np.float32)
        add_scores(xyz, row, log_densities(density), from_camera, shift, scores[rows])
    return scores


def _in_view(xyz: F32, camera_from_cloud: F64, view: Intrinsics, reach: float) -> Bool:
    """Return which points lie in a cone around the image and ``reach``."""
    corners = np.array([[u, v, 1.0] for u in (0, view.width) for v in (0, view.height)])
    rays = corners @ np.linalg.inv(view.K).T
    angle = np.arccos((rays[:, 2] / np.linalg.norm(rays, axis=1)).min()) + reach
    return _in_cone(xyz, camera_from_cloud[2].astype(np.float32), np.float32(np.cos(angle)))


@kernel
def _in_cone(xyz: F32, axis: F32, cosine: np.float32) -> Bool:
    """Return which points are within an angle of the optical axis, a row of ``camera_from_cloud``."""
    inside = np.empty(len(xyz), np.bool_)
    for i in range(len(xyz)):
        x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        depth = axis[0] * x + axis[1] * y + axis[2] * z + axis[3]
        inside[i] = depth > cosine * np.sqrt(x * x + y * y + z * z)
    return inside
