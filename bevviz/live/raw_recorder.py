"""The serialised messages of the last seconds, as they came, to be written as a bag that runs again."""

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

LEAD = 3.0  # seconds before the first frame: what it was synchronised with, and its transforms, came earlier
BULKY = frozenset({"PointCloud2", "Image", "CompressedImage"})
PACKETS = frozenset({"PacketMsg", "PandarScan", "VelodyneScan", "CustomMsg", "CompressedPointCloud2"})


class RawMessage(NamedTuple):
    """Times are nanoseconds since 1970: when the middleware had it, and when it was published."""

    connection: Connection
    received: int
    sent: int
    data: bytes

    @property
    def passing(self) -> bool:
        """Whether it holds for its own time alone, as a scan or an image does."""
        return self.connection.msgtype.rpartition("/")[2] in BULKY | PACKETS


Sink = Callable[[RawMessage], None]


class Earlier:
    """What holds until something else is said: of each topic the last message, of transforms each one.

    So a map, a calibration, a robot's description and a mounting that were published once are there however
    long ago that was. Of clouds, what they are made of, and images none is kept.
    """

    def __init__(self) -> None:
        self._last: dict[tuple[str, tuple[bytes, ...]], RawMessage] = {}
        self.size = 0

    def note(self, message: RawMessage) -> None:
        if message.passing:
            return
        is_tf = message.connection.msgtype.endswith("/TFMessage")
        key = message.connection.topic, children(message.data) if is_tf else ()
        former = self._last.pop(key, None)  # the order is that of the messages
        self._last[key] = message
        self.size += len(message.data) - (0 if former is None else len(former.data))

    def copy(self) -> Earlier:
        other = Earlier()
        other._last, other.size = dict(self._last), self.size
        return other

    def before(self, received: int) -> list[RawMessage]:
        """With times of receipt just before this one: who plays the bag must not wait for hours."""
        return [
            message._replace(received=received - place)
            for place, message in zip(range(len(self._last), 0, -1), self._last.values(), strict=True)
        ]


class RawRecorder:
    """Holds the messages of the last ``live.flight_time`` and ``LEAD``, within ``live.raw_size``.

    Messages are put by one thread; everything else may be called from any.
    """

    def __init__(self, config: LiveConfig) -> None:
        self.config = config
        self.left_out: dict[str, str] = {}  # topic that is published and not held -> why
        self._messages: deque[tuple[float, RawMessage]] = deque()  # with the time of putting, monotonic
        self._earlier = Earlier()
        self._size = 0
        self._sinks: list[Sink] = []
        self._held = threading.RLock()

    @property
    def size(self) -> int:
        """Bytes held."""
        return self._size + self._earlier.size

    @property
    def seconds(self) -> float:
        """That the messages held reach back."""
        with self._held:
            return self._messages[-1][0] - self._messages[0][0] if self._messages else 0.0

    def put(self, message: RawMessage) -> None:
        now = time.monotonic()
        with self._held:
            self._messages.append((now, message))
            self._size += len(message.data)
            self._forget(now)
            for sink in self._sinks:
                sink(message)

    def _forget(self, now: float) -> None:
        config = self.config
        recording = config.flight_time > 0 and config.raw_size > 0
        lead = LEAD if self._sinks else 0.0  # each part of a recording begins with it
        oldest = now - (config.flight_time + LEAD if recording else lead)
        while self._messages and (
            self._messages[0][0] <= oldest
            or (self._size > config.raw_size * MEGABYTE and self._messages[0][0] <= now - lead)
        ):
            _, message = self._messages.popleft()
            self._size -= len(message.data)
            self._earlier.note(message)

    def held(self, seconds: float | None = None) -> list[RawMessage]:
        """The messages of the last seconds, or all, in order of receipt, behind what holds from before."""
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
        """``begin`` gets what is held, ``sink`` every message from then on, in the receiving thread."""
        with self._held:
            begin(self.held())
            self._sinks.append(sink)

    def begin_again(self, begin: Callable[[Sequence[RawMessage]], None]) -> None:
        """``begin`` gets what a bag that starts now needs; no message comes meanwhile."""
        with self._held:
            begin(self.held(LEAD))

    def detach(self, sink: Sink) -> None:
        with self._held, suppress(ValueError):
            self._sinks.remove(sink)


def write_bag(path: Path, messages: Sequence[RawMessage]) -> None:
    """As an MCAP file, which appears when it is whole.

    Raises:
        UserError: it is already there, or cannot be written.
    """
    if path.exists():
        raise UserError(f"{path}: is already there")
    with McapWriter(path, define, replace=False) as bag:
        for message in messages:
            bag.write(message.connection, message.received, message.data, message.sent)


@cache
def _defined(kind: str) -> MessageDefinition:
    text = definition(kind)
    form = MessageDefinitionFormat.NONE if text is None else MessageDefinitionFormat.MSG
    return MessageDefinition(form, text or "")


def define(connection: Connection) -> MessageDefinition:
    """What its messages are made of."""
    return _defined(connection.msgtype)


def children(data: bytes) -> tuple[bytes, ...]:
    """The child frames of a serialised tf2_msgs/TFMessage; none where it cannot be read."""
    with suppress(struct.error, IndexError):
        return tuple(_children(data))
    return ()


def _children(data: bytes) -> Iterator[bytes]:
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
        at += (4 - at) % 8 + 56  # numbers are aligned behind the four bytes that say the encoding
