"""Brings clouds, images, transforms and boxes of one time together into frames; the LiDAR drives."""

from __future__ import annotations

import math
import re
from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevviz import geometry
from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.frame import (
    F32,
    F64,
    Camera,
    Cloud,
    Frame,
    Image,
    Intrinsics,
    LabelledBoxes2D,
    LabelledBoxes3D,
    LateResult,
)
from bevviz.ros.messages import StampedTransform
from bevviz.ros.roles import CameraRole, Roles, entity_name
from bevviz.sync.around import Surroundings
from bevviz.sync.clocks import Clocks
from bevviz.sync.report import SyncReport
from bevviz.sync.tf import Lookup, Origin, TransformError
from bevviz.sync.track import JUMP, Track
from bevviz.sync.upright import Upright
from bevviz.sync.video import Video

SECOND = 1_000_000_000
LATENCY = 2 * SECOND  # the longest a cloud is expected to arrive after an image of the same stamp
FIXED_FRAMES = {"map", "odom", "world", "earth", "global", "utm", "enu", "ned", "mocap", "vicon", "init"}
FAR = 500.0  # metres that no LiDAR has half of its points beyond
OVERTAKEN = 64  # results and frames that late results are placed by
GLOBE_FRAMES = {"earth", "ecef", "utm"}  # coordinates too large for the float32 of a viewer
TUTORIAL_K = np.array([[267.0, 0.0, 320.0], [0.0, 267.0, 180.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, slots=True)
class _Undecoded:
    """The header of an image, and how to get the rest."""

    stamp: int
    frame_id: str
    load: Callable[[], Image]


@dataclass(frozen=True, slots=True)
class _UndecodedBoxes:
    """When boxes were, and how to get them."""

    stamp: int
    load: Callable[[], LabelledBoxes3D]


@dataclass(frozen=True, slots=True)
class _Place:
    """Where the points of a frame are, and how they hang together with the world."""

    stamp: int
    points_frame: str
    world_frame: str  # "" where there is none
    inertial_frame: str  # the smoothest fixed frame, to compensate motion with; "" where there is none
    upright: F64 | None = None  # (4, 4) points from points_frame; None: it is upright
    world_from_points: F64 | None = None
    tf_age: float = float("nan")

    def points_from(self, frame: Lookup) -> Lookup:
        """Of what was looked up in ``points_frame``."""
        return frame if self.upright is None else replace(frame, matrix=self.upright @ frame.matrix)

    def from_points(self, matrix: F64) -> F64:
        """The same the other way round."""
        return matrix if self.upright is None else matrix @ geometry.inverse(self.upright)


class Synchronizer:
    """Bounded in memory; the same for a bag and a live robot. Messages come in the order of receipt.

    A cloud waits until each camera has an image of its stamp or later and the transforms reach as far,
    at most ``sync.max_wait`` seconds of received time, and in a queue of ``sync.queue``. Clouds out of
    order within the queue are put back in order; later ones are dropped, and all of it is counted.

    Args:
        roles: which topic is what.
        config: tolerances and queues.
        beside: topics of the robot's boxes that no frame waits for: what comes too late for its frame is to
            be had from ``overtaken``.

    Attributes:
        followed: the frame that odometry places.
        skims: remember what a frame leaves behind, and do not make it: somebody else does. The frames have
            their numbers and stamps then, and what they would have complained of is not counted.
    """

    def __init__(self, roles: Roles, config: Config, beside: Collection[str] = ()) -> None:
        self.report = SyncReport()
        self.followed = ""
        self.skims = False
        self.absent: frozenset[str] = frozenset()  # topics that nobody publishes now: not waited for
        self.tf = self.report.tf
        self.upright = Upright(self.tf, config.source.base_frame, config.sync.tf_tolerance)
        self.report.upright = self.upright.warnings
        self.around = Surroundings()
        self.clocks = self.report.clocks = Clocks(config.sync.offsets, config.sync.by)
        self.report.clocked = (*roles.lidars, *(c.topic for c in roles.cameras), *roles.tf)
        self._roles = roles
        self._config = config
        self._tolerance = round(config.sync.tolerance * 1e9)
        self._wait = round(config.sync.max_wait * 1e9)
        self._horizon = self._wait + self._tolerance + LATENCY
        self._now = 0
        self._clouds: list[Cloud] = []  # of the driving LiDAR, in order of stamp
        self._done: deque[Frame] = deque()
        self._index = 0
        self._last: int | None = None  # stamp of the last frame
        self._step = math.inf  # nanoseconds between the last two clouds; a gap is much longer
        self._partners: dict[str, Track[Cloud]] = self._make_tracks(*roles.lidars[1:])
        self.videos: dict[str, Video] = {}  # by topic
        self._images: dict[str, Track[_Undecoded]] = self._make_tracks(*(c.topic for c in roles.cameras))
        self._lidar_frames: dict[str, str] = {}  # cloud topic -> frame
        self._camera_frames: dict[str, str] = {}  # image topic -> optical frame
        self.intrinsics: dict[str, Intrinsics] = {}  # CameraInfo topic -> the newest
        self._infos: dict[str, Track[Intrinsics]] = {}  # by topic
        self._refused_infos: dict[str, str] = {}  # topic -> why its calibration cannot be used
        self._info_counts: Counter[str] = Counter()
        self._image_counts: Counter[str] = Counter()
        self._odometry_frames: set[str] = set()
        self._boxes: dict[str, Track[LabelledBoxes3D]] = self._make_tracks(*roles.robot_detections_3d)
        self._detections: dict[str, Track[LabelledBoxes2D]] = self._make_tracks(*roles.robot_detections_2d)
        self._robot_clouds: dict[str, Track[Cloud]] = self._make_tracks(*roles.robot_clouds)
        self._truth: dict[str, Track[_UndecodedBoxes]] = self._make_tracks(*filter(None, [roles.truth]))
        self._beside = frozenset(beside)
        self._overtaken: deque[LateResult] = deque(maxlen=OVERTAKEN)
        self._places: deque[tuple[_Place, F64]] = deque(
            maxlen=OVERTAKEN
        )  # of the last frames, and their poses
        for names, pose in config.source.extrinsics.items():
            self.tf.add(_extrinsic(names, pose), static=True, origin=Origin.CONFIG)

    def _make_tracks(self, *topics: str) -> dict[str, Track[Any]]:
        return {topic: Track(self._horizon) for topic in topics}

    def take_over(self, former: Synchronizer) -> None:
        """Go on with the transforms, calibrations and counts of ``former``, when the roles change."""
        clocked = self.report.clocked
        self.report, self.absent = former.report, former.absent
        self.report.clocked = clocked
        self.tf, self.upright, self.clocks = former.tf, former.upright, former.clocks
        self.around, self.videos = former.around, former.videos
        self.intrinsics, self._infos = former.intrinsics, former._infos
        self._refused_infos = former._refused_infos
        self._odometry_frames = former._odometry_frames
        self._overtaken, self._places = former._overtaken, former._places

    # --- what comes in -------------------------------------------------------------------------

    def add_cloud(self, cloud: Cloud) -> None:
        """A scan of a LiDAR, told by ``cloud.topic``."""
        if cloud.topic not in self._roles.lidars:
            return
        stamp = self._arrived(cloud.topic, cloud.stamp, cloud.received)
        cloud = replace(cloud, stamp=stamp, name=self._lidar_name(cloud))
        self._lidar_frames[cloud.topic] = cloud.frame_id.lstrip("/")
        self._check_units(cloud)
        self.report.clouds += 1
        if cloud.topic in self._partners:
            self._partners[cloud.topic].add(cloud.stamp, cloud)
            return
        self._drive(cloud)

    def _drive(self, cloud: Cloud) -> None:
        """A frame for a cloud of the driving LiDAR."""
        self._watch_clock(cloud.stamp)
        stamps = [waiting.stamp for waiting in self._clouds]
        place = bisect_left(stamps, cloud.stamp)
        if cloud.stamp == self._last or cloud.stamp in stamps:
            self.report.duplicates += 1
        elif self._last is not None and cloud.stamp < self._last:
            self.report.late += 1
        else:
            self.report.reordered += place < len(stamps)
            self._clouds.insert(place, cloud)

    def add_image(
        self, topic: str, stamp: int, frame_id: str, received: int, load: Callable[[], Image]
    ) -> None:
        """An image not yet decoded: ``load`` is called only when a frame takes it.

        ``load`` may raise a UserError, which becomes a problem of that frame's camera.
        """
        if topic in self._images:
            stamp = self._arrived(topic, stamp, received)
            self._camera_frames[topic] = frame_id
            self._image_counts[topic] += 1
            self._images[topic].add(stamp, _Undecoded(stamp, frame_id, load))
            if topic == self._roles.driver:  # there is no LiDAR
                self.report.clouds += 1
                self._drive(Cloud(stamp, frame_id, np.zeros((0, 3), np.float32), {}, topic, received))

    def add_camera_info(self, topic: str, intrinsics: Intrinsics, stamp: int, received: int) -> None:
        """``topic`` is that of the CameraInfo; for an image the one that is nearest in stamp holds."""
        self.intrinsics[topic] = intrinsics
        self._info_counts[topic] += 1
        track = self._infos.setdefault(topic, Track(self._horizon))
        track.add(self._arrived(topic, stamp, received), intrinsics)

    def refuse_camera_info(self, topic: str, reason: str) -> None:
        """A calibration that cannot be used; the reason is that of the camera where there is no other."""
        self._refused_infos[topic] = reason

    def add_transform(
        self, transform: StampedTransform, static: bool = False, fallback: bool = False, held: bool = False
    ) -> None:
        """``fallback``: from Odometry, used only where nothing else states the child's parent.

        ``held``: what is stated once holds until there is more.
        """
        if fallback:
            self._odometry_frames.add(transform.parent.lstrip("/"))
        self.tf.add(transform, static, Origin.ODOMETRY if fallback else Origin.TF, held)

    def add_boxes(self, boxes: LabelledBoxes3D) -> None:
        """The robot's own 3D boxes."""
        self._add_result(self._boxes, boxes)

    def add_detections(self, detections: LabelledBoxes2D) -> None:
        """The robot's own image boxes."""
        self._add_result(self._detections, detections)

    def add_robot_cloud(self, cloud: Cloud) -> None:
        """The robot's own points without the ground."""
        stamp = self._arrived(cloud.topic, cloud.stamp, cloud.received)
        self._robot_clouds[cloud.topic].add(stamp, replace(cloud, stamp=stamp))

    def add_truth(self, topic: str, stamp: int, received: int, load: Callable[[], LabelledBoxes3D]) -> None:
        """Ground truth not yet decoded: ``load`` is called only when a frame takes it.

        ``load`` may raise a UserError: it is counted, and the boxes are as if they had not come.
        """
        stamp = self._arrived(topic, stamp, received)
        self._truth.setdefault(topic, Track(self._horizon)).add(stamp, _UndecodedBoxes(stamp, load))

    def _add_result(self, tracks: dict[str, Track[Any]], result: LabelledBoxes2D | LabelledBoxes3D) -> None:
        stamp = self._arrived(result.topic, result.stamp, result.received)
        result = replace(result, stamp=stamp)
        if result.topic in self._beside and self._is_past(stamp):
            self._overtake(result)
        else:
            tracks.setdefault(result.topic, Track(self._horizon)).add(stamp, result)

    def _is_past(self, stamp: int) -> bool:
        """Whether the frame that is nearest to a stamp has gone on."""
        if self._last is None:
            return False
        after = self._clouds[0].stamp if self._clouds else self._last + self._step
        return stamp <= min(self._last + self._tolerance, (self._last + after) / 2)

    def _overtake(self, result: LabelledBoxes2D | LabelledBoxes3D) -> None:
        """Place a result of the robot's where no frame takes it."""
        self.report.overtaken[result.topic] += 1
        late = (result.received - result.stamp) * 1e-9
        self.report.slowest[result.topic] = max(self.report.slowest.get(result.topic, late), late)
        if not self._places:
            return
        place, pose = min(self._places, key=lambda at: abs(at[0].stamp - result.stamp))
        if isinstance(result, LabelledBoxes3D):
            result = self._placed(result, place, [])
        elif not result.camera:
            names = {self._camera_frames.get(role.topic): role.name for role in self._roles.cameras}
            result = replace(result, camera=names.get(result.frame_id, ""))
        self._overtaken.append(LateResult(result, place.stamp, pose))

    def overtaken(self) -> tuple[LateResult, ...]:
        """The robot's results that no frame has taken, since the last call."""
        found = tuple(self._overtaken)
        self._overtaken.clear()
        return found

    def _arrived(self, topic: str, stamp: int, received: int) -> int:
        """The stamp to go by."""
        self._now = received
        if stamp == 0:
            self.report.unstamped[topic] += 1
            return received
        return self.clocks.stamp(topic, stamp, received)

    def _check_units(self, cloud: Cloud) -> None:
        """In millimetres nothing is within the reach of any stage, and nothing would be said."""
        if cloud.topic not in self.report.oddities and len(cloud.xyz):
            x, y, z = np.abs(cloud.xyz[::16]).T  # their maximum, faster than by row
            middle = float(np.median(np.maximum(np.maximum(x, y), z)))
            if middle > FAR:
                self.report.oddities[cloud.topic] = (
                    f"{cloud.topic}: half of its points are farther than {middle:,.0f} m, as coordinates in "
                    f"millimetres are; a PointCloud2 is in metres (REP 103): correct its driver"
                )

    def _watch_clock(self, stamp: int) -> None:
        newest = self._clouds[-1].stamp if self._clouds else self._last
        if newest is None:
            return
        step = stamp - newest
        if step < -JUMP:
            self._reset(stamp)
        elif step > max(JUMP, 3 * self._step):
            self.report.gaps += 1
            self.report.longest_gap = max(self.report.longest_gap, step * 1e-9)
        if step > 0:
            self._step = step

    def _reset(self, stamp: int) -> None:
        """The clock went back to ``stamp``: a bag played in a loop, or a simulation restarted."""
        self.report.resets += 1
        self._done.extend(self._build_all())
        self._last = None
        self.tf.forget_after(stamp + JUMP)
        for _, track in self._tracks():
            track.keep(0, stamp + JUMP)

    def _tracks(self) -> Iterator[tuple[str, Track[Any]]]:
        """Topic and messages."""
        groups: tuple[Mapping[str, Track[Any]], ...] = (
            self._partners,
            self._images,
            self._boxes,
            self._detections,
            self._robot_clouds,
            self._truth,
        )
        for group in groups:
            yield from group.items()

    def lacking(self) -> Iterator[str]:
        """What keeps frames from being whole so far, and may still come: calibrations and transforms."""
        lidar = next(iter(self._lidar_frames.values()), "")
        for camera in self._roles.cameras:
            if camera.info_topic and camera.info_topic not in self.intrinsics:
                yield f"no CameraInfo on {camera.info_topic} yet"
            frame = self._camera_frames.get(camera.topic, "")
            if self._roles.tf_static + self._roles.tf and frame and lidar and not self.tf.knows(lidar, frame):
                yield f"no transform from '{lidar}' to '{frame}' yet"
        moving = self._roles.tf or self._roles.odometry
        if moving and lidar and not self._fixed(lidar)[0]:
            yield f"no transform from '{lidar}' to a frame that stands still yet"

    # --- what goes out -------------------------------------------------------------------------

    def ready(self, now: int | None = None) -> Iterator[Frame]:
        """The frames, in order of stamp, that have all they wait for, or have waited long enough.

        ``now``: newest received time in nanoseconds; None: that of the last message added. Call it
        after every message, or every few: what is not fetched is held.
        """
        if now is not None:
            self._now = now
        while self._done:
            yield self._done.popleft()
        while self._clouds:
            over = self._now - self._clouds[0].received > self._wait
            if not over and not self._complete():
                if len(self._clouds) <= self._config.sync.queue:
                    return
                self.report.unwaited += 1
            yield self._build()

    def flush(self) -> Iterator[Frame]:
        """The frames still held, at the end of the stream."""
        while self._done:
            yield self._done.popleft()
        yield from self._build_all()
        if self.report.clouds and not self.report.frames:
            self.report.idle = self._roles.driver

    def _build_all(self) -> Iterator[Frame]:
        while self._clouds:
            yield self._build()

    def _complete(self) -> bool:
        """Whether nothing that may still come could change the oldest cloud's frame."""
        stamp = self._clouds[0].stamp
        beside = self.absent | self._beside
        waited = [track for topic, track in self._tracks() if topic not in beside]
        if any(track.newest is None or track.newest < stamp for track in waited):
            return False
        groups: tuple[Mapping[str, Track[Any]], ...] = (
            self._boxes,
            self._detections,
            self._robot_clouds,
            self._truth,
        )
        results = [track for group in groups for topic, track in group.items() if topic not in self._beside]
        if len(self._clouds) == 1 and any(self._may_be_of_next(track, stamp) for track in results):
            return False
        infos = {camera.info_topic for camera in self._roles.cameras} - {""}
        if infos - self.absent - self.intrinsics.keys():
            return False
        if not all(self._info_reaches(camera, stamp) for camera in self._roles.cameras):
            return False
        lacking = not self.absent.isdisjoint((*self._roles.tf, self._roles.odometry))
        return lacking or self._transforms_reach(self._clouds[0])

    def _info_reaches(self, role: CameraRole, stamp: int) -> bool:
        """Whether the calibration of the image of this time has come, where each image has one of its own."""
        track, image = self._infos.get(role.info_topic), self._images[role.topic].nearest(stamp)
        if track is None or track.newest is None or image is None or role.info_topic in self.absent:
            return True
        one_each = self._info_counts[role.info_topic] * 2 > self._image_counts[role.topic] > 1
        return not one_each or track.newest >= image[0]

    def _may_be_of_next(self, track: Track[Any], stamp: int) -> bool:
        nearest = track.nearest(stamp)
        return nearest is not None and 0 < nearest[0] - stamp <= self._tolerance

    def _transforms_reach(self, cloud: Cloud) -> bool:
        """Whether the transforms have samples up to the cloud and to all that it is joined with."""
        place = self._place(cloud)
        moving = self._roles.tf or self._roles.odometry
        if moving and not place.world_frame:
            return False
        asked = [(cloud.stamp, cloud.frame_id)]
        joined: list[Track[Any]] = [*self._images.values(), *self._partners.values()]
        for track in joined:
            nearest = track.nearest(cloud.stamp)
            if nearest is not None and abs(nearest[0] - cloud.stamp) <= self._tolerance:
                asked.append((max(nearest[0], cloud.stamp), nearest[1].frame_id))
        anchors = {place.points_frame, place.world_frame or place.points_frame}
        if self._partners:
            anchors.add(self._config.source.base_frame)
        try:
            ends = [(self.tf.latest(anchor, frame), stamp) for stamp, frame in asked for anchor in anchors]
        except TransformError:
            return False
        return all(end is None or end >= stamp for end, stamp in ends)

    # --- one frame -----------------------------------------------------------------------------

    def _build(self) -> Frame:
        cloud = self._clouds.pop(0)
        problems: list[str] = []
        if self.skims:
            counted, self.report.problems = self.report.problems, Counter()
            place = self._place(cloud, problems)
            self.report.problems = counted
            return self._passed(place, self._skimmed(cloud, place))
        place = self._place(cloud, problems)
        clouds, poses = self._gather(cloud, place, problems)
        in_place = place.upright is None and cloud.frame_id.lstrip("/") == place.points_frame
        points, fields = _merge(clouds, poses, in_place)
        cameras = tuple(self._camera(role, place) for role in self._roles.cameras)
        first, last = self._window(cloud.stamp)
        boxes = [track.take(cloud.stamp, first, last) for track in self._boxes.values()]
        placed = [self._placed(b, place, problems) for b in boxes if b is not None]
        truth = self._taken_truth(cloud.stamp, first, last)
        frame = Frame(
            index=self._index,
            stamp=cloud.stamp,
            received=cloud.received,
            lidar="lidars" if self._partners else cloud.name,
            points=points,
            points_frame=place.points_frame,
            upright=place.upright,
            fields=fields,
            world_frame=place.world_frame or place.points_frame,
            world_from_points=place.world_from_points,
            clouds=clouds,
            points_from_clouds=poses,
            cameras=cameras,
            robot_boxes=tuple(placed),
            robot_detections=self._robot_detections(cameras, cloud.stamp, first, last),
            robot_clouds=self._taken_clouds(place, first, last, problems),
            truth=None if truth is None else self._placed(truth, place, problems),
            tf_age=place.tf_age,
            problems=tuple(problems),
            around=self.around.take(lambda name: self._world_from(place, name)),
        )
        return self._passed(place, frame)

    def _skimmed(self, cloud: Cloud, place: _Place) -> Frame:
        """Of a frame what is known at once. What belongs to it is taken, as in ``_build``."""
        window = self._window(cloud.stamp)
        groups: tuple[Mapping[str, Track[Any]], ...] = (
            self._boxes,
            self._truth,
            self._detections,
            self._robot_clouds,
        )
        for group in groups:
            for track in group.values():
                track.take(cloud.stamp, *window)
        self.around.take(lambda name: None)
        points, pose = np.zeros((0, 3), np.float32), place.world_from_points
        return Frame(
            self._index,
            cloud.stamp,
            cloud.received,
            cloud.name,
            points,
            place.points_frame,
            world_from_points=pose,
        )

    def _passed(self, place: _Place, frame: Frame) -> Frame:
        """The frame, from here on that of before."""
        last = self._window(frame.stamp)[1]
        self._index += 1
        self._last = frame.stamp
        self.report.frames += 1
        self._places.append((place, frame.pose))
        unused: tuple[Mapping[str, Track[Any]], ...] = (self._boxes, self._detections)
        for group in unused:
            for topic in self._beside & group.keys():
                for result in group[topic].shed(last):
                    self._overtake(result)
        for _, track in self._tracks():
            track.forget(frame.stamp - self._tolerance)
        return frame

    def _lidar_name(self, cloud: Cloud) -> str:
        names = dict(zip(self._roles.lidars, self._roles.lidar_names, strict=False))
        return names.get(cloud.topic) or entity_name(cloud.topic, cloud.frame_id)

    def _place(self, cloud: Cloud, problems: list[str] | None = None) -> _Place:
        """Find the frames of reference; with ``problems``, also where the points are in the world."""
        points_frame = cloud.frame_id.lstrip("/")
        base = self._config.source.base_frame
        if self._partners and self.tf.knows(base, points_frame):
            points_frame = base
        world, inertial = self._fixed(points_frame)
        place = _Place(cloud.stamp, points_frame, world, inertial)
        if problems is None:
            return place
        turn = self.upright.turn(cloud, world) if self._roles.lidars else None
        if points_frame == cloud.frame_id.lstrip("/"):
            place = replace(place, upright=turn)
        if self._partners and points_frame != base:
            self._complain(
                problems,
                f"no transform from '{points_frame}' to source.base_frame '{base}': "
                f"the LiDARs are merged in '{points_frame}'",
            )
        if not world and not self._roles.lidars:
            return place
        if not world:
            self.report.problems[
                f"no fixed frame (map, odom or the like) above '{points_frame}' in TF: motion is not "
                f"compensated; odometry is taken from source.odometry_topic"
            ] += 1
            return place
        try:
            found = self.tf.lookup(world, points_frame, cloud.stamp, self._config.sync.tf_tolerance)
        except TransformError as error:
            self._complain(problems, f"{error}: the cloud has no place in the world")
            return place
        return replace(place, world_from_points=place.from_points(found.matrix), tf_age=found.age)

    def _fixed(self, points_frame: str) -> tuple[str, str]:
        """The world's frame and the smoothest fixed frame above ``points_frame``; "" where there is none."""
        path = self.tf.ancestors(points_frame)
        fixed = [f for f in path if f in self._odometry_frames or _words(f) & FIXED_FRAMES]
        near = [f for f in fixed if not _words(f) & GLOBE_FRAMES] or fixed
        given = self._config.source.fixed_frame.lstrip("/")
        return given or (near[-1] if near else ""), near[0] if near else given

    def pose(self, frame: Frame, stamp: int) -> F64 | None:
        """(4, 4) smoothest fixed frame from points, as far as the transforms reach so far."""
        inertial = self._fixed(frame.points_frame)[1]
        if not inertial:
            return None
        try:
            found = self.tf.lookup(inertial, frame.points_frame, stamp, self._config.sync.tf_tolerance)
        except TransformError:
            return None
        return found.matrix if frame.upright is None else found.matrix @ geometry.inverse(frame.upright)

    def _gather(
        self, cloud: Cloud, place: _Place, problems: list[str]
    ) -> tuple[tuple[Cloud, ...], tuple[F64, ...]]:
        """The clouds of every LiDAR nearest to ``cloud``, each with points_from_cloud."""
        clouds, poses = [cloud], [np.eye(4) if place.upright is None else place.upright]
        if place.points_frame != cloud.frame_id.lstrip("/"):
            try:
                poses[0] = self._moved(place, cloud.stamp, cloud.frame_id)[0].matrix
            except TransformError as error:
                self._complain(problems, f"{error}: the points of {cloud.topic} stay where they are")
        for topic, track in self._partners.items():
            nearest = track.nearest(cloud.stamp)
            if nearest is None or abs(nearest[0] - cloud.stamp) > self._tolerance:
                problems.append(f"no cloud of LiDAR {topic} {self._nearest(nearest, cloud.stamp)}")
                continue
            partner = nearest[1]
            try:
                found, _ = self._moved(place, partner.stamp, partner.frame_id)
            except TransformError as error:
                self._complain(problems, f"{error}: the points of {topic} are left out")
                continue
            clouds.append(partner)
            poses.append(found.matrix)
        return tuple(clouds), tuple(poses)

    def _moved(self, place: _Place, stamp: int, frame: str) -> tuple[Lookup, bool]:
        """points at the cloud's stamp from ``frame`` at ``stamp``, and whether motion is compensated."""
        tolerance = self._config.sync.tf_tolerance
        if self._compensates(place):
            try:
                found = self.tf.lookup_moving(
                    place.points_frame, place.stamp, frame, stamp, place.inertial_frame, tolerance
                )
                return place.points_from(found), True
            except TransformError:
                pass  # without motion is the next best
        return place.points_from(self.tf.lookup(place.points_frame, frame, place.stamp, tolerance)), False

    def _compensates(self, place: _Place) -> bool:
        return self._config.sync.motion_compensation and bool(place.inertial_frame)

    def _camera(self, role: CameraRole, place: _Place) -> Camera:
        problems: list[str] = []
        image, stamp = self._image(role, place.stamp, problems)
        intrinsics = self._camera_intrinsics(role, image, stamp, problems)
        camera = Camera(role.name, image, intrinsics, None, None, problems=tuple(problems))
        if image is not None:
            camera = replace(camera, sync_error=(stamp - place.stamp) * 1e-9)
            off = self.clocks.apart(role.topic, self._roles.driver)
            if off:
                self._complain(
                    problems,
                    f"the clocks of camera '{role.name}' and the LiDAR are {abs(off):.2f} s apart: "
                    f"its image is of another time",
                )
                camera = replace(camera, problems=tuple(problems))
        frame = self._camera_frames.get(role.topic)
        if frame is None:
            return camera
        try:
            found, compensated = self._moved(place, stamp, frame)
        except TransformError as error:
            lacking = frame and place.points_frame and not self.tf.knows(place.points_frame, frame)
            self._complain(problems, f"{error}; source.extrinsics can state it" if lacking else str(error))
            return replace(camera, problems=tuple(problems))
        if image is not None and not compensated and self._compensates(place):
            self._complain(problems, f"no motion compensation: '{place.inertial_frame}' is out of reach")
        world = np.eye(4) if place.world_from_points is None else place.world_from_points
        first_from_camera = self._second_of_stereo(role, intrinsics, frame)
        points_from_camera = found.matrix @ first_from_camera
        mounting = self._mounting(place, frame) if compensated else None
        return replace(
            camera,
            camera_from_points=geometry.inverse(points_from_camera),
            world_from_camera=world @ points_from_camera,
            tf_age=found.age,
            motion_compensated=compensated,
            mounting=None if mounting is None else geometry.inverse(first_from_camera) @ mounting,
            problems=tuple(problems),
        )

    def _second_of_stereo(self, role: CameraRole, intrinsics: Intrinsics | None, frame: str) -> F64:
        """(4, 4) frame of the image from its camera: the second of a stereo pair is in the first one's.

        See P in sensor_msgs/CameraInfo. Many drivers give the second camera a frame of its own, and P all the
        same; then it is where TF says.
        """
        pose = np.eye(4)
        if intrinsics is None or intrinsics.baseline == (0.0, 0.0):
            return pose
        if any(there == frame for topic, there in self._camera_frames.items() if topic != role.topic):
            pose[:2, 3] = intrinsics.baseline
        else:
            self.report.oddities.setdefault(
                role.info_topic,
                f"{role.info_topic}: its P tells of a camera {math.hypot(*intrinsics.baseline):.3f} m beside "
                f"another one's frame; '{frame}' is taken as its own, as no other camera is in it",
            )
        return pose

    def _mounting(self, place: _Place, frame: str) -> F64 | None:
        """frame from points at the cloud's stamp, None where TF does not say."""
        try:
            found = self.tf.lookup(place.points_frame, frame, place.stamp, self._config.sync.tf_tolerance)
        except TransformError:
            return None
        return geometry.inverse(place.points_from(found).matrix)

    def _world_from(self, place: _Place, frame: str) -> F64 | None:
        """world from a frame at the cloud's stamp; None where TF does not say."""
        if not frame:
            return None
        from_points = self._mounting(place, frame)
        if from_points is None:
            return None
        world = np.eye(4) if place.world_from_points is None else place.world_from_points
        return world @ geometry.inverse(from_points)

    def _image(self, role: CameraRole, stamp: int, problems: list[str]) -> tuple[Image | None, int]:
        """The decoded image nearest to ``stamp``, and its stamp; without one, ``stamp``."""
        nearest = self._images[role.topic].nearest(stamp)
        if nearest is None or abs(nearest[0] - stamp) > self._tolerance:
            self.report.without_image[role.name] += 1
            problems.append(f"no image of camera '{role.name}' {self._nearest(nearest, stamp)}")
            return None, stamp
        try:
            image = replace(nearest[1].load(), stamp=nearest[0])
            self.report.images += 1
            return image, nearest[0]
        except UserError as error:
            self.report.undecodable[role.name] += 1
            self.report.first_undecodable.setdefault(role.name, str(error))
            problems.append(str(error))
            return None, stamp

    def _nearest(self, nearest: tuple[int, Any] | None, stamp: int) -> str:
        within = f"within {self._tolerance * 1e-9:.2f} s"
        if nearest is None:
            return f"{within}: none at all around this time"
        away = (nearest[0] - stamp) * 1e-9
        return f"{within}: nearest is {abs(away):.2f} s {'later' if away > 0 else 'earlier'}"

    def _camera_intrinsics(
        self, role: CameraRole, image: Image | None, stamp: int, problems: list[str]
    ) -> Intrinsics | None:
        infos = self._infos.get(role.info_topic)
        nearest = None if infos is None else infos.nearest(stamp)
        intrinsics = None if nearest is None else nearest[1]
        if intrinsics is not None and image is not None:
            return self._fitted(role, intrinsics, image, problems)
        if intrinsics is not None:
            return intrinsics
        missing = f"no CameraInfo on {role.info_topic}" if role.info_topic else "no CameraInfo topic"
        if self._config.preset == "reference":
            self._complain(problems, f"{missing} yet: using fx = fy = 267, cx 320, cy 180 of the reference")
            height, width = image.bgr.shape[:2] if image is not None else (360, 640)
            return Intrinsics(width, height, TUTORIAL_K, assumed=True)
        if role.info_topic in self._refused_infos:
            self._complain(problems, self._refused_infos[role.info_topic])
            return None
        others = [topic for topic in self._roles.camera_infos if topic != role.info_topic]
        setting = f"source.camera_info_topics='{{{role.topic}: {others[0]}}}'" if others else ""
        helps = f"name the topic with --set {setting}" if setting else "record one"
        self._complain(
            problems, f"{missing} for camera '{role.name}': nothing can be projected into it; {helps}"
        )
        return None

    def _fitted(
        self, role: CameraRole, intrinsics: Intrinsics, image: Image, problems: list[str]
    ) -> Intrinsics | None:
        """The intrinsics for the image's own size."""
        height, width = image.bgr.shape[:2]
        if (width, height) == (intrinsics.width, intrinsics.height):
            return intrinsics
        if not intrinsics.width or not intrinsics.height:  # many drivers leave them empty
            return replace(intrinsics, width=width, height=height)
        sx, sy = width / intrinsics.width, height / intrinsics.height
        if abs(sx / sy - 1) > 0.01:
            self._complain(
                problems,
                f"CameraInfo on {role.info_topic} is for {intrinsics.width} x {intrinsics.height} pixels, "
                f"the image has {width} x {height}: nothing can be projected into it",
            )
            return None
        # Pixel (0, 0) is the centre of the corner pixel, so that the corner itself is at -0.5.
        scale = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]])
        return replace(intrinsics, width=width, height=height, K=scale @ intrinsics.K)

    def _window(self, stamp: int) -> tuple[int, int]:
        """The stamps that are nearer to this cloud than to its neighbours, within the tolerance."""
        first, last = stamp - self._tolerance, stamp + self._tolerance
        if self._last is not None:
            first = max(first, (self._last + stamp) // 2 + 1)
        if self._clouds:
            last = min(last, (stamp + self._clouds[0].stamp) // 2)
        return first, last

    def _placed(self, boxes: LabelledBoxes3D, place: _Place, problems: list[str]) -> LabelledBoxes3D:
        known = place.world_from_points is not None
        try:
            found = self.tf.lookup(
                place.world_frame if known else place.points_frame,
                boxes.frame_id,
                boxes.stamp if known else place.stamp,
                self._config.sync.tf_tolerance,
            )
        except TransformError as error:
            self._complain(problems, f"{error}: the boxes of {boxes.topic} have no place in the world")
            return boxes
        return replace(boxes, world_from_boxes=(found if known else place.points_from(found)).matrix)

    def _taken_truth(self, stamp: int, first: int, last: int) -> LabelledBoxes3D | None:
        for topic, track in self._truth.items():
            while (found := track.take(stamp, first, last)) is not None:
                try:
                    return replace(found.load(), stamp=found.stamp)
                except UserError as error:
                    self.report.damage.add(topic, str(error))
        return None

    def _robot_detections(
        self, cameras: tuple[Camera, ...], stamp: int, first: int, last: int
    ) -> tuple[LabelledBoxes2D, ...]:
        """The robot's image boxes of this time, each told its camera by the image's frame."""
        names = {c.image.frame_id: c.name for c in cameras if c.image is not None}
        found = (track.take(stamp, first, last) for track in self._detections.values())
        return tuple(
            d if d.camera else replace(d, camera=names.get(d.frame_id, "")) for d in found if d is not None
        )

    def _taken_clouds(self, place: _Place, first: int, last: int, problems: list[str]) -> tuple[Cloud, ...]:
        """The robot's clouds of this time, in the frame of the points."""
        found = []
        for track in self._robot_clouds.values():
            cloud = track.take(place.stamp, first, last)
            if cloud is None:
                continue
            try:
                pose, _ = self._moved(place, cloud.stamp, cloud.frame_id)
            except TransformError as error:
                self._complain(problems, f"{error}: the points of {cloud.topic} are left out")
                continue
            found.append(replace(cloud, xyz=geometry.apply(pose.matrix, cloud.xyz)))
        return tuple(found)

    def _complain(self, problems: list[str], text: str) -> None:
        """Tell this frame, and count in the report, where sentences that differ in a number are one."""
        problems.append(text)
        self.report.problems[re.sub(r"\d+\.\d+ s ", "", text)] += 1


def _words(frame: str) -> set[str]:
    return set(re.split(r"[/_]", frame.lower()))


def _extrinsic(names: str, pose: tuple[float, ...]) -> StampedTransform:
    parent, _, child = names.strip().partition(" ")
    if not parent or not child.strip():
        raise UserError(f"source.extrinsics: '{names}' should be 'parent child', two frame names")
    try:
        matrix = geometry.transform(np.array(pose[:3]), np.array(pose[3:]))
    except ValueError as error:
        raise UserError(f"source.extrinsics '{names}': {error}; expected x y z qx qy qz qw") from None
    return StampedTransform(0, parent, child.strip(), matrix)


def _merge(
    clouds: tuple[Cloud, ...], poses: tuple[F64, ...], in_place: bool
) -> tuple[F32, Mapping[str, NDArray[Any]]]:
    """All points in one frame, with the fields that every cloud has."""
    if len(clouds) == 1 and in_place:
        return clouds[0].xyz, clouds[0].fields
    points = np.concatenate([geometry.apply(p, c.xyz) for c, p in zip(clouds, poses, strict=True)])
    common = [name for name in clouds[0].fields if all(name in c.fields for c in clouds)]
    return points, {name: np.concatenate([c.fields[name] for c in clouds]) for name in common}
