"""Topics of the ROS graph: their publishers, their quality of service, and subscriptions to them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence, Set
from contextlib import suppress
from copy import copy
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

from bevviz.errors import UserError
from bevviz.live.node import INPUT, Node
from bevviz.live.typesupport import message_type
from bevviz.messages.decoders import reads_bytes
from bevviz.messages.definitions import store_of
from bevviz.messages.topics import CLOUDS

UNKNOWN = "_NODE_NAME_UNKNOWN_"  # rmw's node name for a publisher that is discovered before its node
LATCHED_DEPTH = 100  # one message of each node that publishes static transforms
CLOUD_DEPTH = 5
IMAGE_DEPTH = 30  # images that arrive while a cloud of 50 MB is received and decoded
STREAM_DEPTH = 100  # small messages that come in bursts
FIRST = 1.0  # seconds after subscribing in which lost messages are expected and not counted
TRANSFORMS = "tf2_msgs/msg/TFMessage"
MERGED = 1000  # messages that one of two subscriptions may be behind the other
PACKET_DEPTH = 512  # LiDAR packets, about 1000 a second: those that arrive while a scan is decoded


@dataclass(frozen=True, slots=True)
class PublishedTopic:
    """Topic that at least one other node publishes."""

    name: str
    type: str
    publishers: tuple[Any, ...]  # rclpy's TopicEndpointInfo of other nodes, of this type
    others: tuple[Any, ...] = ()  # the same of publishers with another type, which are not received

    @property
    def clash(self) -> str:
        """One sentence about publishers with another type. Empty: there are none."""
        if not self.others:
            return ""
        used, unused = (
            ", ".join(f"{full_name(p)} ({p.topic_type})" for p in publishers)
            for publishers in (self.publishers, self.others)
        )
        return f"{self.name} has two types: {used} is received, {unused} is not; remap one of them"


def published_topics(session: Node, rank: Callable[[str, str], int]) -> dict[str, PublishedTopic]:
    """Return every topic that another node publishes.

    In a namespace these are its own topics. Topics outside are added for types that it lacks.

    Args:
        session: the nodes of bevviz.
        rank: returns a number for name and type of a topic. If it has several types, the lowest is taken.
    """
    topics = {}
    for name, _ in session.input.get_topic_names_and_types():
        foreign = foreign_publishers(session.node, name)
        if foreign:
            kind = min({p.topic_type for p in foreign}, key=lambda kind: (rank(name, kind), kind))
            of_kind = tuple(p for p in foreign if p.topic_type == kind)
            topics[name] = PublishedTopic(
                name, kind, of_kind, tuple(p for p in foreign if p.topic_type != kind)
            )
    inside = session.namespace.rstrip("/") + "/"
    types = {topic.type for topic in topics.values() if topic.name.startswith(inside)}
    return {n: t for n, t in topics.items() if n.startswith(inside) or t.type not in types}


def matched_qos(publishers: Sequence[Any], kind: str) -> Any:
    """Return the strongest quality of service that every publisher offers.

    The subscription is reliable if all publishers are. One best-effort publisher makes it best effort. It
    asks for latched messages if any publisher latches. ``mismatches`` then reports a volatile publisher of
    the same topic. The other choice would lose static transforms silently.
    """
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

    reliable = all(p.qos_profile.reliability == ReliabilityPolicy.RELIABLE for p in publishers)
    latched = any(p.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in publishers)
    depths = {
        "PointCloud2": CLOUD_DEPTH,
        "Image": IMAGE_DEPTH,
        "CompressedImage": IMAGE_DEPTH,
        "PacketMsg": PACKET_DEPTH,
    }
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depths.get(kind, LATCHED_DEPTH if latched else STREAM_DEPTH),
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def describe_qos(topic: PublishedTopic) -> str:
    """Return a text with the publishers of a topic and their quality of service."""
    from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

    lines = []
    for publisher in topic.publishers:
        qos = publisher.qos_profile
        words = ["reliable" if qos.reliability == ReliabilityPolicy.RELIABLE else "best effort"]
        if qos.durability == DurabilityPolicy.TRANSIENT_LOCAL:
            words.append("latched")
        lines.append(f"{full_name(publisher)} ({', '.join(words)})")
    return f"from {', '.join(lines)}"


def full_name(publisher: Any) -> str:
    """Return the full name of a publisher's node."""
    if publisher.node_name == UNKNOWN:
        return "a node that does not say its name"
    return f"{publisher.node_namespace.rstrip('/')}/{publisher.node_name}"


