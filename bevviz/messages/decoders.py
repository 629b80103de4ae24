"""Registry of message decoders, and what all decoders share: stamps, headers, texts, and their error.

The decoders (``clouds``, ``images``, ``camera_info``, ``transforms``, ``detections``) read attributes and
never check types. They therefore take messages of rosbags and of rclpy, and of any ROS version. A decoder
raises MessageError for contradictory content, and any other exception for missing or wrong fields; ``guard``
turns that into a MessageError. No decoder takes more memory than a message of reasonable size needs.

The registry holds decoders for message types that bevviz does not read as their definition has them. The
decoders of bevviz come first, then those that installed packages register under the entry point group
``bevviz.decoders``. Bags and live graphs decode their messages by ``guard.decode_message``.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import EntryPoint
from typing import Any, Protocol

from bevviz.errors import UserError
from bevviz.model.frame import Cloud
from bevviz.support.extensions import load, registered

LATEST = 2**63 - 1  # nanoseconds; the largest stamp that 64 bits hold
SECOND = 1_000_000_000


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


# Names, not imports: drivers import this package. Each names a Decoder or a sequence of them.
BUILT_IN = (
    "bevviz.drivers.compressed_clouds:DECODER",
    "bevviz.messages.foxglove:DECODERS",
    "bevviz.drivers.video:DECODERS",
)
Bytes = bytes | memoryview


@dataclass(frozen=True, slots=True)
class Serialization:
    """Facts about a serialised message that its bytes do not hold.

    Attributes:
        type: message type.
        ros1: serialised by ROS 1; otherwise as CDR.
        calibration: path of the file that ``source.lidar_calibration`` states for the topic; empty: none.
        definitions: fields of the message types as rosbags parsed them from the bag; empty: not known.
    """

    type: str
    ros1: bool = False
    calibration: str = ""
    definitions: Mapping[str, Any] = field(default_factory=dict)


def _nothing() -> str:
    return ""


@dataclass(frozen=True, slots=True)
class Scan:
    """One scan made of packets, or of a file of a data set. It is decoded when a frame takes it.

    Attributes:
        received: time of receipt of its last packet, nanoseconds.
        decode: decodes its packets or its file.
    """

    received: int
    decode: Callable[[], Cloud]


def decode_scan(scan: Scan) -> Cloud:
    """Return the cloud of a scan."""
    return scan.decode()


class ScanDecoder(Protocol):
    """Decoder of the packets of one sensor. It holds the packets of the scan that is not complete yet."""

    @property
    def frame_id(self) -> str:
        """Frame of the clouds."""

    def add(self, received: int, data: Bytes, *, ros1: bool) -> Iterator[Scan]:
        """Add a serialised message. Yield each scan that ends with it.

        Raises:
            ValueError: the packet is not one of the sensor.
        """

    def rest(self) -> Iterator[Scan]:
        """Yield the incomplete scan."""


@dataclass(frozen=True, slots=True)
class PacketStream:
    """Description of the topics on which each message is a single packet, of which scans are made.

    Attributes:
        sensor: name of the sensor in sentences, with its article.
        open: makes the decoder of a sensor from its metadata and the file or topic that they come from.
            Raises UserError.
        metadata_topic: returns the topic of the metadata (std_msgs/String) for a topic of packets.
        smallest: bytes; messages that are not larger are packets of the sensor's IMU.
    """

    sensor: str
    open: Callable[[str, str], ScanDecoder]
    metadata_topic: Callable[[str], str]
    smallest: int

    @property
    def imu(self) -> str:
        """Note on a topic of packets that belong to no scan."""
        return f"packets of {self.sensor}'s IMU"

    @property
    def lacks_metadata(self) -> str:
        """Note on a recorded topic of packets without metadata."""
        return (
            f"packets of {self.sensor} without its metadata: record its metadata topic (std_msgs/String) "
            "with them, --set 'source.lidar_calibration={TOPIC: metadata.json}', or play them through its "
            "driver"
        )

    def awaits_metadata(self, topic: str) -> str:
        """Return the note on a live topic of packets whose metadata have not arrived yet."""
        return (
            f"packets of {self.sensor} whose metadata are waited for on {self.metadata_topic(topic)} "
            f"(std_msgs/String); --set 'source.lidar_calibration={{{topic}: metadata.json}}' gives them from "
            "a file"
        )


@dataclass(frozen=True, slots=True)
class Decoder:
    """Decoder of a driver's message types.

    Attributes:
        types: message types that the decoder takes, as ``package/msg/Name``. The decoder of one compression
            of CompressedPointCloud2 has ``package/msg/Name/format``.
        kind: ROS message that the types are handled as, without its package: ``PointCloud2``.
        from_bytes: decodes a serialised message, to a ``Cloud``, ``LabelledBoxes3D``, a list of
            ``StampedTransform``, or a message of ``kind``.
        from_message: does the same with a message that has the fields of its definition. Without
            ``from_bytes`` and ``from_message`` the message stays as it is.
        missing: returns the library that must be installed for the decoder; empty: none is missing.
        definitions: text of the message definitions that rosbags lacks, by type.
        packets: given where a message is a single packet, of which the source gathers scans. Such a topic
            has the kind only if ``Topic.scans`` is set.
    """

    types: tuple[str, ...]
    kind: str
    from_bytes: Callable[[Bytes, Serialization], Any] | None = None
    from_message: Callable[[Any], Any] | None = None
    missing: Callable[[], str] = _nothing
    definitions: Mapping[str, str] = field(default_factory=dict)
    packets: PacketStream | None = None


@cache
def decoders() -> Mapping[str, Decoder]:
    """Load all decoders. Return them by message type; the first one that is declared for a type wins.

    Raises:
        UserError: a decoder of an installed package cannot be loaded.
    """
    by_type: dict[str, Decoder] = {}
    built_in = (EntryPoint(name, name, "bevviz.decoders") for name in BUILT_IN)
    for point in (*built_in, *registered("decoders").values()):
        for decoder in _loaded(point):
            for msgtype in decoder.types:
                by_type.setdefault(msgtype, decoder)
    return by_type


def _loaded(point: EntryPoint) -> Iterable[Decoder]:
    """Load the decoders of an entry point."""
    target = load(point)
    loaded = [target] if isinstance(target, Decoder) else list(target) if isinstance(target, tuple) else []
    if not loaded or not all(isinstance(decoder, Decoder) for decoder in loaded):
        raise UserError(
            f"the decoder '{point.name}' ({point.value}) is a {type(target).__name__}, not a "
            f"{Decoder.__module__}.Decoder or a tuple of them; repair or uninstall its package"
        )
    return loaded


def declared_decoder(msgtype: str) -> Decoder | None:
    """Return the decoder of a message type, even if a library is missing for it."""
    package, _, name = msgtype.replace(".", "/").rpartition("/")
    return decoders().get(f"{package.removesuffix('/msg')}/msg/{name}")


def find_decoder(msgtype: str) -> Decoder | None:
    """Return the decoder of a message type; None if there is none or a library is missing for it."""
    decoder = declared_decoder(msgtype)
    return None if decoder is None or decoder.missing() else decoder


def reads_bytes(msgtype: str) -> bool:
    """Return whether messages of a type are decoded without their definition."""
    decoder = find_decoder(msgtype)
    return decoder is not None and decoder.from_bytes is not None
