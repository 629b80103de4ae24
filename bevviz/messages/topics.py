"""Topics: their kind by type, the names of their entities, and the LiDARs and cameras among them."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from posixpath import commonprefix

from bevviz.config import SourceConfig
from bevviz.errors import UserError
from bevviz.messages.decoders import declared_decoder, find_decoder
from bevviz.messages.foreign_boxes import holds_boxes

CLOUDS = ("PointCloud2", "LaserScan")  # what may be a LiDAR's; scans of one plane where there is no cloud
IMAGES = ("Image", "CompressedImage", "CompressedVideo")
RESULT_TOPICS = "/results/"  # topics of result files begin with it
VIDEO = "video of a kind that is not decoded here: republish it as images (image_transport) and record these"

# Entities of recordings beside those of the sensors (docs/reference.md). No sensor may have these names.
RESERVED = frozenset(
    {"fused", "fusion", "frustums", "bev", "ground_truth", "tracks"}  # in /world
    | {"missed", "false", "unnamed"}  # in /world, too
    | {"about", "log", "states", "objects", "count"}  # in /compare
    | {"pipeline", "marks"}  # in /explain/states
    | {"lidars"}  # merged cloud of several LiDARs
    | {"overlay"}  # in /bev
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
        if decoder is not None and (self.scans or decoder.packets is None):
            return decoder.kind
        if self.video:
            return "CompressedVideo"
        return "Detection3DArray" if self.boxes or holds_boxes(self.type) else self.type.rpartition("/")[2]

    @property
    def metadata_topic(self) -> str:
        """Topic with the metadata of the LiDAR whose packets these are; empty for other topics."""
        decoder = declared_decoder(self.type) if self.scans else None
        return decoder.packets.metadata_topic(self.name) if decoder and decoder.packets else ""


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
        re.compile(r"sensor_msgs/(msg/)?MultiEchoLaserScan$"),
        "several echoes of one plane: laser_proc makes a LaserScan of it, record that",
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
    if decoder is not None and decoder.packets is not None and topic.aside:
        return topic.aside if not sensor or (sensor == "LiDAR" and topic.aside != decoder.packets.imu) else ""
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


@dataclass(frozen=True, slots=True)
class CameraRole:
    """Topics of a camera.

    Attributes:
        name: name of its entities.
        topic: topic of its images.
        info_topic: topic of its CameraInfo; empty: there is none.
        rectified: whether the images are rectified.
        kind: Image, CompressedImage or CompressedVideo.
    """

    name: str
    topic: str
    info_topic: str
    rectified: bool
    kind: str


# --- LiDARs ------------------------------------------------------------------------------------

_LIDAR = re.compile(r"lidar|laser|velodyne|ouster|os_|livox|hesai|robosense|pandar|points|scan")
_DERIVED_CLOUD = re.compile(
    r"ground|cluster|obstacle|filter|registered|depth|stereo|camera|zed|realsense|rgbd|map|voxel|fused|segment"
    r"|crop|downsample|object|debug|feature|plane|merged|concat|keypoint|matched|odom|slam"
    r"|radar|mmwave|sonar"
)
_FIXED = ("map", "odom", "world", "camera_init")  # frames in which no sensor moves


def find_lidars(topics: Sequence[Topic], config: SourceConfig, notes: dict[str, str]) -> list[Topic]:
    """Return the clouds of LiDARs, sorted by name. Add the reason for each cloud to ``notes``.

    Raises:
        UserError: source.lidar_topics names a topic that is no cloud.
    """
    clouds = of_kind(topics, "PointCloud2")
    if config.lidar_topics:
        chosen = [stated_topic(t, topics, "source.lidar_topics", *CLOUDS) for t in config.lidar_topics]
        set_note(notes, clouds, "not used: not in source.lidar_topics")
        set_note(notes, chosen, "LiDAR, by source.lidar_topics")
        return chosen
    clouds = [topic for topic in clouds if not topic.aside]
    tiers = {topic: _lidar_tier(topic, config.base_frame) for topic in clouds}
    best = min(tiers.values(), default=0)
    set_note(
        notes, clouds, "not used: looks like a result, a radar's or a depth camera's cloud, not a LiDAR's"
    )
    moved = [t for t in clouds if tiers[t] == 1 and _is_moved(t, config.base_frame)]
    set_note(notes, moved, "not used: in the robot's own frame, to which points of others were moved")
    set_note(notes, [t for t in clouds if t.count == 0], "not used: without messages")
    candidates = sorted((t for t in clouds if tiers[t] == best), key=lambda t: (len(t.name), t.name))
    if all(t.count == 0 for t in clouds):
        planes = [t for t in of_kind(topics, "LaserScan") if t.count != 0]
        planes.sort(key=lambda t: (bool(_DERIVED_CLOUD.search(t.name.lower())), len(t.name), t.name))
        candidates = planes or candidates
    if best in (2, 3):
        candidates = candidates[:1]  # results are not merged like sensors
    chosen = _one_per_sensor(candidates, lambda t: t.frame_id or t.name, notes, "LiDAR, by type and name")
    return sorted(chosen, key=lambda t: t.name)


def _lidar_tier(topic: Topic, base_frame: str) -> int:
    """Return 0: named like a LiDAR, 1: other cloud, 2: derived, 3: in a fixed frame, 4: without messages."""
    name, frame = topic.name.lower(), topic.frame_id.lower()
    if topic.count == 0:
        return 4
    if frame in _FIXED:
        return 3
    if _DERIVED_CLOUD.search(name) or "optical" in frame:
        return 2
    named = _LIDAR.search(name) or _LIDAR.search(frame)
    return 0 if named and not _is_moved(topic, base_frame) else 1


def _is_moved(topic: Topic, base_frame: str) -> bool:
    """Return whether points are in the robot's frame: with a LiDAR's raw points they would appear twice."""
    return topic.frame_id.lower() in (base_frame, "base_link", "base_footprint")


def _one_per_sensor(
    candidates: Iterable[Topic], sensor: Callable[[Topic], str], notes: dict[str, str], why: str
) -> list[Topic]:
    """Choose the first candidate of each sensor. Add the reason for each candidate to ``notes``."""
    chosen: dict[str, Topic] = {}
    for topic in candidates:
        first = chosen.setdefault(sensor(topic), topic)
        notes[topic.name] = (
            why if first is topic else f"not used: the sensor of {first.name}, by its frame or name"
        )
    return list(chosen.values())


# --- cameras -----------------------------------------------------------------------------------

_DERIVED_IMAGE = re.compile(
    r"depth(?!ai)|disparity|confidence|annotat|debug|dbg|bev|mask|overlay|detect|visuali[sz]|segment|semantic"
    r"|label|heat_?map|costmap|stereo(_raw)?/image|track|result|infra|normal|cloud|side_by_side"
    r"|radar|sonar|(range|signal|reflec|nearir)_image"  # images of Ouster's scans
)
_COLOURLESS = re.compile(r"gray|mono|(?<![a-z])ir(?![a-z])")
_RECTIFIED = re.compile(r"(?<![a-z])rect")


def is_derived(topic: Topic) -> bool:
    """Return whether the name of a cloud or an image says that it is a result."""
    pattern = _DERIVED_CLOUD if topic.kind in CLOUDS else _DERIVED_IMAGE
    return topic.kind in (*CLOUDS, *IMAGES) and pattern.search(topic.name.lower()) is not None


def find_images(topics: Sequence[Topic], config: SourceConfig, notes: dict[str, str]) -> list[Topic]:
    """Return one topic of images for each camera, sorted by name. Add the reason for each topic to ``notes``.

    Raises:
        UserError: source.camera_topics or source.camera_info_topics name a topic that is no image.
    """
    images = of_kind(topics, *IMAGES)
    for name in config.camera_info_topics:
        stated_topic(name, topics, "source.camera_info_topics", *IMAGES)
    if config.camera_topics:
        chosen = [stated_topic(t, topics, "source.camera_topics", *IMAGES) for t in config.camera_topics]
        set_note(notes, images, "not used: not in source.camera_topics")
        set_note(notes, chosen, "camera, by source.camera_topics")
        return chosen
    usable = []
    for topic in images:
        if topic.count == 0:
            notes[topic.name] = "not used: without messages"
        elif topic.aside:
            notes[topic.name] = f"not used: {topic.aside}"
        elif match := _DERIVED_IMAGE.search(topic.name.lower()):
            notes[topic.name] = f"not used: '{match.group()}' in the name says it is no camera's colour image"
        else:
            usable.append(topic)

    infos = [t for t in of_kind(topics, "CameraInfo") if t.count != 0]

    def distance(topic: Topic) -> tuple[bool, bool, bool, int, int, str]:
        name = topic.name.lower()
        return (
            not _RECTIFIED.search(name),
            bool(_COLOURLESS.search(name)),
            not _near_infos(topic, infos),
            IMAGES.index(topic.kind),  # the robot's detector mostly uses the first kind
            len(name),
            name,
        )

    usable.sort(key=distance)
    chosen = _one_per_sensor(usable, lambda t: t.frame_id or _stem(t.name), notes, "camera, by type and name")
    return sorted(chosen, key=lambda t: t.name)


def _stem(topic: str) -> str:
    """Return the common part of the topics of a camera's images, without raw, rect, gray, color and mono."""
    return "/".join(re.sub(r"_(raw|rect|gray|color|mono)$", "", part) for part in device_parts(topic))


