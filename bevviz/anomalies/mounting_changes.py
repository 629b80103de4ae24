"""Faults of mountings: a camera or LiDAR that turned, and a transform between them that jumped.

Camera and LiDAR see the same rotation of the robot. A rotation that only one of them sees, for one frame, is
a sensor that was turned. A rotation that the camera sees earlier or later than the LiDAR, always by the same
time, is a camera whose clock is off. The rotation of a camera comes from corners that are tracked from image
to image (Shi and Tomasi 1994; Bouguet 2000). The rotation of a LiDAR comes from the mean range in each
direction, and from the slope of the ground.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from bevviz.anomalies.sensor_faults import SensorFault
from bevviz.model.frame import F32, F64, I64, U8, Camera, Image
from bevviz.model.results import Ground, Voxels
from bevviz.support.numba_kernel import kernel

BINS = 360  # directions in which the range is compared
BANDS = (20, 33, 46, 59, 72, 85, 98)  # percentiles of the elevations that bound the bands of a scan
FAR = 6.0  # metres; what is nearer moves sideways as the robot drives
REACH = 8  # bins, largest rotation of a LiDAR from scan to scan
UNLIKE = 0.9  # ratio of the least to the usual difference of two scans of different places
LARGEST = 0.3  # largest difference of two mean logarithms that counts: beyond it they show two objects
FEWEST = 2  # points of a direction whose mean range is used
GROUND = 20.0  # metres, farthest ground whose slope is measured
LEAST_GROUND = 200  # points
POINTS = 40_000  # most points of a scan that are used
GROUND_POINTS = 4000  # most points of the ground that are used

CORNERS, LEAST_CORNERS = 150, 40
AGREE = 0.35  # least share of the corners that move together
SPREAD = 0.1  # least spread of these corners, as a share of the image width: one object is not enough
OUTLIER = 1.5  # pixels

PAST = 10  # frames that a rotation is compared with
LEAST_PAST = 3
TURNED = 1.5  # degrees, least rotation that only one sensor sees
STEADY = 0.6  # degrees, largest such rotation in the frames before and after it
STEP, SHIFT = 0.5, 0.05  # degrees and metres, least jump of a transform
JERK = 4.0  # ratio of a jump to the usual change of a camera that is moved on purpose
LASTS = 30.0  # seconds for which it is told

COMPARED, FEW_COMPARED = 100, 25  # rotations that tell how far a clock is off
JUDGE = 10  # rotations from one judgement of the clock to the next
OFFSETS = np.arange(-1.0, 1.01, 0.05)  # seconds that are tried
LEAST_OFFSET = 0.2  # seconds; a scan may be stamped at its start or end, and lasts 0.1 s
TURNS = 4.0  # degrees per second, least spread of the rotation of a drive that tells
CORRELATED = 0.97  # least correlation of the rotations at the best offset
CLEARER = 4.0  # ratio of the unexplained rotation without an offset to that at the best


@dataclass(frozen=True, slots=True)
class ScanShape:
    """Shape of a scan, from which its rotation against the next scan is measured."""

    ranges: F32  # (bands, BINS) mean logarithm of the range in each direction; NaN: too few points
    elevations: F64  # (bands + 1,) tangents of the elevations that bound the bands
    slope: F64  # (2,) rise of the ground along x and along y; NaN: unknown

    @staticmethod
    def measure(
        points: F32, voxels: Voxels | None, ground: Ground | None, before: ScanShape | None = None
    ) -> ScanShape:
        """Measure the (N, 3) points of a scan, in the bands of the scan before."""
        points = points[:: -(-len(points) // POINTS) or 1]
        bounds = _elevation_bounds(points) if before is None else before.elevations
        band, x, y, distance = _between(points, bounds)
        cell = band * BINS + ((np.arctan2(y, x) + np.pi) * BINS / (2 * np.pi)).astype(np.int64) % BINS
        cells = (len(BANDS) - 1) * BINS
        count = np.bincount(cell, minlength=cells)
        total = np.bincount(cell, np.log(distance), cells)
        ranges = (
            np.where(count >= FEWEST, total / np.maximum(count, 1), np.nan)
            .reshape(-1, BINS)
            .astype(np.float32)
        )
        return ScanShape(ranges, bounds, _ground_slope(voxels, ground))

    def change_to(self, other: ScanShape) -> float:
        """Return the mean difference of the ranges in each direction, as a logarithm."""
        difference = np.abs(self.ranges - other.ranges)
        known = np.isfinite(difference)
        return float(np.minimum(difference[known], LARGEST).mean()) if known.any() else 0.0

    def rotation_to(self, other: ScanShape) -> F64 | None:
        """Return the (3,) rotation of the scene in degrees, about x, y and z of the points.

        None: the two scans do not show the same place, or too few points were measured.
        """
        shifts = np.arange(-REACH, REACH + 1)
        turned = np.pad(self.ranges, ((0, 0), (REACH, REACH)), mode="wrap")
        turned = np.lib.stride_tricks.sliding_window_view(turned, BINS, axis=1)[:, ::-1]
        difference = np.abs(turned - other.ranges[:, None])  # (bands, shifts, BINS)
        known = np.isfinite(difference)
        count = known.sum(axis=(0, 2))
        if count.min() < BINS / 8:
            return None
        cost = np.where(known, np.minimum(difference, LARGEST), 0).sum(axis=(0, 2)) / count
        best = int(cost.argmin())
        if cost[best] > UNLIKE * np.median(cost) or not 0 < best < 2 * REACH:
            return None
        before, here, after = cost[best - 1 : best + 2]
        bend = before - 2 * here + after
        fraction = 0.5 * (before - after) / bend if bend > 0 else 0.0
        tilt = np.degrees(other.slope - self.slope)
        # The ground rises along x where the scene turned about -y, and along y where it turned about x.
        return np.array([tilt[1], -tilt[0], (shifts[best] + fraction) * 360 / BINS])


def _elevation_bounds(points: F32) -> F64:
    """Return the tangents of the elevations that bound the bands of a scan."""
    distance = np.hypot(points[:, 0], points[:, 1])
    is_far = distance > FAR
    if not is_far.any():
        return np.zeros(len(BANDS))
    return np.asarray(np.percentile(points[is_far, 2] / distance[is_far], BANDS), np.float64)


@kernel
def _between(points: F32, bounds: F64) -> tuple[I64, F32, F32, F32]:
    """Return band, x, y and distance of the far points whose elevation is between the bounds."""
    band = np.empty(len(points), np.int64)
    x, y, distance = np.empty((3, len(points)), np.float32)
    count = 0
    for i in range(len(points)):
        away = np.float32(np.sqrt(np.float64(points[i, 0]) ** 2 + np.float64(points[i, 1]) ** 2))
        elevation = points[i, 2] / away
        if away > FAR and bounds[0] < elevation < bounds[-1]:
            k = 0
            while bounds[k + 1] < elevation:
                k += 1
            band[count], x[count], y[count], distance[count] = k, points[i, 0], points[i, 1], away
            count += 1
    return band[:count], x[:count], y[:count], distance[:count]


def _ground_slope(voxels: Voxels | None, ground: Ground | None) -> F64:
    """Return the (2,) slope of the near ground along x and y, NaN if it is not known."""
    if ground is None or voxels is None:
        return np.full(2, np.nan)
    rows = np.flatnonzero(ground.mask)
    points = voxels.points[rows[:: -(-len(rows) // GROUND_POINTS) or 1]]
    points = points[np.hypot(points[:, 0], points[:, 1]) < GROUND].astype(np.float64)
    if len(points) < LEAST_GROUND:
        return np.full(2, np.nan)
    on_plane = np.ones(len(points), np.bool_)
    plane = np.zeros(3)
    columns = np.column_stack([points[:, :2], np.ones(len(points))])
    for _ in range(2):
        kept = columns[on_plane]
        plane = np.linalg.lstsq(kept.T @ kept, kept.T @ points[on_plane, 2], rcond=None)[0]
        error = np.abs(columns @ plane - points[:, 2])
        on_plane = error < 0.1 + 2 * np.median(error)
    return plane[:2]


def camera_rotation(before: U8, after: U8, camera: Camera) -> F64 | None:
    """Return the (3,) rotation of the scene in degrees, about x, y and z of the camera.

    Args:
        before: previous image in grey.
        after: newest image in grey, of the same size.
        camera: the camera, for its focal length.

    Returns:
        None where too few corners move together: a dark image, or one large object in front of the camera.
    """
    if camera.image is None or camera.intrinsics is None or before.shape != after.shape:
        return None
    corners = cv2.goodFeaturesToTrack(before, CORNERS, 0.01, 6)
    if corners is None or len(corners) < LEAST_CORNERS:
        return None
    moved, state, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None, winSize=(13, 13), maxLevel=2)
    tracked = state[:, 0] == 1
    middle = np.array(before.shape[::-1], np.float32) / 2
    start, end = corners[tracked, 0] - middle, moved[tracked, 0] - middle
    if len(start) < LEAST_CORNERS:
        return None
    motion, inlier = cv2.estimateAffinePartial2D(start, end, ransacReprojThreshold=OUTLIER)
    if motion is None or inlier.mean() < AGREE:
        return None
    if start[inlier[:, 0] == 1, 0].std() < SPREAD * before.shape[1]:
        return None
    focal = float(camera.intrinsics.K[0, 0]) * before.shape[1] / camera.intrinsics.width
    right, down = motion[:, 2] / focal
    return np.degrees([-down, right, np.arctan2(motion[1, 0], motion[0, 0])])


def stamp_offset(camera: F64, lidar: F64) -> float | None:
    """Return the seconds that a camera's stamps lack, by its rotation and that of the LiDAR.

    Args:
        camera: (N, 2) time in seconds and rotation in degrees per second, which rises in time.
        lidar: (N, 2) the same of the LiDAR about the same axis.

    Returns:
        None: the stamps are right, or the drive does not turn enough to tell.
    """
    if len(camera) < FEW_COMPARED or np.std(lidar[:, 1]) < TURNS or np.std(camera[:, 1]) < TURNS:
        return None
    correlation = np.zeros(len(OFFSETS))
    for k, offset in enumerate(OFFSETS):
        time = camera[:, 0] + offset
        inside = (time >= lidar[0, 0]) & (time <= lidar[-1, 0])
        seen, turned = camera[inside, 1], np.interp(time[inside], *lidar.T)
        if len(seen) >= FEW_COMPARED // 2 and min(np.std(seen), np.std(turned)) > TURNS / 2:
            correlation[k] = np.corrcoef(seen, turned)[0, 1]
    best = int(correlation.argmax())
    offset, unexplained = float(OFFSETS[best]), 1 - correlation**2
    stated = float(np.interp(0.0, OFFSETS, unexplained))
    if not 0 < best < len(OFFSETS) - 1 or abs(offset) < LEAST_OFFSET - 1e-6:
        return None
    return offset if correlation[best] > CORRELATED and stated > CLEARER * unexplained[best] else None


class MountingWatch:
    """Detector of a camera or LiDAR that turned, of its clock, and of a transform that jumped."""

    def __init__(self, camera: str, lidar: str) -> None:
        self._camera, self._lidar = f"camera {camera}", f"LiDAR {lidar}"
        self._stamp = 0
        self._gray: U8 | None = None
        self._turns: deque[tuple[F64, F64, int]] = deque(maxlen=PAST)  # of camera and LiDAR, camera's axes
        self._turned: dict[str, tuple[F64, int]] = {}  # sensor: degrees that it is off, since when
        self._mounting: F64 | None = None
        self._steps: deque[float] = deque(maxlen=PAST)  # degrees by which the transform changed
        self._before_jump: tuple[F64, int] | None = None
        self._scan_stamp = 0
        # Time in seconds and degrees per second about z of the points, of camera and LiDAR.
        self._rates: deque[tuple[tuple[float, float], tuple[float, float]]] = deque(maxlen=COMPARED)
        self._judged, self._offset = 0, 0.0
        self._clock_fault: SensorFault | None = None

    def update(
        self, camera: Camera, gray: U8 | None, scene: F64 | None, stamp: int, trusted: bool
    ) -> Iterator[SensorFault]:
        """Yield the faults of the mounting in this frame.

        Args:
            camera: the camera in this frame.
            gray: its image in grey.
            scene: (3,) rotation of the scene in the axes of the points, from the last scan to this one.
            stamp: stamp of the frame.
            trusted: False if the image is known to be wrong.
        """
        mounting = camera.camera_from_points if camera.mounting is None else camera.mounting
        yield from self._jump(mounting, stamp)
        image = camera.image
        if image is not None and image.stamp != self._stamp:
            if self._gray is not None and gray is not None and scene is not None and mounting is not None:
                turn = camera_rotation(self._gray, gray, camera) if trusted else None
                self._compare(turn, mounting[:3, :3] @ scene, stamp)
                if turn is not None:
                    seen = _rate(self._stamp, image.stamp, float(turn @ mounting[:3, 2]))
                    self._rates.append((seen, _rate(self._scan_stamp, stamp, float(scene[2]))))
                    self._judge_clock(image)
            self._stamp, self._gray = image.stamp, gray if trusted else None
        self._scan_stamp = stamp
        if self._clock_fault is not None:
            yield self._clock_fault
        for sensor, (angle, since) in list(self._turned.items()):
            if stamp - since > LASTS * 1e9:
                del self._turned[sensor]
            else:
                size = float(np.linalg.norm(np.nan_to_num(angle)))
                other = self._lidar if sensor == self._camera else self._camera
                detail = f", by {size:.1f} degrees against {other}"
                yield SensorFault(sensor, "turned in its mounting", since, detail)

    def _compare(self, camera: F64 | None, lidar: F64, stamp: int) -> None:
        """Compare the newest rotations of camera and LiDAR. A rotation is judged one frame later."""
        if camera is None:
            self._turns.clear()
            return
        self._turns.append((camera, lidar, stamp))
        if len(self._turns) < LEAST_PAST + 2:
            return
        alone = np.nan_to_num(np.array([camera - lidar for camera, lidar, _ in self._turns]))
        size = np.linalg.norm(alone, axis=1)
        if size[-2] < TURNED or max(size[-1], float(np.median(size[:-2]))) > STEADY:
            return
        seen = np.nan_to_num(np.array([[camera, lidar] for camera, lidar, _ in self._turns]))
        surprise = np.linalg.norm(seen[-2] - np.median(seen[:-2], axis=0), axis=1)
        sensor = self._camera if surprise[0] >= surprise[1] else self._lidar
        angle, since = self._turned.pop(sensor, (np.zeros(3), self._turns[-2][2]))
        angle = angle + alone[-2]
        if np.linalg.norm(angle) >= TURNED:  # smaller: it was turned back
            self._turned[sensor] = angle, since

    def _judge_clock(self, image: Image) -> None:
        """Judge the clock of the camera now and then. Two judgements must agree."""
        self._judged += 1
        if self._judged % JUDGE:
            return
        camera, lidar = np.array(self._rates).transpose(1, 0, 2)
        before, self._offset = self._offset, stamp_offset(camera, lidar) or 0.0
        if not self._offset:
            self._clock_fault = None
        elif abs(before - self._offset) < LEAST_OFFSET / 2:
            side = "behind" if self._offset > 0 else "ahead of"
            detail = (
                f", {abs(self._offset):.2f} s {side} {self._lidar} by the turns of the drive; "
                f"--set sync.offsets='{{{image.topic}: {self._offset:.2f}}}' sets it right"
            )
            since = round(lidar[0, 0] * 1e9) if self._clock_fault is None else self._clock_fault.since
            self._clock_fault = SensorFault(self._camera, "clock is off", since, detail)

    def _jump(self, mounting: F64 | None, stamp: int) -> Iterator[SensorFault]:
        """Yield a transform that jumped, until it is back or the new one is usual."""
        before, self._mounting = self._mounting, mounting
        if mounting is None or before is None:
            return
        degrees, metres = _difference(before, mounting)
        usual = float(np.median(self._steps)) if self._steps else 0.0
        if (degrees > STEP and degrees > JERK * usual) or (metres > SHIFT and degrees > JERK * usual):
            if self._before_jump is None:
                self._before_jump = before, stamp
        else:
            self._steps.append(degrees)
        if self._before_jump is None:
            return
        first, since = self._before_jump
        degrees, metres = _difference(first, mounting)
        if (degrees <= STEP and metres <= SHIFT) or stamp - since > LASTS * 1e9:
            self._before_jump = None
            return
        detail = f", by {degrees:.1f} degrees and {100 * metres:.0f} cm"
        name = f"transform from {self._lidar} jumped"
        yield SensorFault(self._camera, name, since, detail)


def _rate(start: int, end: int, degrees: float) -> tuple[float, float]:
    """Return the middle of an interval in seconds, and the degrees per second in it."""
    return (start + end) / 2e9, degrees * 1e9 / max(end - start, 1)


def _difference(a: F64, b: F64) -> tuple[float, float]:
    """Return the angle in degrees and the distance in metres between two (4, 4) transforms."""
    cosine = (np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2
    position = -a[:3, :3].T @ a[:3, 3] + b[:3, :3].T @ b[:3, 3]
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))), float(np.linalg.norm(position))
