"""Logs a FrameResult: what each entity looks like in Rerun."""

from __future__ import annotations

import platform
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.metadata import version
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
import rerun as rr

from bevviz import __version__, geometry
from bevviz.anomalies import KINDS, News, label
from bevviz.colors import bins, class_color, palette, turbo
from bevviz.config import Config, dump
from bevviz.frame import (
    F32,
    F64,
    U8,
    Bev,
    CameraResult,
    Clusters,
    ClusterState,
    Decision,
    Detections,
    DetectionState,
    Frame,
    FrameResult,
    Image,
    Intrinsics,
    LabelledBoxes2D,
    LabelledBoxes3D,
    Objects,
    Scene,
    Tracks,
)
from bevviz.logging import entities, tracks
from bevviz.logging.entities import ClassId
from bevviz.logging.pieces import CORNER, blob, boxes3d, rounded, transform
from bevviz.logging.text import markdown, remarks
from bevviz.logging.writer import Writer
from bevviz.stages.voxel import of_points

_OUTLINE = rr.components.FillMode.MajorWireframe
_TRUTH_COLOR = (215, 215, 215)
_ROBOT_COLOR = (255, 210, 0)
_FAINT = (150, 150, 160, 110)
_UNMATCHED = (80, 80, 92)
_UNMATCHED_DEPTH = 20.0  # metres that the frustum of a detection without a match is drawn to

