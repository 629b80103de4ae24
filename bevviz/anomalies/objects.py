"""Anomalies of objects: lost by one sensor, moved in a jump, or missing with their whole class.

The history of an object decides how surprising a miss is. For an object that was found in ``n`` of the last
``m`` frames in which it was plainly in view, the chance of one miss is ``1 - (n + 1) / (m + 2)`` (Laplace's
rule). The surprise of missing it ``k`` times is ``-k ln`` of that. So a weak detector or a small object
causes no surprise. An object is not counted while it is half hidden, largely outside the image, or near the
detector's threshold.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from bevviz.config import AnomaliesConfig
from bevviz.model import box_overlap, geometry
from bevviz.model.frame import F32, F64, Bool, Boxes3D
from bevviz.model.results import Anomaly, CameraResult, FrameResult, Tracks
from bevviz.stages.fusion import clusters_in_view
from bevviz.stages.visibility import range_image, visible

MEMORY = 20  # frames of the history of an object
PAST = 5  # least frames with the object found, before a miss counts
SAME = 0.3  # least IoU of a projected track and its detection
INSIDE = 0.6  # least share of a projected track that must be in the image: the nearest car is cut off by it
NOISE = 0.15  # metres, least spread of the distance between expected and measured position
SPREADS = 6.0  # a jump is larger than this multiple of the object's own spread
LOST_SPREADS = 4.0  # the same where the track's box is empty and a new track of the same length appeared
REACH = 3.0  # metres, largest jump that is searched for a new track
LATEST = 0.25  # seconds, largest time without a cluster before the new track appears
GROWTH = 0.5  # metres, largest change of length in a jump; a larger one is a new segmentation
EMPTY = 3  # most obstacle points in a box that counts as empty


@dataclass(slots=True)
class Past:
    """History of one object and one sensor: in how many frames it was found or missed."""

    found: float = 0.0
    asked: float = 0.0
    missed: int = 0  # misses in a row up to now

    def add(self, found: bool) -> None:
        """Count one more frame. Old frames fade with a memory of ``MEMORY`` frames."""
        if found:
            fade = 1 - 1 / MEMORY
            # Earlier misses are part of the history now.
            self.found, self.asked = fade * self.found + 1, fade * self.asked + 1 + self.missed
            self.missed = 0
        else:
            self.missed += 1

    @property
    def surprise(self) -> float:
        """Surprise of the current misses in a row. Zero while it was found too rarely."""
        if self.found < PAST:
            return 0.0
        return -self.missed * math.log(1 - (self.found + 1) / (self.asked + 2))


@dataclass(slots=True)
class _TrackHistory:
    """State of one track: its history and its last measurement."""

    camera: Past
    lidar: Past
    name: str = ""
    steps: int = 0  # frames with an innovation
    spread: float = 0.0  # square metres, mean squared distance from the expected position
    length: float = 0.0  # metres, longer side of the last cluster
    center: F32 | F64 | None = None  # centre of the last cluster, in the frame of the tracks


@dataclass(frozen=True, slots=True)
class _Visibility:
    """Expected visibility of the tracks. One row per track."""

    boxes: Boxes3D  # in the frame of the points
    open: F32  # (T,) share that no nearer object hides
    whole: Bool  # (T,) whether it is in a camera image, or most of it
    detected: Bool  # (T,) whether a kept detection, or any one of its class, overlaps it


class _Measured(NamedTuple):
    """Clusters of the newest frame."""

    length: F32  # (K,) metres, longer side
    center: F32 | F64  # (K, 3) in the frame of the tracks


class ObjectWatch:
    """Detector of object anomalies in the tracks of consecutive frames."""

    def __init__(self) -> None:
        self._known: dict[int, _TrackHistory] = {}

    def clear(self) -> None:
        """Forget all tracks, for a drive that starts again."""
        self._known.clear()

    def update(self, result: FrameResult, tracks: Tracks, config: AnomaliesConfig) -> Iterator[Anomaly]:
        """Yield the anomalies of this frame, given the frames before it."""
        count = 0 if result.clusters is None else len(result.clusters)
        looked_at = np.append(clusters_in_view(result.cameras, count), False)[tracks.cluster]
        visibility, measured = _expected_visibility(result, tracks), _clusters(result, tracks)
        before, self._known = self._known, {}
        missing: dict[str, list[tuple[int, Past]]] = defaultdict(list)
        named: set[str] = set()
        for row, number in enumerate(tracks.id.tolist()):
            known = self._known[number] = before.get(number) or _TrackHistory(Past(), Past())
            clustered, has_name = tracks.cluster[row] >= 0, tracks.object[row] >= 0
            plain = visibility.open[row] >= config.visible
            if has_name:
                named.add(tracks.names[row])
                known.camera.add(True)
            elif (
                clustered
                and looked_at[row]
                and plain
                and visibility.whole[row]
                and not visibility.detected[row]
            ):
                known.camera.add(False)
                if tracks.confirmed[row]:
                    missing[tracks.names[row]].append((row, known.camera))
            if clustered:
                known.lidar.add(True)
            elif (
                tracks.confirmed[row]
                and plain
                and visibility.whole[row]
                and _empty(result, tracks, visibility, row)
            ):
                known.lidar.add(False)
                if known.lidar.surprise >= config.surprise and known.lidar.missed >= 2:
                    yield _lost(tracks, visibility, row, known.lidar)
            if tracks.confirmed[row]:
                yield from _jump(result, tracks, visibility, row, known, measured, config)
            if clustered:
                known.length, known.center = _measured(measured, tracks, row)
            if clustered and np.isfinite(tracks.innovation[row]):
                known.steps += 1
                gain = max(1 / known.steps, 1 / MEMORY)
                known.spread += gain * (float(tracks.innovation[row]) ** 2 - known.spread)
        for name, rows in missing.items():
            yield from _missing(tracks, visibility, name, rows, name in named, config)


def _jump(
    result: FrameResult,
    tracks: Tracks,
    visibility: _Visibility,
    row: int,
    known: _TrackHistory,
    measured: _Measured,
    config: AnomaliesConfig,
) -> Iterator[Anomaly]:
    """Yield a jump: the same track far from its expected position, or a new track while its box is empty.

    A centre that moves because more or less of the object was measured is no jump.
    """
    if known.steps < PAST or known.center is None or visibility.open[row] < config.visible:
        return
    name, spread = label(tracks, row), math.sqrt(known.spread + NOISE**2)
    limit = max(config.jump, SPREADS * spread)
    if tracks.cluster[row] >= 0:
        length, center = _measured(measured, tracks, row)
        distance = min(float(tracks.innovation[row]), float(np.hypot(*(center - known.center)[:2])))
        if distance > limit and tracks.object[row] >= 0 and abs(length - known.length) <= GROWTH:
            text = f"{name}: {distance:.1f} m from where it was expected"
            yield Anomaly("jump", name, text, rank=_rank(visibility, row, distance / limit / 3))
        return
    if tracks.coasting[row] > LATEST or result.obstacles is None:
        return
    limit = max(config.jump, LOST_SPREADS * spread)
    offset = np.hypot(*(tracks.boxes.center[:, :2] - tracks.boxes.center[row, :2]).T)
    for other in np.flatnonzero((tracks.hits <= 2) & (offset > limit) & (offset <= REACH)).tolist():
        length, _ = _measured(measured, tracks, other)
        if (
            tracks.names[other] in ("", tracks.names[row])
            and abs(length - known.length) <= GROWTH
            and _count_older_points(result, tracks, visibility, row) <= EMPTY
        ):
            text = f"{name}: {offset[other]:.1f} m from where it was expected, as a new track"
            yield Anomaly("jump", name, text, rank=_rank(visibility, row, float(offset[other]) / limit / 3))
            return


def _count_older_points(result: FrameResult, tracks: Tracks, visibility: _Visibility, row: int) -> int:
    """Count the obstacle points in the box of a track that belong to clusters with older tracks."""
    assert result.obstacles is not None
    assert result.clusters is not None
    old = tracks.cluster[(tracks.hits > 2) & (tracks.cluster >= 0)]
    in_box = geometry.inside(result.obstacles, visibility.boxes, row)
    return int(np.isin(result.clusters.labels[in_box], old).sum()) if len(result.clusters.labels) else 0


def _measured(measured: _Measured, tracks: Tracks, row: int) -> tuple[float, F32 | F64]:
    """Return the longer side and the centre of a track's cluster."""
    k = int(tracks.cluster[row])
    return float(measured.length[k]), measured.center[k]


