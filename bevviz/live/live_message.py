"""A message of a running ROS 2 graph, as it came."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any

from bevviz.drivers import ouster
from bevviz.drivers.compressed_clouds import decompress, is_compressed
from bevviz.drivers.livox import is_livox, read_custom
from bevviz.drivers.packets import is_packets, read_scan
from bevviz.messages.decoding import read_header
from bevviz.messages.definitions import store_of
from bevviz.messages.guard import guard
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
        if is_livox(self.type):
            return guard(self, partial(read_custom, ros1=False), self.data)
        if is_packets(self.type):
            file = calibration.get(self.topic, "")
            return guard(self, partial(read_scan, ros1=False, calibration=file), self.data, self.type)
        found = guard(self, partial(deserialize, store_of(self.type)), self.data, self.type)
        return guard(self, decompress, found) if is_compressed(self.type) else found
