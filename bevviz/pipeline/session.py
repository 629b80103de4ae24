"""Sessions: state of a drive from one frame to the next, for one configuration or several at once."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from dataclasses import replace

from bevviz.anomalies import AnomalyDetector
from bevviz.anomalies.sensors import SensorWatch
from bevviz.config import Config, ParameterChange, changes
from bevviz.errors import UserError
from bevviz.model import geometry
from bevviz.model.frame import Camera, Frame
from bevviz.model.results import FrameResult
from bevviz.pipeline.perceive import add_explanations, perceive
from bevviz.pipeline.stage_loader import DetectFunction, StageLoader, Stages
from bevviz.pipeline.stage_log import Memo, StageLog
from bevviz.stages.fusion import clusters_in_view
from bevviz.stages.odometry import Odometry, place
from bevviz.stages.tracking import Tracker
from bevviz.support.contexts import Closable


class Session(Closable):
    """Processor of the frames of one drive, in order.

    ``perceive`` and ``finish`` may run in two threads, each in the order of the frames. ``configure`` may be
    called from any thread. One configuration makes all of a result, which refers to it.

    Args:
        config: the configuration.
        detect: function that replaces the detector's model.
        loader: loader shared by sessions that share networks.
        memo: results shared by sessions that run on the same frames. The maker of the frames clears it.
        odometry: estimator of the motion, shared by sessions that run on the same frames.
        sensors: watch of the sensors, shared by sessions that run on the same frames.
        draws: whether results have a bird's-eye view.

    Raises:
        UserError: the detector's model or a user-defined function cannot be used.
    """

    estimates_motion = True  # whether the robot's motion may be estimated from the scans

    def __init__(
        self,
        config: Config,
        detect: DetectFunction | None = None,
        *,
        loader: StageLoader | None = None,
        memo: Memo | None = None,
        odometry: Odometry | None = None,
        sensors: SensorWatch | None = None,
        draws: bool = True,
    ) -> None:
        self.loader = loader or StageLoader()
        self._detect, self._memo, self._draws = detect, memo, draws
        self._in_force = config, self.loader.load(config, detect)  # Both are read and replaced together.
        self._odometry = odometry or Odometry()
        self._tracker = Tracker()
        self._sensors = sensors or SensorWatch()
        self._anomalies = AnomalyDetector(self._sensors)

    def close(self) -> None:
        """End the threads that watch the sensors."""
        self._sensors.close()

    @property
    def config(self) -> Config:
        """Configuration in force."""
        return self._in_force[0]

    @property
    def stages(self) -> Stages:
        """Stages of the configuration in force."""
        return self._in_force[1]

    def configure(self, config: Config) -> dict[str, ParameterChange]:
        """Use another configuration from the next frame on. Return the changed parameters.

        Raises:
            UserError: the detector's model or a user-defined function cannot be used. Nothing is changed.
        """
        stages = self.loader.load(config, self._detect)
        previous = self.config
        self._in_force = config, stages
        return changes(previous, config)

    def run(self, frame: Frame) -> FrameResult:
        """Return the complete result of the next frame. The content of a frame never raises an error."""
        return self.finish(self.perceive(frame))

    def run_single(self, frame: Frame) -> FrameResult:
        """Return the result of any single frame, without tracks and anomalies, which need earlier frames."""
        config, stages = self._in_force
        return add_explanations(perceive(frame, config, stages, self._memo))

    def run_explained(self, frame: Frame) -> FrameResult:
        """Return the result of the next frame with explanations, without bird's-eye view and anomalies."""
        return add_explanations(self._perceive(frame), seen=False)

    def perceive(self, frame: Frame, network: Executor | None = None) -> FrameResult:
        """Estimate the motion to the next frame, run the stages on it, and update the tracks.

        A thread judges the sensors meanwhile, for ``add_anomalies``.
        """
        sensors = self._sensors
        return self._perceive(frame, network, lambda *scan: sensors.worker.submit(sensors.update, *scan))

    def _perceive(
        self, frame: Frame, network: Executor | None = None, on_ground: Callable[..., object] | None = None
    ) -> FrameResult:
        config, stages = self._in_force
        log = StageLog()
        frame = self._placed(frame, config, log)
        result = perceive(frame, config, stages, self._memo, network=network, on_ground=on_ground)
        return self._add_tracks(result, log)

    def finish(self, result: FrameResult) -> FrameResult:
        """Add bird's-eye view, explanations and anomalies to a result of ``perceive``."""
        return self.add_anomalies(add_explanations(result, seen=self._draws))

    def add_anomalies(self, result: FrameResult) -> FrameResult:
        """Add the anomalies of the drive to the next result."""
        return replace(result, anomalies=self._anomalies.update(result, result.config.anomalies))

    def _placed(self, frame: Frame, config: Config, log: StageLog) -> Frame:
        """Return the frame at its estimated pose, if the motion is to be estimated.

        A fixed frame that has no transform at this time is an error in the transforms, which stays visible.
        """
        method = config.odometry.method
        stated = frame.world_from_points is not None or frame.world_frame != frame.points_frame
        if not (self.estimates_motion and frame.lidar) or method == "none" or (method == "auto" and stated):
            return frame
        log.run("odometry", self._odometry.estimate, frame.points, frame.stamp)
        pose = self._odometry.poses.get(frame.stamp)
        self.estimates_motion = pose is not None  # else the estimator is not installed, which is told once
        return frame if pose is None else place(frame, pose)

    def _add_tracks(self, result: FrameResult, log: StageLog) -> FrameResult:
        """Add the tracks of the drive to the next result, and the times and failures of the log."""
        clusters, config, tracks = result.clusters, result.config.tracking, None
        if clusters is not None and config.method != "none":
            is_in_view = clusters_in_view(result.cameras, len(clusters))
            tracks = log.run(
                "tracking", self._tracker.update, result.frame, clusters, is_in_view, result.objects, config
            )
        total = result.timings["total"] + sum(log.timings.values())
        return replace(
            result,
            tracks=tracks,
            timings={**result.timings, **log.timings, "total": total},
            failures=(*result.failures, *log.failures),
        )


