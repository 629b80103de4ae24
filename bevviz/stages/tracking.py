"""Track clusters over frames with a constant-velocity Kalman filter for each object."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevviz.config import TrackingConfig
from bevviz.model import geometry
from bevviz.model.box_overlap import bev_iou_and_share
from bevviz.model.frame import F32, F64, I32, I64, Bool, Boxes3D, Frame
from bevviz.model.results import Clusters, Objects, Tracks
from bevviz.stages.track_matching import SAME_PLACE, costs, extents, match

INITIAL_SPEED = 5.0  # m/s, one sigma of the speed of a new track
SHAPE_GAIN = 0.2  # share of the newest box in the smoothed size and heading
LEAST_VOTE = 1.0  # a track whose decayed scores sum up to less loses its name
SAME_OBJECT = 0.5  # share of a track's box that lies in an older one's from which on both are one object
LONG = 3.0  # m; a track of this length or more is a vehicle, of which often only a part is seen
HEADING_SPEED = 1.0  # m/s above which the direction of motion distinguishes front from back


@dataclass(slots=True)
class _TrackStates:
    """State of all tracks, one row for each. All fields are arrays, so that rows are selected together."""

    id: I64
    mean: F64  # (T, 2, 3) position and velocity
    covariance: F64  # (T, 2, 2) the same for each axis
    size: F64  # (T, 3)
    whole: Bool  # whether the size is that of the whole object, not of its visible part
    yaw: F64
    hits: I32
    sightings: I32
    born: I64  # stamp
    seen: I64  # stamp
    doubled: I32  # frames that the track shared the box of an older one
    split: Bool  # whether the box holds another cluster as well, which may be a part of the object
    votes: F64  # (T, classes)
    trail: F32  # (T, L, 3) NaN before the birth

    @staticmethod
    def empty() -> _TrackStates:
        """Return the state without tracks."""
        whole = np.zeros(0, np.bool_)
        return _TrackStates.new(np.zeros(0, np.int64), Boxes3D.empty(), whole, 0, 0, 0, TrackingConfig())

    @staticmethod
    def new(
        ids: I64, boxes: Boxes3D, whole: Bool, stamp: int, classes: int, length: int, config: TrackingConfig
    ) -> _TrackStates:
        """Return the state of new tracks, one for each box."""
        n = len(ids)
        mean = np.zeros((n, 2, 3))
        mean[:, 0] = boxes.center
        return _TrackStates(
            id=ids,
            mean=mean,
            covariance=np.tile(np.diag([config.position_noise**2, INITIAL_SPEED**2]), (n, 1, 1)),
            size=boxes.size.astype(np.float64),
            whole=whole,
            yaw=boxes.yaw.astype(np.float64),
            hits=np.ones(n, np.int32),
            sightings=np.zeros(n, np.int32),
            born=np.full(n, stamp, np.int64),
            seen=np.full(n, stamp, np.int64),
            doubled=np.zeros(n, np.int32),
            split=np.zeros(n, np.bool_),
            votes=np.zeros((n, classes)),
            trail=np.full((n, length, 3), np.nan, np.float32),
        )

    def __len__(self) -> int:
        return len(self.id)

    def chosen(self, rows: NDArray[Any]) -> _TrackStates:
        """Return the state of some rows."""
        return _TrackStates(*(getattr(self, field.name)[rows] for field in fields(self)))

    def joined(self, other: _TrackStates) -> _TrackStates:
        """Return the state with the rows of another appended."""
        return _TrackStates(
            *(np.concatenate([getattr(s, field.name) for s in (self, other)]) for field in fields(self))
        )


class Tracker:
    """Tracker of the clusters of consecutive frames. The fused objects name the tracks.

    It follows SORT (Bewley et al. 2016) and AB3DMOT (Weng et al. 2020): predict, assign, update. These track
    image boxes and 3D detections; here the boxes come from the clusters. So a track survives while the
    detector misses its object or the camera does not see it.

    Positions are in the fixed frame if there is one. A standing object then has speed zero however the robot
    moves. The tracker restarts with new ids if stamps jump or the frame changes.
    """

    def __init__(self) -> None:
        self._state = _TrackStates.empty()
        self._classes: list[str] = []
        self._stamps: list[int] = []  # stamps of the columns of the trails
        self._frame: tuple[str, bool] | None = None
        self._next = 0

    def update(
        self, frame: Frame, clusters: Clusters, in_view: Bool, objects: Objects | None, config: TrackingConfig
    ) -> Tracks:
        """Return the tracks after this frame.

        Args:
            frame: gives stamp and pose. The same stamp twice is the same instant seen again.
            clusters: only kept clusters are tracked, by their oriented boxes. If an object completed the box
                to the size of its class, that box is used.
            in_view: (K,) clusters that some camera could name. Without a name their tracks gradually lose the
                name they had.
            objects: names of clusters.
            config: noise, gate, birth and death.

        Returns:
            Every living track, also tracks without a name.
        """
        absolute = frame.world_from_points is not None
        place = (frame.world_frame if absolute else frame.points_frame, absolute)
        dt = (frame.stamp - self._stamps[-1]) * 1e-9 if self._stamps else 0.0
        if not 0 <= dt <= config.reset_after or place != self._frame:
            self._state, self._stamps, self._frame, dt = _TrackStates.empty(), [], place, 0.0
            self._state.votes = np.zeros((0, len(self._classes)))
        kept = np.flatnonzero(clusters.kept)
        pose = frame.pose
        seen = _move_boxes(clusters.obb, kept, pose)
        boxes, whole = _complete_boxes(seen, kept, objects, pose, config.gate)

        self._predict(dt, config)
        column = self._assign(boxes, whole, seen, pose, config)
        old = np.flatnonzero(column >= 0)
        innovation = np.full(len(column), np.nan, np.float32)
        measured = self._complete(
            old, boxes.chosen(column[old]), whole[column[old]], seen.chosen(column[old]), pose
        )
        innovation[old] = self._correct(old, measured, config)
        self._state.hits[old] += 1
        self._state.seen[old] = frame.stamp
        cluster = np.where(column >= 0, np.append(kept, -1)[column], -1)

        missed = (frame.stamp - self._state.seen) * 1e-9
        young = (self._state.hits < config.min_hits) & (column < 0)
        alive = (missed <= config.max_coast) & ~young
        self._state, cluster, innovation = self._state.chosen(alive), cluster[alive], innovation[alive]
        fresh = np.setdiff1d(np.arange(len(boxes)), column)
        ids = self._next + np.arange(len(fresh))
        self._next += len(fresh)
        length, classes = len(self._stamps), len(self._classes)
        born = _TrackStates.new(ids, boxes.chosen(fresh), whole[fresh], frame.stamp, classes, length, config)
        self._state = self._state.joined(born)
        cluster = np.concatenate([cluster, kept[fresh]])
        innovation = np.concatenate([innovation, np.full(len(fresh), np.nan, np.float32)])

        self._remember(frame.stamp, config)
        named = self._vote(cluster, in_view, objects, dt, config)
        cluster, named, innovation, shown = self._merge(cluster, named, innovation, config)
        return self._tracks(frame.stamp, place, cluster, named, innovation, shown)

    def _predict(self, dt: float, config: TrackingConfig) -> None:
        """Predict with constant velocity. Noise is an acceleration that is constant between two frames."""
        step = np.array([[1.0, dt], [0.0, 1.0]])
        disturbed = config.acceleration * np.array([dt**2 / 2, dt])
        self._state.mean = step @ self._state.mean
        self._state.covariance = step @ self._state.covariance @ step.T + np.outer(disturbed, disturbed)

    def _assign(self, boxes: Boxes3D, whole: Bool, seen: Boxes3D, pose: F64, config: TrackingConfig) -> I32:
        """Return the (T,) box of each track, -1 for none.

        The assignment minimises squared distances on the ground, relative to the gate. The gate is
        ``tracking.gate``, or three sigma of the position if that is wider. Different sizes cost as well. A
        track that never was whole is compared with the visible box. The visible part of an object that was
        whole before may be smaller and its centre may lie nearer to the sensor, at no cost. A box that
        overlaps a long track may be its box beyond the gate, too, since the centre of a vehicle's visible
        part may be far from the vehicle's. Tracks that share the box of an older one choose last.
        """
        state = self._state
        column = np.full(len(state), -1, np.int32)
        state.split[:] = False
        if len(state) == 0 or len(boxes) == 0:
            return column
        expected = self._boxes()
        large = np.flatnonzero(expected.size[:, :2].max(axis=1) >= LONG)
        overlap = np.zeros((2, len(state), len(boxes)))
        overlap[0, large], inside = bev_iou_and_share(expected.chosen(large), seen)
        overlap[1, large], _ = bev_iou_and_share(expected.chosen(large), boxes)
        gate = self._gate(config)
        sight = state.mean[:, 0, :2] - pose[:2, 3]
        sight /= np.maximum(np.linalg.norm(sight, axis=1, keepdims=True), 1e-9)
        cost = costs(
            state.mean[:, 0],
            gate,
            extents(state.size),
            sight,
            state.whole,
            np.stack([seen.center, boxes.center]),
            np.stack([extents(seen.size), extents(boxes.size)]),
            whole,
            overlap,
        )
        doubled = state.doubled >= config.min_hits
        column[~doubled] = match(cost[~doubled])
        free = np.setdiff1d(np.arange(len(boxes)), column)
        column[doubled] = np.append(free, -1)[match(cost[np.ix_(doubled, free)])]
        parts = (inside >= SAME_OBJECT) & (np.arange(len(boxes)) != column[large, None])
        state.split[large] = (parts & (seen.size[:, :2].max(axis=1) >= config.gate)).any(axis=1)
        return column

    def _complete(self, rows: NDArray[Any], boxes: Boxes3D, whole: Bool, seen: Boxes3D, pose: F64) -> Boxes3D:
        """Complete the measured boxes with sizes from earlier frames. A whole track keeps its size.

        If only a part of a whole object is measured, its box is extended away from the sensor. If the whole
        object is measured for the first time, the track moves to its centre. This is not motion.
        """
        state = self._state
        first = whole & ~state.whole[rows]
        state.mean[rows[first], 0] += boxes.center[first] - seen.center[first]
        state.size[rows[first]], state.yaw[rows[first]] = boxes.size[first], boxes.yaw[first]
        state.whole[rows] |= whole
        part = np.flatnonzero(state.whole[rows] & ~whole)
        if len(part) == 0:
            return boxes
        center, size = boxes.center.copy(), boxes.size.copy()
        _, quarters = _turn(boxes.yaw[part], state.yaw[rows[part]])
        known = state.size[rows[part]]
        known[:, :2] = np.where((quarters % 2 == 1)[:, None], known[:, 1::-1], known[:, :2])
        yaw = boxes.yaw[part]
        ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
        for axis, direction in enumerate((ahead, np.stack([-ahead[:, 1], ahead[:, 0]], axis=1))):
            away = ((center[part, :2] - pose[:2, 3]) * direction).sum(axis=1)
            missing = np.maximum(known[:, axis] - size[part, axis], 0)
            behind = np.where(np.abs(away) > size[part, axis] / 2, np.sign(away) * missing / 2, 0)
            center[part, :2] += behind[:, None] * direction
            size[part, axis] += missing
        return Boxes3D(center, size, boxes.yaw)

    def _correct(self, rows: NDArray[Any], boxes: Boxes3D, config: TrackingConfig) -> F32:
        """Update with the measured boxes. Return the distances on the ground from the predictions.

        If a long object seems longer or shorter than before, its steadiest end counts as its motion. An
        offset beyond the gate moves the track without changing its speed.
        """
        state = self._state
        turn, quarters = _turn(boxes.yaw, state.yaw[rows])
        size = boxes.size.astype(np.float64)
        size[:, :2] = np.where((quarters % 2 == 1)[:, None], size[:, 1::-1], size[:, :2])
        axes = _axes(state.yaw[rows])
        offset = boxes.center - state.mean[rows, 0]
        along = (axes @ offset[:, :2, None])[:, :, 0]
        grown = (size - state.size[rows])[:, :2]
        side = _steadiest_side(along, grown, 2 * config.position_noise)
        side[state.size[rows, :2].max(axis=1) < LONG] = 0
        innovation = offset.copy()
        innovation[:, :2] += ((side * grown / 2)[:, None] @ axes)[:, 0]

        covariance = state.covariance[rows]
        gain = covariance[:, :, 0] / (covariance[:, :1, 0] + config.position_noise**2)
        gain[(innovation[:, :2] ** 2).sum(axis=1) > self._gate(config)[rows], 1] = 0
        state.mean[rows] += gain[:, :, None] * innovation[:, None]
        state.covariance[rows] = covariance - gain[:, :, None] * covariance[:, :1]
        smaller = state.split[rows, None] & (size < state.size[rows])  # the rest is in another cluster
        gains = np.where(smaller, 0, SHAPE_GAIN)
        state.mean[rows, 0, :2] -= ((side * gains[:, :2] * grown / 2)[:, None] @ axes)[:, 0]

        state.yaw[rows] += SHAPE_GAIN * turn
        state.size[rows] += gains * (size - state.size[rows])
        velocity = state.mean[rows, 1]
        backwards = np.cos(state.yaw[rows] - np.arctan2(velocity[:, 1], velocity[:, 0])) < 0
        state.yaw[rows] += np.pi * (backwards & (np.hypot(*velocity[:, :2].T) > HEADING_SPEED))
        return np.asarray(np.hypot(innovation[:, 0], innovation[:, 1]), np.float32)

    def _merge(
        self, cluster: NDArray[Any], named: I32, innovation: F32, config: TrackingConfig
    ) -> tuple[NDArray[Any], I32, F32, Bool]:
        """Make one of tracks that share the box of a vehicle: the oldest one that is confirmed survives.

        A younger track that is seen beside the older one goes on, so that its cluster has a track, but
        is not shown. If the older one is not seen, it continues as the younger one. People and others who
        are shorter than a vehicle and have another name stay.

        Returns:
            The clusters, objects and innovations of the remaining tracks, and which of them are shown.
        """
        state = self._state
        shown = (state.sightings >= config.min_hits) & (state.votes.sum(1) >= LEAST_VOTE)
        length = state.size[:, :2].max(axis=1)
        hosts = np.flatnonzero(shown & (length >= LONG))
        boxes = self._boxes()
        iou, share = bev_iou_and_share(boxes.chosen(hosts), boxes)
        best = state.votes.argmax(1) if len(self._classes) else np.zeros(len(state), np.int64)
        alike = (best[hosts, None] == best) | (state.sightings == 0) | (length >= LONG)
        doubles = (share >= SAME_OBJECT) & alike & (hosts[:, None] < np.arange(len(state)))
        ended = np.zeros(len(state), np.bool_)
        before = state.doubled.copy()
        state.doubled[:] = np.clip(before - 1, 0, 2 * config.min_hits)
        for young in np.flatnonzero(doubles.any(axis=0)).tolist():
            older = np.flatnonzero(doubles[:, young] & shown[hosts] & ~ended[hosts])
            doubled = before[young] + (1 if len(older) else -1)
            state.doubled[young] = min(max(doubled, 0), 2 * config.min_hits)
            if len(older) == 0 or doubled < config.min_hits:
                continue
            shown[young] = False
            near = older[iou[older, young].argmax()]
            old = hosts[near]
            if cluster[old] < 0 <= cluster[young] and iou[near, young] >= SAME_PLACE:
                for values in (state.mean, state.covariance, state.size, state.whole, state.yaw, state.seen):
                    values[old] = values[young]
                for results in (cluster, named, innovation, state.trail[:, -1]):
                    results[old] = results[young]
                ended[young] = True
            elif cluster[young] < 0:
                ended[young] = True
        self._state = state.chosen(~ended)
        return cluster[~ended], named[~ended], innovation[~ended], shown[~ended]

    def _gate(self, config: TrackingConfig) -> F64:
        """Return the (T,) squared distances on the ground within which an object may have moved."""
        return np.maximum(config.gate**2, 9 * (self._state.covariance[:, 0, 0] + config.position_noise**2))

    def _boxes(self) -> Boxes3D:
        """Return the boxes of the tracks."""
        state = self._state
        yaw = np.arctan2(np.sin(state.yaw), np.cos(state.yaw))
        return Boxes3D(*(a.astype(np.float32) for a in (state.mean[:, 0], state.size, yaw)))

    def _remember(self, stamp: int, config: TrackingConfig) -> None:
        """Append the positions to the trails, and drop those older than ``config.trail``."""
        self._stamps.append(stamp)
        state = self._state
        here = state.mean[:, :1].astype(np.float32)
        recent = np.array(self._stamps) >= stamp - config.trail * 1e9
        recent[-1] = True
        state.trail = np.concatenate([state.trail, here], axis=1)[:, recent]
        self._stamps = [s for s, kept in zip(self._stamps, recent, strict=True) if kept]

    def _vote(
        self, cluster: NDArray[Any], in_view: Bool, objects: Objects | None, dt: float, config: TrackingConfig
    ) -> I32:
        """Add the scores of this frame's objects. Return the (T,) object of each track, -1 for none."""
        state = self._state
        looked_at = np.append(in_view, False)[cluster]
        state.votes[looked_at] *= np.exp(-dt / config.class_memory)
        named = np.full(len(state), -1, np.int32)
        if objects is None or len(objects) == 0:
            return named
        new = sorted(set(objects.names) - set(self._classes))
        self._classes += new
        state.votes = np.hstack([state.votes, np.zeros((len(state), len(new)))])
        row_of = {int(k): row for row, k in enumerate(cluster) if k >= 0}
        for j, (name, score, k) in enumerate(
            zip(objects.names, objects.score.tolist(), objects.cluster.tolist(), strict=True)
        ):
            if k in row_of:
                named[row_of[k]] = j
                state.votes[row_of[k], self._classes.index(name)] += score
        state.sightings += named >= 0
        return named

    def _tracks(
        self,
        stamp: int,
        place: tuple[str, bool],
        cluster: NDArray[Any],
        named: I32,
        innovation: F32,
        shown: Bool,
    ) -> Tracks:
        """Return the tracks of the current state."""
        state = self._state
        best = state.votes.argmax(1) if len(self._classes) else np.zeros(len(state), np.int64)
        return Tracks(
            frame_id=place[0],
            absolute=place[1],
            id=state.id.copy(),
            boxes=self._boxes(),
            velocity=state.mean[:, 1].astype(np.float32),
            age=((stamp - state.born) * 1e-9).astype(np.float32),
            coasting=((stamp - state.seen) * 1e-9).astype(np.float32),
            innovation=innovation,
            hits=state.hits.copy(),
            names=tuple(
                self._classes[c] if n else "" for c, n in zip(best.tolist(), state.sightings, strict=True)
            ),
            confirmed=shown,
            cluster=cluster.astype(np.int32),
            object=named,
            trail=state.trail,
        )


