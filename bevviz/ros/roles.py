"""Which topic plays which role: found by type, name and frame, or set by hand."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from posixpath import commonprefix
from types import MappingProxyType
from typing import Literal

from bevviz.config import SourceConfig
from bevviz.errors import UserError
from bevviz.frame import Scene
from bevviz.logging.entities import RESERVED
from bevviz.ros import ouster
from bevviz.ros.compressed import is_compressed
from bevviz.ros.foxglove import KINDS, short_of
from bevviz.ros.livox import is_livox
from bevviz.ros.objects import check, holds_boxes
from bevviz.ros.ouster import is_packet
from bevviz.ros.packets import is_packets, lacks


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
        if self.scans or is_livox(self.type) or is_packets(self.type) or is_compressed(self.type):
            return "PointCloud2"
        if short := short_of(self.type):
            return KINDS[short]
        if self.video or _VIDEO.search(self.type):
            return "CompressedVideo"
        return "Detection3DArray" if self.boxes or holds_boxes(self.type) else self.type.rpartition("/")[2]


@dataclass(frozen=True, slots=True)
class CameraRole:
    name: str  # of its entities
    topic: str
    info_topic: str  # "": there is none
    rectified: bool
    kind: str  # Image, CompressedImage or CompressedVideo


@dataclass(frozen=True, slots=True)
class Roles:
    """The topics that play. ``notes`` says of every topic, in a few words, why it does or does not."""

    lidars: tuple[str, ...] = ()
    lidar_names: tuple[str, ...] = ()  # entity name of each
    cameras: tuple[CameraRole, ...] = ()
    tf: tuple[str, ...] = ()
    tf_static: tuple[str, ...] = ()
    tf_held: tuple[str, ...] = ()  # of tf, those whose transforms hold until there are others, as Foxglove's
    odometry: str = ""
    imus: tuple[str, ...] = ()  # tell which way is up, where transforms do not
    robot_detections_2d: tuple[str, ...] = ()
    robot_detections_3d: tuple[str, ...] = ()
    robot_clouds: tuple[str, ...] = ()  # of obstacles, where the ground stage is the robot's
    stages: tuple[str, ...] = ()  # the robot's results that our stages are taken from
    truth: str = ""
    boxes: Mapping[str, str] = field(default_factory=dict)  # as source.boxes has it
    around: tuple[tuple[str, str, str], ...] = field(default=(), compare=False)  # topic, what it tells, type
    # What follows is for sentences: it changes with topics that play no role.
    camera_infos: tuple[str, ...] = field(default=(), compare=False)  # all of them, whoever uses them
    no_lidar: str = field(default="", compare=False)  # why there is none, and what would help
    no_camera: str = field(default="", compare=False)  # the same of cameras
    notes: Mapping[str, str] = field(default_factory=dict)

    @property
    def driver(self) -> str:
        """The topic whose messages make the frames: the first LiDAR's, without one the first camera's."""
        return next(iter((*self.lidars, *(camera.topic for camera in self.cameras))), "")

    @property
    def settings(self) -> tuple[str, ...]:
        """``key=value`` each, which give the sensors' topics the same roles whatever others there are."""
        infos = {camera.topic: camera.info_topic for camera in self.cameras if camera.info_topic}
        chosen = {
            "lidar_topics": list(self.lidars),
            "camera_topics": [camera.topic for camera in self.cameras],
            "camera_info_topics": infos,
            "odometry_topic": self.odometry,
        }
        return tuple(f"source.{key}={json.dumps(value)}" for key, value in chosen.items() if value)

    def scene(self, name: str) -> Scene:
        """What a source with these topics delivers."""
        lidars = self.lidar_names
        return Scene(
            name=name,
            lidar="lidars" if len(lidars) > 1 else "".join(lidars),
            lidars=lidars,
            cameras=tuple(camera.name for camera in self.cameras),
            robot=bool(self.robot_detections_2d or self.robot_detections_3d),
            truth=bool(self.truth),
            imu=bool(self.imus),
        )


MANY = 12  # topics; more are not listed in a sentence
_VIDEO = re.compile(r"ffmpeg_image_transport_msgs/(msg/)?FFMPEGPacket$|theora_image_transport/(msg/)?Packet$")
VIDEO = "video of a kind that is not decoded here: republish it as images (image_transport) and record these"
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
    if is_packet(topic.type) and topic.aside:
        return topic.aside if not sensor or (sensor == "LiDAR" and topic.aside != ouster.NOT_LIDAR) else ""
    if sensor in ("", "LiDAR") and (why := lacks(topic.type)):
        return why
    return next((why for of, kind, why in _FOREIGN if sensor in ("", of) and kind.search(topic.type)), "")


