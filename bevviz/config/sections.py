"""Parameters as pydantic models: one section for each part of the pipeline."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationInfo,
    field_validator,
)
from pydantic_core import PydanticCustomError

from bevviz.config.module_folder import ModuleFolder
from bevviz.config.value_types import (
    CLASS_SIZES,
    CLUSTERING,
    GROUND,
    OBJECTS,
    ClassSize,
    Degrees,
    Megabytes,
    Metres,
    Pixels,
    Seconds,
    with_default_sizes,
)
from bevviz.support.limits import MAX_SENSORS, MAX_SETTINGS

MAX_SIDE = 65_500  # pixels of a bird's-eye image: the JPEG encoder takes no more
MAX_CELLS = 300_000_000  # cells of a bird's-eye image: 0.9 GB of pixels

Preset = Literal["default", "reference"]
Functions = Mapping[tuple[str, str], ModuleFolder]  # (section, module:function) -> folder of the module
Keep = Literal["everything", "inspect", "report"]
Quantity = Literal["height", "intensity", "ring", "time", "distance"]  # values of a point that can colour it


class Section(BaseModel):
    """Base class of all sections: immutable, without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)


class StageSection(Section):
    """Base class of the settings of a stage that can be user-defined."""

    params: Mapping[str, Any] = Field({}, description="parameters of a function that is not bevviz's own")


class SourceConfig(Section):
    """Roles of the topics. An empty value is found by type, name and frame (see ``bevviz info``)."""

    dataset: str = Field("", description="data set that PATH is; empty: recognised by its folders")
    sequence: str = Field("", description="drive of a data set that has several in one folder")
    lidar_topics: tuple[str, ...] = Field(
        (),
        max_length=MAX_SENSORS,
        description="PointCloud2 or LaserScan topics; several are merged in base_frame",
    )
    camera_topics: tuple[str, ...] = Field(
        (), max_length=MAX_SENSORS, description="Image or CompressedImage topics"
    )
    camera_info_topics: Mapping[str, str] = Field(
        {}, max_length=MAX_SENSORS, description="camera topic -> its CameraInfo topic"
    )
    lidar_calibration: Mapping[str, str] = Field(
        {},
        max_length=MAX_SENSORS,
        description="topic with a LiDAR's packets -> its angles: a Hesai's CSV, an Ouster's metadata",
    )
    boxes: Mapping[str, str] = Field(
        {},
        description="topic with the robot's boxes in messages of its own, and where in them: topic, objects, "
        "center, size, orientation or yaw, label, score, id",
    )
    results: Mapping[str, str] = Field(
        {},
        max_length=MAX_SENSORS,
        description="name -> file with a detector's results, which appear on the topic /results/NAME",
    )
    labels: Mapping[str, tuple[str, ...]] = Field(
        {},
        max_length=MAX_SETTINGS,
        description="label of the ground truth -> right names of its objects, in place of the known ones; "
        "[]: none has to be found, and an object on one is neither right nor wrong",
    )
    frames: Mapping[str, str] = Field(
        {},
        max_length=MAX_SETTINGS,
        description="camera or LiDAR topic -> frame of its messages, in place of the one that they state",
    )
    odometry_topic: str = Field("", description="nav_msgs/Odometry used where /tf has no fixed frame")
    base_frame: str = Field("base_link", description="frame that several LiDARs are merged in")
    fixed_frame: str = Field("", description="world frame; empty: map, odom or the like, where TF has one")
    rectified: Literal["auto", "yes", "no"] = Field(
        "auto", description="image is already free of distortion; auto: from the topic's name"
    )
    extrinsics: Mapping[str, tuple[float, float, float, float, float, float, float]] = Field(
        {}, max_length=MAX_SETTINGS, description="'parent child' -> x y z (metres) qx qy qz qw; wins over TF"
    )


