"""Topics of the ROS graph: their publishers and quality of service."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from bevviz.live.node import Node

UNKNOWN = "_NODE_NAME_UNKNOWN_"  # rmw's node name for a publisher that is discovered before its node
LATCHED_DEPTH = 100  # one message of each node that publishes static transforms
SENSOR_DEPTH = 5
STREAM_DEPTH = 100  # small messages that come in bursts
PACKET_DEPTH = 512  # LiDAR packets, about 1000 a second: those that arrive while a scan is decoded


@dataclass(frozen=True, slots=True)
class PublishedTopic:
    """Topic that at least one other node publishes."""

    name: str
    type: str
    publishers: tuple[Any, ...]  # rclpy's TopicEndpointInfo of other nodes


def published_topics(session: Node) -> dict[str, PublishedTopic]:
    """Return every topic that another node publishes.

    In a namespace these are its own topics. Topics outside are added for types that it lacks.
    """
    topics = {}
    for name, _ in session.input.get_topic_names_and_types():
        publishers = session.input.get_publishers_info_by_topic(name)
        others = tuple(p for p in publishers if not session.owns(p))
        if others:
            topics[name] = PublishedTopic(name, others[0].topic_type, others)
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
    bulky = kind in ("PointCloud2", "Image", "CompressedImage")
    streamed = PACKET_DEPTH if kind == "PacketMsg" else STREAM_DEPTH
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=SENSOR_DEPTH if bulky else LATCHED_DEPTH if latched else streamed,
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


def mismatches(topic: PublishedTopic, qos: Any) -> Iterable[str]:
    """Yield one sentence for each publisher that a subscription with ``qos`` cannot receive."""
    from rclpy.qos import QoSCompatibility, qos_check_compatible

    for publisher in topic.publishers:
        compatible, reason = qos_check_compatible(publisher.qos_profile, qos)
        if compatible == QoSCompatibility.ERROR:
            who = full_name(publisher)
            text = reason.removeprefix("ERROR: ").rstrip(".;")
            yield f"{topic.name}: {who} is not heard, its quality of service does not fit ({text})"
