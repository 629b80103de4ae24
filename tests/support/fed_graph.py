"""A ROS graph inside the process of a test: no middleware, no threads, and a clock that the test moves on.

``LiveSource`` runs on it unchanged: only its two rclpy nodes are replaced. A published message reaches its
subscriptions before ``publish`` returns, as serialised bytes, under the rules of rclpy's quality of service.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest

from bevviz.config import load
from bevviz.extras.demo.drive import LIDAR_TOPIC
from bevviz.extras.fast_dds import requests
from bevviz.live import graph, graph_info, input_problems, inputs, problems, raw_recorder, source
from bevviz.live.raw_recorder import RawRecorder
from bevviz.live.runtime import Live
from bevviz.live.source import LiveSource
from bevviz.live.typesupport import message_type
from bevviz.messages.decoders import read_header
from bevviz.messages.definitions import store_of
from bevviz.model.frame import Frame
from tests.support.played_drive import drive_of
from tests.support.ros_player import Play
from tests.support.waiting import until

NEEDED = 3.0  # seconds of the graph after which the frames have begun
TIMED = (
    graph,
    graph_info,
    input_problems,
    inputs,
    problems,
    raw_recorder,
    requests,
    source,
)  # modules whose clock is that of the graph


@dataclass
class Endpoint:
    """Publisher, as rclpy's TopicEndpointInfo shows it to other nodes."""

    node_name: str
    topic: str
    topic_type: str
    qos_profile: Any
    node_namespace: str = "/"
    topic_type_hash: str = ""
    latched: list[bytes] = field(default_factory=list)


@dataclass
class _Subscription:
    topic: str
    type: Any
    receive: Callable[[bytes, dict[str, Any]], None]
    qos: Any
    handle: _Queue = field(default_factory=lambda: _Queue())

    @property
    def msg_type(self) -> Any:
        return self.type


class _Queue(nullcontext[None]):
    """Messages that wait in the middleware."""

    def __init__(self) -> None:
        super().__init__()
        self.messages: list[tuple[bytes, dict[str, Any]]] = []

    def take_message(self, kind: Any, raw: bool) -> tuple[bytes, dict[str, Any]] | None:
        return self.messages.pop(0) if self.messages else None


@dataclass
class _Timer:
    due: float
    period: float
    callback: Callable[[], None]


