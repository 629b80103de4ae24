"""Messages as a recording stores them, and their serialisation formats."""

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
    """One serialised message of a recording.

    Attributes:
        topic: name of the topic.
        received: log time in nanoseconds.
        data: serialised message, possibly compressed with zstd.
        connection: connection that recorded the message.
        packets: time in nanoseconds and bytes of each LiDAR packet of one scan; see ``Recording.scans``.
    """

    topic: str
    received: int
    data: bytes | memoryview
    connection: Connection
    packets: tuple[tuple[int, bytes | memoryview], ...] = ()

    @property
    def type(self) -> str:
        """Type of the message as ROS 2 spells it."""
        return normalized(self.connection.msgtype)

    def content(self) -> bytes | memoryview:
        """Return the serialised message. A compressed message is unpacked.

        Raises:
            zstd.ZstdError: the message cannot be unpacked, or it has more than ``LONGEST`` bytes.
        """
        if self.data[:4] != ZSTD:
            return self.data
        stream = zstd.ZstdDecompressor()
        data = stream.decompress(self.data, LONGEST)
        if not stream.eof:
            raise zstd.ZstdError("the end of the compressed message is missing, or it is too long")
        return data

    def header(self) -> tuple[int, str]:
        """Return the stamp in nanoseconds and the frame_id. Only the Header at the start is decoded.

        Raises:
            MessageError: the message has no header.
        """
        try:
            data = self.content()
        except zstd.ZstdError:
            raise MessageError(f"{self.topic}: a message of {len(self.data)} bytes is damaged") from None
        if foxglove_encoding(self.connection):
            return guard(self, foxglove.header, self.parsed(data), self.connection.msgtype)
        little = is_ros1(self.connection) or data[1:2] != b"\0"
        return read_header(data, "<" if little else ">", self.topic)

    def parsed(self, data: bytes | memoryview) -> Any:
        """Parse ``data`` as a Foxglove message.

        Raises:
            MessageError: the bytes do not fit the Foxglove type.
        """
        about = self.connection
        return guard(self, foxglove.parse, data, about.msgtype, foxglove_encoding(about), about.msgdef.data)


def foxglove_encoding(connection: Connection) -> str:
    """Return the serialisation of a Foxglove message that ROS cannot decode: protobuf, json, or empty."""
    form = getattr(connection.ext, "serialization_format", "")
    return form if form in foxglove.ENCODINGS and foxglove.foxglove_type(connection.msgtype) else ""


def is_ros1(connection: Connection) -> bool:
    """Tell whether the messages of a connection are serialised as in ROS 1."""
    extra = connection.ext
    return isinstance(extra, ConnectionExtRosbag1) or extra.serialization_format == "ros1"