def _axes(yaw: F64) -> F64:
    """Return the (N, 2, 2) directions of the length and of the width on the ground."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([np.stack([c, s], axis=1), np.stack([-s, c], axis=1)], axis=1)


def _steadiest_side(along: F64, grown: F64, noise: float) -> F64:
    """Return the (N, 2) sides, -1 or 1, that moved less than the centre did, 0 for the centre.

    A box that is longer or shorter than before has another end, which is not motion: another part of the
    object is seen.

    Args:
        along: (N, 2) offsets of the centres.
        grown: (N, 2) differences of the sizes.
        noise: differences of the sizes up to here are noise.
    """
    moved = np.abs(np.stack([along - grown / 2, along, along + grown / 2]))
    return np.where(np.abs(grown) > noise, moved.argmin(axis=0) - 1.0, 0.0)


def _turn(measured: F32, expected: F64) -> tuple[F64, I64]:
    """Return how far rectangles are turned from the nearest of four headings, and which heading that is."""
    turn = measured - expected
    quarters = np.round(turn / (np.pi / 2)).astype(np.int64)
    return turn - quarters * (np.pi / 2), quarters


def _complete_boxes(
    seen: Boxes3D, kept: NDArray[Any], objects: Objects | None, pose: F64, gate: float
) -> tuple[Boxes3D, Bool]:
    """Replace boxes of clusters by whole boxes of objects where known.

    Boxes smaller than the gate stay as measured: their centres are accurate enough and steadier.

    Returns:
        The boxes, and which of them are whole.
    """
    whole = np.zeros(len(kept), np.bool_)
    if objects is None or objects.seen is None or not len(objects) or not len(kept):
        return seen, whole
    place = np.searchsorted(kept, objects.cluster)
    is_kept = np.append(kept, -2)[place] == objects.cluster
    large = np.flatnonzero(is_kept & (objects.boxes.size[:, :2].max(axis=1) > gate))
    named = _move_boxes(objects.boxes, large, pose)
    boxes = Boxes3D(seen.center.copy(), seen.size.copy(), seen.yaw.copy())
    rows = place[large]
    boxes.center[rows], boxes.size[rows], boxes.yaw[rows] = named.center, named.size, named.yaw
    whole[rows] = True
    return boxes, whole


def _move_boxes(boxes: Boxes3D, rows: NDArray[Any], pose: F64) -> Boxes3D:
    """Move upright boxes into another upright frame."""
    return geometry.transform_boxes(boxes.chosen(rows), pose)
