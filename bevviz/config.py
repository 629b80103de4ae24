"""The whole configuration: pydantic models with units, two presets, YAML files and ``key=value`` settings.

``default`` is the better method at every stage, ``reference`` is what the ROS 2 tutorial pipeline
computes. The tutorial's own parameter names (``cluster_tolerance`` ...) are accepted everywhere. Where a
stage is somebody else's, its parameters are those of the model beside it, under ``SECTION.params``.
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PositiveFloat,
    PrivateAttr,
    ValidationError,
    ValidationInfo,
    field_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError

from bevviz import plugins
from bevviz.errors import UserError
from bevviz.frame import AnomalyKind, Quantity
from bevviz.plugins import TOPIC

Preset = Literal["default", "reference"]
Keep = Literal["everything", "inspect", "report"]


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit that a value is stored in, and the factor of each other spelling that is accepted."""

    name: str
    factors: Mapping[str, float]

    def parse(self, value: Any) -> Any:
        """Turn ``"50 cm"`` into 0.5; leave what is no text to pydantic."""
        if not isinstance(value, str):
            return value
        match = re.fullmatch(r"\s*([-+.\deE]*\d\.?)\s*([^\s\d]*)\s*", value)
        if match is None:
            return value
        number, suffix = match.groups()
        if suffix and suffix not in self.factors:
            raise PydanticCustomError(
                "wrong_unit",
                "is in {unit}, not in '{given}'; accepted: {accepted}",
                {"unit": self.name, "given": suffix, "accepted": ", ".join(self.factors)},
            )
        try:
            return float(number) * self.factors.get(suffix, 1.0)
        except ValueError:
            return value


METRES = Unit("metres", {"m": 1.0, "cm": 0.01, "mm": 0.001})
SECONDS = Unit("seconds", {"s": 1.0, "ms": 0.001, "us": 1e-6, "min": 60.0, "h": 3600.0})
DEGREES = Unit("degrees", {"deg": 1.0, "rad": 57.29577951308232})
PIXELS = Unit("pixels", {"px": 1.0})
MEGABYTES = Unit("MB", {"MB": 1.0, "GB": 1000.0, "kB": 0.001})

Metres = Annotated[float, BeforeValidator(METRES.parse)]
Seconds = Annotated[float, BeforeValidator(SECONDS.parse)]
Degrees = Annotated[float, BeforeValidator(DEGREES.parse)]
Pixels = Annotated[float, BeforeValidator(PIXELS.parse)]
Megabytes = Annotated[float, BeforeValidator(MEGABYTES.parse)]


@dataclass(frozen=True, slots=True)
class Methods:
    """What a stage can be: one of ours, ``module:function``, a registered name, or ``topic:NAME``."""

    ours: tuple[str, ...]
    former: Mapping[str, str] = field(default_factory=dict)  # names that ours once had

    def check(self, value: str) -> str:
        value = self.former.get(value, value)
        if value in self.ours or ":" in value or value in plugins.registered():
            return value
        registered = f", {', '.join(plugins.registered())} (registered)" if plugins.registered() else ""
        raise PydanticCustomError(
            "method",
            "must be one of {ours}{registered}, module:function, or topic:/name",
            {"ours": ", ".join(self.ours), "registered": registered},
        )


GROUND = Methods(("polar", "plane"), {"ransac": "plane"})
CLUSTERING = Methods(("dbscan",))
OBJECTS = Methods(("frustum",))
OURS = ("", "demo", *GROUND.ours, *GROUND.former, *CLUSTERING.ours, *OBJECTS.ours)

BASE = "configuration"  # where values are stated that came as a whole

STAGES = {  # section -> the key that names its function
    "ground": "method",
    "clustering": "method",
    "detector": "model",
    "objects": "method",
}


class Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)


class StageSection(Section):
    """Of a stage that may be somebody else's."""

    params: Mapping[str, Any] = Field({}, description="parameters of a function that is not bevviz's own")


class SourceConfig(Section):
    """Which topics play which role. Empty: found by type, name and frame (see ``bevviz info``)."""

    dataset: str = Field("", description="data set that PATH is; empty: recognised by its folders")
    sequence: str = Field("", description="drive of a data set that has several in one folder")
    lidar_topics: tuple[str, ...] = Field(
        (), description="PointCloud2 topics; several are merged in base_frame"
    )
    camera_topics: tuple[str, ...] = Field((), description="Image or CompressedImage topics")
    camera_info_topics: Mapping[str, str] = Field({}, description="camera topic -> its CameraInfo topic")
    lidar_calibration: Mapping[str, str] = Field(
        {},
        description="topic with a LiDAR's packets -> its angles: a Hesai's CSV, an Ouster's metadata",
    )
    boxes: Mapping[str, str] = Field(
        {},
        description="topic with the robot's boxes in messages of its own, and where in them: topic, objects, "
        "center, size, orientation or yaw, label, score, id",
    )
    odometry_topic: str = Field("", description="nav_msgs/Odometry used where /tf has no fixed frame")
    base_frame: str = Field("base_link", description="frame that several LiDARs are merged in")
    fixed_frame: str = Field("", description="world frame; empty: map, odom or the like, where TF has one")
    rectified: Literal["auto", "yes", "no"] = Field(
        "auto", description="image is already free of distortion; auto: from the topic's name"
    )
    extrinsics: Mapping[str, tuple[float, float, float, float, float, float, float]] = Field(
        {}, description="'parent child' -> x y z (metres) qx qy qz qw; wins over TF"
    )


