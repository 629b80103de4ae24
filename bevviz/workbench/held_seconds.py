"""The last seconds of a running robot as a bag, made of its messages in memory when somebody asks."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from bevviz.bags.source import BagSource
from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.live.files import write_bag
from bevviz.live.raw_recorder import RawMessage
from bevviz.live.source_wrappers import thin
from bevviz.model.frame import Camera, Frame
from bevviz.model.results import FrameResult, Tracks
from bevviz.support.contexts import Closable
from bevviz.support.scratch_folder import ScratchFolder
from bevviz.why.robot_questions import RobotQuestions, robot_questions
from bevviz.workbench.run_results import without_trails

NEIGHBOURS = (0, -1, 1)  # scans that are tried where the time of receipt is that of one of many packets

SAME = 1_000_000  # nanoseconds, difference of one stamp that was corrected by two estimates of a clock


@dataclass(frozen=True, slots=True)
class FrameFacts:
    """Facts about a frame of the live run, which stay when its result is gone.

    Attributes:
        number: number of the frame.
        stamp: its stamp, in nanoseconds.
        received: time of receipt of its scan, in nanoseconds.
        logged: time when it was shown, in monotonic seconds.
        topic: topic of its scan. Empty: the frame has none.
        images: stamp of the image of each camera. None: the camera had none.
        config: configuration of its result.
        tracks: its tracks, without their trails.
    """

    number: int
    stamp: int
    received: int
    logged: float
    topic: str
    images: tuple[int | None, ...]
    config: Config
    tracks: Tracks | None

    @classmethod
    def of(cls, result: FrameResult) -> FrameFacts:
        """Return the facts about the frame of a result that was just shown."""
        frame = result.frame
        return cls(
            frame.index,
            frame.stamp,
            frame.received,
            time.monotonic(),
            frame.clouds[0].topic if frame.clouds else "",
            image_stamps(frame),
            result.config,
            without_trails(result.tracks),
        )


def image_stamps(frame: Frame) -> tuple[int | None, ...]:
    """Return the stamp of the image of each camera. None: the camera has none."""
    return tuple(None if camera.image is None else camera.image.stamp for camera in frame.cameras)


class HeldSeconds(Closable):
    """Bag of the messages that were in memory at one time, in a temporary folder.

    Only one thread at a time may use it.

    Args:
        messages: the messages.
        frames: facts about the frames that they make, by number.

    Attributes:
        path: path of the bag.
        frames: facts about its frames, by number.
        made: time when it was made, in nanoseconds.

    Raises:
        UserError: the bag cannot be written.
    """

    def __init__(self, messages: Sequence[RawMessage], frames: Mapping[int, FrameFacts]) -> None:
        self.frames, self.made = frames, time.time_ns()
        self._robot: RobotQuestions | None = None
        self._folder = ScratchFolder()
        self._sources: dict[str, BagSource] = {}  # by topic of the scans
        self.path = self._folder.new() / time.strftime("robot_%Y%m%dT%H%M%S.mcap")
        try:
            write_bag(self.path, messages, compress=False)
        except BaseException:
            self._folder.close()
            raise

    def close(self) -> None:
        """Delete the bag."""
        for source in self._sources.values():
            source.close()
        self._folder.close()

    def start(self, delivered: FrameFacts) -> int:
        """Return the log time of the first scan of the topic that a frame is of."""
        return int(self._source(delivered).scans[0])

    def frame(self, delivered: FrameFacts) -> Frame:
        """Make a frame again. It has the number and the stamp of the live run.

        An image that came too late for the live run is left out. Other images become a problem of the frame.

        Raises:
            UserError: the scan of the frame is not among the messages, or cannot be read.
        """
        source = self._source(delivered)
        nearest = int(np.abs(source.scans - delivered.received).argmin()) if len(source.scans) else 0
        for number in (nearest + by for by in NEIGHBOURS):
            frame = None
            with suppress(UserError):  # There is no neighbour at the ends.
                frame = source.frame(number)
            if frame is not None and (
                delivered.received == frame.received or abs(frame.stamp - delivered.stamp) < SAME
            ):
                return _as_delivered(frame, delivered)
        raise UserError(f"frame {delivered.number} cannot be made again: its scan is not among the messages")

    def robot_questions(self, delivered: FrameFacts, frame: Frame) -> RobotQuestions:
        """Return the questions about the robot's own chain around a frame.

        Raises:
            UserError: the robot published no objects around the frame.
        """
        self._robot = robot_questions(self._source(delivered), frame, self._robot)
        return self._robot

    def _source(self, delivered: FrameFacts) -> BagSource:
        """Return the bag with the scans of a topic first: the first LiDAR by name may have been silent."""
        topic = delivered.topic
        if topic not in self._sources:
            config = delivered.config
            source = BagSource([self.path], config)
            lidars = source.roles.lidars
            if topic in lidars and topic != source.roles.driver:
                source.close()
                order = (topic, *(other for other in lidars if other != topic))
                settings = config.source.model_copy(update={"lidar_topics": order})
                source = BagSource([self.path], config.model_copy(update={"source": settings}))
            self._sources[topic] = source
        return self._sources[topic]


def _as_delivered(frame: Frame, delivered: FrameFacts) -> Frame:
    """Return a frame with the number, stamp, images and points of the live run."""
    frame = replace(frame, index=delivered.number, stamp=delivered.stamp)
    if len(delivered.images) == len(frame.cameras):
        late = [stamp is None for stamp in delivered.images]
        cameras = [
            _without_late_image(camera) if is_late else camera
            for camera, is_late in zip(frame.cameras, late, strict=True)
        ]
        frame = replace(frame, cameras=tuple(cameras))
    if not _are_near(image_stamps(frame), delivered.images):
        problem = "made again from the messages, with other images than the live run had"
        frame = replace(frame, problems=(*frame.problems, problem))
    return thin(frame, delivered.config.live.points)


def _without_late_image(camera: Camera) -> Camera:
    """Return a camera without the image that the live run had not."""
    if camera.image is None:
        return camera
    return replace(
        camera, image=None, problems=(*camera.problems, "its image came too late for the live run")
    )


def _are_near(stamps: tuple[int | None, ...], others: tuple[int | None, ...]) -> bool:
    """Return whether the stamps are the same, but for the estimate of a clock."""
    return len(stamps) == len(others) and all(
        stamp == other or (stamp is not None and other is not None and abs(stamp - other) < SAME)
        for stamp, other in zip(stamps, others, strict=True)
    )
