"""The frame step: every stage on one frame with one configuration. No state, no threads of its own."""

from __future__ import annotations

import threading
import traceback
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any, TypeVar, TypeVarTuple, cast

import numpy as np
from pydantic import BaseModel

from bevviz import geometry
from bevviz.config import Config, DetectorConfig, FusionConfig
from bevviz.errors import StageError, UserError, interrupt_in
from bevviz.explain import explain
from bevviz.frame import (
    F32,
    Camera,
    CameraResult,
    Claims,
    Clusters,
    Detections,
    Failure,
    Frame,
    FrameResult,
    Fusion,
    Ground,
    Objects,
    Splits,
    Voxels,
)
from bevviz.loggers import logger
from bevviz.plugins import TOPIC
from bevviz.stages import foreign, robot
from bevviz.stages.bev import bev
from bevviz.stages.clustering import cluster
from bevviz.stages.detector import Detector
from bevviz.stages.foreign import Foreign
from bevviz.stages.frustum import claim
from bevviz.stages.fusion import fuse, merge
from bevviz.stages.ground import segment_ground
from bevviz.stages.kernel import clock, common_clock
from bevviz.stages.voxel import of_points, voxel_grid

T = TypeVar("T")
Ts = TypeVarTuple("Ts")

Detect = Callable[[Camera], Detections | None]

_log = logger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Stages:
    """The functions and networks that a configuration names. None: the stage is ours, or there is none.

    Attributes:
        network: the detector's network, shared by configurations that only differ in thresholds.
        detector: the same with this configuration's thresholds.
        detect: what finds the objects in a camera's image instead of both.
    """

    ground: Foreign | None = None
    clustering: Foreign | None = None
    objects: Foreign | None = None
    network: Detector | Foreign | None = None
    detector: Detector | None = None
    detect: Detect | None = None

    @property
    def class_names(self) -> tuple[str, ...]:
        """That the detector knows, as far as that is known."""
        return () if self.detector is None else tuple(self.detector.names)

    @property
    def provider(self) -> str:
        """What the network runs on; empty: there is none of ours."""
        return "" if self.detector is None else self.detector.provider


class StageLoader:
    """Loads what configurations name, each network and function once."""

    def __init__(self) -> None:
        self._networks: dict[tuple[str, str, str, int], Detector] = {}
        self._foreign: dict[tuple[str, str], Foreign | None] = {}

    def load(self, config: Config, detect: Detect | None = None) -> Stages:
        """The stages of a configuration; with ``detect``, that instead of its detector.

        Raises:
            UserError: the detector's model or somebody's function cannot be used.
        """
        detector = None if detect is not None else self._function(config, "detector")
        network = self._network(config.detector) if detect is None and detector is None else None
        return Stages(
            ground=self._function(config, "ground"),
            clustering=self._function(config, "clustering"),
            objects=self._function(config, "objects"),
            network=network or detector,
            detector=None if network is None else network.restated(config.detector),
            detect=detect,
        )

    def _function(self, config: Config, section: str) -> Foreign | None:
        key = section, getattr(config, section).model_dump_json()
        if key not in self._foreign:
            self._foreign[key] = foreign.foreign(config, section)
        return self._foreign[key]

    def _network(self, config: DetectorConfig) -> Detector | None:
        if not config.model or config.model.startswith(TOPIC):
            return None
        key = config.model, config.names, config.provider, config.threads
        if key not in self._networks:
            self._networks[key] = Detector(config)
        return self._networks[key]


