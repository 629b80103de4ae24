"""Serialised messages of a running ROS 2 graph, and the scans made of the packets of Ouster sensors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

from bevviz.drivers import ouster
from bevviz.drivers.packets import read_calibration
from bevviz.errors import UserError
from bevviz.messages.decoders import MessageError, Serialization, read_header
from bevviz.messages.definitions import deserialize_cdr, store_of
from bevviz.messages.guard import decode_message, guard
from bevviz.messages.topics import NOT_LIDAR, Topic


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

        def to_object(data: bytes | memoryview) -> Any:
            return deserialize_cdr(store_of(self.type), data, self.type)

        return decode_message(self, self.data, to_object, serialization)


class OusterSensors:
    """Ouster sensors by topic of packets. Only the receiving thread may use it.

    A topic of packets belongs to a LiDAR once its metadata are known. They come from a file, or else from the
    metadata topic beside it.
    """

    def __init__(self) -> None:
        self._texts: dict[str, str] = {}  # topic of packets -> its metadata
        self._scans: dict[str, ouster.ScanCollector] = {}
        self._imus: set[str] = set()  # topics whose packets are too small for a LiDAR
        self._beside: dict[str, set[str]] = {}  # topic of metadata -> topics of packets

    @property
    def metadata(self) -> Set[str]:
        """Topics on which metadata are expected."""
        return self._beside.keys()

    @property
    def packets(self) -> Set[str]:
        """Topics whose packets make scans."""
        return self._scans.keys() - self._imus

    def describe(self, topic: Topic, calibration: Mapping[str, str]) -> Topic:
        """Return the same topic. A topic of packets gets the known facts about it.

        Args:
            topic: any topic of the graph.
            calibration: metadata files by topic, as in ``source.lidar_calibration``.

        Raises:
            UserError: a metadata file cannot be used.
        """
        name = topic.name
        if not ouster.is_packet(topic.type):
            return topic
        if name in self._imus or "imu" in name.rpartition("/")[2]:
            return replace(topic, aside=NOT_LIDAR)
        if file := calibration.get(name, ""):
            if name not in self._scans:
                self._add(name, read_calibration(Path(file)), f"source.lidar_calibration: {file}")
        else:
            self._beside.setdefault(ouster.metadata_topic(name), set()).add(name)
        if name in self._scans:
            return replace(topic, scans=True, frame_id=ouster.FRAME)
        return replace(topic, aside=ouster.waiting_note(name))

    def _add(self, topic: str, text: str, where: str) -> None:
        """Set the metadata of a topic of packets."""
        if self._texts.get(topic) != text:
            self._scans[topic] = ouster.ScanCollector(ouster.read_sensor(text, where))
            self._texts[topic] = text

    def add_metadata(self, topic: str, text: str) -> bool:
        """Take in a message of a metadata topic. Return whether it differs from the last one.

        Raises:
            MessageError: the text is not metadata, or the sensor is not supported.
        """
        names = self._beside[topic]
        changed = any(self._texts.get(name, text) != text for name in names)
        try:
            for name in names:
                self._add(name, text, topic)
        except UserError as error:
            raise MessageError(str(error)) from None
        return changed

    def sensor(self, topic: str) -> ouster.Sensor:
        """Return the sensor of a topic of packets."""
        return self._scans[topic].sensor

    def add_packet(
        self, topic: str, received: int, data: bytes
    ) -> Iterator[tuple[ouster.ReceivedPacket, ...]]:
        """Yield the scans that are complete with this message.

        Raises:
            MessageError: the packet does not fit the sensor of the metadata.
        """
        packet, scans = ouster.payload(data, ros1=False), self._scans[topic]
        if len(packet) != scans.sensor.size:
            if len(packet) <= ouster.SMALLEST:
                self._imus.add(topic)
            raise MessageError(
                f"{topic}: a packet of {len(packet)} bytes, but the sensor that its metadata are of sends "
                f"packets of {scans.sensor.size}"
            )
        yield from scans.add(received, packet)
