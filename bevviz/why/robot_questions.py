"""Questions about the robot's own nodes, which an extra answers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

from typing_extensions import TypedDict  # pydantic needs this one before Python 3.12

from bevviz.bags.source import BagSource
from bevviz.model.frame import F64, Frame
from bevviz.support.extensions import find

if TYPE_CHECKING:
    from bevviz.why.answer_results import FrameAnswers
    from bevviz.why.selection import Selection


RobotStep = TypedDict("RobotStep", {"about": str, "text": str, "changed": bool})
RobotSteps = TypedDict("RobotSteps", {"text": str, "steps": list[RobotStep], "notes": list[str]})


class RobotObject(Protocol):
    """One object of the robot, and its way through the robot's nodes."""

    @property
    def is_known(self) -> bool:
        """Whether a topic has the object."""

    def page_form(self) -> RobotSteps:
        """Return what the workbench shows: a text, the steps and notes."""


class RobotQuestions(Protocol):
    """Questions about the robot's own nodes around one frame of a bag."""

    def about(self, frame: Frame) -> RobotQuestions:
        """Return the questions about another frame of the bag."""

    def at(self, center: F64) -> RobotObject:
        """Follow the object at a place in the frame of the points."""


class Question(Protocol):
    """Question of ``bevviz why`` and of the workbench, registered in the group ``bevviz.questions``."""

    OPTIONS: type  # dataclass of the options of ``bevviz why`` by which a user asks it

    def answer(
        self,
        options: Any,
        source: BagSource,
        frame: Frame,
        selection: Selection,
        limit: int,
        everything: bool,
    ) -> tuple[FrameAnswers, Sequence[str]] | None:
        """Return the answer as JSON and as lines. None: the options do not ask it.

        Args:
            options: values of ``OPTIONS``.
            source: frames of the drive.
            frame: the asked frame.
            selection: the asked objects.
            limit: objects that are told with their steps.
            everything: tell also what went well.

        Raises:
            UserError: the selection is none of the question, or there is no answer.
        """

    def around(self, source: BagSource, frame: Frame) -> RobotQuestions:
        """Return the questions about a frame.

        Raises:
            UserError: the robot published no objects around the frame.
        """


def object_topics(source: BagSource) -> list[str]:
    """Return the topics of a bag with objects of the robot."""
    roles, names = source.roles, {topic.name for topic in source.recording.topics}
    return sorted(names & {*roles.robot_detections_3d, *roles.stages} - {*roles.robot_clouds})


def robot_questions(source: BagSource, frame: Frame, known: RobotQuestions | None) -> RobotQuestions:
    """Return the questions about a frame. ``known`` are those about another frame of the bag.

    Raises:
        UserError: the robot published no objects around the frame, or the extra is not installed.
    """
    if known is not None:
        return known.about(frame)
    question: Question = find("questions", "robot_chain")
    return question.around(source, frame)