class Memo:
    """What stages made of one frame, for runs of other configurations on the same frame.

    A stage that gets the same arrays and equal parameters is not run again. To be cleared from one frame to
    the next.

    Args:
        size: results that are kept; the one that was not asked for the longest goes.
    """

    def __init__(self, size: int = 200) -> None:
        self._size = size
        self._results: OrderedDict[tuple[object, ...], tuple[tuple[object, ...], Any, float]] = OrderedDict()
        self._local = threading.local()

    @property
    def seconds_saved(self) -> float:
        """By this thread so far."""
        return getattr(self._local, "seconds_saved", 0.0)

    def clear(self) -> None:
        self._results.clear()

    def call(self, function: Callable[[*Ts], T], *args: *Ts) -> T:
        """The function's result, made now or before. A function may ask for others in turn."""
        key = (function, *map(_identity, args))
        if key in self._results:
            _, known, seconds = self._results[key]
            self._results.move_to_end(key)
            self._local.seconds_saved = self.seconds_saved + seconds
            return cast(T, known)
        start, before = clock(), self.seconds_saved
        result = function(*args)
        seconds = clock() - start + self.seconds_saved - before
        # The arguments are kept as well: nothing else can get their ids then.
        self._results[key] = args, result, seconds
        if len(self._results) > self._size:
            self._results.popitem(last=False)
        return result


def _identity(argument: object) -> object:
    """Parameters are the same when they are equal, arrays only when they are one."""
    if isinstance(argument, BaseModel) and not isinstance(argument, Config):
        return type(argument), argument.model_dump_json()
    return argument if isinstance(argument, str | int | float) else id(argument)


class StageLog:
    """Runs stages; keeps how long each took and why it failed.

    Args:
        memo: where to look for results; a stage that need not be run counts with the time it once took.
    """

    def __init__(self, memo: Memo | None = None) -> None:
        self.timings: dict[str, float] = {}
        self.failures: list[Failure] = []
        self.seconds_saved = 0.0
        self._memo = memo

    def run(self, stage: str, function: Callable[[*Ts], T], *args: *Ts) -> T | None:
        """The function's result, or None where it failed: one bad stage must not take the frame with it.

        Raises:
            KeyboardInterrupt: the user wants to end, whatever the stage made of that.
        """
        return self.guard(stage, lambda: self.call(function, *args))

    def guard(self, stage: str, work: Callable[[], T]) -> T | None:
        """As ``run``, of what is not to be looked up itself."""
        memo = self._memo
        start, before = clock(), memo.seconds_saved if memo else 0.0
        try:
            return work()
        except (UserError, StageError) as error:
            self._failed(stage, str(error), error)
        except Exception as error:
            if interrupt_in(error):
                raise KeyboardInterrupt from error
            self._failed(stage, f"{type(error).__name__}: {error}", error)
        finally:
            saved = memo.seconds_saved - before if memo else 0.0
            self.timings[stage] = self.timings.get(stage, 0.0) + clock() - start + saved
            self.seconds_saved += saved
        return None

    def call(self, function: Callable[[*Ts], T], *args: *Ts) -> T:
        """The function's result, from the memo where there is one."""
        return function(*args) if self._memo is None else self._memo.call(function, *args)

    def _failed(self, stage: str, reason: str, error: Exception) -> None:
        unforeseen = not isinstance(error, UserError | StageError)
        trace = "".join(traceback.format_exception(error)) if unforeseen else ""
        _log.warning("stage %s failed: %s", stage, reason, exc_info=error if unforeseen else None)
        self.failures.append(Failure(stage, reason, trace))


