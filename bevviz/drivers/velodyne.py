"""Packets of Velodyne's LiDARs, decoded by velodyne-decoder (an extra of its own)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from bevviz.errors import first_line
from bevviz.messages.encode import encode_points

if TYPE_CHECKING:
    from bevviz.drivers.packets import Packets

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
