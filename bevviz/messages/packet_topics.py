"""Live topics whose messages are single packets of a LiDAR, and the calibration files of LiDARs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Set
from dataclasses import replace
from pathlib import Path

from bevviz.errors import UserError
from bevviz.messages.decoders import (
    Bytes,
    MessageError,
    PacketStream,
    Scan,
    ScanDecoder,
    declared_decoder,
)
from bevviz.messages.topics import Topic
from bevviz.support.files import read_text


def packet_stream(msgtype: str) -> PacketStream | None:
    """Return the description of a message type whose messages are single packets; None for other types."""
    decoder = declared_decoder(msgtype)
    return decoder.packets if decoder is not None else None


def read_calibration(path: Path) -> str:
    """Return the text of a file that ``source.lidar_calibration`` names.

    Raises:
        UserError: the file cannot be read.
    """
    return read_text(path, problem=f"source.lidar_calibration: {path}: cannot be read")


def open_calibrated(stream: PacketStream, file: str) -> ScanDecoder:
    """Return the decoder of a sensor whose metadata ``source.lidar_calibration`` names.

    Raises:
        UserError: the file cannot be used.
    """
    return stream.open(read_calibration(Path(file)), f"source.lidar_calibration: {file}")


class PacketTopics:
    """Decoders of the topics of packets on a live graph. Only the receiving thread may use it.

    A topic of packets belongs to a LiDAR once its metadata are known. They come from a file, or else from the
    metadata topic beside it.
    """

    def __init__(self) -> None:
        self._texts: dict[str, str] = {}  # topic of packets -> its metadata
        self._decoders: dict[str, ScanDecoder] = {}
        self._streams: dict[str, PacketStream] = {}
        self._imus: set[str] = set()  # topics whose packets are too small for a LiDAR
        self._beside: dict[str, set[str]] = {}  # topic of metadata -> topics of packets

    @property
    def metadata(self) -> Set[str]:
        """Topics on which metadata are expected."""
        return self._beside.keys()

    @property
    def packets(self) -> Set[str]:
        """Topics whose packets make scans."""
        return self._decoders.keys() - self._imus

    def describe(self, topic: Topic, calibration: Mapping[str, str]) -> Topic:
        """Return the same topic. A topic of packets gets the known facts about it.

        Args:
            topic: any topic of the graph.
            calibration: metadata files by topic, as in ``source.lidar_calibration``.

        Raises:
            UserError: a metadata file cannot be used.
        """
        name, stream = topic.name, packet_stream(topic.type)
        if stream is None:
            return topic
        self._streams[name] = stream
        if name in self._imus or "imu" in name.rpartition("/")[2]:
            return replace(topic, aside=stream.imu)
        if file := calibration.get(name, ""):
            if name not in self._decoders:
                self._decoders[name] = open_calibrated(stream, file)
        else:
            self._beside.setdefault(stream.metadata_topic(name), set()).add(name)
        if name in self._decoders:
            return replace(topic, scans=True, frame_id=self._decoders[name].frame_id)
        return replace(topic, aside=stream.awaits_metadata(name))

    def add_metadata(self, topic: str, text: str) -> bool:
        """Take in a message of a metadata topic. Return whether it differs from the last one.

        Raises:
            MessageError: the text is not metadata, or the sensor is not supported.
        """
        names = self._beside[topic]
        changed = any(self._texts.get(name, text) != text for name in names)
        try:
            for name in names:
                if self._texts.get(name) != text:
                    self._decoders[name] = self._streams[name].open(text, topic)
                    self._texts[name] = text
        except UserError as error:
            raise MessageError(str(error)) from None
        return changed

    def add_packet(self, topic: str, received: int, data: Bytes) -> Iterator[Scan]:
        """Yield the scans that are complete with this message.

        Raises:
            MessageError: the packet does not fit the sensor of the metadata.
        """
        try:
            yield from self._decoders[topic].add(received, data, ros1=False)
        except ValueError as error:
            if len(data) <= self._streams[topic].smallest:
                self._imus.add(topic)
            raise MessageError(f"{topic}: {error}") from None