class SyncConfig(Section):
    """How images and transforms are found for a cloud."""

    tolerance: Seconds = Field(0.1, gt=0, le=10, description="largest |image stamp - cloud stamp|")
    offsets: Mapping[str, Seconds] = Field({}, description="topic -> time added to its stamps")
    by: Literal["stamp", "received"] = Field(
        "stamp", description="what tells the time of a message: its own stamp, or when it was received"
    )
    tf_tolerance: Seconds = Field(0.2, ge=0, le=60, description="how far past its samples TF is held")
    motion_compensation: bool = Field(
        True, description="move the cloud to the image's time before projection"
    )
    max_wait: Seconds = Field(0.5, gt=0, le=60, description="how long a cloud waits for its image and TF")
    queue: int = Field(10, ge=1, le=1000, description="clouds that may wait; the oldest goes on first")


class VoxelConfig(Section):
    size: Metres = Field(0.1, ge=0, le=10, description="edge of a voxel; 0 keeps every point")
    average: bool = Field(
        False, description="mean of a voxel's points (as Open3D) instead of its first point"
    )


class GroundConfig(StageSection):
    method: Annotated[str, AfterValidator(GROUND.check)] = Field(
        "polar",
        description="polar: a surface that follows slopes and kerbs outwards; plane: a single one by RANSAC; "
        "or module:function, (N, 3) points -> (N,) True where ground; or topic:/obstacle_points",
    )
    distance_threshold: Metres = Field(
        0.2, gt=0, le=5, description="height above the ground still called ground"
    )
    iterations: int = Field(
        100, ge=1, le=100_000, description="samples of three points for the (polar: first) plane"
    )
    seed: int = Field(0, ge=0, description="random seed of these samples")
    sensor_height: Metres | None = Field(
        None, description="height of points_frame above the road; empty: estimated from the cloud"
    )
    max_slope: Degrees = Field(15.0, gt=0, lt=90, description="polar: steepest ground")
    max_step: Metres = Field(0.25, gt=0, le=2, description="polar: highest step from one ring to the next")
    sectors: int = Field(180, ge=8, le=3600, description="polar: sectors around the sensor")
    max_range: Metres = Field(100.0, gt=0, le=1000, description="polar: beyond it the ground goes on level")


class ClusteringConfig(StageSection):
    method: Annotated[str, AfterValidator(CLUSTERING.check)] = Field(
        "dbscan",
        description="dbscan; or module:function, (P, 3) obstacle points -> (P,) labels, -1 noise; "
        "or topic:/clusters of the robot",
    )
    eps: Metres = Field(0.5, gt=0, le=20, description="DBSCAN neighbourhood radius")
    min_points: int = Field(
        10, ge=1, le=100_000, description="DBSCAN neighbours (itself included) of a core point"
    )
    min_cluster_points: int = Field(10, ge=1, description="smaller clusters are set aside, with the reason")
    max_cluster_points: int | None = Field(None, ge=1, description="larger ones too; empty: no limit")
    boxes: Literal["oriented", "axis_aligned"] = Field("oriented", description="box used downstream")

    @field_validator("max_cluster_points")
    @classmethod
    def _leaves_some(cls, most: int | None, info: ValidationInfo) -> int | None:
        least = info.data.get("min_cluster_points", 1)
        if most is not None and most < least:
            raise PydanticCustomError(
                "no_room",
                "must not be below clustering.min_cluster_points, which is {least}",
                {"least": least},
            )
        return most


class DetectorConfig(StageSection):
    model: str = Field(
        "",
        description="ONNX file, or 'demo' for the simulator's own network; or module:function or class, "
        "(H, W, 3) BGR -> xyxy, score, names; or topic:/detections of the robot; empty: no detector",
    )
    names: str = Field(
        "", description="file with one class name a line, coco or coco91; empty: the model's, else COCO's"
    )
    conf_threshold: float = Field(0.25, gt=0, le=1, description="lowest score of a detection")
    iou_threshold: float = Field(0.45, gt=0, le=1, description="class-wise NMS")
    explain_threshold: float = Field(0.01, gt=0, le=1, description="weaker candidates are not even explained")
    max_candidates: int = Field(
        100, ge=1, le=10_000, description="candidates kept for explanation, duplicates last"
    )
    classes: tuple[str, ...] = Field((), description="only these class names; empty: all")
    provider: str = Field(
        "auto",
        description="onnxruntime's: auto (a GPU's, where it works), CPU, CUDA, TensorRT",
    )
    threads: int = Field(0, ge=0, description="onnxruntime threads; 0: all cores")


