"""Boxes in Autoware's, radars' and private messages, with their definitions."""

from __future__ import annotations

from typing import Any

import numpy as np
from rosbags.typesys import get_types_from_msg

from bevviz.model.frame import LabelledBoxes3D
from tests.support import bags

AUTOWARE = {
    "ObjectClassification": "uint8 UNKNOWN = 0\nuint8 CAR = 1\nuint8 TRUCK = 2\nuint8 PEDESTRIAN = 7\n"
    "uint8 label\nfloat32 probability\n",
    "Shape": "uint8 BOUNDING_BOX=0\nuint8 CYLINDER=1\nuint8 POLYGON=2\nuint8 type\n"
    "geometry_msgs/Polygon footprint\ngeometry_msgs/Vector3 dimensions\n",
    "DetectedObjectKinematics": "uint8 UNAVAILABLE=0\nuint8 AVAILABLE=2\n"
    "geometry_msgs/PoseWithCovariance pose_with_covariance\nbool has_position_covariance\n"
    "uint8 orientation_availability\ngeometry_msgs/TwistWithCovariance twist_with_covariance\n"
    "bool has_twist\nbool has_twist_covariance\n",
    "TrackedObjectKinematics": "geometry_msgs/PoseWithCovariance pose_with_covariance\n"
    "geometry_msgs/TwistWithCovariance twist_with_covariance\n"
    "geometry_msgs/AccelWithCovariance acceleration_with_covariance\nuint8 orientation_availability\n"
    "bool is_stationary\n",
    "PredictedObjectKinematics": "geometry_msgs/PoseWithCovariance initial_pose_with_covariance\n",
    "DetectedObject": "float32 existence_probability\nObjectClassification[] classification\n"
    "DetectedObjectKinematics kinematics\nShape shape\n",
    "TrackedObject": "unique_identifier_msgs/UUID object_id\nfloat32 existence_probability\n"
    "ObjectClassification[] classification\nTrackedObjectKinematics kinematics\nShape shape\n",
    "PredictedObject": "unique_identifier_msgs/UUID object_id\nfloat32 existence_probability\n"
    "ObjectClassification[] classification\nPredictedObjectKinematics kinematics\nShape shape\n",
    **{
        f"{kind}Objects": f"std_msgs/Header header\n{kind}Object[] objects\n"
        for kind in ("Detected", "Tracked", "Predicted")
    },
}


RADAR = {
    "RadarTrack": "uint16 NO_CLASSIFICATION=0\nuint16 STATIC=1\nuint16 DYNAMIC=2\n"
    "unique_identifier_msgs/UUID uuid\ngeometry_msgs/Point position\ngeometry_msgs/Vector3 velocity\n"
    "geometry_msgs/Vector3 acceleration\ngeometry_msgs/Vector3 size\nuint16 classification\n"
    "float32[6] position_covariance\nfloat32[6] velocity_covariance\nfloat32[6] acceleration_covariance\n"
    "float32[6] size_covariance\n",
    "RadarTracks": "std_msgs/Header header\nradar_msgs/RadarTrack[] tracks\n",
}


PRIVATE = {
    "Thing": "uint8 CLASS_NAME_VAN=3\nuint8 SHAPE_BOX=3\ngeometry_msgs/Pose pose\nfloat32[3] dimensions\n"
    "uint8 class_name\nfloat32 confidence\nfloat32 heading\nuint32 number\n",
    "Things": "std_msgs/Header header\nThing[] things\n",
}


BOX = (10.0, 2.0, 0.5, 4.2, 1.8, 1.6, 0.7)  # centre, size, yaw


def made(package: str, definitions: dict[str, str]) -> bags.Messages:
    found = bags.Messages()
    types: dict[str, Any] = {}
    for name, text in definitions.items():
        types |= get_types_from_msg(text, f"{package}/msg/{name}")
    found.store.register(types)
    return found


def vector(m: bags.Messages, kind: str, values: Any) -> Any:
    return m.make(f"geometry_msgs/msg/{kind}", **dict(zip("xyz", map(float, values), strict=False)))


