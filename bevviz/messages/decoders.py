"""Registry of decoders for message types that bevviz does not read as their definition has them.

The decoders of bevviz come first, then those that installed packages register under the entry point group
``bevviz.decoders``. Bags and live graphs decode their messages by ``guard.decode_message``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from bevviz.errors import UserError, first_line

GROUP = "bevviz.decoders"  # of the entry points
# Names, not imports: drivers import this package. Each names a Decoder or a sequence of them.
BUILT_IN = (
    "bevviz.drivers.livox:DECODER",
    "bevviz.drivers.hesai:DECODER",
    "bevviz.drivers.velodyne:DECODER",
    "bevviz.drivers.ouster:DECODER",
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
class Decoder:
    """Decoder of a driver's message types.

    Attributes:
        types: message types that the decoder takes, as ``package/msg/Name``.
        kind: ROS message that the types are handled as, without its package: ``PointCloud2``.
        from_bytes: decodes a serialised message.
        from_message: converts a message with the fields of its definition. Without ``from_bytes`` and
            ``from_message`` the message stays as it is.
        missing: returns the library that must be installed for the decoder; empty: none is missing.
        definitions: text of the message definitions that rosbags lacks, by type.
        metadata_topic: returns the topic with the metadata of the LiDAR, for a topic of its packets. Given
            where a message is a single packet, of which the source gathers scans. Such a topic has the kind
            only if ``Topic.scans`` is set.
    """

    types: tuple[str, ...]
    kind: str
    from_bytes: Callable[[Bytes, Serialization], Any] | None = None
    from_message: Callable[[Any], Any] | None = None
    missing: Callable[[], str] = _nothing
    definitions: Mapping[str, str] = field(default_factory=dict)
    metadata_topic: Callable[[str], str] | None = None


@cache
def decoders() -> Mapping[str, Decoder]:
    """Load all decoders. Return them by message type; the first one that is declared for a type wins.

    Raises:
        UserError: a decoder of an installed package cannot be loaded.
    """
    by_type: dict[str, Decoder] = {}
    points = [*(EntryPoint(name, name, GROUP) for name in BUILT_IN), *entry_points(group=GROUP)]
    for point in points:
        for decoder in _loaded(point):
            for msgtype in decoder.types:
                by_type.setdefault(msgtype, decoder)
    return by_type


def _loaded(point: EntryPoint) -> Iterable[Decoder]:
    """Load the decoders of an entry point."""
    try:
        target = point.load()
    except Exception as error:  # a package may raise anything when it is imported
        raise UserError(
            f"the decoder '{point.name}' ({point.value}) cannot be loaded: {type(error).__name__}: "
            f"{first_line(error)}; repair or uninstall its package"
        ) from error
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
