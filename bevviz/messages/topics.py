"""Topics: what they are read as, by type, and what the entities of their sensors are called."""

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
NOT_LIDAR = "packets of an Ouster's IMU"  # Topic.aside of packets that are no part of a scan

# Entities that a recording has beside those of its sensors (docs/recordings.md). No sensor may be called so.
RESERVED = frozenset(
    {"fused", "fusion", "frustums", "bev", "ground_truth", "tracks"}  # of /world
    | {"missed", "false", "unnamed"}  # of /world, too
    | {"about", "log", "states", "objects", "count"}  # of /compare
    | {"pipeline", "marks"}  # of /explain/states
    | {"lidars"}  # the merged cloud of several LiDARs
)


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag or of a live graph, as far as it is known."""

    name: str
    type: str  # sensor_msgs/msg/PointCloud2, or the shorter spelling of ROS 1
    count: int | None = None  # messages; None: not known, as on a live graph
    frame_id: str = ""  # of its first message; "": not known
    rate: float | None = None  # Hz
    aside: str = ""  # why it plays no role unless it is stated
    boxes: bool = False  # source.boxes says where in its messages they are
    video: bool = False  # its messages are packets of video, whatever their type says
    scans: bool = False  # its messages are packets of a LiDAR that scans can be made of

    @property
    def kind(self) -> str:
        """What it is read as: the type without its package, but for types that stand for others."""
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


_FOREIGN = (  # what holds points or pixels in a form that nothing here reads, and what would help
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


def foreign(topic: Topic, sensor: str = "") -> str:
    """What a topic that nothing here reads holds and what would help; empty where it is not known."""
    if topic.kind == "PointCloud2":
        return ""
    decoder = declared_decoder(topic.type)
    if decoder is not None and decoder.metadata_topic is not None and topic.aside:
        return topic.aside if not sensor or (sensor == "LiDAR" and topic.aside != NOT_LIDAR) else ""
    if decoder is not None and sensor in ("", "LiDAR") and (why := decoder.missing()):
        return why
    return next((why for of, kind, why in _FOREIGN if sensor in ("", of) and kind.search(topic.type)), "")


def names_of(topics: Iterable[Topic]) -> tuple[str, ...]:
    """In their order."""
    return tuple(topic.name for topic in topics)


def note(notes: dict[str, str], topics: Iterable[Topic], text: str) -> None:
    """Say the same of all of them, in place of what was said before."""
    notes.update({topic.name: text for topic in topics})


def of_kind(topics: Iterable[Topic], *kinds: str) -> list[Topic]:
    """Those that are read as one of these."""
    return [topic for topic in topics if topic.kind in kinds]


def stated_topic(name: str, topics: Sequence[Topic], key: str, *kinds: str) -> Topic:
    """The topic that the configuration names under ``key``.

    Raises:
        UserError: there is none of that name, or it is of no such kind.
    """
    fitting = of_kind(topics, *kinds)
    for topic in topics:
        if topic.name == name:
            if topic in fitting:
                return topic
            why = foreign(topic)
            helps = f"; it holds {why}" if why else ""
            raise UserError(f"{key}: {name} is a {topic.type}, but must be {' or '.join(kinds)}{helps}")
    near = difflib.get_close_matches(name, names_of(fitting), n=3, cutoff=0.4) or names_of(fitting)
    there = f"the nearest are {', '.join(near)}" if near else f"there is no {' or '.join(kinds)} topic"
    raise UserError(f"{key}: there is no topic {name}; {there}")


# --- names -------------------------------------------------------------------------------------

TRANSPORT = re.compile(r"/(compressed|compressedDepth|theora|ffmpeg|foxglove|zstd|h26[45]|video)$")
_IMAGE_WORDS = re.compile(
    r"(?:image|rgb|colou?r|raw|rect|gray|mono|rectified)(?:_(?:image|rgb|colou?r|raw|rect|gray|mono|compressed))*"
)
_WEAK = {"left", "right", "front", "rear", "back", "center", "camera", "cam", "sensor", "driver", "points"}


def entity_name(topic: str, frame_id: str = "") -> str:
    """Name of a sensor's entities: its frame's, or without one its topic's.

    LiDARs are named by their frame. Cameras, whose frames have long names, by the part of the topic that
    tells the device, with the side where there is one.

    >>> entity_name("/rslidar_points", "rslidar")
    'rslidar'
    >>> entity_name("/zed2/zed/rgb/image_rect_color")
    'zed'
    >>> entity_name("/stereo/left/image_raw")
    'stereo_left'
    """
    if frame_id:
        return _clean(frame_id)
    parts = device(topic)
    weak = parts[-1] in _WEAK and len(parts) > 1 and parts[-2] != parts[-1]
    return _clean("_".join(parts[-2:] if weak else parts[-1:]))


def device(topic: str) -> list[str]:
    """The parts of a topic that name a device."""
    parts = TRANSPORT.sub("", topic).strip("/").split("/")
    kept = [part.removesuffix("_node") for part in parts if not _IMAGE_WORDS.fullmatch(part)]
    return kept or ["camera"]


def _clean(name: str) -> str:
    """A part of an entity path that needs no escapes."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_") or "sensor"


def unique_names(named: Sequence[tuple[str, Topic]]) -> list[str]:
    """The short names where they are unique, else those of the whole topic, else with a number."""
    short = [name for name, _ in named]
    unique: list[str] = []
    for name, topic in named:
        if short.count(name) > 1 or name in RESERVED:
            name = _clean("_".join(device(topic.name)))
        number, free = 2, name
        while free in unique or free in RESERVED:
            free, number = f"{name}_{number}", number + 1
        unique.append(free)
    return unique
