"""Definitions of grid_map_msgs (ROS 2 Humble to Jazzy), which rosbags lacks."""

from __future__ import annotations

from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore

DEFINITIONS = {
    "GridMapInfo": "float64 resolution\nfloat64 length_x\nfloat64 length_y\ngeometry_msgs/Pose pose\n",
    "GridMap": "std_msgs/Header header\nGridMapInfo info\nstring[] layers\nstring[] basic_layers\n"
    "std_msgs/Float32MultiArray[] data\nuint16 outer_start_index\nuint16 inner_start_index\n",
}


def register(typestore: Typestore) -> None:
    """Add ``grid_map_msgs/msg/*`` to a store that has the geometry and std messages."""
    types = {}
    for name, text in DEFINITIONS.items():
        types.update(get_types_from_msg(text, f"grid_map_msgs/msg/{name}"))
    typestore.register(types)