class FedGraph:
    """Graph of one robot and of the sources that join it."""

    def __init__(self) -> None:
        self.now = 1000.0  # seconds, monotonic
        self.sent: dict[str, list[Any]] = {}  # messages that bevviz published, by topic
        self.publishers: list[Endpoint] = []
        self.nodes = ["/robot"]
        self.subscriptions: list[_Subscription] = []
        self.timers: list[_Timer] = []
        self.after: Callable[[], object] = lambda: None  # called when messages or time have moved on
        self._shift = time.time_ns() - round(self.now * 1e9)

    def time_ns(self) -> int:
        return self._shift + round(self.now * 1e9)

    def advance(self, seconds: float) -> None:
        """Let time pass. Timers are called when they are due."""
        end = self.now + seconds
        while (timer := min(self.timers, key=lambda one: one.due, default=None)) and timer.due <= end:
            self.now = max(self.now, timer.due)
            timer.due += timer.period
            timer.callback()
            self.after()
        self.now = end

    # --- the robot -----------------------------------------------------------------------------

    def advertise(self, topic: str, kind: str, node: str = "robot", qos: Any = None) -> Endpoint:
        from rclpy.qos import QoSProfile

        publisher = Endpoint(node, topic, kind, qos or QoSProfile(depth=10))
        self.publishers.append(publisher)
        return publisher

    def withdraw(self, *publishers: Endpoint) -> None:
        self.publishers = [one for one in self.publishers if one not in publishers]

    def publish(self, publisher: Endpoint, message: Any) -> None:
        """Publish an object of the type's definition with its stamp as it is, or CDR."""
        from rclpy.qos import DurabilityPolicy

        kind = publisher.topic_type
        data = message if isinstance(message, bytes) else bytes(store_of(kind).serialize_cdr(message, kind))
        if publisher.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL:
            publisher.latched = [data]
        for subscription in [one for one in self.subscriptions if one.topic == publisher.topic]:
            self._hand_over(publisher, subscription, data)
        self.after()

    def publish_now(self, publisher: Endpoint, message: Any, frame_id: str | None = None) -> None:
        """Publish a message with a header, stamped with the time of the graph."""
        at, header = self.time_ns(), message.header
        stamp = replace(header.stamp, sec=at // 10**9, nanosec=at % 10**9)
        header = replace(header, stamp=stamp, frame_id=header.frame_id if frame_id is None else frame_id)
        self.publish(publisher, replace(message, header=header))

    def _hand_over(self, publisher: Endpoint, subscription: _Subscription, data: bytes) -> None:
        from rclpy.qos import QoSCompatibility, qos_check_compatible

        compatible, _ = qos_check_compatible(publisher.qos_profile, subscription.qos)
        if compatible != QoSCompatibility.ERROR and subscription.type is message_type(publisher.topic_type):
            now = self.time_ns()
            subscription.receive(data, {"received_timestamp": now, "source_timestamp": now})

    # --- what rclpy's node does for bevviz -----------------------------------------------------

    def join(self, arguments: Sequence[str] = (), on_end: object = None, name: str = "bevviz") -> Any:
        """Return what stands for ``bevviz.live.node.Node``."""
        return _Joined(self, name, dict(one.split(":=") for one in arguments if ":=" in one))

    def subscribe(self, kind: Any, topic: str, receive: Any, qos: Any) -> _Subscription:
        from rclpy.qos import DurabilityPolicy

        subscription = _Subscription(topic, kind, receive, qos)
        self.subscriptions.append(subscription)
        if qos.durability == DurabilityPolicy.TRANSIENT_LOCAL:
            for publisher in [one for one in self.publishers if one.topic == topic]:
                for data in publisher.latched:
                    # The middleware hands it over later, in the receiving thread.
                    self._soon(partial(self._hand_over, publisher, subscription, data))
        return subscription

    def _soon(self, work: Callable[[], None]) -> None:
        timer = _Timer(self.now, 0.0, lambda: None)

        def once() -> None:
            self.timers.remove(timer)
            work()

        timer.callback = once
        self.timers.append(timer)


class _Joined:
    """Stand-in for ``bevviz.live.node.Node``. It is its own ``node`` and ``input``."""

    error = None
    domain = 0
    middleware = "none"
    namespace = "/"

    def __init__(self, graph: FedGraph, name: str, remaps: Mapping[str, str]) -> None:
        self._graph, self._name, self._remaps = graph, name, remaps
        self.node = self.input = self

    def start(self) -> None:
        self._graph.advance(source.LOOK)  # it has looked around once

    def close(self) -> None:
        self._graph.timers.clear()
        self._graph.subscriptions.clear()

    @property
    def is_alone(self) -> bool:
        return f"/{self._name}" not in self._graph.nodes

    def resolve(self, topic: str) -> str:
        topic = self._remaps.get(topic, topic)
        return topic if topic.startswith("/") else f"/{topic}"

    resolve_topic_name = resolve

    def get_name(self) -> str:
        return self._name

    def get_namespace(self) -> str:
        return self.namespace

    def get_fully_qualified_name(self) -> str:
        return f"/{self._name}"

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        names = dict.fromkeys(publisher.topic for publisher in self._graph.publishers)
        return [(name, []) for name in names]

    def get_publishers_info_by_topic(self, topic: str) -> list[Endpoint]:
        return [publisher for publisher in self._graph.publishers if publisher.topic == topic]

    def create_timer(self, period: float, callback: Callable[[], None], clock: object = None) -> None:
        self._graph.timers.append(_Timer(self._graph.now + period, period, callback))

    def create_subscription(self, kind: Any, topic: str, receive: Any, qos: Any, **options: Any) -> Any:
        return self._graph.subscribe(kind, topic, receive, qos)

    def destroy_subscription(self, subscription: _Subscription) -> None:
        with suppress(ValueError):
            self._graph.subscriptions.remove(subscription)

    def create_client(self, kind: Any, name: str) -> Any:
        return SimpleNamespace(service_is_ready=lambda: False)

    def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
        """Return a publisher whose messages the test finds in ``FedGraph.sent``."""
        name = f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}"
        name = kind.__doc__ if "/msg/" in str(kind.__doc__) else name
        publisher = self._graph.advertise(topic, name, self._name)
        messages = self._graph.sent.setdefault(topic, [])

        def publish(data: bytes) -> None:
            messages.append(store_of(name).deserialize_cdr(data, name))
            self._graph.publish(publisher, data)

        return SimpleNamespace(publish=publish, get_subscription_count=lambda: 1)


