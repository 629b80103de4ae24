"""Decoder for packets of Velodyne's LiDARs, by the library velodyne-decoder (``bevviz[lidars]``)."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np

from bevviz.errors import UserError, first_line
from bevviz.extras.lidars.scan_messages import ScanPackets, split
from bevviz.messages.clouds import make_cloud
from bevviz.messages.decoders import Bytes, Decoder, Serialization
from bevviz.model.frame import Cloud

FIELDS = ("x", "y", "z", "intensity", "time", "ring")
MODEL = 1205  # offset of the byte that states the model
FAR = 1000.0  # metres; no model measures farther


def decode(packets: ScanPackets) -> Cloud:
    """Decode a scan, as velodyne_pointcloud does.

    The packets state the model. The nominal angles of the model are used. ``time`` is in seconds after the
    stamp of the scan, which is that of its first or of its last packet, depending on the driver.

    Raises:
        ValueError: velodyne-decoder does not know the model.
    """
    import velodyne_decoder as vd

    kinds = packets.data[:, MODEL]
    # The library refuses a scan if one of its packets is unknown.
    usable = np.flatnonzero(kinds == np.bincount(kinds).argmax())
    packet_vector = vd.PacketVector(
        [
            vd.VelodynePacket(received * 1e-9, data.tobytes())
            for received, data in zip(packets.received[usable].tolist(), packets.data[usable], strict=True)
        ]
    )
    # Each scan needs a new decoder: a decoder keeps the first model that it meets.
    decoder = vd.ScanDecoder(vd.Config(min_range=0.0, max_range=FAR))
    try:
        _, points = decoder.decode(packet_vector, as_pcl_structs=True)
    except RuntimeError as error:
        raise ValueError(f"velodyne-decoder does not take the packets ({first_line(error)})") from None
    # The library's times are relative to the last packet.
    points["time"] += np.float32((int(packets.received[usable[-1]]) - packets.stamp) * 1e-9)
    return make_cloud(packets.stamp, packets.frame_id, points[list(FIELDS)])


def read_scan(data: Bytes, serialization: Serialization) -> Cloud:
    """Decode a serialised VelodyneScan.

    Raises:
        UserError: the configuration states a file of angles.
    """
    if file := serialization.calibration:
        raise UserError(f"source.lidar_calibration: {file}: a Velodyne has none: its packets tell its model")
    return decode(split(data, 1206, sized=False, ros1=serialization.ros1))


def _missing() -> str:
    """Return the library to install; empty if it is installed."""
    if find_spec("velodyne_decoder") is not None:
        return ""
    return "packets of the sensor, which velodyne-decoder reads: pip install 'bevviz[lidars]'"


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