class SyncConfig(Section):
    """Settings of the search for the images and transforms of a cloud."""

    tolerance: Seconds = Field(0.1, gt=0, le=10, description="largest |image stamp - cloud stamp|")
    offsets: Mapping[str, Seconds] = Field(
        {}, max_length=MAX_SETTINGS, description="topic -> time added to its stamps"
    )
    by: Literal["stamp", "received"] = Field(
        "stamp", description="time of a message: its own stamp, or the time of receipt"
    )
    tf_tolerance: Seconds = Field(0.2, ge=0, le=60, description="how far past its samples TF is held")
    motion_compensation: bool = Field(
        True, description="move the cloud to the image's time before projection"
    )
    max_wait: Seconds = Field(0.5, gt=0, le=60, description="how long a cloud waits for its image and TF")
    queue: int = Field(10, ge=1, le=1000, description="clouds that may wait; the oldest goes on first")


class VoxelConfig(Section):
    """Settings of the voxel grid."""

    size: Metres = Field(0.1, ge=0, le=10, description="edge of a voxel; 0 keeps every point")
    average: bool = Field(
        False, description="mean of a voxel's points (as Open3D) instead of its first point"
    )


class GroundConfig(StageSection):
    """Settings of the ground segmentation."""

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
    """Settings of the clustering."""

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
    def _leaves_some(cls, max_points: int | None, info: ValidationInfo) -> int | None:
        """Check that the largest allowed cluster is not smaller than the smallest."""
        min_points = info.data.get("min_cluster_points", 1)
        if max_points is not None and max_points < min_points:
            raise PydanticCustomError(
                "no_room",
                "must not be below clustering.min_cluster_points, which is {least}",
                {"least": min_points},
            )
        return max_points


class DetectorConfig(StageSection):
    """Settings of the 2D detector."""

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
    classes: tuple[str, ...] = Field(
        (), max_length=MAX_SETTINGS, description="only these class names; empty: all"
    )
    provider: str = Field(
        "auto", description="onnxruntime's: auto (a GPU's, where it works), CPU, CUDA, TensorRT"
    )
    threads: int = Field(0, ge=0, description="onnxruntime threads; 0: all cores")


class FusionConfig(Section):
    """Settings of the matching of detections and clusters."""

    method: Literal["frustum", "centroid"] = Field(
        "frustum", description="frustum: points in the box's frustum; centroid: nearest 2D box centre"
    )
    match_radius: Pixels = Field(150.0, gt=0, description="centroid: largest pixel distance")
    min_points: int = Field(3, ge=1, description="frustum: fewest points of a cluster inside")
    min_iou: float = Field(0.1, ge=0, le=1, description="frustum: least IoU of 2D box and projected cluster")
    min_rating: float = Field(
        0.06, ge=0, le=1, description="frustum: least score of a detection times how well points fit it"
    )
    max_gap: Metres = Field(
        0.5, gt=0, le=20, description="frustum: points nearer to each other on the ground stay together"
    )
    split: bool = Field(
        True, description="frustum: detections split and merge clusters; false: they name whole ones"
    )
    masks: bool = Field(
        True,
        description="split: points in the mask instead of the whole 2D box, where the network gives masks",
    )
    mask_margin: Pixels = Field(
        2.0, ge=0, le=50, description="masks: points this near to a mask count as inside"
    )
    max_depth: Metres = Field(120.0, gt=0, description="frustum: farther clusters are out of range")


class ObjectsConfig(StageSection):
    """Settings of the method that makes the named 3D boxes."""

    method: Annotated[str, AfterValidator(OBJECTS.check)] = Field(
        "frustum",
        description="frustum: clusters that detections name; or a file that a registered stage reads; or "
        "module:function, (N, 4) points and intensity -> (K, 7) boxes x y z length width height yaw, score, "
        "names; or topic:/objects of the robot",
    )
    sizes: Annotated[Mapping[str, ClassSize | None], BeforeValidator(with_default_sizes)] = Field(
        CLASS_SIZES,
        description="frustum: by class, mean length, width, height in metres and the spread of each, "
        "six more numbers for each further size; "
        "a class that is stated changes alone, null: it has none",
    )