_STATES = {
    "ok": (70, 160, 90),
    "matched": (70, 160, 90),
    "degraded": (220, 160, 50),
    "failed": (210, 70, 70),
    "no cluster": (210, 70, 70),
    "too few points": (220, 160, 50),
    "low overlap": (220, 160, 50),
    "taken": (150, 120, 220),
    "too far": (110, 130, 160),
    "not fused": (110, 110, 120),
}


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
        wait: as of ``Writer``.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        config: Config,
        scene: Scene,
        root: str = "",
        wait: float = 0.0,
    ) -> None:
        super().__init__(recording, root, wait)
        self._config = config
        self._scene = scene
        self._track_lanes = tracks.Lanes()
        self._news = News()
        self._intrinsics: dict[str, Intrinsics] = {}
        self._image_stamps: dict[str, int] = {}
        self._lanes: dict[str, str] = {}  # state lane -> its latest state
        self._last: Frame | None = None

    @property
    def context(self) -> Context:
        """What the frame that was logged last relies on."""
        last = self._last
        clock = (0, 0, 0) if last is None else (last.index, last.stamp, last.received)
        return Context(self._config, self._scene, clock, self._intrinsics, self._lanes)

    # --- once ----------------------------------------------------------------------------------

    def log_static(self) -> None:
        """How the recording was made, the axes, the classes and the looks: what no frame changes."""
        self._log_origin()
        self._static(entities.WORLD, rr.ViewCoordinates.FLU, _annotations())
        for lidar in dict.fromkeys((self._scene.lidar, *self._scene.lidars)):
            self._static(entities.points(lidar), rr.Points3D.from_fields(radii=rr.Radius.ui_points(1.0)))
            for path in (entities.ground(lidar), entities.obstacles(lidar)):
                self._static(path, rr.Points3D.from_fields(radii=rr.Radius.ui_points(1.5)))
            self._static(
                entities.clusters(lidar),
                rr.Points3D.from_fields(radii=rr.Radius.ui_points(2.0), show_labels=False),
                rr.Boxes3D.from_fields(radii=rr.Radius.ui_points(1.0), fill_mode=_OUTLINE),
            )
            self._static(entities.set_aside(lidar), rr.Boxes3D.from_fields(show_labels=False))
        for camera in self._scene.cameras:
            self._static(
                entities.projected(camera),
                depth_annotations(),
                rr.Points2D.from_fields(radii=rr.Radius.ui_points(1.5), show_labels=False, draw_order=10.0),
            )
            self._static(entities.detections(camera), rr.Boxes2D.from_fields(draw_order=30.0))
            if self._root:  # over the one image
                for path in (entities.projected(camera), entities.detections(camera), entities.weak(camera)):
                    self._static(path, rr.CoordinateFrame(f"tf#{entities.image(camera)}"))
            self._static(
                entities.weak(camera),
                rr.Boxes2D.from_fields(
                    colors=[_FAINT], radii=rr.Radius.ui_points(0.5), show_labels=False, draw_order=20.0
                ),
            )
        self._static(entities.FUSED, rr.Boxes3D.from_fields(radii=rr.Radius.ui_points(2.0), show_labels=True))
        self._static(
            entities.TRACKS,
            rr.Boxes3D.from_fields(radii=rr.Radius.ui_points(0.75), show_labels=False, fill_mode=_OUTLINE),
        )
        self._static(
            entities.UNSEEN,
            rr.Boxes3D.from_fields(radii=rr.Radius.ui_points(0.75), show_labels=True, fill_mode=_OUTLINE),
        )
        self._static(entities.TRAILS, rr.LineStrips3D.from_fields(radii=rr.Radius.ui_points(1.5)))
        self._static(entities.TRACK_SPEEDS, rr.SeriesLines(names=[f"{n:02}" for n in range(tracks.LANES)]))
        self._static(entities.ANOMALY_COUNTS, rr.SeriesLines(names=list(KINDS)))
        for name, radius in (("tracks", 1.0), ("trails", 1.5)):
            self._static(
                entities.overlay(name),
                _annotations(),
                rr.LineStrips2D.from_fields(radii=rr.Radius.ui_points(radius), draw_order=20.0),
            )
        self._static(
            entities.TRUTH,
            rr.Boxes3D.from_fields(
                colors=[_TRUTH_COLOR],
                radii=rr.Radius.ui_points(0.5),
                show_labels=False,
                fill_mode=_OUTLINE,
            ),
        )

    def log_context(self, context: Context) -> None:
        """Static data, calibration and states of a frame, for a recording that starts with it."""
        self.log_static()
        for name, intrinsics in context.intrinsics.items():
            self._log_intrinsics(name, intrinsics)
        if context.lanes:
            self._set_time(*context.clock)
            self._change_states(context.lanes)

    def reconfigure(self, config: Config, scene: Scene) -> None:
        """From here on the results are made in another way, or of other sensors."""
        same, self._config, self._scene = scene == self._scene, config, scene
        if same:  # the viewer loses class colours that are logged twice
            self._log_origin()
        else:
            self.log_static()

    def refresh(self) -> None:
        """Make the next frame whole without those before: what it lacks is cleared, images come again."""
        self._shown = set(self._known)
        self._image_stamps.clear()

    def _log_origin(self) -> None:
        config, made_with = dump(self._config), versions()
        self._static(
            entities.CONFIG,
            rr.TextDocument(
                "# How this recording was made\n\n"
                + f"Source: **{self._scene.name}**, preset: **{self._config.preset}**\n\n"
                + f"```yaml\n{config}```\n\n"
                + "\n".join(f"- {line}" for line in made_with),
                media_type=rr.MediaType.MARKDOWN,
            ),
        )
        if not self._root:
            self._recording.send_recording_name(self._scene.name)
        self._recording.send_property(
            entities.PROPERTY + self._root.replace("/", "_"),
            rr.AnyValues(
                source=self._scene.name,
                preset=self._config.preset,
                config=config,
                versions=made_with,
                lidars=list(self._scene.lidars or (self._scene.lidar,)),
                cameras=list(self._scene.cameras) or None,
            ),
        )

    # --- each frame ----------------------------------------------------------------------------

    def log(
        self,
        result: FrameResult,
        health: Mapping[str, float] = MappingProxyType({}),
        notes: Sequence[tuple[str, str]] = (),
    ) -> None:
        """Everything of one frame. What the frame before had and this one has not is cleared.

        Args:
            result: the frame and what was made of it.
            health: further scalars, by entity.
            notes: further lines of the log: level and text.
        """
        frame = result.frame
        self._begin(frame.index, frame.stamp, frame.received)
        self._log_cloud(result)
        if result.obstacles is not None:
            obstacles = self._rounded(result.obstacles)
            self._put_points(entities.obstacles(frame.lidar), obstacles, ClassId.OBSTACLE)
            if result.clusters is not None:
                self._log_clusters(frame, result.clusters, result.tracks, obstacles)
        for camera in result.cameras:
            self._log_camera(frame, camera)
        if result.objects is not None and len(result.objects):
            self._log_objects(result, result.objects)
        if result.tracks is not None:
            self._log_tracks(frame, result.tracks)
        self._log_frustums(frame, result.cameras)
        if result.bev is not None:
            self._log_bev(result, result.bev)
        if not self._root:
            self._log_others(frame)
        self._log_decisions(result, notes)
        self._log_anomalies(result)
        self._log_states(result)
        self._log_health(result, health)
        self._end()
        self._last = frame

    def _log_cloud(self, result: FrameResult) -> None:
        frame = result.frame
        world_from_points = frame.pose
        self._put(entities.sensor(frame.lidar), transform(world_from_points))
        if self._config.logging.raw_cloud and not self._root:
            class_ids = np.zeros(len(frame.points), np.uint16)
            if result.voxels is not None and result.ground is not None:
                of_voxels = np.where(result.ground.mask, ClassId.GROUND, ClassId.OBSTACLE).astype(np.uint16)
                class_ids = of_points(of_voxels, result.voxels.inverse)
            if len(frame.clouds) > 1:
                self._log_merged(frame, world_from_points, class_ids)
            elif len(frame.points):
                self._put(entities.points(frame.lidar), rr.Points3D(frame.points, class_ids=class_ids))
        if result.voxels is not None and result.ground is not None:
            road = self._rounded(result.voxels.points.compress(result.ground.mask, axis=0))
            self._put_points(entities.ground(frame.lidar), road, ClassId.GROUND)

    def _log_merged(self, frame: Frame, world_from_points: F64, class_ids: np.ndarray[Any, Any]) -> None:
        """Several LiDARs: each raw cloud in the frame of its own sensor."""
        end = 0
        for cloud, points_from_cloud in zip(frame.clouds, frame.points_from_clouds, strict=True):
            start, end = end, end + len(cloud.xyz)
            self._put(entities.sensor(cloud.name), transform(world_from_points @ points_from_cloud))
            if len(cloud.xyz):
                self._put(entities.points(cloud.name), rr.Points3D(cloud.xyz, class_ids=class_ids[start:end]))

    def _rounded(self, points: F32) -> F32:
        """Voxelised points to a fraction of a voxel, which compresses to half. The raw cloud stays exact."""
        if self._config.voxel.size == 0:
            return points
        return rounded(points, 2.0 ** np.floor(np.log2(8 / self._config.voxel.size)))

    def _put_points(self, path: str, points: F32, class_id: int) -> None:
        if len(points):
            self._put(path, rr.Points3D(points, class_ids=class_id))

    def _log_clusters(self, frame: Frame, clusters: Clusters, tracked: Tracks | None, obstacles: F32) -> None:
        boxes = clusters.obb if self._config.clustering.boxes == "oriented" else clusters.aabb
        colors = tracks.class_ids(tracks.of_clusters(tracked, len(clusters)))
        kept = np.flatnonzero(clusters.state == ClusterState.KEPT)
        member = np.append(clusters.state == ClusterState.KEPT, False).take(clusters.labels)  # -1 is noise
        if len(kept):
            self._put(
                entities.clusters(frame.lidar),
                rr.Points3D(
                    obstacles.compress(member, axis=0),
                    class_ids=colors.take(clusters.labels.compress(member)),
                ),
                boxes3d(boxes, kept, [f"{k}" for k in kept], class_ids=colors[kept]),
            )
        aside = np.flatnonzero(clusters.state != ClusterState.KEPT)
        if len(aside):
            states = [ClusterState(s) for s in clusters.state[aside].tolist()]
            self._put(
                entities.set_aside(frame.lidar),
                boxes3d(
                    boxes,
                    aside,
                    [f"{k}: {n} points" for k, n in zip(aside, clusters.count[aside], strict=True)],
                    class_ids=[entities.CLUSTER_CLASS[s] for s in states],
                ),
            )

    # --- cameras -------------------------------------------------------------------------------

    def _log_camera(self, frame: Frame, result: CameraResult) -> None:
        camera = result.camera
        if not self._root:
            world_from_camera = _camera_pose(frame, result)
            if world_from_camera is not None:
                self._put(entities.sensor(camera.name), transform(world_from_camera))
            if camera.intrinsics is not None:
                self._log_intrinsics(camera.name, camera.intrinsics)
            if camera.image is not None:
                self._log_image(camera.name, camera.image)
        if result.detections is not None:
            self._log_detections(camera.name, result.detections)
        if self._config.logging.projected_points and result.uv is not None and result.depth is not None:
            seen = np.isfinite(result.uv[:, 0])
            if seen.any():
                depth = bins(result.depth[seen], 0, entities.DEPTH_RANGE, entities.DEPTH_BINS)
                self._put(
                    entities.projected(camera.name), rr.Points2D(result.uv[seen] + CORNER, class_ids=depth)
                )

    def _log_intrinsics(self, name: str, intrinsics: Intrinsics) -> None:
        """Static, so that a viewer that joins late has it; logged again where the calibration changes."""
        if self._intrinsics.get(name) is intrinsics:
            return
        last = self._intrinsics.get(name)
        self._intrinsics = {**self._intrinsics, name: intrinsics}  # a context may hold the one before
        size = [intrinsics.width, intrinsics.height]
        if last is None or [last.width, last.height] != size or not np.array_equal(last.K, intrinsics.K):
            self._static(
                entities.sensor(name),
                rr.Pinhole(
                    image_from_camera=intrinsics.K + np.array([[0, 0, CORNER], [0, 0, CORNER], [0, 0, 0]]),
                    resolution=size,
                    camera_xyz=rr.ViewCoordinates.RDF,
                    image_plane_distance=1.5,
                ),
            )

    def _log_image(self, name: str, image: Image) -> None:
        path = entities.image(name)
        self._now.add(path)
        if self._image_stamps.get(name) == image.stamp and path in self._shown:
            return  # the camera is slower than the LiDAR: the image is already there
        self._image_stamps[name] = image.stamp
        self._put(path, encode_image(image, self._config.logging.jpeg_quality))

    def _log_detections(self, name: str, detections: Detections) -> None:
        for path, rows in (
            (entities.detections(name), np.flatnonzero(detections.state == DetectionState.KEPT)),
            (entities.weak(name), np.flatnonzero(detections.state != DetectionState.KEPT)),
        ):
            if len(rows) == 0:
                continue
            names = [detections.names[d] for d in rows]
            self._put(
                path,
                rr.Boxes2D(
                    array=detections.xyxy[rows] + CORNER,
                    array_format=rr.Box2DFormat.XYXY,
                    labels=[f"{n} {s:.2f}" for n, s in zip(names, detections.score[rows], strict=True)],
                    colors=[class_color(n) for n in names] if path == entities.detections(name) else None,
                    class_ids=[entities.DETECTION_CLASS[DetectionState(s)] for s in detections.state[rows]],
                ),
            )

    # --- fusion --------------------------------------------------------------------------------

    def _log_objects(self, result: FrameResult, objects: Objects) -> None:
        reasons = {(e.camera, e.row): e.text for e in result.explanations if e.subject == "detection"}
        labels = [f"{n} {s:.2f}" for n, s in zip(objects.names, objects.score, strict=True)]
        ids, speeds = np.full(len(objects), -1), np.full(len(objects), np.nan, np.float32)
        for j, row in enumerate(tracks.of_objects(result.tracks, len(objects))):
            if row is not None and result.tracks is not None:
                labels[j] = tracks.label(result.tracks, row)
                ids[j], speeds[j] = result.tracks.id[row], result.tracks.speed[row]
        self._put(
            entities.FUSED,
            transform(result.frame.pose),
            boxes3d(
                objects.boxes,
                np.arange(len(objects)),
                labels,
                colors=[class_color(n) for n in objects.names],
            ),
            rr.AnyValues(
                class_name=list(objects.names),
                score=objects.score,
                track=ids,
                speed=speeds,
                cluster=objects.cluster,
                camera=list(objects.camera),
                reason=[
                    reasons.get((c, d), "") for c, d in zip(objects.camera, objects.detection, strict=True)
                ],
            ),
        )

    def _log_tracks(self, frame: Frame, tracked: Tracks) -> None:
        """In the fixed frame, and seen from above over the bird's-eye image."""
        rows = tracks.shown(tracked)
        named = tracked.object[rows] >= 0
        for path, chosen, text in (
            (entities.TRACKS, rows[named], tracks.label),
            (entities.UNSEEN, rows[~named], tracks.unseen),
        ):
            if len(chosen):
                labels = [text(tracked, row) for row in chosen.tolist()]
                colors = tracks.class_ids(tracked.id[chosen])
                self._put(path, boxes3d(tracked.boxes, chosen, labels, class_ids=colors))
        if len(rows) == 0:
            return
        trails, colors = tracks.trails(tracked, rows), tracks.class_ids(tracked.id[rows])
        self._put(entities.TRAILS, rr.LineStrips3D(trails, class_ids=colors))
        points_from_world = geometry.inverse(frame.pose)
        self._put(
            entities.overlay("trails"),
            rr.LineStrips2D([self._seen_from_above(points_from_world, t) for t in trails], class_ids=colors),
        )
        outlines = geometry.corners(tracked.boxes)[rows][:, [0, 1, 2, 3, 0]]
        self._put(
            entities.overlay("tracks"),
            rr.LineStrips2D(
                self._seen_from_above(points_from_world, outlines.reshape(-1, 3)).reshape(-1, 5, 2),
                class_ids=colors,
                labels=[f"#{tracked.id[row]} {tracked.speed[row]:.1f} m/s" for row in rows],
                show_labels=True,
            ),
        )

    def _log_frustums(self, frame: Frame, cameras: Sequence[CameraResult]) -> None:
        strips: list[F32] = []
        colors: list[tuple[int, ...]] = []
        labels: list[str] = []
        for camera in cameras:
            pose, intrinsics = _camera_pose(frame, camera), camera.camera.intrinsics
            found, fusion = camera.detections, camera.fusion
            if pose is None or intrinsics is None or found is None or fusion is None:
                continue
            rows = np.flatnonzero(found.state == DetectionState.KEPT)
            if len(rows) == 0:
                continue
            far = np.full(len(found), _UNMATCHED_DEPTH, np.float32)
            matched = fusion.detection_decision == Decision.MATCHED
            pairs = fusion.pairs
            chosen = matched[pairs.detection] & (fusion.detection_cluster[pairs.detection] == pairs.cluster)
            far[pairs.detection[chosen]] = pairs.depth[chosen]
            near = np.full(len(rows), 0.3, np.float32)
            corners = geometry.frustum(found.xyxy[rows], intrinsics, near, far[rows])
            corners = geometry.apply(pose, corners.reshape(-1, 3)).reshape(-1, 8, 3)
            for d, eight in zip(rows.tolist(), corners, strict=True):
                strips.append(eight[_FRUSTUM_PATH])
                colors.append(class_color(found.names[d]) if matched[d] else _UNMATCHED)
                labels.append(f"{found.names[d]} {found.score[d]:.2f}")
        if strips:
            self._put(
                entities.FRUSTUMS,
                rr.LineStrips3D(
                    strips, colors=colors, labels=labels, radii=rr.Radius.ui_points(1.0), show_labels=False
                ),
            )

    # --- bird's-eye view -----------------------------------------------------------------------

    def _log_bev(self, result: FrameResult, bev: Bev) -> None:
        if self._config.bev.style == "reference":
            self._put(entities.BEV, _png(bev.image))  # pixel for pixel
        else:
            self._put(entities.BEV, _jpeg(bev.image, self._config.logging.jpeg_quality))
        for name, grid in bev.channels.items():
            if name == "occupancy":
                self._log_grid(result, bev)
            else:
                self._put(entities.channel(name), rr.Image(grid, color_model="L"))

    def _log_grid(self, result: FrameResult, bev: Bev) -> None:
        """The occupancy laid on the ground. The pose of a grid map is that of its lower left corner."""
        grid = bev.channels["occupancy"]
        level = 0.0
        if result.ground is not None and result.voxels is not None:
            heights = result.voxels.points[::32, 2].compress(result.ground.mask[::32])
            level = float(np.median(heights)) if len(heights) else 0.0
        self._put(
            entities.GRID,
            transform(result.frame.pose),
            _grid_looks(*grid.shape, bev.resolution),
            rr.GridMap.from_fields(
                data=blob(grid.view(np.uint8).ravel()), translation=[-bev.range_x, bev.range_y, level - 0.05]
            ),
        )

    # --- what others state ---------------------------------------------------------------------

    def _log_others(self, frame: Frame) -> None:
        world_from_points = frame.pose
        if frame.truth is not None and len(frame.truth.boxes):
            self._log_stated(entities.TRUTH, frame.truth, None)
            self._log_outlines("ground_truth", frame.truth, world_from_points, _TRUTH_COLOR)
        for stated in frame.robot_boxes:
            if len(stated.boxes):
                self._log_stated(entities.robot(stated.topic), stated, _ROBOT_COLOR)
                self._log_outlines(stated.topic.strip("/"), stated, world_from_points, _ROBOT_COLOR)
        for found in frame.robot_detections:
            if len(found.xyxy):
                self._log_stated_2d(found)

    def _log_stated(self, path: str, stated: LabelledBoxes3D, color: tuple[int, int, int] | None) -> None:
        pose = np.eye(4) if stated.world_from_boxes is None else stated.world_from_boxes
        self._put(
            path,
            transform(pose),
            boxes3d(
                stated.boxes,
                np.arange(len(stated.boxes)),
                [f"{n} {s:.2f}" for n, s in zip(stated.labels, stated.scores, strict=True)],
                colors=None if color is None else [color],
            ),
        )

    def _log_stated_2d(self, found: LabelledBoxes2D) -> None:
        """Under /robot, but in the space of the camera's image, so that it can be shown over it."""
        frame = rr.CoordinateFrame(f"tf#{entities.image(found.camera)}") if found.camera else None
        self._put(
            entities.robot(found.topic),
            *([frame] if frame else []),
            rr.Boxes2D(
                array=found.xyxy + CORNER,
                array_format=rr.Box2DFormat.XYXY,
                labels=[f"{n} {s:.2f}" for n, s in zip(found.labels, found.scores, strict=True)],
                colors=[_ROBOT_COLOR],
                draw_order=25.0,
            ),
        )

    def _log_outlines(
        self, what: str, stated: LabelledBoxes3D, world_from_points: F64, color: tuple[int, int, int]
    ) -> None:
        """Boxes seen from above, over the bird's-eye image; only those whose centre is in it."""
        pose = np.eye(4) if stated.world_from_boxes is None else stated.world_from_boxes
        points_from_boxes = geometry.inverse(world_from_points) @ pose
        config = self._config.bev
        reach = np.array([config.range_x, config.range_y], np.float32)
        inside = (np.abs(geometry.apply(points_from_boxes, stated.boxes.center)[:, :2]) < reach).all(axis=1)
        if not inside.any():
            return
        corners = geometry.corners(stated.boxes)[inside][:, [0, 1, 2, 3, 0]]
        self._put(
            entities.overlay(what),
            rr.LineStrips2D(
                self._seen_from_above(points_from_boxes, corners.reshape(-1, 3)).reshape(-1, 5, 2),
                colors=[color],
                radii=rr.Radius.ui_points(0.75),
                labels=[stated.labels[k] for k in np.flatnonzero(inside)],
                show_labels=False,
                draw_order=10.0,
            ),
        )

    def _seen_from_above(self, points_from_those: F64, those: F32) -> F32:
        """(N, 2) pixels of the bird's-eye image."""
        config = self._config.bev
        reach = np.array([config.range_x, config.range_y], np.float32)
        xy = geometry.apply(points_from_those, those)[:, :2]
        return np.asarray(((reach - xy) / np.float32(config.resolution))[:, ::-1], np.float32)

    # --- decisions -----------------------------------------------------------------------------

    def _log_decisions(self, result: FrameResult, notes: Sequence[tuple[str, str]]) -> None:
        self._put(entities.EXPLAIN, rr.TextDocument(markdown(result), media_type=rr.MediaType.MARKDOWN))
        self._log_lines(entities.EXPLAIN_LOG, [*notes, *remarks(result)])

    def _log_anomalies(self, result: FrameResult) -> None:
        news = self._news.of(result.anomalies)
        self._log_lines(entities.ANOMALY_LOG, [(a.severity, f"{a.kind}: {a.text}") for a in news])
        count = Counter(anomaly.kind for anomaly in result.anomalies)
        self._log(entities.ANOMALY_COUNTS, rr.Scalars([float(count[kind]) for kind in KINDS]))

    def _log_lines(self, path: str, lines: Sequence[tuple[str, str]]) -> None:
        """Level and text of each line."""
        if lines:
            levels, texts = zip(*lines, strict=True)
            self._columns(path, [self._clock] * len(lines), rr.TextLog.columns(text=texts, level=levels))

    def _log_states(self, result: FrameResult) -> None:
        """Lanes: the pipeline, each camera, each class that it has seen; anomalies by kind; tracks."""
        lanes = dict.fromkeys(self._lanes, "")
        degraded = result.frame.problems or any(c.camera.problems for c in result.cameras)
        lanes[entities.state("pipeline")] = "failed" if result.failures else "degraded" if degraded else "ok"
        for camera in result.cameras:
            name = camera.camera.name
            failed = camera.detections is None
            lanes[entities.state(name)] = (
                "degraded"
                if camera.camera.problems
                else "not fused"
                if failed or camera.fusion is None
                else "ok"
            )
            for class_name, decision in _best_decisions(camera):
                lanes[entities.state(name, class_name.replace(" ", "_"))] = decision
        for kind in KINDS:
            subjects = [anomaly.subject for anomaly in result.anomalies if anomaly.kind == kind]
            more = f" +{len(subjects) - 1}" if subjects[1:] else ""
            lanes[entities.anomaly_state(kind)] = f"{subjects[0]}{more}" if subjects else ""
        lanes |= self._log_track_lanes(result.tracks)
        self._change_states(lanes)

    def _log_track_lanes(self, tracked: Tracks | None) -> Mapping[str, str]:
        """Speeds; the states of the lanes."""
        rows = self._track_lanes.update(tracked)
        if tracked is None:
            return {}
        speeds = np.full(tracks.LANES, np.nan)
        speeds[list(rows)] = tracked.speed[list(rows.values())]
        self._log(entities.TRACK_SPEEDS, rr.Scalars(speeds))
        return {entities.track_state(lane): label(tracked, row) for lane, row in rows.items()}

    def _change_states(self, lanes: Mapping[str, str]) -> None:
        for lane, value in lanes.items():
            if lane not in self._lanes:
                self._static(lane, rr.StateConfiguration(values=list(_STATES), colors=list(_STATES.values())))
            if self._lanes.get(lane) != value:
                self._log(lane, rr.StateChange(state=value))
        self._lanes = dict(lanes)

    # --- health --------------------------------------------------------------------------------

    def _log_health(self, result: FrameResult, more: Mapping[str, float]) -> None:
        for path, value in (*health(result, self._last), *more.items()):
            if np.isfinite(value):
                self._scalar(path, float(value))


