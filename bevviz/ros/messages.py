"""What decoding ROS messages into arrays has in common.

``clouds``, ``images``, ``cameras``, ``transforms`` and ``detections`` read only attributes, never types, so
that what rosbags deserialises and what rclpy delivers are both welcome, whichever the ROS version. Each
function raises MessageError and nothing else, whatever is in the message, and none takes more memory than a
message of reasonable size asks for.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

from bevviz.errors import UserError, first_line
from bevviz.loggers import logger

_log = logger(__name__)

P = ParamSpec("P")
R = TypeVar("R")


class MessageError(UserError):
    """A message that cannot be used: its topic, what is wrong with it, and what would be accepted."""


def guarded(decode: Callable[P, R]) -> Callable[P, R]:
    """Whatever else ``decode`` raises, as a MessageError: a message may hold anything, even other fields."""

    @wraps(decode)
    def guarded(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return decode(*args, **kwargs)
        except MessageError:
            raise
        except Exception as error:
            topic = next((value for value in (*args, *kwargs.values()) if isinstance(value, str)), "message")
            _log.debug("%s cannot be used", topic, exc_info=True)
            what = f"{type(error).__name__}: {first_line(error)}"
            raise MessageError(f"{topic}: cannot be used ({what})") from None

    return guarded


def stamp_ns(stamp: Any) -> int:
    """Nanoseconds of a builtin_interfaces/Time."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def read_header(data: bytes | memoryview, order: str, topic: str) -> tuple[int, str]:
    """Stamp in nanoseconds and frame_id of a serialised message that begins with a Header.

    Args:
        data: from four bytes before the stamp: the encoding of CDR, or the seq of ROS 1.
        order: ``<`` or ``>``, of the bytes.
        topic: for the error message.

    Raises:
        MessageError: there is no header.
    """
    try:
        sec, nanosec, size = struct.unpack_from(f"{order}iII", data, 4)
        (name,) = struct.unpack_from(f"{size}s", data, 16)
        return sec * 1_000_000_000 + nanosec, frame_name(name.rstrip(b"\0").decode())
    except (struct.error, UnicodeDecodeError):
        raise MessageError(f"{topic}: a message of {len(data)} bytes has no header") from None


def frame_name(name: str) -> str:
    return name.removeprefix("/")  # ROS 1 knew both spellings


def either(msg: Any, *names: str) -> Any:
    """The first attribute that exists: message definitions differ between versions of ROS."""
    for name in names:
        if hasattr(msg, name):
            return getattr(msg, name)
    raise MessageError(f"message {type(msg).__name__} has no field {' or '.join(names)}")
