"""Source of frames from a running ROS 2 graph. It finds topics, follows restarts, and never blocks."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.live.graph import PublishedTopic, Subscriptions, published_topics
from bevviz.live.input_problems import InputProblems
from bevviz.live.inputs import KINDS, STALL, Inputs
from bevviz.live.live_message import LiveMessage
from bevviz.live.node import Node, add_timer, is_cut_off
from bevviz.live.problems import CurrentProblems
from bevviz.live.raw_recorder import RawRecorder, RawTopics
from bevviz.live.typesupport import message_type
from bevviz.messages.definitions import typestore
from bevviz.messages.encode import make_message
from bevviz.messages.roles import MARK, Roles
from bevviz.model.frame import Frame, Intrinsics, LateBoxes, Scene, UserMark
from bevviz.pipeline.run import MAX_BURST
from bevviz.support.contexts import Closable
from bevviz.support.extensions import load_all
from bevviz.support.queues import NewestQueue
from bevviz.sync.buffers import MARKS
from bevviz.sync.synchronizer import OVERTAKEN

LOOK = 0.5  # seconds between two looks at the graph
TICK = 0.05  # seconds between two checks for clouds that have waited long enough
SETTLE = 1.0  # seconds without a change of roles after which the scene is complete
PATIENCE = 3.0  # seconds that missing topics may delay the scene
CHANGING = "the topics are still changing"
CUT_OFF = (
    "Fast DDS has deleted shared memory that this process reads, as it may within 20 s after another was "
    "killed: end this one and start it again"
)


class LiveSource(Closable):
    """Source of a robot's frames as they become complete, until ``stop``.

    One thread receives, decodes and synchronises the messages. It passes frames through a short queue. The
    consumer gets the newest frames, and ``dropped`` counts the others. Events such as a lost publisher or a
    new calibration go to ``tell``.

    Args:
        config: roles and synchronisation.
        arguments: arguments after ``--ros-args``: remaps, namespace, parameters.
        tell: called with one sentence for each event, from the receiving thread.
        name: name of the node.
        raw: takes every serialised message, also of further topics (``live.raw_topics``).
        results: also receive the robot's bird's-eye view and obstacles.

    Raises:
        UserError: rclpy does not work, or refuses the arguments.
    """

    def __init__(
        self,
        config: Config,
        *,
        arguments: Sequence[str] = (),
        tell: Callable[[str], None] | None = None,
        name: str = "bevviz",
        raw: RawRecorder | None = None,
        results: bool = False,
    ) -> None:
        self.topics: dict[str, PublishedTopic] = {}  # topics published by other nodes
        self.problems = CurrentProblems(tell or (lambda text: None))
        self.raw = raw
        self._known: dict[str, PublishedTopic] = {}  # topics that may have a role, or had one
        self._settled = threading.Event()
        self._complete = False  # whether the scene is known
        self._lock = threading.RLock()  # guards the state that the receiving thread changes
        self._handover: NewestQueue[Frame] = NewestQueue(MAX_BURST, catch_up=True)
        self._dropped_before: int | None = None  # frames dropped before the iteration
        self._frames = 0
        self._numbers: deque[tuple[int, int]] = deque(maxlen=OVERTAKEN)  # stamp and index of recent frames
        self._marks: deque[UserMark] = deque(maxlen=MARKS)  # marks that no call of ``marks`` has returned
        self._ended = False

        self.nodes = Node(arguments, on_end=self.stop, name=name)
        self.inputs = Inputs(config, self.nodes.resolve, self.problems, results=results)
        self.watch = self.inputs.watch
        for kind in KINDS:  # To import them takes 0.1 s, in which the receiving thread would receive nothing.
            with suppress(UserError):
                message_type(kind)
        requests = [types.TypeRequests(self.nodes) for types in load_all("message_types", self.problems.tell)]
        self._subscriptions = Subscriptions(
            self.nodes, requests, self._locked(self._receive), self._locked(self._count_lost)
        )
        self._checks = InputProblems(self.nodes, self.inputs, self._subscriptions)
        self._raw_topics = None if raw is None else RawTopics(self.nodes, raw, requests)
        # Subscribed before it is published, because a mark may be sent once only.
        self._mark = PublishedTopic(self.nodes.resolve(MARK), "std_msgs/msg/String", ())
        add_timer(self.nodes.input, LOOK, self._locked(self._follow_graph))
        add_timer(self.nodes.input, TICK, self._locked(self._tick))
        self.nodes.start()

    def close(self) -> None:
        """Leave the graph."""
        self.stop()
        self.nodes.close()

    def stop(self) -> None:
        """End the iteration. Any thread may call it."""
        self._ended = True
        self._handover.close()
        self._settled.set()

    @property
    def roles(self) -> Roles:
        """Roles of the topics."""
        return self.inputs.roles

    @property
    def dropped(self) -> int:
        """Frames replaced by newer ones before they were taken, since the iteration began."""
        return self._handover.dropped - (self._dropped_before or 0)

    # --- as a source ---------------------------------------------------------------------------

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the scene is known: a LiDAR delivers and the roles are stable.

        Return False after the timeout, or if the source was stopped.
        """
        settled = self._settled.wait(timeout)
        self._check()
        return settled and not self._ended

    def wait_aloud(self, tell: Callable[[str], None], timeout: float = math.inf) -> bool:
        """Wait as ``wait`` does. Tell what is waited for, each time that it changes."""
        end, told = time.monotonic() + timeout, ""
        while not (settled := self.wait(max(0.0, min(1.0, end - time.monotonic())))):
            if time.monotonic() >= end:
                break
            if (missing := self.missing) and missing != told:
                told = missing
                tell(missing)
        return settled

    @property
    def missing(self) -> str:
        """One sentence with the conditions that ``wait`` waits for. Empty once the scene is known."""
        with self._lock:
            return "" if self._complete else "; ".join(self._lacking())

    def _lacking(self) -> list[str]:
        """Return the data that a first frame would lack, the worst first."""
        if not self.topics:
            return [
                f"nothing is published on ROS domain {self.nodes.domain}: is the robot running, with this "
                f"ROS_DOMAIN_ID, and not limited to its own machine (ROS_AUTOMATIC_DISCOVERY_RANGE)?"
            ]
        misstated = list(self.inputs.misstated(self.topics.values()).values())
        if not self.roles.lidars:
            return misstated or [self.roles.no_lidar or "no LiDAR yet"]
        used = [*self.roles.lidars, *(camera.topic for camera in self.roles.cameras)]
        silent = [topic for topic in used if not self.watch.received[topic]]
        why = f"; {CUT_OFF}" if silent and is_cut_off() else ""
        none = [f"no message on {', '.join(silent)} yet{why}"] if silent else []
        return [*misstated, *none, *self.inputs.sync.lacking()] or [CHANGING]

    @property
    def scene(self) -> Scene:
        """Names of the sensors, known after ``wait``. It changes when sensors appear later."""
        return self.roles.scene("live")

    @property
    def total(self) -> None:
        """None, because a live run has no known length."""
        return None

    @property
    def warnings(self) -> Sequence[str]:
        """Sentences about what was counted since the start and is no problem of ``problems``."""
        with self._lock:
            findings, known = list(self.inputs.sync.report.findings()), self.problems.all
        return [str(finding) for finding in findings if (finding.kind, finding.subject) not in known]

    @property
    def states(self) -> Mapping[str, str]:
        """State of each topic that has a role."""
        with self._lock:
            # Topics around the robot and marks are published irregularly.
            shown = {topic for topic, _, _ in self.roles.around} | {self._mark.name}
            states: dict[str, str] = {
                name: self.watch.state(name, published=name in self.topics)
                for name in self._subscriptions.topics - shown
            }
        doubtful = {problem.finding.subject for problem in self.problems.current}
        return {n: "degraded" if state == "ok" and n in doubtful else state for n, state in states.items()}

    def overtaken(self) -> tuple[LateBoxes, ...]:
        """Return the robot's results that no frame took, since the last call. Any thread may call it."""
        with self._lock:
            numbers = dict(self._numbers)
            return tuple(
                replace(late, index=numbers[late.frame_stamp])
                for late in self.inputs.sync.overtaken()
                if late.frame_stamp in numbers
            )

    def marks(self, index: int) -> tuple[UserMark, ...]:
        """Return the marks of frames up to this index since the last call, including dropped frames."""
        with self._lock:
            marks = tuple(mark for mark in self._marks if mark.index <= index)
            for _ in marks:
                self._marks.popleft()
        return marks

    def mark(self, text: str) -> None:
        """Take in a mark as if it came on the topic of marks. Any thread may call it."""
        kind, now = self._mark.type, time.time_ns()
        message = make_message(kind, data=text)
        data = bytes(typestore().serialize_cdr(message, kind))
        with self._lock:
            self._receive(self._mark, data, {"received_timestamp": now, "source_timestamp": now})

    def __iter__(self) -> Iterator[Frame]:
        if self._dropped_before is None:
            self._dropped_before = self._handover.dropped
        for frame in self._handover:
            if self._ended:
                break
            yield frame
        self._check()

    def _check(self) -> None:
        """Raise the exception that ended the receiving thread, if any."""
        if self.nodes.error is not None:
            raise self.nodes.error

    # --- the receiving thread ------------------------------------------------------------------

    def _locked(self, work: Callable[..., None]) -> Callable[..., None]:
        """Return a callback of the receiving thread that holds the lock while it works."""

        def run(*arguments: Any) -> None:
            with self._lock:
                work(*arguments)

        return run

    def _count_lost(self, topic: str, count: int) -> None:
        self.watch.lost[topic] += count

    def _receive(self, published: PublishedTopic, data: bytes, info: dict[str, Any]) -> None:
        """Take in a message and deliver the frames that it completes."""
        topic, inputs = published.name, self.inputs
        message = LiveMessage(topic, published.type, info["received_timestamp"] or time.time_ns(), data)
        if self._raw_topics is not None:
            self._raw_topics.put(self._known.get(topic, published), message.received, info, data)
        first = self.watch.count(topic, len(data))
        before = inputs.sync.cameras.intrinsics.get(topic)
        try:
            if first and inputs.learn(message):
                self._assign()
            if inputs.handle(message):
                self._assign()
            self.watch.mark_usable(topic)
        except UserError as error:
            self.watch.mark_unusable(topic, str(error))
        if before is not None:
            self._compare(topic, before, inputs.sync.cameras.intrinsics[topic])
        self._deliver(inputs.sync.ready(message.received))

    def _compare(self, topic: str, before: Intrinsics, after: Intrinsics) -> None:
        if (before.K != after.K).any() or before.D.tolist() != after.D.tolist():
            old, new = before.K[0, 0], after.K[0, 0]
            self.problems.tell(f"the calibration on {topic} has changed: fx {old:.1f} -> {new:.1f}")

    def _tick(self) -> None:
        """Deliver the frames whose clouds have waited long enough."""
        self.inputs.sync.absent = self._checks.apart.union(self._not_delivering())
        self._deliver(self.inputs.sync.ready(time.time_ns()))

    def _not_delivering(self) -> Iterator[str]:
        """Yield the topics for which no frame waits: without a publisher, silent, or not begun in time."""
        received, lidars = self.watch.received, self.roles.lidars
        published = self._subscriptions.topics & self.topics.keys()
        for name in self.inputs.handlers:
            missed = not received[name] and (self._complete or name in lidars)
            if missed or name not in published or self.watch.silent_for(name):
                yield name
        stalled = [name for name in lidars if self.watch.silent_for(name, STALL)]
        if len(stalled) < len(lidars):  # else this process or the whole robot has paused
            yield from stalled

    def _deliver(self, frames: Iterable[Frame]) -> None:
        """Queue frames for the consumer, with consecutive indices."""
        for frame in frames:
            if not self._complete:
                continue
            self._checks.observe(frame)
            self._numbers.append((frame.stamp, self._frames))
            for text in frame.around.marks if frame.around else ():
                self._marks.append(UserMark(text, self._frames, frame.stamp))
            self._handover.put(replace(frame, index=self._frames))
            self._frames += 1

    # --- the graph -----------------------------------------------------------------------------

    def _follow_graph(self) -> None:
        """Look at the graph: assign roles, subscribe, and report changes."""
        self.topics = published_topics(self.nodes, self.inputs.rank)
        known = {name: topic for name, topic in self._known.items() if self.watch.received[name]}
        known.setdefault(self._mark.name, self._mark)
        self._known = known | self.inputs.candidates(self.topics)
        self._assign()
        if self._raw_topics is not None:
            self._raw_topics.follow(self.topics, self._subscriptions.topics)
            self._report_unsaved(self._raw_topics.unknown)
        self._checks.look(self.topics, complete=self._complete)
        if not self._complete and self._is_settled():
            self._complete = True
            self._settled.set()

    def _is_settled(self) -> bool:
        """Return whether the roles are stable and every sensor delivers, or the patience is over."""
        calm = time.monotonic() - self.inputs.changed
        if calm < SETTLE or not any(self.watch.received[topic] for topic in self.roles.lidars):
            return False
        lacking = [text for text in self._lacking() if text != CHANGING]
        if lacking and calm > PATIENCE:
            self.problems.tell(f"not waited for any longer: {'; '.join(lacking)}")
        return not lacking or calm > PATIENCE

    def _assign(self) -> None:
        if not self.inputs.assign(self._known):
            return
        handlers = self.inputs.handlers
        for name in self._subscriptions.topics - handlers.keys():
            self._subscriptions.drop(name)
        for name in handlers:
            if self._raw_topics is not None:
                self._raw_topics.make_room(self._known[name])
            problem = self._subscriptions.listen(self._known[name])
            text = f"{name} is not received: {problem}" if problem else ""
            if problem != "":  # else a publisher may still answer
                self.problems.set("type", name, text, f"{name} can be received now")

    def _report_unsaved(self, unknown: Mapping[str, str]) -> None:
        """Report the topics that are not recorded because their type is unknown."""
        first, *others = sorted(unknown) or [""]
        more = f" (and {len(others)} more topics of unknown types)" if others else ""
        text = f"{first}{more} is not among the saved messages: {unknown[first]}" if unknown else ""
        self.problems.set("unsaved", "messages", text, "every topic of a known type is saved")
