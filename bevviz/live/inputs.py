"""Inputs of the frames: topics with a role, watch over their messages, and the way to the synchroniser."""

from __future__ import annotations

import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cached_property, partial
from itertools import pairwise
from statistics import median
from typing import Any, Literal

from bevviz.config import Config, SourceConfig, stage_topics
from bevviz.drivers.video import is_video
from bevviz.errors import UserError
from bevviz.live.graph import PublishedTopic
from bevviz.live.live_message import LiveMessage
from bevviz.live.problems import CurrentProblems
from bevviz.messages import surroundings
from bevviz.messages.decoders import declared_decoder
from bevviz.messages.foreign_boxes import holds_boxes
from bevviz.messages.guard import guard
from bevviz.messages.packet_topics import PacketTopics, packet_stream
from bevviz.messages.roles import STAGE_KINDS, Roles, find_roles
from bevviz.messages.topics import CLOUDS, IMAGES, Topic, unsupported_reason
from bevviz.sync.feed import Handler, make_around_handlers, make_handlers
from bevviz.sync.report import UnusableMessages
from bevviz.sync.synchronizer import Synchronizer

SILENCE = 1.5  # seconds without a message that are reported, unless five usual steps are longer
STALL = 0.5  # the same after which another LiDAR drives the frames
STREAM = 5  # messages after which a topic counts as a stream that should continue
AGAIN = 10  # unusable messages in a row that are reported once more

TopicState = Literal["ok", "silent", "unusable", "no publisher"]
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


class TopicWatch:
    """Counter of received, lost and unusable messages.

    Args:
        problems: takes the topics whose messages are unusable.
        clock: returns seconds, for tests.

    Attributes:
        received: messages since the start, by topic.
        volume: bytes since the start, by topic.
        lost: messages that the middleware has lost, by topic.
    """

    def __init__(self, problems: CurrentProblems, clock: Callable[[], float] = time.monotonic) -> None:
        self._problems, self._clock, self._begun = problems, clock, clock()
        self.received, self.volume, self.lost = Counter[str](), Counter[str](), Counter[str]()
        self.damage = UnusableMessages()
        self._times: dict[str, deque[float]] = defaultdict(lambda: deque(maxlen=20))  # seconds, monotonic
        self._row = Counter[str]()  # unusable messages since the last usable one

    def count(self, topic: str, size: int) -> bool:
        """Count a message. Return whether it is the first of its topic."""
        self.received[topic] += 1
        self.volume[topic] += size
        self._times[topic].append(self._clock())
        return self.received[topic] == 1

    def mark_usable(self, topic: str) -> None:
        """Record that a message of a topic could be used."""
        if self._row[topic]:
            self._row[topic] = 0
            self._problems.set("unusable", topic, "", f"{topic}: its messages can be used again")

    def mark_unusable(self, topic: str, reason: str) -> None:
        """Record a message that cannot be used. The reason names the topic."""
        self._row[topic] += 1
        count = self.damage.add(topic, reason)
        if count == 1 or self._row[topic] == AGAIN:
            self._problems.set("unusable", topic, f"a message cannot be used: {reason}")
        self._problems.count("unusable", topic, count)

    def silent_for(self, topic: str, least: float = SILENCE) -> float:
        """Return the seconds since the last message of a stream, or 0 if that is a usual time.

        ``least``: shortest time in seconds that is not usual.
        """
        if self.received[topic] < STREAM:
            return 0.0
        silent = self._clock() - self._times[topic][-1]
        if silent <= least:  # Most are: this is asked many times in a second.
            return 0.0
        return silent if silent > 5 * self.step(topic) else 0.0

    def step(self, topic: str, newest: int = 0) -> float:
        """Return the usual seconds between two messages of a topic, or 0 if it is no stream yet.

        ``newest``: number of the newest steps that count. 0: all that are known.
        """
        if self.received[topic] < STREAM:
            return 0.0
        return median([after - before for before, after in pairwise(self._times[topic])][-newest:])

    def without(self, topics: Iterable[str]) -> float:
        """Return the seconds since the last message of any of these topics, or since the start."""
        last = max((self._times[name][-1] for name in topics if self.received[name]), default=self._begun)
        return self._clock() - last

    def state(self, topic: str, *, published: bool) -> TopicState:
        """Return the state of a topic, given whether it has a publisher."""
        if not published:
            return "no publisher"
        if self.silent_for(topic):
            return "silent"
        return "unusable" if self._row[topic] else "ok"


