"""Packets of Velodyne's LiDARs, decoded by velodyne-decoder (an extra of its own)."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np

from bevviz.drivers.packets import Packets, split
from bevviz.errors import UserError, first_line
from bevviz.messages.decoders import Bytes, Decoder, Serialization
from bevviz.messages.encode import encode_points

FIELDS = ("x", "y", "z", "intensity", "time", "ring")
MODEL = 1205  # byte that tells it
FAR = 1000.0  # metres: no model measures as far


def decode(packets: Packets) -> Any:
    """The sensor_msgs/PointCloud2 of a scan, as velodyne_pointcloud makes it.

    The model is what the packets say it is, with the angles that all of its kind have. ``time`` is in seconds
    after the stamp of the scan, which drivers give it as that of its first or of its last packet.

    Raises:
        ValueError: a model that the library does not know by its packets.
    """
    import velodyne_decoder as vd

    kinds = packets.data[:, MODEL]
    usable = np.flatnonzero(kinds == np.bincount(kinds).argmax())  # the library takes all or none
    found = vd.PacketVector(
        [
            vd.VelodynePacket(received * 1e-9, data.tobytes())
            for received, data in zip(packets.received[usable].tolist(), packets.data[usable], strict=True)
        ]
    )
    # One decoder for each scan: it holds on to the first model that it meets.
    decoder = vd.ScanDecoder(vd.Config(min_range=0.0, max_range=FAR))
    try:
        _, points = decoder.decode(found, as_pcl_structs=True)
    except RuntimeError as error:
        raise ValueError(f"velodyne-decoder does not take the packets ({first_line(error)})") from None
    # It counts from the last packet.
    points["time"] += np.float32((int(packets.received[usable[-1]]) - packets.stamp) * 1e-9)
    return encode_points(packets.stamp, packets.frame_id, points[list(FIELDS)])


def read_scan(data: Bytes, serialization: Serialization) -> Any:
    """Decode a VelodyneScan.

    Raises:
        UserError: a file of angles is stated for the sensor.
    """
    if file := serialization.calibration:
        raise UserError(f"source.lidar_calibration: {file}: a Velodyne has none: its packets tell its model")
    return decode(split(data, 1206, sized=False, ros1=serialization.ros1))


def _missing() -> str:
    """Return the library that is to be installed; empty: it is installed."""
    if find_spec("velodyne_decoder") is not None:
        return ""
    return "packets of the sensor, which velodyne-decoder reads: pip install 'bevviz[velodyne]'"


DEFINITIONS = {
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data\n",
    "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nVelodynePacket[] packets\n",
}
DECODER = Decoder(
    types=("velodyne_msgs/msg/VelodyneScan",),
    kind="PointCloud2",
    from_bytes=read_scan,
    missing=_missing,
    definitions=DEFINITIONS,
)