MARK = "bevviz/mark"  # topic, in the namespace of the node
_MARK = re.compile(rf"(^|/){MARK}$")

Kind = Literal["mark", "status", "shape"]
SHAPES = frozenset(
    {"LaserScan", "Path", "PoseStamped", "OccupancyGrid", "GridMap", "MarkerArray", "Marker", "NavSatFix"}
)
RESULTS = {  # of the robot's own pipeline, shown where nothing of ours is
    "PointCloud2": re.compile(r"(^|/)lidar/points_no_ground$"),
    "Image": re.compile(r"(^|/)visualization/bev_image$"),
}
_DESCRIPTION = re.compile(r"(^|/)robot_description$")
_AROUND = {
    "mark": "notes of people",
    "status": "the robot's diagnostics",
    "shape": "around perception",
}

STAGE_KINDS = {  # what the robot publishes as the result of a stage
    "ground.method": "PointCloud2",
    "clustering.method": "Detection3DArray",
    "detector.model": "Detection2DArray",
    "objects.method": "Detection3DArray",
}


def find_roles(
    topics: Sequence[Topic],
    config: SourceConfig,
    stages: Mapping[str, str] = MappingProxyType({}),
    *,
    results: bool = False,
) -> Roles:
    """Give each topic its role.

    Topics that are stated in the configuration are taken as they are. Otherwise one frame is one sensor:
    of several clouds, or several images, with the same frame_id the one nearest to the sensor is taken
    (images: the rectified one, as the others of a pipeline are made from it).

    Args:
        topics: all that there are.
        config: which topics are stated.
        stages: the robot's topics that stages are taken from, by the dotted key that names each.
        results: the robot's bird's-eye view and obstacles are shown, too.

    Raises:
        UserError: a stated topic does not exist, or is of another type.
    """
    topics = sorted(topics, key=lambda t: t.name)  # the order of a bag's or a graph's topics is chance
    topics = _with_boxes(topics, config)
    notes = {t.name: f"not used: {foreign(t) or f'nothing here reads {t.type}'}" for t in topics}
    staged = {key: _stated(name, topics, key, STAGE_KINDS[key]) for key, name in stages.items()}
    obstacles = [topic for key, topic in staged.items() if key == "ground.method"]
    for name in config.lidar_calibration:
        _stated(name, topics, "source.lidar_calibration", "PointCloud2")
    told = {ouster.metadata_of(t.name) for t in topics if t.scans}
    _note(notes, [t for t in topics if t.name in told], "metadata of the LiDAR")
    lidars = _find_lidars([t for t in topics if t not in obstacles], config, notes)
    images = _find_images(topics, config, notes)
    names = _unique_names(
        [(entity_name(t.name, t.frame_id), t) for t in lidars] + [(entity_name(t.name), t) for t in images]
    )
    cameras = tuple(
        _camera(t, name, topics, config, notes) for t, name in zip(images, names[len(lidars) :], strict=True)
    )
    for topic in _of(topics, "CameraInfo"):
        used_by = [camera.name for camera in cameras if camera.info_topic == topic.name]
        notes[topic.name] = (
            f"calibration of {', '.join(used_by)}" if used_by else "not used: its images are not"
        )

    transforms = [t for t in topics if t.kind.lower() == "tfmessage"]
    others = [t for t in transforms if _of_another_robot(t, topics, [*lidars, *images])]
    _note(notes, others, "not used: transforms of another robot, whose sensors are not")
    transforms = [t for t in transforms if t not in others]
    static = [t for t in transforms if t.name.endswith("tf_static")]
    moving = [t for t in transforms if t not in static]
    _note(notes, static, "static transforms")
    _note(notes, moving, "transforms")
    odometry = _find_odometry(topics, config, notes)
    imus = [topic for topic in _of(topics, "Imu") if topic.count != 0]
    _note(notes, imus, "plotted; gravity, where the transforms have no upright frame")
    boxes = _of(topics, "Detection3DArray")
    truth = [t for t in boxes if t.name.endswith("ground_truth") and t not in staged.values()][:1]
    boxes = [t for t in boxes if t not in truth]
    detections = _of(topics, "Detection2DArray")
    _note(notes, truth, "ground truth, by its name")
    _note(notes, [*boxes, *detections], "the robot's own result")
    for key, topic in staged.items():
        notes[topic.name] = f"the robot's own result, taken for the stage {key.partition('.')[0]}"
    around = [(t.name, kind, t.kind) for t in topics if (kind := kind_of(t.name, t.kind)) is not None]
    if results:
        free = [t for t in topics if t not in (*lidars, *images, *staged.values()) and t.kind in RESULTS]
        around += [(t.name, "shape", t.kind) for t in free if RESULTS[t.kind].search(t.name)]
    helps = {t.name: f"; no LiDAR: {why}" if (why := foreign(t, "LiDAR")) else "" for t in topics}
    notes.update({name: f"shown: {_AROUND[kind]}{helps[name]}" for name, kind, _ in around})
    return Roles(
        boxes=config.boxes,
        around=tuple(around),
        lidars=_names(lidars),
        lidar_names=tuple(names[: len(lidars)]),
        cameras=cameras,
        tf=_names(moving),
        tf_static=_names(static),
        tf_held=_names(t for t in moving if short_of(t.type)),
        odometry=odometry,
        imus=_names(imus),
        robot_detections_2d=_names(detections),
        robot_detections_3d=_names(boxes),
        robot_clouds=_names(obstacles),
        stages=_names(staged.values()),
        truth=truth[0].name if truth else "",
        camera_infos=_names(_of(topics, "CameraInfo")),
        no_lidar="" if lidars else _no_lidar(topics),
        no_camera="" if images else _no_camera(topics),
        notes=notes,
    )


