"""What is published on the graph, by whom and with which quality of service."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from bevviz.live.node import Node

UNKNOWN = "_NODE_NAME_UNKNOWN_"  # rmw's name of a node whose publishers were met before itself
LATCHED_DEPTH = 100  # one message of each node that states static transforms
SENSOR_DEPTH = 5
STREAM_DEPTH = 100  # small messages that come in bursts
PACKET_DEPTH = (
    512  # single packets of a LiDAR, some thousand a second: those of the time that a scan is decoded
)


@dataclass(frozen=True, slots=True)
class PublishedTopic:
    name: str
    type: str
    publishers: tuple[Any, ...]  # rclpy's TopicEndpointInfo of other nodes


def published_topics(session: Node) -> dict[str, PublishedTopic]:
    """Every topic that somebody else publishes; in a namespace, its own topics and those it lacks."""
    found = {}
    for name, _ in session.input.get_topic_names_and_types():
        publishers = session.input.get_publishers_info_by_topic(name)
        others = tuple(p for p in publishers if not session.owns(p))
        if others:
            found[name] = PublishedTopic(name, others[0].topic_type, others)
    inside = session.namespace.rstrip("/") + "/"
    types = {topic.type for topic in found.values() if topic.name.startswith(inside)}
    return {n: t for n, t in found.items() if n.startswith(inside) or t.type not in types}


def matched_qos(publishers: Sequence[Any], kind: str) -> Any:
    """The strongest quality of service that every publisher offers.

    Reliable where all are; with one best-effort publisher, best effort serves them all. Latched messages
    are asked for where anybody latches: a volatile publisher beside is then told by ``mismatches``, while
    the other way round static transforms would be missed in silence.
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
    """Who publishes a topic, and how."""
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
    """Of the node that a publisher belongs to."""
    if publisher.node_name == UNKNOWN:
        return "a node that does not say its name"
    return f"{publisher.node_namespace.rstrip('/')}/{publisher.node_name}"


def mismatches(topic: PublishedTopic, qos: Any) -> Iterable[str]:
    """The publishers that a subscription with ``qos`` cannot hear, and why, one sentence each."""
    from rclpy.qos import QoSCompatibility, qos_check_compatible

    for publisher in topic.publishers:
        compatible, reason = qos_check_compatible(publisher.qos_profile, qos)
        if compatible == QoSCompatibility.ERROR:
            who = full_name(publisher)
            text = reason.removeprefix("ERROR: ").rstrip(".;")
            yield f"{topic.name}: {who} is not heard, its quality of service does not fit ({text})"
