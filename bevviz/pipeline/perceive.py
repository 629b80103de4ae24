"""Run every stage on one frame with one configuration, without state or threads of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bevviz.config import Config, FusionConfig
from bevviz.config.plugins import TOPIC
from bevviz.model import geometry
from bevviz.model.decisions import explain
from bevviz.model.frame import F32, Camera, Frame
from bevviz.model.results import (
    CameraResult,
    Claims,
    Clusters,
    Detections,
    Failure,
    FrameResult,
    Fusion,
    Ground,
    Objects,
    Opinions,
    Splits,
    Voxels,
)
from bevviz.pipeline.stage_loader import Stages
from bevviz.pipeline.stage_log import Memo, StageLog
from bevviz.stages import robot_results, user_stages
from bevviz.stages.bev import bev
from bevviz.stages.clustering import cluster
from bevviz.stages.frustum_fusion import claim_clusters
from bevviz.stages.fusion import fuse, merge
from bevviz.stages.ground import no_ground, segment_ground
from bevviz.stages.opinions import opinions
from bevviz.stages.planar_boxes import whole_boxes
from bevviz.stages.user_stages import UserStage
from bevviz.stages.visibility import range_image
from bevviz.stages.voxel import spread_to_points, voxel_grid
from bevviz.support.compile_clock import common_clock, thread_clock

# Values for scans of one plane, whose points are in a row: a person has those of two legs.
PLANAR = {"voxel.size": 0.02, "clustering.min_points": 4, "clustering.min_cluster_points": 4}
LEAST_SCORE = 0.01  # of candidates that are decoded, so that configurations and runs can share them


class StageEdits(Protocol):
    """Changes of single stages' results, made before the next stage runs."""

    def ground(self, voxels: Voxels, ground: Ground) -> Ground:
        """Return the ground mask that the clustering sees."""

    def clusters(self, obstacles: F32, clusters: Clusters) -> Clusters:
        """Return the clusters that the fusion sees."""

    def detections(self, camera: Camera, detections: Detections) -> Detections:
        """Return the detections that the fusion sees."""

    def objects(self, obstacles: F32, cameras: Sequence[CameraResult], objects: Objects) -> Objects:
        """Return the objects that the frame reports."""


def perceive(
    frame: Frame,
    config: Config,
    stages: Stages,
    memo: Memo | None = None,
    *,
    network: Executor | None = None,
    edits: StageEdits | None = None,
    on_ground: Callable[[Frame, Voxels | None, Ground | None], object] | None = None,
) -> FrameResult:
    """Run the stages that need no other frame on one frame: everything but tracks and anomalies.

    The content of a frame never raises an error. A failed stage is listed in ``failures``, and the others go
    on.

    Args:
        frame: the frame.
        config: configuration. The result refers to it, or to the one that suits scans of one plane.
        stages: stages that the configuration names, from ``StageLoader.load``.
        memo: results shared by configurations that run on the same frame.
        network: executor of the detector. It runs beside the LiDAR stages, since it does not need Python's
            lock. None: it runs after them.
        edits: changes of single stages' results. None: the stages are left as they are.
        on_ground: called once the ground is known, while the detector works.
    """
    log, detector_log = StageLog(memo), StageLog(memo)
    start = common_clock()
    is_planar = frame.is_planar
    if is_planar:
        config = suited_to_planes(config)

    def detect(camera: Camera) -> Detections | None:
        detections = _detect(detector_log, frame, camera, config, stages)
        return detections if edits is None or detections is None else edits.detections(camera, detections)

    futures = [network.submit(detect, camera) for camera in frame.cameras] if network is not None else []

    voxels = ground = obstacles = clusters = None
    if not frame.lidar:
        pass
    elif len(frame.points) == 0:
        log.failures.append(Failure("cloud", "the cloud holds no finite point"))
    else:
        voxels = log.run("voxel", voxel_grid, frame.points, config.voxel)
    if voxels is not None:
        ground = _ground(log, frame, voxels, config, stages)
        if edits is not None and ground is not None:
            ground = edits.ground(voxels, ground)
    if on_ground is not None:
        on_ground(frame, voxels, ground)
    if voxels is not None and ground is not None:
        obstacles = log.run("ground", _obstacles, voxels, ground)
    if obstacles is not None:
        clusters = _clusters(log, frame, obstacles, config, stages)
        if edits is not None and clusters is not None:
            clusters = edits.clusters(obstacles, clusters)

    cameras = []
    for i, camera in enumerate(frame.cameras):
        uv = depth = None
        if obstacles is not None:
            projected = log.run("projection", _project, obstacles, camera)
            uv, depth = projected or (None, None)
        detections = futures[i].result() if network is not None else detect(camera)
        cameras.append(CameraResult(camera, detections, None, uv, depth))
    splits: Splits | None = None
    first_labels = None if clusters is None else clusters.labels
    claims: Sequence[Claims | None] = [None] * len(cameras)
    if obstacles is not None and clusters is not None and _splits(config) and not is_planar:
        height = None if ground is None else log.run("fusion", _obstacle_heights, ground)
        camera_results = tuple(cameras)
        sections = config.fusion, config.objects, config.clustering
        split_clusters = log.run(
            "fusion", claim_clusters, obstacles, height, clusters, camera_results, *sections
        )
        if split_clusters is not None:
            clusters, claims, splits = split_clusters
    for i, (result, camera_claims) in enumerate(zip(cameras, claims, strict=True)):
        uv, depth, detected = result.uv, result.depth, result.detections
        if uv is not None and depth is not None and clusters is not None and detected is not None:
            evidence = uv, depth, clusters, detected, result.camera, config.fusion, camera_claims
            fusion = log.run("fusion", _fuse, *evidence, is_planar)
            cameras[i] = replace(result, fusion=fusion)
    log.timings.update(detector_log.timings)
    log.failures.extend(detector_log.failures)

    objects = _objects(log, frame, obstacles, clusters, cameras, config, stages)
    if edits is not None and objects is not None and obstacles is not None:
        objects = edits.objects(obstacles, cameras, objects)
    result_opinions = ranges = None
    if objects is not None and config.objects.method != "frustum" and _detects(config, stages):
        ranges = log.run("opinions", range_image, frame.points)
        result_opinions = _opinions(log, objects, obstacles, clusters, cameras, ranges, config, stages)
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
        opinions=result_opinions,
        first_labels=first_labels,
        ranges=ranges,
    )