class OpinionsConfig(Section):
    """Limits for cameras that confirm or contradict objects of a 3D detector or of the robot."""

    min_iou: float = Field(
        0.3,
        gt=0,
        le=1,
        description="least IoU in the image for a detection without a cluster to belong to a box",
    )
    min_shown: float = Field(
        0.5, ge=0, le=1, description="least share of a box in the image for a camera to contradict it"
    )
    min_visible: float = Field(
        0.5,
        ge=0,
        le=1,
        description="least share of a box that nothing nearer hides for a camera to contradict it, or for a "
        "detection without a cluster to be of it",
    )
    min_height: Pixels = Field(
        25.0, ge=0, description="least height of a box in the image for a camera to contradict it"
    )


class OdometryConfig(Section):
    """Settings of the estimate of the robot's motion."""

    method: Literal["auto", "kiss_icp", "none"] = Field(
        "auto",
        description="kiss_icp: estimate the motion from the scans of a drive; auto: if nothing else states "
        "it; none: never, as in live runs",
    )


class TrackingConfig(Section):
    """Settings of the tracker."""

    method: Literal["kalman", "none"] = Field(
        "kalman", description="kalman: objects keep an id, with speed and trail; none: each frame for itself"
    )
    gate: Metres = Field(
        1.5,
        gt=0,
        le=20,
        description="farthest on the ground from the expected place; tracks of 3 m or more also follow boxes "
        "that they overlap",
    )
    position_noise: Metres = Field(0.2, gt=0, le=5, description="one sigma of the centre of a box")
    acceleration: float = Field(
        2.0, gt=0, le=50, description="one sigma of an object's acceleration, in m/s^2"
    )
    min_hits: int = Field(
        3,
        ge=1,
        le=100,
        description="frames with a name until a track is shown, or frames in the box of an older one until "
        "it is hidden",
    )
    max_coast: Seconds = Field(1.0, ge=0, le=60, description="a track that is unseen for longer ends")
    class_memory: Seconds = Field(1.0, gt=0, le=60, description="time that the vote of a class decays in")
    reset_after: Seconds = Field(3.0, gt=0, le=3600, description="a longer gap in the stamps ends all tracks")
    trail: Seconds = Field(3.0, ge=0, le=60, description="how far back the trails go")


AnomalyKind = Literal["flicker", "jump", "one_sensor", "sensor", "sync", "tf", "stage"]


class AnomaliesConfig(Section):
    """Limits of the search for anomalies in consecutive frames."""

    surprise: float = Field(
        8.0,
        gt=0,
        le=100,
        description="least surprise of a missed object or class: -ln of its chance, by the object's own past",
    )
    visible: float = Field(
        0.7, ge=0, le=1, description="least visible share of an object whose miss is an anomaly"
    )
    jump: Metres = Field(1.0, gt=0, le=20, description="least distance of a box from its expected place")
    alone_frames: int = Field(
        5, ge=1, le=1000, description="frames until an object that only one sensor sees is an anomaly"
    )
    sync_error: Seconds = Field(0.05, gt=0, description="largest |image stamp - cloud stamp|")
    tf_age: Seconds = Field(0.1, gt=0, description="longest time from a stamp to the nearest transform")
    stage_time: Seconds | None = Field(
        None, gt=0, description="longest time of any stage, or 'total'; empty: no limit"
    )
    hold: Seconds = Field(1.0, ge=0, le=60, description="how long an anomaly stays visible after its end")


