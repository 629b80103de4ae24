"""Synchroniser of clouds, images, transforms and boxes into frames, driven by the LiDAR."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.messages.roles import Roles
from bevviz.messages.topics import entity_name
from bevviz.messages.transforms import StampedTransform
from bevviz.model import geometry
from bevviz.model.frame import (
    F32,
    F64,
    Camera,
    Cloud,
    Frame,
    Image,
    Intrinsics,
    LabelledBoxes2D,
    LabelledBoxes3D,
    LateBoxes,
)
from bevviz.sync.buffers import JUMP, SurroundingsBuffer, TopicBuffer, describe_distance
from bevviz.sync.cameras import Cameras
from bevviz.sync.clocks import LAST, LATENCY, LIVE, Clocks
from bevviz.sync.gravity import VerticalEstimate
from bevviz.sync.pose_lookup import PoseLookup, ReferenceFrames
from bevviz.sync.report import SyncReport
from bevviz.sync.transform_tree import Origin, TransformError
from bevviz.sync.video import Video

FAR = 500.0  # metres; no LiDAR has half of its points farther away
OVERTAKEN = 64  # late results, and frames to compare them with, that are kept

T = TypeVar("T")


class Synchronizer:
    """Synchroniser of the messages of a bag or a live robot, with bounded memory.

    Messages come in order of receipt. A cloud waits until each camera has an image of its stamp or later and
    the transforms reach its stamp. It waits at most ``sync.max_wait`` seconds of received time, in a queue of
    ``sync.queue`` clouds. Clouds that are out of order within the queue are put back in order. Later ones are
    dropped and counted.

    Args:
        roles: roles of the topics.
        config: tolerances and queues.
        beside: topics of the robot's boxes for which no frame waits. ``overtaken`` returns those that come
            too late for their frame.
        lapse: seconds after which no frame waits for transforms that stay away; None: each frame waits.

    Attributes:
        report: counts and oddities.
        number: number in the recording of the message of the driver that is added; None: frames are counted.
        followed: child frame of the odometry; empty: not known yet.
        absent: topics that do not deliver. No frame waits for them, and the first LiDAR that is not among
            them drives.
        videos: video by topic.
        placing: finder of poses.
        cameras: buffer of images and calibrations.
    """

    def __init__(
        self, roles: Roles, config: Config, beside: Collection[str] = (), lapse: float | None = None
    ) -> None:
        self.report = SyncReport()
        self.number: int | None = None
        self.followed = ""
        self._absent: frozenset[str] = frozenset()
        self._lapse = math.inf if lapse is None else lapse * 1e9
        self._unconnected: int | None = None  # time of receipt since which transforms are unknown
        self.tf = self.report.tf
        self.upright = VerticalEstimate(self.tf, config.source.base_frame, config.sync.tf_tolerance)
        self.report.upright = self.upright.warnings
        self.around = SurroundingsBuffer()
        self.clocks = self.report.clocks = Clocks(config.sync, roles.driver, LAST if lapse is None else LIVE)
        self.report.driver, self.report.noun = roles.driver, "cloud" if roles.lidars else "image"
        self.report.clocked = (*roles.lidars, *(c.topic for c in roles.cameras), *roles.tf)
        self._roles = roles
        self._config = config
        self._tolerance = round(config.sync.tolerance * 1e9)
        self._wait = round(config.sync.max_wait * 1e9)
        self._horizon = self._wait + self._tolerance + round(LATENCY * 1e9)
        self._now = 0
        self._clouds: list[Cloud] = []  # clouds of the driving LiDAR, in order of stamp
        self._done: deque[Frame] = deque()
        self._index = 0
        self._last: int | None = None  # stamp of the last frame
        self._step = math.inf  # nanoseconds between the last two clouds; a gap is much longer
        self.driver = roles.driver  # topic whose messages make the frames now
        self._partners: dict[str, TopicBuffer[Cloud]] = self._make_buffers(*roles.lidars[1:])
        self.videos: dict[str, Video] = {}
        self._lidar_frames: dict[str, str] = {}  # frame by cloud topic
        self._boxes: dict[str, TopicBuffer[LabelledBoxes3D]] = self._make_buffers(*roles.robot_detections_3d)
        self._detections: dict[str, TopicBuffer[LabelledBoxes2D]] = self._make_buffers(
            *roles.robot_detections_2d
        )
        self._robot_clouds: dict[str, TopicBuffer[Cloud]] = self._make_buffers(*roles.robot_clouds)
        # Functions that decode the ground truth.
        self._truth: dict[str, TopicBuffer[Callable[[], LabelledBoxes3D]]] = self._make_buffers(
            *filter(None, [roles.truth])
        )
        self._results: tuple[Mapping[str, TopicBuffer[Any]], ...] = (
            self._boxes,
            self._detections,
            self._robot_clouds,
            self._truth,
        )
        self._beside = frozenset(beside)
        self._overtaken: deque[LateBoxes] = deque(maxlen=OVERTAKEN)
        # Reference frames and poses of the last frames.
        self._past_references: deque[tuple[ReferenceFrames, F64]] = deque(maxlen=OVERTAKEN)
        self.placing = PoseLookup(
            config, self.report, self.upright, turned=bool(roles.lidars), merged=bool(self._partners)
        )
        self.cameras = Cameras(roles, config, self.report, self.placing, self._horizon)

    def _make_buffers(self, *topics: str) -> dict[str, TopicBuffer[Any]]:
        return {topic: TopicBuffer(self._horizon) for topic in topics}

    def take_over(self, former: Synchronizer) -> None:
        """Continue with the transforms, calibrations and counts of ``former`` when the roles change."""
        clocked = self.report.clocked
        driver, noun = self.report.driver, self.report.noun
        self.report = former.report
        self.report.clocked, self.report.driver, self.report.noun = clocked, driver, noun
        former.clocks.driver = driver
        self.tf, self.upright, self.clocks = former.tf, former.upright, former.clocks
        self.around, self.videos = former.around, former.videos
        self.placing.take_over(former.placing)
        self.cameras.take_over(former.cameras)
        self._overtaken, self._past_references = former._overtaken, former._past_references
        self.absent = former.absent

    @property
    def absent(self) -> frozenset[str]:
        """Topics that do not deliver."""
        return self._absent

    @absent.setter
    def absent(self, topics: frozenset[str]) -> None:
        self._absent = topics
        driver = next((lidar for lidar in self._roles.lidars if lidar not in topics), self.driver)
        if driver != self.driver:
            self._drive(driver)

    def _drive(self, lidar: str) -> None:
        """Let another LiDAR drive. Its clouds that no frame has taken yet make frames."""
        former: TopicBuffer[Cloud] = TopicBuffer(self._horizon)
        for cloud in self._clouds:
            former.add(cloud.stamp, cloud)
        untaken = self._partners.pop(lidar)
        self._partners[self.driver] = former
        self.driver = lidar
        if self._last is not None:
            untaken.shed(self._last + self._tolerance)
        self._clouds = untaken.shed(untaken.newest or 0)

    # --- what comes in -------------------------------------------------------------------------

    def add_cloud(self, cloud: Cloud) -> None:
        """Add a scan. ``cloud.topic`` tells its LiDAR."""
        if cloud.topic not in self._roles.lidars:
            return
        stamp = self._arrived(cloud.topic, cloud.stamp, cloud.received)
        frame_id = self._config.source.frames.get(cloud.topic, cloud.frame_id)
        cloud = replace(cloud, stamp=stamp, frame_id=frame_id)
        cloud = replace(cloud, name=self._lidar_name(cloud))
        frame = cloud.frame_id.lstrip("/")
        if (former := self._lidar_frames.get(cloud.topic, frame)) != frame:
            changed = f"{cloud.topic}: its frame_id changed from '{former}' to '{frame}'"
            self.report.oddities.setdefault(f"{cloud.topic} frame_id", changed)
        self._lidar_frames[cloud.topic] = frame
        self._note_layout(cloud)
        self._check_units(cloud)
        self.report.clouds += 1
        if cloud.topic in self._partners:
            self.report.repeated[cloud.topic] += self._partners[cloud.topic].add(cloud.stamp, cloud)
            return
        self._queue(cloud)

    def add_neighbour(self, topic: str, stamp: int, frame_id: str, received: int) -> None:
        """Add a message of the driver whose frame is not wanted. It takes what is nearest to it."""
        stamp = self._arrived(topic, stamp, received)
        frame_id = self._config.source.frames.get(topic, frame_id)
        self._queue(Cloud(stamp, frame_id, np.zeros((0, 3), np.float32), received=received))

    def _queue(self, cloud: Cloud) -> None:
        """Queue a cloud of the driving LiDAR for a frame."""
        cloud = replace(cloud, number=self.number)
        self.report.queued += 1
        self._watch_clock(cloud.stamp)
        stamps = [waiting.stamp for waiting in self._clouds]
        row = bisect_left(stamps, cloud.stamp)
        if cloud.stamp == self._last or cloud.stamp in stamps:
            self.report.duplicates += 1
        elif self._last is not None and cloud.stamp < self._last:
            self.report.late += 1
        else:
            self.report.reordered += row < len(stamps)
            self._clouds.insert(row, cloud)

    def add_image(
        self, topic: str, stamp: int, frame_id: str, received: int, load: Callable[[], Image]
    ) -> None:
        """Add an image that is not decoded yet.

        Args:
            topic: topic of the image.
            stamp: stamp of its header, nanoseconds.
            frame_id: frame of its header.
            received: time of receipt, nanoseconds.
            load: decodes the image when a frame takes it. A UserError that it raises becomes a problem of the
                camera.
        """
        if topic in self.cameras.images:
            stamp = self._arrived(topic, stamp, received)
            repeated = self.cameras.add_image(topic, stamp, frame_id, load)
            if topic not in self.videos:  # parameters of a video may precede the picture with the same stamp
                self.report.repeated[topic] += repeated
            if topic == self._roles.driver:  # without a LiDAR the camera drives
                self.report.clouds += 1
                self._queue(Cloud(stamp, frame_id, np.zeros((0, 3), np.float32), {}, topic, received))

    def add_camera_info(
        self, topic: str, intrinsics: Intrinsics, stamp: int, received: int, frame_id: str = ""
    ) -> None:
        """Add a calibration on a CameraInfo topic. An image uses the calibration with the nearest stamp."""
        self.cameras.add_info(topic, self._arrived(topic, stamp, received), intrinsics, frame_id)

    def refuse_camera_info(self, topic: str, reason: str) -> None:
        """Note why a calibration cannot be used. The camera reports it if it has no other calibration."""
        self.cameras.refuse_info(topic, reason)

    def add_transform(
        self,
        transform: StampedTransform,
        static: bool = False,
        fallback: bool = False,
        held: bool = False,
        topic: str = "",
    ) -> None:
        """Add a transform.

        Args:
            transform: the transform.
            static: whether it holds at any time.
            fallback: whether it is from odometry, which is used only if nothing else states the parent of the
                child.
            held: whether it holds until the next one.
            topic: its topic, for warnings.
        """
        if fallback:
            self.placing.odometry_frames.add(transform.parent.lstrip("/"))
        self.tf.add(transform, static, Origin.ODOMETRY if fallback else Origin.TF, held, topic)

    def add_boxes(self, boxes: LabelledBoxes3D) -> None:
        """Add 3D boxes of the robot."""
        self._add_result(self._boxes, boxes)

    def add_detections(self, detections: LabelledBoxes2D) -> None:
        """Add image boxes of the robot."""
        self._add_result(self._detections, detections)

    def add_robot_cloud(self, cloud: Cloud) -> None:
        """Add the robot's points without the ground."""
        self._note_layout(cloud)
        stamp = self._arrived(cloud.topic, cloud.stamp, cloud.received)
        self._robot_clouds[cloud.topic].add(stamp, replace(cloud, stamp=stamp))

    def add_truth(self, topic: str, stamp: int, received: int, load: Callable[[], LabelledBoxes3D]) -> None:
        """Add ground truth that is not decoded yet.

        Args:
            topic: topic of the boxes.
            stamp: stamp, nanoseconds.
            received: time of receipt, nanoseconds.
            load: decodes the boxes when a frame takes them. If it raises a UserError, this is counted and the
                boxes are ignored.
        """
        stamp = self._arrived(topic, stamp, received)
        self._keep(self._truth, topic, stamp, lambda: replace(load(), stamp=stamp))

    def _keep(self, buffers: dict[str, TopicBuffer[T]], topic: str, stamp: int, message: T) -> None:
        """Keep a message until a frame takes it."""
        buffer = buffers.setdefault(topic, TopicBuffer(self._horizon))
        self.report.repeated[topic] += buffer.add(stamp, message)

    def _add_result(
        self, buffers: dict[str, TopicBuffer[Any]], result: LabelledBoxes2D | LabelledBoxes3D
    ) -> None:
        stamp = self._arrived(result.topic, result.stamp, result.received)
        result = replace(result, stamp=stamp)
        if result.topic in self._beside and self._is_past(stamp):
            self._add_late_result(result)
        else:
            self._keep(buffers, result.topic, stamp, result)

    def _is_past(self, stamp: int) -> bool:
        """Return whether the frame nearest to a stamp has been delivered."""
        if self._last is None:
            return False
        after = self._clouds[0].stamp if self._clouds else self._last + self._step
        return stamp <= min(self._last + self._tolerance, (self._last + after) / 2)

    def _add_late_result(self, result: LabelledBoxes2D | LabelledBoxes3D) -> None:
        """Note a result of the robot that no frame takes, with the frame nearest to it."""
        self.report.overtaken[result.topic] += 1
        late = (result.received - result.stamp) * 1e-9
        self.report.note_boxes(result)
        self.report.slowest[result.topic] = max(self.report.slowest.get(result.topic, late), late)
        if not self._past_references:
            return
        reference, pose = min(self._past_references, key=lambda past: abs(past[0].stamp - result.stamp))
        if isinstance(result, LabelledBoxes3D):
            result = self.placing.placed(result, reference, [])
        elif not result.camera:
            names = {self.cameras.frames.get(role.topic): role.name for role in self._roles.cameras}
            result = replace(result, camera=names.get(result.frame_id, ""))
        self._overtaken.append(LateBoxes(result, reference.stamp, pose))

    def overtaken(self) -> tuple[LateBoxes, ...]:
        """Return the robot's results that no frame has taken since the last call."""
        results = tuple(self._overtaken)
        self._overtaken.clear()
        return results

    def _arrived(self, topic: str, stamp: int, received: int) -> int:
        """Return the stamp to use of a message that is paired by its stamp."""
        self._now = received
        return self.stamped(topic, stamp, received)

    def stamped(self, topic: str, stamp: int, received: int) -> int:
        """Return the stamp to use. That of a message without one is its time of receipt, which is counted."""
        if stamp == 0:
            self.report.unstamped[topic] += 1
            return received
        return self.clocks.stamp(topic, stamp, received)

    def _note_layout(self, cloud: Cloud) -> None:
        if cloud.doubt:
            self.report.oddities.setdefault(f"{cloud.topic} layout", f"{cloud.topic}: {cloud.doubt}")

    def _check_units(self, cloud: Cloud) -> None:
        """Warn of coordinates in millimetres or far from the origin of a map, which no stage reaches."""
        if cloud.topic not in self.report.oddities and len(cloud.xyz):
            sample = cloud.xyz[::16]
            x, y, z = np.abs(sample).T  # maximum of each point, faster than max(axis=1)
            middle = float(np.median(np.maximum(np.maximum(x, y), z)))
            if middle > FAR:
                spread = float(np.median(np.abs(sample - np.median(sample, axis=0)).max(axis=1)))
                why = (
                    "millimetres are; a PointCloud2 is in metres (REP 103): correct its driver"
                    if spread > FAR
                    else f"a map (UTM) are, with most within {spread:,.0f} m of each other; they are wanted "
                    "in the frame of the LiDAR: take its position away"
                )
                far = f"{cloud.topic}: half of its points are farther than {middle:,.0f} m"
                self.report.oddities[cloud.topic] = f"{far}, as coordinates in {why}"

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
        """Start again at ``stamp``: the clock jumped back, as with a bag in a loop or a new simulation."""
        self.report.resets += 1
        self.clocks.forget()
        self._done.extend(self._build_all())
        self._last = None
        self.tf.forget_after(stamp + JUMP)
        for _, buffer in self._buffers():
            buffer.keep(0, stamp + JUMP)

    def _buffers(self) -> Iterator[tuple[str, TopicBuffer[Any]]]:
        """Iterate over all topics and their buffers."""
        yield from self._partners.items()
        yield from self.cameras.images.items()
        for group in self._results:
            yield from group.items()

    def lacking(self) -> Iterator[str]:
        """Yield a sentence for each calibration or transform that is missing so far and may still come."""
        lidar = next(iter(self._lidar_frames.values()), "")
        for camera in self._roles.cameras:
            if camera.info_topic and camera.info_topic not in self.cameras.intrinsics:
                yield f"no CameraInfo on {camera.info_topic} yet"
            frame = self.cameras.frames.get(camera.topic, "")
            if self._roles.tf_static + self._roles.tf and frame and lidar and not self.tf.knows(lidar, frame):
                yield f"no transform from '{lidar}' to '{frame}' yet"
        moving = self._roles.tf or self._roles.odometry
        if moving and lidar and not self.placing.fixed(lidar)[0]:
            yield f"no transform from '{lidar}' to a frame that stands still yet"

    # --- what goes out -------------------------------------------------------------------------

    def ready(self, now: int | None = None) -> Iterator[Frame]:
        """Yield the frames, in order of stamp, that are complete or have waited long enough.

        Call it after every message, or after a few. Frames are kept until they are taken.

        Args:
            now: newest time of receipt, nanoseconds; None: that of the last message.
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
            yield from self._build()

    def flush(self) -> Iterator[Frame]:
        """Yield the remaining frames at the end of the stream."""
        while self._done:
            yield self._done.popleft()
        yield from self._build_all()
        if self.report.clouds and not self.report.frames:
            self.report.idle = self._roles.driver

    def _build_all(self) -> Iterator[Frame]:
        while self._clouds:
            yield from self._build()

    def reaches(self, stamp: int, silent: Collection[str]) -> bool:
        """Return whether the images and the clouds of further LiDARs begin before a stamp.

        Args:
            stamp: stamp of a frame.
            silent: topics without messages, which do not count.
        """
        groups: tuple[Mapping[str, TopicBuffer[Any]], ...] = (self._partners, self.cameras.images)
        oldest = [buffer.oldest for group in groups for topic, buffer in group.items() if topic not in silent]
        return all(first is not None and first <= stamp for first in oldest)

    def _complete(self) -> bool:
        """Return whether no further message can change the frame of the oldest cloud."""
        stamp = self._clouds[0].stamp
        beside = self.absent | self._beside
        waited = [buffer for topic, buffer in self._buffers() if topic not in beside]
        if any(buffer.newest is None or buffer.newest < stamp for buffer in waited):
            return False
        results = [
            buffer for group in self._results for topic, buffer in group.items() if topic not in self._beside
        ]
        if len(self._clouds) == 1 and any(self._may_be_of_next(buffer, stamp) for buffer in results):
            return False
        infos = {camera.info_topic for camera in self._roles.cameras} - {""}
        if infos - self.absent - self.cameras.intrinsics.keys():
            return False
        if not all(self.cameras.info_reaches(camera, stamp, self.absent) for camera in self._roles.cameras):
            return False
        lacking = not self.absent.isdisjoint((*self._roles.tf, self._roles.odometry))
        return lacking or self._transforms_reach(self._clouds[0])

    def _may_be_of_next(self, buffer: TopicBuffer[Any], stamp: int) -> bool:
        nearest = buffer.nearest(stamp)
        return nearest is not None and 0 < nearest[0] - stamp <= self._tolerance

    def _transforms_reach(self, cloud: Cloud) -> bool:
        """Return whether the transforms reach the stamps of the cloud and the messages joined with it."""
        reference = self.placing.of(cloud)
        moving = self._roles.tf or self._roles.odometry
        if moving and not reference.world_frame:
            return self._has_lapsed()
        needed = [(cloud.stamp, cloud.frame_id)]
        joined: list[TopicBuffer[Any]] = [*self.cameras.images.values(), *self._partners.values()]
        for buffer in joined:
            nearest = buffer.nearest(cloud.stamp)
            if nearest is not None and abs(nearest[0] - cloud.stamp) <= self._tolerance:
                needed.append((max(nearest[0], cloud.stamp), nearest[1].frame_id))
        anchors = {reference.points_frame, reference.world_frame or reference.points_frame}
        if self._partners:
            anchors.add(self._config.source.base_frame)
        try:
            ends = [(self.tf.latest(anchor, frame), stamp) for stamp, frame in needed for anchor in anchors]
        except TransformError:
            return self._has_lapsed()
        self._unconnected = None
        return all(end is None or end >= stamp or end < stamp - self._lapse for end, stamp in ends)

    def _has_lapsed(self) -> bool:
        """Note that transforms are unknown. Return whether that is so for longer than the lapse."""
        if self._unconnected is None:
            self._unconnected = self._now
        return self._now - self._unconnected > self._lapse

    # --- one frame -----------------------------------------------------------------------------

    def _build(self) -> Iterator[Frame]:
        """Yield the frame of the oldest cloud, if it is wanted."""
        cloud = self._clouds.pop(0)
        if not cloud.topic:
            self._pass_over(cloud.stamp)
            return
        problems: list[str] = []
        reference = self.placing.of(cloud, problems)
        clouds, poses = self._gather(cloud, reference, problems)
        in_place = reference.upright is None and cloud.frame_id.lstrip("/") == reference.points_frame
        points, fields = _merge(clouds, poses, in_place)
        cameras = tuple(self.cameras.at(role, reference) for role in self._roles.cameras)
        boxes = self._take(self._boxes, cloud.stamp)
        posed_boxes = [self.placing.placed(b, reference, problems) for b in boxes]
        for robot_boxes in posed_boxes:
            self.report.note_boxes(robot_boxes)
        truth = self._taken_truth(cloud.stamp)
        frame = Frame(
            index=self._index if cloud.number is None else cloud.number,
            stamp=cloud.stamp,
            received=cloud.received,
            lidar="lidars" if self._partners else cloud.name,
            points=points,
            points_frame=reference.points_frame,
            upright=reference.upright,
            fields=fields,
            world_frame=reference.world_frame or reference.points_frame,
            world_from_points=reference.world_from_points,
            clouds=clouds,
            points_from_clouds=poses,
            cameras=cameras,
            robot_boxes=tuple(posed_boxes),
            robot_detections=self._robot_detections(cameras, cloud.stamp),
            robot_clouds=self._taken_clouds(reference, problems),
            truth=None if truth is None else self.placing.placed(truth, reference, problems),
            label_names=self._config.source.labels,
            tf_age=reference.tf_age,
            problems=tuple(problems),
            around=self.around.take(lambda name: self.placing.world_from(reference, name)),
        )
        yield self._finish(reference, frame)

    def _pass_over(self, stamp: int) -> None:
        """Drop what the frame of a neighbour takes."""
        for group in self._results:
            self._take(group, stamp)
        self.around.take(lambda name: None)
        self._last = stamp
        for _, buffer in self._buffers():
            buffer.forget(stamp - self._tolerance)

    def _finish(self, reference: ReferenceFrames, frame: Frame) -> Frame:
        """Note that the frame is delivered. Return it."""
        last = self._window(frame.stamp)[1]
        self._index += 1
        self._last = frame.stamp
        self.report.frames += 1
        self._past_references.append((reference, frame.pose))
        unused: tuple[Mapping[str, TopicBuffer[Any]], ...] = (self._boxes, self._detections)
        for group in unused:
            for topic in self._beside & group.keys():
                for result in group[topic].shed(last):
                    self._add_late_result(result)
        for _, buffer in self._buffers():
            buffer.forget(frame.stamp - self._tolerance)
        return frame

    def _lidar_name(self, cloud: Cloud) -> str:
        names = dict(zip(self._roles.lidars, self._roles.lidar_names, strict=False))
        return names.get(cloud.topic) or entity_name(cloud.topic, cloud.frame_id)

    def _gather(
        self, cloud: Cloud, reference: ReferenceFrames, problems: list[str]
    ) -> tuple[tuple[Cloud, ...], tuple[F64, ...]]:
        """Return the clouds of all LiDARs nearest to ``cloud``, and points_from_cloud of each."""
        clouds, poses = [cloud], [np.eye(4) if reference.upright is None else reference.upright]
        if reference.points_frame != cloud.frame_id.lstrip("/"):
            try:
                poses[0] = self.placing.moved(reference, cloud.stamp, cloud.frame_id)[0].matrix
            except TransformError as error:
                self.report.complain(problems, f"{error}: the points of {cloud.topic} stay where they are")
        for topic, buffer in self._partners.items():
            nearest = buffer.nearest(cloud.stamp)
            if nearest is None or abs(nearest[0] - cloud.stamp) > self._tolerance:
                problems.append(
                    f"no cloud of LiDAR {topic} {describe_distance(nearest, cloud.stamp, self._tolerance)}"
                )
                continue
            partner = nearest[1]
            try:
                lookup, _ = self.placing.moved(reference, partner.stamp, partner.frame_id)
            except TransformError as error:
                self.report.complain(problems, f"{error}: the points of {topic} are left out")
                continue
            clouds.append(partner)
            poses.append(lookup.matrix)
        return tuple(clouds), tuple(poses)

    def _window(self, stamp: int) -> tuple[int, int]:
        """Return the first and last stamp nearer to this cloud than to others, within the tolerance."""
        first, last = stamp - self._tolerance, stamp + self._tolerance
        if self._last is not None:
            first = max(first, (self._last + stamp) // 2 + 1)
        if self._clouds:
            last = min(last, (stamp + self._clouds[0].stamp) // 2)
        return first, last

    def _take(self, buffers: Mapping[str, TopicBuffer[T]], stamp: int) -> list[T]:
        """Remove and return the message of each topic that is nearest to the cloud at a stamp."""
        first, last = self._window(stamp)
        nearest = [buffer.take(stamp, first, last) for buffer in buffers.values()]
        return [message for message in nearest if message is not None]

    def _taken_truth(self, stamp: int) -> LabelledBoxes3D | None:
        while loads := self._take(self._truth, stamp):
            try:
                truth = loads[0]()
            except UserError as error:
                self.report.damage.add(self._roles.truth, str(error))
            else:
                self.report.note_boxes(truth)
                return truth
        return None

    def _robot_detections(self, cameras: tuple[Camera, ...], stamp: int) -> tuple[LabelledBoxes2D, ...]:
        """Return the robot's image boxes of this time, with the camera that has their frame."""
        names = {c.image.frame_id: c.name for c in cameras if c.image is not None}
        messages = self._take(self._detections, stamp)
        for detections in messages:
            self.report.note_boxes(detections)
        return tuple(d if d.camera else replace(d, camera=names.get(d.frame_id, "")) for d in messages)

    def _taken_clouds(self, reference: ReferenceFrames, problems: list[str]) -> tuple[Cloud, ...]:
        """Return the robot's clouds of this time, in the frame of the points."""
        clouds = []
        for cloud in self._take(self._robot_clouds, reference.stamp):
            try:
                pose, _ = self.placing.moved(reference, cloud.stamp, cloud.frame_id)
            except TransformError as error:
                self.report.complain(problems, f"{error}: the points of {cloud.topic} are left out")
                continue
            clouds.append(replace(cloud, xyz=geometry.apply(pose.matrix, cloud.xyz)))
        return tuple(clouds)


def _merge(
    clouds: tuple[Cloud, ...], poses: tuple[F64, ...], in_place: bool
) -> tuple[F32, Mapping[str, NDArray[Any]]]:
    """Return all points in one frame, with the fields that all clouds have."""
    if len(clouds) == 1 and in_place:
        return clouds[0].xyz, clouds[0].fields
    points = np.concatenate([geometry.apply(p, c.xyz) for c, p in zip(clouds, poses, strict=True)])
    common = [name for name in clouds[0].fields if all(name in c.fields for c in clouds)]
    return points, {name: np.concatenate([c.fields[name] for c in clouds]) for name in common}