def foreign_publishers(node: Any, name: str) -> list[Any]:
    """Return rclpy's TopicEndpointInfo of the publishers of a topic that are not of the two nodes here."""
    own = {(f"{node.get_name()}{suffix}", node.get_namespace()) for suffix in ("", INPUT)}
    return [p for p in node.get_publishers_info_by_topic(name) if (p.node_name, p.node_namespace) not in own]


# --- subscriptions -----------------------------------------------------------------------------

Receive = Callable[[PublishedTopic, bytes, dict[str, Any]], None]  # topic, message, rclpy's message info


class TypeRequests(Protocol):
    """Client that asks publishing nodes for unknown types, of an extension in ``bevviz.message_types``."""

    def ask(self, topic: PublishedTopic) -> str | None:
        """Ask a publisher of a topic for its type. Return why that fails, or None while an answer may come.

        ``definitions.store_of`` knows the type after an answer.
        """


@dataclass(slots=True)
class _Subscription:
    """Subscription with its type and quality of service."""

    handles: Sequence[Any]
    type: str
    qos: Any


class Subscriptions:
    """Subscriptions of the input node to serialised messages. Only the receiving thread may use it.

    Args:
        node: the nodes of bevviz.
        requests: clients that ask publishers for the definitions of unknown types. The first one does.
        receive: called with each message.
        on_loss: called with topic and number of messages that the middleware has lost. None: not watched.
    """

    def __init__(
        self,
        node: Node,
        requests: Sequence[TypeRequests],
        receive: Receive,
        on_loss: Callable[[str, int], None] | None = None,
    ) -> None:
        self._node, self._requests = node, requests
        self._receive, self._on_loss = receive, on_loss
        self._by_topic: dict[str, _Subscription] = {}

    @property
    def topics(self) -> Set[str]:
        """Names of the subscribed topics."""
        return self._by_topic.keys()

    def type_of(self, name: str) -> str | None:
        """Return the type with which a topic is subscribed, or None."""
        return self._by_topic[name].type if name in self._by_topic else None

    def listen(self, topic: PublishedTopic, *, decoded: bool = True) -> str | None:
        """Subscribe to a topic, or again if the offered type or quality of service has changed.

        ``decoded``: the definition of the type is needed, too, unless a decoder reads the bytes.

        Returns:
            None, or the reason why the topic is not received. It is empty while a publisher may answer.
        """
        try:
            kind = message_type(topic.type)
            if decoded and not reads_bytes(topic.type):
                store_of(topic.type)
        except UserError as error:
            why = next((client.ask(topic) for client in self._requests), "nothing here asks its publisher")
            return f"{error}; {why}" if why is not None else ""
        qos = matched_qos(topic.publishers, topic.type.rpartition("/")[2])
        former = self._by_topic.get(topic.name)
        if former is not None and (former.type, former.qos) == (topic.type, qos):
            return None
        self.drop(topic.name)

        def receive(data: bytes, info: dict[str, Any]) -> None:
            self._receive(topic, data, info)

        hurried = _hurried_qos(qos) if topic.type == TRANSFORMS else None
        take = receive if hurried is None else _first_of_two(receive)
        node, events = self._node.input, self._events(topic.name)
        handles: list[Any] = []

        def take_all(row: int, data: bytes, info: dict[str, Any]) -> None:
            # rclpy takes one message of each topic in turn. While clouds of 50 MB wait, each would let one
            # image pass, and the others would be overwritten.
            take(data, info)
            if topic.type.rpartition("/")[2] not in CLOUDS:
                for more in _waiting(handles[row]):
                    take(*more)

        try:
            for row, (quality, callbacks) in enumerate([(qos, events), (hurried, None)]):
                if quality is not None:
                    each = partial(take_all, row)
                    handles.append(
                        node.create_subscription(
                            kind, topic.name, each, quality, event_callbacks=callbacks, raw=True
                        )
                    )
        except Exception as error:  # this process still has an endpoint of another type on that name
            return f"the middleware refuses {topic.type}: {' '.join(str(error).split())}"
        self._by_topic[topic.name] = _Subscription(handles, topic.type, qos)
        return None

    def _events(self, topic: str) -> Any:
        """Return callbacks that count the lost messages of a topic. None: the losses are not watched."""
        if self._on_loss is None:
            return None
        from rclpy.event_handler import SubscriptionEventCallbacks

        since, on_loss = time.monotonic(), self._on_loss

        def count_lost(event: Any) -> None:
            if time.monotonic() - since >= FIRST:
                on_loss(topic, event.total_count_change)

        return SubscriptionEventCallbacks(
            message_lost=count_lost,
            incompatible_qos=lambda event: None,  # ``mismatches`` reports it by name
            use_default_callbacks=False,
        )

    def drop(self, name: str) -> None:
        """Unsubscribe from a topic, if it is subscribed."""
        if (subscription := self._by_topic.pop(name, None)) is not None:
            for handle in subscription.handles:
                self._node.input.destroy_subscription(handle)

    def mismatches(self, topic: PublishedTopic) -> Iterable[str]:
        """Yield one sentence for each publisher of a subscribed topic that cannot be received."""
        from rclpy.qos import QoSCompatibility, qos_check_compatible

        for publisher in topic.publishers:
            qos = self._by_topic[topic.name].qos
            compatible, reason = qos_check_compatible(publisher.qos_profile, qos)
            if compatible == QoSCompatibility.ERROR:
                who = full_name(publisher)
                text = reason.removeprefix("ERROR: ").rstrip(".;")
                yield f"{topic.name}: {who} is not heard, its quality of service does not fit ({text})"


