"""Definitions of vision_msgs 4 (ROS 2 Humble to Jazzy) and 2 (Foxy), which rosbags lacks.

Version 3 (Galactic) has other field names for the same bytes as version 4.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

_DETECTION = "std_msgs/Header header\nObjectHypothesisWithPose[] results\n{box} bbox\nstring id\n"
DEFINITIONS = {
    "Point2D": "float64 x\nfloat64 y\n",
    "Pose2D": "vision_msgs/Point2D position\nfloat64 theta\n",
    "BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
    "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "ObjectHypothesis": "string class_id\nfloat64 score\n",
    "ObjectHypothesisWithPose": "ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n",
    "Detection2D": _DETECTION.format(box="BoundingBox2D"),
    "Detection3D": _DETECTION.format(box="BoundingBox3D"),
    "Detection2DArray": "std_msgs/Header header\nDetection2D[] detections\n",
    "Detection3DArray": "std_msgs/Header header\nDetection3D[] detections\n",
}


_OLDER = (
    "std_msgs/Header header\nObjectHypothesisWithPose[] results\n{box} bbox\nsensor_msgs/{source}\n"
    "bool is_tracking\nstring tracking_id\n"
)
OLDER = DEFINITIONS | {
    "BoundingBox2D": "geometry_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
    "ObjectHypothesisWithPose": "string id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose\n",
    "Detection2D": _OLDER.format(box="BoundingBox2D", source="Image source_img"),
    "Detection3D": _OLDER.format(box="BoundingBox3D", source="PointCloud2 source_cloud"),
}


def register(typestore: Typestore, definitions: Mapping[str, str] = DEFINITIONS) -> None:
    """Add ``vision_msgs/msg/*`` to a store that has the geometry, sensor and std messages.

    Raises:
        rosbags.typesys.TypesysError: the store has other definitions of the same names.
    """
    types = {}
    for name, text in definitions.items():
        types.update(get_types_from_msg(text, f"vision_msgs/msg/{name}"))
    typestore.register(types)


@cache
def _older() -> Typestore:
    store = get_typestore(Stores.ROS2_JAZZY)
    register(store, OLDER)
    return store


def deserialize(store: Typestore, data: bytes | memoryview, msgtype: str) -> Any:
    """Deserialise a message of any type.

    A message of vision_msgs that does not fit the definition is read as Foxy's. The bytes of a message that
    is not empty fit only one of the two definitions.
    """
    try:
        return store.deserialize_cdr(data, msgtype)
    except Exception:  # rosbags' generated code raises any exception, depending on the bytes
        if msgtype.startswith("vision_msgs/msg/") and msgtype in _older().types:
            with suppress(Exception):
                return _older().deserialize_cdr(data, msgtype)
        raise
