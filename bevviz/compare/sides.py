"""The two sides of a comparison: two configurations, or a configuration and the robot."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property

from bevviz.anomalies import FailureSummary
from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.evaluate.differences import FrameDifferences, differences, seen
from bevviz.evaluate.ground_truth import Truth, TruthLookup
from bevviz.model.frame import F64, Camera, Frame, LabelledBoxes3D
from bevviz.model.protocols import Observer
from bevviz.model.results import CameraResult, FrameResult, Objects
from bevviz.pipeline.session import Variants, check_same_frames
from bevviz.stages.robot_results import detections_of, in_points_frame
from bevviz.stages.user_stages import make_objects


@dataclass(frozen=True)
class ComparedFrame:
    """Results of both sides for a frame.

    Attributes:
        a: result of A.
        b: result of B. None: the robot published none.
        truth: ground truth of the frame. None: it is unknown.
    """

    a: FrameResult
    b: FrameResult | None
    truth: Truth | None = None

    @cached_property
    def found(self) -> FrameDifferences | None:
        """Differences of the sides. None: a side has no result."""
        if self.b is None:
            return None
        cameras = self.a.cameras, self.b.cameras
        return differences(seen(self.a), seen(self.b), self.truth, cameras=cameras)


class FirstSide(Observer[ComparedFrame]):
    """Observer that shows the results of A to an observer of a single run."""

    def __init__(self, observer: Observer[FrameResult]) -> None:
        self._observer = observer

    def observe(self, result: ComparedFrame) -> None:
        """Show A's result of a frame."""
        self._observer.observe(result.a)


class SideFailures(Observer[ComparedFrame]):
    """Observer that collects the stages that failed on either side."""

    def __init__(self) -> None:
        self._sides = {"A": FailureSummary(), "B": FailureSummary()}

    def observe(self, result: ComparedFrame) -> None:
        """Collect the failures of a frame."""
        self._sides["A"].observe(result.a)
        if result.b is not None:
            self._sides["B"].observe(result.b)

    @property
    def warnings(self) -> list[str]:
        """One sentence for each failed stage of a side."""
        return [f"{side}: {text}" for side, failures in self._sides.items() for text in failures.warnings]


class Comparison:
    """Processor that runs two configurations on the same frames, or one beside the robot's results.

    Args:
        configs: configurations of A and B, or of A alone.
        topic: the robot's Detection3DArray topic, which is B. Empty: there are two configurations.
        truth: returns the ground truth of a frame, if it is known.

    Raises:
        UserError: a detector's model cannot be used, or the configurations need different frames.
    """

    def __init__(self, configs: Sequence[Config], topic: str = "", truth: TruthLookup | None = None) -> None:
        check_same_frames(dict(zip("AB", configs, strict=False)))
        self._topic, self._truth, self._variants = topic, truth, Variants()
        self._sessions = [self._variants.session(config) for config in configs]

    def perceive(self, frame: Frame, network: Executor | None = None) -> ComparedFrame:
        """Run the stages of the configurations on a frame."""
        a, *others = (
            session.perceive(self._variants.frame(frame, session.config), network)
            for session in self._sessions
        )
        b = others[0] if others else published_result(a.frame, self._topic, a.config)
        return ComparedFrame(a, b, None if self._truth is None else self._truth(a.frame))

    def finish(self, compared: ComparedFrame) -> ComparedFrame:
        """Finish the results of the configurations in frame order."""
        first, *others = self._sessions
        a, b = first.finish(compared.a), compared.b
        return replace(compared, a=a, b=others[0].finish(b) if others and b is not None else b)


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
    objects = robot_objects(frame.pose, labelled)
    return replace(FrameResult.unprocessed(frame, config, cameras), objects=objects)


def robot_objects(pose: F64, labelled: LabelledBoxes3D) -> Objects:
    """Return the robot's boxes as objects, for the (4, 4) pose of the points."""
    return make_objects(in_points_frame(pose, labelled), labelled.labels, labelled.scores, None, None)


def _published_2d(frame: Frame, camera: Camera) -> CameraResult:
    detections = [candidate for candidate in frame.robot_detections if candidate.camera == camera.name]
    return CameraResult(camera, detections_of(detections[0]) if detections else None, None)
