"""Cut the time window of a report out of a bag, into a bag that can be run again."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
from backports import zstd
from rosbags.interfaces import Connection

from bevviz.bags.bag import ATTACHED, Recording
from bevviz.bags.mcap_writer import McapWriter
from bevviz.bags.message import RawMessage, is_ros1
from bevviz.bags.reader import LAST_TIME
from bevviz.bags.source import MARGIN, SECOND, BagSource, iso
from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.messages.roles import Roles
from bevviz.sync.report import UnusableMessages

MILLISECOND = 1_000_000

Edited = tuple[Connection, bytes | memoryview] | None
Edit = Callable[[RawMessage, bytes | memoryview], Edited]


def unchanged(message: RawMessage, data: bytes | memoryview) -> Edited:
    """Return a message unchanged."""
    return message.connection, data


@dataclass(frozen=True, slots=True)
class ReportWindow:
    """Time window of a report, as log times in nanoseconds.

    ``low`` and ``high`` are whole milliseconds, so that they can be written exactly as text.
    """

    at: int  # scan that the report is about
    low: int  # first scan, inclusive
    high: int  # last scan, exclusive
    start: int  # start of the whole recording


@dataclass(frozen=True, slots=True)
class MadeMessage:
    """Message that the bag of a report has beside the recorded ones."""

    connection: Connection
    received: int
    data: bytes


@dataclass(frozen=True, slots=True)
class CutContent:
    """Content of a bag that was cut out."""

    counts: Counter[str]  # messages by topic
    left_out: tuple[str, ...]  # messages that are missing, one sentence each


def find_window(source: BagSource, at: int, before: float, after: float) -> ReportWindow:
    """Return the window from the first to the last scan within ``before`` and ``after`` seconds of ``at``."""
    times = source.recording.scan_times(source.roles.driver)
    first, last = np.searchsorted(times, [at - round(before * SECOND), at + round(after * SECOND) + 1])
    low = int(times[first]) // MILLISECOND * MILLISECOND
    high = (int(times[last - 1]) // MILLISECOND + 1) * MILLISECOND
    return ReportWindow(at, low, high, source.recording.start)


def open_window(paths: Sequence[Path], config: Config, low: int, high: int) -> BagSource:
    """Open the scans of a window, in the whole bag or in the one that was cut out."""
    return BagSource(paths, config, start=iso(low), end=iso(high))


def choose_topics(recording: Recording, roles: Roles, patterns: Sequence[str] | None) -> list[str]:
    """Return the topics that the pipeline reads, and the others that fit a pattern. None: all topics.

    Raises:
        UserError: a pattern fits no topic.
    """
    names = [topic.name for topic in recording.topics]
    if patterns is None:
        return names
    check_patterns(recording, patterns, "--topics")
    needed = {*_read(roles), *(topic.metadata_topic for topic in recording.topics)}
    return [n for n in names if n in needed or any(fnmatchcase(n, pattern) for pattern in patterns)]


def check_patterns(recording: Recording, patterns: Sequence[str], option: str) -> None:
    """Check that every pattern fits a topic.

    Raises:
        UserError: a pattern fits none.
    """
    names = [topic.name for topic in recording.topics]
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in names):
            raise UserError(f"{option} {pattern}: no topic fits among {', '.join(names)}")


def _read(roles: Roles) -> list[str]:
    """Return every topic that the pipeline reads."""
    cameras = [name for camera in roles.cameras for name in (camera.topic, camera.info_topic)]
    single = [roles.odometry, roles.truth]
    return [
        *roles.lidars,
        *roles.tf,
        *roles.tf_static,
        *roles.imus,
        *roles.robot_detections_2d,
        *roles.robot_detections_3d,
        *roles.robot_clouds,
        *(name for name in (*cameras, *single) if name),
    ]


def cut_bag(
    recording: Recording,
    window: ReportWindow,
    topics: Collection[str],
    static: Collection[str],
    path: Path,
    edit: Edit = unchanged,
    margin: int = MARGIN,
    made: Sequence[MadeMessage] = (),
) -> CutContent:
    """Write the messages of a window to an MCAP file, byte for byte, with all that a run of it needs.

    The file also gets:

    - the calibration files of LiDARs,
    - the messages within ``margin`` on either side, which ``BagSource`` reads, too,
    - all messages of the ``static`` topics,
    - the earlier packets of a video that its first image is decoded from,
    - for a topic that is silent in the window, its last message before it, else its first one after it (a
      calibration, a map or a robot description that was published once).

    Args:
        recording: the whole bag.
        window: the scans.
        topics: the topics to write.
        static: topics of static transforms.
        path: path of the MCAP file.
        edit: returns the connection and the bytes to write for a message. None: leave it out.
        margin: nanoseconds.
        made: messages to add, in order of time. Recorded messages of their topics are left out.

    Raises:
        UserError: the file cannot be written.
    """
    low, high = window.low - margin, window.high + margin
    added = {message.connection.topic for message in made}
    topics = [name for name in topics if name not in added]
    chosen = [name for name in topics if name not in static]
    waiting = deque(made)
    counts: Counter[str] = Counter()
    damage = UnusableMessages()
    ros1 = is_ros1(next(c for f in recording.files for c in f.connections))
    with McapWriter(path, recording.types.definition, ros1=ros1) as bag:
        for topic in sorted(recording.calibrations.keys() & set(topics)):
            file = Path(recording.calibrations[topic])
            bag.attach(f"{ATTACHED}{topic}/{file.name}", file.read_bytes())

        def put_made(before: int) -> None:
            while waiting and waiting[0].received < before:
                message = waiting.popleft()
                bag.write(message.connection, message.received, message.data)
                counts[message.connection.topic] += 1

        def put(message: RawMessage) -> None:
            put_made(message.received)
            try:
                content = message.content()
            except zstd.ZstdError:
                damage.add(message.topic, f"{message.topic}: it is damaged, and left out")
                return
            if (edited := edit(message, content)) is not None:
                connection, data = edited
                bag.write(connection, message.received, data)
                counts[message.topic] += 1

        videos = {topic.name for topic in recording.topics if topic.kind == "CompressedVideo"}
        valid = [_last(recording, name, low, high) for name in chosen if name not in videos]
        messages_before = [message for message in valid if message is not None and message.received < low]
        messages_after = [message for message in valid if message is not None and message.received >= high]
        messages_before += recording.messages(static, None, low)
        messages_before += [
            message for name in chosen if name in videos for message in _needed(recording, name, low)
        ]
        for message in sorted(messages_before, key=lambda message: message.received):
            put(message)
        for message in recording.messages(topics, low, high):
            put(message)
        messages_after += recording.messages(static, high)
        for message in sorted(messages_after, key=lambda message: message.received):
            put(message)
        put_made(LAST_TIME)
    return CutContent(counts, tuple(damage.sentences))


def _needed(recording: Recording, topic: str, low: int) -> list[RawMessage]:
    """Return the video messages before the window that its first image is decoded from."""
    received = {packet.received for packet in recording.packets(topic, low - 1)}
    times = sorted(time for time in received if time < low)
    return [message for time in times for message in recording.messages([topic], time, time + 1)]


def _last(recording: Recording, topic: str, low: int, high: int) -> RawMessage | None:
    """Return the message that is valid in the window, for a topic that is silent in it. Otherwise None."""
    times = recording.times(topic)
    first, last = np.searchsorted(times, [low, high])
    if first < last or not len(times):
        return None
    nearest = int(times[first - 1]) if first else int(times[0])
    return next(recording.messages([topic], nearest, nearest + 1), None)
