"""Network captures (pcap, pcapng) of LiDARs, as topics of the packets that their drivers record.

The formats are those of the IETF drafts draft-ietf-opsawg-pcap and draft-ietf-opsawg-pcapng.
"""

from __future__ import annotations

import heapq
import struct
from array import array
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import BinaryIO, Literal, NamedTuple

import numpy as np
from rosbags.interfaces import Connection

from bevviz.bags.file_types import FileFormat
from bevviz.bags.reader import LAST_TIME, FileBytes, Message
from bevviz.datasets.dataset import make_connection
from bevviz.errors import UserError
from bevviz.extras.lidars import hesai, ouster
from bevviz.extras.lidars.scan_messages import encode_scan
from bevviz.messages.definitions import typestore
from bevviz.messages.encode import make_message
from bevviz.model.frame import I64
from bevviz.support.limits import MAX_PACKET

SECOND = 1_000_000_000
# Of files in either byte order: nanoseconds of a unit of the fraction of a second.
MAGICS = {
    b"\xd4\xc3\xb2\xa1": 1000,
    b"\xa1\xb2\xc3\xd4": 1000,
    b"\x4d\x3c\xb2\xa1": 1,
    b"\xa1\xb2\x3c\x4d": 1,
}
NEXT_GENERATION = b"\n\r\r\n"
LITTLE = (b"\xd4", b"\x4d")  # first bytes of little-endian files
# Bytes before the type of the network protocol, by type of the link; None: the packet begins with IP.
LINKS = {1: 12, 113: 14, 276: 0, 0: None, 101: None, 108: None, 228: None}
LOOPBACK = (0, 108)  # links with four bytes before IP
VLAN = (0x8100, 0x88A8)
VELODYNE, OUSTER, HESAI = "velodyne", "ouster", "hesai"
VELODYNE_SIZE, HESAI_SIZE = 1206, 1500
VELODYNE_AZIMUTH = 2  # offset in a packet
OUSTER_PORT = 7502
HALF_TURN = 18_000  # hundredths of a degree
TYPES = {
    VELODYNE: "velodyne_msgs/msg/VelodyneScan",
    HESAI: "pandar_msgs/msg/PandarScan",
    OUSTER: "ouster_sensor_msgs/msg/PacketMsg",
}
METADATA = "/ouster/metadata"


class Datagram(NamedTuple):
    """UDP datagram: time in nanoseconds, sender, port, and the places of its pieces in the file."""

    time: int
    sender: bytes
    port: int
    pieces: tuple[tuple[int, int], ...]


@dataclass(slots=True)
class PacketStream:
    """Packets of one sensor.

    Attributes:
        kind: make of the sensor.
        times: nanoseconds of each packet.
        pieces: places of each packet in the file.
        starts: number of the first packet of each scan. Of an Ouster each packet is a message of its own.
        azimuth: last azimuth, hundredths of a degree.
    """

    kind: str
    times: array[int] = field(default_factory=lambda: array("q"))
    pieces: list[tuple[tuple[int, int], ...]] = field(default_factory=list)
    starts: array[int] = field(default_factory=lambda: array("q"))
    azimuth: int = -1

    def add(self, datagram: Datagram, azimuth: int) -> None:
        """Add a packet. A scan ends where the azimuth starts again."""
        if self.kind == OUSTER or self.azimuth < 0 or abs(azimuth - self.azimuth) > HALF_TURN:
            self.starts.append(len(self.times))
        self.azimuth = azimuth
        self.times.append(datagram.time)
        self.pieces.append(datagram.pieces)

    def received(self) -> I64:
        """Return the time of each message: that of its last packet."""
        last = np.append(np.frombuffer(self.starts, np.int64)[1:], len(self.times)) - 1
        return np.maximum.accumulate(np.frombuffer(self.times, np.int64)[last])


