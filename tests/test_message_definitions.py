"""Messages whose definition in the bag is not the one that bevviz knows: counted, told, and nothing more."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from itertools import repeat
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore

from bevviz.bags.source import BagSource
from bevviz.cli import main
from bevviz.config import Config, SourceConfig
from bevviz.live.live_message import LiveMessage
from bevviz.messages.decoders import MessageError, stamp_ns
from bevviz.messages.definitions import typestore
from bevviz.messages.guard import guard
from bevviz.messages.roles import find_roles
from bevviz.messages.surroundings import decode_shapes
from bevviz.messages.topics import Topic
from bevviz.model.frame import Cloud, Intrinsics
from bevviz.sync.feed import make_handlers
from bevviz.sync.synchronizer import Synchronizer
from tests.support import bags

STATED = SourceConfig(lidar_topics=["/other_points", "/packed_points", "/livox/lidar", "/velodyne_packets"])
STAMPED = bytes(
    typestore().serialize_cdr(bags.Messages().header(bags.START, "sensor"), "std_msgs/msg/Header")
)
LIDARS = f"source.lidar_topics=[{bags.CLOUD}, {', '.join(STATED.lidar_topics)}]"
NUMBERS = ("int", "uint", "float", "octet", "byte", "char", "bool")
OBJECTS = """std_msgs/Header header
TrackedObject[] objects
================================================================================
MSG: autoware_perception_msgs/TrackedObject
float32 existence_probability
ObjectClassification[] classification
TrackedObjectKinematics kinematics
Shape shape
================================================================================
MSG: autoware_perception_msgs/ObjectClassification
uint8 label
float32 probability
================================================================================
MSG: autoware_perception_msgs/TrackedObjectKinematics
geometry_msgs/PoseWithCovariance pose_with_covariance
================================================================================
MSG: autoware_perception_msgs/Shape
uint8 type
geometry_msgs/Vector3 dimensions
"""


@dataclass(frozen=True)
class Kind:
    """A message type, the topic that gives it its role, and a field that its decoder needs."""

    topic: str
    type: str
    field: str


KINDS = [
    Kind("/other_points", "sensor_msgs/msg/PointCloud2", "data"),
    Kind("/other/image_raw", "sensor_msgs/msg/Image", "encoding"),
    Kind("/packed/image_raw/compressed", "sensor_msgs/msg/CompressedImage", "data"),
    Kind("/other/camera_info", "sensor_msgs/msg/CameraInfo", "k"),
    Kind("/film/ffmpeg", "ffmpeg_image_transport_msgs/msg/FFMPEGPacket", "data"),
    Kind("/film/theora", "theora_image_transport/msg/Packet", "data"),
    Kind("/film/foxglove", "foxglove_msgs/msg/CompressedVideo", "data"),
    Kind("/packed_points", "point_cloud_interfaces/msg/CompressedPointCloud2", "compressed_data"),
    Kind("/livox/lidar", "livox_ros_driver2/msg/CustomMsg", "points"),
    Kind("/velodyne_packets", "velodyne_msgs/msg/VelodyneScan", "packets"),
    Kind("/tf", "tf2_msgs/msg/TFMessage", "transforms"),
    Kind("/odom", "nav_msgs/msg/Odometry", "pose"),
    Kind("/imu", "sensor_msgs/msg/Imu", "angular_velocity"),
    Kind("/detections", "vision_msgs/msg/Detection2DArray", "detections"),
    Kind("/boxes", "vision_msgs/msg/Detection3DArray", "detections"),
    Kind("/tracked", "autoware_perception_msgs/msg/TrackedObjects", "objects"),
    Kind("/bevviz/mark", "std_msgs/msg/String", "data"),
    Kind("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", "status"),
    Kind("/scan", "sensor_msgs/msg/LaserScan", "angle_min"),
    Kind("/gps", "sensor_msgs/msg/NavSatFix", "latitude"),
    Kind("/path", "nav_msgs/msg/Path", "poses"),
    Kind("/map", "nav_msgs/msg/OccupancyGrid", "info"),
    Kind("/heights", "grid_map_msgs/msg/GridMap", "layers"),
    Kind("/pose", "geometry_msgs/msg/PoseStamped", "pose"),
    Kind("/marker", "visualization_msgs/msg/Marker", "pose"),
    Kind("/markers", "visualization_msgs/msg/MarkerArray", "markers"),
]


@cache
def definitions() -> Mapping[str, Any]:
    """Return the fields of all kinds, as rosbags has them."""
    store = Typestore()
    store.fielddefs.update(typestore().fielddefs)
    store.types.update(typestore().types)
    store.register(get_types_from_msg(OBJECTS, "autoware_perception_msgs/msg/TrackedObjects"))
    return dict(store.fielddefs)


def parts_of(msgtype: str, found: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a type and of all that it is made of."""
    found[msgtype] = definitions()[msgtype]
    for _, (node, about) in found[msgtype][1]:
        while node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            (node, about), _ = about
        if node == Nodetype.NAME and about not in found:
            parts_of(about, found)
    return found


