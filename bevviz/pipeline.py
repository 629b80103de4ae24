"""The pipeline: runs the stages on a frame, times them, and turns a failure into a reason."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import TracebackType
from typing import Any, Self, TypeVar, TypeVarTuple, cast

import numpy as np
from pydantic import BaseModel

from bevviz import geometry
from bevviz.anomalies import AnomalyDetector
from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.explain import explain
from bevviz.frame import (
    F32,
    Camera,
    CameraResult,
    Clusters,
    Detections,
    Failure,
    Frame,
    FrameResult,
    Fusion,
    Ground,
    Voxels,
)
from bevviz.stages.bev import bev
from bevviz.stages.clustering import cluster
from bevviz.stages.detector import Detector
from bevviz.stages.fusion import fuse, in_view, merge
from bevviz.stages.ground import segment_ground
from bevviz.stages.tracking import Tracker
from bevviz.stages.voxel import of_points, voxel_grid

T = TypeVar("T")
Ts = TypeVarTuple("Ts")


class Memo:
    """What stages made of one frame, for runs of other configurations on the same frame.

    A stage that gets the same arrays and an equal configuration is not run again. To be cleared from one
    frame to the next.

    Args:
        size: results that are kept; the one that was not asked for the longest goes.
    """

    def __init__(self, size: int = 200) -> None:
        self._size = size
        self._made: OrderedDict[tuple[object, ...], tuple[tuple[object, ...], Any, float]] = OrderedDict()
        self._local = threading.local()

    @property
    def spared(self) -> float:
        """Seconds that this thread was spared so far."""
        return getattr(self._local, "spared", 0.0)

    def clear(self) -> None:
        self._made.clear()

    def call(self, function: Callable[[*Ts], T], *args: *Ts) -> T:
        """The function's result, made now or before. A function may ask for others in turn."""
        key = (function, *map(_identity, args))
        if key in self._made:
            _, known, seconds = self._made[key]
            self._made.move_to_end(key)
            self._local.spared = self.spared + seconds
            return cast(T, known)
        start, before = time.perf_counter(), self.spared
        result = function(*args)
        seconds = time.perf_counter() - start + self.spared - before
        # The arguments are kept as well: nothing else can get their ids then.
        self._made[key] = args, result, seconds
        if len(self._made) > self._size:
            self._made.popitem(last=False)
        return result


def _identity(argument: object) -> object:
    """Parameters are the same when they are equal, arrays only when they are one."""
    parameters = isinstance(argument, BaseModel) and not isinstance(argument, Config)  # holds mappings
    return argument if parameters else id(argument)


class StageLog:
    """Runs stages; keeps how long each took and why it failed.

    Args:
        memo: where to look for results; a stage that was spared counts with the time that it once took.
    """

    def __init__(self, memo: Memo | None = None) -> None:
        self.timings: dict[str, float] = {}
        self.failures: list[Failure] = []
        self.spared = 0.0
        self._memo = memo

    def run(self, stage: str, function: Callable[[*Ts], T], *args: *Ts) -> T | None:
        """The function's result, or None where it failed: one bad stage must not take the frame with it."""
        memo = self._memo
        start, before = time.perf_counter(), memo.spared if memo else 0.0
        try:
            return function(*args) if memo is None else memo.call(function, *args)
        except UserError as error:
            self.failures.append(Failure(stage, str(error)))
        except Exception as error:
            self.failures.append(Failure(stage, f"{type(error).__name__}: {error}"))
        finally:
            spared = memo.spared - before if memo else 0.0
            self.timings[stage] = self.timings.get(stage, 0.0) + time.perf_counter() - start + spared
            self.spared += spared
        return None