def perceive(
    frame: Frame, config: Config, stages: Stages, memo: Memo | None = None, *, network: Executor | None = None
) -> FrameResult:
    """What the stages make of the frame, without what needs other frames (tracks, anomalies).

    Never raises for what the frame holds: what fails is told in ``failures``, the rest goes on.

    Args:
        frame: the frame.
        config: the configuration; the result says that it was made with this one.
        stages: that the configuration names, of ``StageLoader.load``.
        memo: shared by configurations that run on the same frame.
        network: where the detector runs beside the LiDAR stages, since it needs no lock of Python's; None:
            after them.
    """
    log, detector_log = StageLog(memo), StageLog(memo)
    start = common_clock()

    def detect(camera: Camera) -> Detections | None:
        return _detect(detector_log, frame, camera, config, stages)

    found = [network.submit(detect, camera) for camera in frame.cameras] if network is not None else []

    voxels = ground = obstacles = clusters = None
    if not frame.lidar:
        pass
    elif len(frame.points) == 0:
        log.failures.append(Failure("cloud", "the cloud holds no finite point"))
    else:
        voxels = log.run("voxel", voxel_grid, frame.points, config.voxel)
    if voxels is not None:
        ground = _ground(log, frame, voxels, config, stages)
    if voxels is not None and ground is not None:
        obstacles = log.run("ground", _obstacles, voxels, ground)
    if obstacles is not None:
        clusters = _clusters(log, frame, obstacles, config, stages)

    cameras = []
    for i, camera in enumerate(frame.cameras):
        uv = depth = None
        if obstacles is not None:
            projected = log.run("projection", _project, obstacles, camera)
            uv, depth = projected or (None, None)
        detections = found[i].result() if network is not None else detect(camera)
        cameras.append(CameraResult(camera, detections, None, uv, depth))
    splits: Splits | None = None
    claims: Sequence[Claims | None] = [None] * len(cameras)
    if obstacles is not None and clusters is not None and _splits(config):
        height = None if ground is None else ground.height.compress(~ground.mask)
        seen = tuple(cameras)
        sections = config.fusion, config.objects, config.clustering
        made = log.run("fusion", claim, obstacles, height, clusters, seen, *sections)
        if made is not None:
            clusters, claims, splits = made
    for i, (result, claimed) in enumerate(zip(cameras, claims, strict=True)):
        uv, depth, found_there = result.uv, result.depth, result.detections
        if uv is not None and depth is not None and clusters is not None and found_there is not None:
            fusion = log.run(
                "fusion", _fuse, uv, depth, clusters, found_there, result.camera, config.fusion, claimed
            )
            cameras[i] = replace(result, fusion=fusion)
    log.timings.update(detector_log.timings)
    log.failures.extend(detector_log.failures)

    objects = _objects(log, frame, obstacles, clusters, cameras, config, stages)
    wall = common_clock() - start + log.seconds_saved
    lidar = sum(log.timings.values()) - sum(detector_log.timings.values())
    log.timings["total"] = max(wall, lidar, sum(detector_log.timings.values()))
    return FrameResult(
        frame=frame,
        config=config,
        voxels=voxels,
        ground=ground,
        obstacles=obstacles,
        clusters=clusters,
        cameras=tuple(cameras),
        objects=objects,
        splits=splits,
        bev=None,
        timings=log.timings,
        failures=tuple(log.failures),
    )


def describe(result: FrameResult, *, seen: bool = True) -> FrameResult:
    """The result with what makes it understood: the bird's-eye view, where it is to be seen, and the
    explanations."""
    config, frame, log = result.config, result.frame, StageLog()
    start = clock()
    raw_ground = image = None
    if seen and result.voxels is not None and result.ground is not None:
        raw_ground = log.run("bev", of_points, result.ground.mask, result.voxels.inverse)
    if seen and frame.lidar:
        image = log.run(
            "bev",
            bev,
            frame.points,
            frame.fields.get("intensity"),
            raw_ground,
            result.objects,
            result.clusters,
            config.bev,
        )
    explanations = log.run(
        "explain", explain, result.cameras, result.clusters, config, result.splits, bool(frame.lidar)
    )
    wall = clock() - start
    return replace(
        result,
        bev=image,
        explanations=explanations or (),
        timings={**result.timings, **log.timings, "total": result.timings["total"] + wall},
        failures=(*result.failures, *log.failures),
    )


# --- the stages, each as the configuration names it --------------------------------------------


def _topic(method: str) -> str:
    """The robot's topic that a stage is taken from, empty where it is none."""
    return method.removeprefix(TOPIC) if method.startswith(TOPIC) else ""


