"""Buffer of the serialised messages of the last seconds, and the choice of the topics that it records."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence, Set
from contextlib import suppress
from typing import Any, NamedTuple

from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)

from bevviz.config import LiveConfig
from bevviz.config.reloading import ReloadableConfig
from bevviz.errors import UserError
from bevviz.live.graph import TRANSFORMS, UNKNOWN, PublishedTopic, Subscriptions, TypeRequests, full_name
from bevviz.live.node import Node
from bevviz.messages.definitions import definition, deserialize_cdr, store_of, typestore
from bevviz.messages.foreign_boxes import holds_boxes

MEGABYTE = 1_000_000
LEAD = 3.0  # seconds before the first frame, in which its synchronised messages and transforms came
SMALL = 1_000_000  # bytes a second, limit for a topic without a role
TRIAL = 5.0  # seconds over which that rate is measured
BULKY = frozenset({"PointCloud2", "Image", "CompressedImage"})
PACKETS = frozenset({"PacketMsg", "PandarScan", "VelodyneScan", "CustomMsg", "CompressedPointCloud2"})


class RawMessage(NamedTuple):
    """Serialised message. Times are nanoseconds since 1970: receipt by the middleware, and publication."""

    connection: Connection
    received: int
    sent: int
    data: bytes

    @property
    def passing(self) -> bool:
        """Whether the message is valid at its own time only, as a scan or an image is."""
        return self.connection.msgtype.rpartition("/")[2] in BULKY | PACKETS


Sink = Callable[[RawMessage], None]


class LatchedMessages:
    """Messages that stay valid until replaced: the last one of each topic, and of each transform.

    So a map, a calibration, a robot description and a mounting are kept even if they were published once,
    long ago. Clouds, packets and images are not kept.
    """

    def __init__(self) -> None:
        self._last: dict[tuple[str, tuple[str, ...]], RawMessage] = {}
        self.size = 0

    def add(self, message: RawMessage) -> None:
        """Keep a message in place of the last one, if messages of this type stay valid."""
        if message.passing:
            return
        is_tf = message.connection.msgtype.endswith("/TFMessage")
        key = message.connection.topic, children(message.data) if is_tf else ()
        former = self._last.pop(key, None)  # removed first, so that the order is that of the messages
        self._last[key] = message
        self.size += len(message.data) - (0 if former is None else len(former.data))

    def copy(self) -> LatchedMessages:
        """Return a copy that changes independently."""
        other = LatchedMessages()
        other._last, other.size = dict(self._last), self.size
        return other

    def before(self, received: int) -> list[RawMessage]:
        """Return the messages with times of receipt just before this one.

        With their true times, a player of the bag would wait for hours.
        """
        return [
            message._replace(received=received - place)
            for place, message in zip(range(len(self._last), 0, -1), self._last.values(), strict=True)
        ]


class RawRecorder:
    """Buffer of the messages of the last ``live.flight_time`` plus ``LEAD``, limited by ``live.raw_size``.

    One thread adds messages. Any thread may call everything else.
    """

    def __init__(self, settings: ReloadableConfig) -> None:
        self._settings = settings
        self.left_out: dict[str, str] = {}  # published topic that is not recorded -> reason
        self._types: dict[str, str] = {}  # by recorded topic
        self._messages: deque[tuple[float, RawMessage]] = deque()  # with the monotonic time of ``put``
        self._latched = LatchedMessages()
        self._size = self._since = 0
        self._sink: Sink | None = None
        self._lock = threading.RLock()

    @property
    def config(self) -> LiveConfig:
        """Limits in force."""
        return self._settings.config.live

    @property
    def size(self) -> int:
        """Bytes in the buffer."""
        return self._size + self._latched.size

    @property
    def seconds(self) -> float:
        """Seconds from the oldest to the newest message."""
        with self._lock:
            return self._messages[-1][0] - self._messages[0][0] if self._messages else 0.0

    @property
    def since(self) -> int:
        """Time of receipt from which on all messages are in the buffer, nanoseconds. 0: none was dropped."""
        return self._since

    @property
    def object_topics(self) -> set[str]:
        """Topics with objects in space that were recorded, also such that came too late for each frame."""
        types = dict(self._types)  # the receiving thread may add one
        return {
            name for name, kind in types.items() if kind.endswith("/Detection3DArray") or holds_boxes(kind)
        }

    def put(self, message: RawMessage) -> None:
        """Add a message, drop old ones, and pass it to the attached sink."""
        now = time.monotonic()
        self._types[message.connection.topic] = message.connection.msgtype
        with self._lock:
            self._messages.append((now, message))
            self._size += len(message.data)
            self._forget(now)
            if self._sink is not None:
                self._sink(message)

    def _forget(self, now: float) -> None:
        """Drop messages that are too old or too many."""
        config = self.config
        recording = config.flight_time > 0 and config.raw_size > 0
        lead = LEAD if self._sink is not None else 0.0  # each part of a saved bag begins with these seconds
        oldest = now - (config.flight_time + LEAD if recording else lead)
        while self._messages and (
            self._messages[0][0] <= oldest
            or (self._size > config.raw_size * MEGABYTE and self._messages[0][0] <= now - lead)
        ):
            _, message = self._messages.popleft()
            self._since = message.received + 1
            self._size -= len(message.data)
            self._latched.add(message)

    def messages(self, seconds: float | None = None) -> list[RawMessage]:
        """Return the messages of the last seconds, or all, in order of receipt.

        The earlier messages that are still valid come first.
        """
        with self._lock:
            since = -1.0 if seconds is None else time.monotonic() - seconds
            recent: list[RawMessage] = []
            latched = self._latched.copy()
            for at, message in self._messages:
                if at >= since:
                    recent.append(message)
                else:
                    latched.add(message)
        recent.sort(key=lambda message: message.received)
        first = recent[0].received if recent else time.time_ns()
        messages = [*latched.before(first), *recent]
        # The last connection of a topic has the names of its nodes, which may be discovered late.
        newest = {(m.connection.topic, m.connection.msgtype): m.connection for m in messages}
        return [m._replace(connection=newest[m.connection.topic, m.connection.msgtype]) for m in messages]

    def attach(
        self, sink: Sink, begin: Callable[[list[RawMessage]], None], seconds: float | None = None
    ) -> None:
        """Pass the messages of the last seconds, or all, to ``begin``, and every later one to ``sink``.

        No message comes between them. The receiving thread calls ``sink``.
        """
        with self._lock:
            begin(self.messages(seconds))
            self._sink = sink

    def detach(self) -> None:
        """Stop passing messages to the sink."""
        with self._lock:
            self._sink = None


def children(data: bytes) -> tuple[str, ...]:
    """Return the child frames of a serialised tf2_msgs/TFMessage, or none if it cannot be read."""
    with suppress(Exception):  # rosbags' generated code raises any exception, depending on the bytes
        message = deserialize_cdr(typestore(), data, TRANSFORMS)
        return tuple(transform.child_frame_id for transform in message.transforms)
    return ()


class RawTopics:
    """Selection of the recorded topics: every topic with a role, and further topics with little data.

    It passes the messages of further topics, and those of the source, to the recorder. Only the receiving
    thread may use it.

    Args:
        node: nodes for the subscriptions.
        recorder: takes the messages.
        requests: asks publishers for unknown types.
    """

    def __init__(self, node: Node, recorder: RawRecorder, requests: Sequence[TypeRequests]) -> None:
        self._recorder = recorder
        self._connections: dict[str, Connection] = {}
        self._further = Subscriptions(node, requests, self._receive)
        self._sizes: dict[str, tuple[float, int]] = {}  # topic -> start of the measurement, bytes
        self._refused: dict[str, str] = {}  # topic -> reason why it is left out for good
        self.unknown: dict[str, str] = {}  # the same of topics whose type is unknown

    def put(self, topic: PublishedTopic, received: int, info: Mapping[str, Any], data: bytes) -> None:
        """Record a message of any topic."""
        connection = self._connections.get(topic.name)
        if connection is None or connection.msgtype != topic.type or _is_named_now(connection, topic):
            connection = self._connections[topic.name] = connection_of(topic)
        sent = info.get("source_timestamp") or received
        self._recorder.put(RawMessage(connection, received, sent, data))

    def make_room(self, topic: PublishedTopic) -> None:
        """Unsubscribe from a topic of another type. A process can have one type on a name only."""
        if self._further.type_of(topic.name) not in (None, topic.type):
            self._leave(topic.name)

    def follow(self, topics: Mapping[str, PublishedTopic], taken: Set[str]) -> None:
        """Subscribe to topics that are not ``taken`` by the source, if they have little data."""
        wanted = self._recorder.config.raw_topics
        left_out = {}
        for name, topic in topics.items():
            if name in taken:
                self._leave(name)
                continue
            bulky = topic.type.rpartition("/")[2] in BULKY
            if wanted == "roles":
                left_out[name] = "it plays no role"
            elif wanted == "small" and bulky:
                left_out[name] = "it plays no role and is no small one"
            elif name in self._refused:
                left_out[name] = self._refused[name]
            elif self._further.type_of(name) != topic.type:
                self._listen(topic)
            if name in left_out:
                self._leave(name)
        for name in self._further.topics - topics.keys():
            self._leave(name)
        if wanted == "small":
            self._refuse_large()
        self._recorder.left_out = left_out

    def _refuse_large(self) -> None:
        """Leave topics whose data rate is above the limit."""
        now = time.monotonic()
        for name, (since, size) in list(self._sizes.items()):
            if now - since < TRIAL:
                continue
            rate = size / (now - since)
            self._sizes[name] = now, 0
            if rate > SMALL:
                self._refused[name] = f"it plays no role and has {rate / 1e6:.1f} MB/s"
                self._leave(name)

    def _leave(self, name: str) -> None:
        self._further.drop(name)
        self._sizes.pop(name, None)

    def _listen(self, topic: PublishedTopic) -> None:
        """Subscribe to a topic, if its type is known."""
        problem = self._further.listen(topic, decoded=False)
        if problem:
            self._refused[topic.name] = self.unknown[topic.name] = problem
        elif problem is None:
            self._sizes[topic.name] = time.monotonic(), 0

    def _receive(self, topic: PublishedTopic, data: bytes, info: dict[str, Any]) -> None:
        if topic.name in self._sizes:
            since, size = self._sizes[topic.name]
            self._sizes[topic.name] = since, size + len(data)
        self.put(topic, info["received_timestamp"] or time.time_ns(), info, data)


def connection_of(topic: PublishedTopic) -> Connection:
    """Return the rosbags connection of a topic, as of a bag."""
    try:
        digest = store_of(topic.type).hash_rihs01(topic.type)
    except UserError:
        digest = ""
    extra = ConnectionExtRosbag2("cdr", [_qos(publisher.qos_profile) for publisher in topic.publishers])
    text = definition(topic.type)
    form = MessageDefinitionFormat.NONE if text is None else MessageDefinitionFormat.MSG
    about = MessageDefinition(form, text or "")
    return Connection(0, topic.name, topic.type, about, digest, 0, extra, _node_names(topic) or None)


def _node_names(topic: PublishedTopic) -> str:
    """Return the names of the publishing nodes. A node is often discovered after its publisher."""
    return ", ".join(full_name(p) for p in topic.publishers if p.node_name != UNKNOWN)


def _is_named_now(connection: Connection, topic: PublishedTopic) -> bool:
    """Return whether the names of the publishing nodes are known now, and were not before."""
    return connection.owner is None and bool(_node_names(topic))


def _qos(profile: Any) -> Qos:
    """Return the quality of service of a publisher. The graph does not report history and depth."""

    def duration(value: Any) -> QosTime:
        return QosTime(*divmod(value.nanoseconds, 10**9))

    return Qos(
        history=QosHistory[profile.history.name],
        depth=profile.depth,
        reliability=QosReliability[profile.reliability.name],
        durability=QosDurability[profile.durability.name],
        deadline=duration(profile.deadline),
        lifespan=duration(profile.lifespan),
        liveliness=QosLiveliness[profile.liveliness.name],
        liveliness_lease_duration=duration(profile.liveliness_lease_duration),
        avoid_ros_namespace_conventions=profile.avoid_ros_namespace_conventions,
    )
