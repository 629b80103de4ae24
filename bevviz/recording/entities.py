"""Entity paths, timelines and class ids of a recording (listed in docs/reference.md)."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from enum import IntEnum
from functools import lru_cache
from typing import Self

from bevviz.model.results import ClusterState, DetectionState

# --- timelines ---------------------------------------------------------------------------------

STAMP = "stamp"  # sensor time, from the header of the cloud
TRIED = "tried"  # sensor time, for results with tried values in bevviz open
FRAME = "frame"  # sequence number of the frame
REPORTED = "report"  # sequence number of the frame, up to the frame that a bug report is about
RECEIVED = "received"  # when the cloud was received, or logged into the bag

TIME_TOLERANCE = 1000  # nanoseconds of tolerance for times from a viewer, which counts them in doubles

# --- entities ----------------------------------------------------------------------------------


class Entity(str):
    """Entity of a recording: its path, and what docs/reference.md says of it.

    A path with braces is the template of many entities; ``path`` fills it in.

    Args:
        template: path.
        types: Rerun types of the data.
        content: what the data shows.

    Attributes:
        above: path above the first brace.
    """

    types: str
    content: str
    above: str
    _names: tuple[str, ...]

    def __new__(cls, template: str, types: str, content: str) -> Self:
        """Return the entity. Its path can be used like any string."""
        entity = super().__new__(cls, template)
        entity.types, entity.content = types, content
        entity.above = template.partition("/{")[0]
        entity._names = tuple(re.findall(r"{(\w+)}", template))
        return entity

    def path(self, *values: str) -> str:
        """Return the path with these values in place of the names in braces."""
        return _path(self, values)

    @property
    def row(self) -> str:
        """Row of docs/reference.md, in Markdown."""
        return f"| `{self.translate({123: '<', 125: '>'})}` | {self.types} | {self.content} |"


@lru_cache(maxsize=4096)  # each frame asks for some 70 paths
def _path(entity: Entity, values: tuple[str, ...]) -> str:
    names = zip(entity._names, values, strict=True)
    return entity.format_map({name: SPELLINGS.get(name, str)(value) for name, value in names})


def table() -> Mapping[str, Entity]:
    """Return all entities by name, in the order of the docs."""
    return {name: entity for name, entity in globals().items() if isinstance(entity, Entity)}


def _path_part(name: str) -> str:
    """Turn an external name into one path part. No character in it ends the part or needs an escape."""
    return re.sub(r"[\s/\\]", "_", name) or "_"


SPELLINGS: Mapping[str, Callable[[str], str]] = {  # names in braces whose values come from outside
    "topic": lambda topic: "/".join(_path_part(part) for part in topic.split("/") if part),
    "change": lambda change: _path_part(change).lower(),
    **dict.fromkeys(("opinion", "class", "component", "chart"), _path_part),
}

# Entities without data of their own, above others.
HEALTH = "/health"
B = "/b"  # root of the second run's tree in a comparison

# The scene
WORLD = Entity(
    "/world",
    "ViewCoordinates, AnnotationContext (static)",
    "the fixed frame, x forward, y left, z up; class ids",
)
SENSOR = Entity(
    "/world/{sensor}",
    "Transform3D; Pinhole (camera)",
    "pose of a LiDAR, or of the base frame; pose and calibration of a camera",
)
POINTS = Entity(
    "/world/{lidar}/points",
    "Points3D, ColorBy",
    "raw points; class id 0 unclassified, 1 ground, 2 obstacle; "
    "[further colours](recordings.md#colours-of-the-raw-points)",
)
GROUND = Entity(
    "/world/{lidar}/points/ground",
    "Points3D",
    "voxels of the ground, rounded by at most an eighth of a voxel",
)
OBSTACLES = Entity(
    "/world/{lidar}/points/obstacles", "Points3D", "voxels of obstacles, rounded in the same way"
)
CLUSTERS = Entity(
    "/world/{lidar}/clusters", "Boxes3D, Points3D", "clusters with the number that `/explain` uses"
)
SET_ASIDE = Entity("/world/{lidar}/clusters/set_aside", "Boxes3D", "clusters outside the size limits")
IMAGE = Entity(
    "/world/{camera}/image",
    "EncodedImage, VideoStream",
    "the picture or video as it came; raw and WebP as JPEG",
)
DETECTIONS = Entity("/world/{camera}/image/detections", "Boxes2D", "kept detections")
MASKS = Entity("/world/{camera}/image/detections/masks", "LineStrips2D", "outlines of masks")
WEAK = Entity(
    "/world/{camera}/image/detections/weak", "Boxes2D", "detections below the threshold or suppressed"
)
PROJECTED = Entity(
    "/world/{camera}/image/points", "Points2D", "obstacle points by depth, 0 to 50 m, near red"
)
MARKED = Entity(
    "/world/{mark}",
    "LineStrips3D, AnyValues",
    "the [findings](workbench.md#worth-a-look): `missed`: red; `false`: false and doubtful objects, crossed "
    "out yellow; `unexplained`: detections without one, dotted yellow; `unnamed`: clusters, dotted grey",
)
IMAGE_MARK = Entity(
    "/world/{camera}/image/{mark}",
    "LineStrips2D, AnyValues",
    "the same in an image",
)
IMAGE_OPINION = Entity(
    "/world/{camera}/image/opinions/{opinion}",
    "LineStrips2D, AnyValues",
    "[opinions on another method's objects](stages.md#two-opinions-on-the-objects): `contradicted` yellow, "
    "`named_otherwise` purple, `missed` red, `confirmed` blue, `unseen` grey; `says` is why",
)
FRUSTUMS = Entity("/world/frustums", "LineStrips3D", "detections in space; grey without a match")
FUSED = Entity(
    "/world/fused",
    "Boxes3D, AnyValues",
    "objects; `class_name`, `score`, `track`, `speed`, `cluster`, `camera`, `seen` (sides), `reason`, "
    "`opinion`",
)
MEASURED = Entity("/world/fused/measured", "Boxes3D", "the part that was seen")
FUSION = Entity("/world/fusion", "Boxes3D, AnyValues", "objects of bevviz's fusion beside another method's")
OUTLINES = Entity(
    "{boxes}/outlines",
    "LineStrips3D, LineStrips2D, AnyValues",
    "of objects, detections and evaluated objects, row for row; `says` is the tooltip",
)
NAMES = Entity(
    "{boxes}/names",
    "Points3D, Points2D, AnyValues",
    "names of anomalies, of detections without a match, and of marks",
)
TRACKS = Entity("/world/tracks", "Boxes3D", "[tracks](project.md#tracking), smoothed, in the fixed frame")
UNSEEN = Entity("/world/tracks/unseen", "Boxes3D", "expected place of tracks without a name in this frame")
TRAILS = Entity("/world/tracks/trails", "LineStrips3D", "the last seconds")
TRUTH = Entity("/world/ground_truth", "Boxes3D", "labels")
GRID = Entity("/world/bev", "GridMap", "occupancy: 0 free, 100 occupied, -1 (255) unknown")
BEV = Entity("/bev", "EncodedImage", "bird's-eye view; PNG with `bev.style=reference`, else JPEG")
CHANNEL = Entity("/bev/{channel}", "Image", "`density`, `height`, `intensity`: those of `bev.channels`")
OVERLAY = Entity(
    "/bev/overlay/{layer}",
    "LineStrips2D, AnyValues",
    "over its pixels: `tracks`, `trails`, `ground_truth`, marks, `why`",
)
OVERLAY_OPINION = Entity(
    "/bev/overlay/opinions/{opinion}", "LineStrips2D, AnyValues", "opinions, as in the images"
)
ROBOT_OVERLAY = Entity("/bev/overlay/robot/{topic}", "LineStrips2D", "boxes that the robot published")
ROBOT = Entity(
    "/robot/{topic}", "Boxes3D, Boxes2D ...", "the robot's own [messages](live.md#what-it-receives)"
)
MESH = Entity("/robot/{topic}/{mesh}", "Asset3D", "meshes of the robot's description, static")
DIAGNOSTIC = Entity("/robot/diagnostics/{component}", "StateChange", "`ok`, `warning`, `error`, `stale`")
ROTATION = Entity("/motion/rotation_rad_s/{topic}", "Scalars", "x, y, z of an Imu")
ACCELERATION = Entity("/motion/acceleration_m_s2/{topic}", "Scalars", "x, y, z of an Imu")

# Decisions
EXPLAIN = Entity(
    "/explain", "TextDocument", "failures, problems, and the decision on each detection and cluster"
)
EXPLAIN_LOG = Entity(
    "/explain/log", "TextLog", "failures (ERROR), problems (WARN), detections without a match (INFO)"
)
STATE = Entity(
    "/explain/states/{lane}",
    "StateChange",
    "`pipeline`: `ok`, `no detector`, `degraded` (an input is missing), `failed` (a stage failed); "
    "a camera: `ok`, `degraded`, `not fused`; `marks`: notes (`/bevviz/mark`)",
)
CLASS_STATE = Entity(
    "/explain/states/{camera}/{class}",
    "StateChange",
    "of the best detection: `matched`, `no cluster`, `taken` ...",
)
TOPIC_STATE = Entity("/explain/states/topics/{topic}", "StateChange", "problems of a robot's topics")
ANOMALY_STATE = Entity("/anomalies/states/{kind}", "StateChange", "subject of the anomaly, `+n` for n others")
ANOMALY_LOG = Entity("/anomalies/log", "TextLog", "beginnings of anomalies")
ANOMALY_COUNTS = Entity("/anomalies/count", "Scalars", "number by kind")
TRACK_STATE = Entity("/tracks/states/{lane}", "StateChange", "12 lanes; a track keeps its lane")
TRACK_SPEEDS = Entity("/tracks/speed_m_s", "Scalars", "speed of the track of each lane")
WHY = Entity("/explain/why", "TextDocument", "of `bevviz why`: verdicts and chains")
WHY_PART = Entity(
    "/explain/why/{part}",
    "Points3D, LineStrips3D, Boxes2D",
    "`points`: raw points, brown ground, red noise, orange set aside, yellow unnamed cluster, light blue "
    "reported, dark blue in front; `legend`: its name and counts; `place`, `<camera>/place`: its place, "
    "thin for further subjects; `<camera>/veil`: covers the rest of the image in the workbench",
)
FOCUS = Entity(
    "/focus/{view}",
    "Transform3D, LineStrips3D",
    "in the workbench: pose of the coordinate frame of each view, which goes to the subject; `robot`: the "
    "robot and rings of 10 m around it",
)

# Health
STAGE_TIME = Entity("/health/time_ms/{stage}", "Scalars", "time of each stage, and `total`")
RATE = Entity(
    "/health/rate_hz/{rate}",
    "Scalars",
    "`pipeline`: possible frames a second; `sensor`: by stamps; `received`: by arrival",
)
COUNT = Entity(
    "/health/count/{count}",
    "Scalars",
    "`points`, `invalid_points`, `voxels`, `obstacle_points`, `clusters`, `detections`, `matches`, "
    "`problems`, `failures`, `skipped_frames`; of opinions `confirmed`, `named_otherwise`, `contradicted`, "
    "`unseen`, `missed`",
)
LATENCY = Entity(
    "/health/latency_ms/{percentile}",
    "Scalars",
    "from a cloud's arrival until its results are logged, of the last frames",
)
DROPS = Entity("/health/drops/{place}", "Scalars", "beside a robot: frames dropped so far")
VIEWER_LAG = Entity(
    "/health/viewer_lag_ms/{viewer}", "Scalars", "beside a robot: until the viewer's process has a frame"
)
PROCESS = Entity(
    "/health/process/{resource}", "Scalars", "beside a robot: CPU, memory, `raw_mb`, `raw_s`, `flight_mb`"
)
SYNC_ERROR = Entity(
    "/health/sync_error_ms/{camera}", "Scalars", "stamp of the image minus stamp of the cloud"
)
TF_AGE = Entity("/health/tf_age_ms/{sensor}", "Scalars", "to the nearest transform")

# Evaluate, compare, sweep, calib
EVALUATE = Entity("/evaluate", "TextDocument", "the frame")
EVALUATE_ABOUT = Entity("/evaluate/about", "TextDocument", "the tables (static)")
JUDGED = Entity("/evaluate/objects/{outcome}", "Boxes3D", "objects: `true`, `missed`, `false`")
JUDGED_COUNT = Entity("/evaluate/count/{outcome}", "Scalars", "their number")
EVALUATE_LOG = Entity("/evaluate/log", "TextLog", "each missed and false one")
COMPARE = Entity("/compare", "TextDocument", "the frame")
COMPARE_ABOUT = Entity("/compare/about", "TextDocument", "A, B and the parameters that differ (static)")
DIFFERENCE = Entity(
    "/compare/objects/{change}",
    "Boxes3D",
    "`only_a`, `only_b`, `moved`, `other_class`, `broken`, `fixed`, in B's place where both have one",
)
FROM_A = Entity("/compare/objects/moved/from_a", "Arrows3D", "from A's centre to B's")
IMAGE_DIFFERENCE = Entity(
    "/compare/{camera}/{change}", "Boxes2D", "detections that differ: `only_a`, `only_b`, `other_class`"
)
DIFFERENCE_COUNT = Entity("/compare/count/{change}", "Scalars", "differences counted")
DIFFERENCE_STATE = Entity("/compare/states/{class}", "StateChange", "the worst difference by class")
COMPARE_LOG = Entity("/compare/log", "TextLog", "all differences in words")
SWEEP = Entity("/sweep", "TextDocument", "table of the sweep")
SWEEP_CHART = Entity("/sweep/{chart}", "LineStrips2D, Points2D", "curves of one parameter")
CALIB_RESULT = Entity(
    "/calib/{camera}/result",
    "TextDocument",
    "of [`bevviz calib`](extras/calib.md): the answer, the table and the corrected extrinsics",
)
CALIB_CURVE = Entity(
    "/calib/{camera}/score/{axis}",
    "BarChart",
    "score over the offset; blue fine, red off, grey cannot tell, yellow no agreement",
)
CALIB_STATED = Entity(
    "/calib/{camera}/stated",
    "EncodedImage, Points2D",
    "`image`; `points`: every point by depth; `edges`: the cloud's edges, as stated",
)
CALIB_CORRECTED = Entity("/calib/{camera}/corrected", "EncodedImage, Points2D", "the same, corrected")

# Provenance
CONFIG = Entity("/config", "TextDocument", "configuration and versions")
REPORT = Entity("/report", "TextDocument", "note, files and commands of a report")
DIGEST = Entity("/report/digest", "AnyValues", "fingerprints of each frame's results")

SECTIONS: Mapping[Entity, str] = {  # first entity of each section of the docs, and its title
    WORLD: "The scene",
    EXPLAIN: "Decisions",
    STAGE_TIME: "Health",
    EVALUATE: "Evaluate, compare, sweep, calib",
    CONFIG: "Provenance",
}
PROPERTY = "bevviz"  # property of a recording that says how it was made
BAG = "bag"  # property of a recording that says what it was made from


def space(path: str) -> str:
    """Return the coordinate frame that Rerun gives to an entity."""
    return f"tf#{path}"


# --- class ids ---------------------------------------------------------------------------------


class ClassId(IntEnum):
    """Class ids of points and boxes. The annotation context of /world names and colours them."""

    UNCLASSIFIED = 0
    GROUND = 1
    OBSTACLE = 2
    DETECTION = 10  # + DetectionState
    CLUSTER = 20  # + ClusterState, for clusters outside the size limits
    TRACK = 100  # + number of the colour of the track


TRACK_COLORS = 64
DEPTH_BINS = 64  # depth bins, one class id each, of the points projected into an image
DEPTH_RANGE = 50.0  # metres that the depth bins span

DETECTION_CLASS = {state: ClassId.DETECTION + state for state in DetectionState}
CLUSTER_CLASS = {state: ClassId.CLUSTER + state for state in ClusterState}
