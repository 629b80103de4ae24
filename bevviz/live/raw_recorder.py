"""Buffer of the serialised messages of the last seconds, and the bag written from it."""

from __future__ import annotations

import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple

from rosbags.interfaces import Connection, MessageDefinition, MessageDefinitionFormat

from bevviz.bags.mcap_writer import McapWriter
from bevviz.config import LiveConfig
from bevviz.errors import UserError
from bevviz.live.files import MEGABYTE
from bevviz.messages.definitions import definition

LEAD = 3.0  # seconds before the first frame, in which its synchronised messages and transforms came
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


class Earlier:
    """Messages that stay valid until replaced: the last one of each topic, and of each transform.

    So a map, a calibration, a robot description and a mounting are kept even if they were published once,
    long ago. Clouds, packets and images are not kept.
    """

    def __init__(self) -> None:
        self._last: dict[tuple[str, tuple[bytes, ...]], RawMessage] = {}
        self.size = 0

    def note(self, message: RawMessage) -> None:
        """Keep a message in place of the last one, if messages of this type stay valid."""
        if message.passing:
            return
        is_tf = message.connection.msgtype.endswith("/TFMessage")
        key = message.connection.topic, children(message.data) if is_tf else ()
        former = self._last.pop(key, None)  # removed first, so that the order is that of the messages
        self._last[key] = message
        self.size += len(message.data) - (0 if former is None else len(former.data))

    def copy(self) -> Earlier:
        """Return a copy that changes independently."""
        other = Earlier()
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

    def __init__(self, config: LiveConfig) -> None:
        self.config = config
        self.left_out: dict[str, str] = {}  # published topic that is not recorded -> reason
        self._messages: deque[tuple[float, RawMessage]] = deque()  # with the monotonic time of ``put``
        self._earlier = Earlier()
        self._size = 0
        self._sinks: list[Sink] = []
        self._held = threading.RLock()

    @property
    def size(self) -> int:
        """Bytes in the buffer."""
        return self._size + self._earlier.size

    @property
    def seconds(self) -> float:
        """Seconds from the oldest to the newest message."""
        with self._held:
            return self._messages[-1][0] - self._messages[0][0] if self._messages else 0.0

    def put(self, message: RawMessage) -> None:
        """Add a message, drop old ones, and pass it to the attached sinks."""
        now = time.monotonic()
        with self._held:
            self._messages.append((now, message))
            self._size += len(message.data)
            self._forget(now)
            for sink in self._sinks:
                sink(message)

    def _forget(self, now: float) -> None:
        """Drop messages that are too old or too many."""
        config = self.config
        recording = config.flight_time > 0 and config.raw_size > 0
        lead = LEAD if self._sinks else 0.0  # each part of a saved bag begins with these seconds
        oldest = now - (config.flight_time + LEAD if recording else lead)
        while self._messages and (
            self._messages[0][0] <= oldest
            or (self._size > config.raw_size * MEGABYTE and self._messages[0][0] <= now - lead)
        ):
            _, message = self._messages.popleft()
            self._size -= len(message.data)
            self._earlier.note(message)

    def held(self, seconds: float | None = None) -> list[RawMessage]:
        """Return the messages of the last seconds, or all, in order of receipt.

        The earlier messages that are still valid come first.
        """
        with self._held:
            since = -1.0 if seconds is None else time.monotonic() - seconds
            recent: list[RawMessage] = []
            earlier = self._earlier.copy()
            for at, message in self._messages:
                if at >= since:
                    recent.append(message)
                else:
                    earlier.note(message)
        recent.sort(key=lambda message: message.received)
        first = recent[0].received if recent else time.time_ns()
        return [*earlier.before(first), *recent]

    def attach(self, sink: Sink, begin: Callable[[Sequence[RawMessage]], None]) -> None:
        """Pass the held messages to ``begin``, and every later one to ``sink``, in the receiving thread."""
        with self._held:
            begin(self.held())
            self._sinks.append(sink)

    def begin_again(self, begin: Callable[[Sequence[RawMessage]], None]) -> None:
        """Pass the messages that a new bag needs to ``begin``. No message comes meanwhile."""
        with self._held:
            begin(self.held(LEAD))

    def detach(self, sink: Sink) -> None:
        """Stop passing messages to a sink."""
        with self._held, suppress(ValueError):
            self._sinks.remove(sink)


def write_bag(path: Path, messages: Sequence[RawMessage]) -> None:
    """Write messages as an MCAP file. The file appears when it is complete.

    Raises:
        UserError: the file exists already, or cannot be written.
    """
    if path.exists():
        raise UserError(f"{path}: is already there")
    with McapWriter(path, define, replace=False) as bag:
        for message in messages:
            bag.write(message.connection, message.received, message.data, message.sent)


@cache
def _defined(kind: str) -> MessageDefinition:
    """Return the definition of a message type."""
    text = definition(kind)
    form = MessageDefinitionFormat.NONE if text is None else MessageDefinitionFormat.MSG
    return MessageDefinition(form, text or "")


def define(connection: Connection) -> MessageDefinition:
    """Return the definition of a connection's message type."""
    return _defined(connection.msgtype)


def children(data: bytes) -> tuple[bytes, ...]:
    """Return the child frames of a serialised tf2_msgs/TFMessage, or none if it cannot be read."""
    with suppress(struct.error, IndexError):
        return tuple(_children(data))
    return ()


def _children(data: bytes) -> Iterator[bytes]:
    """Yield the child frames of a serialised tf2_msgs/TFMessage."""
    order = "<" if data[1] & 1 else ">"
    length = struct.Struct(order + "I")
    (count,) = length.unpack_from(data, 4)
    at = 8
    for _ in range(count):
        at += 8  # the stamp
        (size,) = length.unpack_from(data, at)
        at += 4 + size
        at += -at % 4
        (size,) = length.unpack_from(data, at)
        yield data[at + 4 : at + 3 + size]
        at += 4 + size
        at += (4 - at) % 8 + 56  # numbers are aligned relative to the end of the four-byte header
