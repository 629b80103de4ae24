"""The two sides of a comparison on the same frames: two configurations, or a configuration and the robot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import rerun as rr

from bevviz.compare.differences import differences, seen
from bevviz.compare.log import DifferenceLogger
from bevviz.compare.summary import Summary, parameters
from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.evaluate import in_points_frame
from bevviz.frame import (
    Camera,
    CameraResult,
    Detections,
    DetectionState,
    Frame,
    FrameResult,
    LabelledBoxes2D,
    LabelledBoxes3D,
    Objects,
    Scene,
)
from bevviz.live.settings import differences as config_differences
from bevviz.logging import entities
from bevviz.logging.logger import Logger
from bevviz.text import fenced
from bevviz.variants import Variants, check_same_frames, common_frames

Results = tuple[Frame, FrameResult | None, FrameResult | None]


@dataclass(frozen=True, slots=True)
class Side:
    """One of the two. ``run`` gives None where it says nothing of a frame."""

    name: str
    config: Config
    run: Callable[[Frame], FrameResult | None]


class Comparison:
    """Runs both sides on each frame, logs both and how they differ, and counts.

    Args:
        a, b: the sides. What A makes is logged where a run alone has it, what B makes under ``/b``.
    """

    def __init__(self, a: Side, b: Side) -> None:
        self.a, self.b = a, b
        self.summary = Summary((a.name, b.name), config_differences(a.config, b.config))
        self.without = 0  # frames that a side says nothing of

    def run(self, frame: Frame) -> Results:
        """What both make of the frame."""
        return frame, self.a.run(frame), self.b.run(frame)

    def begin(self, recording: rr.RecordingStream, scene: Scene) -> Callable[[Results], None]:
        """Log what no frame changes. Returns what is to be called with the results of each frame."""
        loggers = [
            Logger(recording, self.a.config, scene),
            Logger(recording, self.b.config, scene, entities.B),
        ]
        for logger in loggers:
            logger.log_static()
        about = fenced("\n".join(parameters(self.summary.config)))
        log = DifferenceLogger(recording, self.summary.names, about)

        def handle(results: Results) -> None:
            frame, a, b = results
            for logger, result in zip(loggers, (a, b), strict=True):
                if result is not None:
                    logger.log(result)
            if a is None or b is None:
                self.without += 1
                return
            found = differences(frame.index, frame.stamp, seen(a), seen(b))
            log.log(found, frame.received, frame.pose)
            self.summary.add(found)

        return handle


def configured(names: tuple[str, str], configs: tuple[Config, Config]) -> tuple[Comparison, Config]:
    """Two configurations, and how the frames for both are to be made.

    Raises:
        UserError: a detector's model cannot be used, or they need different frames.
    """
    check_same_frames(dict(zip(("A", "B"), configs, strict=True)))
    variants = Variants()
    for config in configs:
        variants.prepare(config)

    def side(name: str, config: Config) -> Side:
        return Side(name, config, lambda frame: variants.run(frame, config))

    a, b = (side(name, config) for name, config in zip(names, configs, strict=True))
    return Comparison(a, b), common_frames(configs)


# --- the robot ---------------------------------------------------------------------------------


def against_robot(config: Config, topic: str) -> Comparison:
    """What the configuration makes, and what the robot published on a Detection3DArray topic.

    Raises:
        UserError: the detector's model cannot be used.
    """
    variants = Variants()
    variants.prepare(config)
    ours = Side("bevviz", config, lambda frame: variants.run(frame, config))
    return Comparison(ours, Side(f"the robot's {topic}", config, lambda frame: published(frame, topic)))


def robot_topic(topics: tuple[str, ...], asked: str) -> str:
    """The topic with the robot's classed boxes: the one asked for, or the one whose name says so.

    Raises:
        UserError: there is none, or several could be meant.
    """
    there = ", ".join(topics)
    if asked:
        if asked not in topics:
            raise UserError(f"--robot {asked}: no such Detection3DArray topic; there are: {there or 'none'}")
        return asked
    named = [topic for topic in topics if "fused" in topic or "fusion" in topic]
    classed = named or [topic for topic in topics if "cluster" not in topic]
    if len(classed) == 1:
        return classed[0]
    if not topics:
        raise UserError("--robot: the bag has no vision_msgs/Detection3DArray of the robot")
    raise UserError(f"--robot: which of its topics? Give one: --robot TOPIC, of {there}")


def published(frame: Frame, topic: str) -> FrameResult | None:
    """What the robot says of the frame, as if a run had made it; None where it says nothing."""
    stated = next((boxes for boxes in frame.robot_boxes if boxes.topic == topic), None)
    if stated is None:
        return None
    cameras = tuple(_published_2d(frame, camera) for camera in frame.cameras)
    return FrameResult(
        frame=frame,
        voxels=None,
        ground=None,
        obstacles=None,
        clusters=None,
        cameras=cameras,
        objects=_objects(stated, frame),
        bev=None,
    )


def _objects(stated: LabelledBoxes3D, frame: Frame) -> Objects:
    """The robot's boxes in the frame of the points."""
    boxes = in_points_frame(frame, stated)
    none = np.full(len(boxes), -1, np.int32)
    return Objects(boxes, stated.labels, stated.scores, none, ("",) * len(boxes), none)


def _published_2d(frame: Frame, camera: Camera) -> CameraResult:
    mine = [found for found in frame.robot_detections if found.camera == camera.name]
    return CameraResult(camera, _detections(mine[0]) if mine else None, None)


def _detections(found: LabelledBoxes2D) -> Detections:
    count = len(found.xyxy)
    zero = np.zeros(count, np.int32)
    kept = np.full(count, DetectionState.KEPT, np.int32)
    return Detections(
        found.xyxy, found.scores, zero, found.labels, kept, zero - 1, np.zeros(count, np.float32)
    )
