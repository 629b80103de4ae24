"""Decoders of Foxglove's messages (protobuf, JSON or ROS) into clouds, transforms, boxes and ROS messages.

A bag contains the schema of protobuf messages. Only field names are defined here
(https://docs.foxglove.dev/docs/visualization/message-schemas).
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevviz.messages.clouds import Field, make_cloud, point_layout
from bevviz.messages.decoders import Decoder, frame_name, nanoseconds
from bevviz.messages.encode import encode_camera, make_header, make_message
from bevviz.messages.foreign_boxes import BoxRow, box_columns, boxes_3d
from bevviz.messages.poses import matrix_of
from bevviz.messages.transforms import StampedTransform
from bevviz.model import geometry
from bevviz.model.frame import F64, Cloud, LabelledBoxes3D

ENCODINGS = ("protobuf", "json")
TYPE = re.compile(r"^foxglove(?:_msgs)?[./](?:msg/)?(\w+)$")
KINDS = {  # kind of ROS message by Foxglove's type
    "PointCloud": "PointCloud2",
    "CompressedImage": "CompressedImage",
    "CompressedVideo": "CompressedVideo",
    "RawImage": "Image",
    "CameraCalibration": "CameraInfo",
    "FrameTransform": "TFMessage",
    "FrameTransforms": "TFMessage",
    "SceneUpdate": "Detection3DArray",
}
# Datatype of a PointField by the number of Foxglove's type, and by its name in protobuf's JSON.
_POINT_FIELD: Mapping[Any, int] = {1: 2, 2: 1, 3: 4, 4: 3, 5: 6, 6: 5, 7: 7, 8: 8} | {
    kind: number
    for number, kind in enumerate(
        ("INT8", "UINT8", "INT16", "UINT16", "INT32", "UINT32", "FLOAT32", "FLOAT64"), 1
    )
}
_AXES = ("x", "y", "z")
# Keys of metadata; the first that exists is the class.
_LABELS = ("category", "label", "class", "class_name", "type", "name")


def foxglove_type(msgtype: str) -> str:
    """Return ``PointCloud`` for ``foxglove.PointCloud`` and ``foxglove_msgs/msg/PointCloud``; else ""."""
    match = TYPE.match(msgtype)
    return match.group(1) if match and match.group(1) in KINDS else ""


def parse(data: bytes | memoryview, msgtype: str, encoding: str, schema: str) -> Any:
    """Parse a serialised message into an object with its fields.

    Args:
        data: serialised message.
        msgtype: message type, such as ``foxglove.PointCloud``.
        encoding: protobuf or json.
        schema: FileDescriptorSet of protobuf, one character for each byte.

    Raises:
        ValueError: the data cannot be parsed.
    """
    if encoding == "json":
        return json.loads(bytes(data), object_hook=_Fields)
    message = _message_class(msgtype, schema)()
    message.ParseFromString(bytes(data))
    return message


@lru_cache(maxsize=64)
def _message_class(msgtype: str, schema: str) -> Callable[[], Any]:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    files = descriptor_pb2.FileDescriptorSet.FromString(schema.encode("latin-1"))
    pool = descriptor_pool.DescriptorPool()
    for file in _sorted_files(files.file):
        pool.Add(file)
    made: Callable[[], Any] = message_factory.GetMessageClass(pool.FindMessageTypeByName(msgtype))
    return made


def _sorted_files(files: Iterable[Any]) -> list[Any]:
    """Sort files so that each comes after the files that it needs."""
    waiting = {file.name: file for file in files}
    ordered: list[Any] = []
    while waiting:
        free = [f for f in waiting.values() if not any(name in waiting for name in f.dependency)]
        if not free:
            raise ValueError("the schema's files need each other")
        ordered += free
        for file in free:
            del waiting[file.name]
    return ordered


_HUMP = re.compile(r"(?<=[a-z])[A-Z]")  # protobuf's JSON has frameId


class _Fields(SimpleNamespace):
    """Object of JSON. A missing field is None."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        super().__init__(**{_HUMP.sub(lambda match: f"_{match[0].lower()}", k): v for k, v in values.items()})

    def __getattr__(self, name: str) -> Any:
        return None


