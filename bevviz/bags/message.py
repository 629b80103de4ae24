"""Messages as they lie in a recording, and how they are serialised."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from backports import zstd
from rosbags.interfaces import Connection, ConnectionExtRosbag1

from bevviz.bags.reader import LONGEST, ZSTD, normalized
from bevviz.messages import foxglove
from bevviz.messages.decoding import MessageError, read_header
from bevviz.messages.guard import guard


@dataclass(frozen=True, slots=True)
class RawMessage:
    topic: str
    received: int  # log time, nanoseconds
    data: bytes | memoryview
    connection: Connection
    packets: tuple[tuple[int, bytes | memoryview], ...] = ()  # with the time of each: a scan, see ``scans``

    @property
    def type(self) -> str:
        return normalized(self.connection.msgtype)

    def content(self) -> bytes | memoryview:
        """The serialised message; a compressed one is unpacked.

        Raises:
            zstd.ZstdError: it cannot be, or has more than ``LONGEST`` bytes.
        """
        if self.data[:4] != ZSTD:
            return self.data
        stream = zstd.ZstdDecompressor()
        data = stream.decompress(self.data, LONGEST)
        if not stream.eof:
            raise zstd.ZstdError("the end of the compressed message is missing, or it is too long")
        return data

    def header(self) -> tuple[int, str]:
        """Stamp in nanoseconds and frame_id of a message that begins with a Header; the rest is not decoded.

        Raises:
            MessageError: there is no header.
        """
        try:
            data = self.content()
        except zstd.ZstdError:
            raise MessageError(f"{self.topic}: a message of {len(self.data)} bytes is damaged") from None
        if form_of(self.connection):
            return guard(self, foxglove.header, self.parsed(data), self.connection.msgtype)
        little = is_ros1(self.connection) or data[1:2] != b"\0"
        return read_header(data, "<" if little else ">", self.topic)

    def parsed(self, data: bytes | memoryview) -> Any:
        """The message of Foxglove's that these bytes are.

        Raises:
            MessageError: they are none.
        """
        about = self.connection
        return guard(self, foxglove.parse, data, about.msgtype, form_of(about), about.msgdef.data)


def form_of(connection: Connection) -> str:
    """How messages of Foxglove's are serialised where ROS does not: protobuf or json; else empty."""
    form = getattr(connection.ext, "serialization_format", "")
    return form if form in foxglove.ENCODINGS and foxglove.short_of(connection.msgtype) else ""


def is_ros1(connection: Connection) -> bool:
    """Whether its messages are serialised as in ROS 1."""
    extra = connection.ext
    return isinstance(extra, ConnectionExtRosbag1) or extra.serialization_format == "ros1"