class BevConfig(Section):
    """Settings of the bird's-eye view."""

    range_x: Metres = Field(40.0, gt=0, le=500, description="range ahead and behind")
    range_y: Metres = Field(40.0, gt=0, le=500, description="range to the left and right")
    resolution: Metres = Field(0.1, gt=0, le=10, description="edge of a cell")
    style: Literal["rich", "reference"] = Field(
        "rich", description="reference: the tutorial's image, pixel for pixel"
    )
    channels: tuple[Literal["density", "height", "intensity", "occupancy"], ...] = Field(
        ("occupancy",), description="rasters logged beside the image: density, height, intensity, occupancy"
    )

    @field_validator("resolution")
    @classmethod
    def _fits_an_image(cls, resolution: float, info: ValidationInfo) -> float:
        """Check that the image can be encoded and fits into memory."""
        rows, columns = (int(2 * info.data.get(key, 40.0) / resolution) for key in ("range_x", "range_y"))
        if not (min(rows, columns) > 0 and max(rows, columns) <= MAX_SIDE and rows * columns <= MAX_CELLS):
            raise PydanticCustomError(
                "no_image",
                "must leave 1 to {side} cells a side and at most {cells} million in all, "
                "not {rows} x {columns}",
                {"side": MAX_SIDE, "cells": MAX_CELLS // 1_000_000, "rows": rows, "columns": columns},
            )
        return resolution


class LoggingConfig(Section):
    """Amount and form of the logged data."""

    keep: Keep = Field(
        "everything",
        description="inspect: a fifth, with some raw clouds; report: less, without (docs/recordings.md)",
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


class StoreConfig(Section):
    """Settings of the store of results, which commands share."""

    size: Megabytes = Field(
        10_000.0,
        ge=0,
        description="disk space for detections of images and results of stages, which no command makes "
        "twice; the least recently used go first; 0: none are kept",
    )


class LiveConfig(Section):
    """Settings of ``bevviz live``, which runs beside the robot."""

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
        0.5, ge=0, description="--robot: largest distance of the two centres of one object, seen from above"
    )
    trigger_after: Seconds = Field(
        2.0, ge=0, le=600, description="time after its trigger that an automatic save includes"
    )
    trigger_pause: Seconds = Field(60.0, ge=0, description="least time from one automatic save to the next")


class Config(Section):
    """All parameters. ``bevviz config`` prints the effective configuration."""

    preset: Preset = "default"
    source: SourceConfig = SourceConfig()
    sync: SyncConfig = SyncConfig()
    voxel: VoxelConfig = VoxelConfig()
    ground: GroundConfig = GroundConfig()
    clustering: ClusteringConfig = ClusteringConfig()
    detector: DetectorConfig = DetectorConfig()
    fusion: FusionConfig = FusionConfig()
    objects: ObjectsConfig = ObjectsConfig()
    opinions: OpinionsConfig = OpinionsConfig()
    odometry: OdometryConfig = OdometryConfig()
    tracking: TrackingConfig = TrackingConfig()
    anomalies: AnomaliesConfig = AnomaliesConfig()
    bev: BevConfig = BevConfig()
    logging: LoggingConfig = LoggingConfig()
    store: StoreConfig = StoreConfig()
    live: LiveConfig = LiveConfig()

    _stated: Mapping[str, str] = PrivateAttr(default_factory=dict)
    _functions: Functions = PrivateAttr(default_factory=dict)

    @property
    def stated(self) -> Mapping[str, str]:
        """Source of each dotted key that was stated: an option, a file or a variable.

        Comparisons of two configurations ignore it.
        """
        return self._stated

    @property
    def functions(self) -> Functions:
        """Functions that the user has named or trusted, with the folder of each module. ``load`` sets them.

        No other function is imported.
        """
        return self._functions

    def restated(self, tree: Mapping[str, Any]) -> Config:
        """Return a configuration with the values of a tree, which may run the same functions.

        Raises:
            ValidationError: of pydantic.
        """
        config = Config.model_validate(tree)
        config._functions = self._functions
        return config

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Config) and self.__dict__ == other.__dict__

    __hash__ = None  # type: ignore[assignment]
