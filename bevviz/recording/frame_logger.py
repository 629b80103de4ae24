"""Log a FrameResult: call the ``log_*`` functions, and keep the state that they need between frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
import rerun as rr

from bevviz.anomalies import Onsets
from bevviz.config import Config, config_yaml, stated_lines
from bevviz.model.frame import Frame, Intrinsics, LateBoxes, Scene
from bevviz.model.results import FrameResult
from bevviz.recording import entities
from bevviz.recording.addresses import EntityRows
from bevviz.recording.boxes import (
    TrackLanes,
    clear_late,
    log_late,
    log_objects,
    log_robot,
    log_speeds,
    log_tracks,
    log_truth,
)
from bevviz.recording.cloud import (
    log_cloud,
    log_cloud_poses,
    log_cloud_style,
    log_clusters,
    log_ground,
    log_obstacles,
    packed_points,
    raw_clouds,
    round_voxels,
    unclustered,
)
from bevviz.recording.decisions import log_decisions
from bevviz.recording.health import FrameRates, log_anomalies, log_health
from bevviz.recording.images import (
    VideoEncoders,
    log_bev,
    log_camera,
    log_detections,
    log_frustums,
    log_grid,
    log_intrinsics,
    log_projected_points,
)
from bevviz.recording.opinions import (
    log_fusion,
    log_opinions_in_bev,
    log_opinions_in_images,
)
from bevviz.recording.primitives import document, log_world, transform
from bevviz.recording.provenance import versions
from bevviz.recording.retention import (
    CLUSTER_STEPS,
    RawCloudLog,
    keeps_everything,
    omitted_data,
    rounding_scale,
)
from bevviz.recording.states import COLORS, StateLanes, states_of, track_states
from bevviz.recording.stream import RecordingStream
from bevviz.recording.surroundings import (
    DiagnosticsLog,
    StaticData,
    diagnostic_states,
    log_imu_samples,
    log_shapes,
    mark_lines,
    static_data_makers,
)
from bevviz.recording.writer import Writer
from bevviz.stages.odometry import ESTIMATED
from bevviz.support.text import fenced, markdown

MOTION_NOTE = "nothing states the robot's motion: it is estimated from the scans (odometry.method)"
LATE_RESULT_LIFETIME = 3_000_000_000  # nanoseconds that the newest late result of the robot stays visible


@dataclass(frozen=True, slots=True)
class RecordingContext:
    """State from earlier frames that a frame relies on. A recording that starts with the frame needs it."""

    config: Config
    scene: Scene
    clock: tuple[int, int, int] = (0, 0, 0)  # index, stamp and received of the frame
    intrinsics: Mapping[str, Intrinsics] = field(default_factory=dict)
    lanes: Mapping[str, str] = field(default_factory=dict)  # state lane -> its state
    fixed: Mapping[str, StaticData] = field(
        default_factory=dict
    )  # entity -> static data, from its first frame on


class FrameLogger(Writer):
    """Logger of frames to a recording, on the timelines ``stamp``, ``frame`` and ``received``.

    Call ``log_static`` once, then ``log`` for each frame.

    Args:
        recording: recording stream, with any number of sinks.
        config: configuration of the run; it is stored in the recording.
        scene: names of the sensors.
        root: entity above all others. A logger with a root adds the results of another run to frames that
            another logger writes. It does not write the input of the sensors and the robot again.
        wait, stamps: see ``Writer``.
        inputs: write the input of the sensors and the robot; default: only without a root.
        network: device of the detector's network; it is stored in the recording.
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
        network: str = "",
    ) -> None:
        super().__init__(recording, root, wait, stamps)
        self._inputs = not root if inputs is None else inputs
        self._input_entities: set[str] = set()  # entities of the sensors and the robot
        self._config = config
        self.streams_video = config.logging.video == "stream"
        self._scene, self._network = scene, network
        self._intrinsics: dict[str, Intrinsics] = {}
        self._static_data: dict[str, StaticData] = {}
        self._track_lanes = TrackLanes()
        self._state_lanes = StateLanes(COLORS, plain_lanes=entities.ANOMALY_STATE.above)
        self._robot_log = DiagnosticsLog()
        self._onsets = Onsets()
        self._last_frame: Frame | None = None
        self._rates = FrameRates()
        self._videos, self._raw_clouds = VideoEncoders(), RawCloudLog()
        self._config_changed = False  # whether the configuration changed before this frame
        self._late_stamps: dict[str, int] = {}  # topic of late robot results -> stamp of the newest

    @property
    def context(self) -> RecordingContext:
        """State that the last logged frame relies on."""
        frame = self._last_frame
        clock = (0, 0, 0) if frame is None else (frame.index, frame.stamp, frame.received)
        return RecordingContext(
            self._config, self._scene, clock, self._intrinsics, self._state_lanes.states, self._static_data
        )

    @property
    def clouds_left_out(self) -> int:
        """Number of events without raw clouds around them, because the limit of raw clouds was reached."""
        return self._raw_clouds.left_out

    @property
    def results(self) -> frozenset[str]:
        """Entities that any frame had, except the input of the sensors and the robot."""
        return self.known - self._input_entities

    def refresh(self, known: Set[str] = frozenset()) -> None:
        """Make the next frame complete, as ``Writer.refresh`` does.

        Inputs that this logger does not write are not cleared either.
        """
        super().refresh(known)
        self._videos.restart()
        self._raw_clouds.refresh()
        if not self._inputs:
            self._previous_entities -= self._input_entities

    # --- once ----------------------------------------------------------------------------------

    def log_static(self) -> None:
        """Log the static data: origin of the recording, axes, classes and styles."""
        lidars = list(dict.fromkeys(filter(None, (self._scene.lidar, *self._scene.lidars))))
        log_run_settings(self, self._config, self._scene, self._network)
        log_world(self)
        log_cloud_style(self, lidars)

    def log_context(self, context: RecordingContext) -> None:
        """Log static data, calibration and states for a recording that starts with a frame."""
        self.log_static()
        for name, intrinsics in context.intrinsics.items():
            self._log_intrinsics(name, intrinsics)
        for path, data in context.fixed.items():
            self.static(path, *data)
        if context.lanes:
            self.set_time(*context.clock)
            self._state_lanes.log(self, context.lanes)

    def reconfigure(self, config: Config, scene: Scene) -> None:
        """Change the configuration and the sensors for the frames that follow."""
        same, self._config, self._scene = scene == self._scene, config, scene
        self._config_changed = True
        self.streams_video = config.logging.video == "stream"
        if same:  # the viewer loses class colours that are logged twice
            log_run_settings(self, config, scene, self._network)
        else:
            self.log_static()

    # --- each frame ----------------------------------------------------------------------------

    def log(
        self,
        result: FrameResult,
        health: Mapping[str, float] = MappingProxyType({}),
        notes: Sequence[tuple[str, str]] = (),
        late: Sequence[LateBoxes] = (),
        states: Mapping[str, str] = MappingProxyType({}),
        log_more: Callable[[], object] | None = None,
        cloud: bool = False,
    ) -> None:
        """Log a frame. Entities that only the previous frame had are cleared.

        Args:
            result: the frame and its results.
            health: further scalars, by entity.
            notes: further lines of the log: level and text.
            late: results that the robot has published since and that belong to earlier frames.
            states: states of further lanes, by entity.
            log_more: function that logs additional data of the frame.
            cloud: write the raw cloud, coloured as ground and obstacles, even without inputs.
        """
        frame = result.frame
        for late_result in late:
            self._late_stamps[late_result.boxes.topic] = late_result.boxes.stamp
            log_late(self, late_result, self._config.bev)
        self.begin(frame.index, frame.stamp, frame.received)
        self._log_results(result, cloud)
        self._log_changes(result, health, notes, states)
        if log_more is not None:
            log_more()
        self.end()

    def log_frame(self, result: FrameResult, log_more: Callable[[], object]) -> None:
        """Log the part of a frame that a viewer shows at its time, without numbers, states and notes.

        Args:
            result: the frame and its results.
            log_more: function that logs additional data of the frame.
        """
        frame = result.frame
        self.begin(frame.index, frame.stamp, frame.received)
        self._log_results(result, False)
        log_more()
        self.end()

    def log_numbers(self, result: FrameResult) -> None:
        """Log the numbers, states and notes of the next frame, which ``log_frame`` leaves out."""
        frame = result.frame
        self.begin(frame.index, frame.stamp, frame.received)
        self._log_changes(result, {}, (), {})
        self.end()

    def _log_results(self, result: FrameResult, cloud: bool) -> None:
        """Log the results of this frame: those of the stages, objects and tracks."""
        self._log_stages(result, cloud)
        log_objects(self, result)
        log_fusion(self, result)
        if result.tracks is not None:
            log_tracks(self, result.frame, result.tracks, self._config.bev)

    def _log_stages(self, result: FrameResult, cloud: bool) -> None:
        """Log the results of the stages for this frame alone."""
        frame = result.frame
        if frame.lidar:
            self.put(entities.SENSOR.path(frame.lidar), transform(frame.pose))
        entities_before = set(self._frame_entities)
        if self._inputs:
            self._log_input(result)
        elif cloud:
            log_cloud(self, result, self._config.logging.color_by)
        self._input_entities |= self._frame_entities - entities_before
        self._log_lidar_results(result)
        for camera in result.cameras:
            log_detections(self, camera, result.explanations, has_truth=frame.truth is not None)
            if self._config.logging.projected_points and self._config.logging.keep != "report":
                log_projected_points(self, camera, packed=not keeps_everything(self._config))
        log_opinions_in_images(self, result)
        log_frustums(self, frame, result.cameras)
        log_decisions(self, result)
        if result.bev is not None:
            log_bev(self, result.bev, self._config)
            log_opinions_in_bev(self, result)
            if self._config.logging.keep != "report":
                log_grid(self, result, result.bev)
        if not self.root:
            self._log_static_data(frame)
            log_shapes(self, frame)
            log_imu_samples(self, frame)

    def _log_changes(
        self,
        result: FrameResult,
        health: Mapping[str, float],
        notes: Sequence[tuple[str, str]],
        states: Mapping[str, str],
    ) -> None:
        """Log data that depends on earlier frames: anomalies, states, rates."""
        frame = result.frame
        lines = mark_lines(frame) if self.root else self._robot_log.lines(frame)
        before = self._last_frame
        if frame.world_frame == ESTIMATED and (before is None or before.world_frame != ESTIMATED):
            notes = [*notes, ("INFO", MOTION_NOTE)]
        self.lines(entities.EXPLAIN_LOG, [*notes, *lines])
        started = self._onsets.of(result.anomalies)
        log_anomalies(self, result, started)
        self._log_states(result, states)
        logging = self._config.logging
        if self._inputs and logging.keep == "inspect" and logging.raw_cloud:
            self._log_selected_clouds(result, is_event=bool(started))
        self._rates.add(frame)
        log_health(self, result, self._last_frame, self._rates, health)
        self._last_frame = frame

    def log_meanwhile(
        self, seconds: float, notes: Sequence[tuple[str, str]], states: Mapping[str, str]
    ) -> None:
        """Log notes and states while no frame arrives, ``seconds`` after the last frame was received."""
        if self._last_frame is None:
            return
        elapsed = round(seconds * 1e9)
        last = self._last_frame
        self.set_time(last.index, last.stamp + elapsed, last.received + elapsed if last.received else 0)
        self.lines(entities.EXPLAIN_LOG, notes)
        self._state_lanes.log(self, {**self._state_lanes.states, **states})

    def _log_input(self, result: FrameResult) -> None:
        """Log the input of the sensors and the robot."""
        frame, config = result.frame, self._config
        if config.logging.raw_cloud and keeps_everything(config):
            log_cloud(self, result, config.logging.color_by)
        else:
            log_cloud_poses(self, frame)
        videos = None if keeps_everything(config) else self._videos
        for camera in result.cameras:
            log_camera(self, frame, camera, config.logging.jpeg_quality, videos)
            if camera.camera.intrinsics is not None:
                self._log_intrinsics(camera.camera.name, camera.camera.intrinsics)
        log_truth(self, frame, config.bev)
        log_robot(self, frame, config.bev)
        for topic, stamp in list(self._late_stamps.items()):
            if frame.stamp - stamp > LATE_RESULT_LIFETIME:
                del self._late_stamps[topic]
                clear_late(self, topic)

    def _log_static_data(self, frame: Frame) -> None:
        """Log static data that the frame is the first to have."""
        for path, make_data in static_data_makers(frame).items():
            if path not in self._static_data and (data := make_data()) is not None:
                self._static_data = {
                    **self._static_data,
                    path: data,
                }  # a Context may hold the previous mapping
                self.static(path, *data)

    def _log_intrinsics(self, name: str, intrinsics: Intrinsics) -> None:
        """Log intrinsics if they changed."""
        last = self._intrinsics.get(name)
        if last is intrinsics:
            return
        self._intrinsics = {**self._intrinsics, name: intrinsics}  # a Context may hold the previous mapping
        size = (intrinsics.width, intrinsics.height)
        if last is None or (last.width, last.height) != size or not np.array_equal(last.K, intrinsics.K):
            log_intrinsics(self, name, intrinsics)

    def _log_lidar_results(self, result: FrameResult) -> None:
        """Log ground, obstacles and clusters. Unless everything is kept, each voxel is logged once."""
        frame, config, clusters = result.frame, self._config, result.clusters
        size, obstacles = config.voxel.size, result.obstacles
        is_packed, is_report = not keeps_everything(config), config.logging.keep == "report"
        if not is_report:
            log_ground(self, result, size, packed=is_packed)
        if obstacles is None:
            return
        if not is_packed:
            obstacles = round_voxels(obstacles, size)
            log_obstacles(self, frame, obstacles)
        elif not is_report:
            others = obstacles if clusters is None else unclustered(obstacles, clusters)
            log_obstacles(self, frame, packed_points(others, size))
        if clusters is not None:
            scale = rounding_scale(size, CLUSTER_STEPS) if is_packed else None
            log_clusters(self, frame, clusters, result.tracks, obstacles, config.clustering, scale)

    def _log_selected_clouds(self, result: FrameResult, *, is_event: bool) -> None:
        """Log the raw clouds of this frame and of earlier frames, if they are wanted.

        Call it after anomalies and states are logged, because changes in them select the clouds.
        """
        lanes = [
            entities.STATE.path("pipeline"),
            *(entities.STATE.path(camera.camera.name) for camera in result.cameras),
        ]
        states = {lane: self._state_lanes.states.get(lane, "") for lane in lanes}
        is_requested = bool(mark_lines(result.frame)) or self._config_changed
        self._config_changed = False
        clouds, config = raw_clouds(result), self._config.logging
        self._raw_clouds.log(
            self, result.frame, clouds, config, states, is_event=is_event, is_requested=is_requested
        )

    def _log_states(self, result: FrameResult, extra_states: Mapping[str, str]) -> None:
        states = {**states_of(result), **extra_states}
        rows = self._track_lanes.update(result.tracks)
        if result.tracks is not None:
            log_speeds(self, result.tracks, rows)
            states |= track_states(result.tracks, rows)
        if not self.root:
            states |= diagnostic_states(result.frame)
        self._state_lanes.log(self, states)