class FusionConfig(Section):
    method: Literal["frustum", "centroid"] = Field(
        "frustum", description="frustum: points in the box's frustum; centroid: nearest 2D box centre"
    )
    match_radius: Pixels = Field(150.0, gt=0, description="centroid: largest pixel distance")
    min_points: int = Field(3, ge=1, description="frustum: fewest points of a cluster inside")
    min_iou: float = Field(0.1, ge=0, le=1, description="frustum: least IoU of 2D box and projected cluster")
    min_rating: float = Field(
        0.05, ge=0, le=1, description="frustum: least score of a detection times how well points fit it"
    )
    max_gap: Metres = Field(
        0.5, gt=0, le=20, description="frustum: what is nearer on the ground holds together in a frustum"
    )
    split: bool = Field(
        True, description="frustum: detections split and merge clusters; false: they name whole ones"
    )
    masks: bool = Field(
        True,
        description="split: points in the mask instead of the whole 2D box, where the network gives masks",
    )
    mask_margin: Pixels = Field(2.0, ge=0, le=50, description="masks: what is so near counts, too")
    max_depth: Metres = Field(120.0, gt=0, description="frustum: farther clusters are out of range")


# Mean length, width and height of a class in metres, and the spread (one sigma) of each. Means of road users
# are KITTI's (Geiger et al. 2012, as Qi et al. 2018 give them for Frustum PointNets), of what KITTI has not
# those of nuScenes (Caesar et al. 2020, as Zhu et al. 2019 give them for CBGS); truck is between them, since
# COCO calls a pickup one, too. Spreads are those of KITTI's cars (wider across: cars elsewhere are 2 m wide),
# else wider than the two sets differ. What stands below the line is our own estimate.
SIZES: dict[str, tuple[float, ...]] = {
    "car": (3.88, 1.63, 1.53, 0.43, 0.15, 0.14),
    "van": (5.07, 1.90, 2.21, 0.50, 0.15, 0.25),
    "truck": (8.50, 2.55, 3.05, 2.50, 0.25, 0.50),
    "bus": (10.50, 2.94, 3.47, 2.00, 0.25, 0.35),
    "train": (16.17, 2.53, 3.53, 6.00, 0.20, 0.30),
    "tram": (16.17, 2.53, 3.53, 6.00, 0.20, 0.30),
    "trailer": (12.29, 2.90, 3.87, 3.00, 0.30, 0.60),
    "construction_vehicle": (6.37, 2.85, 3.19, 1.60, 0.50, 0.60),
    "motorcycle": (2.11, 0.77, 1.47, 0.30, 0.15, 0.20),
    "bicycle": (1.70, 0.60, 1.28, 0.25, 0.15, 0.25),
    "cyclist": (1.76, 0.60, 1.74, 0.20, 0.12, 0.15),
    "person": (0.84, 0.66, 1.76, 0.24, 0.14, 0.14),
    "pedestrian": (0.84, 0.66, 1.76, 0.24, 0.14, 0.14),
    "person_sitting": (0.80, 0.60, 1.27, 0.20, 0.12, 0.14),
    "traffic_cone": (0.41, 0.41, 1.07, 0.10, 0.10, 0.25),
    "barrier": (2.53, 0.50, 0.98, 0.60, 0.15, 0.15),
    # ---
    "fire hydrant": (0.35, 0.35, 0.75, 0.08, 0.08, 0.12),
    "bench": (1.60, 0.60, 0.85, 0.40, 0.15, 0.15),
    "chair": (0.55, 0.55, 0.90, 0.12, 0.12, 0.15),
    "couch": (2.00, 0.90, 0.85, 0.40, 0.15, 0.15),
    "dog": (0.90, 0.35, 0.65, 0.25, 0.10, 0.18),
    "horse": (2.20, 0.60, 1.60, 0.30, 0.12, 0.20),
    "cow": (2.30, 0.75, 1.45, 0.30, 0.12, 0.15),
}


def _with_known(given: Any) -> Any:
    """What is stated changes single classes."""
    if not isinstance(given, Mapping):
        return given
    return {**SIZES, **{str(name).lower(): size for name, size in given.items()}}


def _six(given: tuple[float, ...]) -> tuple[float, ...]:
    if len(given) != 6:
        raise PydanticCustomError(
            "size",
            "has {count} numbers, a class has six: length, width, height and the spread of each",
            {"count": len(given)},
        )
    return given


ClassSize = Annotated[tuple[PositiveFloat, ...], AfterValidator(_six)]