def _clusters(result: FrameResult, tracks: Tracks) -> _Measured:
    """Return the clusters in the frame of the tracks."""
    boxes = Boxes3D.empty() if result.clusters is None else result.clusters.obb
    center = geometry.apply(result.frame.pose, boxes.center) if tracks.absolute else boxes.center
    return _Measured(boxes.size[:, :2].max(axis=1), center)


def _missing(
    tracks: Tracks,
    visibility: _Visibility,
    name: str,
    rows: list[tuple[int, Past]],
    others: bool,
    config: AnomaliesConfig,
) -> Iterator[Anomaly]:
    """Yield clusters in plain view that lost their detections: a whole class, or single objects."""
    past = [p for _, p in rows if p.found >= PAST]
    together = sum(p.surprise for p in past)
    if len(past) > 1 and not others and together >= config.surprise and min(p.missed for p in past) >= 2:
        frames = _frames(min(p.missed for p in past))
        text = f"no {name} is detected any more: {len(past)} are in plain view for {frames}"
        yield Anomaly("flicker", name, text, rank=min(together / config.surprise / 3, 1.0))
        return
    for row, p in rows:
        if p.surprise >= config.surprise and p.missed >= 2:
            who = label(tracks, row)
            size = " x ".join(f"{side:.1f}" for side in tracks.boxes.size[row].tolist())
            text = f"{who}: a cluster in plain view, {size} m, without a detection for {_frames(p.missed)}"
            yield Anomaly(
                "one_sensor", who, text, rank=_rank(visibility, row, p.surprise / config.surprise / 3)
            )


