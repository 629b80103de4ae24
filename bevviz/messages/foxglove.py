"""Foxglove's messages, in protobuf, JSON or ROS, as the ROS messages that they stand for.

What a protobuf message is made of is in the file; here are the names of fields alone
(https://docs.foxglove.dev/docs/visualization/message-schemas).
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np

from bevviz.messages.decoders import Decoder
from bevviz.messages.decoding import nanoseconds
from bevviz.messages.encode import encode_box_3d, encode_camera, encode_pose_edges, make
from bevviz.model import geometry
from bevviz.model.frame import F64, U8

ENCODINGS = ("protobuf", "json")
TYPE = re.compile(r"^foxglove(?:_msgs)?[./](?:msg/)?(\w+)$")
KINDS = {  # what each is read as
    "PointCloud": "PointCloud2",
    "CompressedImage": "CompressedImage",
    "CompressedVideo": "CompressedVideo",
    "RawImage": "Image",
    "CameraCalibration": "CameraInfo",
    "FrameTransform": "TFMessage",
    "FrameTransforms": "TFMessage",
    "SceneUpdate": "Detection3DArray",
}
_POINT_FIELD = {1: 2, 2: 1, 3: 4, 4: 3, 5: 6, 6: 5, 7: 7, 8: 8}  # to PointField's: uint8 to float64
_AXES = ["x", "y", "z"]
_FLOATS = {7: "<f4", 8: "<f8"}
_LABELS = ("category", "label", "class", "class_name", "type", "name")  # of metadata, the first that is there
_MODELS = {"kannala_brandt": "equidistant"}


def short_of(msgtype: str) -> str:
    """``PointCloud`` of ``foxglove.PointCloud`` and of ``foxglove_msgs/msg/PointCloud``; else empty."""
    found = TYPE.match(msgtype)
    return found.group(1) if found and found.group(1) in KINDS else ""


def parse(data: bytes | memoryview, msgtype: str, encoding: str, schema: str) -> Any:
    """A serialised message as an object with its fields.

    Args:
        data: the message.
        msgtype: ``foxglove.PointCloud``.
        encoding: protobuf or json.
        schema: of protobuf, the FileDescriptorSet, a character for each byte.

    Raises:
        ValueError: it is none.
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
    for file in _in_order(files.file):
        pool.Add(file)
    made: Callable[[], Any] = message_factory.GetMessageClass(pool.FindMessageTypeByName(msgtype))
    return made


def _in_order(files: Iterable[Any]) -> list[Any]:
    """Each behind those that it needs."""
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