class ObjectsConfig(StageSection):
    """What the named 3D boxes are made from."""

    method: Annotated[str, AfterValidator(OBJECTS.check)] = Field(
        "frustum",
        description="frustum: clusters that detections name; or module:function, (N, 4) points and intensity "
        "-> (K, 7) boxes x y z length width height yaw, score, names; or topic:/objects of the robot",
    )
    sizes: Annotated[Mapping[str, ClassSize | None], BeforeValidator(_with_known)] = Field(
        SIZES,
        description="frustum: by class, mean length, width, height in metres and the spread of each; "
        "a class that is stated changes alone, null: it has none",
    )


class TrackingConfig(Section):
    method: Literal["kalman", "none"] = Field(
        "kalman", description="kalman: objects keep an id, with speed and trail; none: each frame for itself"
    )
    gate: Metres = Field(1.5, gt=0, le=20, description="farthest on the ground from where it is expected")
    position_noise: Metres = Field(0.2, gt=0, le=5, description="one sigma of the centre of a box")
    acceleration: float = Field(2.0, gt=0, le=50, description="one sigma of an object's, in m/s^2")
    min_hits: int = Field(3, ge=1, le=100, description="frames with a name until a track is shown")
    max_coast: Seconds = Field(1.0, ge=0, le=60, description="a track that is unseen for longer ends")
    class_memory: Seconds = Field(1.0, gt=0, le=60, description="time that the vote of a class decays in")
    reset_after: Seconds = Field(3.0, gt=0, le=3600, description="a longer gap in the stamps ends all tracks")
    trail: Seconds = Field(3.0, ge=0, le=60, description="how far back the trails go")


class AnomaliesConfig(Section):
    """What is worth a look, frame after frame."""

    surprise: float = Field(
        8.0,
        gt=0,
        le=100,
        description="of an object, or a class, that is missed: -ln of its chance, by the object's own past",
    )
    visible: float = Field(
        0.7, ge=0, le=1, description="share of an object that nothing may hide, else it is excused"
    )
    jump: Metres = Field(1.0, gt=0, le=20, description="least of a box from where it was expected")
    alone_frames: int = Field(
        5, ge=1, le=1000, description="frames until what only one sensor sees is an anomaly"
    )
    sync_error: Seconds = Field(0.05, gt=0, description="|image stamp - cloud stamp|")
    tf_age: Seconds = Field(0.1, gt=0, description="from a stamp to the nearest transform")
    stage_time: Seconds | None = Field(None, gt=0, description="of any stage, or 'total'; empty: no limit")
    hold: Seconds = Field(1.0, ge=0, le=60, description="how long one that is over goes on being shown")


class BevConfig(Section):
    range_x: Metres = Field(40.0, gt=0, le=500, description="range ahead and behind")
    range_y: Metres = Field(40.0, gt=0, le=500, description="range to the left and right")
    resolution: Metres = Field(0.1, gt=0, le=10, description="edge of a cell")
    style: Literal["rich", "reference"] = Field(
        "rich", description="reference: the tutorial's image, pixel for pixel"
    )
    channels: tuple[Literal["density", "height", "intensity", "occupancy"], ...] = Field(
        ("occupancy",), description="rasters logged beside the image: density, height, intensity, occupancy"
    )


class LoggingConfig(Section):
    keep: Keep = Field(
        "everything",
        description="inspect: a fifth, with raw clouds now and then; report: less, without (docs/size.md)",
    )
    raw_every: int = Field(50, ge=1, description="keep=inspect: raw cloud of each N-th frame")
    raw_around: Seconds = Field(
        0.5, ge=0, le=5, description="keep=inspect: raw clouds before and after an anomaly or a change"
    )
    raw_share: float = Field(
        0.02,
        ge=0,
        le=1,
        description="keep=inspect: of all frames, those with raw clouds for that reason, at most",
    )
    jpeg_quality: int = Field(85, ge=1, le=100, description="for images that came uncompressed")
    video: Literal["stream", "images"] = Field(
        "stream", description="video as it came, or each picture as JPEG, which takes no decoder in a viewer"
    )
    raw_cloud: bool = Field(True, description="log every raw point")
    color_by: tuple[Quantity, ...] = Field(
        get_args(Quantity),
        description="with every raw point, so that the 3D view has a tab for each: "
        + ", ".join(get_args(Quantity)),
    )
    projected_points: bool = Field(True, description="log obstacle points over the image, coloured by depth")