def versions() -> list[str]:
    """Name and version of all that results depend on."""
    packages = ("rerun-sdk", "numpy", "open3d", "onnxruntime", "opencv-python-headless", "rosbags")
    found = {"bevviz": __version__, "python": platform.python_version()}
    found |= {name: version(name) for name in packages}
    return [f"{name} {number}" for name, number in found.items()]


# --- pieces ------------------------------------------------------------------------------------

_FRUSTUM_PATH = [0, 1, 2, 3, 0, 4, 5, 1, 5, 6, 2, 6, 7, 3, 7, 4]  # every edge in one stroke


def _annotations() -> rr.AnnotationContext:
    classes: list[tuple[int, str, tuple[int, ...]]] = [
        (ClassId.UNCLASSIFIED, "", (130, 130, 140)),
        (ClassId.GROUND, "ground", (92, 84, 76)),
        (ClassId.OBSTACLE, "obstacle", (170, 175, 190)),
        (entities.DETECTION_CLASS[DetectionState.KEPT], "kept", (255, 255, 255)),
        (entities.DETECTION_CLASS[DetectionState.BELOW_THRESHOLD], "below threshold", _FAINT),
        (entities.DETECTION_CLASS[DetectionState.SUPPRESSED], "suppressed", _FAINT),
        (entities.CLUSTER_CLASS[ClusterState.TOO_SMALL], "too small", (120, 120, 130)),
        (entities.CLUSTER_CLASS[ClusterState.TOO_LARGE], "too large", (140, 100, 100)),
    ]
    colors = palette(entities.TRACK_COLORS).tolist()
    return rr.AnnotationContext(
        [
            *(rr.AnnotationInfo(id=i, label=label or None, color=color) for i, label, color in classes),
            *(rr.AnnotationInfo(id=ClassId.TRACK + i, color=color) for i, color in enumerate(colors)),
        ]
    )


