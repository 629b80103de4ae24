"""The definition of point_cloud_interfaces (point_cloud_transport), which rosbags' type stores lack."""

from __future__ import annotations

from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore

COMPRESSED = "point_cloud_interfaces/msg/CompressedPointCloud2"
DEFINITION = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\n"
    "bool is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] compressed_data\nbool is_dense\n"
    "string format\n"
)


def register(typestore: Typestore) -> None:
    """Add the type to a store that has the sensor and std messages."""
    typestore.register(get_types_from_msg(DEFINITION, COMPRESSED))
