"""What decoding ROS messages into arrays has in common.

``clouds``, ``images``, ``cameras``, ``transforms`` and ``detections`` read only attributes, never types, so
that what rosbags deserialises and what rclpy delivers are both welcome, whichever the ROS version. They raise
MessageError for content that contradicts itself, and any other exception for fields that are missing or
wrong: ``guard``, which calls them, makes a MessageError of it. None takes more memory than a message of
reasonable size asks for.
"""

from __future__ import annotations

import struct
from typing import Any

from bevviz.errors import UserError

LATEST = 2**63 - 1  # nanoseconds that a stamp can have


class MessageError(UserError):
    """A message that cannot be used: its topic, what is wrong with it, and what would be accepted."""


def stamp_ns(stamp: Any) -> int:
    """Nanoseconds of a builtin_interfaces/Time."""
    return nanoseconds(stamp.sec, stamp.nanosec)


def nanoseconds(seconds: Any, rest: Any) -> int:
    """Add up a stamp. Raise ValueError if it is later than any clock of 64 bits."""
    found = int(seconds) * 1_000_000_000 + int(rest)
    if abs(found) > LATEST:
        raise ValueError(f"a stamp of {seconds} s is too large")
    return found


def text_of(value: Any) -> str:
    """Return a field that must be a text. Raise TypeError if it is something else."""
    if not isinstance(value, str):
        raise TypeError(f"a text is a {type(value).__name__}")
    return value


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
    """Return the first attribute that exists: message definitions differ between versions of ROS.

    Raises:
        AttributeError: there is none of them.
    """
    for name in names:
        if hasattr(msg, name):
            return getattr(msg, name)
    wanted = " or ".join(names)
    raise AttributeError(f"no field {wanted}", name=wanted, obj=msg)
