"""Roles of topics: found by type, name and frame, or set by the configuration."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Literal

from bevviz.config import SourceConfig
from bevviz.errors import UserError
from bevviz.messages.foreign_boxes import check_boxes_setting
from bevviz.messages.foxglove import foxglove_type
from bevviz.messages.robots import choose_robot
from bevviz.messages.topics import (
    CLOUDS,
    IMAGES,
    CameraRole,
    Topic,
    camera_role,
    entity_name,
    find_images,
    find_lidars,
    names_of,
    of_kind,
    set_note,
    stated_topic,
    unique_names,
    unsupported_reason,
)
from bevviz.model.frame import Scene
from bevviz.support.limits import MAX_SENSORS


@dataclass(frozen=True, slots=True)
class Roles:
    """Topics by their role.

    Attributes:
        lidars: clouds of the LiDARs.
        lidar_names: entity name of each LiDAR.
        cameras: topics of the cameras.
        tf: moving transforms.
        tf_static: static transforms.
        tf_held: topics of ``tf`` whose transforms hold until the next one, as Foxglove's do.
        odometry: topic of the odometry; empty: there is none.
        imus: topics that give the gravity direction if the transforms do not.
        robot_detections_2d: the robot's own image boxes.
        robot_detections_3d: the robot's own 3D boxes.
        robot_clouds: the robot's obstacle points, if the ground stage is the robot's.
        stages: the robot's results that replace our stages.
        truth: topic of the ground truth; empty: there is none.
        boxes: setting ``source.boxes``.
        around: topic, kind and type of the messages that are shown around perception.
        camera_infos: topics of CameraInfo that no camera uses.
        no_lidar: why there is no LiDAR, and what would help; empty: there is one.
        no_camera: why there is no camera, and what would help; empty: there is one.
        robots: names of the robots, if there are several, which of them is shown, and what shows another one.
        notes: for every topic, in a few words, why it has its role or none.
    """

    lidars: tuple[str, ...] = ()
    lidar_names: tuple[str, ...] = ()
    cameras: tuple[CameraRole, ...] = ()
    tf: tuple[str, ...] = ()
    tf_static: tuple[str, ...] = ()
    tf_held: tuple[str, ...] = ()
    odometry: str = ""
    imus: tuple[str, ...] = ()
    robot_detections_2d: tuple[str, ...] = ()
    robot_detections_3d: tuple[str, ...] = ()
    robot_clouds: tuple[str, ...] = ()
    stages: tuple[str, ...] = ()
    truth: str = ""
    boxes: Mapping[str, str] = field(default_factory=dict)
    around: tuple[tuple[str, str, str], ...] = field(default=(), compare=False)
    # The following fields are for sentences. They also depend on topics without a role.
    camera_infos: tuple[str, ...] = field(default=(), compare=False)
    no_lidar: str = field(default="", compare=False)
    no_camera: str = field(default="", compare=False)
    robots: str = field(default="", compare=False)
    notes: Mapping[str, str] = field(default_factory=dict)

    @property
    def driver(self) -> str:
        """Topic whose messages make the frames: the first LiDAR's, or the first camera's without a LiDAR."""
        return next(iter((*self.lidars, *(camera.topic for camera in self.cameras))), "")

    @property
    def settings(self) -> tuple[str, ...]:
        """Settings ``key=value`` that give the sensors' topics the same roles beside any other topics."""
        infos = {camera.topic: camera.info_topic for camera in self.cameras if camera.info_topic}
        chosen = {
            "lidar_topics": list(self.lidars),
            "camera_topics": [camera.topic for camera in self.cameras],
            "camera_info_topics": infos,
            "odometry_topic": self.odometry,
        }
        return tuple(f"source.{key}={json.dumps(value)}" for key, value in chosen.items() if value)

    def scene(self, name: str) -> Scene:
        """Return the scene that a source with these topics delivers."""
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


MANY = 12  # longest list of topics in a sentence
MARK = "bevviz/mark"  # topic within the namespace of the node
_MARK = re.compile(rf"(^|/){MARK}$")

Kind = Literal["mark", "status", "shape"]
SHAPES = frozenset(
    {"LaserScan", "Path", "PoseStamped", "OccupancyGrid", "GridMap", "MarkerArray", "Marker", "NavSatFix"}
)
RESULTS = {  # results of the robot's pipeline that are shown unless ours use them
    "PointCloud2": re.compile(r"(^|/)lidar/points_no_ground$"),
    "Image": re.compile(r"(^|/)visualization/bev_image$"),
}
_DESCRIPTION = re.compile(r"(^|/)robot_description$")
_AROUND = {"mark": "notes of people", "status": "the robot's diagnostics", "shape": "around perception"}