# --- several configurations --------------------------------------------------------------------

MOTION = "sync.motion_compensation"  # the only parameter of frames in which variants may differ


class Variants:
    """Configurations that share frames, networks, and results of stages on the same arrays.

    Args:
        loader: loader with loaded networks.
    """

    def __init__(self, loader: StageLoader | None = None) -> None:
        self._memo, self._loader, self._odometry = Memo(), loader or StageLoader(), Odometry()
        self._sensors: dict[str, SensorWatch] = {}  # by the sections that it depends on
        self._frame: Frame | None = None
        self._still: Frame | None = None
        self._lock = threading.Lock()  # guards _frame and _still

    def session(self, config: Config) -> Session:
        """Return a new session with its own tracks and anomalies.

        Raises:
            UserError: the detector's model or a user-defined function cannot be used.
        """
        sections = f"{config.voxel} {config.ground} {config.sync}"
        sensors = self._sensors.setdefault(sections, SensorWatch())
        return Session(config, loader=self._loader, memo=self._memo, odometry=self._odometry, sensors=sensors)

    def check(self, config: Config) -> None:
        """Check that the stages of a configuration can be loaded.

        Raises:
            UserError: the detector's model or a user-defined function cannot be used.
        """
        self._loader.load(config)

    def frame(self, frame: Frame, config: Config) -> Frame:
        """Return the frame as a configuration wants it made. A new frame clears the shared results."""
        with self._lock:
            if frame is not self._frame:
                self._memo.clear()
                self._frame, self._still = frame, None
            if config.sync.motion_compensation:
                return frame
            self._still = self._still or without_motion_compensation(frame)
            return self._still

    def perceive(self, frame: Frame, config: Config, network: Executor | None = None) -> FrameResult:
        """Run the stages that need no other frame on one frame.

        A reused result keeps the time that it once took.

        Raises:
            UserError: the detector's model or a user-defined function cannot be used.
        """
        stages = self._loader.load(config)
        return perceive(self.frame(frame, config), config, stages, self._memo, network=network)


def check_same_frames(configs: Mapping[str, Config]) -> None:
    """Check that variants can share decoded frames.

    Raises:
        UserError: they differ in a parameter of the frames.
    """
    first, *others = configs.items()
    for name, config in others:
        for key, change in changes(first[1], config).items():
            if key.startswith(("source.", "sync.")) and key != MOTION:
                raise UserError(
                    f"{first[0]} and {name} differ in {key} ({change}), but are to run on the same frames; "
                    f"give both the same with --set {key}=..."
                )


def common_frames(configs: Iterable[Config]) -> Config:
    """Return the configuration that makes the frames of all: with motion compensation if any needs it."""
    configs = list(configs)
    return next((config for config in configs if config.sync.motion_compensation), configs[0])


def without_motion_compensation(frame: Frame) -> Frame:
    """Return the frame as with ``sync.motion_compensation`` off: the cameras have their mounting pose."""

    def still(camera: Camera) -> Camera:
        """Return a camera at its mounting pose."""
        if camera.mounting is None:
            return camera
        return replace(
            camera,
            camera_from_points=camera.mounting,
            world_from_camera=frame.pose @ geometry.inverse(camera.mounting),
            motion_compensated=False,
        )

    return replace(frame, cameras=tuple(map(still, frame.cameras)))