def header(message: Any, msgtype: str) -> tuple[int, str]:
    """Return stamp (nanoseconds) and frame_id; those of the first part if the message has several."""
    kind = foxglove_type(msgtype)
    if kind in ("FrameTransforms", "SceneUpdate"):
        first = next(
            iter((message.transforms if kind == "FrameTransforms" else message.entities) or ()), None
        )
        return (0, "") if first is None else (_stamp(first), _frame(first))
    return _stamp(message), _frame(message)


def _frame(message: Any) -> str:
    return str(getattr(message, "frame_id", None) or getattr(message, "parent_frame_id", None) or "")


def _stamp(message: Any) -> int:
    time = getattr(message, "timestamp", None)
    if time is None:
        return 0
    if isinstance(time, str):  # protobuf's JSON has RFC 3339
        try:
            date = datetime.fromisoformat(time)
        except ValueError:
            raise ValueError(f"the field 'timestamp' is no time: {time!r:.40}") from None
        date = date if date.tzinfo else date.replace(tzinfo=UTC)
        return (date - datetime.fromtimestamp(0, UTC)) // timedelta(microseconds=1) * 1000
    seconds, rest = _first_field(time, "seconds", "sec"), _first_field(time, "nanos", "nsec", "nanosec")
    try:
        return nanoseconds(seconds or 0, rest or 0)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"the field 'timestamp' is no time: {seconds!r} s and {rest!r} ns") from None


def _first_field(message: Any, *names: str) -> Any:
    """Return the first of these fields that exists."""
    return next((v for n in names if (v := getattr(message, n, None)) is not None), None)


def _data(message: Any) -> bytes:
    data = message.data
    if data is None:
        return b""
    if isinstance(data, int | float):  # bytes() of a number would allocate that many zeros
        raise ValueError(f"the field 'data' is the number {data}")
    return base64.b64decode(data) if isinstance(data, str) else bytes(data)


def _header(message: Any) -> Any:
    return make_header(_stamp(message), _frame(message))