class LiveConfig(Section):
    """How ``bevviz live`` runs beside the robot."""

    nice: int = Field(0, ge=0, le=19, description="priority given up to other processes, as nice(1)")
    max_rate: float | None = Field(None, gt=0, le=1000, description="frames a second at most; empty: all")
    every: int = Field(1, ge=1, description="run each N-th scan only")
    points: int | None = Field(None, ge=1, description="points kept of each scan; empty: all")
    log_queue: int = Field(3, ge=1, le=100, description="results that may wait to be logged; the oldest goes")
    output_queue: int = Field(20, ge=1, le=1000, description="frames that may wait for a slow disk or viewer")
    viewer_memory: Megabytes = Field(
        500.0, ge=10, description="recent past kept for a viewer that comes late (--serve)"
    )
    viewer_rate: float | None = Field(
        None, ge=1, le=100, description="frames a second that viewers get at most, files get all; empty: all"
    )
    viewer_points: int | None = Field(
        None, ge=1, description="points of each cloud that viewers get at most, files get all; empty: all"
    )
    split_size: Megabytes | None = Field(
        None, ge=1, description="--save: size that a part is closed at; empty: any"
    )
    split_time: Seconds | None = Field(
        None, ge=1, description="--save: time that a part is closed after; empty: any"
    )
    held: int = Field(
        20, ge=1, le=1000, description="newest frames that can be asked about (--workbench), 5 to 20 MB each"
    )
    flight_time: Seconds = Field(30.0, ge=0, le=3600, description="flight recorder: the last seconds; 0: off")
    flight_size: Megabytes = Field(500.0, ge=1, description="flight recorder: memory at most")
    raw_size: Megabytes = Field(
        500.0, ge=0, description="flight recorder: memory for the messages as they came, at most; 0: none"
    )
    raw_topics: Literal["roles", "small", "all"] = Field(
        "small",
        description="messages that are kept, of --save FILE.mcap too: of topics that play a role, of small "
        "ones beside them (no clouds or images, below 1 MB/s), of all",
    )
    flight_folder: str = Field("", description="where its recordings go; empty: the working directory")
    triggers: tuple[AnomalyKind, ...] = Field(
        (), description="save when such an anomaly begins: " + ", ".join(get_args(AnomalyKind))
    )
    robot_time: Seconds | None = Field(
        None,
        ge=0,
        description="--robot: save when the robot's objects and ours differ for so long; empty: never",
    )
    robot_tolerance: Metres = Field(
        0.5,
        ge=0,
        description="--robot: distance of one object's centres, seen from above, that is the same yet",
    )
    trigger_after: Seconds = Field(
        2.0, ge=0, le=600, description="that still belong to an automatic save, after its reason"
    )
    trigger_pause: Seconds = Field(60.0, ge=0, description="least time from one automatic save to the next")


class Config(Section):
    """Everything that can be set. ``bevviz config`` prints the effective one."""

    preset: Preset = "default"
    source: SourceConfig = SourceConfig()
    sync: SyncConfig = SyncConfig()
    voxel: VoxelConfig = VoxelConfig()
    ground: GroundConfig = GroundConfig()
    clustering: ClusteringConfig = ClusteringConfig()
    detector: DetectorConfig = DetectorConfig()
    fusion: FusionConfig = FusionConfig()
    objects: ObjectsConfig = ObjectsConfig()
    tracking: TrackingConfig = TrackingConfig()
    anomalies: AnomaliesConfig = AnomaliesConfig()
    bev: BevConfig = BevConfig()
    logging: LoggingConfig = LoggingConfig()
    live: LiveConfig = LiveConfig()

    _stated: Mapping[str, str] = PrivateAttr(default_factory=dict)

    @property
    def stated(self) -> Mapping[str, str]:
        """Where each dotted key was stated that was: an option, a file, a variable. It is no part of what
        two configurations have in common."""
        return self._stated

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Config) and self.__dict__ == other.__dict__

    __hash__ = None  # type: ignore[assignment]


@dataclass(frozen=True, slots=True)
class Layer:
    """Values by dotted key, and where they are stated."""

    where: str
    values: Mapping[str, Any]


REFERENCE: dict[str, dict[str, Any]] = {
    "voxel": {"size": 0.05, "average": True},
    "ground": {"method": "plane", "distance_threshold": 0.5, "iterations": 100},
    "clustering": {
        "eps": 0.5,
        "min_points": 50,
        "min_cluster_points": 1,
        "max_cluster_points": None,  # declared by the tutorial as 1000 and never applied
        "boxes": "axis_aligned",
    },
    "detector": {"conf_threshold": 0.25},
    "fusion": {"method": "centroid", "match_radius": 150.0},
    "tracking": {"method": "none"},
    "bev": {"range_x": 10.0, "range_y": 10.0, "resolution": 0.05, "style": "reference"},
    "sync": {"motion_compensation": False},
}

TUTORIAL_NAMES = {
    "voxel_size": "voxel.size",
    "ground_distance_threshold": "ground.distance_threshold",
    "cluster_tolerance": "clustering.eps",
    "min_cluster_size": "clustering.min_points",
    "max_cluster_size": "clustering.max_cluster_points",
    "conf_threshold": "detector.conf_threshold",
    "match_radius": "fusion.match_radius",
    "range_x": "bev.range_x",
    "range_y": "bev.range_y",
    "resolution": "bev.resolution",
}


