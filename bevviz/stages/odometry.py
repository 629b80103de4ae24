"""Estimate the robot's motion from the scans of its LiDAR, and place frames by it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevviz.config import VoxelConfig
from bevviz.errors import StageError
from bevviz.model import geometry
from bevviz.model.frame import F32, F64, I64, Frame, LabelledBoxes3D
from bevviz.stages.voxel import voxel_grid

ESTIMATED = "estimated"  # name of the fixed frame, whose origin is the place of the first scan

# Values of KISS-ICP: cells of the map, range of the points, first deviation from the expected motion.
CELL, RANGE, DEVIATION = 1.0, 100.0, 2.0  # metres
LEAST_MOTION, CELL_POINTS = 0.1, 20
CONVERGED = 1e-3  # metres and radians; KISS-ICP's 1e-4 takes twice the time and is no nearer to the truth
ITERATIONS = 100  # of KISS-ICP's 500; scans of one place need 10 to 30
NEAR = 1.0  # metres; nearer points are often of the robot itself, which never seems to move
FINE = CELL / 2  # metres, edge of the voxels that one point stands for
FEWEST = 50  # upright voxels of a scan that can be matched
SPARSE_SCANS = 10  # scans until the map has points between the rings of the ground
LONGEST_GAP = 1.05  # seconds between two scans, after which the last speed tells nothing
LONGEST_START = 0.35  # the same where no speed is known: the next scan must be near the first one
FITTING = 0.4  # least share of upright points that meet the last scan's: 0.6 to 0.8 in drives, 0.2 by chance
REACH = 24  # fine voxels, farthest motion that is searched for where no speed is known
GRID = 256  # fine voxels, edge of the picture in which it is searched for


class Odometry:
    """Estimator of the pose of consecutive scans. The first scan is the origin.

    It calls the compiled core of KISS-ICP (Vizzo et al. 2023), which matches each scan with a map of those
    before it, on one thread, so that the same scans give the same poses. It differs in three things. The
    expected motion depends on the time since the last scan, since scans may be missing; where no speed is
    known, it is the shift at which upright structures of two scans meet. While the map is sparse, upright
    structures alone are matched: rings of points on the ground move along with the sensor and seem to stand
    still. A scan that does not fit the last one begins a new map.

    Args:
        poses: (4, 4) world_from_points by stamp. The estimator adds to them.
    """

    def __init__(self, poses: dict[int, F64] | None = None) -> None:
        self.poses = {} if poses is None else poses
        self._core: Any = None  # compiled module of KISS-ICP
        self._pose, self._stamp = np.eye(4), 0
        self._motion: tuple[F64, float] | None = None  # last motion, and the seconds that it took
        self._points: F32 | None = None  # thinned points of the last scan
        self._upright = np.zeros((0, 3), np.float32)  # those of upright structures
        self._scans = 0  # scans in the map

    def estimate(self, points: F32, stamp: int) -> F64:
        """Return the (4, 4) pose of the next scan. The same stamp twice is the same scan.

        Args:
            points: (N, 3) points, z up.
            stamp: stamp of the scan, nanoseconds.

        Raises:
            StageError: the scan does not fit the last one: ``poses`` has the last pose for it. Or kiss-icp is
                not installed, and ``poses`` has none.
        """
        if self._core is None:
            self._core = _load_core()
        if stamp == self._stamp and self._points is not None:
            return self._pose
        self.poses[stamp] = self._pose
        distance = np.hypot(points[:, 0], points[:, 1])
        thinned = voxel_grid(points[(distance > NEAR) & (distance < RANGE)], VoxelConfig(size=FINE)).points
        upright = thinned[_in_columns(thinned)]
        if len(upright) < FEWEST:
            return self._pose  # As if the scan were missing: nothing in it shows a motion.
        seconds, self._stamp = (stamp - self._stamp) * 1e-9, stamp
        longest = LONGEST_START if self._motion is None else LONGEST_GAP
        try:
            if self._points is not None and 0 < seconds <= longest:
                self._match(thinned, upright, seconds)
            else:
                self._scans, self._motion = 0, None
        finally:
            self._points, self._upright = thinned, upright
            self.poses[stamp] = self._pose
        return self._pose

    def _match(self, points: F32, upright: F32, seconds: float) -> None:
        """Match a scan with the map and add it. The map begins with the last scan."""
        core = self._core
        if self._scans == 0:
            self._map = core._VoxelHashMap(CELL, RANGE, CELL_POINTS)
            self._registration = core._Registration(ITERATIONS, CONVERGED, 1)
            self._threshold = core._AdaptiveThreshold(DEVIATION, LEAST_MOTION, RANGE)
            assert self._points is not None
            self._add(self._points)
        if self._motion is None:
            motion = _shift(self._upright, upright)
        else:
            motion = geometry.interpolate(np.eye(4), self._motion[0], seconds / self._motion[1])
        expected = self._pose @ motion
        matched = upright if self._scans < SPARSE_SCANS else points
        source = core._voxel_down_sample(self._vectors(matched), 1.5 * CELL)
        sigma = self._threshold._compute_threshold()
        pose = self._registration._align_points_to_map(source, self._map, expected, 3 * sigma, sigma)
        here, before = _cells(upright, pose), _cells(self._upright, self._pose)
        # Of two LiDARs one may miss a scan: the smaller scan must be in the larger one.
        if max(np.isin(here, before).mean(), np.isin(before, here).mean()) < FITTING:
            self._scans, self._motion = 0, None
            raise StageError("the scan does not fit the last one: the robot counts as standing")
        self._threshold._update_model_deviation(np.linalg.inv(expected) @ pose)
        self._motion = np.linalg.inv(self._pose) @ pose, seconds
        self._pose = pose
        self._add(points)

    def _add(self, points: F32) -> None:
        """Add a scan at the current pose to the map."""
        self._map._update(self._vectors(points), self._pose)
        self._scans += 1

    def _vectors(self, points: F32) -> object:
        """Return points as KISS-ICP takes them."""
        return self._core._Vector3dVector(points.astype(np.float64))


def _load_core() -> Any:
    """Return the compiled module of KISS-ICP.

    Raises:
        StageError: it is not installed.
    """
    try:
        from kiss_icp.pybind import kiss_icp_pybind
    except ImportError as error:
        raise StageError(f"{error}: pip install kiss-icp, or --set odometry.method=none") from None
    return kiss_icp_pybind


def place(frame: Frame, world_from_points: F64) -> Frame:
    """Return the frame with its points, cameras, boxes and shapes at another pose in the world."""
    move = world_from_points @ geometry.inverse(frame.pose)

    def moved(pose: F64 | None) -> F64 | None:
        return None if pose is None else move @ pose

    def moved_boxes(boxes: LabelledBoxes3D) -> LabelledBoxes3D:
        return replace(boxes, world_from_boxes=moved(boxes.world_from_boxes))

    around = frame.around
    if around is not None:
        shapes = tuple(replace(s, world_from_shape=moved(s.world_from_shape)) for s in around.shapes)
        around = replace(around, shapes=shapes)
    return replace(
        frame,
        world_frame=ESTIMATED,
        world_from_points=world_from_points,
        cameras=tuple(replace(c, world_from_camera=moved(c.world_from_camera)) for c in frame.cameras),
        robot_boxes=tuple(map(moved_boxes, frame.robot_boxes)),
        truth=None if frame.truth is None else moved_boxes(frame.truth),
        around=around,
    )


def _in_columns(points: F32) -> NDArray[np.bool_]:
    """Return which thinned points stand above one another: walls, poles, vehicles, not the ground."""
    cells = np.floor(points[:, :2] / FINE).astype(np.int64)
    _, column, count = np.unique(_packed(cells), return_inverse=True, return_counts=True)
    return np.asarray(count[column] > 1)


def _shift(before: F32, now: F32) -> F64:
    """Return the (4, 4) shift on the ground that makes the most points of two scans meet."""

    def spectrum(points: F32) -> NDArray[np.complex128]:
        cells = np.floor(points[:, :2] / FINE).astype(np.int64) + GRID // 2
        rows, columns = cells[((cells >= 0) & (cells < GRID)).all(axis=1)].T
        picture = np.zeros((GRID, GRID))
        picture[rows, columns] = 1
        return np.fft.rfft2(picture)

    meeting = np.fft.irfft2(spectrum(before) * spectrum(now).conj(), (GRID, GRID))
    meeting = np.roll(meeting, (REACH, REACH), axis=(0, 1))[: 2 * REACH + 1, : 2 * REACH + 1]
    x, y = np.unravel_index(meeting.argmax(), meeting.shape)
    return geometry.transform([(int(x) - REACH) * FINE, (int(y) - REACH) * FINE, 0], [0, 0, 0, 1])


def _cells(points: F32, pose: F64) -> I64:
    """Return the cell of each point in the world."""
    return _packed(np.floor(geometry.apply(pose, points) / CELL).astype(np.int64))


def _packed(cells: I64) -> I64:
    """Return one number for the coordinates of each cell."""
    return np.asarray(cells @ (1 << 21) ** np.arange(cells.shape[1]), np.int64)