def _of_another_robot(topic: Topic, topics: Sequence[Topic], used: Sequence[Topic]) -> bool:
    """Whether a namespace has transforms and sensors of its own, and none of these is used.

    Robots of one kind name their frames alike: their transforms are not to be mixed.
    """
    namespace = topic.name.rpartition("/")[0] + "/"
    own = [t for t in _of(topics, "PointCloud2", *_IMAGES) if t.name.startswith(namespace)]
    return bool(own and used) and not any(t in used for t in own)


def _with_boxes(topics: list[Topic], config: SourceConfig) -> list[Topic]:
    """The topic that ``source.boxes`` is of is read as boxes."""
    check(config.boxes)
    name = config.boxes.get("topic", "")
    if name and name not in _names(topics):
        near = difflib.get_close_matches(name, _names(topics), n=3, cutoff=0.4)
        there = f"; the nearest are {', '.join(near)}" if near else ""
        raise UserError(f"source.boxes: there is no topic {name}{there}")
    return [replace(topic, boxes=topic.name == name) for topic in topics] if name else topics


def _no_lidar(topics: Sequence[Topic]) -> str:
    said = f"no LiDAR: none of {len(topics)} topics is a sensor_msgs/PointCloud2"
    if held := [f"{t.name} holds {why}" for t in topics if (why := foreign(t, "LiDAR"))]:
        return f"{said}; {'; '.join(held)}"
    if taken := _names(_of(topics, "PointCloud2")):
        return f"no LiDAR: {', '.join(taken)} is the result of a stage"
    if len(topics) > MANY:
        return f"{said}; 'bevviz info' shows them"
    return f"{said}; there are {', '.join(f'{t.name} ({t.kind})' for t in topics) or 'none'}"


def _no_camera(topics: Sequence[Topic]) -> str:
    images = _of(topics, *_IMAGES)
    if held := [f"{t.name} holds {why}" for t in topics if (why := foreign(t, "camera"))]:
        return f"no camera that can be read: {'; '.join(held)}"
    if with_messages := _names(t for t in images if t.count != 0):
        return f"no camera among the images: --set source.camera_topics=[{with_messages[0]}]"
    if images:
        return f"no camera: there are no messages on {', '.join(_names(images))}"
    return "no camera: there is no topic of sensor_msgs/Image or CompressedImage"


def _names(topics: Iterable[Topic]) -> tuple[str, ...]:
    return tuple(topic.name for topic in topics)


def _note(notes: dict[str, str], topics: Iterable[Topic], text: str) -> None:
    notes.update({topic.name: text for topic in topics})


def _of(topics: Iterable[Topic], *kinds: str) -> list[Topic]:
    return [topic for topic in topics if topic.kind in kinds]


def _stated(name: str, topics: Sequence[Topic], key: str, *kinds: str) -> Topic:
    """The topic that the configuration names under ``key``."""
    fitting = _of(topics, *kinds)
    for topic in topics:
        if topic.name == name:
            if topic in fitting:
                return topic
            why = foreign(topic)
            helps = f"; it holds {why}" if why else ""
            raise UserError(f"{key}: {name} is a {topic.type}, but must be {' or '.join(kinds)}{helps}")
    near = difflib.get_close_matches(name, _names(fitting), n=3, cutoff=0.4) or _names(fitting)
    there = f"the nearest are {', '.join(near)}" if near else f"there is no {' or '.join(kinds)} topic"
    raise UserError(f"{key}: there is no topic {name}; {there}")