class Player:
    """Robot on a fed graph that plays the synthetic drive."""

    def __init__(self, graph: FedGraph, **fields: Any) -> None:
        drive = drive_of(Play(**fields))
        self._graph, self._start = graph, graph.now
        self._plan = drive.schedule(graph.time_ns())
        self._publishers = {
            topic: graph.advertise(topic, drive.types[topic], drive.play.name, drive.quality(topic))
            for topic in drive.topics
        }
        self._next = next(self._plan)
        self.stamp = 0  # of the newest scan that was published

    def play(self, seconds: float) -> None:
        """Publish what is due in the next seconds of the graph's clock."""
        end = self._graph.now + seconds
        while self._start + self._next[0] <= end:
            due, topic, message = self._next
            self._graph.advance(max(0.0, self._start + due - self._graph.now))
            if topic in self._publishers:
                self.stamp = read_header(message, "<", topic)[0] if topic == LIDAR_TOPIC else self.stamp
                self._graph.publish(self._publishers[topic], message)
            self._next = next(self._plan)
        self._graph.advance(end - self._graph.now)

    def stop(self) -> None:
        self._graph.withdraw(*self._publishers.values())


def play_in_step(player: Player, live: Live, live_source: LiveSource, seconds: float = 0.1) -> None:
    """Play on, and wait until the run has logged the newest frame."""
    player.play(seconds)

    def is_logged() -> bool:
        newest = live_source._frames - 1
        return newest < 0 or (live.frames > 0 and live.encoder.context.clock[0] == newest)

    until(is_logged, "the newest frame", every=0.002)


@dataclass
class Session:
    """Source on a fed graph, the frames that it has made, and its messages to the user."""

    graph: FedGraph
    source: LiveSource
    said: list[str]
    frames: list[Frame] = field(default_factory=list)

    def told(self, text: str) -> bool:
        return any(text in line for line in self.said)


@contextmanager
def joined(
    graph: FedGraph, *settings: str, arguments: Sequence[str] = (), raw: RawRecorder | None = None
) -> Iterator[Session]:
    """Run a source with ``key=value`` settings, and take each frame at once."""
    said: list[str] = []
    config = load(settings=settings)
    with LiveSource(config, arguments=arguments, tell=said.append, raw=raw) as live:
        session = Session(graph, live, said)
        frames = iter(live)

        def take() -> None:
            while len(live._handover):
                session.frames.append(next(frames))

        graph.after = take
        yield session
        graph.after = lambda: None


@contextmanager
def fed_graph() -> Iterator[FedGraph]:
    """Let every ``LiveSource`` of the block join a graph of this process."""
    fed, wait = FedGraph(), LiveSource.wait
    clock = SimpleNamespace(monotonic=lambda: fed.now, time_ns=fed.time_ns, time=lambda: 1e-9 * fed.time_ns())
    with pytest.MonkeyPatch.context() as patch:
        for module in TIMED:
            patch.setattr(module, "time", clock)
        patch.setattr(source, "Node", fed.join)

        def pass_time(live: LiveSource, timeout: float) -> bool:
            fed.advance(timeout)
            return wait(live, 0.0)

        patch.setattr(LiveSource, "wait", pass_time)
        patch.setattr(inputs.TopicWatch.__init__, "__defaults__", (clock.monotonic,))
        yield fed
