"""The two sides of a comparison: two configurations, or a configuration and the robot."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
import rerun as rr

from bevviz.anomalies import FailureSummary
from bevviz.compare.log import DifferenceLogger
from bevviz.compare.summary import ComparisonSummary
from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.evaluate.differences import FrameDifferences, before_after, differences, seen
from bevviz.evaluate.ground_truth import TruthLookup
from bevviz.model.frame import Camera, Frame, LabelledBoxes3D
from bevviz.model.protocols import Items, Observer
from bevviz.model.results import CameraResult, FrameResult, Objects
from bevviz.pipeline.session import Session, SessionGroup, check_same_frames
from bevviz.recording import entities
from bevviz.recording.frame_logger import FrameLogger
from bevviz.stages.robot_results import detections_of, in_points_frame


@dataclass(frozen=True, slots=True)
class ComparedFrame:
    """Results of both sides for a frame, and their differences. None: a side has no result."""

    frame: Frame
    a: FrameResult | None
    b: FrameResult | None
    found: FrameDifferences | None = None


class SideFailures(Observer[ComparedFrame]):
    """Observer that collects the stages that failed on either side."""

    def __init__(self) -> None:
        self._sides = {"A": FailureSummary(), "B": FailureSummary()}

    def observe(self, result: ComparedFrame) -> None:
        """Collect the failures of a frame."""
        for side, frame_result in (("A", result.a), ("B", result.b)):
            if frame_result is not None:
                self._sides[side].observe(frame_result)

    @property
    def warnings(self) -> list[str]:
        """One sentence for each failed stage of a side."""
        return [f"{side}: {text}" for side, failures in self._sides.items() for text in failures.warnings]


class ComparedSessions:
    """Processor that runs two configurations on the same frames.

    Args:
        a, b: the configurations.
        truth: returns the ground truth of a frame, if it is known.

    Raises:
        UserError: a detector's model cannot be used, or the configurations need different frames.
    """

    def __init__(self, a: Config, b: Config, truth: TruthLookup | None = None) -> None:
        check_same_frames({"A": a, "B": b})
        self._sessions, self._truth = SessionGroup([a, b]), truth

    def perceive(self, frame: Frame, network: Executor | None = None) -> ComparedFrame:
        """Run the stages of both configurations on a frame."""
        a, b = self._sessions.perceive(frame, network)
        return ComparedFrame(a.frame, a, b)

    def finish(self, compared: ComparedFrame) -> ComparedFrame:
        """Finish the results of both sides in frame order, and compare them."""
        assert compared.a is not None
        assert compared.b is not None
        a, b = self._sessions.finish((compared.a, compared.b))
        return _compare_sides(compared.frame, a, b, self._truth)


class ComparedRobot:
    """Processor that compares a session with the robot's Detection3DArray topic."""

    def __init__(self, session: Session, topic: str, truth: TruthLookup | None = None) -> None:
        self._session, self._topic, self._truth = session, topic, truth

    def perceive(self, frame: Frame, network: Executor | None = None) -> ComparedFrame:
        """Run the stages on a frame."""
        result = self._session.perceive(frame, network)
        return ComparedFrame(result.frame, result, None)

    def finish(self, compared: ComparedFrame) -> ComparedFrame:
        """Finish the result in frame order, and compare it with the robot's."""
        assert compared.a is not None
        robot_result = published_result(compared.frame, self._topic, compared.a.config)
        return _compare_sides(compared.frame, self._session.finish(compared.a), robot_result, self._truth)


def _compare_sides(
    frame: Frame, a: FrameResult, b: FrameResult | None, truths: TruthLookup | None
) -> ComparedFrame:
    if b is None:
        return ComparedFrame(frame, a, b)
    truth = None if truths is None else truths(frame)
    judged = None if truth is None else before_after(a.objects, b.objects, truth)
    return ComparedFrame(frame, a, b, differences(frame.index, frame.stamp, seen(a), seen(b), judged))


class ComparisonRecorder(Observer[ComparedFrame]):
    """Observer that logs both sides and their differences.

    Entities of A have the same paths as in a single run. Those of B are under ``/b``.

    Args:
        recording: target.
        a, b: the configurations.
        summary: of the same comparison.
    """

    def __init__(
        self, recording: rr.RecordingStream, a: Config, b: Config, summary: ComparisonSummary
    ) -> None:
        self._recording, self._configs, self._summary = recording, (a, b), summary

    def begin(self, items: Items[object]) -> None:
        """Log the static entities of both sides."""
        a, b = self._configs
        self._loggers = (
            FrameLogger(self._recording, a, items.scene),
            FrameLogger(self._recording, b, items.scene, entities.B),
        )
        for logger in self._loggers:
            logger.log_static()
        self._differences = DifferenceLogger(self._recording, self._summary.names, self._summary.about)

    def observe(self, compared: ComparedFrame) -> None:
        """Log both sides and their differences for a frame."""
        for logger, result in zip(self._loggers, (compared.a, compared.b), strict=True):
            if result is not None:
                logger.log(result)
        if compared.found is not None:
            self._differences.log(compared.found, compared.frame.received, compared.frame.pose)


# --- the robot ---------------------------------------------------------------------------------


def robot_topic(topics: tuple[str, ...], requested: str) -> str:
    """Return the requested topic, or the topic with the robot's classed boxes if its name shows it.

    Raises:
        UserError: there is no such topic, or there are several candidates.
    """
    known = ", ".join(topics)
    if requested:
        if requested not in topics:
            raise UserError(
                f"--robot {requested}: no such Detection3DArray topic; there are: {known or 'none'}"
            )
        return requested
    named = [topic for topic in topics if "fused" in topic or "fusion" in topic]
    classed = named or [topic for topic in topics if "cluster" not in topic]
    if len(classed) == 1:
        return classed[0]
    if not topics:
        raise UserError("--robot: the bag has no vision_msgs/Detection3DArray of the robot")
    raise UserError(f"--robot: which of its topics? Give one: --robot TOPIC, of {known}")


def published_result(frame: Frame, topic: str, config: Config) -> FrameResult | None:
    """Return the robot's results for the frame as a frame result. None: the robot published none."""
    labelled = next((boxes for boxes in frame.robot_boxes if boxes.topic == topic), None)
    if labelled is None:
        return None
    cameras = tuple(_published_2d(frame, camera) for camera in frame.cameras)
    return replace(FrameResult.unprocessed(frame, config, cameras), objects=_objects(labelled, frame))


def _objects(labelled: LabelledBoxes3D, frame: Frame) -> Objects:
    """Return the robot's boxes in the frame of the points."""
    boxes = in_points_frame(frame, labelled)
    unmatched = np.full(len(boxes), -1, np.int32)
    return Objects(boxes, labelled.labels, labelled.scores, unmatched, ("",) * len(boxes), unmatched)


def _published_2d(frame: Frame, camera: Camera) -> CameraResult:
    detections = [candidate for candidate in frame.robot_detections if candidate.camera == camera.name]
    return CameraResult(camera, detections_of(detections[0]) if detections else None, None)
