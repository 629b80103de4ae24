"""The robot's objects of some seconds of a bag, and what its steps did with those of one frame."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bevviz.bags.message import RawMessage
from bevviz.bags.source import BagSource
from bevviz.errors import UserError
from bevviz.extras.robot_chain.chain import (
    ENDED,
    NEAR,
    SECOND,
    ObjectMessage,
    RobotChain,
    StepOutcome,
    verdict,
)
from bevviz.messages.decoders import MessageError
from bevviz.messages.detections import decode_boxes
from bevviz.messages.guard import guard
from bevviz.messages.transforms import decode_transforms
from bevviz.model import geometry
from bevviz.model.frame import F64, Frame, LabelledBoxes3D
from bevviz.sync.transform_tree import TransformBuffer, TransformError
from bevviz.why.answer_results import RobotObjectResult, RobotStepResult
from bevviz.why.robot_questions import RobotSteps, object_topics

AROUND = 10 * SECOND  # nanoseconds before and after the frame that the chain is inferred from
LEAST = 4  # messages of a topic that the chain needs


@dataclass(frozen=True, slots=True)
class FollowedObject:
    """One object of the robot, and its way through the steps.

    Attributes:
        label: class name in the first topic that has it.
        center: (3,) place in the frame of the points.
        outcomes: one for each step that it could have reached.
        chain: the steps.
        notes: one sentence for each topic that is not in the chain.
        nodes: names of the nodes that publish a topic, by topic. Empty: the bag does not say them.
    """

    label: str
    center: F64
    outcomes: tuple[StepOutcome, ...]
    chain: RobotChain
    notes: Sequence[str]
    nodes: Mapping[str, str]

    @property
    def is_known(self) -> bool:
        """Whether a step has it."""
        return any(outcome.row >= 0 for outcome in self.outcomes)

    @property
    def change(self) -> StepOutcome | None:
        """The first step that lost, renamed, delayed or moved it. None: all have kept it."""
        return verdict(self.outcomes)

    @property
    def text(self) -> str:
        """One sentence: the object, and the step that changed it."""
        x, y, _ = self.center.tolist()
        name = f"{self.label or 'object'} at ({x:.1f}, {y:.1f})"
        change = self.change
        if change is None:
            kept = [one.topic for one in self.outcomes if one.row >= 0]
            return f"{name}: kept by all steps, the last is {kept[-1]}"
        if change.state == "unknown":
            return f"{name}: {ENDED}"
        verb = {"message lost": "lost with the whole message", "not made": "not made"}.get(
            change.state, change.state
        )
        node = self.nodes[change.topic]
        maker = f"{node}, which makes {change.topic}" if node else f"the step that makes {change.topic}"
        return f"{name}: {verb} by {maker}"

    def result(self) -> RobotObjectResult:
        """Return the object in plain values."""
        change = self.change
        return RobotObjectResult(
            text=self.text,
            label=self.label,
            center=[round(value, 2) for value in self.center.tolist()],
            step=None if change is None else change.topic,
            state="kept" if change is None else change.state,
            steps=[RobotStepResult(one.topic, one.parent, one.state, one.text) for one in self.outcomes],
        )

    def page_form(self) -> RobotSteps:
        """Return each step of the chain, with what it did with the object."""
        outcomes = {outcome.topic: outcome for outcome in self.outcomes}
        change = self.change
        return {
            "text": self.text,
            "steps": [
                {
                    "about": step_line(step.topic, self.chain, self.nodes[step.topic]).removeprefix(
                        f"{step.topic}: "
                    ),
                    "text": outcomes[step.topic].text if step.topic in outcomes else "",
                    "changed": change is not None and step.topic == change.topic,
                }
                for step in self.chain.steps
            ],
            "notes": list(self.notes),
        }


class RobotQuestions:
    """Questions about the robot's own chain around one frame of a bag.

    Args:
        source: the bag.
        frame: the frame.

    Attributes:
        chain: the chain.
        notes: one sentence for each topic that is not in the chain.

    Raises:
        UserError: the robot published no objects around the frame.
    """

    def __init__(self, source: BagSource, frame: Frame) -> None:
        self._source, self._frame = source, frame
        self._world, self._middle = frame.world_frame, frame.received
        self.notes: list[str] = []
        low, high = _window(frame.received, source.recording.start, source.recording.end)
        self._tf = TransformBuffer(4 * AROUND / SECOND)
        self._read_transforms(low, high)
        roles = source.roles
        names = object_topics(source)
        messages: dict[str, list[ObjectMessage]] = {name: [] for name in names}
        problems: dict[str, str] = {}
        for message in source.recording.messages(names, low, high):
            try:
                messages[message.topic].append(self._objects(message))
            except (MessageError, TransformError) as error:
                problems.setdefault(message.topic, f"{message.topic}: {error}")
        self.notes += problems.values()
        few = {name for name, those in messages.items() if len(those) < LEAST}
        self.notes += [
            f"{name}: {len(messages[name])} messages within {AROUND // SECOND} s, too few to tell"
            for name in sorted(few - problems.keys())
        ]
        if len(messages) == len(few):
            raise UserError(
                "no topic has objects of the robot around that frame; 'bevviz info' lists the topics"
            )
        sensors = {
            name: self._stamps(name, low, high) for name in (*roles.lidars, *(c.topic for c in roles.cameras))
        }
        self.chain = RobotChain({name: those for name, those in messages.items() if name not in few}, sensors)
        self._nodes = {name: source.recording.publishers(name) for name in names}

    def about(self, frame: Frame) -> RobotQuestions:
        """Return the questions about another frame. The chain is the same where the frame is near.

        Raises:
            UserError: the robot published no objects around the frame.
        """
        if frame.world_frame != self._world or abs(frame.received - self._middle) > AROUND // 2:
            return RobotQuestions(self._source, frame)
        questions = copy.copy(self)
        questions._frame = frame
        return questions

    # --- questions -----------------------------------------------------------------------------

    def at(self, center: F64 | Sequence[float]) -> FollowedObject:
        """Follow the object at a place in the frame of the points."""
        place = np.asarray(center, np.float64)
        world = geometry.apply(self._frame.pose, place[None].astype(np.float32))[0]
        outcomes = self.chain.follow(self._frame.stamp, world)
        return FollowedObject(
            self._label(outcomes), place, tuple(outcomes), self.chain, self.notes, self._nodes
        )

    def objects(self) -> list[FollowedObject]:
        """Follow every object that a step has in the frame. Changed ones come first, nearest first."""
        world_from_points, followed = geometry.inverse(self._frame.pose), list[FollowedObject]()
        for step in self.chain.steps:
            message = self.chain.nearest(step.topic, self._frame.stamp)
            if message is None or any(parent in self.chain.messages for parent in step.parents):
                continue
            for center in geometry.apply(world_from_points, message.center).astype(np.float64):
                if all(np.linalg.norm(center[:2] - one.center[:2]) > NEAR / 2 for one in followed):
                    followed.append(self.at(center))
        return sorted(followed, key=lambda one: (one.change is None, float(np.hypot(*one.center[:2]))))

    def _label(self, outcomes: Sequence[StepOutcome]) -> str:
        for outcome in outcomes:
            message = self.chain.nearest(outcome.topic, self._frame.stamp)
            if outcome.row >= 0 and message is not None and outcome.row < len(message.labels):
                return message.labels[outcome.row]
        return ""

    def lines(self) -> Iterator[str]:
        """Yield one line for each step of the chain."""
        for step in self.chain.steps:
            yield step_line(step.topic, self.chain, self._nodes[step.topic])
        yield from self.notes

    # --- reading -------------------------------------------------------------------------------

    def _read_transforms(self, low: int, high: int) -> None:
        recording, roles = self._source.recording, self._source.roles
        static = set(roles.tf_static)
        for names, start, stop in ((roles.tf_static, None, None), (roles.tf, low, high)):
            for message in recording.messages(names, start, stop):
                try:
                    content = recording.decode(message)
                    for transform in guard(message, decode_transforms, content, message.topic):
                        self._tf.add(transform, static=message.topic in static)
                except MessageError:
                    continue  # A run over the bag counts it.

    def _stamps(self, topic: str, low: int, high: int) -> list[int]:
        """Return the stamps of a sensor's messages."""
        stamps = []
        for message in self._source.recording.messages([topic], low, high):
            try:
                stamps.append(message.header()[0])
            except MessageError:
                continue
        return sorted(stamps)

    def _objects(self, message: RawMessage) -> ObjectMessage:
        """Return the objects of a message in the fixed frame.

        Raises:
            MessageError: the message cannot be decoded.
            TransformError: its frame has no transform to the fixed frame.
        """
        content = self._source.recording.decode(message)
        stated = self._source.roles.boxes
        stated = stated if stated.get("topic") == message.topic else {}
        boxes: LabelledBoxes3D = guard(
            message, decode_boxes, content, message.topic, message.received, stated
        )
        center = boxes.boxes.center.astype(np.float32)
        if len(center):
            frames: Mapping[str, F64] = {
                name: self._tf.lookup(self._world, name, boxes.stamp, 0.2).matrix
                for name in dict.fromkeys(boxes.frames or (boxes.frame_id,))
            }
            rows = boxes.frames or (boxes.frame_id,) * len(center)
            moved = [geometry.apply(frames[name], one[None]) for name, one in zip(rows, center, strict=True)]
            center = np.concatenate(moved).astype(np.float32)
        return ObjectMessage(boxes.stamp, message.received, center, boxes.boxes.size, boxes.labels, boxes.ids)


def _window(received: int, start: int, end: int) -> tuple[int, int]:
    """Return the log times around a frame that the chain is inferred from.

    Near an end of the bag the times reach further to its other side, so that no fewer messages tell the
    parents.
    """
    low = max(start, min(received - AROUND, end + 1 - 2 * AROUND))
    return low, low + 2 * AROUND


def step_line(topic: str, chain: RobotChain, node: str = "") -> str:
    """Return one line about a step: its node, what it is made from, with delay and loss."""
    step, maker = chain[topic], f"by {node}, " if node else ""
    if not step.parents:
        return f"{topic}: {maker}from which it is made cannot be told"
    rivals = f" (or {', '.join(step.rivals)}: they cannot be told apart)" if step.rivals else ""
    parts = [f"{1e3 * step.delay:.0f} ms later"]
    if step.parents[0] in chain.messages:
        parts += [f"{step.dropped:.0%} of the objects dropped"]
    parts += [f"{step.lost:.0%} of the messages lost"]
    return f"{topic}: {maker}from {' and '.join(step.parents)}{rivals}, {', '.join(parts)}"
