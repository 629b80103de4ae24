"""LiDARs and cameras among the topics, by type, name and frame."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from posixpath import commonprefix

from bevviz.config import SourceConfig
from bevviz.messages.topics import (
    IMAGES,
    TRANSPORT,
    Topic,
    device_parts,
    of_kind,
    set_note,
    stated_topic,
)


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
        chosen = [stated_topic(t, topics, "source.lidar_topics", "PointCloud2") for t in config.lidar_topics]
        set_note(notes, clouds, "not used: not in source.lidar_topics")
        set_note(notes, chosen, "LiDAR, by source.lidar_topics")
        return chosen
    tiers = {topic: _lidar_tier(topic, config.base_frame) for topic in clouds}
    best = min(tiers.values(), default=0)
    set_note(
        notes, clouds, "not used: looks like a result, a radar's or a depth camera's cloud, not a LiDAR's"
    )
    moved = [t for t in clouds if tiers[t] == 1 and _is_moved(t, config.base_frame)]
    set_note(notes, moved, "not used: in the robot's own frame, to which points of others were moved")
    set_note(notes, [t for t in clouds if t.count == 0], "not used: without messages")
    candidates = sorted((t for t in clouds if tiers[t] == best), key=lambda t: (len(t.name), t.name))
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

    def distance(topic: Topic) -> tuple[bool, bool, bool, int, int, str]:
        name = topic.name.lower()
        return (
            not _RECTIFIED.search(name),
            bool(_COLOURLESS.search(name)),
            not _info_topic(topic, topics),
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
        info = _info_topic(topic, topics)
    else:
        info = stated_topic(stated, topics, "source.camera_info_topics", "CameraInfo").name
    rectified = bool(_RECTIFIED.search(topic.name.lower()))
    if config.rectified != "auto":
        rectified = config.rectified == "yes"
    notes[topic.name] += f", {'rectified' if rectified else 'not rectified'}, {info or 'without CameraInfo'}"
    return CameraRole(name, topic.name, info, rectified, topic.kind)


def _info_topic(image: Topic, topics: Sequence[Topic]) -> str:
    """Return the CameraInfo of an image; empty if there is none.

    ROS puts it beside the image. Otherwise one in the same frame or in a namespace above is used.
    """
    base = TRANSPORT.sub("", image.name)
    infos = [t for t in of_kind(topics, "CameraInfo") if t.count != 0]
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
