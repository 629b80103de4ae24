"""Objects that behave as they never did: gone from one sensor, elsewhere at once, a class gone altogether.

How strange it is that an object is not seen is told by its own past. Of one found in ``n`` of the
last ``m`` frames in which it was plainly in view, the chance to miss it once is taken as
``1 - (n + 1) / (m + 2)`` (Laplace's rule); the surprise of missing it ``k`` times is ``-k ln`` of that.
What the past explains, a weak detector or a small object, is no surprise. What is half hidden, cut off by
the border of the image or near the detector's threshold is not counted at all.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bevviz.config import AnomaliesConfig
from bevviz.model import geometry
from bevviz.model.frame import F32, Bool, Boxes3D
from bevviz.model.results import Anomaly, CameraResult, FrameResult, Tracks
from bevviz.stages.fusion import in_view
from bevviz.stages.visibility import range_image, visible

MEMORY = 20  # frames that the past of an object counts
PAST = 5  # frames that an object must have been found in before it can be missed
SAME = 0.3  # least IoU of an object's place in the image and a detection of it
INSIDE = 0.9  # least share of an object's place that is in the image
NOISE = 0.15  # metres, least spread of how far an object is from where it is expected
SPREADS = 6.0  # a jump is so many times what the object's own past spreads
LOST_SPREADS = 4.0  # where its own place is empty, and one of its length has turned up elsewhere
REACH = 3.0  # metres that an object may have jumped
LATEST = 0.25  # seconds that a track may be unseen for when it turns up elsewhere
GROWTH = 0.5  # metres that what is measured may have become longer or shorter in a jump: else it was cut anew
EMPTY = 3  # obstacle points, at most, where nothing is


@dataclass(slots=True)
class Past:
    """What became of one thing, frame after frame: found or not."""

    found: float = 0.0
    asked: float = 0.0
    missed: int = 0  # in a row, until now

    def add(self, found: bool) -> None:
        if found:
            fade = 1 - 1 / MEMORY
            # What was missed before belongs to the past now.
            self.found, self.asked = fade * self.found + 1, fade * self.asked + 1 + self.missed
            self.missed = 0
        else:
            self.missed += 1

    @property
    def surprise(self) -> float:
        """Of having missed it until now; zero where it was not found often enough before."""
        if self.found < PAST:
            return 0.0
        return -self.missed * math.log(1 - (self.found + 1) / (self.asked + 2))


@dataclass(slots=True)
class _Known:
    """What is remembered of a track."""

    camera: Past
    lidar: Past
    name: str = ""
    steps: int = 0  # frames that it was followed in
    spread: float = 0.0  # square metres, mean of how far it was from where it was expected
    length: float = 0.0  # metres, longer side of what was measured last
    center: F32 | None = None  # its centre, in the frame of the tracks


@dataclass(frozen=True, slots=True)
class _Sight:
    """The tracks as they should be seen. Rows are those of the tracks."""

    boxes: Boxes3D  # in the frame of the points
    open: F32  # (T,) share that nothing nearer hides
    whole: Bool  # (T,) in the image of some camera, not cut off by its border
    detected: Bool  # (T,) a kept detection is there, or one of its class, however weak


class ObjectWatch:
    """Looks at the tracks of consecutive frames."""

    def __init__(self) -> None:
        self._known: dict[int, _Known] = {}

    def clear(self) -> None:
        """A drive that starts anew."""
        self._known.clear()

    def update(self, result: FrameResult, tracks: Tracks, config: AnomaliesConfig) -> Iterator[Anomaly]:
        """What is strange in this frame, given those before it."""
        count = 0 if result.clusters is None else len(result.clusters)
        looked_at = np.append(in_view(result.cameras, count), False)[tracks.cluster]
        sight, measured = _sight(result, tracks), _clusters(result, tracks)
        before, self._known = self._known, {}
        missing: dict[str, list[tuple[int, Past]]] = defaultdict(list)
        named: set[str] = set()
        for row, number in enumerate(tracks.id.tolist()):
            known = self._known[number] = before.get(number) or _Known(Past(), Past())
            clustered, has_name = tracks.cluster[row] >= 0, tracks.object[row] >= 0
            plain = sight.open[row] >= config.visible
            if has_name:
                named.add(tracks.names[row])
                known.camera.add(True)
            elif clustered and looked_at[row] and plain and sight.whole[row] and not sight.detected[row]:
                known.camera.add(False)
                if tracks.confirmed[row]:
                    missing[tracks.names[row]].append((row, known.camera))
            if clustered:
                known.lidar.add(True)
            elif tracks.confirmed[row] and plain and sight.whole[row] and _empty(result, tracks, sight, row):
                known.lidar.add(False)
                if known.lidar.surprise >= config.surprise and known.lidar.missed >= 2:
                    yield _lost(tracks, sight, row, known.lidar)
            if tracks.confirmed[row]:
                yield from _jump(result, tracks, sight, row, known, measured, config)
            if clustered:
                known.length, known.center = _measured(measured, tracks, row)
            if clustered and np.isfinite(tracks.innovation[row]):
                known.steps += 1
                gain = max(1 / known.steps, 1 / MEMORY)
                known.spread += gain * (float(tracks.innovation[row]) ** 2 - known.spread)
        for name, rows in missing.items():
            yield from _missing(tracks, sight, name, rows, name in named, config)


def _jump(
    result: FrameResult,
    tracks: Tracks,
    sight: _Sight,
    row: int,
    known: _Known,
    measured: Boxes3D,
    config: AnomaliesConfig,
) -> Iterator[Anomaly]:
    """Elsewhere at once: as the same track, or as a new one where its own has nothing any more.

    A box whose centre moves because more, or less, of the object was measured has not jumped.
    """
    if known.steps < PAST or known.center is None or sight.open[row] < config.visible:
        return
    who, spread = label(tracks, row), math.sqrt(known.spread + NOISE**2)
    limit = max(config.jump, SPREADS * spread)
    if tracks.cluster[row] >= 0:
        length, center = _measured(measured, tracks, row)
        away = min(float(tracks.innovation[row]), float(np.hypot(*(center - known.center)[:2])))
        if away > limit and tracks.object[row] >= 0 and abs(length - known.length) <= GROWTH:
            text = f"{who}: {away:.1f} m from where it was expected"
            yield Anomaly("jump", who, text, rank=_rank(sight, row, away / limit / 3))
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
            and _others_there(result, tracks, sight, row) <= EMPTY
        ):
            text = f"{who}: {offset[other]:.1f} m from where it was expected, as a new track"
            yield Anomaly("jump", who, text, rank=_rank(sight, row, float(offset[other]) / limit / 3))
            return


def _others_there(result: FrameResult, tracks: Tracks, sight: _Sight, row: int) -> int:
    """Obstacle points where a track should be, of clusters that were tracked before."""
    assert result.obstacles is not None
    assert result.clusters is not None
    old = tracks.cluster[(tracks.hits > 2) & (tracks.cluster >= 0)]
    there = geometry.inside(result.obstacles, sight.boxes, row)
    return int(np.isin(result.clusters.labels[there], old).sum()) if len(result.clusters.labels) else 0


def _measured(measured: Boxes3D, tracks: Tracks, row: int) -> tuple[float, F32]:
    """Longer side and centre of a track's cluster."""
    k = int(tracks.cluster[row])
    return float(measured.size[k, :2].max()), measured.center[k]