# --- LiDARs ------------------------------------------------------------------------------------

_LIDAR = re.compile(r"lidar|laser|velodyne|ouster|os_|livox|hesai|robosense|pandar|points|scan")
_DERIVED_CLOUD = re.compile(
    r"ground|cluster|obstacle|filter|registered|depth|stereo|camera|zed|realsense|rgbd|map|voxel|fused|segment"
    r"|crop|downsample|object|debug|feature|plane|merged|concat|keypoint|matched|odom|slam"
    r"|radar|mmwave|sonar"
)
_FIXED = ("map", "odom", "world", "camera_init")  # no sensor moves with them


def _find_lidars(topics: Sequence[Topic], config: SourceConfig, notes: dict[str, str]) -> list[Topic]:
    clouds = _of(topics, "PointCloud2")
    if config.lidar_topics:
        chosen = [_stated(t, topics, "source.lidar_topics", "PointCloud2") for t in config.lidar_topics]
        _note(notes, clouds, "not used: not in source.lidar_topics")
        _note(notes, chosen, "LiDAR, by source.lidar_topics")
        return chosen
    tiers = {topic: _lidar_tier(topic, config.base_frame) for topic in clouds}
    best = min(tiers.values(), default=0)
    _note(notes, clouds, "not used: looks like a result, a radar's or a depth camera's cloud, not a LiDAR's")
    _note(notes, [t for t in clouds if t.count == 0], "not used: without messages")
    candidates = sorted((t for t in clouds if tiers[t] == best), key=lambda t: (len(t.name), t.name))
    if best in (2, 3):
        candidates = candidates[:1]  # results are no sensors to be merged
    chosen = _one_a_frame(candidates, lambda t: t.frame_id or t.name, notes, "LiDAR, by type and name")
    return sorted(chosen, key=lambda t: t.name)


def _lidar_tier(topic: Topic, base_frame: str) -> int:
    """0: named like a LiDAR, 1: other cloud, 2: derived one, 3: in a fixed frame, 4: without messages.

    Who publishes in the robot's own frame has moved the points there: beside a LiDAR's raw ones they would
    be the same twice.
    """
    name, frame = topic.name.lower(), topic.frame_id.lower()
    if topic.count == 0:
        return 4
    if frame in _FIXED:
        return 3
    if _DERIVED_CLOUD.search(name) or "optical" in frame:
        return 2
    named = _LIDAR.search(name) or _LIDAR.search(frame)
    return 0 if named and frame not in (base_frame, "base_link", "base_footprint") else 1


def _one_a_frame(
    candidates: Iterable[Topic], sensor: Callable[[Topic], str], notes: dict[str, str], why: str
) -> list[Topic]:
    """The first candidate of each sensor."""
    chosen: dict[str, Topic] = {}
    for topic in candidates:
        first = chosen.setdefault(sensor(topic), topic)
        notes[topic.name] = (
            why if first is topic else f"not used: the sensor of {first.name}, by its frame or name"
        )
    return list(chosen.values())


# --- cameras -----------------------------------------------------------------------------------

_IMAGES = ("Image", "CompressedImage", "CompressedVideo")
_TRANSPORT = re.compile(r"/(compressed|compressedDepth|theora|ffmpeg|foxglove|zstd|h26[45]|video)$")
_DERIVED_IMAGE = re.compile(
    r"depth(?!ai)|disparity|confidence|annotat|debug|dbg|bev|mask|overlay|detect|visuali[sz]|segment|semantic"
    r"|label|heat_?map|costmap|stereo(_raw)?/image|track|result|infra|normal|cloud|side_by_side"
    r"|radar|sonar|(range|signal|reflec|nearir)_image"  # the latter Ouster's driver makes of its scans
)
_COLOURLESS = re.compile(r"gray|mono|(?<![a-z])ir(?![a-z])")
_RECTIFIED = re.compile(r"(?<![a-z])rect")


def _find_images(topics: Sequence[Topic], config: SourceConfig, notes: dict[str, str]) -> list[Topic]:
    images = _of(topics, *_IMAGES)
    for name in config.camera_info_topics:
        _stated(name, topics, "source.camera_info_topics", *_IMAGES)
    if config.camera_topics:
        chosen = [_stated(t, topics, "source.camera_topics", *_IMAGES) for t in config.camera_topics]
        _note(notes, images, "not used: not in source.camera_topics")
        _note(notes, chosen, "camera, by source.camera_topics")
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

    def distance(topic: Topic) -> tuple[bool, bool, bool, int, int, str]:
        name = topic.name.lower()
        return (
            not _RECTIFIED.search(name),
            bool(_COLOURLESS.search(name)),
            not _info_topic(topic, topics),
            _IMAGES.index(topic.kind),  # what the robot's detector saw is mostly the first one
            len(name),
            name,
        )

    usable.sort(key=distance)
    chosen = _one_a_frame(usable, lambda t: t.frame_id or _stem(t.name), notes, "camera, by type and name")
    return sorted(chosen, key=lambda t: t.name)