def _lost(tracks: Tracks, visibility: _Visibility, row: int, past: Past) -> Anomaly:
    """Return the anomaly of a track whose cluster is gone although nothing hides it."""
    who, frames = label(tracks, row), _frames(past.missed)
    if visibility.detected[row]:
        text = f"{who}: detected where the LiDAR sees nothing, and nothing that hides it, for {frames}"
        return Anomaly("one_sensor", who, text, rank=_rank(visibility, row, past.surprise / 20))
    text = f"{who}: gone for {frames} from where nothing hides it"
    return Anomaly("flicker", who, text, rank=_rank(visibility, row, past.surprise / 20))


def _empty(result: FrameResult, tracks: Tracks, visibility: _Visibility, row: int) -> bool:
    """Return whether the box of a track is empty and no other track has taken the object over."""
    if result.obstacles is None or geometry.inside(result.obstacles, visibility.boxes, row).sum() > EMPTY:
        return False
    others = np.flatnonzero(tracks.cluster >= 0)
    return not box_overlap.bev_iou(visibility.boxes.chosen([row]), visibility.boxes.chosen(others)).any()


def _rank(visibility: _Visibility, row: int, strange: float) -> float:
    """Return a rank from 0 to 1. Near and very surprising objects rank highest."""
    distance = float(visibility.boxes.distance[row])
    return min(strange, 1.0) / (1 + distance / 20)


# --- expected visibility -----------------------------------------------------------------------


def _expected_visibility(result: FrameResult, tracks: Tracks) -> _Visibility:
    """Compute the expected visibility of the tracks. Only confirmed tracks are examined."""
    boxes = tracks.boxes
    if tracks.absolute:
        boxes = geometry.transform_boxes(boxes, geometry.inverse(result.frame.pose))
    n = len(boxes)
    open_, whole = np.ones(n, np.float32), np.zeros(n, bool)
    detected = np.zeros(n, bool)
    asked = np.flatnonzero(tracks.confirmed)
    if len(asked):
        image = range_image(result.frame.points) if result.ranges is None else result.ranges
        open_[asked] = visible(image, boxes.chosen(asked))
    for camera in result.cameras:
        places = _in_image(camera, boxes.chosen(asked))
        if places is None or camera.detections is None:
            continue
        xyxy, share = places
        whole[asked] |= share >= INSIDE
        detections = camera.detections
        near = geometry.iou(xyxy, detections.xyxy) >= SAME
        same = np.array(tracks.names, str)[asked, None] == np.array(detections.names, str)
        detected[asked] |= (near & (same | detections.kept)).any(axis=1)
    return _Visibility(boxes, open_, whole, detected)


def _in_image(camera: CameraResult, boxes: Boxes3D) -> tuple[F32, F32] | None:
    """Project boxes into a camera. Return None without image, intrinsics or transform.

    Returns:
        (K, 4) bounding rectangle of each box, clipped to the image, NaN behind the camera, and (K,) share of
        the rectangle that is in the image.
    """
    sensor = camera.camera
    if sensor.image is None or sensor.intrinsics is None or sensor.camera_from_points is None:
        return None
    corners = geometry.corners(boxes).reshape(-1, 3)
    uv, _ = geometry.project(geometry.apply(sensor.camera_from_points, corners), sensor.intrinsics)
    uv = uv.reshape(-1, 8, 2)
    xyxy = np.hstack([uv.min(axis=1), uv.max(axis=1)])
    size = np.array([sensor.intrinsics.width, sensor.intrinsics.height] * 2, np.float32)
    inside = np.clip(xyxy, 0, size)
    area = np.prod(np.maximum(xyxy[:, 2:] - xyxy[:, :2], 1e-3), axis=1)
    with np.errstate(invalid="ignore"):
        share = np.prod(inside[:, 2:] - inside[:, :2], axis=1) / area
    return inside, np.nan_to_num(share).astype(np.float32)


def label(tracks: Tracks, row: int) -> str:
    """Return the name of a track for texts, such as ``person #12``."""
    return f"{tracks.names[row] or 'object'} #{tracks.id[row]}"


def _frames(count: int) -> str:
    """Return the count with its noun, such as ``2 frames``."""
    return "1 frame" if count == 1 else f"{count} frames"