class Inputs:
    """Roles of the topics, and a handler for each topic with a role. Only the receiving thread may use it.

    Args:
        config: states topics and synchronisation.
        resolve: returns the name on the graph of a topic that the user states.
        problems: takes topics that do not fit the configuration.
        results: also the robot's bird's-eye view and obstacles have roles.
    """

    def __init__(
        self, config: Config, resolve: Callable[[str], str], problems: CurrentProblems, *, results: bool
    ) -> None:
        self.config, self.problems, self.watch = config, problems, TopicWatch(problems)
        self._resolve, self._results = resolve, results
        self.roles = Roles()
        self.sync = Synchronizer(self.roles, config, lapse=SILENCE)
        self.handlers: dict[str, Handler[LiveMessage]] = {}
        self.frame_ids: dict[str, str] = {}  # topic -> frame id of its first message
        self.changed = time.monotonic()  # seconds, last change of roles
        self._videos: set[str] = set()  # topics of compressed images that hold video
        self._packets = PacketTopics()

    @cached_property
    def stated(self) -> dict[str, tuple[str, tuple[str, ...]]]:
        """Topics of the configuration, each with its key and its permitted types. None: any type."""
        source = self._source
        stated: dict[str, tuple[str, tuple[str, ...]]] = {}
        for key, names, kinds in (
            ("source.lidar_topics", source.lidar_topics, CLOUDS),
            ("source.camera_topics", source.camera_topics, IMAGES),
            ("source.camera_info_topics", source.camera_info_topics, IMAGES),
            ("source.camera_info_topics", source.camera_info_topics.values(), ("CameraInfo",)),
            ("source.odometry_topic", filter(None, [source.odometry_topic]), ("Odometry",)),
            ("source.boxes", filter(None, [source.boxes.get("topic", "")]), ()),
        ):
            stated |= dict.fromkeys(names, (key, kinds))
        return stated | {name: (key, (STAGE_KINDS[key],)) for key, name in self._stages.items()}

    @cached_property
    def _source(self) -> SourceConfig:
        """The configuration with the topic names on the graph."""
        return _renamed(self.config.source, self._resolve)

    @cached_property
    def _stages(self) -> dict[str, str]:
        """Topics whose messages replace a stage, by key."""
        return {key: self._resolve(name) for key, name in stage_topics(self.config).items()}

    def misstated(self, topics: Iterable[PublishedTopic]) -> dict[str, str]:
        """Return the stated topics that nobody publishes, or that have another type, with the problem."""
        problems = {}
        published = {topic.name: topic for topic in self._describe(topics)}
        for name, (key, kinds) in self.stated.items():
            topic = published.get(name)
            if topic is None:
                problems[name] = f"nobody publishes {name}, which {key} states"
            elif topic.aside and "PointCloud2" in kinds:
                problems[name] = f"{name}, which {key} states, holds {topic.aside}"
            elif kinds and topic.kind not in kinds:
                problems[name] = f"{name} is a {topic.type}, but {key} takes {' or '.join(kinds)}"
        return problems

    def rank(self, name: str, kind: str) -> int:
        """Return 0 if the configuration asks for this type of a topic, 1 if it may have a role, else 2."""
        if name in self.stated and kind.rpartition("/")[2] in self.stated[name][1]:
            return 0
        return 1 if _concerns(PublishedTopic(name, kind, ())) else 2

    def candidates(self, topics: Mapping[str, PublishedTopic]) -> dict[str, PublishedTopic]:
        """Return the topics that may have a role, or may hold sensor data in an unsupported form."""
        streams = {name: packet_stream(topic.type) for name, topic in topics.items()}
        metadata = (stream.metadata_topic(name) for name, stream in streams.items() if stream is not None)
        besides = {self._source.boxes.get("topic"), *metadata}
        return {name: topic for name, topic in topics.items() if name in besides or _concerns(topic)}

    def assign(self, known: Mapping[str, PublishedTopic]) -> bool:
        """Assign roles to the candidates. Return False if they do not fit the configuration."""
        stated, topics = self._source, self._describe(known.values())
        if stated.lidar_topics:  # packets without metadata do not have a role yet
            topics = [t for t in topics if not (t.aside and t.name in stated.lidar_topics)]
        names = {topic.name for topic in topics}
        # An absent topic of a stage is waited for, as an absent sensor is.
        stages = {key: name for key, name in self._stages.items() if name in names}
        try:
            roles = find_roles(*_without_absent(topics, stated), stages, results=self._results)
        except UserError as error:
            self.problems.set("roles", "topics", str(error))
            return False
        self.problems.set("roles", "topics", "", "the topics fit the configuration")
        if replace(roles, notes={}) != replace(self.roles, notes={}):
            self.changed = time.monotonic()
            results = {*roles.robot_detections_2d, *roles.robot_detections_3d} - set(stages.values())
            former, self.sync = self.sync, Synchronizer(roles, self.config, results, SILENCE)
            self.sync.take_over(former)
            self.handlers = make_handlers(self.sync, roles, self._decode)
            for name in self._packets.packets & self.handlers.keys():
                self.handlers[name] = partial(self._gather, self.handlers[name])
        elif roles.around != self.roles.around:
            others = self.handlers.keys() - {topic for topic, _, _ in self.roles.around}
            self.handlers = {topic: self.handlers[topic] for topic in others}
            self.handlers |= make_around_handlers(self.sync, roles, LiveMessage.decode)
        self.roles = roles
        metadata_topics = [name for name in self._packets.metadata if name in known]
        self.handlers |= dict.fromkeys(metadata_topics, self._add_metadata)
        return True

    def learn(self, message: LiveMessage) -> bool:
        """Learn from the first message of a topic. Return whether roles must be assigned again.

        Raises:
            MessageError: the message has no header.
        """
        kind = Topic(message.topic, message.type).kind
        if not kind.endswith((*CLOUDS, "Image")):
            return False
        self.frame_ids[message.topic] = message.header()[1]
        if kind == "CompressedImage" and guard(message, is_video, message.decode()):
            self._videos.add(message.topic)
        return True

    def handle(self, message: LiveMessage) -> bool:
        """Pass a message to its handler. Return whether roles must be assigned again.

        Raises:
            UserError: the message cannot be used.
        """
        if (handler := self.handlers.get(message.topic)) is not None:
            handler(message)
        return message.topic in self._packets.metadata

    def _describe(self, topics: Iterable[PublishedTopic]) -> list[Topic]:
        boxes = self._source.boxes.get("topic", "")
        known = [
            Topic(
                t.name,
                t.type,
                frame_id=self.frame_ids.get(t.name, ""),
                boxes=t.name == boxes,
                video=t.name in self._videos,
            )
            for t in topics
        ]
        return [self._packets.describe(topic, self._source.lidar_calibration) for topic in known]

    def _add_metadata(self, message: LiveMessage) -> None:
        text = guard(message, surroundings.decode_mark, message.decode())
        if self._packets.add_metadata(message.topic, text):
            self.problems.tell(f"the metadata on {message.topic} have changed")

    def _gather(self, handler: Handler[LiveMessage], message: LiveMessage) -> None:
        """Gather packets to scans and pass these on. A scan has the time of receipt of its last packet."""
        for scan in self._packets.add_packet(message.topic, message.received, message.data):
            handler(replace(message, received=scan.received, data=b"", scan=scan))

    def _decode(self, message: LiveMessage) -> Any:
        """Decode a message with the calibration of the configuration."""
        return message.decode(self._source.lidar_calibration)