class PcapReader:
    """Reader of the LiDAR packets in a capture: of a Velodyne, an Ouster or a Hesai.

    The metadata of an Ouster are a JSON file beside the capture: of its name, or the only one in the folder.

    Raises:
        UserError: the file is no capture, or no packet in it is of one of these LiDARs.
    """

    def __init__(self, path: Path) -> None:
        self.compression, self.warnings = "", list[str]()
        self._file = FileBytes(path)
        self._metadata = _read_metadata(path)
        sensor = ouster.read_sensor(self._metadata, str(path)) if self._metadata else None
        streams, others = dict[tuple[str, bytes, int], PacketStream](), Counter[tuple[int, int]]()
        with path.open("rb") as file:
            for datagram in _datagrams(file, self.warnings):
                data = self._read(datagram.pieces)
                kind, azimuth = _recognise(data, datagram.port, sensor)
                if kind:
                    key = kind, datagram.sender, datagram.port
                    streams.setdefault(key, PacketStream(kind)).add(datagram, azimuth)
                else:
                    others[len(data), datagram.port] += 1
        if not streams:
            self.close()
            (size, port), count = others.most_common(1)[0] if others else ((0, 0), 0)
            most = f"; most of its packets have {size} bytes, to port {port}" if count else ""
            raise UserError(
                f"{path}: no packets of a Velodyne, an Ouster or a Hesai in it{most}: play them through "
                "their driver and record its topics"
            )
        kinds = Counter(kind for kind, *_ in streams)
        self._streams, self.connections = list[PacketStream](), list[Connection]()
        for (kind, _, port), stream in streams.items():
            part = "lidar_packets" if kind == OUSTER else "packets"
            topic = f"/{kind}/{part}" if kinds[kind] == 1 else f"/{kind}_{port}/{part}"
            self._streams.append(stream)
            self.connections.append(
                make_connection(len(self.connections), topic, TYPES[kind], len(stream.starts))
            )
        if self._metadata and kinds[OUSTER]:
            number = len(self.connections)
            self.connections.append(make_connection(number, METADATA, "std_msgs/msg/String", 1))

    @property
    def span(self) -> tuple[int, int]:
        """Log time of the first message, and log time of the last message plus one nanosecond."""
        times = [stream.received() for stream in self._streams]
        return min(int(t[0]) for t in times), max(int(t[-1]) for t in times) + 1

    def messages(self, ids: Collection[int], start: int, stop: int) -> Iterator[Message]:
        """Yield messages as ``bevviz.bags.reader.Reader`` does."""
        parts = [self._messages(number, start, stop) for number in ids]
        yield from heapq.merge(*parts, key=itemgetter(1))

    def times(self, ids: Collection[int], start: int = 0, stop: int = LAST_TIME) -> I64:
        """Return the sorted log times of the connections ``ids`` with start <= time < stop."""
        times = np.sort(np.concatenate([self._received(number) for number in ids]))
        return times[(times >= start) & (times < stop)]

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _received(self, number: int) -> I64:
        if number == len(self._streams):  # the metadata
            return np.array([self.span[0]], np.int64)
        return self._streams[number].received()

    def _messages(self, number: int, start: int, stop: int) -> Iterator[Message]:
        """Yield the messages of one connection."""
        received = self._received(number)
        first, last = np.searchsorted(received, [start, stop])
        for row in range(int(first), int(last)):
            yield self.connections[number], int(received[row]), self._message(number, row)

    def _message(self, number: int, row: int) -> bytes | memoryview:
        """Return a serialised message."""
        if number == len(self._streams):
            text = make_message("std_msgs/msg/String", data=self._metadata)
            return typestore().serialize_cdr(text, "std_msgs/msg/String")
        stream = self._streams[number]
        first = stream.starts[row]
        end = stream.starts[row + 1] if row + 1 < len(stream.starts) else len(stream.times)
        packets = [self._read(stream.pieces[packet]) for packet in range(first, end)]
        if stream.kind == OUSTER:
            return b"\0\1\0\0" + struct.pack("<I", len(packets[0])) + packets[0]
        size, sized = (HESAI_SIZE, True) if stream.kind == HESAI else (VELODYNE_SIZE, False)
        return encode_scan(stream.kind, stream.times[first:end], packets, size, sized=sized)

    def _read(self, pieces: tuple[tuple[int, int], ...]) -> bytes:
        return b"".join(self._file.read(offset, length) for offset, length in pieces)


