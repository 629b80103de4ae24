"""Serialised message of a running ROS 2 graph."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any

from bevviz.drivers import ouster
from bevviz.messages.decoders import Serialization
from bevviz.messages.decoding import read_header
from bevviz.messages.definitions import deserialize_cdr, store_of
from bevviz.messages.guard import decode_message, guard


@dataclass(frozen=True, slots=True)
class LiveMessage:
    """Message as received, or the packets of one Ouster scan."""

    topic: str
    type: str
    received: int  # nanoseconds, time of receipt by the middleware
    data: bytes  # CDR
    sensor: ouster.Sensor | None = None  # the Ouster whose packets make a scan
    packets: tuple[ouster.ReceivedPacket, ...] = ()

    def header(self) -> tuple[int, str]:
        """Return the stamp in nanoseconds and the frame id of the header."""
        return read_header(self.data, "<" if self.data[1:2] != b"\0" else ">", self.topic)

    def decode(self, calibration: Mapping[str, str] = MappingProxyType({})) -> Any:
        """Return the message as an object with the fields of its definition.

        ``calibration`` holds the calibration files of the LiDARs by topic, as in
        ``source.lidar_calibration``.

        Raises:
            MessageError: the data does not fit the definition.
        """
        if self.sensor is not None:
            return guard(self, partial(ouster.decode, self.sensor), self.packets)
        serialization = Serialization(self.type, calibration=calibration.get(self.topic, ""))
        return decode_message(self, self.data, self._deserialized, serialization)

    def _deserialized(self, data: bytes | memoryview) -> Any:
        """Return the message as an object of its definition."""
        return deserialize_cdr(store_of(self.type), data, self.type)
