"""Logs a FrameResult: which ``log_*`` function is called when, and what they need of the frames before."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
import rerun as rr

from bevviz.anomalies import Onsets
from bevviz.config import Config
from bevviz.frame import CameraResult, Frame, FrameResult, Intrinsics, LateResult, Scene
from bevviz.logging import entities
from bevviz.logging.annotations import log_world
from bevviz.logging.anomalies import log_anomalies, log_anomalies_looks
from bevviz.logging.around import AroundLog, diagnostic_states, log_shapes, marks
from bevviz.logging.bev import log_bev, log_grid
from bevviz.logging.camera import (
    log_camera,
    log_camera_looks,
    log_detections,
    log_intrinsics,
    log_projected_points,
)
from bevviz.logging.cloud import log_cloud, log_cloud_looks, log_ground, log_obstacles, quantised
from bevviz.logging.clusters import log_cluster_colors, log_clusters, log_clusters_looks
from bevviz.logging.decisions import log_decisions
from bevviz.logging.frustums import log_frustums
from bevviz.logging.health import Rates, log_health
from bevviz.logging.labelled import forget_late, log_late, log_robot, log_truth, log_truth_looks
from bevviz.logging.objects import log_objects, log_objects_looks
from bevviz.logging.origin import log_origin
from bevviz.logging.pieces import transform
from bevviz.logging.states import COLORS, StateLanes, states_of, track_states
from bevviz.logging.tracks import Lanes, log_speeds, log_tracks, log_tracks_looks
from bevviz.logging.writer import Writer

STALE = 3_000_000_000  # nanoseconds that the newest late result of the robot is shown


@dataclass(frozen=True, slots=True)
class Context:
    """What a frame relies on that was logged before it: a recording that starts with it needs this."""

    config: Config
    scene: Scene
    clock: tuple[int, int, int] = (0, 0, 0)  # index, stamp and received of the frame
    intrinsics: Mapping[str, Intrinsics] = field(default_factory=dict)
    lanes: Mapping[str, str] = field(default_factory=dict)  # state lane -> its state


class Logger(Writer):
    """Writes frames to a recording, on the timelines ``stamp``, ``frame`` and ``received``.

    Call ``log_static`` once, then ``log`` for each frame.

    Args:
        recording: where to; it may have any number of sinks.
        config: how the results were made; stored in the recording.
        scene: names of the sensors.
        root: entity that everything goes under. With one, this is what else was made of frames that
            another logger writes: what the sensors and the robot brought is not written twice.
        wait, stamps: as of ``Writer``.
        inputs: write what the sensors and the robot brought; default: without a root.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        config: Config,
        scene: Scene,
        root: str = "",
        wait: float = 0.0,
        stamps: Sequence[str] = (entities.STAMP,),
        inputs: bool | None = None,
    ) -> None:
        super().__init__(recording, root, wait, stamps)
        self._inputs = not root if inputs is None else inputs
        self._brought: set[str] = set()  # entities of the sensors and the robot
        self._config = config
        self.streams_video = config.logging.video == "stream"
        self._scene = scene
        self._intrinsics: dict[str, Intrinsics] = {}
        self._track_lanes = Lanes()
        self._state_lanes = StateLanes(COLORS)
        self._around = AroundLog()
        self._onsets = Onsets()
        self._last: Frame | None = None
        self._rates = Rates()
        self._late: dict[str, int] = {}  # topic of the robot's results that come late -> stamp of the newest

    @property
    def context(self) -> Context:
        """What the frame that was logged last relies on."""
        last = self._last
        clock = (0, 0, 0) if last is None else (last.index, last.stamp, last.received)
        return Context(self._config, self._scene, clock, self._intrinsics, self._state_lanes.states)

    @property
    def results(self) -> frozenset[str]:
        """Entities that any frame had, but for what the sensors and the robot brought."""
        return self.known - self._brought

    def refresh(self, known: Set[str] = frozenset()) -> None:
        """As a ``Writer``; inputs that are not written here are not cleared here either."""
        super().refresh(known)
        if not self._inputs:
            self._shown -= self._brought

    # --- once ----------------------------------------------------------------------------------

    def log_static(self) -> None:
        """How the recording was made, the axes, the classes and the looks: what no frame changes."""
        lidars = list(dict.fromkeys(filter(None, (self._scene.lidar, *self._scene.lidars))))
        log_origin(self, self._config, self._scene)
        log_world(self)
        log_cloud_looks(self, lidars)
        log_clusters_looks(self, lidars)
        log_camera_looks(self, self._scene.cameras)
        log_objects_looks(self)
        log_tracks_looks(self)
        log_truth_looks(self)
        log_anomalies_looks(self)

    def log_context(self, context: Context) -> None:
        """Static data, calibration and states of a frame, for a recording that starts with it."""
        self.log_static()
        for name, intrinsics in context.intrinsics.items():
            self._log_intrinsics(name, intrinsics)
        if context.lanes:
            self.set_time(*context.clock)
            self._state_lanes.log(self, context.lanes)

    def reconfigure(self, config: Config, scene: Scene) -> None:
        """From here on the results are made in another way, or of other sensors."""
        same, self._config, self._scene = scene == self._scene, config, scene
        self.streams_video = config.logging.video == "stream"
        if same:  # the viewer loses class colours that are logged twice
            log_origin(self, config, scene)
        else:
            self.log_static()

    # --- each frame ----------------------------------------------------------------------------

    def log(
        self,
        result: FrameResult,
        health: Mapping[str, float] = MappingProxyType({}),
        notes: Sequence[tuple[str, str]] = (),
        late: Sequence[LateResult] = (),
        states: Mapping[str, str] = MappingProxyType({}),
        beside: Callable[[], object] | None = None,
        cloud: bool = False,
    ) -> None:
        """Everything of one frame. What the frame before had and this one has not is cleared.

        Args:
            result: the frame and what was made of it.
            health: further scalars, by entity.
            notes: further lines of the log: level and text.
            late: what the robot has published since and belongs to frames before.
            states: of further lanes, by entity.
            beside: puts something more into the frame.
            cloud: write the raw cloud, which tells ground from obstacles, also where no inputs are written.
        """
        frame = result.frame
        for found in late:
            self._late[found.boxes.topic] = found.boxes.stamp
            log_late(self, found, self._config.bev)
        self.begin(frame.index, frame.stamp, frame.received)
        self._log_alone(result, cloud=cloud)
        self._log_in_order(result, health, notes, states)
        if beside is not None:
            beside()
        self.end()

    def log_alone(self, result: FrameResult) -> None:
        """What no other frame has a part in but the one before it; ``log_in_order`` has the rest.

        With both, by two loggers that need not know each other, a recording says of a frame what it says with
        ``log``.
        """
        frame = result.frame
        self.begin(frame.index, frame.stamp, frame.received)
        self._log_alone(result, colored=False)
        self.end()

    def log_in_order(self, result: FrameResult) -> None:
        """What the frames before have a part in: tracks and their colours, anomalies, states, rates."""
        frame = result.frame
        self.begin(frame.index, frame.stamp, frame.received)
        if result.clusters is not None:
            log_cluster_colors(self, frame, result.clusters, result.tracks)
        self._log_in_order(result)
        self.end()

    def _log_alone(self, result: FrameResult, *, cloud: bool = False, colored: bool = True) -> None:
        frame = result.frame
        if frame.lidar:
            self.put(entities.sensor(frame.lidar), transform(frame.pose))
        before = set(self._now)
        if self._inputs:
            self._log_input(result)
        elif cloud:
            log_cloud(self, result)
        self._brought |= self._now - before
        self._log_lidar_results(result, colored)
        for camera in result.cameras:
            self._log_camera_results(camera)
        log_frustums(self, frame, result.cameras)
        if result.bev is not None:
            log_bev(self, result.bev, self._config)
            log_grid(self, result, result.bev)
        if not self.root:
            log_shapes(self, frame)

    def _log_in_order(
        self,
        result: FrameResult,
        health: Mapping[str, float] = MappingProxyType({}),
        notes: Sequence[tuple[str, str]] = (),
        states: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        frame = result.frame
        log_objects(self, result)
        if result.tracks is not None:
            log_tracks(self, frame, result.tracks, self._config.bev)
        lines = marks(frame) if self.root else self._around.lines(frame)
        log_decisions(self, result, [*notes, *lines])
        log_anomalies(self, result, self._onsets.of(result.anomalies))
        self._log_states(result, states)
        self._rates.add(frame)
        log_health(self, result, self._last, self._rates, health)
        self._last = frame

    def log_meanwhile(
        self, seconds: float, notes: Sequence[tuple[str, str]], states: Mapping[str, str]
    ) -> None:
        """What is to be said while no frame comes, ``seconds`` after the last one was received."""
        if self._last is None:
            return
        later = round(seconds * 1e9)
        last = self._last
        self.set_time(last.index, last.stamp + later, last.received + later if last.received else 0)
        self.lines(entities.EXPLAIN_LOG, notes)
        self._state_lanes.log(self, {**self._state_lanes.states, **states})

    def _log_input(self, result: FrameResult) -> None:
        """What the sensors and the robot brought."""
        frame, config = result.frame, self._config
        if config.logging.raw_cloud:
            log_cloud(self, result)
        for camera in result.cameras:
            log_camera(self, frame, camera, config.logging.jpeg_quality)
            if camera.camera.intrinsics is not None:
                self._log_intrinsics(camera.camera.name, camera.camera.intrinsics)
        log_truth(self, frame, config.bev)
        log_robot(self, frame, config.bev)
        for topic, stamp in list(self._late.items()):
            if frame.stamp - stamp > STALE:
                del self._late[topic]
                forget_late(self, topic)

    def _log_intrinsics(self, name: str, intrinsics: Intrinsics) -> None:
        """Where they are new."""
        last = self._intrinsics.get(name)
        if last is intrinsics:
            return
        self._intrinsics = {**self._intrinsics, name: intrinsics}  # a context may hold the one before
        size = (intrinsics.width, intrinsics.height)
        if last is None or (last.width, last.height) != size or not np.array_equal(last.K, intrinsics.K):
            log_intrinsics(self, name, intrinsics)

    def _log_lidar_results(self, result: FrameResult, colored: bool) -> None:
        frame, config = result.frame, self._config
        log_ground(self, result, config.voxel.size)
        if result.obstacles is None:
            return
        obstacles = quantised(result.obstacles, config.voxel.size)
        log_obstacles(self, frame, obstacles)
        if result.clusters is not None:
            log_clusters(self, frame, result.clusters, result.tracks, obstacles, config.clustering, colored)

    def _log_camera_results(self, result: CameraResult) -> None:
        if result.detections is not None:
            log_detections(self, result.camera.name, result.detections)
        if self._config.logging.projected_points:
            log_projected_points(self, result)

    def _log_states(self, result: FrameResult, more: Mapping[str, str]) -> None:
        states = {**states_of(result), **more}
        rows = self._track_lanes.update(result.tracks)
        if result.tracks is not None:
            log_speeds(self, result.tracks, rows)
            states |= track_states(result.tracks, rows)
        if not self.root:
            states |= diagnostic_states(result.frame)
        self._state_lanes.log(self, states)
