"""Guard around all decoders: it turns the exceptions of a decoder into a MessageError."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import MISSING, fields, is_dataclass
from itertools import islice
from numbers import Integral, Real
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

import numpy as np
from rosbags.interfaces import Nodetype

from bevviz.errors import UserError, first_line
from bevviz.messages.decoders import Bytes, MessageError, Serialization, find_decoder
from bevviz.messages.definitions import typestore
from bevviz.support.limits import MAX_OBJECTS
from bevviz.support.loggers import logger

NO_FIELD = "structure_needs_at_least_one_member"  # ROS's name for the byte of an empty message
# Types whose many values are one array of numbers. Those of other types become Python objects.
BULK = frozenset({"PointCloud2", "Image", "CompressedImage", "LaserScan", "OccupancyGrid", "GridMap"})
MANY = 1000  # values of a list that are compared with their definition to explain an error
_log = logger(__name__)

C = TypeVar("C")
P = ParamSpec("P")
R = TypeVar("R")


class TypedMessage(Protocol):
    """Topic and type of a message, for errors."""

    @property
    def topic(self) -> str:
        """Topic of the message."""

    @property
    def type(self) -> str:
        """Type of the message."""


def guard(
    message: TypedMessage,
    decoder: Callable[Concatenate[C, P], R],
    content: C,
    *args: P.args,
    **kwargs: P.kwargs,
) -> R:
    """Return ``decoder(content, ...)``. The content may be anything, even a message with other fields.

    Args:
        message: names the topic and the type in the error.
        decoder: decodes the content.
        content: the message, serialised or as an object with its fields.
        *args: further arguments of the decoder.
        **kwargs: further keyword arguments of the decoder.

    Raises:
        MessageError: the decoder raised an exception. The error names the topic, the type and, if it can be
            found, the field that is missing or wrong.
        UserError: the decoder raised it.
    """
    try:
        return decoder(content, *args, **kwargs)
    except UserError:
        raise
    except Exception as error:
        _log.debug("%s: a %s cannot be used", message.topic, message.type, exc_info=True)
        reason = _reason(error, content, message.type)
        raise MessageError(f"{message.topic}: not a {message.type}: {reason}") from None


def decode_message(
    message: TypedMessage, data: Bytes, deserialize: Callable[[Bytes], Any], serialization: Serialization
) -> Any:
    """Decode a message of a bag or of a live graph.

    Args:
        message: names the topic and the type in errors.
        data: the serialised message.
        deserialize: makes an object with the fields of the definition.
        serialization: passed on to the decoder.

    Returns:
        The result of the decoder; the deserialised message if its type has no decoder.

    Raises:
        MessageError: the data cannot be decoded.
        UserError: a file that the configuration names for the topic cannot be used.
    """
    decoder = find_decoder(serialization.type)
    if decoder is not None and decoder.from_bytes is not None:
        return guard(message, decoder.from_bytes, data, serialization)
    if len(data) > MAX_OBJECTS and decoder is None and message.type.rpartition("/")[2] not in BULK:
        raise MessageError(
            f"{message.topic}: a {message.type} of {len(data):,} bytes is not taken: {MAX_OBJECTS:,} at most"
        )
    content = guard(message, deserialize, data)
    if decoder is None or decoder.from_message is None:
        return content
    return guard(message, decoder.from_message, content)


def _reason(error: Exception, content: Any, msgtype: str) -> str:
    """Describe the fault in the content of a message, in a few words."""
    if isinstance(error, AttributeError) and (names := field_names(error.obj)) is not None:
        existing = ", ".join(names) or "none"
        part = "it" if error.obj is content else f"a {_type_of(error.obj) or 'message'} in it"
        return f"{part} has no field '{error.name}'; there are {existing}"
    if wrong := next(_wrong_fields(content, msgtype, ""), ""):
        return wrong
    kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
    return f"{kind}{first_line(error)}"


def field_names(content: Any) -> list[str] | None:
    """Return the field names of a message of rosbags, rclpy or protobuf; None for any other object."""
    if (descriptor := getattr(content, "DESCRIPTOR", None)) is not None:
        return [field.name for field in descriptor.fields]
    if is_dataclass(content):  # rosbags' classes have constants as fields with a default
        return [
            field.name for field in fields(content) if field.default is MISSING and field.name != NO_FIELD
        ]
    stated = getattr(content, "_fields_and_field_types", None)
    return None if stated is None else [*stated]


def _type_of(content: Any) -> str:
    """Return the type of a message, as ``sensor_msgs/msg/Image``."""
    descriptor = getattr(content, "DESCRIPTOR", None)
    return str(getattr(content, "__msgtype__", "") or getattr(descriptor, "full_name", ""))


# --- fields that differ from their definition ---------------------------------------------------


def _wrong_fields(content: Any, msgtype: str, path: str) -> Iterator[str]:
    """Compare a message with the known definition of its type. Yield a sentence for each difference.

    Additional fields are no difference. ROS 1 spells some fields in upper case.
    """
    definition = typestore().fielddefs.get(msgtype)
    if definition is None or field_names(content) is None:
        return
    for name, (node, about) in definition[1]:
        value = getattr(content, name, getattr(content, name.upper(), None))
        if value is None:
            yield f"the field '{path}{name}' is missing"
        else:
            yield from _wrong_values([value], (node, about), f"{path}{name}")


def _wrong_values(values: Iterable[Any], kind: tuple[Any, Any], path: str) -> Iterator[str]:
    """Compare the values of a field with its type. Yield a sentence for each difference."""
    node, about = kind
    for value in islice(values, MANY):
        if node == Nodetype.NAME:
            if field_names(value) is None:
                yield f"the field '{path}' is {describe_kind(value)}, not a {about}"
            yield from _wrong_fields(value, about, f"{path}.")
        elif node == Nodetype.BASE:
            if not _is_base(value, about[0]):
                yield f"the field '{path}' is {describe_kind(value)}, not a {about[0]}"
        elif not isinstance(value, list | tuple | np.ndarray | bytes):
            yield f"the field '{path}' is {describe_kind(value)}, not a list"
        elif isinstance(value, np.ndarray):
            if about[0][0] != Nodetype.BASE or about[0][1][0] == "string":
                yield f"the field '{path}' is a list of {value.dtype} numbers, not of {_name_of(about[0])}"
        elif not isinstance(value, bytes):
            yield from _wrong_values(value, about[0], path)


def _name_of(kind: tuple[Any, Any]) -> str:
    node, about = kind
    return str(about[0] if node == Nodetype.BASE else about)


def _is_base(value: Any, name: str) -> bool:
    """Return whether a value can be one of a basic type of ROS."""
    if name in ("string", "wstring"):
        return isinstance(value, str)
    if name.startswith("float"):
        return isinstance(value, Real)
    return isinstance(value, Integral | np.bool_)


def describe_kind(value: Any) -> str:
    """Return the name of a value's kind, for the middle of a sentence."""
    if field_names(value) is not None:
        return f"a {_type_of(value) or 'message'}"
    if isinstance(value, bool | np.bool_):
        return "a bool"
    if isinstance(value, Integral):
        return "a whole number"
    if isinstance(value, Real):
        return "a number with a fraction"
    names = {str: "a string", np.ndarray: "a list of numbers"}
    return names.get(type(value), f"a {type(value).__name__}")