STAGE_KINDS = {  # type of the robot's result, by the stage that it replaces
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

    Topics that the configuration states are taken. Otherwise each frame_id is one sensor. Of several clouds,
    or several images, with the same frame_id the one nearest to the sensor is taken; of images the rectified
    one, because pipelines make their other images from it.

    Args:
        topics: all topics.
        config: states topics.
        stages: topics of the robot's results that replace stages, by the dotted key that names each.
        results: whether the robot's bird's-eye view and obstacles are shown, too.

    Raises:
        UserError: a stated topic does not exist, or has another type.
    """
    topics = sorted(topics, key=lambda t: t.name)  # topics of a bag or graph have no fixed order
    topics = _with_boxes(topics, config)
    notes = {
        t.name: f"not used: {unsupported_reason(t) or t.aside or f'nothing here reads {t.type}'}"
        for t in topics
    }
    of_others, robots = choose_robot(topics, config)
    notes.update({name: f"not used: of {robot}, another robot" for name, robot in of_others.items()})
    topics = [topic for topic in topics if topic.name not in of_others]
    staged = {key: stated_topic(name, topics, key, STAGE_KINDS[key]) for key, name in stages.items()}
    obstacles = [topic for key, topic in staged.items() if key == "ground.method"]
    for name in config.lidar_calibration:
        stated_topic(name, topics, "source.lidar_calibration", "PointCloud2")
    metadata = {t.metadata_topic for t in topics}
    set_note(notes, [t for t in topics if t.name in metadata], "metadata of the LiDAR")
    lidars = find_lidars([t for t in topics if t not in obstacles], config, notes)
    images = find_images(topics, config, notes)
    for sensors, noun, key in ((lidars, "LiDARs", "lidar_topics"), (images, "cameras", "camera_topics")):
        if len(sensors) > MAX_SENSORS:
            raise UserError(
                f"{len(sensors):,} topics look like {noun}: {MAX_SENSORS} at most are taken, choose some: "
                f"--set source.{key}=[{sensors[0].name}]"
            )
    names = unique_names(
        [(entity_name(t.name, t.frame_id), t) for t in lidars] + [(entity_name(t.name), t) for t in images]
    )
    cameras = tuple(
        camera_role(t, name, topics, config, notes)
        for t, name in zip(images, names[len(lidars) :], strict=True)
    )
    used_infos = {camera.info_topic for camera in cameras}
    for topic in of_kind(topics, "CameraInfo"):
        used_by = [camera.name for camera in cameras if camera.info_topic == topic.name]
        notes[topic.name] = (
            f"calibration of {', '.join(used_by)}" if used_by else "not used: its images are not"
        )

    transforms = [t for t in topics if t.kind.lower() == "tfmessage"]
    others = _of_other_robots(transforms, of_kind(topics, "PointCloud2", *IMAGES), [*lidars, *images])
    set_note(notes, others, "not used: transforms of another robot, whose sensors are not")
    foreign = set(names_of(others))
    transforms = [t for t in transforms if t.name not in foreign]
    static = [t for t in transforms if t.name.endswith("tf_static")]
    moving = [t for t in transforms if not t.name.endswith("tf_static")]
    set_note(notes, static, "static transforms")
    set_note(notes, moving, "transforms")
    odometry = _find_odometry(topics, config, notes)
    imus = [topic for topic in of_kind(topics, "Imu") if topic.count != 0]
    set_note(notes, imus, "plotted; gravity, where the transforms have no upright frame")
    boxes = of_kind(topics, "Detection3DArray")
    truth = [t for t in boxes if t.name.endswith("ground_truth") and t not in staged.values()][:1]
    boxes = [t for t in boxes if t not in truth]
    detections = of_kind(topics, "Detection2DArray")
    set_note(notes, truth, "ground truth, by its name")
    set_note(notes, [*boxes, *detections], "the robot's own result")
    for key, topic in staged.items():
        notes[topic.name] = f"the robot's own result, taken for the stage {key.partition('.')[0]}"
    around = [
        (t.name, kind, t.kind)
        for t in topics
        if t not in lidars and (kind := surroundings_kind(t.name, t.kind)) is not None
    ]
    if results:
        unused = [t for t in topics if t not in (*lidars, *images, *staged.values()) and t.kind in RESULTS]
        around += [(t.name, "shape", t.kind) for t in unused if RESULTS[t.kind].search(t.name)]
    helps = {t.name: f"; no LiDAR: {why}" if (why := unsupported_reason(t, "LiDAR")) else "" for t in topics}
    notes.update({name: f"shown: {_AROUND[kind]}{helps[name]}" for name, kind, _ in around})
    return Roles(
        boxes=config.boxes,
        around=tuple(around),
        lidars=names_of(lidars),
        lidar_names=tuple(names[: len(lidars)]),
        cameras=cameras,
        tf=names_of(moving),
        tf_static=names_of(static),
        tf_held=names_of(t for t in moving if foxglove_type(t.type)),
        odometry=odometry,
        imus=names_of(imus),
        robot_detections_2d=names_of(detections),
        robot_detections_3d=names_of(boxes),
        robot_clouds=names_of(obstacles),
        stages=names_of(staged.values()),
        truth=truth[0].name if truth else "",
        camera_infos=names_of(t for t in of_kind(topics, "CameraInfo") if t.name not in used_infos),
        no_lidar="" if lidars else _no_lidar(topics),
        no_camera="" if images else _no_camera(topics),
        robots=robots,
        notes=notes,
    )


def _of_other_robots(
    transforms: Sequence[Topic], sensors: Sequence[Topic], used: Sequence[Topic]
) -> list[Topic]:
    """Return the transforms in whose namespace there are sensors, but none that is used.

    Robots of one kind have equal frame names, so their transforms must not be mixed.
    """
    if not used:
        return []
    names, used_names = names_of(sensors), names_of(used)
    others = []
    for topic in transforms:
        namespace = topic.name.rpartition("/")[0] + "/"
        in_use = any(name.startswith(namespace) for name in used_names)
        if not in_use and any(name.startswith(namespace) for name in names):
            others.append(topic)
    return others


def _with_boxes(topics: list[Topic], config: SourceConfig) -> list[Topic]:
    """Mark the topic that ``source.boxes`` names."""
    check_boxes_setting(config.boxes)
    name = config.boxes.get("topic", "")
    if name and name not in names_of(topics):
        near = difflib.get_close_matches(name, names_of(topics), n=3, cutoff=0.4)
        there = f"; the nearest are {', '.join(near)}" if near else ""
        raise UserError(f"source.boxes: there is no topic {name}{there}")
    return [replace(topic, boxes=topic.name == name) for topic in topics] if name else topics


def _no_lidar(topics: Sequence[Topic]) -> str:
    summary = f"no LiDAR: none of {len(topics)} topics is a sensor_msgs/PointCloud2"
    if unsupported := [f"{t.name} holds {why}" for t in topics if (why := unsupported_reason(t, "LiDAR"))]:
        return f"{summary}; {'; '.join(unsupported)}"
    unread = [t for t in topics if t.aside and t.kind in (*CLOUDS, "")]
    if unread and len(unread) <= MANY:
        return f"no LiDAR that can be read: {'; '.join(f'{t.name}: {t.aside}' for t in unread)}"
    if clouds := names_of(of_kind(topics, "PointCloud2")):
        return f"no LiDAR: {', '.join(clouds)} is the result of a stage"
    if len(topics) > MANY:
        return f"{summary}; 'bevviz info' shows them"
    return f"{summary}; there are {', '.join(f'{t.name} ({t.kind})' for t in topics) or 'none'}"


def _no_camera(topics: Sequence[Topic]) -> str:
    images = of_kind(topics, *IMAGES)
    if unsupported := [f"{t.name} holds {why}" for t in topics if (why := unsupported_reason(t, "camera"))]:
        return f"no camera that can be read: {'; '.join(unsupported)}"
    if with_messages := names_of(t for t in images if t.count != 0):
        return f"no camera among the images: --set source.camera_topics=[{with_messages[0]}]"
    if images:
        return f"no camera: there are no messages on {', '.join(names_of(images))}"
    return "no camera: there is no topic of sensor_msgs/Image or CompressedImage"


# --- odometry ----------------------------------------------------------------------------------


def _find_odometry(topics: Sequence[Topic], config: SourceConfig, notes: dict[str, str]) -> str:
    candidates = of_kind(topics, "Odometry")
    if config.odometry_topic:
        chosen = stated_topic(config.odometry_topic, topics, "source.odometry_topic", "Odometry")
    elif not candidates:
        return ""
    else:
        chosen = min(candidates, key=lambda t: (t.count == 0, t.name.count("/"), t.name))
    set_note(notes, candidates, f"not used: {chosen.name} is")
    notes[chosen.name] = "odometry, where the transforms have no fixed frame"
    return chosen.name


# --- around perception -------------------------------------------------------------------------


def surroundings_kind(topic: str, short: str) -> Kind | None:
    """Return the kind of a topic around perception, by its name and its type without the package."""
    if short == "String" and _MARK.search(topic):
        return "mark"
    if short == "DiagnosticArray":
        return "status"
    described = short == "String" and _DESCRIPTION.search(topic)
    return "shape" if short in SHAPES or described else None
