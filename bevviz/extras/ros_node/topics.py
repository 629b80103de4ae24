"""Topics of the results on the robot's graph."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence, Set
from typing import Any

from bevviz.errors import UserError
from bevviz.live.graph import UNKNOWN, foreign_publishers, full_name
from bevviz.live.node import add_timer
from bevviz.live.publish import TOPICS, TRANSFORMS, Receiver
from bevviz.live.typesupport import message_type

LOOK = 0.5  # seconds between two looks for other publishers of our topics


def open_publisher(node: Any, kind: str, topic: str, *, shared: bool = False) -> Any:
    """Return a publisher of serialised messages.

    ``shared``: several nodes may publish the topic, if they do so with this type.

    Raises:
        UserError: the type is unknown, or another node publishes the topic.
    """
    message_class = message_type(kind)
    name = node.resolve_topic_name(topic)
    others = foreign_publishers(node, name)
    clashing = [p for p in others if p.topic_type != kind]
    if clashing or (others and not shared):
        raise UserError(f"{_who_publishes(name, clashing or others, kind)}; {rename_advice(topic)}")
    try:
        return node.create_publisher(message_class, topic, 10)
    except Exception as error:  # the middleware refuses a type beside another one
        raise UserError(f"the middleware refuses {kind} on {name}: {' '.join(str(error).split())}") from None


def _who_publishes(name: str, others: Sequence[Any], kind: str) -> str:
    """Return the words that name another publisher of a topic, and its type if that is not ours."""
    other = others[0]
    if other.topic_type != kind:
        return f"{full_name(other)} publishes {name} as {other.topic_type}, ours is {kind}"
    return f"{full_name(other)} publishes {name}, and messages of two sources would mix"


def rename_advice(topic: str) -> str:
    """Return the words that say how our topic gets another name."""
    return f"--ros-args -r {topic}:=/bevviz{topic} gives ours another name"


class RosTopics(Receiver):
    """Publishers of a ROS node. A topic that another node publishes is left to that node.

    If another node begins to publish a topic later, ours ends there, and does not begin again: a robot that
    loses its detector must not be steered by ours.

    Args:
        node: an rclpy node, whose remaps apply.
        tell: called with one sentence for each topic that is not published.
    """

    def __init__(self, node: Any, tell: Callable[[str], None] = lambda text: None) -> None:
        self._node, self._tell = node, tell
        self._lock = threading.Lock()  # guards ``_publishers``, from which the timer removes
        self._publishers: dict[str, Any] = {}
        for topic, kind in TOPICS.items():
            if topic == TRANSFORMS:  # The robot publishes its own.
                continue
            try:
                self._publishers[topic] = open_publisher(node, kind, topic)
            except UserError as error:
                tell(f"{topic} is not published: {error}")
        add_timer(node, LOOK, self._give_way)

    @property
    def topics(self) -> Set[str]:
        """Topics that are published."""
        return self._publishers.keys()

    def wants(self, topic: str) -> bool:
        """Return whether anybody receives a topic."""
        with self._lock:
            publisher = self._publishers.get(topic)
            return publisher is not None and publisher.get_subscription_count() > 0

    def send(self, topic: str, data: bytes, stamp: int) -> None:
        """Publish a message, unless another node publishes the topic by now."""
        with self._lock:
            if (publisher := self._publishers.get(topic)) is not None:
                publisher.publish(data)

    def _give_way(self) -> None:
        """End each topic that another node publishes by now."""
        for topic in list(self._publishers):
            name = self._node.resolve_topic_name(topic)
            others = [p for p in foreign_publishers(self._node, name) if p.node_name != UNKNOWN]
            if others:
                with self._lock:
                    self._node.destroy_publisher(self._publishers.pop(topic))
                who = f"{full_name(others[0])} publishes {name} now"
                self._tell(f"{topic} is not published any more: {who}; {rename_advice(topic)}")
