"""Definitions of the messages of LiDARs' drivers that are decoded here, which rosbags' type stores lack."""

from __future__ import annotations

from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore

_HEADER = "std_msgs/Header header\n"
_STAMP = "builtin_interfaces/Time stamp\n"
_LIVOX = {
    "CustomPoint": "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\n"
    "uint8 line\n",
    "CustomMsg": f"{_HEADER}uint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
    "CustomPoint[] points\n",
}
_OUSTER = {"PacketMsg": "uint8[] buf\n"}
DEFINITIONS = {
    "livox_ros_driver": _LIVOX,
    "livox_ros_driver2": _LIVOX,
    "ouster_sensor_msgs": _OUSTER,
    "ouster_msgs": _OUSTER,
    "ouster_ros": _OUSTER,
    "pandar_msgs": {
        "PandarPacket": f"{_STAMP}uint8[1500] data\nuint32 size\n",
        "PandarScan": f"{_HEADER}PandarPacket[] packets\n",
    },
    "velodyne_msgs": {
        "VelodynePacket": f"{_STAMP}uint8[1206] data\n",
        "VelodyneScan": f"{_HEADER}VelodynePacket[] packets\n",
    },
}


def register(typestore: Typestore) -> None:
    """Add the types to a store that has the std messages of ROS 2."""
    types = {}
    for package, definitions in DEFINITIONS.items():
        for name, text in definitions.items():
            types.update(get_types_from_msg(text, f"{package}/msg/{name}"))
    typestore.register(types)
