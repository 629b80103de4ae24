"""Topics of the raw recording: every topic with a role, and further topics with little data."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Set
from typing import Any

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

from bevviz.errors import UserError
from bevviz.live.graph import PublishedTopic, matched_qos
from bevviz.live.node import Node
from bevviz.live.raw_recorder import BULKY, RawMessage, RawRecorder
from bevviz.live.type_sources import TypeSources
from bevviz.live.typesupport import message_type
from bevviz.messages.definitions import store_of

SMALL = 1_000_000  # bytes a second, limit for a topic without a role
TRIAL = 5.0  # seconds over which that rate is measured


class RawTopics:
    """Subscriber to further topics. It passes their messages, and those of the source, to the recorder.

    Only the receiving thread may use it.

    Args:
        node: node for the subscriptions.
        recorder: takes the messages.
        sources: asks publishers for unknown types.
        known: called with each message of a further topic before it is recorded: topic, type, time of
            receipt, data.
    """

    def __init__(
        self,
        node: Node,
        recorder: RawRecorder,
        sources: TypeSources,
        known: Callable[[str, str, int, bytes], None] = lambda topic, kind, received, data: None,
    ) -> None:
        self._node, self._recorder, self._known = node, recorder, known
        self._sources = sources
        self._connections: dict[str, Connection] = {}
        self._further: dict[str, Any] = {}  # topic -> subscription
        self._sizes: dict[str, tuple[float, int]] = {}  # topic -> start of the measurement, bytes
        self._refused: dict[str, str] = {}  # topic -> reason why it is left out for good

    def put(self, topic: PublishedTopic, received: int, info: Mapping[str, Any], data: bytes) -> None:
        """Record a message of any topic."""
        connection = self._connections.get(topic.name)
        if connection is None or connection.msgtype != topic.type:
            connection = self._connections[topic.name] = connection_of(topic)
        sent = info.get("source_timestamp") or received
        self._recorder.put(RawMessage(connection, received, sent, data))

    def look(self, topics: Mapping[str, PublishedTopic], taken: Set[str]) -> None:
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
            elif name not in self._further:
                self._listen(topic)
            if name in left_out:
                self._leave(name)
        for name in self._further.keys() - topics.keys():
            self._leave(name)
        if wanted == "small":
            self._judge()
        self._recorder.left_out = left_out

    def _judge(self) -> None:
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
        """Unsubscribe from a topic."""
        if (subscription := self._further.pop(name, None)) is not None:
            self._node.input.destroy_subscription(subscription)
            del self._sizes[name]

    def _listen(self, topic: PublishedTopic) -> None:
        """Subscribe to a topic, if its type is known."""
        try:
            kind = message_type(topic.type)
        except UserError as error:
            if (why := self._sources.ask(topic)) is not None:
                self._refused[topic.name] = f"{error}; {why}"
            return

        def receive(data: bytes, info: dict[str, Any]) -> None:
            received = info["received_timestamp"] or time.time_ns()
            if topic.name in self._sizes:
                since, size = self._sizes[topic.name]
                self._sizes[topic.name] = since, size + len(data)
            self._known(topic.name, topic.type, received, data)
            self.put(topic, received, info, data)

        qos = matched_qos(topic.publishers, topic.type.rpartition("/")[2])
        self._sizes[topic.name] = time.monotonic(), 0
        self._further[topic.name] = self._node.input.create_subscription(
            kind, topic.name, receive, qos, raw=True
        )


def connection_of(topic: PublishedTopic) -> Connection:
    """Return the rosbags connection of a topic, as of a bag."""
    try:
        digest = store_of(topic.type).hash_rihs01(topic.type)
    except UserError:
        digest = ""
    extra = ConnectionExtRosbag2("cdr", [_qos(publisher.qos_profile) for publisher in topic.publishers])
    nothing = MessageDefinition(MessageDefinitionFormat.NONE, "")
    return Connection(0, topic.name, topic.type, nothing, digest, 0, extra, None)


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