def keys(config: Config | None = None) -> dict[str, str]:
    """Every dotted key with its description, in order; of a configuration, those of its plugins too."""
    found: dict[str, str] = {}
    for section, info in Config.model_fields.items():
        model = _model(section)
        if model is None:
            found[section] = info.description or ""
            continue
        for name, inner in model.model_fields.items():
            if name != "params":
                found[f"{section}.{name}"] = inner.description or ""
        if config is not None:
            found |= {
                f"{section}.params.{name}": inner.description or ""
                for name, inner in _params_of(config, section).items()
            }
    return found


def values(config: Config) -> dict[str, Any]:
    """The value of each dotted key, those of plugins included."""
    found: dict[str, Any] = {}
    for section, given in config:
        if not isinstance(given, Section):
            found[section] = given
            continue
        for name, value in given:
            if name != "params":
                found[f"{section}.{name}"] = value
            else:
                found |= {f"{section}.params.{key}": inner for key, inner in value.items()}
    return found


@dataclass(frozen=True, slots=True)
class ParameterChange:
    """Of one parameter."""

    before: Any
    after: Any

    def __str__(self) -> str:
        if not isinstance(self.before, Mapping) or not isinstance(self.after, Mapping):
            return f"{self.before} -> {self.after}"
        both = dict.fromkeys([*self.before, *self.after])
        pairs = {key: (self.before.get(key), self.after.get(key)) for key in both}
        return "; ".join(f"{key}: {old} -> {new}" for key, (old, new) in pairs.items() if old != new)


def changes(old: Config | Mapping[str, Any], new: Config | Mapping[str, Any]) -> dict[str, ParameterChange]:
    """Each dotted key that differs. Mappings are of ``flat_yaml``, perhaps of another version."""
    before, after = (values(side) if isinstance(side, Config) else side for side in (old, new))
    return {
        key: ParameterChange(before.get(key, "absent"), after.get(key, "absent"))
        for key in dict.fromkeys([*before, *after])
        if before.get(key, "absent") != after.get(key, "absent")
    }


def plugin_of(config: Config, section: str) -> plugins.Plugin | None:
    """The function of somebody else's that a stage's section names; None: it is ours, or a topic's.

    Raises:
        UserError: it cannot be had.
    """
    key = STAGES[section]
    return _plugin(section, getattr(getattr(config, section), key))


def _plugin(section: str, method: str) -> plugins.Plugin | None:
    if method in OURS or (section == "detector" and Path(method).exists()):
        return None
    name = method if ":" in method else plugins.registered().get(method, "")
    if not plugins.is_foreign(name):
        return None
    try:
        return plugins.find(name)
    except UserError as error:
        raise UserError(f"{section}.{STAGES[section]} {method}: {error}") from error.__cause__


def stage_topics(config: Config) -> dict[str, str]:
    """The robot's topics that stages are taken from, by the dotted key that names each."""
    named = {f"{s}.{key}": str(getattr(getattr(config, s), key)) for s, key in STAGES.items()}
    return {key: name.removeprefix(TOPIC) for key, name in named.items() if name.startswith(TOPIC)}


def _params_of(config: Config, section: str) -> Mapping[str, FieldInfo]:
    plugin = plugin_of(config, section) if section in STAGES else None
    return plugin.params.model_fields if plugin is not None and plugin.params is not None else {}