def depth_annotations() -> rr.AnnotationContext:
    """Colours of the depth bins: near is red, far is blue."""
    width = entities.DEPTH_RANGE / entities.DEPTH_BINS
    near_is_red = turbo(entities.DEPTH_BINS)[::-1].tolist()
    return rr.AnnotationContext(
        [
            rr.AnnotationInfo(id=i, label=f"{i * width:.1f} m", color=color)
            for i, color in enumerate(near_is_red)
        ]
    )


@lru_cache(maxsize=2)
def _grid_looks(rows: int, columns: int, resolution: float) -> rr.GridMap:
    return rr.GridMap.from_fields(
        format=rr.components.ImageFormat(width=columns, height=rows, color_model="L", channel_datatype="U8"),
        cell_size=resolution,
        rotation_axis_angle=rr.RotationAxisAngle([0, 0, 1], radians=-np.pi / 2),
        opacity=0.2,
        colormap=rr.components.Colormap.RvizMap,
    )


def _camera_pose(frame: Frame, result: CameraResult) -> F64 | None:
    camera = result.camera
    if camera.world_from_camera is not None:
        return camera.world_from_camera
    if camera.camera_from_points is not None:
        return frame.pose @ geometry.inverse(camera.camera_from_points)
    return None


def encode_image(image: Image, quality: int) -> rr.EncodedImage:
    """As it came where it came encoded, else as JPEG of that quality."""
    if image.encoded is not None:
        return rr.EncodedImage(contents=image.encoded, media_type=image.media_type or None)
    return _jpeg(image.bgr, quality)


