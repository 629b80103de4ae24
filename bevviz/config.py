"""The whole configuration: pydantic models with units, two presets, YAML files and ``key=value`` settings.

``default`` is the better method at every stage, ``reference`` is what the ROS 2 tutorial pipeline
computes. The tutorial's own parameter names (``cluster_tolerance`` ...) are accepted everywhere.
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic_core import PydanticCustomError

from bevviz.errors import UserError
from bevviz.frame import AnomalyKind

Preset = Literal["default", "reference"]


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


class Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)


class SourceConfig(Section):
    """Which topics play which role. Empty: found by type, name and frame (see ``bevviz info``)."""

    lidar_topics: tuple[str, ...] = Field(
        (), description="PointCloud2 topics; several are merged in base_frame"
    )
    camera_topics: tuple[str, ...] = Field((), description="Image or CompressedImage topics")
    camera_info_topics: Mapping[str, str] = Field({}, description="camera topic -> its CameraInfo topic")
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


class GroundConfig(Section):
    method: Literal["polar", "ransac"] = Field(
        "polar", description="polar: a surface that follows slopes and kerbs outwards; ransac: one plane"
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


class ClusteringConfig(Section):
    eps: Metres = Field(0.5, gt=0, le=20, description="DBSCAN neighbourhood radius")
    min_points: int = Field(
        10, ge=1, le=100_000, description="DBSCAN neighbours (itself included) of a core point"
    )
    min_cluster_points: int = Field(10, ge=1, description="smaller clusters are set aside, with the reason")
    max_cluster_points: int | None = Field(None, ge=1, description="larger ones too; empty: no limit")
    boxes: Literal["oriented", "axis_aligned"] = Field("oriented", description="box used downstream")


class DetectorConfig(Section):
    model: str = Field(
        "", description="ONNX file, or 'demo' for the simulator's own network; empty: no detector"
    )
    names: str = Field(
        "", description="file with one class name a line; empty: the model's metadata, else COCO"
    )
    conf_threshold: float = Field(0.25, gt=0, le=1, description="lowest score of a detection")
    iou_threshold: float = Field(0.45, gt=0, le=1, description="class-wise NMS")
    explain_threshold: float = Field(0.01, gt=0, le=1, description="weaker candidates are not even explained")
    max_candidates: int = Field(
        100, ge=1, le=10_000, description="candidates kept for explanation, duplicates last"
    )
    classes: tuple[str, ...] = Field((), description="only these class names; empty: all")
    provider: str = Field("auto", description="onnxruntime execution provider, e.g. CPU, CUDA, TensorRT")
    threads: int = Field(0, ge=0, description="onnxruntime threads; 0: all cores")


class FusionConfig(Section):
    method: Literal["frustum", "centroid"] = Field(
        "frustum", description="frustum: points in the box's frustum; centroid: nearest 2D box centre"
    )
    match_radius: Pixels = Field(150.0, gt=0, description="centroid: largest pixel distance")
    min_points: int = Field(3, ge=1, description="frustum: fewest points of a cluster inside")
    min_iou: float = Field(0.1, ge=0, le=1, description="frustum: least IoU of 2D box and projected cluster")
    max_depth: Metres = Field(120.0, gt=0, description="frustum: farther clusters are out of range")


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

    flicker_frames: int = Field(
        5, ge=1, le=1000, description="longest gap, in frames, after as many frames with the object"
    )
    jump: Metres = Field(
        1.0, gt=0, le=20, description="of a box from where it was expected, or of its longer side"
    )
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
    jpeg_quality: int = Field(85, ge=1, le=100, description="for images that came uncompressed")
    raw_cloud: bool = Field(True, description="log every raw point")
    projected_points: bool = Field(True, description="log obstacle points over the image, coloured by depth")


class LiveConfig(Section):
    """How ``bevviz live`` runs beside the robot."""

    nice: int = Field(0, ge=0, le=19, description="priority given up to other processes, as nice(1)")
    max_rate: float | None = Field(None, gt=0, le=1000, description="frames a second at most; empty: all")
    every: int = Field(1, ge=1, description="run each N-th scan only")
    points: int | None = Field(None, ge=1, description="points kept of each scan; empty: all")
    log_queue: int = Field(2, ge=1, le=100, description="results that may wait to be logged; the oldest goes")
    output_queue: int = Field(20, ge=1, le=1000, description="frames that may wait for a slow disk or viewer")
    viewer_memory: Megabytes = Field(
        500.0, ge=10, description="recent past kept for a viewer that comes late (--serve)"
    )
    split_size: Megabytes | None = Field(
        None, ge=1, description="--save: size that a part is closed at; empty: any"
    )
    split_time: Seconds | None = Field(
        None, ge=1, description="--save: time that a part is closed after; empty: any"
    )
    flight_time: Seconds = Field(30.0, ge=0, le=3600, description="flight recorder: the last seconds; 0: off")
    flight_size: Megabytes = Field(500.0, ge=1, description="flight recorder: memory at most")
    flight_folder: str = Field("", description="where its recordings go; empty: the working directory")
    triggers: tuple[AnomalyKind, ...] = Field(
        (), description="save when such an anomaly begins: " + ", ".join(get_args(AnomalyKind))
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
    tracking: TrackingConfig = TrackingConfig()
    anomalies: AnomaliesConfig = AnomaliesConfig()
    bev: BevConfig = BevConfig()
    logging: LoggingConfig = LoggingConfig()
    live: LiveConfig = LiveConfig()


REFERENCE: dict[str, dict[str, Any]] = {
    "voxel": {"size": 0.05, "average": True},
    "ground": {"method": "ransac", "distance_threshold": 0.5, "iterations": 100},
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


def keys(model: type[BaseModel] = Config, prefix: str = "") -> dict[str, str]:
    """Every dotted key with its description, in order."""
    found: dict[str, str] = {}
    for name, info in model.model_fields.items():
        inner = info.annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            found.update(keys(inner, f"{prefix}{name}."))
        else:
            found[prefix + name] = info.description or ""
    return found


def load(
    file: str | Path | Sequence[Path] | None = None,
    settings: Iterable[str] = (),
    preset: Preset | None = None,
) -> Config:
    """The effective configuration: preset, then the files, then each ``key=value``, later ones winning.

    Raises:
        UserError: unreadable file, unknown key, wrong unit or value out of range, in one line.
    """
    stated: dict[str, Any] = {}
    origin: dict[str, str] = {}
    files = [Path(file)] if isinstance(file, str | Path) else file or ()
    for path in files:
        for key, value in _flatten(_read_yaml(path)).items():
            _put(stated, origin, key, value, str(path))
    for text in settings:
        key, sep, value = text.partition("=")
        if not sep:
            raise UserError(f"--set {text}: expected key=value, for example --set clustering.eps=0.6")
        parsed = _yaml_value(value, f"--set {text}") if value.strip() else ""
        _put(stated, origin, key.strip(), parsed, f"--set {text}")
    chosen = preset or stated.get("preset", "default")
    tree: dict[str, Any] = {"preset": chosen}
    base = _flatten(REFERENCE) if chosen == "reference" else {}
    for key, value in {**base, **stated}.items():
        if key != "preset":
            _insert(tree, key, value)
    try:
        return Config.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        key = next((k for k in _prefixes(first["loc"]) if k in origin), ".".join(map(str, first["loc"])))
        where = origin.get(key, "configuration")
        given = f" (given: {first['input']!r})" if first["type"] != "wrong_unit" else ""
        about = keys().get(key, "")
        hint = f"; it is: {about}" if about else ""
        unit = f", in {_unit(key)}" if _unit(key) and first["type"] != "wrong_unit" else ""
        raise UserError(f"{where}: {key} {_lower(first['msg'])}{unit}{given}{hint}") from None


def dump(config: Config) -> str:
    """The configuration as YAML with each parameter's unit and meaning, readable back by ``load``."""
    about = keys()
    lines = []
    for section, values in config.model_dump(mode="json").items():
        if not isinstance(values, dict):
            lines.append(f"{section}: {json.dumps(values)}")
            continue
        lines.append(f"{section}:")
        for name, value in values.items():
            unit = _unit(f"{section}.{name}")
            note = (f"in {unit}; " if unit else "") + about[f"{section}.{name}"]
            lines.append(f"  {name}: {json.dumps(value)}  # {note}")
    return "\n".join(lines) + "\n"


