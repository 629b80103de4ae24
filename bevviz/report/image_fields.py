"""Find the fields of a message that may hold an image, from its message definition."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from typing import Any, TypeAlias

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from bevviz.messages.decoding import MessageError

Definitions: TypeAlias = Mapping[str, Any]  # message type -> (constants, fields), as rosbags returns them

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CLOUD, OLD_CLOUD = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/PointCloud"
PLAIN = {"nav_msgs/msg/OccupancyGrid"}  # Its bytes are occupancy values, no pixels.
# Types with encoded images that this module cannot decode.
PICTURES = re.compile(r"image|video|ffmpeg|theora|h26[45]|jpeg|png|disparity", re.IGNORECASE)
COLOUR_FIELDS = {"rgb", "rgba", "r", "red", "color"}  # fields of a cloud that shows an image
PIXELS = {"uint8", "int8", "byte", "octet", "char", "uint16", "int16"}
SMALL = 256  # Arrays of up to this many values hold no image, but for example a key or a name.


@cache
def known_types() -> frozenset[str]:
    """Return the message types of ROS, whose fields are all documented."""
    stores = (get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS1_NOETIC))
    return frozenset(name for store in stores for name in store.fielddefs)


def is_known(msgtype: str) -> bool:
    """Return whether the meaning of its fields is known. This includes every version of vision_msgs."""
    return msgtype in known_types() or msgtype.startswith(("vision_msgs/", "tf2_msgs/"))


def is_coloured(cloud: Any) -> bool:
    """Return whether a PointCloud2 or PointCloud has the colours of an image."""
    columns = cloud.fields if hasattr(cloud, "fields") else cloud.channels
    return not COLOUR_FIELDS.isdisjoint(column.name.lower() for column in columns)


class ImageFinder:
    """Search for images in the messages of one type.

    Args:
        msgtype: the normalised type.
        definitions: definitions of this type and of all types in it.

    Raises:
        MessageError: a type in it is not defined.
    """

    def __init__(self, msgtype: str, definitions: Definitions) -> None:
        self._msgtype, self._definitions = msgtype, definitions
        self._inside: dict[str, bool] = {}
        self.may_show = self._look(msgtype)

    def without_pictures(self, message: Any, lenient: bool = False) -> tuple[Any, Counter[str]]:
        """Return the message with every image and coloured cloud emptied, and the paths of these fields.

        Args:
            message: the decoded message.
            lenient: keep bytes of unknown meaning.

        Raises:
            MessageError: the message has bytes of unknown meaning.
        """
        emptied: Counter[str] = Counter()
        return self._strip(message, self._msgtype, "", emptied, lenient), emptied

    def _look(self, msgtype: str, within: tuple[str, ...] = ()) -> bool:
        """Return whether a type may hold images. Every type within it is looked up."""
        if msgtype in self._inside:
            return self._inside[msgtype]
        if msgtype not in self._definitions or msgtype in within:
            raise MessageError(f"nobody knows what a {msgtype} is made of")
        inside = msgtype in _EMPTIED
        for _, kind in self._definitions[msgtype][1]:
            inside |= self._is_opaque(msgtype, kind)
            if inner_type := _inner_type(kind):
                inside |= self._look(inner_type, (*within, msgtype))
        self._inside[msgtype] = inside
        return inside

    def _is_opaque(self, msgtype: str, kind: Any) -> bool:
        """Return whether a field is an array of bytes or numbers that may be pixels."""
        node, about = kind
        if node not in (Nodetype.ARRAY, Nodetype.SEQUENCE) or msgtype in PLAIN:
            return False
        (element, basic), length = about
        if element != Nodetype.BASE or 0 < length <= SMALL:
            return False
        return basic[0] in PIXELS or msgtype.endswith("MultiArray")

    def _strip(self, message: Any, msgtype: str, path: str, emptied: Counter[str], lenient: bool) -> Any:
        """Return a message with its images emptied. ``emptied`` counts the emptied fields by path."""
        if not self._inside[msgtype]:
            return message
        if msgtype in _EMPTIED:
            if _EMPTIED[msgtype][0](message):
                emptied[path] += 1
                return replace(message, **_EMPTIED[msgtype][1])
            return message
        changed = {}
        for name, kind in self._definitions[msgtype][1]:
            value, inner = getattr(message, name), f"{path}.{name}".lstrip(".")
            if self._is_opaque(msgtype, kind):
                if len(value) > SMALL and not lenient:
                    raise MessageError(f"nobody can tell what the {len(value)} values of '{inner}' show")
            elif (inner_type := _inner_type(kind)) and self._inside[inner_type]:
                if kind[0] == Nodetype.NAME:
                    changed[name] = self._strip(value, inner_type, inner, emptied, lenient)
                else:
                    changed[name] = [
                        self._strip(element, inner_type, inner, emptied, lenient) for element in value
                    ]
        return replace(message, **changed)


def _inner_type(kind: Any) -> str:
    """Return the message type of a field, or an empty text for a basic type."""
    node, about = kind
    if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        node, about = about[0]
    return str(about) if node == Nodetype.NAME else ""


_NOTHING = np.zeros(0, np.uint8)
_EMPTIED: Mapping[str, tuple[Callable[[Any], bool], Mapping[str, Any]]] = {
    IMAGE: (lambda image: len(image.data) > 0, {"height": 0, "width": 0, "step": 0, "data": _NOTHING}),
    COMPRESSED: (lambda image: len(image.data) > 0, {"data": _NOTHING}),
    CLOUD: (
        lambda cloud: len(cloud.data) > 0 and is_coloured(cloud),
        {"height": 0, "width": 0, "row_step": 0, "data": _NOTHING},
    ),
    OLD_CLOUD: (is_coloured, {"points": [], "channels": []}),
}
