"""Topics: their kind, by type, and the names of their sensors' entities."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from bevviz.errors import UserError
from bevviz.messages.decoders import declared_decoder, find_decoder
from bevviz.messages.foreign_boxes import holds_boxes

IMAGES = ("Image", "CompressedImage", "CompressedVideo")
VIDEO = "video of a kind that is not decoded here: republish it as images (image_transport) and record these"
NOT_LIDAR = "packets of an Ouster's IMU"  # Topic.aside of packets that belong to no scan

# Entities of recordings beside those of the sensors (docs/recordings.md). No sensor may have these names.
RESERVED = frozenset(
    {"fused", "fusion", "frustums", "bev", "ground_truth", "tracks"}  # in /world
    | {"missed", "false", "unnamed"}  # in /world, too
    | {"about", "log", "states", "objects", "count"}  # in /compare
    | {"pipeline", "marks"}  # in /explain/states
    | {"lidars"}  # merged cloud of several LiDARs
)


@dataclass(frozen=True, slots=True)
class Topic:
    """Topic of a bag or of a live graph.

    Attributes:
        name: topic name.
        type: message type, as sensor_msgs/msg/PointCloud2 or in the shorter spelling of ROS 1.
        count: number of messages; None: not known, as on a live graph.
        frame_id: frame of its first message; empty: not known.
        rate: messages per second, Hz; None: not known.
        aside: reason why it plays no role unless it is stated; empty: it may play one.
        boxes: whether ``source.boxes`` describes its messages.
        video: whether its messages are video packets, although their type is CompressedImage.
        scans: whether its messages are LiDAR packets that the source groups into scans.
    """

    name: str
    type: str
    count: int | None = None
    frame_id: str = ""
    rate: float | None = None
    aside: str = ""
    boxes: bool = False
    video: bool = False
    scans: bool = False

    @property
    def kind(self) -> str:
        """Type that the messages are handled as, without package: PointCloud2 for a LiDAR's packets."""
        decoder = find_decoder(self.type)
        if decoder is not None and (self.scans or decoder.metadata_topic is None):
            return decoder.kind
        if self.video:
            return "CompressedVideo"
        return "Detection3DArray" if self.boxes or holds_boxes(self.type) else self.type.rpartition("/")[2]

    @property
    def metadata_topic(self) -> str:
        """Topic with the metadata of the LiDAR whose packets these are; empty for other topics."""
        decoder = declared_decoder(self.type) if self.scans else None
        return decoder.metadata_topic(self.name) if decoder and decoder.metadata_topic else ""


_FOREIGN = (  # sensor, type, and what would help: points or pixels in forms that are not supported
    ("camera", re.compile(r"video|ffmpeg|theora|h26[45]", re.IGNORECASE), VIDEO),
    (
        "LiDAR",
        re.compile(
            r"VelodyneScan$|PandarScan$|RslidarScan|^(ouster|hesai|rslidar|nebula).*Packets?", re.IGNORECASE
        ),
        "packets of the sensor: play them through its driver and record its PointCloud2",
    ),
    (
        "LiDAR",
        re.compile(r"sensor_msgs/(msg/)?(Multi)?(Echo)?LaserScan$"),
        "one plane: pointcloud_to_laserscan's laserscan_to_pointcloud makes a PointCloud2 of it, record that",
    ),
    (
        "LiDAR",
        re.compile(r"sensor_msgs/(msg/)?PointCloud$"),
        "the older kind of cloud: point_cloud_converter makes a PointCloud2 of it, record that",
    ),
)


def unsupported_reason(topic: Topic, sensor: str = "") -> str:
    """Return what an unsupported topic holds and what would help; empty if that is not known.

    Args:
        topic: the topic.
        sensor: ``LiDAR`` or ``camera`` for topics of this sensor only; empty: any.
    """
    if topic.kind == "PointCloud2":
        return ""
    decoder = declared_decoder(topic.type)
    if decoder is not None and decoder.metadata_topic is not None and topic.aside:
        return topic.aside if not sensor or (sensor == "LiDAR" and topic.aside != NOT_LIDAR) else ""
    if decoder is not None and sensor in ("", "LiDAR") and (why := decoder.missing()):
        return why
    for name, types, reason in _FOREIGN:
        if sensor in ("", name) and types.search(topic.type):
            return reason
    return ""