def flat_yaml(text: str, where: str) -> dict[str, Any]:
    """Dotted keys and values of what ``dump`` has written, by this version or another.

    Raises:
        UserError: no YAML; ``where`` says whose.
    """
    return _flatten(_yaml_value(text, where) or {})


def _lower(message: str) -> str:
    message = message.replace("Input should be", "must be")
    return message[0].lower() + message[1:]


def _unit(key: str) -> str:
    """Name of the unit that the value of a dotted key is in; empty where it has none."""
    section, _, name = key.partition(".")
    model = Config.model_fields[section].annotation if section in Config.model_fields else None
    if not (isinstance(model, type) and issubclass(model, BaseModel)) or name not in model.model_fields:
        return ""
    info = model.model_fields[name]
    # An optional quantity carries its unit inside the union.
    inner = [extra for part in get_args(info.annotation) for extra in getattr(part, "__metadata__", ())]
    for extra in [*info.metadata, *inner]:
        owner = getattr(getattr(extra, "func", None), "__self__", None)
        if isinstance(owner, Unit):
            return owner.name
    return ""


def _prefixes(loc: tuple[int | str, ...]) -> Iterable[str]:
    for end in range(len(loc), 0, -1):
        yield ".".join(map(str, loc[:end]))


def _insert(tree: dict[str, Any], key: str, value: Any) -> None:
    *path, last = key.split(".", 1)
    for part in path:
        tree = tree.setdefault(part, {})
    tree[last] = value


def _put(stated: dict[str, Any], origin: dict[str, str], key: str, value: Any, where: str) -> None:
    known = keys()
    full = TUTORIAL_NAMES.get(key, key)
    if full not in known:
        choices = [*known, *TUTORIAL_NAMES]
        by_last = [k for k in choices if k.rsplit(".", 1)[-1] == key.rsplit(".", 1)[-1]]
        near = by_last or difflib.get_close_matches(key, choices, 1, 0.3)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        raise UserError(f"{where}: unknown key '{key}'{hint} ('bevviz config' lists all)")
    stated[full] = value
    origin[full] = where


def _flatten(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted keys of a two-level tree. What is deeper is a value."""
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        if name in Config.model_fields and name != "preset" and isinstance(value, Mapping):
            flat.update({f"{name}.{inner}": v for inner, v in value.items()})
        else:
            flat[str(name)] = value
    return flat


def _read_yaml(path: Path) -> Mapping[str, Any]:
    try:
        text = path.read_text()
    except OSError as error:
        raise UserError(f"{path}: cannot read the configuration: {error.strerror}") from None
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