def pose(m: bags.Messages) -> Any:
    turn = {"x": 0.0, "y": 0.0, "z": float(np.sin(BOX[6] / 2)), "w": float(np.cos(BOX[6] / 2))}
    quaternion = m.make("geometry_msgs/msg/Quaternion", **turn)
    return m.make("geometry_msgs/msg/Pose", position=vector(m, "Point", BOX[:3]), orientation=quaternion)


def autoware(m: bags.Messages, package: str, kind: str, outline: Any = ()) -> Any:
    def one(name: str, **values: Any) -> Any:
        return m.make(f"{package}/msg/{name}", **values)

    where = m.make("geometry_msgs/msg/PoseWithCovariance", pose=pose(m), covariance=np.zeros(36))
    still = vector(m, "Vector3", (0, 0, 0))
    twist = m.make("geometry_msgs/msg/Twist", linear=still, angular=still)
    moving = m.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36))
    accel = m.make("geometry_msgs/msg/Accel", linear=still, angular=still)
    faster = m.make("geometry_msgs/msg/AccelWithCovariance", accel=accel, covariance=np.zeros(36))
    about: dict[str, Any] = {
        "Detected": {
            "pose_with_covariance": where,
            "has_position_covariance": False,
            "orientation_availability": 2,
            "twist_with_covariance": moving,
            "has_twist": False,
            "has_twist_covariance": False,
        },
        "Tracked": {
            "pose_with_covariance": where,
            "twist_with_covariance": moving,
            "acceleration_with_covariance": faster,
            "orientation_availability": 2,
            "is_stationary": True,
        },
        "Predicted": {"initial_pose_with_covariance": where},
    }[kind]
    footprint = m.make("geometry_msgs/msg/Polygon", points=[vector(m, "Point32", (*p, 0)) for p in outline])
    size = (0, 0, BOX[5]) if len(outline) else BOX[3:6]
    shape = one(
        "Shape", type=2 if len(outline) else 0, footprint=footprint, dimensions=vector(m, "Vector3", size)
    )
    ids = {} if kind == "Detected" else {"object_id": uuid(m)}
    item = one(
        f"{kind}Object",
        existence_probability=0.75,
        classification=[
            one("ObjectClassification", label=1, probability=0.3),
            one("ObjectClassification", label=7, probability=0.6),
        ],
        kinematics=one(f"{kind}ObjectKinematics", **about),
        shape=shape,
        **ids,
    )
    return one(f"{kind}Objects", header=m.header(bags.START, bags.LIDAR_FRAME), objects=[item])


def uuid(m: bags.Messages) -> Any:
    return m.make("unique_identifier_msgs/msg/UUID", uuid=np.arange(16, dtype=np.uint8))


def assert_is_box(found: LabelledBoxes3D, yaw: float = BOX[6]) -> None:
    np.testing.assert_allclose(found.boxes.center, [BOX[:3]], rtol=1e-6)
    np.testing.assert_allclose(found.boxes.size, [BOX[3:6]], rtol=1e-6)
    np.testing.assert_allclose(found.boxes.yaw, [yaw], rtol=1e-6)


def radar(m: bags.Messages) -> Any:
    none = np.zeros(6, np.float32)
    track = m.make(
        "radar_msgs/msg/RadarTrack",
        uuid=uuid(m),
        position=vector(m, "Point", BOX[:3]),
        velocity=vector(m, "Vector3", (1, 0, 0)),
        acceleration=vector(m, "Vector3", (0, 0, 0)),
        size=vector(m, "Vector3", BOX[3:6]),
        classification=2,
        **{f"{name}_covariance": none for name in ("position", "velocity", "acceleration", "size")},
    )
    header = m.header(bags.START, bags.LIDAR_FRAME)
    return m.make("radar_msgs/msg/RadarTracks", header=header, tracks=[track])


def private(m: bags.Messages) -> Any:
    thing = m.make(
        "my_msgs/msg/Thing",
        pose=pose(m),
        dimensions=np.array(BOX[3:6], np.float32),
        class_name=3,
        confidence=0.5,
        heading=-0.25,
        number=12,
    )
    return m.make("my_msgs/msg/Things", header=m.header(bags.START, bags.LIDAR_FRAME), things=[thing])
