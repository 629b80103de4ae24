"""Topics that a configuration states: their names on a running graph, and their absence."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from bevviz.config import Config, SourceConfig, stage_topics
from bevviz.messages.roles import STAGE_KINDS
from bevviz.messages.topics import Topic


def stated_topics(config: Config, resolve: Callable[[str], str]) -> dict[str, tuple[str, tuple[str, ...]]]:
    """Return the topics of the configuration, each with its key and its permitted types.

    No types means that any type is permitted.
    """
    source, images = resolved(config.source, resolve), ("Image", "CompressedImage")
    stated: dict[str, tuple[str, tuple[str, ...]]] = {}
    for key, names, kinds in (
        ("source.lidar_topics", source.lidar_topics, ("PointCloud2",)),
        ("source.camera_topics", source.camera_topics, images),
        ("source.camera_info_topics", source.camera_info_topics, images),
        ("source.camera_info_topics", source.camera_info_topics.values(), ("CameraInfo",)),
        ("source.odometry_topic", filter(None, [source.odometry_topic]), ("Odometry",)),
        ("source.boxes", filter(None, [source.boxes.get("topic", "")]), ()),
    ):
        stated |= dict.fromkeys(names, (key, kinds))
    stages = stage_topics(config)
    return stated | {resolve(name): (key, (STAGE_KINDS[key],)) for key, name in stages.items()}


def resolved(config: SourceConfig, resolve: Callable[[str], str]) -> SourceConfig:
    """Return the configuration with the topic names on the graph."""
    infos, boxes = config.camera_info_topics, config.boxes
    return config.model_copy(
        update={
            "lidar_topics": tuple(map(resolve, config.lidar_topics)),
            "camera_topics": tuple(map(resolve, config.camera_topics)),
            "camera_info_topics": {resolve(image): resolve(info) for image, info in infos.items()},
            "odometry_topic": config.odometry_topic and resolve(config.odometry_topic),
            "boxes": {key: resolve(path) if key == "topic" else path for key, path in boxes.items()},
            "lidar_calibration": {resolve(name): file for name, file in config.lidar_calibration.items()},
        }
    )


def without_absent(topics: list[Topic], config: SourceConfig) -> tuple[list[Topic], SourceConfig]:
    """Remove stated topics that are absent, and the topics that could take over their roles.

    A stated topic that is absent is waited for. No other topic may take its role meanwhile.
    """
    names = {topic.name for topic in topics}
    changes: dict[str, Any] = {}
    for key, kinds in (("lidar_topics", {"PointCloud2"}), ("camera_topics", {"Image", "CompressedImage"})):
        stated_names = getattr(config, key)
        changes[key] = tuple(name for name in stated_names if name in names)
        if stated_names and not changes[key]:
            topics = [topic for topic in topics if topic.kind not in kinds]
    changes["camera_info_topics"] = {
        image: info for image, info in config.camera_info_topics.items() if {image, info} <= names
    }
    if config.boxes.get("topic", "") not in names:
        changes["boxes"] = {}
    changes["lidar_calibration"] = {
        name: file for name, file in config.lidar_calibration.items() if name in names
    }
    if config.odometry_topic and config.odometry_topic not in names:
        changes["odometry_topic"] = ""
        topics = [topic for topic in topics if topic.kind != "Odometry"]
    return topics, config.model_copy(update=changes)