def load(
    file: str | Path | Sequence[Path] | None = None,
    settings: Iterable[str] = (),
    preset: Preset | None = None,
    base: Config | Mapping[str, Any] | None = None,
    layers: Iterable[Layer] = (),
) -> Config:
    """The effective configuration: preset, then the layers, the files, then each ``key=value``, later ones
    winning.

    Args:
        file: YAML files.
        settings: ``key=value`` each.
        preset: which one; None: as the files say, else ``default``.
        base: a whole configuration that all of this is to change, or its values by dotted key.
        layers: of the project, see ``bevviz.project``.

    Raises:
        UserError: unreadable file, unknown key, wrong unit or value out of range, in one line.
    """
    given: list[tuple[str, Any, str]] = []  # key, value, and where it was stated
    if base is not None:
        stated_there = values(base) if isinstance(base, Config) else base
        given += [(key, value, BASE) for key, value in stated_there.items()]
    files = [Path(file)] if isinstance(file, str | Path) else file or ()
    for layer in (*layers, *map(read_layer, files)):
        given += [(key, value, layer.where) for key, value in layer.values.items()]
    for text in settings:
        key, sep, value = text.partition("=")
        if not sep:
            raise UserError(f"--set {text}: expected key=value, for example --set clustering.eps=0.6")
        parsed = _yaml_value(value, f"--set {text}") if value.strip() else ""
        if isinstance(parsed, int) and _is_text(key.strip()):  # 0001 is a name
            parsed = value.strip()
        given.append((key.strip(), parsed, f"--set {text}"))
    given = [(TUTORIAL_NAMES.get(key, key), value, where) for key, value, where in given]
    chosen = preset or next((value for key, value, _ in reversed(given) if key == "preset"), "default")
    of_preset = flattened(REFERENCE) if chosen == "reference" else {}
    stated: dict[str, Any] = {}
    origin: dict[str, str] = {}
    for key, value, where in given:
        section, _, name = key.partition(".")
        if name == STAGES.get(section) and stated.get(key, value) != value:  # not the parameters of this one
            stated = {k: v for k, v in stated.items() if not k.startswith(f"{section}.params.")}
        stated[key], origin[key] = value, where
    params = _params({**of_preset, **stated}, origin)
    known = [*keys(), *params]
    tree: dict[str, Any] = {"preset": chosen}
    for key, value in {**of_preset, **stated}.items():
        full = key
        if key not in known:
            section, _, name = key.partition(".")
            full = f"{section}.params.{name}"
            if full not in params:
                raise UserError(f"{origin[key]}: {unknown_key(key, known)}")
            origin[full] = origin[key]
        if full != "preset":
            _insert(tree, full, value)
    try:
        for section, model in _param_models(tree):
            prefix = f"{section}.params."
            tree[section]["params"] = model.model_validate(tree[section].get("params", {})).model_dump(
                mode="json"
            )
        prefix = ""
        made = Config.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        loc = (*prefix.split(".")[:-1], *first["loc"])
        key = next((k for k in _prefixes(loc) if k in origin), ".".join(map(str, loc)))
        where = origin.get(key, BASE)
        silent = first["type"] in ("wrong_unit", "missing")
        value = f" (given: {first['input']!r})" if not silent else ""
        about = keys().get(key) or params.get(key, "")
        hint = f"; it is: {about}" if about else ""
        stated_unit = f", in {unit(key)}" if unit(key) and not silent else ""
        raise UserError(f"{where}: {key} {_lower(first['msg'])}{stated_unit}{value}{hint}") from None
    before = base.stated if isinstance(base, Config) else {}
    made._stated = {**before, **{key: where for key, where in origin.items() if where != BASE}}
    return made


def _is_text(key: str) -> bool:
    """Whether a parameter is a text, whatever is in it."""
    section, _, name = key.partition(".")
    model = Config.model_fields[section].annotation if section in Config.model_fields else None
    return name in getattr(model, "model_fields", {}) and model.model_fields[name].annotation is str  # type: ignore[union-attr]


def _params(stated: Mapping[str, Any], origin: Mapping[str, str]) -> dict[str, str]:
    """Dotted keys and descriptions of the parameters of the plugins that are named."""
    found: dict[str, str] = {}
    for section, key in STAGES.items():
        method = stated.get(f"{section}.{key}")
        if not isinstance(method, str):
            continue
        try:
            plugin = _plugin(section, method)
        except UserError as error:
            raise UserError(f"{origin[f'{section}.{key}']}: {error}") from error.__cause__
        if plugin is not None and plugin.params is not None:
            fields = plugin.params.model_fields
            found |= {f"{section}.params.{name}": info.description or "" for name, info in fields.items()}
    return found


def _param_models(tree: Mapping[str, Any]) -> Iterator[tuple[str, type[BaseModel]]]:
    """The sections whose functions have parameters of their own, with the model of these."""
    for section, key in STAGES.items():
        plugin = _plugin(section, str(tree.get(section, {}).get(key, "")))
        if plugin is not None and plugin.params is not None:
            yield section, plugin.params


def dump(config: Config) -> str:
    """The configuration as YAML with each parameter's unit and meaning, readable back by ``load``."""
    about = keys(config)
    lines = []
    for section, content in config.model_dump(mode="json").items():
        if not isinstance(content, dict):
            lines.append(f"{section}: {json.dumps(content)}")
            continue
        lines.append(f"{section}:")
        params = content.pop("params", {})
        for name, value in content.items():
            note = _note(f"{section}.{name}", about)
            if isinstance(value, dict) and value:
                lines.append(f"  {name}:{note}")
                lines += [f"    {json.dumps(key)}: {json.dumps(inner)}" for key, inner in value.items()]
            else:
                lines.append(f"  {name}: {json.dumps(value)}{note}")
        if params:
            lines.append("  params:")
        for name, value in params.items():
            lines.append(f"    {name}: {json.dumps(value)}{_note(f'{section}.params.{name}', about)}")
    return "\n".join(lines) + "\n"


def stated_lines(config: Config, *, folders: bool = True) -> list[str]:
    """For each place that states parameters one line, with their names: ``bevviz.toml: clustering.eps``."""
    found: dict[str, list[str]] = {}
    for key, where in config.stated.items():
        place = "command line" if where.startswith("--") else where if folders else Path(where).name
        found.setdefault(place, []).append(key)
    return [f"{place}: {', '.join(names)}" for place, names in found.items()]


