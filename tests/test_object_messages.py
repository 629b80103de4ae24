"""Boxes in Autoware's, radars', markers' and private messages, which rosbags serialises."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from bevviz.bags.source import BagSource
from bevviz.cli import main
from bevviz.config import load
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


def bag(tmp_path: Path, m: bags.Messages, kind: str, message: Any) -> Path:
    cloud = m.cloud(bags.START, np.random.default_rng(0).normal(0, 5, (200, 4)).astype(np.float32))
    items = [
        bags.Item(bags.CLOUD, "sensor_msgs/msg/PointCloud2", bags.START, cloud),
        bags.Item("/my/objects", kind, bags.START + 1000, message),
    ]
    return bags.write(tmp_path / "bag", items, m)


def boxes(path: Path, *settings: str) -> LabelledBoxes3D:
    with BagSource([path], load(settings=settings)) as source:
        (frame,) = source
        assert source.roles.notes["/my/objects"] == "the robot's own result"
    (found,) = frame.robot_boxes
    assert (found.topic, found.stamp, found.frame_id) == ("/my/objects", bags.START, bags.LIDAR_FRAME)
    return found


def assert_is_box(found: LabelledBoxes3D, yaw: float = BOX[6]) -> None:
    np.testing.assert_allclose(found.boxes.center, [BOX[:3]], rtol=1e-6)
    np.testing.assert_allclose(found.boxes.size, [BOX[3:6]], rtol=1e-6)
    np.testing.assert_allclose(found.boxes.yaw, [yaw], rtol=1e-6)


@pytest.mark.parametrize("package", ["autoware_perception_msgs", "autoware_auto_perception_msgs"])
@pytest.mark.parametrize("kind", ["Detected", "Tracked", "Predicted"])
def test_objects_of_autoware(tmp_path: Path, package: str, kind: str) -> None:
    m = made(package, AUTOWARE)
    found = boxes(bag(tmp_path, m, f"{package}/msg/{kind}Objects", autoware(m, package, kind)))
    assert_is_box(found)
    assert found.labels == ("pedestrian",)  # the likeliest, by the name of its constant
    assert found.scores.tolist() == [0.75]
    assert found.ids == (() if kind == "Detected" else (bytes(range(16)).hex(),))


def test_a_polygon_of_autoware_is_the_box_around_it(tmp_path: Path) -> None:
    package = "autoware_perception_msgs"
    m = made(package, AUTOWARE)
    outline = [(-1, -1), (3, -1), (3, 1), (0, 0.5)]  # in the object's axes
    found = boxes(
        bag(tmp_path, m, f"{package}/msg/DetectedObjects", autoware(m, package, "Detected", outline))
    )
    np.testing.assert_allclose(found.boxes.size, [[4, 2, BOX[5]]], rtol=1e-6)
    c, s = np.cos(BOX[6]), np.sin(BOX[6])
    np.testing.assert_allclose(found.boxes.center, [[10 + c, 2 + s, 0.5]], rtol=1e-6)


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


def test_tracks_of_a_radar(tmp_path: Path) -> None:
    m = made("radar_msgs", RADAR)
    found = boxes(bag(tmp_path, m, "radar_msgs/msg/RadarTracks", radar(m)))
    assert_is_box(found, yaw=0.0)
    assert found.labels == ("dynamic",)


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


MAPPED = "source.boxes={topic: /my/objects, center: pose.position, size: dimensions, label: class_name%s}"


def test_a_message_of_ones_own_by_its_fields(tmp_path: Path) -> None:
    m = made("my_msgs", PRIVATE)
    path = bag(tmp_path, m, "my_msgs/msg/Things", private(m))
    found = boxes(path, MAPPED % "")
    assert_is_box(found)
    assert found.labels == ("van",)  # of two constants with that value the field's own
    assert (found.scores.tolist(), found.ids) == ([1.0], ())
    found = boxes(path, MAPPED % ", yaw: heading, score: confidence, id: number, objects: things")
    assert_is_box(found, yaw=-0.25)
    assert (found.scores.tolist(), found.ids) == ([0.5], ("12",))


def test_it_is_the_truth_that_evaluate_asks_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    m = made("my_msgs", PRIVATE)
    path = str(bag(tmp_path, m, "my_msgs/msg/Things", private(m)))
    assert main(["evaluate", path, "--truth", "/my/objects", "--set", MAPPED % ""]) == 0
    assert "1 frame" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("topic: /my/object", "there is no topic /my/object; the nearest are /my/objects"),
        ("topic: /my/objects, centre: pose", "centre is not known, did you mean center? There are topic"),
        ("center: pose", "topic is missing"),
        ("topic: /my/objects, size: extent", "no field extent (of extent); there are pose, dimensions"),
        ("topic: /my/objects, objects: stuff", "no field stuff (of stuff); there are header, things"),
    ],
)
def test_what_is_wrong_with_a_mapping(
    tmp_path: Path, setting: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    m = made("my_msgs", PRIVATE)
    path = str(bag(tmp_path, m, "my_msgs/msg/Things", private(m)))
    main(["info", path, "--set", f"source.boxes={{{setting}}}"])
    said = capsys.readouterr()
    assert message.lower() in " ".join((said.out + said.err).split()).lower()


def test_markers_by_the_documented_rule(tmp_path: Path) -> None:
    m = bags.Messages()

    def marker(number: int, kind: int, action: int = 0, text: str = "", ns: str = "cars") -> Any:
        box = pose(m), BOX[3:6]
        return m.marker(bags.LIDAR_FRAME, *box, ns=ns, number=number, kind=kind, action=action, text=text)

    shown = [marker(4, 1), marker(4, 9, text="bus"), marker(5, 1), marker(6, 1, action=2), marker(7, 2)]
    shown += [marker(4, 1, ns="people"), marker(8, 1), marker(8, 9, text="van", ns="labels")]
    message = m.make("visualization_msgs/msg/MarkerArray", markers=shown)
    path = bag(tmp_path, m, "visualization_msgs/msg/MarkerArray", message)
    found = boxes(path, "source.boxes={topic: /my/objects}")
    assert found.labels == ("bus", "cars", "people", "van")  # people/4 is no bus, as cars/4 is
    assert found.ids == ("cars/4", "cars/5", "people/4", "cars/8")
    np.testing.assert_allclose(found.boxes.size, [BOX[3:6]] * 4, rtol=1e-6)
    np.testing.assert_allclose(found.boxes.yaw, [BOX[6]] * 4, rtol=1e-6)
    with BagSource([path], load()) as source:  # without being asked to be boxes they are only shown
        assert source.roles.notes["/my/objects"] == "shown: around perception"