def names_of(topics: Iterable[Topic]) -> tuple[str, ...]:
    """Return the names of topics, in their order."""
    return tuple(topic.name for topic in topics)


def set_note(notes: dict[str, str], topics: Iterable[Topic], text: str) -> None:
    """Set the same note for several topics."""
    notes.update({topic.name: text for topic in topics})


def of_kind(topics: Iterable[Topic], *kinds: str) -> list[Topic]:
    """Return the topics of these kinds."""
    return [topic for topic in topics if topic.kind in kinds]


def stated_topic(name: str, topics: Sequence[Topic], key: str, *kinds: str) -> Topic:
    """Return the topic that the configuration names under ``key``.

    Raises:
        UserError: there is no such topic, or it is of another kind.
    """
    fitting = of_kind(topics, *kinds)
    for topic in topics:
        if topic.name == name:
            if topic in fitting:
                return topic
            why = unsupported_reason(topic)
            helps = f"; it holds {why}" if why else ""
            raise UserError(f"{key}: {name} is a {topic.type}, but must be {' or '.join(kinds)}{helps}")
    near = difflib.get_close_matches(name, names_of(fitting), n=3, cutoff=0.4) or names_of(fitting)
    hint = f"the nearest are {', '.join(near)}" if near else f"there is no {' or '.join(kinds)} topic"
    raise UserError(f"{key}: there is no topic {name}; {hint}")


# --- names -------------------------------------------------------------------------------------

TRANSPORT = re.compile(r"/(compressed|compressedDepth|theora|ffmpeg|foxglove|zstd|h26[45]|video)$")
_IMAGE_WORDS = re.compile(
    r"(?:image|rgb|colou?r|raw|rect|gray|mono|rectified)(?:_(?:image|rgb|colou?r|raw|rect|gray|mono|compressed))*"
)
_WEAK = {"left", "right", "front", "rear", "back", "center", "camera", "cam", "sensor", "driver", "points"}


def entity_name(topic: str, frame_id: str = "") -> str:
    """Return the name of a sensor's entities: its frame, or a part of its topic if it has no frame.

    LiDARs are named by their frame. The frames of cameras have long names, so cameras are named by the part
    of the topic that names the device, with the side if there is one.

    >>> entity_name("/rslidar_points", "rslidar")
    'rslidar'
    >>> entity_name("/zed2/zed/rgb/image_rect_color")
    'zed'
    >>> entity_name("/stereo/left/image_raw")
    'stereo_left'
    """
    if frame_id:
        return _clean(frame_id)
    parts = device_parts(topic)
    weak = parts[-1] in _WEAK and len(parts) > 1 and parts[-2] != parts[-1]
    return _clean("_".join(parts[-2:] if weak else parts[-1:]))


def device_parts(topic: str) -> list[str]:
    """Return the parts of a topic that name a device."""
    parts = TRANSPORT.sub("", topic).strip("/").split("/")
    kept = [part.removesuffix("_node") for part in parts if not _IMAGE_WORDS.fullmatch(part)]
    return kept or ["camera"]


def _clean(name: str) -> str:
    """Return a part of an entity path that needs no escapes."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_") or "sensor"


def unique_names(named: Sequence[tuple[str, Topic]]) -> list[str]:
    """Return unique names: the short name, else the name of the whole topic, else with a number."""
    short = [name for name, _ in named]
    unique: list[str] = []
    for name, topic in named:
        if short.count(name) > 1 or name in RESERVED:
            name = _clean("_".join(device_parts(topic.name)))
        number, free = 2, name
        while free in unique or free in RESERVED:
            free, number = f"{name}_{number}", number + 1
        unique.append(free)
    return unique
