"""Common parts of the message decoders: stamps, headers, texts, and the error for unusable messages.

The decoders (``clouds``, ``images``, ``camera_info``, ``transforms``, ``detections``) read attributes and
never check types. They therefore take messages of rosbags and of rclpy, and of any ROS version. A decoder
raises MessageError for contradictory content, and any other exception for missing or wrong fields; ``guard``
turns that into a MessageError. No decoder takes more memory than a message of reasonable size needs.
"""

from __future__ import annotations

import struct
from typing import Any

from bevviz.errors import UserError

LATEST = 2**63 - 1  # nanoseconds; the largest stamp that 64 bits hold


class MessageError(UserError):
    """Error for a message that cannot be used. It names the topic, the fault and the supported values."""


def stamp_ns(stamp: Any) -> int:
    """Return the nanoseconds of a builtin_interfaces/Time."""
    return nanoseconds(stamp.sec, stamp.nanosec)


def nanoseconds(seconds: Any, fraction: Any) -> int:
    """Convert a stamp to nanoseconds.

    Raises:
        ValueError: the stamp does not fit into 64 bits.
    """
    total = int(seconds) * 1_000_000_000 + int(fraction)
    if abs(total) > LATEST:
        raise ValueError(f"a stamp of {seconds} s is too large")
    return total


def text_of(value: Any) -> str:
    """Return a field that must be a text. Raise TypeError if it is not."""
    if not isinstance(value, str):
        raise TypeError(f"a text is a {type(value).__name__}")
    return value


def read_header(data: bytes | memoryview, order: str, topic: str) -> tuple[int, str]:
    """Return stamp (nanoseconds) and frame_id of a serialised message that begins with a Header.

    Args:
        data: message from four bytes before the stamp on: the encapsulation header of CDR, or the seq of ROS
            1.
        order: byte order, ``<`` or ``>``.
        topic: topic of the message, for errors.

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
    """Return a frame name without the leading slash of ROS 1."""
    return name.removeprefix("/")  # ROS 1 used both spellings


def either(msg: Any, *names: str) -> Any:
    """Return the first attribute that exists, because names of fields differ between ROS versions.

    Raises:
        AttributeError: none of the attributes exists.
    """
    for name in names:
        if hasattr(msg, name):
            return getattr(msg, name)
    wanted = " or ".join(names)
    raise AttributeError(f"no field {wanted}", name=wanted, obj=msg)