class _Fields(SimpleNamespace):
    """A JSON object; what is left out is None, as protobuf's defaults are."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        super().__init__(**values)

    def __getattr__(self, name: str) -> Any:
        return None


def as_ros(message: Any, msgtype: str) -> Any:
    """The ROS message that a message of Foxglove's stands for.

    Raises:
        ValueError: it lacks what that needs.
    """
    return _CONVERT[short_of(msgtype)](message)


def header(message: Any, msgtype: str) -> tuple[int, str]:
    """Stamp in nanoseconds and frame_id; of several, those of the first."""
    kind = short_of(msgtype)
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
    seconds, rest = _first(time, "seconds", "sec"), _first(time, "nanos", "nsec", "nanosec")
    try:
        return nanoseconds(seconds or 0, rest or 0)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"the field 'timestamp' is no time: {seconds!r} s and {rest!r} ns") from None


def _first(message: Any, *names: str) -> Any:
    """The first of these fields that there is."""
    return next((v for n in names if (v := getattr(message, n, None)) is not None), None)


def _data(message: Any) -> bytes:
    data = message.data
    if data is None:
        return b""
    if isinstance(data, int | float):  # of which bytes() would make as many zeros
        raise ValueError(f"the field 'data' is the number {data}")
    return base64.b64decode(data) if isinstance(data, str) else bytes(data)


def _header(message: Any) -> Any:
    stamp = _stamp(message)
    time = make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
    return make("std_msgs/msg/Header", stamp=time, frame_id=_frame(message))


def _cloud(message: Any) -> Any:
    data, step = _data(message), _whole(message, "point_stride")
    fields = [
        make(
            "sensor_msgs/msg/PointField",
            name=str(field.name),
            offset=_whole(field, "offset"),
            datatype=_POINT_FIELD.get(_whole(field, "type"), 0),
            count=1,
        )
        for field in message.fields or ()
    ]
    count = len(data) // step if step > 0 else 0
    pose = _matrix(message.pose) if _given(message, "pose") else np.eye(4)
    values = np.frombuffer(data, np.uint8)
    if not np.array_equal(pose, np.eye(4)):
        values = _moved(values, step, fields, pose)
    return make(
        "sensor_msgs/msg/PointCloud2",
        header=_header(message),
        height=1,
        width=count,
        fields=fields,
        is_bigendian=False,
        point_step=step,
        row_step=step * count,
        data=values,
        is_dense=False,
    )


def _moved(data: U8, step: int, fields: Iterable[Any], pose: F64) -> U8:
    """Points of so many bytes, their coordinates turned into the frame of the message."""
    at = {field.name: field for field in fields if field.name in _AXES and field.datatype in _FLOATS}
    if len(at) < len(_AXES):
        raise ValueError("a cloud with a pose needs x, y and z as floats")
    layout: np.dtype[np.void] = np.dtype(
        {
            "names": _AXES,
            "formats": [_FLOATS[at[name].datatype] for name in _AXES],
            "offsets": [at[name].offset for name in _AXES],
            "itemsize": step,
        }
    )
    turned = data[: len(data) // step * step].copy()
    points = turned.view(layout)
    xyz = np.stack([points[name] for name in _AXES], axis=1) @ pose[:3, :3].T + pose[:3, 3]
    for name, values in zip(_AXES, xyz.T, strict=True):
        points[name] = values
    return turned


def _compressed(message: Any) -> Any:
    data = np.frombuffer(_data(message), np.uint8)
    return make(
        "sensor_msgs/msg/CompressedImage",
        header=_header(message),
        format=str(message.format or ""),
        data=data,
    )


def _raw(message: Any) -> Any:
    return make(
        "sensor_msgs/msg/Image",
        header=_header(message),
        height=_whole(message, "height"),
        width=_whole(message, "width"),
        encoding=str(message.encoding or ""),
        is_bigendian=0,
        step=_whole(message, "step"),
        data=np.frombuffer(_data(message), np.uint8),
    )


def _calibration(message: Any) -> Any:
    d, k, p = (_matrix_of(message, name) for name in "DKP")
    if k.size != 9:
        raise ValueError("K has not the nine numbers of a matrix")
    model = str(message.distortion_model or "")
    size = _whole(message, "width"), _whole(message, "height")
    return encode_camera(_header(message), size, _MODELS.get(model, model), d, k, p)


def _matrix_of(message: Any, name: str) -> F64:
    """The numbers of a field that ROS 2 spells in lower case."""
    return np.array(_first(message, name, name.lower()) or [], np.float64)


def _transforms(message: Any) -> Any:
    items = (
        message.transforms if hasattr(message, "transforms") and message.transforms is not None else [message]
    )
    edges = []
    for item in items:
        place = _pose_of(item.translation if _given(item, "translation") else None, item.rotation)
        edges.append((_header(item), str(item.child_frame_id or ""), place))
    return encode_pose_edges(edges)


def _scene(message: Any) -> Any:
    """Boxes: cubes, and cylinders by what encloses them; each in the frame of its entity."""
    found = []
    for entity in message.entities or ():
        for solid in (*(entity.cubes or ()), *(entity.cylinders or ())):
            pose = _matrix(solid.pose) if _given(solid, "pose") else np.eye(4)
            size, results = _numbers(solid.size, "xyz"), [(_label(entity), 1.0)]
            found.append(encode_box_3d(_header(entity), pose, size, results, str(entity.id or "")))
    time = next((one.header.stamp for one in found), _header(message).stamp)
    header = make("std_msgs/msg/Header", stamp=time, frame_id="")
    return make("vision_msgs/msg/Detection3DArray", header=header, detections=found)


def _label(entity: Any) -> str:
    """What the metadata say, else the first text, else nothing."""
    stated = {str(pair.key).lower(): str(pair.value) for pair in entity.metadata or ()}
    told = next((stated[name] for name in _LABELS if name in stated), "")
    return told or next((str(text.text) for text in entity.texts or ()), "")


def _given(message: Any, name: str) -> bool:
    """Whether a field that is a message itself was set."""
    if isinstance(message, _Fields) or not hasattr(message, "HasField"):
        return getattr(message, name, None) is not None
    return bool(message.HasField(name))


def _matrix(pose: Any) -> F64:
    return _pose_of(pose.position, pose.orientation)


def _pose_of(position: Any, orientation: Any) -> F64:
    x, y, z, *_ = _numbers(position, "xyz")
    turn = _numbers(orientation, "xyzw")
    return geometry.transform(np.array([x, y, z]), np.array(turn if any(turn) else [0.0, 0.0, 0.0, 1.0]))


def _numbers(message: Any, names: str) -> list[float]:
    """The fields of a message; 0 where they, or all of it, are left out."""
    return [_number(message, name, float) for name in names]


def _whole(message: Any, name: str) -> int:
    return int(_number(message, name, int))


def _number(message: Any, name: str, kind: Callable[[Any], float]) -> float:
    """Return a field as a number; 0 if the field, or the message, is left out."""
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
