"""How well objects keep their ids and speeds: CLEAR MOT, IDF1 and speed errors against exact truth."""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass, field, replace

import numpy as np

from bevviz.extras.demo.drive import START, Snapshot, SyntheticSource
from bevviz.model import box_overlap, geometry
from bevviz.model.frame import F32, F64, I32, Bool, Boxes3D, Frame
from bevviz.model.results import Tracks
from bevviz.stages.fusion import assign

MAX_DISTANCE = 2.0  # metres between the centres, on the ground plane, of a track and its object
SETTLED = 1.0  # seconds from which on a track's speed is measured

Key = tuple[int, int]  # drive, number of the object or id of the track


@dataclass
class TrackTally:
    """One class, over any number of drives.

    MOTA after Bernardin and Stiefelhagen (2008): what was matched stays matched while it is near enough,
    the rest is assigned anew. IDF1 after Ristani et al. (2016): each object with the one track that was on it
    most.
    """

    counts: Counter[str] = field(default_factory=Counter)
    together: Counter[tuple[Key, Key]] = field(default_factory=Counter)  # object, track -> frames
    speeds: list[float] = field(default_factory=list)  # errors, m/s
    _last: dict[Key, Key] = field(default_factory=dict)  # object -> the track it had

    def add(self, seed: int, tracks: Tracks, rows: list[int], truth: Truth, of_class: list[int]) -> None:
        """One frame: these rows of the tracks, and these of the truth, are of the class."""
        offset = tracks.boxes.center[rows][:, None, :2] - truth.center[of_class][None, :, :2]
        distance = np.linalg.norm(offset, axis=2).astype(np.float64)
        cost = np.where(distance <= MAX_DISTANCE, distance, np.inf)
        tracked = [(seed, int(tracks.id[t])) for t in rows]
        objects = [(seed, int(truth.number[r])) for r in of_class]
        for j, key in enumerate(objects):
            before = self._last.get(key)
            if before in tracked and np.isfinite(cost[tracked.index(before), j]):
                cost[tracked.index(before), j] = -1.0
        column = assign(cost, unmatched=MAX_DISTANCE + 1) if len(objects) else np.full(len(rows), -1)
        missing = {j for j, r in enumerate(of_class) if truth.must[r]}
        for row, (t, j) in enumerate(zip(rows, column.tolist(), strict=True)):
            if j < 0:
                self.counts["fp"] += 1
                continue
            self.counts["switches"] += self._last.get(objects[j], tracked[row]) != tracked[row]
            self._last[objects[j]] = tracked[row]
            if j not in missing:
                continue
            missing.remove(j)
            self.counts["tp"] += 1
            self.together[objects[j], tracked[row]] += 1
            if tracks.age[t] >= SETTLED:
                error = tracks.velocity[t, :2] - truth.velocity[of_class[j], :2]
                self.speeds.append(float(np.hypot(*error)))
        self.counts["fn"] += len(missing)

    @property
    def mota(self) -> float:
        c = self.counts
        return 1 - (c["fp"] + c["fn"] + c["switches"]) / max(c["tp"] + c["fn"], 1)

    @property
    def idf1(self) -> float:
        objects, tracks = (sorted({pair[i] for pair in self.together}) for i in (0, 1))
        frames = np.zeros((len(objects), len(tracks)))
        for (thing, track), count in self.together.items():
            frames[objects.index(thing), tracks.index(track)] = count
        column = assign(-frames, unmatched=0.0) if len(tracks) else np.zeros(0, np.int32)
        kept = float(sum(frames[row, c] for row, c in enumerate(column.tolist()) if c >= 0))
        c = self.counts
        return 2 * kept / max(2 * c["tp"] + c["fn"] + c["fp"], 1)


@dataclass(frozen=True)
class Truth:
    """Where the objects are in the fixed frame, and how they move."""

    center: F32  # (K, 3)
    velocity: F64  # (K, 3)
    number: I32  # (K,)
    labels: tuple[str, ...]
    must: Bool  # (K,)


def truth_of(source: SyntheticSource, shot: Snapshot, must: Bool) -> Truth:
    """Of a snapshot, with exact velocities. ``must``: (K,) what has to be found."""
    stated, time = shot.frame.truth, (shot.frame.stamp - START) * 1e-9
    assert stated is not None and stated.world_from_boxes is not None
    world, step = source.world, 0.05
    actors = {actor.number: actor for actor in world.actors}
    places = [
        [actors[number].pose(world.street, time + sign * step)[:3, 3] for sign in (-1, 1)]
        for number in shot.truth_object.tolist()
    ]
    ends = np.array(places).reshape(-1, 2, 3)
    velocity = (ends[:, 1] - ends[:, 0]) / (2 * step)
    center = geometry.apply(stated.world_from_boxes, stated.boxes.center)
    return Truth(center, velocity, shot.truth_object, stated.labels, must)


def without_pose(frame: Frame) -> Frame:
    """Return a frame of the synthetic drive as if nothing stated the robot's motion."""
    points_from_world = geometry.inverse(frame.pose)
    cameras = []
    for camera in frame.cameras:
        assert camera.world_from_camera is not None
        cameras.append(replace(camera, world_from_camera=points_from_world @ camera.world_from_camera))
    truth = None if frame.truth is None else replace(frame.truth, world_from_boxes=np.eye(4))
    frame = replace(frame, world_frame=frame.points_frame, world_from_points=None)
    return replace(frame, cameras=tuple(cameras), truth=truth)


def moved(truth: Truth, world_from_map: F64) -> Truth:
    """Return the truth in another world."""
    velocity = truth.velocity @ world_from_map[:3, :3].T
    return replace(truth, center=geometry.apply(world_from_map, truth.center), velocity=velocity)


Tallies = defaultdict[str, TrackTally]  # by class


def add_tracks(tallies: Tallies, seed: int, tracks: Tracks, truth: Truth) -> None:
    """Tracks that are shown and seen in this frame, whether or not the detector names them in it."""
    shown = tracks.confirmed & (tracks.cluster >= 0)
    for name in set(truth.labels) | set(tracks.names):
        rows = [t for t in np.flatnonzero(shown).tolist() if tracks.names[t] == name]
        of_class = [r for r, label in enumerate(truth.labels) if label == name]
        tallies[name].add(seed, tracks, rows, truth, of_class)


class IdentityCounter:
    """Counts, without truth, boxes that change their id and boxes shared by two tracks."""

    def __init__(self) -> None:
        self.shown = self.switches = self.doubles = 0
        self._last = (Boxes3D.empty(), np.zeros(0, np.int64))

    def add(self, tracks: Tracks) -> None:
        """Add the next frame."""
        rows = np.flatnonzero(tracks.confirmed & (tracks.cluster >= 0))
        boxes, ids = tracks.boxes.chosen(rows), tracks.id[rows]
        overlap = box_overlap.bev_iou(self._last[0], boxes)
        self.shown += len(rows)
        self.switches += int(((overlap > 0.3) & (self._last[1][:, None] != ids)).sum())
        self._last = boxes, ids
        every = tracks.boxes.chosen(np.flatnonzero(tracks.confirmed))
        self.doubles += int(np.triu(box_overlap.bev_iou(every, every) > 0.3, 1).sum())