def _stem(topic: str) -> str:
    """What all variants of a camera's image have in common: the topic without raw, rect, gray or color."""
    return "/".join(re.sub(r"_(raw|rect|gray|color|mono)$", "", part) for part in _device(topic))


def _camera(
    topic: Topic, name: str, topics: Sequence[Topic], config: SourceConfig, notes: dict[str, str]
) -> CameraRole:
    stated = config.camera_info_topics.get(topic.name)
    if stated is None:
        info = _info_topic(topic, topics)
    else:
        info = _stated(stated, topics, "source.camera_info_topics", "CameraInfo").name
    rectified = bool(_RECTIFIED.search(topic.name.lower()))
    if config.rectified != "auto":
        rectified = config.rectified == "yes"
    notes[topic.name] += f", {'rectified' if rectified else 'not rectified'}, {info or 'without CameraInfo'}"
    return CameraRole(name, topic.name, info, rectified, topic.kind)


def _info_topic(image: Topic, topics: Sequence[Topic]) -> str:
    """The CameraInfo beside the image, as ROS has it; else one in its frame or a namespace above; else ""."""
    base = _TRANSPORT.sub("", image.name)
    infos = [t for t in _of(topics, "CameraInfo") if t.count != 0]
    beside = [base.rpartition("/")[0] + "/camera_info", base + "/camera_info"]
    for name in beside:
        if any(t.name == name for t in infos):
            return name

    def shared(topic: Topic) -> int:
        return len(commonprefix([topic.name.split("/"), base.split("/")]))

    same_frame = [t for t in infos if image.frame_id and t.frame_id == image.frame_id]
    above = [
        t for t in infos if t.name != "/camera_info" and base.startswith(t.name.removesuffix("camera_info"))
    ]
    return max(same_frame or above, key=shared).name if same_frame or above else ""


# --- odometry ----------------------------------------------------------------------------------


def _find_odometry(topics: Sequence[Topic], config: SourceConfig, notes: dict[str, str]) -> str:
    candidates = _of(topics, "Odometry")
    if config.odometry_topic:
        chosen = _stated(config.odometry_topic, topics, "source.odometry_topic", "Odometry")
    elif not candidates:
        return ""
    else:
        chosen = min(candidates, key=lambda t: (t.count == 0, t.name.count("/"), t.name))
    _note(notes, candidates, f"not used: {chosen.name} is")
    notes[chosen.name] = "odometry, where the transforms have no fixed frame"
    return chosen.name


# --- names -------------------------------------------------------------------------------------

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
    parts = _device(topic)
    weak = parts[-1] in _WEAK and len(parts) > 1 and parts[-2] != parts[-1]
    return _clean("_".join(parts[-2:] if weak else parts[-1:]))


def _device(topic: str) -> list[str]:
    """The parts of a topic that name a device."""
    parts = _TRANSPORT.sub("", topic).strip("/").split("/")
    kept = [part.removesuffix("_node") for part in parts if not _IMAGE_WORDS.fullmatch(part)]
    return kept or ["camera"]


def _clean(name: str) -> str:
    """A part of an entity path that needs no escapes."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_") or "sensor"


def _unique_names(named: Sequence[tuple[str, Topic]]) -> list[str]:
    """The short names where they are unique, else those of the whole topic, else with a number."""
    short = [name for name, _ in named]
    unique: list[str] = []
    for name, topic in named:
        if short.count(name) > 1 or name in RESERVED:
            name = _clean("_".join(_device(topic.name)))
        number, free = 2, name
        while free in unique or free in RESERVED:
            free, number = f"{name}_{number}", number + 1
        unique.append(free)
    return unique


# --- around perception -------------------------------------------------------------------------


def kind_of(topic: str, short: str) -> Kind | None:
    """What a topic tells, by its name and its type without the package; None: nothing of this."""
    if short == "String" and _MARK.search(topic):
        return "mark"
    if short == "DiagnosticArray":
        return "status"
    described = short == "String" and _DESCRIPTION.search(topic)
    return "shape" if short in SHAPES or described else None