class Pipeline:
    """Every stage on one frame after another. Use as a context manager: it owns a thread for the network.

    Args:
        config: the whole configuration.
        detect: what finds the objects in a camera's image instead of the detector's model.
        memo: shared by pipelines that run on the same frames.
        draw: with the bird's-eye view and the explanations.

    Raises:
        UserError: the detector's model cannot be used.
    """

    def __init__(
        self,
        config: Config,
        detect: Callable[[Camera], Detections | None] | None = None,
        *,
        memo: Memo | None = None,
        draw: bool = True,
    ) -> None:
        self.config = config
        self.detector = Detector(config.detector) if config.detector.model and detect is None else None
        self._detect_with = detect
        self._memo, self._draw = memo, draw
        self._tracker = Tracker()
        self._anomalies = AnomalyDetector()
        self._network = ThreadPoolExecutor(1, "network")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        self._network.shutdown(cancel_futures=True)

    def run(self, frame: Frame) -> FrameResult:
        """Everything that can be made of the frame. Never raises for what the frame holds."""
        return self.finish(self.perceive(frame))

    def perceive(self, frame: Frame) -> FrameResult:
        """What the stages make of the frame; ``finish`` may follow in another thread, in the same order."""
        config, log = self.config, StageLog(self._memo)
        start = time.perf_counter()

        # The network releases the GIL: it runs beside the LiDAR stages.
        network = StageLog(self._memo)
        waiting = [self._network.submit(self._detect, camera, network) for camera in frame.cameras]

        voxels = ground = obstacles = clusters = None
        if len(frame.points) == 0:
            log.failures.append(Failure("cloud", "the cloud holds no finite point"))
        else:
            voxels = log.run("voxel", voxel_grid, frame.points, config.voxel)
        if voxels is not None:
            ground = log.run("ground", segment_ground, voxels.points, config.ground)
        if voxels is not None and ground is not None:
            obstacles = log.run("ground", _obstacles, voxels, ground)
        if obstacles is not None:
            clusters = log.run("clustering", cluster, obstacles, config.clustering)

        cameras = []
        for camera, future in zip(frame.cameras, waiting, strict=True):
            uv = depth = fusion = None
            if obstacles is not None:
                projected = log.run("projection", _project, obstacles, camera)
                uv, depth = projected or (None, None)
            detections = future.result()
            if uv is not None and depth is not None and clusters is not None and detections is not None:
                fusion = log.run("fusion", self._fuse, uv, depth, clusters, detections, camera)
            cameras.append(CameraResult(camera, detections, fusion, uv, depth))
        log.timings.update(network.timings)
        log.failures.extend(network.failures)

        objects = tracks = None
        if clusters is not None:
            objects = log.run("fusion", merge, clusters, cameras, config.clustering)
            if config.tracking.method != "none" and self._memo is None:  # variants see one frame each
                seen = in_view(cameras, len(clusters))
                tracks = log.run(
                    "tracking", self._tracker.update, frame, clusters, seen, objects, config.tracking
                )
        wall = time.perf_counter() - start + log.spared
        log.timings["total"] = max(wall, sum(network.timings.values()))
        return FrameResult(
            frame=frame,
            voxels=voxels,
            ground=ground,
            obstacles=obstacles,
            clusters=clusters,
            cameras=tuple(cameras),
            objects=objects,
            bev=None,
            timings=log.timings,
            failures=tuple(log.failures),
            tracks=tracks,
        )

    def finish(self, result: FrameResult) -> FrameResult:
        """The result with what makes it understood: the bird's-eye view, explanations, anomalies."""
        config, frame, log = self.config, result.frame, StageLog(self._memo)
        start = time.perf_counter()
        if self._draw:
            intensity, raw_ground = frame.fields.get("intensity"), None
            if result.voxels is not None and result.ground is not None:
                raw_ground = log.run("bev", of_points, result.ground.mask, result.voxels.inverse)
            objects, clusters = result.objects, result.clusters
            image = log.run("bev", bev, frame.points, intensity, raw_ground, objects, clusters, config.bev)
            explanations = log.run("explain", explain, result.cameras, result.clusters, config)
            wall = time.perf_counter() - start + log.spared
            result = replace(
                result,
                bev=image,
                explanations=explanations or (),
                timings={**result.timings, **log.timings, "total": result.timings["total"] + wall},
                failures=(*result.failures, *log.failures),
            )
        return replace(result, anomalies=self._anomalies.update(result, config.anomalies))

    def _detect(self, camera: Camera, log: StageLog) -> Detections | None:
        if self._detect_with is not None:
            return log.run("detector", self._detect_with, camera)
        if self.detector is None or camera.image is None:
            return None
        return log.run("detector", self.detector, camera.image.bgr)

    def _fuse(
        self, uv: F32, depth: F32, clusters: Clusters, detections: Detections, camera: Camera
    ) -> Fusion | None:
        if camera.intrinsics is None or camera.camera_from_points is None:
            return None
        return fuse(
            uv,
            depth,
            clusters,
            detections,
            camera.intrinsics,
            camera.camera_from_points,
            self.config.fusion,
        )


def _obstacles(voxels: Voxels, ground: Ground) -> F32:
    """The voxels that are not ground."""
    return voxels.points.compress(~ground.mask, axis=0)


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