def _read_metadata(path: Path) -> str:
    """Return the metadata of an Ouster beside a capture; empty if there are none."""
    files = [path.with_suffix(".json")] if path.with_suffix(".json").is_file() else []
    files = files or list(path.parent.glob("*.json"))
    text = files[0].read_text(errors="replace") if len(files) == 1 else ""
    return text if "beam_altitude_angles" in text else ""


def _recognise(data: bytes, port: int, sensor: ouster.Sensor | None) -> tuple[str, int]:
    """Return the make of the sensor that sent a packet and its first azimuth; an empty text if not known."""
    if len(data) == VELODYNE_SIZE and data[:2] == b"\xff\xee":
        return VELODYNE, int.from_bytes(data[VELODYNE_AZIMUTH : VELODYNE_AZIMUTH + 2], "little")
    if len(data) == sensor.size if sensor else port == OUSTER_PORT and len(data) > ouster.SMALLEST:
        return OUSTER, 0
    for model in hesai.MODELS:
        fits = all(byte in (None, at) for byte, at in zip(model.head, data, strict=False))
        if fits and model.size <= len(data) <= HESAI_SIZE:
            at = model.first + model.start
            return HESAI, int.from_bytes(data[at : at + 2], "little")
    return "", 0


# --- the capture -------------------------------------------------------------------------------


def _datagrams(file: BinaryIO, warnings: list[str]) -> Iterator[Datagram]:
    """Yield the UDP datagrams of a capture. Those of several IP fragments come with the last one."""
    fragments: dict[tuple[bytes, int], list[tuple[int, int, int]]] = {}
    for time, link, offset, packet in _packets(file, warnings):
        at = _ip_start(packet, link)
        if at is None or len(packet) < at + 20:
            continue
        version, header = packet[at] >> 4, 4 * (packet[at] & 0xF)
        if version == 6 and len(packet) >= at + 48 and packet[at + 6] == 17:
            sender, begin, end = packet[at + 8 : at + 24], at + 40, len(packet)
        elif version == 4 and packet[at + 9] == 17:
            sender, begin = packet[at + 12 : at + 16], at + header
            total, name, flags = struct.unpack_from(">HHH", packet, at + 2)
            end = min(len(packet), at + total) if total else len(packet)
            if flags & 0x3FFF:  # a fragment: more follow, or it does not begin the datagram
                pieces = fragments.setdefault((sender, name), [])
                pieces.append((8 * (flags & 0x1FFF), offset + begin, end - begin))
                if flags & 0x2000:
                    continue
                whole = _joined(fragments.pop((sender, name)))
                if whole is not None:
                    port = int.from_bytes(_peek(file, whole[0][0] + 2, 2), "big")
                    yield Datagram(time, sender, port, _without_header(whole))
                continue
        else:
            continue
        if end >= begin + 8:
            port = int.from_bytes(packet[begin + 2 : begin + 4], "big")
            yield Datagram(time, sender, port, ((offset + begin + 8, end - begin - 8),))


def _joined(pieces: list[tuple[int, int, int]]) -> list[tuple[int, int]] | None:
    """Return the places of all fragments of a datagram in order; None if one is missing."""
    expected, places = 0, list[tuple[int, int]]()
    for begin, offset, length in sorted(pieces):
        if begin != expected:
            return None
        expected += length
        places.append((offset, length))
    return places


