"""Several robots in one recording: their topics by namespace."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence

from bevviz.config import SourceConfig
from bevviz.messages.topics import CLOUDS, IMAGES, Topic, is_derived

# Name of a robot as people number them. Sensors are named by their place: front, rear_left.
_ROBOT = re.compile(
    r"(?:agent|vehicle|car|truck|uav|ugv|drone|tb|rover|unit|husky|jackal|\w*bot)[_-]?(?:\d+|[a-z])?$"
)
MOST = 3  # robots that are offered
ROOT = "/"  # name of the robot without a namespace


def find_robots(topics: Sequence[Topic]) -> dict[str, list[Topic]]:
    """Return the topics of each robot by namespace; nothing if there is but one.

    A namespace is a robot's if it has a LiDAR and a camera, transforms or odometry of its own, and its frames
    have its name before a slash, or its transforms are its own, or it is named as robots are. A robot may be
    without a namespace if it and another one have LiDAR, camera and transforms each.
    """
    sensors = [t for t in topics if t.count != 0 and t.kind in (*CLOUDS, *IMAGES)]
    paths = [topic.name.strip("/").split("/") for topic in sensors]
    level = 0
    while all(len(path) > level + 1 for path in paths) and len({path[level] for path in paths}) == 1:
        level += 1
    names = dict.fromkeys(path[level] for path in paths if len(path) > level + 1)
    robots = {name: _within(topics, level, name) for name in names}
    robots = {name: own for name, own in robots.items() if _is_robot(name, own)}
    namespaced = {topic.name for own in robots.values() for topic in own}
    others = [topic for topic in topics if topic.name not in namespaced]
    if _is_complete(others) and any(map(_is_complete, robots.values())):
        robots[ROOT] = others
    return dict(sorted(robots.items())) if len(robots) > 1 else {}


def _within(topics: Sequence[Topic], level: int, name: str) -> list[Topic]:
    parts = ((topic, topic.name.strip("/").split("/")) for topic in topics)
    return [topic for topic, path in parts if len(path) > level + 1 and path[level] == name]


def _is_robot(name: str, topics: Sequence[Topic]) -> bool:
    kinds = {topic.kind for topic in topics if topic.count != 0}
    transforms = bool({kind.lower() for kind in kinds} & {"tfmessage"})
    if not kinds & set(CLOUDS) or not (kinds & {*IMAGES, "Odometry"} or transforms):
        return False
    clouds = [topic for topic in topics if topic.kind in CLOUDS]
    prefixed = all(topic.frame_id.strip("/").startswith(f"{name}/") for topic in clouds)
    return prefixed or transforms or bool(_ROBOT.match(name.lower()))


def _is_complete(topics: Sequence[Topic]) -> bool:
    """Return whether topics of a LiDAR, a camera and transforms are there, without results of the sensors."""
    kinds = {topic.kind.lower() for topic in topics if topic.count != 0 and not is_derived(topic)}
    return {"pointcloud2", "tfmessage"} <= kinds and not kinds.isdisjoint(map(str.lower, IMAGES))


def choose_robot(topics: Sequence[Topic], config: SourceConfig) -> tuple[Mapping[str, str], str]:
    """Choose one robot: that of the stated topics, else the first.

    Returns:
        The robot of each topic of the others, and a sentence about all robots. Both are empty if there is one
        robot, or topics of several are stated.
    """
    robots = find_robots(topics)
    stated = {*config.lidar_topics, *config.camera_topics}
    chosen = [name for name, own in robots.items() if stated & {t.name for t in own}] or [*robots][:1]
    if len(chosen) != 1:
        return {}, ""
    others = {topic.name: name for name, own in robots.items() if name not in chosen for topic in own}
    if stated:
        return others, ""
    helps = [
        f"--set source.lidar_topics=[{_lidar(own)}] shows {name}"
        for name, own in robots.items()
        if name not in chosen
    ]
    names = f"{len(robots)} robots, {_listed(robots)}"
    return others, f"the topics are of {names}: {chosen[0]} is shown; {', '.join(helps[:MOST])}"


def _lidar(topics: Sequence[Topic]) -> str:
    clouds = sorted((t.kind != CLOUDS[0], len(t.name), t.name) for t in topics if t.kind in CLOUDS)
    return clouds[0][2]


def _listed(names: Collection[str]) -> str:
    *most, last = names
    return f"{', '.join(most)} and {last}"
