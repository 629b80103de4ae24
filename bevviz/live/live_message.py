"""A message of a running ROS 2 graph, as it came."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any

from bevviz.drivers import ouster
from bevviz.messages.decoders import Serialization
from bevviz.messages.decoding import read_header
from bevviz.messages.definitions import store_of
from bevviz.messages.guard import decode_message, guard
from bevviz.messages.vision_msgs import deserialize


@dataclass(frozen=True, slots=True)
class LiveMessage:
    topic: str
    type: str
    received: int  # nanoseconds, when the middleware had it
    data: bytes  # CDR
    sensor: ouster.Sensor | None = None  # an Ouster, whose packets make a scan
    packets: tuple[ouster.Packet, ...] = ()

    def header(self) -> tuple[int, str]:
        return read_header(self.data, "<" if self.data[1:2] != b"\0" else ">", self.topic)

    def decode(self, calibration: Mapping[str, str] = MappingProxyType({})) -> Any:
        """The message as an object with the fields of its definition.

        ``calibration`` is that of the LiDARs, by topic, as ``source.lidar_calibration`` has it.

        Raises:
            MessageError: the data does not fit the definition.
        """
        if self.sensor is not None:
            return guard(self, partial(ouster.decode, self.sensor), self.packets)
        serialization = Serialization(self.type, calibration=calibration.get(self.topic, ""))
        return decode_message(self, self.data, self._deserialized, serialization)

    def _deserialized(self, data: bytes | memoryview) -> Any:
        """Return the message as its definition has it."""
        return deserialize(store_of(self.type), data, self.type)
