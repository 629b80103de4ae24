"""Option ``--robot`` of ``bevviz why``, and the questions of the workbench."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from bevviz.cli.command import Group, flag
from bevviz.errors import UserError

if TYPE_CHECKING:
    from bevviz.bags.source import BagSource
    from bevviz.extras.robot_chain.messages import RobotQuestions
    from bevviz.model.frame import Frame
    from bevviz.why import Selection
    from bevviz.why.answer_results import FrameAnswers


@dataclass(frozen=True, kw_only=True)
class RobotChainOptions:
    """Option for questions about the robot's own nodes."""

    group: ClassVar = Group("what to explain")

    robot: bool = flag(
        "which of the robot's own nodes lost, renamed, delayed or moved it (alone, --class or --point)"
    )


OPTIONS = RobotChainOptions


def around(source: BagSource, frame: Frame) -> RobotQuestions:
    """Return the questions about the robot's own chain around a frame.

    Raises:
        UserError: the robot published no objects around the frame.
    """
    from bevviz.extras.robot_chain.messages import RobotQuestions

    return RobotQuestions(source, frame)


def answer(
    options: RobotChainOptions,
    source: BagSource,
    frame: Frame,
    selection: Selection,
    limit: int,
    everything: bool,
) -> tuple[FrameAnswers, Sequence[str]] | None:
    """Say which steps of the robot's own chain lost or changed objects.

    Raises:
        UserError: an object is selected by other means than a place, or the chain cannot be told.
    """
    if not options.robot:
        return None
    from bevviz.why.answer_results import FrameAnswers, RobotResult

    if selection.one and not selection.point:
        raise UserError("--robot: give the object with --point, or all of a class with --class")
    questions = around(source, frame)
    followed = [questions.at(selection.point)] if selection.point else questions.objects()
    if selection.label:
        followed = [one for one in followed if one.label.lower() == selection.label.lower()]
    changed = [one for one in followed if one.change is not None]
    shown = followed if selection.point or everything else changed
    head = f"frame {frame.index}: {len(changed)} of the robot's {len(followed)} objects lost or changed"
    lines = [head, "", *questions.lines()]
    for number, one in enumerate(shown):
        steps = [f"  {outcome.text}" for outcome in one.outcomes] if number < limit else []
        lines += ["", one.text, *steps] if steps else [one.text]
    robot = RobotResult([*questions.lines()], [one.result() for one in shown])
    return FrameAnswers(frame.index, frame.stamp, source.config.preset, head, [], [], robot), lines
