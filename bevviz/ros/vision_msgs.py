"""Definitions of vision_msgs 4 (ROS 2 Humble to Jazzy), which rosbags' type stores lack."""

from __future__ import annotations

from rosbags.typesys import get_types_from_msg
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


def register(typestore: Typestore) -> None:
    """Add ``vision_msgs/msg/*`` to a store that has the geometry and std messages.

    Raises:
        rosbags.typesys.TypesysError: the store has other definitions of the same names.
    """
    types = {}
    for name, text in DEFINITIONS.items():
        types.update(get_types_from_msg(text, f"vision_msgs/msg/{name}"))
    typestore.register(types)