def _concerns(topic: PublishedTopic) -> bool:
    """Return whether a topic may have a role, or may hold sensor data in an unsupported form."""
    return (
        topic.type in KINDS
        or declared_decoder(topic.type) is not None
        or holds_boxes(topic.type)
        or bool(unsupported_reason(Topic(topic.name, topic.type, None, "")))
    )


def _without_absent(topics: list[Topic], config: SourceConfig) -> tuple[list[Topic], SourceConfig]:
    """Remove stated topics that are absent, and the topics that could take over their roles.

    A stated topic that is absent is waited for. No other topic may take its role meanwhile.
    """
    names = {topic.name for topic in topics}
    present = _renamed(config, lambda name: name if name in names else "")
    for stated, left, kinds in (
        (config.lidar_topics, present.lidar_topics, CLOUDS),
        (config.camera_topics, present.camera_topics, IMAGES),
        (config.odometry_topic, present.odometry_topic, ("Odometry",)),
    ):
        if stated and not left:
            topics = [topic for topic in topics if topic.kind not in kinds]
    return topics, present


def _renamed(config: SourceConfig, rename: Callable[[str], str]) -> SourceConfig:
    """Return the configuration with topics renamed. A topic whose new name is empty is left out."""
    infos = {rename(image): rename(info) for image, info in config.camera_info_topics.items()}
    boxes = {key: rename(value) if key == "topic" else value for key, value in config.boxes.items()}
    files = {rename(name): file for name, file in config.lidar_calibration.items()}
    return config.model_copy(
        update={
            "lidar_topics": tuple(filter(None, map(rename, config.lidar_topics))),
            "camera_topics": tuple(filter(None, map(rename, config.camera_topics))),
            "camera_info_topics": {image: info for image, info in infos.items() if image and info},
            "odometry_topic": config.odometry_topic and rename(config.odometry_topic),
            "boxes": boxes if boxes.get("topic") else {},
            "lidar_calibration": {name: file for name, file in files.items() if name},
        }
    )
