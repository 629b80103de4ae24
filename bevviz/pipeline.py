"""The pipeline: runs the stages on a frame, times them, and turns a failure into a reason."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import ParamSpec, Self, TypeVar

import numpy as np

from bevviz import geometry
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
)
from bevviz.stages.bev import bev
from bevviz.stages.clustering import cluster
from bevviz.stages.detector import Detector
from bevviz.stages.fusion import fuse, merge
from bevviz.stages.ground import segment_ground
from bevviz.stages.voxel import voxel_grid

P = ParamSpec("P")
T = TypeVar("T")


class StageLog:
    """Runs stages; keeps how long each took and why it failed."""

    def __init__(self) -> None:
        self.timings: dict[str, float] = {}
        self.failures: list[Failure] = []

    def run(self, stage: str, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T | None:
        """The function's result, or None where it failed: one bad stage must not take the frame with it."""
        start = time.perf_counter()
        try:
            return function(*args, **kwargs)
        except UserError as error:
            self.failures.append(Failure(stage, str(error)))
        except Exception as error:
            self.failures.append(Failure(stage, f"{type(error).__name__}: {error}"))
        finally:
            self.timings[stage] = self.timings.get(stage, 0.0) + time.perf_counter() - start
        return None


class Pipeline:
    """Every stage on one frame after another. Use as a context manager: it owns a thread for the network.

    Args:
        config: the whole configuration.
        detect: what finds the objects in a camera's image instead of the detector's model.

    Raises:
        UserError: the detector's model cannot be used.
    """

    def __init__(self, config: Config, detect: Callable[[Camera], Detections | None] | None = None) -> None:
        self.config = config
        self.detector = Detector(config.detector) if config.detector.model and detect is None else None
        self._detect_with = detect
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
        config, log = self.config, StageLog()
        start = time.perf_counter()

        # The network releases the GIL: it runs beside the LiDAR stages.
        network = StageLog()
        waiting = [self._network.submit(self._detect, camera, network) for camera in frame.cameras]

        voxels = ground = obstacles = clusters = raw_ground = None
        if len(frame.points) == 0:
            log.failures.append(Failure("cloud", "the cloud holds no finite point"))
        else:
            voxels = log.run("voxel", voxel_grid, frame.points, config.voxel)
        if voxels is not None:
            ground = log.run("ground", segment_ground, voxels.points, config.ground)
        if voxels is not None and ground is not None:
            obstacles = voxels.points.compress(~ground.mask, axis=0)
            raw_ground = ground.mask.take(voxels.inverse)
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

        objects = None
        if clusters is not None:
            objects = log.run("fusion", merge, clusters, cameras, config.clustering)
        intensity = frame.fields.get("intensity")
        image = log.run("bev", bev, frame.points, intensity, raw_ground, objects, clusters, config.bev)
        explanations = log.run("explain", explain, cameras, clusters, config)
        log.timings["total"] = time.perf_counter() - start
        return FrameResult(
            frame=frame,
            voxels=voxels,
            ground=ground,
            obstacles=obstacles,
            clusters=clusters,
            cameras=tuple(cameras),
            objects=objects,
            bev=image,
            explanations=explanations or (),
            timings=log.timings,
            failures=tuple(log.failures),
        )

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