def camera_role(
    topic: Topic, name: str, topics: Sequence[Topic], config: SourceConfig, notes: dict[str, str]
) -> CameraRole:
    """Return the topics of the camera whose images are on ``topic``.

    Raises:
        UserError: source.camera_info_topics names a topic that is no CameraInfo.
    """
    stated = config.camera_info_topics.get(topic.name)
    if stated is None:
        info = _info_topic(topic, [t for t in of_kind(topics, "CameraInfo") if t.count != 0])
    else:
        info = stated_topic(stated, topics, "source.camera_info_topics", "CameraInfo").name
    rectified = bool(_RECTIFIED.search(topic.name.lower()))
    if config.rectified != "auto":
        rectified = config.rectified == "yes"
    notes[topic.name] += f", {'rectified' if rectified else 'not rectified'}, {info or 'without CameraInfo'}"
    return CameraRole(name, topic.name, info, rectified, topic.kind)


def _info_topic(image: Topic, infos: Sequence[Topic]) -> str:
    """Return the CameraInfo of an image, that with the most common namespaces; empty if there is none."""
    base = TRANSPORT.sub("", image.name)

    def shared(topic: Topic) -> int:
        return len(commonprefix([topic.name.split("/"), base.split("/")]))

    return max(_near_infos(image, infos), key=shared, default=Topic("", "")).name


def _near_infos(image: Topic, infos: Sequence[Topic]) -> list[Topic]:
    """Return the CameraInfos that may be an image's.

    ROS puts it beside the image. Otherwise one in the same frame or in a namespace above is used.
    """
    base = TRANSPORT.sub("", image.name)
    for name in (base.rpartition("/")[0] + "/camera_info", base + "/camera_info"):
        if beside := [t for t in infos if t.name == name]:
            return beside
    same_frame = [t for t in infos if image.frame_id and t.frame_id == image.frame_id]
    return same_frame or [
        t for t in infos if t.name != "/camera_info" and base.startswith(t.name.removesuffix("camera_info"))
    ]