def _ground(log: StageLog, frame: Frame, voxels: Voxels, config: Config, stages: Stages) -> Ground | None:
    points = voxels.points
    if topic := _topic(config.ground.method):
        return log.run("ground", robot.segment, points, frame, topic, config.voxel.size)
    if (function := stages.ground) is not None:
        return log.guard(
            "ground", lambda: foreign.ground_of(points, log.call(function, points), function.name)
        )
    return log.run("ground", segment_ground, points, config.ground)


def _obstacles(voxels: Voxels, ground: Ground) -> F32:
    """The voxels that are not ground."""
    return voxels.points.compress(~ground.mask, axis=0)


def _clusters(log: StageLog, frame: Frame, points: F32, config: Config, stages: Stages) -> Clusters | None:
    section = config.clustering
    if topic := _topic(section.method):
        return log.run("clustering", robot.cluster, points, frame, topic)
    if (function := stages.clustering) is not None:
        return log.guard(
            "clustering",
            lambda: foreign.clusters_of(points, section, log.call(function, points), function.name),
        )
    return log.run("clustering", cluster, points, section)


def _detect(log: StageLog, frame: Frame, camera: Camera, config: Config, stages: Stages) -> Detections | None:
    section, image, network, detector = config.detector, camera.image, stages.network, stages.detector
    if (detect := stages.detect) is not None:
        return log.guard("detector", lambda: detect(camera))
    if topic := _topic(section.model):
        return log.guard("detector", lambda: robot.detect(frame, camera, topic))
    if image is None or network is None:
        return None
    if not image.bgr.size:
        return Detections.empty()
    if isinstance(network, Foreign):
        return log.guard(
            "detector",
            lambda: foreign.detections_of(section.conf_threshold, log.call(network, image.bgr), network.name),
        )
    assert detector is not None
    return log.guard("detector", lambda: detector.interpret(log.call(network.infer, image.bgr)))


def _project(points: F32, camera: Camera) -> tuple[F32, F32] | None:
    """Pixels and depths of the points, NaN outside the image; None where the camera's place is unknown."""
    if camera.intrinsics is None or camera.camera_from_points is None:
        return None
    uv, depth = geometry.project(geometry.apply(camera.camera_from_points, points), camera.intrinsics)
    u, v = uv.T
    with np.errstate(invalid="ignore"):
        seen = (u >= -0.5) & (u < camera.intrinsics.width - 0.5)
        seen &= (v >= -0.5) & (v < camera.intrinsics.height - 0.5)
    np.copyto(uv, np.nan, where=~seen[:, None])
    return uv, depth


def _splits(config: Config) -> bool:
    """Whether detections split clusters: those of the robot stay as it published them."""
    ours = not _topic(config.clustering.method)
    return config.fusion.method == "frustum" and config.fusion.split and ours


def _fuse(
    uv: F32,
    depth: F32,
    clusters: Clusters,
    detections: Detections,
    camera: Camera,
    config: FusionConfig,
    claims: Claims | None,
) -> Fusion | None:
    if camera.intrinsics is None or camera.camera_from_points is None:
        return None
    return fuse(uv, depth, clusters, detections, camera.intrinsics, camera.camera_from_points, config, claims)


def _objects(
    log: StageLog,
    frame: Frame,
    obstacles: F32 | None,
    clusters: Clusters | None,
    cameras: list[CameraResult],
    config: Config,
    stages: Stages,
) -> Objects | None:
    if topic := _topic(config.objects.method):
        return log.guard("objects", lambda: robot.find_objects(frame, topic, obstacles, clusters))
    if (function := stages.objects) is not None:
        if len(frame.points) == 0:
            return None
        cloud = foreign.with_intensity(frame.points, frame.fields.get("intensity"))
        return log.guard(
            "objects",
            lambda: foreign.objects_of(log.call(function, cloud), function.name, obstacles, clusters),
        )
    return None if clusters is None else log.run("fusion", merge, clusters, cameras, config.clustering)