def _cloud(message: Any) -> Cloud:
    data, step = np.frombuffer(_data(message), np.uint8), _integer(message, "point_stride")
    fields = [
        Field(
            str(field.name),
            _integer(field, "offset"),
            _POINT_FIELD.get(field.type if isinstance(field.type, str) else _integer(field, "type"), 0),
        )
        for field in message.fields or ()
    ]
    layout = point_layout(fields, step)
    points = data[: len(data) // step * step].view(layout)
    pose = _matrix(message.pose) if _is_set(message, "pose") else np.eye(4)
    if not np.array_equal(pose, np.eye(4)):
        points = _transform_points(points, pose)
    cloud, cut = make_cloud(_stamp(message), _frame(message), points), len(data) % step
    doubt = f"a cloud of points of {step} bytes ends {cut} bytes into a point: points may be missing"
    return replace(cloud, doubt=doubt) if cut else cloud


def _transform_points(points: NDArray[np.void], pose: F64) -> NDArray[np.void]:
    """Return the points in the frame of the message."""
    names = points.dtype.names or ()
    if any(name not in names or points.dtype[name].kind != "f" for name in _AXES):
        raise ValueError("a cloud with a pose needs x, y and z as floats")
    moved = points.copy()
    xyz = np.stack([points[name] for name in _AXES], axis=1) @ pose[:3, :3].T + pose[:3, 3]
    for name, values in zip(_AXES, xyz.T, strict=True):
        moved[name] = values
    return moved


def _compressed(message: Any) -> Any:
    data = np.frombuffer(_data(message), np.uint8)
    return make_message(
        "sensor_msgs/msg/CompressedImage",
        header=_header(message),
        format=str(message.format or ""),
        data=data,
    )


def _raw(message: Any) -> Any:
    return make_message(
        "sensor_msgs/msg/Image",
        header=_header(message),
        height=_integer(message, "height"),
        width=_integer(message, "width"),
        encoding=str(message.encoding or ""),
        step=_integer(message, "step"),
        data=np.frombuffer(_data(message), np.uint8),
    )


def _calibration(message: Any) -> Any:
    d, k, p = (_matrix_of(message, name) for name in "DKP")
    if k.size != 9:
        raise ValueError("K has not the nine numbers of a matrix")
    size = _integer(message, "width"), _integer(message, "height")
    return encode_camera(_header(message), size, str(message.distortion_model or ""), d, k, p)


def _matrix_of(message: Any, name: str) -> F64:
    """Return the numbers of a field, which the ROS definition spells in lower case."""
    numbers = _first_field(message, name, name.lower())
    return np.array([] if numbers is None else numbers, np.float64)


def _transforms(message: Any) -> list[StampedTransform]:
    items = (
        message.transforms if hasattr(message, "transforms") and message.transforms is not None else [message]
    )
    edges = []
    for item in items:
        place = _pose_of(item.translation if _is_set(item, "translation") else None, item.rotation)
        child = frame_name(str(item.child_frame_id or ""))
        edges.append(StampedTransform(_stamp(item), frame_name(_frame(item)), child, place))
    return edges


def _scene(message: Any) -> LabelledBoxes3D:
    """Convert cubes and cylinders to boxes in the frame of their entity. Boxes enclose the cylinders."""
    rows, stamps = list[BoxRow](), list[int]()
    for entity in message.entities or ():
        for solid in (*(entity.cubes or ()), *(entity.cylinders or ())):
            pose = _matrix(solid.pose) if _is_set(solid, "pose") else np.eye(4)
            numbers = (*pose[:3, 3], *_numbers(solid.size, "xyz"), *geometry.quaternion(pose))
            frame = frame_name(_frame(entity))
            rows.append(BoxRow(tuple(map(float, numbers)), _label(entity), 1.0, str(entity.id or ""), frame))
            stamps.append(_stamp(entity))
    columns = box_columns(rows, 10)
    stamp = next(iter(stamps), _stamp(message))
    return boxes_3d(columns, "", 0, stamp, next(iter(columns.frames), ""))


def _label(entity: Any) -> str:
    """Return the class in the metadata of an entity; else its first text; else an empty text."""
    stated = {str(pair.key).lower(): str(pair.value) for pair in entity.metadata or ()}
    label = next((stated[name] for name in _LABELS if name in stated), "")
    return label or next((str(text.text) for text in entity.texts or ()), "")


def _is_set(message: Any, name: str) -> bool:
    """Return whether a field that is a message was set."""
    if isinstance(message, _Fields) or not hasattr(message, "HasField"):
        return getattr(message, name, None) is not None
    return bool(message.HasField(name))


def _matrix(pose: Any) -> F64:
    return _pose_of(pose.position, pose.orientation)


def _pose_of(position: Any, orientation: Any) -> F64:
    x, y, z, w = _numbers(orientation, "xyzw")
    px, py, pz = _numbers(position, "xyz")
    return matrix_of((px, py, pz), (x, y, z, w))


def _numbers(message: Any, names: str) -> list[float]:
    """Return fields of a message as numbers; 0 for a field or a message that is missing."""
    return [_number(message, name, float) for name in names]


def _integer(message: Any, name: str) -> int:
    return int(_number(message, name, int))


def _number(message: Any, name: str, kind: Callable[[Any], float]) -> float:
    """Return a field as a number; 0 if the field or the message is missing."""
    value = (None if message is None else getattr(message, name)) or 0
    try:
        return kind(value)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"the field '{name}' is no number: {value!r:.60}") from None


_CONVERT: Mapping[str, Callable[[Any], Any]] = {
    "PointCloud": _cloud,
    "CompressedImage": _compressed,
    "CompressedVideo": _compressed,
    "RawImage": _raw,
    "CameraCalibration": _calibration,
    "FrameTransform": _transforms,
    "FrameTransforms": _transforms,
    "SceneUpdate": _scene,
}
_VIDEO = "foxglove_msgs/msg/CompressedVideo"
DEFINITIONS = {  # bags of older releases do not define it
    _VIDEO: "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
}
DECODERS = tuple(
    Decoder(
        types=(f"foxglove_msgs/msg/{name}", f"foxglove/msg/{name}"),
        kind=kind,
        from_message=_CONVERT[name],
        definitions=DEFINITIONS if _VIDEO.endswith(f"/{name}") else {},
    )
    for name, kind in KINDS.items()
)
