"""Detection of anomalies in a drive: odd object behaviour, one-sensor objects, clock and transform errors.

Plain rules over the results of consecutive frames. Each frame is judged with the frames before it alone. The
limits are in the configuration section ``anomalies``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import get_args

import numpy as np

from bevviz.anomalies.objects import ObjectWatch
from bevviz.anomalies.sensors import SensorWatch
from bevviz.config import AnomaliesConfig, AnomalyKind
from bevviz.model import geometry
from bevviz.model.frame import F32
from bevviz.model.geometry import iou
from bevviz.model.results import Anomaly, CameraResult, Decision, FrameResult

KINDS: tuple[AnomalyKind, ...] = get_args(AnomalyKind)
UNMATCHED = (Decision.NO_CLUSTER, Decision.TOO_FEW_POINTS, Decision.LOW_OVERLAP, Decision.MISFIT)
SAME_BOX = 0.3  # IoU of the image boxes of one object in consecutive frames
STRONG = 0.5  # least score of a camera detection that the LiDAR should confirm
NEAR = 25.0  # metres, largest distance of such a detection, estimated from the usual height of its class
THROUGH = 0.7  # least share of the points in its box that must lie far behind it
BEHIND = 1.3  # ratio of depth to estimated distance from which a point lies far behind


class AnomalyDetector:
    """Detector of anomalies in consecutive frames. A lasting anomaly keeps the stamp at which it began.

    Args:
        sensors: watch of the sensors, shared by runs on the same frames.
    """

    def __init__(self, sensors: SensorWatch | None = None) -> None:
        self._active: dict[tuple[str, str], tuple[Anomaly, int]] = {}  # with the stamp it last held at
        self._objects = ObjectWatch()
        self._sensors = sensors or SensorWatch()
        self._alone: dict[str, list[tuple[F32, str, int]]] = {}  # camera -> box, class, frames
        self._placed: set[str] = set()  # sensors that had a transform
        self._imaged: set[str] = set()  # cameras that had an image
        self._stamp = 0

    def update(self, result: FrameResult, config: AnomaliesConfig) -> tuple[Anomaly, ...]:
        """Return the anomalies of this frame, worst first.

        An anomaly that ended less than ``anomalies.hold`` ago is still returned.
        """
        stamp = result.frame.stamp
        if stamp < self._stamp:
            self._active.clear()
            self._alone.clear()
            self._objects.clear()
        self._stamp = stamp
        for anomaly in self._found(result, config):
            key = anomaly.kind, anomaly.subject
            since = self._active[key][0].since if key in self._active else anomaly.since or stamp
            self._active[key] = replace(anomaly, since=since), stamp
        self._active = {
            key: (anomaly, last)
            for key, (anomaly, last) in self._active.items()
            if stamp - last <= config.hold * 1e9
        }
        return tuple(sorted((anomaly for anomaly, _ in self._active.values()), key=lambda a: -a.rank))

    def update_alone(self, result: FrameResult, config: AnomaliesConfig) -> tuple[Anomaly, ...]:
        """Return the anomalies of a frame that does not follow the frame before, worst first."""
        anomalies = [
            *self._sensors.update_alone(result.frame),
            *self._clocks(result, config),
            *self._transforms(result, config),
            *_stages(result, config),
        ]
        return tuple(sorted(anomalies, key=lambda anomaly: -anomaly.rank))

    def _found(self, result: FrameResult, config: AnomaliesConfig) -> Iterator[Anomaly]:
        """Yield the anomalies of this frame from every rule."""
        if result.tracks is not None:
            yield from self._objects.update(result, result.tracks, config)
        yield from self._sensors.update(result.frame, result.voxels, result.ground)
        yield from self._detections(result, config)
        yield from self._clocks(result, config)
        yield from self._transforms(result, config)
        yield from _stages(result, config)

    def _detections(self, result: FrameResult, config: AnomaliesConfig) -> Iterator[Anomaly]:
        """Yield detections of a camera that the LiDAR does not confirm for several frames.

        Detections of consecutive frames are associated by the overlap of their boxes.
        """
        texts = {(e.camera, e.row): e.text for e in result.explanations if e.subject == "detection"}
        for camera in result.cameras:
            name, detections, fusion = camera.camera.name, camera.detections, camera.fusion
            before, self._alone[name] = self._alone.get(name, []), []
            if detections is None or fusion is None:
                continue
            alone = (
                np.isin(fusion.detection_decision, UNMATCHED) & detections.kept & (detections.score >= STRONG)
            )
            unmatched = np.flatnonzero(alone)
            boxes = detections.xyxy[unmatched]
            others = np.array([box for box, _, _ in before], np.float32).reshape(-1, 4)
            same = iou(boxes, others) >= SAME_BOX
            for d, box, near in zip(unmatched.tolist(), boxes, same, strict=True):
                class_name = detections.names[d]
                earlier = [before[i][2] for i in np.flatnonzero(near).tolist() if before[i][1] == class_name]
                frames = 1 + max(earlier, default=0)
                self._alone[name].append((box, class_name, frames))
                if frames >= config.alone_frames and _seen_through(result, camera, d):
                    text = texts.get((name, d), f"{class_name} {detections.score[d]:.2f}")
                    subject = f"{class_name} in {name}"
                    yield Anomaly("one_sensor", subject, f"{name}: {text}, for {frames} frames", rank=0.4)

    # --- sensors and stages --------------------------------------------------------------------

    def _clocks(self, result: FrameResult, config: AnomaliesConfig) -> Iterator[Anomaly]:
        """Yield cameras whose image is missing or far from the cloud in time."""
        for camera in result.frame.cameras:
            if abs(camera.sync_error) > config.sync_error:
                text = f"{camera.name} is {1e3 * camera.sync_error:+.0f} ms off the cloud"
                yield Anomaly("sync", camera.name, text, rank=0.8)
            elif camera.image is None and camera.name in self._imaged:
                text = f"{camera.name} has no image at the time of the cloud"
                yield Anomaly("sync", camera.name, text, rank=0.9)
        self._imaged |= {camera.name for camera in result.frame.cameras if camera.image is not None}

    def _transforms(self, result: FrameResult, config: AnomaliesConfig) -> Iterator[Anomaly]:
        """Yield sensors whose transform is old or lost."""
        frame = result.frame
        ages = {frame.lidar: frame.tf_age} if frame.lidar else {}
        ages |= {camera.name: camera.tf_age for camera in frame.cameras}
        for sensor, age in ages.items():
            if age > config.tf_age:
                yield Anomaly("tf", sensor, f"the transform of {sensor} is {1e3 * age:.0f} ms old", rank=0.7)
        placed = {c.name for c in frame.cameras if c.camera_from_points is not None}
        if frame.lidar and frame.world_from_points is not None:
            placed.add(frame.lidar)
        for sensor in sorted(self._placed - placed):
            yield Anomaly("tf", sensor, f"the transform of {sensor} is lost", "ERROR", rank=1.0)
        self._placed |= placed


def _seen_through(result: FrameResult, camera: CameraResult, row: int) -> bool:
    """Return whether the LiDAR sees through a detection.

    The distance of the detection is estimated from the usual height of its class. Most points in its box must
    lie far behind that distance.
    """
    detections, sensor = camera.detections, camera.camera
    assert detections is not None
    size = result.config.objects.sizes.get(detections.names[row].lower())
    if size is None or sensor.intrinsics is None or sensor.camera_from_points is None:
        return False
    x0, y0, x1, y1 = detections.xyxy[row].tolist()
    distance = float(sensor.intrinsics.K[1, 1]) * size[2] / max(y1 - y0, 1.0)
    if (
        distance > NEAR
        or min(x0, y0) < 1
        or x1 > sensor.intrinsics.width - 1
        or y1 > sensor.intrinsics.height - 1
    ):
        return False
    uv, depth = geometry.project(
        geometry.apply(sensor.camera_from_points, result.frame.points), sensor.intrinsics
    )
    low = np.array([x0 + (x1 - x0) / 4, y0 + (y1 - y0) / 5])
    high = np.array([x1 - (x1 - x0) / 4, y1 - (y1 - y0) / 5])
    with np.errstate(invalid="ignore"):
        depths = depth[((uv >= low) & (uv <= high)).all(axis=1)]
    return bool(len(depths) >= 3 and (depths > BEHIND * distance).mean() >= THROUGH)


def _stages(result: FrameResult, config: AnomaliesConfig) -> Iterator[Anomaly]:
    """Yield stages that failed or were slow."""
    for failure in result.failures:
        yield Anomaly("stage", failure.stage, f"{failure.stage}: {failure.reason}", "ERROR", rank=1.0)
    failed = {failure.stage for failure in result.failures}
    for stage, seconds in result.timings.items():
        if config.stage_time is not None and seconds > config.stage_time and stage not in failed:
            yield Anomaly("stage", stage, f"{stage} took {1e3 * seconds:.0f} ms", rank=0.5)