def logged_rows(result: FrameResult, log_more: Callable[[Writer], object] | None = None) -> EntityRows:
    """Return the rows behind the entities of a frame whose log is no longer at hand.

    Args:
        result: the frame and its results.
        log_more: as in ``FrameLogger.log``; it gets the writer.
    """
    logger = FrameLogger(RecordingStream("bevviz"), result.config, Scene("", result.frame.lidar))
    logger.log(result, log_more=None if log_more is None else partial(log_more, logger))
    return logger.rows


def log_run_settings(to: Writer, config: Config, scene: Scene, network: str = "") -> None:
    """Log source, configuration, versions, and the device of the detector's network."""
    settings = config_yaml(config)
    stated = stated_lines(config, folders=False)
    packages = [f"{name} {version}" for name, version in versions().items()]
    lines = [*map(markdown, stated), *packages, *([f"network on {markdown(network)}"] if network else [])]
    omitted = list(omitted_data(config.logging))
    omissions = "".join(f"- {line}\n" for line in omitted)
    omissions = (
        f"## Not in this recording (keep: {config.logging.keep})\n\n{omissions}\n" if omissions else ""
    )
    to.static(
        entities.CONFIG,
        document(
            "# How this recording was made\n\n"
            f"Source: **{markdown(scene.name)}**, preset: **{config.preset}**\n\n"
            f"{omissions}{fenced(settings, 'yaml')}\n\n" + "\n".join(f"- {line}" for line in lines)
        ),
    )
    if not to.root:
        to.recording.send_recording_name(scene.name)
    fields: dict[str, Any] = {
        "source": scene.name,
        "preset": config.preset,
        "config": settings,
        "stated": stated,
        "versions": packages,
        "lidars": [name for name in scene.lidars or (scene.lidar,) if name],
        "cameras": list(scene.cameras),
        "keep": config.logging.keep,
        "left_out": omitted,
        "network": network,
    }
    # Rerun omits None and may omit or keep empty values, depending on names that its process has seen.
    values = rr.AnyValues(**{name: value for name, value in fields.items() if value})
    to.recording.send_property(entities.PROPERTY + to.root.replace("/", "_"), values)
