"""Decoder for packets of Hesai's mechanical LiDARs, by the layouts in their manuals."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import cache
from io import StringIO
from pathlib import Path

import numpy as np

from bevviz.errors import UserError
from bevviz.extras.lidars.scan_messages import ScanPackets, split
from bevviz.messages.clouds import make_cloud
from bevviz.messages.decoders import Bytes, Decoder, Serialization
from bevviz.messages.packet_topics import read_calibration
from bevviz.model.frame import F32, I64, Cloud

NOMINAL = Path(__file__).with_name("hesai_angles.csv")  # the angles that Hesai's drivers contain
AZIMUTHS = 36_000  # units of a full circle
POINT = np.dtype([(n, "<f4") for n in ("x", "y", "z", "intensity", "time")] + [("ring", "<u2")])


@dataclass(frozen=True, slots=True)
class Model:
    """Packet layout of a sensor model.

    Attributes:
        name: Hesai's name of the model.
        head: first bytes of a packet; None is any byte.
        first: bytes before the first block.
        start: bytes of a block before its azimuth.
        blocks: number of blocks in a packet.
        channels: number of channels in a block.
        unit: bytes of a measurement: distance (2), reflectivity (1), and bytes that are not used.
        behind: bytes between the last block and the tail.
        mode: byte of the return mode within the tail.
        clock: byte of the clock's microseconds within the tail.
        tail: bytes of the tail that are used.
        scale: byte with the unit of distance in millimetres; None: the unit is 4 mm.
        period: microseconds between two blocks; negative if the clock gives the time of the last block.
    """

    name: str
    head: tuple[int | None, ...]
    first: int
    start: int
    blocks: int
    channels: int
    unit: int
    behind: int
    mode: int
    clock: int
    tail: int
    scale: int | None
    period: float

    @property
    def block(self) -> np.dtype[np.void]:
        """Data type of a block."""
        measured = np.dtype(
            {"names": ["distance", "reflectivity"], "formats": ["<u2", "u1"], "itemsize": self.unit}
        )
        return np.dtype(
            {
                "names": ["azimuth", "measured"],
                "formats": ["<u2", (measured, (self.channels,))],
                "offsets": [self.start, self.start + 2],
            }
        )

    @property
    def end(self) -> int:
        """Byte at which the tail begins."""
        return self.first + self.blocks * self.block.itemsize + self.behind

    @property
    def size(self) -> int:
        """Smallest size of a packet in bytes."""
        return self.end + self.tail


def _with_header(
    name: str, version: tuple[int, int], channels: int, blocks: int, period: float, **places: int
) -> Model:
    """Make the layout of a model whose packets state version, channels, blocks and unit of distance."""
    head = (0xEE, 0xFF, *version, None, None, channels, blocks)
    return Model(name, head, 12, 0, blocks, channels, 4, scale=9, period=period, **places)


XT = {"behind": 0, "mode": 10, "clock": 19, "tail": 23}
MODELS = (
    Model("Pandar40P", (0xFF, 0xEE), 0, 2, 10, 40, 3, 0, 14, 10, 22, scale=None, period=-55.56),
    Model("Pandar64", (0xEE, 0xFF, 64, 6), 8, 0, 6, 64, 3, 0, 14, 10, 22, scale=5, period=-55.56),
    _with_header("PandarQT64", (3, 1), 64, 4, 166.67, behind=0, mode=16, clock=12, tail=18),
    _with_header("PandarQT128", (3, 2), 128, 2, 111.11, behind=21, mode=12, clock=21, tail=25),
    _with_header("PandarXT16", (6, 1), 16, 8, -50.0, **XT),
    _with_header("PandarXT32", (6, 1), 32, 8, -50.0, **XT),
    _with_header("PandarXT32M", (6, 1), 32, 6, -50.0, **XT),
)
# Number of blocks for one direction, by return mode: first, second, strongest or last; two of these; three.
RETURNS = {0x33: 1, 0x34: 1, 0x37: 1, 0x38: 1, 0x39: 2, 0x3A: 2, 0x3B: 2, 0x3C: 2, 0x3D: 3, 0x3E: 2}


def decode(packets: ScanPackets, angles: Path | None = None) -> Cloud:
    """Decode a scan, as Hesai's driver does: y points to azimuth 0.

    ``ring`` is the channel number from 0. ``time`` is in seconds after the stamp of the scan, by the sensor's
    clock. All channels of a block get the same time, because they fire within 0.15 ms. If a beam has several
    returns, those at different distances become points. Beams without a return, also those of lost packets,
    count as dropped.

    Args:
        packets: packets of the scan. Cut packets, and packets of another model or return mode than most,
            count as lost.
        angles: CSV file with elevation and azimuth of each channel in degrees. None: nominal angles of the
            model, which may be off by half a degree.

    Raises:
        ValueError: the model or the return mode is not known.
        UserError: the angles cannot be read, or are those of another model.
    """
    model, usable = _model_of(packets)
    data = np.ascontiguousarray(packets.data[usable])
    modes = data[:, model.end + model.mode]
    mode = int(np.bincount(modes).argmax())
    returns = RETURNS.get(mode, 0)
    if not returns:
        raise ValueError(f"a {model.name} with the return mode 0x{mode:02x} is not known here")
    usable, data = usable[modes == mode], data[modes == mode]
    shape, steps = (len(data), model.blocks), (data.strides[0], model.block.itemsize)
    blocks = np.ndarray(shape, model.block, data, model.first, steps)
    metres = 0.004 if model.scale is None else int(data[0, model.scale]) * 1e-3
    elevation, offset = _read_angles(angles, model) if angles else _nominal_angles()[model.name]

    distance = np.ascontiguousarray(blocks["measured"]["distance"])  # (N, blocks, channels)
    grouped = distance[:, : model.blocks // returns * returns].reshape(len(data), -1, returns, model.channels)
    for first in range(returns - 1):
        same = (grouped[:, :, first, None] == grouped[:, :, first + 1 :]).any(axis=2)
        grouped[:, :, first][same] = 0
    met = np.asarray(grouped.any(axis=2))
    packet, group, rank, channel = np.nonzero(grouped)
    block = group * returns + rank

    azimuth = np.deg2rad(blocks["azimuth"] * (360 / AZIMUTHS))  # (N, blocks)
    sine, cosine = (np.asarray(f(azimuth), np.float32)[packet, block] for f in (np.sin, np.cos))
    turn, tilt = (np.deg2rad(a) for a in (offset, elevation))
    metres_away = grouped[packet, group, rank, channel] * np.float32(metres)
    flat = metres_away * np.cos(tilt)[channel]
    points = np.empty(len(metres_away), POINT)
    points["x"] = flat * (sine * np.cos(turn)[channel] + cosine * np.sin(turn)[channel])
    points["y"] = flat * (cosine * np.cos(turn)[channel] - sine * np.sin(turn)[channel])
    points["z"] = metres_away * np.sin(tilt)[channel]
    points["intensity"] = blocks["measured"]["reflectivity"][packet, block, channel]
    points["ring"] = channel
    points["time"] = _times(packets, usable, model, returns)[packet, group]
    lost = packets.lost + len(packets.data) - len(data)
    announced = len(points) + int((~met).sum()) + lost * met[0].size
    return make_cloud(packets.stamp, packets.frame_id, points, announced)


def _model_of(packets: ScanPackets) -> tuple[Model, I64]:
    """Return the model of most packets, and the row numbers of its complete packets."""
    rows = np.zeros(0, np.int64)
    best = None
    for model in MODELS:
        wanted = [i for i, byte in enumerate(model.head) if byte is not None]
        head = np.array([byte for byte in model.head if byte is not None], np.uint8)
        fit = np.flatnonzero((packets.data[:, wanted] == head).all(axis=1))
        if len(fit) > len(rows):
            rows, best = fit, model
    if best is None:
        size, begin = int(packets.sizes[0]), bytes(packets.data[0, :12]).hex()
        raise ValueError(
            f"packets of {size} bytes that begin with {begin} are of no model that is decoded here "
            f"({', '.join(m.name for m in MODELS)}): play them through the driver and record its cloud"
        )
    whole = rows[packets.sizes[rows] >= best.size]
    if not len(whole):
        size = int(packets.sizes[rows].max())
        raise ValueError(f"a packet of {size} bytes is too short for a {best.name}'s {best.size}")
    return best, whole


def _times(packets: ScanPackets, usable: I64, model: Model, returns: int) -> F32:
    """Return the (N, directions) seconds after the scan's stamp.

    The sensor's clock may be set wrongly. Only its differences are used, from the time at which the first
    packet was received.
    """
    at = model.end + model.clock
    clock = np.ascontiguousarray(packets.data[usable, at : at + 4]).view("<u4")[:, 0].astype(np.int64)
    steps = np.diff(clock, prepend=clock[0])
    steps[steps < 0] += 1_000_000  # the clock counts microseconds within a second
    since = (int(packets.received[usable[0]]) - packets.stamp) * 1e-9 + np.cumsum(steps) * 1e-6
    groups = model.blocks // returns
    number = np.arange(groups) if model.period > 0 else np.arange(groups) - (groups - 1)
    return np.asarray(since[:, None] + number * abs(model.period) * 1e-6, np.float32)


Angles = tuple[F32, F32]  # elevation and azimuth of each channel, degrees


@cache
def _nominal_angles() -> dict[str, Angles]:
    """Read the nominal angles of each model."""
    rows = list(csv.reader(NOMINAL.read_text().splitlines()))[1:]
    return {
        model.name: _sorted_angles([[float(v) for v in row[1:]] for row in rows if row[0] == model.name])
        for model in MODELS
    }


def _sorted_angles(rows: list[list[float]]) -> Angles:
    """Return elevation and azimuth of rows of channel, elevation and azimuth, sorted by channel."""
    _, elevation, azimuth = np.array(sorted(rows), np.float32).T
    return elevation, azimuth


def _read_angles(path: Path, model: Model) -> Angles:
    """Read the CSV of the sensor's web page: channel number, elevation, azimuth."""
    rows = list[list[float]]()
    for row in csv.reader(StringIO(read_calibration(path))):
        try:
            rows.append([float(value) for value in row[:3]])
        except ValueError:
            continue  # column names, comment or checksum
    rows = [row for row in rows if len(row) == 3]
    if [row[0] for row in sorted(rows)] != list(range(1, model.channels + 1)):
        raise UserError(
            f"source.lidar_calibration: {path}: has {len(rows)} rows of channel, elevation and azimuth, but "
            f"the packets are a {model.name}'s, which has {model.channels} channels, numbered from 1"
        )
    return _sorted_angles(rows)


def read_scan(data: Bytes, serialization: Serialization) -> Cloud:
    """Decode a serialised PandarScan, with the sensor's own angles if the configuration states their file."""
    packets = split(data, 1500, sized=True, ros1=serialization.ros1)
    return decode(packets, Path(serialization.calibration) if serialization.calibration else None)


DEFINITIONS = {
    "pandar_msgs/msg/PandarPacket": "builtin_interfaces/Time stamp\nuint8[1500] data\nuint32 size\n",
    "pandar_msgs/msg/PandarScan": "std_msgs/Header header\nPandarPacket[] packets\n",
}
DECODER = Decoder(
    types=("pandar_msgs/msg/PandarScan",), kind="PointCloud2", from_bytes=read_scan, definitions=DEFINITIONS
)