def _without_header(places: list[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
    """Return the places of a datagram's content, without the eight bytes of the UDP header."""
    (offset, length), *others = places
    return ((offset + 8, length - 8), *others)


def _peek(file: BinaryIO, offset: int, size: int) -> bytes:
    """Read bytes and return to the present position."""
    at = file.tell()
    file.seek(offset)
    data = file.read(size)
    file.seek(at)
    return data


def _ip_start(packet: bytes, link: int) -> int | None:
    """Return the offset of the IP header in a packet; None if it has none, or the link is not known."""
    if link not in LINKS:
        return None
    at = LINKS[link]
    if at is None:
        return 4 if link in LOOPBACK else 0
    protocol = int.from_bytes(packet[at : at + 2], "big")
    while protocol in VLAN:
        at += 4
        protocol = int.from_bytes(packet[at : at + 2], "big")
    after = 20 if link == 276 else at + 2
    return after if protocol in (0x0800, 0x86DD) else None


def _packets(file: BinaryIO, warnings: list[str]) -> Iterator[tuple[int, int, int, bytes]]:
    """Yield time in nanoseconds, type of the link, offset and bytes of each packet."""
    magic = file.read(4)
    file.seek(0)
    if magic == NEXT_GENERATION:
        yield from _blocks(file, warnings)
        return
    if magic not in MAGICS:
        raise UserError(f"{file.name}: no network capture: neither pcap nor pcapng by its first bytes")
    order, unit = "<" if magic[:1] in LITTLE else ">", MAGICS[magic]
    header = file.read(24)
    link = struct.unpack_from(f"{order}I", header, 20)[0] & 0xFFFF if len(header) == 24 else -1
    record = struct.Struct(f"{order}IIII")
    while len(head := file.read(record.size)) == record.size:
        seconds, fraction, size, _ = record.unpack(head)
        offset = file.tell()
        packet = file.read(size) if size <= MAX_PACKET else b""
        if len(packet) < size:
            warnings.append("the capture ends early, or is damaged: the packets up to there are read")
            return
        yield seconds * SECOND + fraction * unit, link, offset, packet


def _blocks(file: BinaryIO, warnings: list[str]) -> Iterator[tuple[int, int, int, bytes]]:
    """Yield as ``_packets`` does the packets of a pcapng file."""
    order: Literal["<", ">"] = "<"
    interfaces = list[tuple[int, int, int]]()  # type of the link; factor and divisor of a time to nanoseconds
    while len(head := file.read(8)) == 8:
        if head[:4] == NEXT_GENERATION:
            order = "<" if _peek(file, file.tell(), 4) == b"\x4d\x3c\x2b\x1a" else ">"
            interfaces.clear()
        kind, length = struct.unpack(f"{order}II", head)
        offset = file.tell()
        body = file.read(length - 8) if 12 <= length <= 2 * MAX_PACKET else b""
        if len(body) < max(length - 8, 4):
            warnings.append("the capture ends early, or is damaged: the packets up to there are read")
            return
        if kind == 1:
            interfaces.append((struct.unpack_from(f"{order}H", body)[0], *_time_unit(body[8:-4], order)))
        elif kind == 6:
            number, high, low, size = struct.unpack_from(f"{order}IIII", body)
            if number < len(interfaces):
                link, factor, divisor = interfaces[number]
                yield (high << 32 | low) * factor // divisor, link, offset + 20, body[20 : 20 + size]


def _time_unit(options: bytes, order: str) -> tuple[int, int]:
    """Return factor and divisor of a time to nanoseconds, by the options of an interface."""
    at = 0
    while at + 4 <= len(options):
        code, length = struct.unpack_from(f"{order}HH", options, at)
        if code == 9 and length:
            value = options[at + 4]
            return SECOND, 2 ** (value & 0x7F) if value & 0x80 else 10**value
        if not code:
            break
        at += 4 + length + -length % 4
    return 1000, 1


FORMATS = tuple(
    FileFormat("network capture", magic, ".pcap", PcapReader) for magic in (*MAGICS, NEXT_GENERATION)
)
