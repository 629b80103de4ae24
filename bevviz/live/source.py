"""Frames from a running ROS 2 graph: topics are found, followed through restarts, and never waited for."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from bevviz.config import Config, SourceConfig, stage_topics
from bevviz.drivers import ouster
from bevviz.errors import UserError
from bevviz.live.arrival_watch import SILENCE, Watch
from bevviz.live.graph import (
    PublishedTopic,
    full_name,
    matched_qos,
    mismatches,
    published_topics,
)
from bevviz.live.live_message import LiveMessage
from bevviz.live.node import Node
from bevviz.live.ouster_sensors import Ousters
from bevviz.live.raw_recorder import RawRecorder
from bevviz.live.raw_topics import RawTopics
from bevviz.live.stated_topics import resolved, stated_topics, without_absent
from bevviz.live.type_sources import TypeSources
from bevviz.live.typesupport import message_type
from bevviz.messages import surroundings
from bevviz.messages.decoders import declared_decoder, reads_bytes
from bevviz.messages.definitions import store_of
from bevviz.messages.foreign_boxes import holds_boxes
from bevviz.messages.guard import guard
from bevviz.messages.roles import MARK, Roles, find_roles
from bevviz.messages.topics import Topic, foreign
from bevviz.model.frame import Frame, Intrinsics, LateResult, Mark, Scene
from bevviz.pipeline.run import BURST
from bevviz.support.contexts import Closing
from bevviz.support.queues import NewestQueue
from bevviz.sync.feed import Handler, make_around_handlers, make_handlers
from bevviz.sync.report import blindness
from bevviz.sync.surroundings import MARKS
from bevviz.sync.synchronizer import OVERTAKEN, Synchronizer

LOOK = 0.5  # seconds between two looks at the graph
TICK = 0.05  # seconds between two looks at the clouds that have waited long enough
SETTLE = 1.0  # seconds without a change of roles after which the scene is taken as complete
PATIENCE = 3.0  # seconds that what is lacking may delay the scene
FIRST = 1.0  # seconds of a subscription in which messages are lost as publishers are met
CHANGING = "the topics are still changing"
PIECE = 65_000  # bytes that DDS sends at once; what is larger goes in pieces

KINDS = {
    "sensor_msgs/msg/PointCloud2",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/CameraInfo",
    "tf2_msgs/msg/TFMessage",
    "nav_msgs/msg/Odometry",
    "sensor_msgs/msg/Imu",
    "vision_msgs/msg/Detection2DArray",
    "vision_msgs/msg/Detection3DArray",
    *surroundings.TYPES,
}


@dataclass(slots=True)
class _Subscription:
    handle: Any
    type: str
    qos: Any


class LiveSource(Closing):
    """The frames of a robot, as they become complete, until ``stop``.

    Messages are received, decoded and synchronised in a thread of their own. It hands over through a short
    queue: whoever iterates gets the newest frames, and those that nobody came for are counted in
    ``dropped``. What has to be said meanwhile (a lost publisher, a new calibration) goes to ``tell``.

    Args:
        config: roles and synchronisation.
        arguments: what follows ``--ros-args``: remaps, namespace, parameters.
        tell: called with one sentence each, from the receiving thread.
        name: of the node.
        raw: gets every message as it came, and those of further topics (``live.raw_topics``).
        results: the robot's own bird's-eye view and obstacles are received and shown, too.

    Raises:
        UserError: no working rclpy, or arguments that it refuses.
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
        self.config = config
        self._results = results
        self.roles = Roles()
        self.lost: Counter[str] = Counter()  # topic -> messages that the middleware could not deliver
        self.frame_ids: dict[str, str] = {}  # of each sensor topic's first message
        self.topics: dict[str, PublishedTopic] = {}  # all that others publish
        self._watch = Watch(tell or (lambda text: None))
        self._clock_resets = 0  # that were told
        self._known: dict[str, PublishedTopic] = {}  # that could play a role, or have
        self._subscriptions: dict[str, _Subscription] = {}
        self._handlers: dict[str, Handler[LiveMessage]] = {}
        self._sync = Synchronizer(self.roles, config)
        self._ousters = Ousters()
        self._begun = self._changed = self._last_cloud = time.monotonic()
        self._settled = threading.Event()
        self._complete = False  # the scene is known
        self._knowledge = threading.RLock()  # of all that the receiving thread changes piece by piece
        self._handover: NewestQueue[Frame] = NewestQueue(BURST, catch_up=True)
        self._iterated = False
        self._unasked = 0  # frames that came before anybody iterated
        self._frames = 0
        self._numbers: deque[tuple[int, int]] = deque(maxlen=OVERTAKEN)  # stamp and index of the last frames
        self._marks: deque[Mark] = deque(maxlen=MARKS)  # that nobody has asked for
        self._ended = False

        self._node = Node(arguments, on_end=self.stop, name=name)
        self._type_sources = TypeSources(self._node)
        self._raw = None if raw is None else RawTopics(self._node, raw, self._type_sources)
        mark = self._node.resolve(MARK)  # heard before anybody says something: it may be said once
        self._mark = PublishedTopic(mark, "std_msgs/msg/String", ())
        self._add_timer(LOOK, self._look)
        self._add_timer(TICK, self._tick)
        self._node.start()

    def close(self) -> None:
        """Leave the graph."""
        self.stop()
        self._node.close()

    def stop(self) -> None:
        """End the iteration, from any thread."""
        self._ended = True
        self._handover.close()
        self._settled.set()

    @property
    def node(self) -> Any:
        """The rclpy node, for what publishes back and takes orders; it has a thread of its own."""
        return self._node.node

    @property
    def domain(self) -> int:
        return self._node.domain

    @property
    def middleware(self) -> str:
        return self._node.middleware

    @property
    def dropped(self) -> int:
        """Frames that were overtaken by newer ones before they were taken, since somebody iterates."""
        return self._handover.dropped - self._unasked

    @property
    def tree(self) -> Mapping[str, str]:
        """Child to parent of the transforms met so far."""
        with self._knowledge:
            return dict(self._sync.tf.tree())

    # --- as a source ---------------------------------------------------------------------------

    def wait(self, timeout: float | None = None) -> bool:
        """Until the scene is known: a LiDAR delivers and the roles have settled. False: not yet."""
        settled = self._settled.wait(timeout)
        self._check()
        return settled and not self._ended

    @property
    def missing(self) -> str:
        """What ``wait`` waits for, in one sentence; empty once the scene is known."""
        with self._knowledge:
            return "" if self._complete else "; ".join(self._lacking())

    def _lacking(self) -> list[str]:
        """What a first frame would lack, the worst first."""
        if not self.topics:
            return [
                f"nothing is published on ROS domain {self._node.domain}: is the robot running, with this "
                f"ROS_DOMAIN_ID, and not limited to its own machine (ROS_AUTOMATIC_DISCOVERY_RANGE)?"
            ]
        misstated = list(self._misstated().values())
        if not self.roles.lidars:
            return misstated or [self.roles.no_lidar or "no LiDAR yet"]
        used = [*self.roles.lidars, *(camera.topic for camera in self.roles.cameras)]
        received = self.received
        silent = [topic for topic in used if not received[topic]]
        none = [f"no message on {', '.join(silent)} yet"] if silent else []
        return [*misstated, *none, *self._sync.lacking()] or [CHANGING]

    def _misstated(self) -> dict[str, str]:
        """Topics that the configuration states and that nobody publishes, or with another type."""
        found = {}
        stated = resolved(self.config.source, self._node.resolve)
        topics = {topic.name: topic for topic in self._look_up(self.topics.values(), stated)}
        for name, (key, kinds) in stated_topics(self.config, self._node.resolve).items():
            topic = topics.get(name)
            if topic is None:
                found[name] = f"nobody publishes {name}, which {key} states"
            elif topic.aside and "PointCloud2" in kinds:
                found[name] = f"{name}, which {key} states, holds {topic.aside}"
            elif kinds and topic.kind not in kinds:
                found[name] = f"{name} is a {topic.type}, but {key} takes {' or '.join(kinds)}"
        return found

    @property
    def scene(self) -> Scene:
        """Known after ``wait``; another one when sensors come up later."""
        return self.roles.scene("live")

    @property
    def total(self) -> None:
        return None

    @property
    def warnings(self) -> Sequence[str]:
        with self._knowledge:
            lost = [
                f"{count} message(s) of {topic} were lost on the way, see docs/live.md"
                for topic, count in self.lost.items()
            ]
            report = self._sync.report
            blind = blindness(self.config, self.roles, report) if self._complete else []
            return [*self._watch.warnings, *lost, *blind, *report.warnings()]

    @property
    def received(self) -> Counter[str]:
        """Messages so far, by topic."""
        return self._watch.received

    @property
    def volume(self) -> Counter[str]:
        """Bytes so far, by topic."""
        return self._watch.volume

    def delay(self, topic: str) -> float | None:
        """Seconds from a stamp to its receipt, the median of the last ones; None: not known."""
        with self._knowledge:
            return self._sync.clocks.lag(topic)

    @property
    def states(self) -> Mapping[str, str]:
        """How each topic that plays a role does."""
        with self._knowledge:
            shown = {topic for topic, _, _ in self.roles.around} | {self._mark.name}  # such come and go
            return self._watch.states(
                {name: name in self.topics for name in self._subscriptions.keys() - shown}
            )

    def overtaken(self) -> tuple[LateResult, ...]:
        """The robot's own results that no frame has taken, since the last call; from any thread."""
        with self._knowledge:
            numbers = dict(self._numbers)
            return tuple(
                replace(late, index=numbers[late.frame_stamp])
                for late in self._sync.overtaken()
                if late.frame_stamp in numbers
            )

    def marks(self, index: int) -> tuple[Mark, ...]:
        """Of the frames up to this index, also of those that were dropped, since the last call."""
        with self._knowledge:
            found = tuple(mark for mark in self._marks if mark.index <= index)
            for _ in found:
                self._marks.popleft()
        return found

    def __iter__(self) -> Iterator[Frame]:
        if not self._iterated:
            self._iterated, self._unasked = True, self._handover.dropped
        for frame in self._handover:
            if self._ended:
                break
            yield frame
        self._check()

    def _check(self) -> None:
        """Raise here what ended the receiving thread."""
        if self._node.error is not None:
            raise self._node.error

    # --- the receiving thread ------------------------------------------------------------------

    def _add_timer(self, period: float, callback: Callable[[], None]) -> None:
        from rclpy.clock import Clock
        from rclpy.clock_type import ClockType

        def run() -> None:
            with self._knowledge:
                callback()

        # Not the node's clock, which stands still where a simulation is paused.
        self._node.input.create_timer(period, run, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _receive(self, topic: str, kind: str, data: bytes, info: dict[str, Any]) -> None:
        message = LiveMessage(topic, kind, info["received_timestamp"] or time.time_ns(), data)
        if self._raw is not None:
            self._raw.put(self._known[topic], message.received, info, data)
        first = self._watch.add(topic, len(data))
        before = self._sync.cameras.intrinsics.get(topic)
        try:
            if first and Topic(topic, kind).kind.endswith(("PointCloud2", "Image")):
                self.frame_ids[topic] = message.header()[1]
                self._assign()
            if (handler := self._handlers.get(topic)) is not None:
                handler(message)
            self._watch.usable(topic)
        except UserError as error:
            self._watch.unusable(topic, str(error))
        if before is not None:
            self._compare(topic, before, self._sync.cameras.intrinsics[topic])
        if topic in self.roles.lidars:
            self._last_cloud = time.monotonic()
        self._deliver(self._sync.ready(message.received))

    def _compare(self, topic: str, before: Intrinsics, after: Intrinsics) -> None:
        if (before.K != after.K).any() or before.D.tolist() != after.D.tolist():
            old, new = before.K[0, 0], after.K[0, 0]
            self._watch.tell(f"the calibration on {topic} has changed: fx {old:.1f} -> {new:.1f}")

    def _tick(self) -> None:
        self._deliver(self._sync.ready(time.time_ns()))

    def _deliver(self, frames: Iterable[Frame]) -> None:
        for frame in frames:
            if not self._complete:
                continue
            self._numbers.append((frame.stamp, self._frames))
            for text in frame.around.marks if frame.around else ():
                self._marks.append(Mark(text, self._frames, frame.stamp))
            self._handover.put(replace(frame, index=self._frames))
            self._frames += 1

    # --- the graph -----------------------------------------------------------------------------

    def _look(self) -> None:
        self.topics = published_topics(self._node)
        received = self.received
        known = {name: topic for name, topic in self._known.items() if received[name]}
        known.setdefault(self._mark.name, self._mark)
        of_boxes = resolved(self.config.source, self._node.resolve).boxes.get("topic")
        packets = [name for name, topic in self.topics.items() if ouster.is_packet(topic.type)]
        besides = {of_boxes, *map(ouster.metadata_of, packets)}
        self._known = known | {
            name: topic for name, topic in self.topics.items() if _concerns(topic) or name in besides
        }
        self._assign()
        if self._raw is not None:
            self._raw.look(self.topics, self._subscriptions.keys())
        heard = self._subscriptions.keys() & self.topics.keys()
        self._sync.absent = frozenset(self._handlers.keys() - heard)
        for name, subscription in self._subscriptions.items():
            if name in self.topics or not any(name == shown for shown, _, _ in self.roles.around):
                self._look_at(name, subscription)  # what is shown around the robot comes and goes
        self._look_at_frames()
        if not self._complete and self._is_settled():
            self._complete = True
            self._settled.set()

    def _look_at(self, name: str, subscription: _Subscription) -> None:
        """At a topic that plays a role."""
        topic, watch = self.topics.get(name), self._watch
        gone = f"{name} has no publisher any more; waiting for it to come back"
        watch.note(f"{name} gone", gone if topic is None else "", f"{name} is published again")
        unheard = "; ".join(mismatches(topic, subscription.qos)) if topic is not None else ""
        watch.note(f"{name} quality", unheard, f"{name}: every publisher is received")
        silent = topic is not None and name not in self.roles.lidars and watch.silent_for(name) > 0
        quiet = f"no message on {name} for {SILENCE:.0f} s, though it has a publisher"
        watch.note(f"{name} silence", quiet if silent else "", f"{name} is back")
        sensors = {*self.roles.lidars, *(camera.topic for camera in self.roles.cameras)}
        several = topic is not None and name in sensors and len(topic.publishers) > 1
        names = ", ".join(map(full_name, topic.publishers)) if topic is not None else ""
        mixed = f"{name} has several publishers, taken for one sensor: {names}; remap all but one"
        watch.note(f"{name} publishers", mixed if several else "", f"{name} has one publisher")
        if self.lost[name]:
            size = watch.volume[name] / max(1, watch.received[name])
            watch.once(f"messages of {name} are lost on the way: {remedy(size)}")

    def _look_at_frames(self) -> None:
        """At what the synchroniser found odd."""
        watch, report = self._watch, self._sync.report
        for name in report.overtaken:
            watch.once(f"{name} comes when its frame has gone on: shown at its own stamp")
        for name in report.unstamped:
            watch.once(f"{name}: no stamp in the header, time of receipt is used instead")
        for camera, reason in report.first_undecodable.items():
            watch.once(f"camera '{camera}': an image could not be decoded: {reason}")
        if report.resets > self._clock_resets:
            watch.tell("the stamps of the clouds jumped back: a simulation or a bag that began anew")
            self._clock_resets = report.resets
        twin = (
            f"another node is called {self._node.node.get_fully_qualified_name()}: orders for one may reach "
            f"the other; --ros-args -r __node:=bevviz_2 gives this one another name"
        )
        watch.note("name", "" if self._node.is_alone else twin, "no other node has the name of this one now")
        silent = self._complete and time.monotonic() - self._last_cloud > SILENCE
        quiet = f"no cloud for {SILENCE:.0f} s on {', '.join(self.roles.lidars)}"
        watch.note("silence", quiet if silent else "", "the clouds are back")
        misstated = self._misstated() if time.monotonic() - self._begun > SETTLE + LOOK else {}
        for name in stated_topics(self.config, self._node.resolve):
            watch.note(
                f"{name} stated", misstated.get(name, ""), f"{name} is there, as the configuration states"
            )

    def _is_settled(self) -> bool:
        calm = time.monotonic() - self._changed
        if calm < SETTLE or not any(self.received[topic] for topic in self.roles.lidars):
            return False
        lacking = [text for text in self._lacking() if text != CHANGING]
        if lacking and calm > PATIENCE:
            self._watch.tell(f"not waited for any longer: {'; '.join(lacking)}")
        return not lacking or calm > PATIENCE

    def _assign(self) -> None:
        """Give the topics their roles, and listen to those that play one."""
        stated = resolved(self.config.source, self._node.resolve)
        topics = self._look_up(self._known.values(), stated)
        if stated.lidar_topics:  # packets without their metadata are waited for
            topics = [t for t in topics if not (t.aside and t.name in stated.lidar_topics)]
        there = {topic.name for topic in topics}
        # As with sensors: one that is not there yet is waited for.
        stages = {key: self._node.resolve(name) for key, name in stage_topics(self.config).items()}
        stages = {key: name for key, name in stages.items() if name in there}
        try:
            roles = find_roles(*without_absent(topics, stated), stages, results=self._results)
        except UserError as error:
            self._watch.note("roles", str(error))
            return
        self._watch.note("roles", "", "the topics fit the configuration")
        if replace(roles, notes={}) != replace(self.roles, notes={}):
            self._changed = time.monotonic()
            results = {*roles.robot_detections_2d, *roles.robot_detections_3d} - set(stages.values())
            former, self._sync = self._sync, Synchronizer(roles, self.config, beside=results)
            self._sync.take_over(former)
            self._handlers = make_handlers(self._sync, roles, self._decode)
            for name in self._ousters.packets & self._handlers.keys():
                self._handlers[name] = partial(self._gather, self._handlers[name])
        elif roles.around != self.roles.around:
            others = self._handlers.keys() - {topic for topic, _, _ in self.roles.around}
            self._handlers = {topic: self._handlers[topic] for topic in others}
            self._handlers |= make_around_handlers(self._sync, roles, LiveMessage.decode)
        self.roles = roles
        told = [name for name in self._ousters.metadata if name in self._known]
        self._handlers |= dict.fromkeys(told, self._add_metadata)
        for name in self._subscriptions.keys() - self._handlers.keys():
            self._node.input.destroy_subscription(self._subscriptions.pop(name).handle)
        for name in self._handlers:
            self._listen(self._known[name])

    def _look_up(self, topics: Iterable[PublishedTopic], stated: SourceConfig) -> list[Topic]:
        """What is known of topics, given what the configuration states."""
        boxes = stated.boxes.get("topic", "")
        found = [
            Topic(t.name, t.type, None, self.frame_ids.get(t.name, ""), boxes=t.name == boxes) for t in topics
        ]
        return self._ousters.look(found, stated.lidar_calibration)

    def _add_metadata(self, message: LiveMessage) -> None:
        text = guard(message, surroundings.decode_mark, message.decode())
        if self._ousters.add_metadata(message.topic, text):
            self._watch.tell(f"the metadata on {message.topic} have changed")
        self._assign()

    def _gather(self, handler: Handler[LiveMessage], message: LiveMessage) -> None:
        """Packets go on as scans, each received when its last one was."""
        sensor = self._ousters.sensor(message.topic)
        for packets in self._ousters.add_packet(message.topic, message.received, message.data):
            handler(replace(message, received=packets[-1][0], data=b"", sensor=sensor, packets=packets))

    def _decode(self, message: LiveMessage) -> Any:
        return message.decode(resolved(self.config.source, self._node.resolve).lidar_calibration)

    def _listen(self, topic: PublishedTopic) -> None:
        """Subscribe, or again where the publishers now offer something else."""
        from rclpy.event_handler import SubscriptionEventCallbacks

        try:
            kind = message_type(topic.type)
            if not reads_bytes(topic.type):
                store_of(topic.type)
        except UserError as error:
            why = self._type_sources.ask(topic)
            text = f"{topic.name} is not received: {error}; {why}" if why is not None else ""
            self._watch.note(f"{topic.name} type", text)
            return
        self._watch.note(f"{topic.name} type", "", f"{topic.name} can be received now")
        qos = matched_qos(topic.publishers, topic.type.rpartition("/")[2])
        former = self._subscriptions.get(topic.name)
        if former is not None:
            if (former.type, former.qos) == (topic.type, qos):
                return
            self._node.input.destroy_subscription(former.handle)

        def receive(data: bytes, info: dict[str, Any]) -> None:
            with self._knowledge:
                self._receive(topic.name, topic.type, data, info)

        since = time.monotonic()

        def count_lost(event: Any) -> None:
            if time.monotonic() - since < FIRST:
                return
            with self._knowledge:
                self.lost[topic.name] += event.total_count_change

        events = SubscriptionEventCallbacks(
            message_lost=count_lost,
            incompatible_qos=lambda event: None,  # told by name in ``_look``
            use_default_callbacks=False,
        )
        handle = self._node.input.create_subscription(
            kind, topic.name, receive, qos, event_callbacks=events, raw=True
        )
        self._subscriptions[topic.name] = _Subscription(handle, topic.type, qos)


def remedy(size: float) -> str:
    """What helps where messages of so many bytes are lost on the way."""
    if size > PIECE:
        return "a larger segment of the publisher's helps, see 'Clouds were lost on the way' in docs/live.md"
    return "small ones are where a machine is too busy; a longer queue (depth) of the publisher's helps"


def _concerns(topic: PublishedTopic) -> bool:
    """Whether a topic can play a role, or holds what could, in a form that nothing here reads."""
    return (
        topic.type in KINDS
        or declared_decoder(topic.type) is not None
        or holds_boxes(topic.type)
        or bool(foreign(Topic(topic.name, topic.type, None, "")))
    )