def _note(key: str, about: Mapping[str, str]) -> str:
    text = (f"in {unit(key)}; " if unit(key) else "") + about.get(key, "")
    return f"  # {text}" if text else ""


def revised(config: Config, settings: Iterable[str]) -> Config:
    """The configuration with other values, ``key=value`` each.

    Raises:
        UserError: as ``load``.
    """
    return load(settings=settings, base=config)


def flat_yaml(text: str, where: str) -> dict[str, Any]:
    """Dotted keys and values of what ``dump`` has written, by this version or another.

    Raises:
        UserError: no YAML; ``where`` says whose.
    """
    return flattened(_yaml_value(text, where) or {})


def _lower(message: str) -> str:
    message = message.replace("Input should be", "must be")
    return message[0].lower() + message[1:]


def unit(key: str) -> str:
    """Name of the unit that the value of a dotted key is in; empty where it has none."""
    found = _unit(key)
    return found.name if found is not None else ""


def unit_spellings(key: str) -> tuple[str, ...]:
    """Units that the value of a dotted key may be given in, e.g. m, cm and mm."""
    found = _unit(key)
    return tuple(found.factors) if found is not None else ()


def _unit(key: str) -> Unit | None:
    section, _, name = key.partition(".")
    model = _model(section)
    if model is None or name not in model.model_fields:
        return None
    info = model.model_fields[name]
    # An optional quantity carries its unit inside the union.
    inner = [extra for part in get_args(info.annotation) for extra in getattr(part, "__metadata__", ())]
    for extra in [*info.metadata, *inner]:
        owner = getattr(getattr(extra, "func", None), "__self__", None)
        if isinstance(owner, Unit):
            return owner
    return None


def _model(section: str) -> type[BaseModel] | None:
    """Of a section; None: there is none of that name, or it is a value."""
    model = Config.model_fields[section].annotation if section in Config.model_fields else None
    return model if isinstance(model, type) and issubclass(model, BaseModel) else None


def _prefixes(loc: tuple[int | str, ...]) -> Iterable[str]:
    for end in range(len(loc), 0, -1):
        yield ".".join(map(str, loc[:end]))


def _insert(tree: dict[str, Any], key: str, value: Any) -> None:
    *path, last = key.split(".")
    for part in path:
        tree = tree.setdefault(part, {})
    tree[last] = value


def unknown_key(key: str, known: Sequence[str]) -> str:
    """That there is no such key, with the nearest of the ``known`` ones."""
    choices = {k.replace(".params.", "."): k for k in [*known, *TUTORIAL_NAMES]}
    by_last = [k for k in choices if k.rsplit(".", 1)[-1] == key.rsplit(".", 1)[-1]]
    near = by_last or difflib.get_close_matches(key.replace(".params.", "."), choices, 1, 0.3)
    hint = f"; did you mean '{choices[near[0]]}'?" if near else ""
    return f"unknown key '{key}'{hint} ('bevviz config' lists all)"


def flattened(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted keys of a tree of sections. What is deeper is a value, but for the parameters of plugins."""
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        if name not in Config.model_fields or name == "preset" or not isinstance(value, Mapping):
            flat[str(name)] = value
            continue
        for inner, content in value.items():
            if inner == "params" and isinstance(content, Mapping):
                flat.update({f"{name}.params.{key}": v for key, v in content.items()})
            else:
                flat[f"{name}.{inner}"] = content
    return flat


def read_layer(path: Path) -> Layer:
    """What a YAML file states.

    Raises:
        UserError: it cannot be read.
    """
    return Layer(str(path), flattened(_read_yaml(path)))


def _read_yaml(path: Path) -> Mapping[str, Any]:
    try:
        if path.is_fifo() and path.parts[1:2] not in (("dev",), ("proc",)):  # <(...) of a shell is welcome
            raise UserError(f"{path}: cannot read the configuration: it is no file")
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(f"{path}: cannot read the configuration: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: is no UTF-8 text: {error.reason} at byte {error.start}") from None
    tree = _yaml_value(text, str(path))
    if tree is None:
        return {}
    if not isinstance(tree, Mapping):
        raise UserError(f"{path}: expected 'section: {{key: value}}' lines, as 'bevviz config' prints them")
    return tree


def _yaml_value(text: str, where: str) -> Any:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        return YAML(typ="safe", pure=True).load(text)
    except YAMLError as error:
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        mark = getattr(error, "problem_mark", None)
        line = f" line {mark.line + 1}" if mark else ""
        raise UserError(f"{where}:{line} is not valid YAML: {problem}") from None
    except RecursionError:
        raise UserError(f"{where}: is not valid YAML for a configuration: too deep") from None
    except (ValueError, OverflowError) as error:  # a date that is none
        raise UserError(f"{where}: is not valid YAML: {error}") from None