def _clusters(result: FrameResult, tracks: Tracks) -> Boxes3D:
    """Boxes of the clusters in the frame of the tracks."""
    clusters = result.clusters
    if clusters is None:
        return Boxes3D.empty()
    if not tracks.absolute:
        return clusters.obb
    center = geometry.apply(result.frame.pose, clusters.obb.center)
    return Boxes3D(center, clusters.obb.size, clusters.obb.yaw)


def _missing(
    tracks: Tracks,
    sight: _Sight,
    name: str,
    rows: list[tuple[int, Past]],
    others: bool,
    config: AnomaliesConfig,
) -> Iterator[Anomaly]:
    """Clusters in plain view whose detections are gone: all of a class, or single ones."""
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
            yield Anomaly("one_sensor", who, text, rank=_rank(sight, row, p.surprise / config.surprise / 3))


def _lost(tracks: Tracks, sight: _Sight, row: int, past: Past) -> Anomaly:
    who, frames = label(tracks, row), _frames(past.missed)
    if sight.detected[row]:
        text = f"{who}: detected where the LiDAR sees nothing, and nothing that hides it, for {frames}"
        return Anomaly("one_sensor", who, text, rank=_rank(sight, row, past.surprise / 20))
    text = f"{who}: gone for {frames} from where nothing hides it"
    return Anomaly("flicker", who, text, rank=_rank(sight, row, past.surprise / 20))


def _empty(result: FrameResult, tracks: Tracks, sight: _Sight, row: int) -> bool:
    """Whether nothing is where a track should be, nor another track that has taken its object over."""
    if result.obstacles is None or geometry.inside(result.obstacles, sight.boxes, row).sum() > EMPTY:
        return False
    others = np.flatnonzero(tracks.cluster >= 0)
    return not geometry.bev_iou(sight.boxes.chosen([row]), sight.boxes.chosen(others)).any()


def _rank(sight: _Sight, row: int, strange: float) -> float:
    """0 to 1: what is near and very strange first."""
    away = float(np.hypot(*sight.boxes.center[row, :2]))
    return min(strange, 1.0) / (1 + away / 20)


# --- what should be seen -----------------------------------------------------------------------


def _sight(result: FrameResult, tracks: Tracks) -> _Sight:
    boxes = tracks.boxes
    if tracks.absolute:
        boxes = geometry.moved(boxes, geometry.inverse(result.frame.pose))
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
        found = camera.detections
        near = geometry.iou(xyxy, found.xyxy) >= SAME
        same = np.array([[name == tracks.names[t] for name in found.names] for t in asked], bool)
        same = same.reshape(len(asked), len(found))
        detected[asked] |= (near & (same | found.kept)).any(axis=1)
    return _Sight(boxes, open_, whole, detected)


def _in_image(camera: CameraResult, boxes: Boxes3D) -> tuple[F32, F32] | None:
    """(K, 4) around each projected box, NaN behind the camera, and (K,) how much of that is in the image."""
    about = camera.camera
    if about.image is None or about.intrinsics is None or about.camera_from_points is None:
        return None
    corners = geometry.corners(boxes).reshape(-1, 3)
    uv, _ = geometry.project(geometry.apply(about.camera_from_points, corners), about.intrinsics)
    uv = uv.reshape(-1, 8, 2)
    xyxy = np.hstack([uv.min(axis=1), uv.max(axis=1)])
    size = np.array([about.intrinsics.width, about.intrinsics.height] * 2, np.float32)
    inside = np.clip(xyxy, 0, size)
    area = np.prod(np.maximum(xyxy[:, 2:] - xyxy[:, :2], 1e-3), axis=1)
    with np.errstate(invalid="ignore"):
        share = np.prod(inside[:, 2:] - inside[:, :2], axis=1) / area
    return inside, np.nan_to_num(share).astype(np.float32)


def label(tracks: Tracks, row: int) -> str:
    """``person #12``."""
    return f"{tracks.names[row] or 'object'} #{tracks.id[row]}"


def _frames(count: int) -> str:
    return "1 frame" if count == 1 else f"{count} frames"
