"""Answers in plain values: what ``bevviz why`` writes as JSON, and what the page shows of an answer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from pydantic import ConfigDict, with_config
from typing_extensions import TypedDict  # pydantic needs this one before Python 3.12

from bevviz.support.json_form import WhereKnown, json_form
from bevviz.why.answer import Answer, Hint, TriedChange


@with_config(ConfigDict(extra="allow"))
class StepResult(TypedDict):
    """Result of one stage. Further keys are its numbers, by name."""

    stage: str
    text: str


@dataclass(frozen=True, slots=True)
class HintResult:
    """Change of parameters that changes the verdict. It was run."""

    settings: Sequence[str]
    """key=value each"""
    text: str
    fixed: Sequence[str]
    """objects that are reported then"""
    added: Sequence[str]
    """further objects"""
    false: Sequence[str]
    """further objects that are false"""
    lost: Sequence[str]
    """lost objects, without the false ones"""
    right: Sequence[str]
    """lost objects that were right"""
    false_gone: Sequence[str]
    """false objects that are gone"""
    changed: int
    """number of other changes"""
    beside: int | None
    """objects that it fixes in the frames before and after, minus those that it breaks; null: unknown"""

    @classmethod
    def of(cls, hint: Hint) -> HintResult:
        """Return a hint in plain values."""
        return cls(hint.settings, hint.text, **asdict(hint.effects.names), beside=hint.beside)


@json_form
@dataclass(frozen=True, slots=True)
class AnswerResult:
    """Answer about one object or place."""

    kind: str
    """truth, detection, cluster, object, track, point, cell ..."""
    name: str
    label: str
    """class; empty: unknown"""
    row: int
    """row in the results; -1: none"""
    camera: str
    """name of the camera; empty: none"""
    image_box: Sequence[float] | None
    """x0, y0, x1, y1 in pixels"""
    position: Sequence[float] | None
    """centre in the frame of the points, metres"""
    distance: float | None
    """metres from the LiDAR, on the ground"""
    points: int
    """points in its box"""
    reported: bool
    reason: str
    """one of the reasons in docs/reference.md"""
    verdict: str
    restored_by: Sequence[Sequence[str]]
    """smallest sets of stages (ground, clustering, detector, fusion) that together bring a missed object
    back: by their ideal results, without ground truth by the first hint; empty: none does"""
    likely: Sequence[str]
    """two reasons that each lost much of it, where nothing tells which one mattered"""
    folded: bool
    """no parameter can help"""
    false: bool
    """an object that no ground truth explains, or a doubtful one"""
    empty: bool
    """a place with nothing but ground or sky"""
    chain: Sequence[StepResult]
    """stages in order"""
    hints: Sequence[HintResult]
    """changes that help"""
    remark: str
    """the best hint in a sentence, or what was tried, or why nothing was"""
    tried: Sequence[TriedChange]

    @classmethod
    def of(cls, answer: Answer) -> AnswerResult:
        """Return an answer in plain values, without the points."""
        subject, verdict = answer.subject, answer.verdict
        box, chain = subject.box, list[Any]()
        for step in answer.steps:
            chain.append({"stage": step.stage, "text": step.text, **step.numbers})
        return cls(
            kind=subject.kind,
            name=subject.name,
            label=subject.label,
            row=subject.row,
            camera=subject.camera,
            image_box=None if subject.xyxy is None else [round(float(value), 2) for value in subject.xyxy],
            position=None if box is None else [round(float(value), 3) for value in box.center[0]],
            distance=None if np.isnan(answer.distance) else round(answer.distance, 1),
            points=answer.points,
            reported=verdict.reported,
            reason=verdict.kind.value,
            verdict=answer.text,
            restored_by=answer.restored_by,
            likely=[kind.value for kind in answer.likely],
            folded=answer.folded,
            false=answer.false,
            empty=answer.empty,
            chain=chain,
            hints=[*map(HintResult.of, answer.hints)],
            remark=answer.remark,
            tried=answer.tried,
        )


@dataclass(frozen=True, slots=True)
class OtherAnswer:
    """Another object at the place."""

    name: str
    verdict: str


@dataclass(frozen=True, slots=True)
class RobotStepResult:
    """Outcome of one of the robot's steps for an object."""

    topic: str
    """topic that the step makes"""
    parent: str
    """topic that had the object before; empty: none is known"""
    state: str
    """kept, dropped, not made, message lost, moved, renamed or delayed"""
    text: str


@dataclass(frozen=True, slots=True)
class RobotObjectResult:
    """An object of the robot."""

    text: str
    label: str
    center: Sequence[float]
    """metres, in the frame of the points"""
    step: str | None
    """topic of the first step that lost or changed it; null: none did"""
    state: str
    steps: Sequence[RobotStepResult]


@dataclass(frozen=True, slots=True)
class RobotResult:
    """The robot's own chain."""

    chain: Sequence[str]
    """one sentence for each topic"""
    objects: Sequence[RobotObjectResult]


@json_form
@dataclass(frozen=True, slots=True)
class FrameAnswers:
    """Answers about one frame."""

    frame: int
    """number of the scan"""
    stamp: int
    """nanoseconds since 1970"""
    preset: str
    summary: str
    """first line of the text"""
    answers: Sequence[AnswerResult]
    """worst first"""
    beside: Sequence[OtherAnswer]
    robot: WhereKnown[RobotResult] = None
    """--robot"""
