"""Faults of the sensors of a drive: each sensor is compared with its own recent past."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

from bevviz.anomalies.calibration_drift import PlacementWatch
from bevviz.anomalies.mounting_changes import MountingWatch, ScanShape
from bevviz.anomalies.sensor_faults import (
    LEAST_SCAN_CHANGE,
    MOVES,
    REPEATS,
    SAME,
    ImageWatch,
    ScanWatch,
    SensorFault,
    UsualChange,
)
from bevviz.model.frame import Cloud, Frame
from bevviz.model.results import Anomaly, Ground, Voxels
from bevviz.support.contexts import Closable

GAP = 1.0  # seconds between two frames, after which the past tells nothing
REMEMBERED = 8  # newest frames whose faults are kept: a frame may be judged while earlier ones are completed


class SensorWatch(Closable):
    """Detector of faults of cameras, LiDARs and their mountings in consecutive frames.

    Runs with other configurations on the same frames may share it: the same frame twice is one frame. Any
    thread may call ``update``, each in the order of the frames.

    Attributes:
        worker: a thread for ``update``. It takes one task after another.
    """

    def __init__(self) -> None:
        self.worker = ThreadPoolExecutor(1, "sensors")
        self._checker = ThreadPoolExecutor(1, "placement")
        self._start: int | None = None
        self._stamp = 0
        self._found: dict[tuple[int, int], list[Anomaly]] = {}  # number and stamp of a frame -> its faults
        self._lock = threading.Lock()
        self.clear()

    def close(self) -> None:
        """End the threads."""
        self.worker.shutdown(cancel_futures=True)
        self._checker.shutdown(cancel_futures=True)

    def clear(self) -> None:
        """Forget all sensors, for a drive that starts again or has a gap."""
        self._images: dict[str, ImageWatch] = {}
        self._scans: dict[str, ScanWatch] = {}
        self._mountings: dict[str, MountingWatch] = {}
        self._placement = PlacementWatch(self._checker)
        self._shape: ScanShape | None = None
        self._scan_change = UsualChange(LEAST_SCAN_CHANGE)
        self._still_scans, self._still_since, self._scan_stamp = 0, 0, 0

    def update(self, frame: Frame, voxels: Voxels | None, ground: Ground | None) -> Sequence[Anomaly]:
        """Return the faults of all sensors in this frame."""
        key = frame.index, frame.stamp
        with self._lock:
            if key not in self._found:
                if len(self._found) >= REMEMBERED:
                    del self._found[next(iter(self._found))]
                self._found[key] = self._update(frame, voxels, ground)
            return self._found[key]

    def _update(self, frame: Frame, voxels: Voxels | None, ground: Ground | None) -> list[Anomaly]:
        """Return the faults in the frame that follows the last one."""
        if self._start is None or frame.stamp < self._stamp:
            self._start = frame.stamp
        if not 0 <= frame.stamp - self._stamp <= GAP * 1e9:
            self.clear()
        self._stamp = frame.stamp
        faults = [
            (fault, 1e-9 * (fault.since - self._start)) for fault in self._faults(frame, voxels, ground)
        ]
        return [_anomaly(fault, f" since {since:.1f} s") for fault, since in faults]

    def update_alone(self, frame: Frame) -> Iterator[Anomaly]:
        """Yield the cameras whose image shows nothing. The frame does not follow the frame before."""
        for camera in frame.cameras:
            watch = self._images.setdefault(camera.name, ImageWatch(f"camera {camera.name}"))
            fault = None if camera.image is None else watch.update_alone(camera.image)
            if fault is not None:
                yield _anomaly(fault)

    def _faults(self, frame: Frame, voxels: Voxels | None, ground: Ground | None) -> Iterator[SensorFault]:
        """Yield the faults that each rule finds in this frame."""
        clouds, distrusted = _clouds(frame), set[str]()
        for cloud in clouds:
            yield from self._scans.setdefault(cloud.name, ScanWatch(f"LiDAR {cloud.name}")).update(cloud)
        before, self._shape = self._shape, None
        if frame.lidar and any(camera.image is not None for camera in frame.cameras):
            self._shape = ScanShape.measure(frame.points, voxels, ground, before)
        scene, scan_ratio = None, float("nan")
        if before is not None and self._shape is not None:
            scene = before.rotation_to(self._shape)
            scan_ratio = self._scan_change.ratio(before.change_to(self._shape))
        for camera in frame.cameras:
            image, gray = camera.image, None
            faults: tuple[SensorFault, ...] = ()
            if image is not None:
                watch = self._images.setdefault(camera.name, ImageWatch(f"camera {camera.name}"))
                faults, gray = watch.update(image, scan_moves=scan_ratio >= MOVES), watch.gray
                yield from faults
            if faults:
                distrusted.add(camera.name)
            mounting = self._mountings.setdefault(camera.name, MountingWatch(camera.name, frame.lidar))
            yield from mounting.update(camera, gray, scene, frame.stamp, trusted=not faults)
        yield from self._still_scan(frame, scan_ratio)
        self._scan_stamp = frame.stamp
        yield from self._placement.update(frame, clouds, distrusted)

    def _still_scan(self, frame: Frame, ratio: float) -> Iterator[SensorFault]:
        """Yield a scan that repeats the scan before but for its noise, while a camera sees the scene move."""
        if not ratio < SAME or not any(watch.moves for watch in self._images.values()):
            self._still_scans = 0
            return
        self._still_since = self._still_since if self._still_scans else self._scan_stamp
        self._still_scans += 1
        if self._still_scans >= REPEATS:
            yield SensorFault(f"LiDAR {frame.lidar}", "frozen scan", self._still_since)


def _anomaly(fault: SensorFault, since: str = "") -> Anomaly:
    """Return a fault as an anomaly. ``since`` says when it began, if that is known."""
    name = f"{fault.sensor}: {fault.name}"
    return Anomaly("sensor", name, f"{name}{since}{fault.detail}", "ERROR", fault.since, fault.rank)


def _clouds(frame: Frame) -> tuple[Cloud, ...]:
    """Return the clouds of the frame by sensor, or all points as one cloud where the source has no more."""
    if frame.clouds or not frame.lidar:
        return frame.clouds
    return (Cloud(frame.stamp, frame.points_frame, frame.points, name=frame.lidar),)
