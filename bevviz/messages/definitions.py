"""Definitions of message types.

They come from rosbags, from bevviz, from installed packages, or from a publisher (``type_sources``).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from bevviz.errors import UserError
from bevviz.messages.decoders import decoders

# vision_msgs 4 (ROS 2 Humble to Jazzy).
_DETECTION = "std_msgs/Header header\nObjectHypothesisWithPose[] results\n{box} bbox\nstring id\n"
_VISION = {
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
# Version 2 (Foxy). Version 3 (Galactic) has other field names for the same bytes as version 4.
_OLDER_VISION = _VISION | {
    "BoundingBox2D": "geometry_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
    "ObjectHypothesisWithPose": "string id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose\n",
    "Detection2D": _OLDER.format(box="BoundingBox2D", source="Image source_img"),
    "Detection3D": _OLDER.format(box="BoundingBox3D", source="PointCloud2 source_cloud"),
}
# grid_map_msgs (ROS 2 Humble to Jazzy).
_GRID_MAP = {
    "GridMapInfo": "float64 resolution\nfloat64 length_x\nfloat64 length_y\ngeometry_msgs/Pose pose\n",
    "GridMap": "std_msgs/Header header\nGridMapInfo info\nstring[] layers\nstring[] basic_layers\n"
    "std_msgs/Float32MultiArray[] data\nuint16 outer_start_index\nuint16 inner_start_index\n",
}
# A vision_msgs/Detection3DArray with labels of an image, see frame.ImageLabels.
_LABELLED = """std_msgs/Header header
vision_msgs/Detection3D[] detections
float32[] image_boxes
float32[] truncated
int32[] occluded
float32[] dont_care
string[] unusable
"""


def register(store: Typestore) -> None:
    """Add the message types that rosbags lacks to a store that has the geometry, sensor and std messages.

    Raises:
        rosbags.typesys.TypesysError: the store has other definitions of the same names.
    """
    _register(store, "vision_msgs", _VISION)
    _register(store, "grid_map_msgs", _GRID_MAP)
    _register(store, "bevviz_msgs", {"Detection3DArray": _LABELLED})
    types: dict[str, Any] = {}
    for decoder in decoders().values():
        for name, text in decoder.definitions.items():
            types.update(get_types_from_msg(text, name))
    store.register(types)


def _register(store: Typestore, package: str, definitions: Mapping[str, str]) -> None:
    types: dict[str, Any] = {}
    for name, text in definitions.items():
        types.update(get_types_from_msg(text, f"{package}/msg/{name}"))
    store.register(types)


@cache
def typestore() -> Typestore:
    """Return the type store of ROS 2 Jazzy with the definitions that bevviz adds."""
    store = get_typestore(Stores.ROS2_JAZZY)
    register(store)
    return store


@cache
def _older() -> Typestore:
    store = get_typestore(Stores.ROS2_JAZZY)
    _register(store, "vision_msgs", _OLDER_VISION)
    return store


def deserialize_cdr(store: Typestore, data: bytes | memoryview, msgtype: str) -> Any:
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


# --- types of installed packages and publishers ---------------------------------------------------


def definition(name: str) -> str | None:
    """Return the definition of ``package/msg/Name`` and the types in it (``ros2msg``); None: not known."""
    try:
        return str(store_of(name).generate_msgdef(name, ros_version=2)[0])
    except (UserError, TypesysError, KeyError):
        return None


@cache
def store_of(name: str) -> Typestore:
    """Return a type store with ``package/msg/Name`` and the types in it.

    Raises:
        UserError: neither rosbags, bevviz nor an installed package defines the type.
    """
    known = typestore()
    if name in known.types:
        return known
    if name in _learned:
        return _learned[name]
    package = name.partition("/")[0]
    try:
        types = _parse_installed(name, {})
        store = Typestore()
        store.fielddefs.update(known.fielddefs)
        store.types.update(known.types)
        store.register(types)
    except FileNotFoundError as error:
        place = Path(error.filename)
        raise UserError(
            f"{name} is not known without its package, and no {place.parent.parent.name}/msg/{place.name} is "
            "in AMENT_PREFIX_PATH: source the workspace that has it"
        ) from None
    except (OSError, UnicodeDecodeError, TypesysError, KeyError, ValueError) as error:
        raise UserError(f"the definition of {name} in {package} cannot be read: {error}") from None
    return store


_learned: dict[str, Typestore] = {}  # type stores made from the definitions that publishers sent, by type


def learn(name: str, sources: Mapping[str, tuple[str, str]], digest: str) -> None:
    """Add the definition of ``package/msg/Name`` that a publisher sent.

    Args:
        name: message type.
        sources: encoding (``msg`` or ``idl``) and text, for the type and for each type in it.
        digest: hash of the type, ``RIHS01_...``.

    Raises:
        UserError: the sources are incomplete, cannot be read, or define another type.
    """
    store = Typestore()
    try:
        for kind, (encoding, text) in sources.items():
            if encoding not in ("msg", "idl"):
                raise UserError(f"it has no source of {kind}")
            types = get_types_from_msg(text, kind) if encoding == "msg" else get_types_from_idl(text)
            store.register({**types})
        actual = store.hash_rihs01(name)
    except (TypesysError, KeyError, ValueError) as error:
        raise UserError(f"its sources of {name} cannot be read: {error}") from None
    if actual != digest:
        raise UserError(f"its sources are of another {name}")
    _learned[name] = store


def _parse_installed(name: str, collected: dict[str, Any]) -> dict[str, Any]:
    """Parse the .msg file of an installed package, and those of the types in it."""
    package, _, short = name.split("/")
    for prefix in (*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix):
        path = Path(prefix, "share", package, "msg", f"{short}.msg")
        if prefix and path.exists():
            break
    types = get_types_from_msg(path.read_text(encoding="utf-8"), name)
    collected.update(types)
    for _, fields in types.values():
        for _, field in fields:
            kind = _type_of_field(field)
            if kind is not None and kind not in collected and kind not in typestore().types:
                _parse_installed(kind, collected)
    return collected


def _type_of_field(field: Any) -> str | None:
    """Return the message type of a field, or of its elements; None for basic types."""
    kind, content = field
    if kind.name == "NAME":
        return str(content)
    return _type_of_field(content[0]) if kind.name in ("ARRAY", "SEQUENCE") else None
