"""Serialised messages of a running ROS 2 graph."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from bevviz.messages.decoders import Scan, Serialization, decode_scan, read_header
from bevviz.messages.definitions import deserialize_cdr, store_of
from bevviz.messages.guard import decode_message, guard


@dataclass(frozen=True, slots=True)
class LiveMessage:
    """Message as received, or one scan made of packets."""

    topic: str
    type: str
    received: int  # nanoseconds, time of receipt by the middleware
    data: bytes  # CDR
    scan: Scan | None = None  # scan made of packets, in place of ``data``

    def header(self) -> tuple[int, str]:
        """Return the stamp in nanoseconds and the frame id of the header."""
        return read_header(self.data, "<" if self.data[1:2] != b"\0" else ">", self.topic)

    def decode(self, calibration: Mapping[str, str] = MappingProxyType({})) -> Any:
        """Return the message as an object with the fields of its definition, or what its decoder makes of it.

        ``calibration`` holds the calibration files of the LiDARs by topic, as in
        ``source.lidar_calibration``.

        Raises:
            MessageError: the data does not fit the definition.
        """
        if self.scan is not None:
            return guard(self, decode_scan, self.scan)
        serialization = Serialization(self.type, calibration=calibration.get(self.topic, ""))

        def to_object(data: bytes | memoryview) -> Any:
            return deserialize_cdr(store_of(self.type), data, self.type)

        return decode_message(self, self.data, to_object, serialization)
