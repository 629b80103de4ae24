"""The Ousters of a graph: what their metadata say, and the scans that their packets make."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Set
from dataclasses import replace
from pathlib import Path

from bevviz.drivers import ouster
from bevviz.drivers.calibration_file import read_calibration
from bevviz.errors import UserError
from bevviz.messages.decoding import MessageError
from bevviz.messages.topics import NOT_LIDAR, Topic


class Ousters:
    """For one thread, which receives.

    A topic of packets is a LiDAR's once its metadata are known: those of a file, else of the topic beside it.
    """

    def __init__(self) -> None:
        self._texts: dict[str, str] = {}  # topic of packets -> its metadata
        self._scans: dict[str, ouster.Scans] = {}
        self._imus: set[str] = set()  # topics whose packets are too small for a LiDAR's
        self._beside: dict[str, set[str]] = {}  # topic of metadata -> topics of packets

    @property
    def metadata(self) -> Set[str]:
        """The topics that metadata are expected on."""
        return self._beside.keys()

    @property
    def packets(self) -> Set[str]:
        """The topics whose packets make scans."""
        return self._scans.keys() - self._imus

    def look(self, topics: Iterable[Topic], calibration: Mapping[str, str]) -> list[Topic]:
        """The same topics, those of packets with what is known of them.

        Args:
            topics: all that there are.
            calibration: as ``source.lidar_calibration`` has it.

        Raises:
            UserError: a file of metadata cannot be used.
        """
        return [self._look(topic, calibration) for topic in topics]

    def _look(self, topic: Topic, calibration: Mapping[str, str]) -> Topic:
        name = topic.name
        if not ouster.is_packet(topic.type):
            return topic
        if name in self._imus or "imu" in name.rpartition("/")[2]:
            return replace(topic, aside=NOT_LIDAR)
        if file := calibration.get(name, ""):
            if name not in self._scans:
                self._add(name, read_calibration(Path(file)), f"source.lidar_calibration: {file}")
        else:
            self._beside.setdefault(ouster.metadata_of(name), set()).add(name)
        if name in self._scans:
            return replace(topic, scans=True, frame_id=ouster.FRAME)
        return replace(topic, aside=ouster.waits(name))

    def _add(self, topic: str, text: str, where: str) -> None:
        if self._texts.get(topic) != text:
            self._scans[topic] = ouster.Scans(ouster.read_sensor(text, where))
            self._texts[topic] = text

    def add_metadata(self, topic: str, text: str) -> bool:
        """What came on a topic of metadata; whether it differs from what came before.

        Raises:
            MessageError: they are none, or of a sensor that is not decoded here.
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
        return self._scans[topic].sensor

    def add_packet(self, topic: str, received: int, data: bytes) -> Iterator[tuple[ouster.Packet, ...]]:
        """The scans that are whole with this message.

        Raises:
            MessageError: it is no packet of the sensor that the metadata are of.
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
