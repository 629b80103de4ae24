"""Source of frames from a running ROS 2 graph. It finds topics, follows restarts, and never blocks."""

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
from bevviz.messages.topics import Topic, unsupported_reason
from bevviz.model.frame import Frame, Intrinsics, LateBoxes, Scene, UserMark
from bevviz.pipeline.run import MAX_BURST
from bevviz.support.contexts import Closable
from bevviz.support.queues import NewestQueue
from bevviz.sync.buffers import MARKS
from bevviz.sync.feed import Handler, make_around_handlers, make_handlers
from bevviz.sync.report import why_no_images
from bevviz.sync.synchronizer import OVERTAKEN, Synchronizer

LOOK = 0.5  # seconds between two looks at the graph
TICK = 0.05  # seconds between two checks for clouds that have waited long enough
SETTLE = 1.0  # seconds without a change of roles after which the scene is complete
PATIENCE = 3.0  # seconds that missing topics may delay the scene
FIRST = 1.0  # seconds after subscribing in which lost messages are expected and not counted
CHANGING = "the topics are still changing"
PIECE = 65_000  # bytes, largest message that DDS sends in one piece

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
    """Subscription with its type and quality of service."""

    handle: Any
    type: str
    qos: Any


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
        self.config = config
        self._results = results
        self.roles = Roles()
        self.lost: Counter[str] = Counter()  # topic -> messages that the middleware lost
        self.frame_ids: dict[str, str] = {}  # topic -> frame id of its first message
        self.topics: dict[str, PublishedTopic] = {}  # topics published by other nodes
        self._watch = Watch(tell or (lambda text: None))
        self._clock_resets = 0  # resets of the stamps that were reported
        self._known: dict[str, PublishedTopic] = {}  # topics that may have a role, or had one
        self._subscriptions: dict[str, _Subscription] = {}
        self._handlers: dict[str, Handler[LiveMessage]] = {}
        self._sync = Synchronizer(self.roles, config)
        self._ousters = Ousters()
        self._begun = self._changed = self._last_cloud = time.monotonic()
        self._settled = threading.Event()
        self._complete = False  # whether the scene is known
        self._knowledge = threading.RLock()  # guards the state that the receiving thread changes
        self._handover: NewestQueue[Frame] = NewestQueue(MAX_BURST, catch_up=True)
        self._iterated = False
        self._unasked = 0  # frames dropped before the first iteration
        self._frames = 0
        self._numbers: deque[tuple[int, int]] = deque(maxlen=OVERTAKEN)  # stamp and index of recent frames
        self._marks: deque[UserMark] = deque(maxlen=MARKS)  # marks that no call of ``marks`` has returned
        self._ended = False

        self._node = Node(arguments, on_end=self.stop, name=name)
        self._type_sources = TypeSources(self._node)
        self._raw = None if raw is None else RawTopics(self._node, raw, self._type_sources)
        # Subscribed before it is published, because a mark may be sent once only.
        mark = self._node.resolve(MARK)
        self._mark = PublishedTopic(mark, "std_msgs/msg/String", ())
        self._add_timer(LOOK, self._look)
        self._add_timer(TICK, self._tick)
        self._node.start()

    def close(self) -> None:
        """Leave the graph."""
        self.stop()
        self._node.close()

    def stop(self) -> None:
        """End the iteration. Any thread may call it."""
        self._ended = True
        self._handover.close()
        self._settled.set()

    @property
    def node(self) -> Any:
        """The rclpy node for publishing and services. It has its own thread."""
        return self._node.node

    @property
    def domain(self) -> int:
        """ROS domain id."""
        return self._node.domain

    @property
    def middleware(self) -> str:
        """Name of the middleware."""
        return self._node.middleware

    @property
    def dropped(self) -> int:
        """Frames replaced by newer ones before they were taken, since the iteration began."""
        return self._handover.dropped - self._unasked

    @property
    def tree(self) -> Mapping[str, str]:
        """Parent of each child frame, of the transforms received so far."""
        with self._knowledge:
            return dict(self._sync.tf.tree())

    # --- as a source ---------------------------------------------------------------------------

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the scene is known: a LiDAR delivers and the roles are stable.

        Return False after the timeout, or if the source was stopped.
        """
        settled = self._settled.wait(timeout)
        self._check()
        return settled and not self._ended

    @property
    def missing(self) -> str:
        """One sentence with the conditions that ``wait`` waits for. Empty once the scene is known."""
        with self._knowledge:
            return "" if self._complete else "; ".join(self._lacking())

    def _lacking(self) -> list[str]:
        """Return the data that a first frame would lack, the worst first."""
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
        """Return the topics of the configuration that nobody publishes, or that have another type."""
        problems = {}
        stated = resolved(self.config.source, self._node.resolve)
        topics = {topic.name: topic for topic in self._look_up(self.topics.values(), stated)}
        for name, (key, kinds) in stated_topics(self.config, self._node.resolve).items():
            topic = topics.get(name)
            if topic is None:
                problems[name] = f"nobody publishes {name}, which {key} states"
            elif topic.aside and "PointCloud2" in kinds:
                problems[name] = f"{name}, which {key} states, holds {topic.aside}"
            elif kinds and topic.kind not in kinds:
                problems[name] = f"{name} is a {topic.type}, but {key} takes {' or '.join(kinds)}"
        return problems

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
        """Sentences about current problems and lost messages."""
        with self._knowledge:
            lost = [
                f"{count} message(s) of {topic} were lost on the way, see docs/live.md"
                for topic, count in self.lost.items()
            ]
            report = self._sync.report
            blind = why_no_images(self.config, self.roles, report) if self._complete else []
            return [*self._watch.warnings, *lost, *blind, *report.warnings()]

    @property
    def received(self) -> Counter[str]:
        """Messages received so far, by topic."""
        return self._watch.received

    @property
    def volume(self) -> Counter[str]:
        """Bytes received so far, by topic."""
        return self._watch.volume

    def delay(self, topic: str) -> float | None:
        """Return the median seconds from a stamp to its receipt, or None if unknown."""
        with self._knowledge:
            return self._sync.clocks.lag(topic)

    @property
    def states(self) -> Mapping[str, str]:
        """State of each topic that has a role."""
        with self._knowledge:
            # Topics around the robot and marks are published irregularly.
            shown = {topic for topic, _, _ in self.roles.around} | {self._mark.name}
            return self._watch.states(
                {name: name in self.topics for name in self._subscriptions.keys() - shown}
            )

    def overtaken(self) -> tuple[LateBoxes, ...]:
        """Return the robot's results that no frame took, since the last call. Any thread may call it."""
        with self._knowledge:
            numbers = dict(self._numbers)
            return tuple(
                replace(late, index=numbers[late.frame_stamp])
                for late in self._sync.overtaken()
                if late.frame_stamp in numbers
            )

    def marks(self, index: int) -> tuple[UserMark, ...]:
        """Return the marks of frames up to this index since the last call, including dropped frames."""
        with self._knowledge:
            marks = tuple(mark for mark in self._marks if mark.index <= index)
            for _ in marks:
                self._marks.popleft()
        return marks

    def __iter__(self) -> Iterator[Frame]:
        if not self._iterated:
            self._iterated, self._unasked = True, self._handover.dropped
        for frame in self._handover:
            if self._ended:
                break
            yield frame
        self._check()

    def _check(self) -> None:
        """Raise the exception that ended the receiving thread, if any."""
        if self._node.error is not None:
            raise self._node.error

    # --- the receiving thread ------------------------------------------------------------------

    def _add_timer(self, period: float, callback: Callable[[], None]) -> None:
        """Call a function regularly in the receiving thread."""
        from rclpy.clock import Clock
        from rclpy.clock_type import ClockType

        def run() -> None:
            with self._knowledge:
                callback()

        # A steady clock. The node's clock stands still while a simulation is paused.
        self._node.input.create_timer(period, run, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _receive(self, topic: str, kind: str, data: bytes, info: dict[str, Any]) -> None:
        """Take in a message and deliver the frames that it completes."""
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
        """Report a changed calibration."""
        if (before.K != after.K).any() or before.D.tolist() != after.D.tolist():
            old, new = before.K[0, 0], after.K[0, 0]
            self._watch.tell(f"the calibration on {topic} has changed: fx {old:.1f} -> {new:.1f}")

    def _tick(self) -> None:
        """Deliver the frames whose clouds have waited long enough."""
        self._deliver(self._sync.ready(time.time_ns()))

    def _deliver(self, frames: Iterable[Frame]) -> None:
        """Queue frames for the consumer, with consecutive indices."""
        for frame in frames:
            if not self._complete:
                continue
            self._numbers.append((frame.stamp, self._frames))
            for text in frame.around.marks if frame.around else ():
                self._marks.append(UserMark(text, self._frames, frame.stamp))
            self._handover.put(replace(frame, index=self._frames))
            self._frames += 1

    # --- the graph -----------------------------------------------------------------------------

    def _look(self) -> None:
        """Look at the graph: assign roles, subscribe, and report changes."""
        self.topics = published_topics(self._node)
        received = self.received
        known = {name: topic for name, topic in self._known.items() if received[name]}
        known.setdefault(self._mark.name, self._mark)
        of_boxes = resolved(self.config.source, self._node.resolve).boxes.get("topic")
        packets = [name for name, topic in self.topics.items() if ouster.is_packet(topic.type)]
        besides = {of_boxes, *map(ouster.metadata_topic, packets)}
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
                self._look_at(name, subscription)  # topics shown around the robot come and go
        self._look_at_frames()
        if not self._complete and self._is_settled():
            self._complete = True
            self._settled.set()

    def _look_at(self, name: str, subscription: _Subscription) -> None:
        """Report problems of one topic that has a role."""
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
        """Report problems that the synchroniser found."""
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
        """Return whether the roles are stable and every sensor delivers, or the patience is over."""
        calm = time.monotonic() - self._changed
        if calm < SETTLE or not any(self.received[topic] for topic in self.roles.lidars):
            return False
        lacking = [text for text in self._lacking() if text != CHANGING]
        if lacking and calm > PATIENCE:
            self._watch.tell(f"not waited for any longer: {'; '.join(lacking)}")
        return not lacking or calm > PATIENCE

    def _assign(self) -> None:
        """Assign roles to the topics and subscribe to those with a role."""
        stated = resolved(self.config.source, self._node.resolve)
        topics = self._look_up(self._known.values(), stated)
        if stated.lidar_topics:  # packets without metadata do not have a role yet
            topics = [t for t in topics if not (t.aside and t.name in stated.lidar_topics)]
        topic_names = {topic.name for topic in topics}
        # An absent topic of a stage is waited for, as an absent sensor is.
        stages = {key: self._node.resolve(name) for key, name in stage_topics(self.config).items()}
        stages = {key: name for key, name in stages.items() if name in topic_names}
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
        metadata_topics = [name for name in self._ousters.metadata if name in self._known]
        self._handlers |= dict.fromkeys(metadata_topics, self._add_metadata)
        for name in self._subscriptions.keys() - self._handlers.keys():
            self._node.input.destroy_subscription(self._subscriptions.pop(name).handle)
        for name in self._handlers:
            self._listen(self._known[name])

    def _look_up(self, topics: Iterable[PublishedTopic], stated: SourceConfig) -> list[Topic]:
        """Return the known facts about topics, given the stated topics of the configuration."""
        boxes = stated.boxes.get("topic", "")
        known_topics = [
            Topic(t.name, t.type, None, self.frame_ids.get(t.name, ""), boxes=t.name == boxes) for t in topics
        ]
        return self._ousters.look(known_topics, stated.lidar_calibration)

    def _add_metadata(self, message: LiveMessage) -> None:
        """Take in the metadata of an Ouster."""
        text = guard(message, surroundings.decode_mark, message.decode())
        if self._ousters.add_metadata(message.topic, text):
            self._watch.tell(f"the metadata on {message.topic} have changed")
        self._assign()

    def _gather(self, handler: Handler[LiveMessage], message: LiveMessage) -> None:
        """Gather packets to scans and pass these on. A scan has the time of receipt of its last packet."""
        sensor = self._ousters.sensor(message.topic)
        for packets in self._ousters.add_packet(message.topic, message.received, message.data):
            handler(replace(message, received=packets[-1][0], data=b"", sensor=sensor, packets=packets))

    def _decode(self, message: LiveMessage) -> Any:
        """Decode a message with the calibration of the configuration."""
        return message.decode(resolved(self.config.source, self._node.resolve).lidar_calibration)

    def _listen(self, topic: PublishedTopic) -> None:
        """Subscribe to a topic, or again if the offered type or quality of service has changed."""
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
            incompatible_qos=lambda event: None,  # reported by name in ``_look_at``
            use_default_callbacks=False,
        )
        handle = self._node.input.create_subscription(
            kind, topic.name, receive, qos, event_callbacks=events, raw=True
        )
        self._subscriptions[topic.name] = _Subscription(handle, topic.type, qos)


def remedy(size: float) -> str:
    """Return advice for lost messages of this size in bytes."""
    if size > PIECE:
        return "a larger segment of the publisher's helps, see 'Clouds were lost on the way' in docs/live.md"
    return "small ones are where a machine is too busy; a longer queue (depth) of the publisher's helps"


def _concerns(topic: PublishedTopic) -> bool:
    """Return whether a topic may have a role, or may hold sensor data in an unsupported form."""
    return (
        topic.type in KINDS
        or declared_decoder(topic.type) is not None
        or holds_boxes(topic.type)
        or bool(unsupported_reason(Topic(topic.name, topic.type, None, "")))
    )