def _jpeg(bgr: U8, quality: int) -> rr.EncodedImage:
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return rr.EncodedImage(contents=blob(data), media_type="image/jpeg")


def _png(bgr: U8) -> rr.EncodedImage:
    _, data = cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return rr.EncodedImage(contents=blob(data), media_type="image/png")


def _best_decisions(camera: CameraResult) -> Iterator[tuple[str, str]]:
    """For each class, what became of its best kept detection."""
    if camera.detections is None or camera.fusion is None:
        return
    found, seen = camera.detections, set()
    for d in np.flatnonzero(found.state == DetectionState.KEPT).tolist():
        if found.names[d] not in seen:
            seen.add(found.names[d])
            decision = Decision(int(camera.fusion.detection_decision[d]))
            yield found.names[d], decision.name.lower().replace("_", " ")


def health(result: FrameResult, last: Frame | None) -> Iterator[tuple[str, float]]:
    """Entity and value of every scalar of a frame; ``last`` is the frame before it. NaN: not known."""
    frame = result.frame
    for stage, seconds in result.timings.items():
        yield entities.stage_time(stage), seconds * 1e3
    if result.timings.get("total"):
        yield entities.rate("pipeline"), 1 / result.timings["total"]
    if last is not None:
        if frame.stamp > last.stamp:
            yield entities.rate("sensor"), 1e9 / (frame.stamp - last.stamp)
        if frame.received > last.received > 0:
            yield entities.rate("received"), 1e9 / (frame.received - last.received)
    for what, number in counts_of(result, last).items():
        yield entities.count(what), number
    yield entities.tf_age(frame.lidar), frame.tf_age * 1e3
    for camera in result.cameras:
        yield entities.sync_error(camera.camera.name), camera.camera.sync_error * 1e3
        yield entities.tf_age(camera.camera.name), camera.camera.tf_age * 1e3


def counts_of(result: FrameResult, last: Frame | None = None) -> Mapping[str, int]:
    """How much of everything there is in a frame; ``last`` is the frame before it."""
    frame = result.frame
    counts: Counter[str] = Counter(
        points=len(frame.points),
        invalid_points=sum(cloud.dropped for cloud in frame.clouds),
        problems=len(frame.problems) + sum(len(c.camera.problems) for c in result.cameras),
        failures=len(result.failures),
        skipped_frames=max(0, frame.index - last.index - 1) if last is not None else 0,
    )
    if result.voxels is not None:
        counts["voxels"] = len(result.voxels.points)
    if result.obstacles is not None:
        counts["obstacle_points"] = len(result.obstacles)
    if result.clusters is not None:
        counts["clusters"] = int((result.clusters.state == ClusterState.KEPT).sum())
    for camera in result.cameras:
        if camera.detections is not None:
            counts["detections"] += int((camera.detections.state == DetectionState.KEPT).sum())
        if camera.fusion is not None:
            counts["matches"] += int((camera.fusion.detection_decision == Decision.MATCHED).sum())
    return counts
