"""Log cameras with their detections, points and frustums, and the bird's-eye view."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np
import rerun as rr

from bevviz.config import Config
from bevviz.model import geometry
from bevviz.model.decisions import unmatched_detections
from bevviz.model.frame import F32, F64, I64, Camera, Frame, Image, Intrinsics
from bevviz.model.results import (
    Bev,
    CameraResult,
    Decision,
    Detections,
    Explanation,
    FrameResult,
    Masks,
    texts_by_row,
)
from bevviz.recording import entities, retention
from bevviz.recording.addresses import Rows
from bevviz.recording.labels import NameRoom, shown, under
from bevviz.recording.layers import Layer, Style, callouts, draw
from bevviz.recording.primitives import (
    CORNER,
    blob,
    depth_annotations,
    encode_image,
    jpeg,
    png,
    scored,
    transform,
)
from bevviz.recording.projection import edges
from bevviz.recording.writer import Writer
from bevviz.support.colors import FAINT, UNNAMED, Color, StateColor, class_color, color_rows

if TYPE_CHECKING:
    from bevviz.recording.video import VideoEncoder


def camera_pose(frame: Frame, result: CameraResult) -> F64 | None:
    """Return (4, 4) ``world_from_camera``, or None if it is unknown."""
    camera = result.camera
    if camera.world_from_camera is not None:
        return camera.world_from_camera
    if camera.camera_from_points is not None:
        return frame.pose @ geometry.inverse(camera.camera_from_points)
    return None


def log_camera(
    to: Writer, frame: Frame, result: CameraResult, quality: int, videos: VideoEncoders | None = None
) -> None:
    """Log pose and image of a camera. The intrinsics are static, see ``log_intrinsics``.

    Args:
        to: writer of the recording.
        frame: frame of the image.
        result: results of the camera.
        quality: JPEG quality of images that came raw.
        videos: encoders for images that came raw or lossless; None: these are logged as images.
    """
    camera, world_from_camera = result.camera, camera_pose(frame, result)
    if world_from_camera is not None:
        to.put(entities.SENSOR.path(camera.name), transform(world_from_camera))
    if camera.image is not None:
        is_stream = camera.image.clip is not None and to.streams_video
        if videos is not None and not is_stream and camera.image.media_type not in retention.LOSSY:
            videos.log(to, camera.name, camera.image)
        else:
            log_image(to, camera.name, camera.image, quality)


def log_intrinsics(to: Writer, name: str, intrinsics: Intrinsics) -> None:
    """Log the intrinsics as static data, so that a viewer that connects late has them."""
    to.static(
        entities.SENSOR.path(name),
        rr.Pinhole(
            image_from_camera=intrinsics.K + np.array([[0, 0, CORNER], [0, 0, CORNER], [0, 0, 0]]),
            resolution=[intrinsics.width, intrinsics.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=1.5,
        ),
    )


def log_image(to: Writer, name: str, image: Image, quality: int) -> None:
    """Log an image once. A camera may be slower than the LiDAR, so several frames may share an image."""
    path = entities.IMAGE.path(name)
    if to.keep(path, image.stamp):
        return
    if image.clip is not None and to.streams_video:
        to.video(path, image.clip)
    else:
        to.put(path, encode_image(image, quality))


class VideoEncoders:
    """Encoders of camera images as H.264 streams, one for each camera."""

    def __init__(self) -> None:
        self._encoders: dict[str, VideoEncoder] = {}
        self._recording: object = None

    def restart(self) -> None:
        """Make the next image of each camera a key frame."""
        for encoder in self._encoders.values():
            encoder.restart()

    def log(self, to: Writer, name: str, image: Image) -> None:
        """Log an image once, as ``log_image`` does."""
        if self._recording is not to.recording:
            self._recording = to.recording
            self.restart()
        path = entities.IMAGE.path(name)
        if to.keep(path, image.stamp):
            return
        if name not in self._encoders:
            from bevviz.recording.video import VideoEncoder  # imports PyAV, which is slow and rarely needed

            self._encoders[name] = VideoEncoder()
        sample = self._encoders[name](image.bgr, image.stamp)
        if sample.key:
            to.put(path, rr.VideoStream.from_fields(codec=rr.VideoCodec.H264, sample=sample.data))
        else:
            to.put(path, rr.VideoStream.from_fields(sample=sample.data))


def log_detections(
    to: Writer, result: CameraResult, explanations: Iterable[Explanation], *, has_truth: bool = False
) -> None:
    """Log kept detections in the colour of their class, and the other detections faint.

    Without ground truth, detections without an object are outlined as doubtful. They have names, as long as
    these do not overlap. The tooltip of each outline explains the decision, see ``bevviz.recording.labels``.
    """
    name, detections = result.camera.name, result.detections
    if detections is None:
        return
    kept, others = np.flatnonzero(detections.kept), np.flatnonzero(~detections.kept)
    weak = Style(FAINT, 0.5, labels=False, order=20.0)
    draw(to, _detection_layer(entities.WEAK.path(name), name, detections, others, weak))
    if not len(kept):
        return
    path, colors = entities.DETECTIONS.path(name), [class_color(detections.names[row]) for row in kept]
    boxes = _detection_layer(path, name, detections, kept, Style(labels=False, order=30.0), colors)
    texts = texts_by_row(explanations, "detection", name)
    labels = scored((detections.names[row] for row in kept), detections.score[kept])
    doubtful = np.isin(kept, unmatched_detections(result)) & (not has_truth)
    # The box of a double lies over that of the best, so both have one colour.
    doubtful_outlines = np.isin(kept, unmatched_detections(result, doubles=True)) & (not has_truth)
    outline_colors = [
        StateColor.DOUBTFUL.value if is_doubtful else color
        for is_doubtful, color in zip(doubtful_outlines, colors, strict=True)
    ]
    xyxy = detections.xyxy[kept]
    # The tallest boxes come first, as they are usually the nearest.
    room, heights = NameRoom.in_image(_width(result.camera)), xyxy[:, 3] - xyxy[:, 1]
    has_name = room.choose(under(xyxy), labels, -heights, doubtful) & doubtful
    says = [texts.get(row, label) for row, label in zip(kept.tolist(), labels, strict=True)]
    outlines = Style(width=1.5, order=31.0)
    names = shown(labels, has_name)
    draw(to, boxes, *callouts(path, xyxy, says, names, outline_colors, outlines, frame=name, rows=boxes.rows))
    if detections.masks is not None:
        _log_masks(to, name, detections, detections.masks, kept)


def _width(camera: Camera) -> float:
    """Return the width of the image in pixels.

    Return infinity if it is unknown: then all names overlap, and only one is written.
    """
    if camera.intrinsics is not None:
        return camera.intrinsics.width
    return np.inf if camera.image is None else camera.image.bgr.shape[1]


def _log_masks(to: Writer, name: str, detections: Detections, masks: Masks, rows: I64) -> None:
    """Log the outlines of the masks."""
    lines, colors, drawn = [], [], list[int]()
    for row in rows.tolist():
        if not masks.has(row):
            continue
        contours, _ = cv2.findContours(
            masks.cells(row).astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE
        )
        corner = masks.place[row, :2] + np.float32(0.5) - masks.grid[2:]
        for outline in contours:
            closed = np.concatenate([outline[:, 0], outline[:1, 0]])
            lines.append((closed + corner) / masks.grid[:2])
            colors.append(class_color(detections.names[row]))
            drawn.append(row)
    addresses = Rows("detection", drawn, name)
    draw(to, Layer(entities.MASKS.path(name), lines, colors=colors, frame=name, rows=addresses))


def _detection_layer(
    path: str,
    camera: str,
    detections: Detections,
    rows: I64,
    style: Style,
    colors: Sequence[Color] | None = None,
) -> Layer:
    labels = scored((detections.names[row] for row in rows), detections.score[rows])
    class_ids = entities.ClassId.DETECTION + detections.state[rows]
    return Layer(
        path,
        detections.xyxy[rows],
        style,
        labels,
        colors=colors,
        class_ids=class_ids,
        frame=camera,
        rows=Rows("detection", rows, camera),
    )


def log_projected_points(to: Writer, result: CameraResult, *, packed: bool = False) -> None:
    """Log the obstacle points in the image, coloured by depth.

    Args:
        to: writer of the recording.
        result: results of the camera.
        packed: round and sort the points, as in recordings that do not keep everything.
    """
    if result.uv is None or result.depth is None:
        return
    visible = np.isfinite(result.uv[:, 0])
    if visible.any():
        depth = color_rows(result.depth[visible], 0, entities.DEPTH_RANGE, entities.DEPTH_BINS)
        uv = result.uv[visible] + CORNER
        if packed:
            rows = retention.sorted_rows(uv, retention.PIXEL_STEPS)
            uv, depth = (
                np.rint(uv[rows] * retention.PIXEL_STEPS) / np.float32(retention.PIXEL_STEPS),
                depth[rows],
            )
        name = result.camera.name
        path, style = entities.PROJECTED.path(name), Style(width=1.5, labels=False, order=10.0)
        to.static_once(path, depth_annotations)
        draw(to, Layer(path, uv, style, class_ids=depth, frame=name))


# --- frustums ----------------------------------------------------------------------------------

_NEAR = 0.3  # metres from the camera
_UNMATCHED_DEPTH = 20.0  # metres to the far end of an unmatched detection's frustum


def log_frustums(to: Writer, frame: Frame, cameras: Sequence[CameraResult]) -> None:
    """Log the frustum of every kept detection in the fixed frame. Unmatched ones are grey."""
    strips: list[F32] = []
    colors: list[tuple[int, ...]] = []
    labels: list[str] = []
    drawn, drawn_cameras = list[int](), list[str]()
    for camera in cameras:
        pose, intrinsics = camera_pose(frame, camera), camera.camera.intrinsics
        detections, fusion = camera.detections, camera.fusion
        if pose is None or intrinsics is None or detections is None or fusion is None:
            continue
        rows = np.flatnonzero(detections.kept)
        if len(rows) == 0:
            continue
        far = np.full(len(detections), _UNMATCHED_DEPTH, np.float32)
        matched = fusion.detection_decision == Decision.MATCHED
        pairs = fusion.pairs
        is_best = matched[pairs.detection] & (fusion.detection_cluster[pairs.detection] == pairs.cluster)
        far[pairs.detection[is_best]] = pairs.depth[is_best]
        near = np.full(len(rows), _NEAR, np.float32)
        corners = geometry.frustum(detections.xyxy[rows], intrinsics, near, far[rows])
        corners = geometry.apply(pose, corners.reshape(-1, 3)).reshape(-1, 8, 3)
        names = [detections.names[row] for row in rows]
        strips.append(edges(corners))
        colors += [
            class_color(name) if is_matched else UNNAMED
            for name, is_matched in zip(names, matched[rows], strict=True)
        ]
        labels += scored(names, detections.score[rows])
        drawn += rows.tolist()
        drawn_cameras += [camera.camera.name] * len(rows)
    if strips:
        style = Style(width=1.0, labels=False)
        addresses = Rows("detection", drawn, drawn_cameras)
        lines = np.concatenate(strips)
        draw(to, Layer(entities.FRUSTUMS, lines, style, labels, colors=colors, rows=addresses))


# --- bird's-eye view ---------------------------------------------------------------------------

_GRID_ROTATION = np.array(
    [0.0, 0.0, -np.sqrt(0.5), np.sqrt(0.5)]
)  # rotation by -90 degrees about z, as x, y, z, w


def log_bev(to: Writer, bev: Bev, config: Config) -> None:
    """Log the bird's-eye image and its channels.

    The reference style is logged as PNG, so that pixels equal those of the tutorial. The others are JPEG.
    """
    quality = config.logging.jpeg_quality if retention.keeps_everything(config) else retention.BEV_QUALITY
    is_reference = config.bev.style == "reference"
    to.put(entities.BEV, png(bev.image) if is_reference else jpeg(bev.image, quality))
    for name, grid in bev.channels.items():
        if name != "occupancy":
            to.put(entities.CHANNEL.path(name), rr.Image(grid, color_model="L"))


def log_grid(to: Writer, result: FrameResult, bev: Bev) -> None:
    """Log the occupancy grid on the ground. The pose of a grid map is the pose of its lower left corner.

    The pose is part of the grid map, not a separate transform. The viewer keeps the transforms of the whole
    drive, and a chunk stays in memory as a whole. A transform in the chunk would keep every grid in memory.
    """
    grid = bev.channels.get("occupancy")
    if grid is None:
        return
    level = 0.0
    if result.ground is not None and result.voxels is not None:
        heights = result.voxels.points[::32, 2].compress(result.ground.mask[::32])
        level = float(np.median(heights)) if len(heights) else 0.0
    corner = np.array([-bev.range_x, bev.range_y, level - 0.05])
    pose = result.frame.pose @ geometry.transform(corner, _GRID_ROTATION)
    to.put(
        entities.GRID,
        _grid_style(*grid.shape, bev.resolution),
        rr.GridMap.from_fields(
            data=blob(grid.view(np.uint8).ravel()),
            translation=pose[:3, 3],
            quaternion=rr.Quaternion(xyzw=geometry.quaternion(pose)),
        ),
    )


@lru_cache(maxsize=2)
def _grid_style(rows: int, columns: int, resolution: float) -> rr.GridMap:
    return rr.GridMap.from_fields(
        format=rr.components.ImageFormat(width=columns, height=rows, color_model="L", channel_datatype="U8"),
        cell_size=resolution,
        opacity=0.2,
        colormap=rr.components.Colormap.RvizMap,
    )