def _waiting(subscription: Any) -> Iterator[tuple[bytes, dict[str, Any]]]:
    """Yield the messages that wait in a subscription, until it is destroyed."""
    from rclpy.exceptions import InvalidHandle

    with suppress(InvalidHandle):
        while True:
            with subscription.handle:
                message = subscription.handle.take_message(subscription.msg_type, True)
            if message is None:
                return
            yield message


def _hurried_qos(qos: Any) -> Any:
    """Return the best-effort quality of service beside a reliable one. None: it is needed by nobody.

    Beside large clouds reliable transforms come half a second late. Best effort brings a part of them soon.
    """
    from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

    if qos.reliability != ReliabilityPolicy.RELIABLE or qos.durability != DurabilityPolicy.VOLATILE:
        return None
    hurried = copy(qos)
    hurried.reliability = ReliabilityPolicy.BEST_EFFORT
    return hurried


def _first_of_two(
    receive: Callable[[bytes, dict[str, Any]], None],
) -> Callable[[bytes, dict[str, Any]], None]:
    """Return a callback of two subscriptions that passes on each message when it comes first."""
    known: dict[tuple[int, bytes], None] = {}  # in order of receipt

    def take(data: bytes, info: dict[str, Any]) -> None:
        key = int(info.get("source_timestamp") or 0), data
        if key in known:
            del known[key]
            return
        known[key] = None
        if len(known) > MERGED:
            del known[next(iter(known))]
        receive(data, info)

    return take