def add_explanations(result: FrameResult, *, seen: bool = True) -> FrameResult:
    """Add the bird's-eye view and the explanations to a result.

    Args:
        result: result of ``perceive``.
        seen: whether the bird's-eye view is needed.
    """
    config, frame, log = result.config, result.frame, StageLog()
    start = thread_clock()
    raw_ground = image = None
    if seen and result.voxels is not None and result.ground is not None:
        raw_ground = log.run("bev", spread_to_points, result.ground.mask, result.voxels.inverse)
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
        "explain",
        explain,
        result.cameras,
        result.clusters,
        config,
        result.splits,
        bool(frame.lidar),
        result.objects,
        result.opinions,
    )
    wall = thread_clock() - start
    return replace(
        result,
        bev=image,
        explanations=explanations or (),
        timings={**result.timings, **log.timings, "total": result.timings["total"] + wall},
        failures=(*result.failures, *log.failures),
    )


# --- stages by the configured method -----------------------------------------------------------


def _topic(method: str) -> str:
    """Return the robot's topic that replaces a stage, or an empty string."""
    return method.removeprefix(TOPIC) if method.startswith(TOPIC) else ""


def _call(
    log: StageLog, function: UserStage, array: NDArray[Any], frame: Frame, sensor: str | None = None
) -> Any:
    """Call a user's function, by default with the name of the LiDAR as its sensor."""
    return log.call(function, array, frame.stamp, frame.index, frame.lidar if sensor is None else sensor)


def _ground(log: StageLog, frame: Frame, voxels: Voxels, config: Config, stages: Stages) -> Ground | None:
    """Segment the ground by the configured method."""
    points = voxels.points
    if topic := _topic(config.ground.method):
        return log.run("ground", robot_results.segment, points, frame, topic, config.voxel.size)
    if (function := stages.ground) is not None:
        return log.guard(
            "ground",
            lambda: user_stages.ground_of(points, _call(log, function, points, frame), function.name),
        )
    if frame.is_planar:
        return log.run("ground", no_ground, len(points))
    return log.run("ground", segment_ground, points, config.ground)


def _obstacles(voxels: Voxels, ground: Ground) -> F32:
    """Return the voxels that are not ground."""
    return voxels.points.compress(~ground.mask, axis=0)


def _obstacle_heights(ground: Ground) -> F32:
    """Return the heights above the ground of the obstacle points."""
    return ground.height.compress(~ground.mask)


def _clusters(log: StageLog, frame: Frame, points: F32, config: Config, stages: Stages) -> Clusters | None:
    """Cluster the obstacle points by the configured method."""
    section = config.clustering
    if topic := _topic(section.method):
        return log.run("clustering", robot_results.cluster, points, frame, topic)
    if (function := stages.clustering) is not None:
        return log.guard(
            "clustering",
            lambda: user_stages.clusters_of(
                points, section, _call(log, function, points, frame), function.name
            ),
        )
    return log.run("clustering", cluster, points, section)