def samples() -> dict[str, Any]:
    """Return messages of a real sensor, by type."""
    made, pixels = bags.Messages(), np.zeros((8, 8, 3), np.uint8)
    camera = Intrinsics(8, 8, np.array([[10.0, 0, 4], [0, 10, 4], [0, 0, 1]]))
    found = [
        made.cloud(bags.START, np.ones((5, 4), np.float32)),
        made.image(bags.START, pixels),
        made.compressed(bags.START, bytes(cv2.imencode(".png", pixels)[1])),
        made.camera_info(bags.START, camera),
        made.transforms(bags.START, ("odom", "base_link", np.eye(4))),
    ]
    return {message.__msgtype__: message for message in found}


def value_of(store: Typestore, kind: Any, sample: Any = None, name: str = "") -> Any:
    """Return a value of a field: that of a sample, if it fits, else 1, a text, or a list of one element."""
    node, about = kind
    if node == Nodetype.NAME:
        values = {
            field: value_of(store, of, getattr(sample, field, None), field)
            for field, of in store.fielddefs[about][1]
        }
        return store.types[about](**values)
    if node == Nodetype.BASE:
        number = {"sec": bags.START // 10**9, "action": 0}.get(name, 1)
        made: Any = "text" if about[0] == "string" else number
        made = float(made) / 2 if about[0].startswith("float") else made
        return sample if isinstance(sample, type(made)) else made
    if isinstance(sample, np.ndarray):
        return sample
    if isinstance(sample, list) and sample:
        return [value_of(store, about[0], one, name) for one in sample]
    (element, of), length = about
    if element == Nodetype.BASE and of[0] != "string":
        return np.ones(length if node == Nodetype.ARRAY else 1, of[0].replace("octet", "uint8"))
    return [value_of(store, about[0], None, name)] * (length if node == Nodetype.ARRAY else 1)


def renamed(field: str, kind: Any) -> tuple[str, Any]:
    return f"{field}_of_old", kind


def retyped(field: str, kind: Any) -> tuple[str, Any]:
    """Change the type of a field: list or nested message to number, number to text, text to number."""
    node, about = kind
    number = node == Nodetype.BASE and about[0].startswith(NUMBERS)
    return field, (Nodetype.BASE, ("string" if number else "int32", 0))


CHANGES = {"renamed": renamed, "retyped": retyped, "emptied": None}


def changed(how: str, msgtype: str, field: str, part: str = "") -> Typestore:
    """Return the definitions of a type, with another field in it or in a part of it, or with none."""
    fields, change = parts_of(msgtype, {}), CHANGES[how]
    constants, former = fields[part or msgtype]
    stated = [] if change is None else [change(*f) if f[0] == field else f for f in former]
    store = Typestore()
    store.register(fields | {part or msgtype: ([] if change is None else constants, stated)})
    return store


def write(folder: Path, changes: Mapping[str, tuple[str, str, str]], count: int = 3) -> Path:
    """Write one message type as the bag defines it: (how, in which type, which field), by topic."""
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for kind in KINDS:
            if kind.topic not in changes:
                continue
            store = changed(*changes[kind.topic])
            name = kind.type
            connection = writer.add_connection(kind.topic, name, typestore=store)
            sample = samples().get(name)
            message = value_of(store, (Nodetype.NAME, name), sample)
            header: Any = getattr(message, "header", None)
            if isinstance(getattr(header, "frame_id", None), str):
                header.frame_id = kind.topic.strip("/")  # each is a sensor of its own
            data = store.serialize_cdr(message, name)
            for i in range(count):
                writer.write(connection, bags.START + i * bags.PERIOD + 1, data)
    return folder


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a readable drive without moving transforms."""
    items = [item for item in bags.small_items(scans=4) if item.topic != "/tf"]
    return bags.write(tmp_path_factory.mktemp("drive") / "drive", items)


LINES = {  # what is said of the field in a sentence on the message
    "renamed": "{field}'?( \\(of {field}\\))?(;| is missing)",
    "retyped": "the field '{field}' (is|cannot be used)",
    "emptied": (
        "is missing|there are none|has no header|SerdeError: Could not deserialize|the bag does not say what"
    ),
}
READ_AS_BYTES = ("/livox/lidar", "/velodyne_packets")  # whatever the bag says that they are made of
LEFT_OUT = {  # these are left out before their content is looked at: no sensor of its own, or no picture
    "renamed": (),
    "retyped": ("/film/theora", "/film/ffmpeg", "/film/foxglove"),
    "emptied": ("/film/theora", "/film/foxglove"),
}


@pytest.mark.long
@pytest.mark.parametrize("how", CHANGES)
def test_every_kind_is_counted_and_told_by_info_and_bag(
    drive: Path, tmp_path: Path, how: str, capfd: pytest.CaptureFixture[str]
) -> None:
    bad = write(tmp_path / "bad", {kind.topic: (how, kind.type, kind.field) for kind in KINDS})
    both = [str(drive), str(bad), "--set", LIDARS]
    assert main(["info", *both]) == 0
    out, err = capfd.readouterr()
    assert not [
        line for line in err.splitlines() if "re_sdk::" not in line
    ]  # the SDK may log for another test
    assert_told(" ".join(out.split()), how)
    assert main(["bag", *both, "--save", str(tmp_path / "out.rrd")]) == 0
    out, err = capfd.readouterr()
    assert_told(err, how)
    assert "Traceback" not in out + err and "4 frames in" in err


def assert_told(text: str, how: str) -> None:
    """Every kind has its line, which names the topic, the type and the field."""
    for kind in KINDS:
        if kind.topic in (*READ_AS_BYTES, *LEFT_OUT[how]):
            continue
        field = "[Kk]( or k)?" if kind.field == "k" else kind.field
        reason = LINES[how].format(field=field)
        wanted = f"{kind.topic}: (not a {kind.type}: .*|a message of 5 bytes )?({reason})"
        if kind.field == "encoding" and how == "retyped":
            wanted = f"{kind.topic}: image encoding '1' is not supported"
        assert re.search(f"(message\\(s\\) of {kind.topic} could not|image could not).*{wanted}", text), kind


# --- any field ---------------------------------------------------------------------------------


def fields_in(kind: Kind) -> Iterator[tuple[str, str, str]]:
    """Yield how which field of which type is changed: the own ones in both ways, those of parts in one."""
    for part, (_, fields) in parts_of(kind.type, {}).items():
        for field, _ in fields:
            yield "retyped", part, field
            if part == kind.type:
                yield "renamed", part, field


@pytest.mark.long
def test_no_field_makes_a_handler_raise_an_unexpected_error() -> None:
    roles = find_roles([Topic(k.topic, k.type, 1, k.topic, video="film" in k.topic) for k in KINDS], STATED)
    errors = 0
    for kind in KINDS:
        for how, part, field in fields_in(kind):
            store = changed(how, kind.type, field, part)
            content = value_of(store, (Nodetype.NAME, kind.type), samples().get(kind.type))
            sync = Synchronizer(roles, Config())
            handlers = make_handlers(sync, roles, partial(next, repeat(content)))
            message = LiveMessage(kind.topic, kind.type, bags.START, STAMPED)
            try:
                handlers[kind.topic](message)
            except MessageError as error:
                errors += 1
                assert str(error).startswith(f"{kind.topic}: ")
            sync.add_cloud(Cloud(bags.START, "lidar", np.ones((5, 3), np.float32), {}, roles.driver))
            assert len(list(sync.flush())) == 1
    assert errors > 200


def test_a_live_message_with_another_definition_is_refused() -> None:
    for kind in KINDS:
        store = changed("emptied", kind.type, "")
        data = store.serialize_cdr(value_of(store, (Nodetype.NAME, kind.type)), kind.type)
        if kind.type in typestore().types and kind.topic != "/tf":
            with pytest.raises(MessageError, match=f"^{kind.topic}: not a {kind.type}: .+"):
                LiveMessage(kind.topic, kind.type, bags.START, bytes(data)).decode()


def test_an_error_of_a_decoder_names_the_field_in_a_part() -> None:
    content = value_of(typestore(), (Nodetype.NAME, "nav_msgs/msg/Path"))
    content.poses[0].pose.position.x = "text"
    message = LiveMessage("/path", "nav_msgs/msg/Path", 0, b"")
    with pytest.raises(MessageError) as caught:
        guard(message, decode_shapes, content, "Path", "/path")
    assert str(caught.value) == (
        "/path: not a nav_msgs/msg/Path: the field 'poses.pose.position.x' is a string, not a float64"
    )


def test_a_stamp_beyond_64_bits_is_refused() -> None:
    with pytest.raises(ValueError, match="too large"):
        stamp_ns(SimpleNamespace(sec=2**62, nanosec=0))


# --- Foxglove ----------------------------------------------------------------------------------

CLOUD = {
    "timestamp": {"sec": bags.START // 10**9, "nsec": 0},
    "frame_id": "lidar",
    "point_stride": 12,
    "fields": [{"name": name, "offset": 4 * i, "type": 7} for i, name in enumerate("xyz")],
    "data": base64.b64encode(np.ones((5, 3), np.float32).tobytes()).decode(),
}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"point_stride": "wide"}, "the field 'point_stride' is no number: 'wide'"),
        ({"timestamp": {"sec": "now"}}, "the field 'timestamp' is no time"),
        ({"timestamp": {"sec": 2**62}}, "the field 'timestamp' is no time"),
        ({"data": 10**12}, "the field 'data' is the number 1000000000000"),
        ({"fields": 5}, "'int' object is not iterable"),
        ({"fields": None}, "no field x, y, z"),
    ],
)
def test_foxglove_json_with_another_field_is_one_line(tmp_path: Path, change: Any, said: str) -> None:
    foxglove = pytest.importorskip("foxglove", reason="needs Foxglove's SDK")
    context, path = foxglove.Context(), tmp_path / "drive.mcap"
    about = foxglove.Schema(name="foxglove.PointCloud", encoding="jsonschema", data=b"{}")
    with foxglove.open_mcap(path, context=context):
        channel = foxglove.Channel("/points", message_encoding="json", schema=about, context=context)
        for i, fields in enumerate([CLOUD, CLOUD | change]):
            channel.log(json.dumps(fields).encode(), log_time=bags.START + i * bags.PERIOD)
    with BagSource([path], Config()) as source:
        assert [len(frame.points) for frame in source] == [5]
        (line,) = [w for w in source.warnings if "could not be used" in w]
    assert line.startswith("1 message(s) of /points could not be used") and said in line


def test_foxglove_protobuf_with_a_renamed_field_is_one_line(tmp_path: Path) -> None:
    foxglove = pytest.importorskip("foxglove", reason="needs Foxglove's SDK")
    from foxglove import messages
    from google.protobuf import descriptor_pb2

    schema = messages.PointCloud.get_schema()
    files = descriptor_pb2.FileDescriptorSet.FromString(schema.data)
    (cloud,) = [kind for file in files.file for kind in file.message_type if kind.name == "PointCloud"]
    (stride,) = [field for field in cloud.field if field.name == "point_stride"]
    stride.name = "bytes_of_a_point"
    context, path = foxglove.Context(), tmp_path / "drive.mcap"
    about = foxglove.Schema(name=schema.name, encoding="protobuf", data=files.SerializeToString())
    with foxglove.open_mcap(path, context=context):
        channel = foxglove.Channel("/points", message_encoding="protobuf", schema=about, context=context)
        channel.log(messages.PointCloud(frame_id="lidar", point_stride=12).encode(), log_time=bags.START)
    with BagSource([path], Config()) as source:
        assert not list(source)
        (line,) = [w for w in source.warnings if "could not be used" in w]
    assert "not a foxglove.PointCloud: it has no field 'point_stride'; there are timestamp, frame_id" in line