def _detect(log: StageLog, frame: Frame, camera: Camera, config: Config, stages: Stages) -> Detections | None:
    """Detect objects in a camera's image by the configured method."""
    section, image, network, detector = config.detector, camera.image, stages.network, stages.detector
    if (detect := stages.detect) is not None:
        return log.guard("detector", lambda: detect(camera))
    if topic := _topic(section.model):
        return log.guard("detector", lambda: robot_results.detect(frame, camera, topic))
    if image is None or network is None:
        return None
    if not image.bgr.size:
        return Detections.empty()
    if isinstance(network, UserStage):
        return log.guard(
            "detector",
            lambda: user_stages.detections_of(
                section.conf_threshold, _call(log, network, image.bgr, frame, camera.name), network.name
            ),
        )
    assert detector is not None
    least = min(section.explain_threshold, LEAST_SCORE)
    return log.guard("detector", lambda: detector.interpret(log.call(network.infer, image.bgr, least)))


def _project(points: F32, camera: Camera) -> tuple[F32, F32] | None:
    """Return pixels and depths of points, NaN outside the image. None if the camera's pose is unknown."""
    if camera.intrinsics is None or camera.camera_from_points is None:
        return None
    uv, depth = geometry.project(geometry.apply(camera.camera_from_points, points), camera.intrinsics)
    u, v = uv.T
    with np.errstate(invalid="ignore"):
        is_visible = (u >= -0.5) & (u < camera.intrinsics.width - 0.5)
        is_visible &= (v >= -0.5) & (v < camera.intrinsics.height - 0.5)
    np.copyto(uv, np.nan, where=~is_visible[:, None])
    return uv, depth


def suited_to_planes(config: Config) -> Config:
    """Return the configuration for scans of one plane: defaults that nobody stated are those of few points.

    A leg at 3 m has a dozen points in such a scan, in one row.
    """
    changes: dict[str, dict[str, float | int]] = {}
    for key, value in PLANAR.items():
        section, _, name = key.partition(".")
        present, default = getattr(config, section), getattr(Config(), section)
        if key not in config.stated and getattr(present, name) == getattr(default, name):
            changes.setdefault(section, {})[name] = value
    sections = {name: getattr(config, name).model_copy(update=values) for name, values in changes.items()}
    return config.model_copy(update=sections)


def _splits(config: Config) -> bool:
    """Return whether detections split clusters. The robot's clusters stay as it published them."""
    is_own_clustering = not _topic(config.clustering.method)
    return config.fusion.method == "frustum" and config.fusion.split and is_own_clustering


def _fuse(
    uv: F32,
    depth: F32,
    clusters: Clusters,
    detections: Detections,
    camera: Camera,
    config: FusionConfig,
    claims: Claims | None,
    is_planar: bool,
) -> Fusion | None:
    """Match detections and clusters of a camera. Return None if its pose is unknown."""
    if camera.intrinsics is None or camera.camera_from_points is None:
        return None
    pose = camera.camera_from_points
    return fuse(uv, depth, clusters, detections, camera.intrinsics, pose, config, claims, is_planar)


def _objects(
    log: StageLog,
    frame: Frame,
    obstacles: F32 | None,
    clusters: Clusters | None,
    cameras: list[CameraResult],
    config: Config,
    stages: Stages,
) -> Objects | None:
    """Make the 3D boxes by the configured method."""
    if topic := _topic(config.objects.method):
        return log.guard("objects", lambda: robot_results.find_objects(frame, topic, obstacles, clusters))
    if len(frame.points) == 0 and stages.objects is not None:
        return None
    if (function := stages.objects) is not None:
        cloud = log.call(user_stages.with_intensity, frame.points, frame.fields.get("intensity"))
        return log.guard(
            "objects",
            lambda: user_stages.objects_of(
                _call(log, function, cloud, frame), function.name, obstacles, clusters
            ),
        )
    if clusters is None:
        return None
    merged = log.run("fusion", merge, clusters, cameras, config.clustering)
    if merged is None or obstacles is None or not frame.is_planar:
        return merged
    return log.run("fusion", whole_boxes, merged, obstacles, clusters, config.objects.sizes)


def _detects(config: Config, stages: Stages) -> bool:
    """Return whether cameras have detections."""
    return stages.network is not None or stages.detect is not None or bool(_topic(config.detector.model))


def _opinions(
    log: StageLog,
    objects: Objects,
    obstacles: F32 | None,
    clusters: Clusters | None,
    cameras: list[CameraResult],
    ranges: F32 | None,
    config: Config,
    stages: Stages,
) -> Opinions | None:
    """Compare objects that our fusion did not make with the cameras and our fusion."""
    if ranges is None:
        return None
    fused = Objects.empty()
    if clusters is not None:
        merged = log.run("opinions", merge, clusters, cameras, config.clustering)
        if merged is None:
            return None
        fused = merged
    known = stages.class_names
    return log.guard(
        "opinions",
        lambda: opinions(objects, fused, obstacles, clusters, cameras, ranges, config.opinions, known),
    )
