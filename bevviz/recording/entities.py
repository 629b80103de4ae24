"""Where everything is in a recording: entity paths and class ids, in one place (see docs/recordings.md)."""

from __future__ import annotations

import re
from enum import IntEnum

from bevviz.config import AnomalyKind
from bevviz.model.results import ClusterState, DetectionState

# --- timelines ---------------------------------------------------------------------------------

STAMP = "stamp"  # sensor time, from the header of the cloud
TRIED = "tried"  # the same, of a frame as other values make it, in bevviz open
FRAME = "frame"  # sequence
VERSION = "version"  # sequence: of the configuration, in bevviz tune
RECEIVED = "received"  # when the cloud was received, or logged into the bag

SLACK = 1000  # nanoseconds that a time which a viewer tells may be off: it counts them in doubles

# --- entities ----------------------------------------------------------------------------------

WORLD = "/world"
DIAGNOSTICS = "/robot/diagnostics"
FUSED = "/world/fused"
MEASURED = "/world/fused/measured"
FUSION = "/world/fusion"  # what our fusion would have made, where the objects are somebody else's
MISSED = "/world/missed"
FALSE = "/world/false"
UNNAMED = "/world/unnamed"
FRUSTUMS = "/world/frustums"
GRID = "/world/bev"
TRUTH = "/world/ground_truth"
BEV = "/bev"
ROBOT = "/robot"
ROTATION = "/motion/rotation_rad_s"
ACCELERATION = "/motion/acceleration_m_s2"
TRACKS = "/world/tracks"
UNSEEN = "/world/tracks/unseen"
TRAILS = "/world/tracks/trails"
TRACK_STATES = "/tracks/states"
TRACK_SPEEDS = "/tracks/speed_m_s"
ANOMALY_COUNTS = "/anomalies/count"
ANOMALY_LOG = "/anomalies/log"
ANOMALY_STATES = "/anomalies/states"
EXPLAIN = "/explain"
EXPLAIN_LOG = "/explain/log"
STATES = "/explain/states"
WHY = "/explain/why"
HEALTH = "/health"
CONFIG = "/config"
REPORT = "/report"
DIGEST = "/report/digest"  # fingerprints of each frame's results
PROPERTY = "bevviz"  # the recording's property that says how it was made
BAG = "bag"  # the one that says what it was made from
B = "/b"  # root of the same tree again, for the other one of two runs that are compared
SWEEP = "/sweep"
TUNE = "/tune"
COMPARE = "/compare"
COMPARE_ABOUT = "/compare/about"
COMPARE_LOG = "/compare/log"
COMPARE_STATES = "/compare/states"
CALIB = "/calib"
EVALUATE = "/evaluate"
EVALUATE_ABOUT = "/evaluate/about"
EVALUATE_LOG = "/evaluate/log"


def sensor(name: str) -> str:
    """A LiDAR or a camera: carries its pose."""
    return f"{WORLD}/{name}"


def space(path: str) -> str:
    """The coordinate frame that Rerun gives an entity."""
    return f"tf#{path}"


def points(lidar: str) -> str:
    return f"{WORLD}/{lidar}/points"


def ground(lidar: str) -> str:
    return f"{WORLD}/{lidar}/points/ground"


def obstacles(lidar: str) -> str:
    return f"{WORLD}/{lidar}/points/obstacles"


def clusters(lidar: str) -> str:
    return f"{WORLD}/{lidar}/clusters"


def set_aside(lidar: str) -> str:
    """Clusters outside the size limits."""
    return f"{WORLD}/{lidar}/clusters/set_aside"


def image(camera: str) -> str:
    return f"{WORLD}/{camera}/image"


def masks(camera: str) -> str:
    return f"{WORLD}/{camera}/image/detections/masks"


def detections(camera: str) -> str:
    return f"{WORLD}/{camera}/image/detections"


def weak(camera: str) -> str:
    """Detections below the threshold, or suppressed by a better one."""
    return f"{WORLD}/{camera}/image/detections/weak"


def outlines(boxes: str) -> str:
    """Over these boxes, a sentence for each; see ``bevviz.recording.labels``."""
    return f"{boxes}/outlines"


def names(boxes: str) -> str:
    """Beside these boxes."""
    return f"{boxes}/names"


def boxes_of(path: str) -> str:
    """The boxes that these outlines or names belong to; other entities are their own."""
    return path.removesuffix("/outlines").removesuffix("/names")


def projected(camera: str) -> str:
    return f"{WORLD}/{camera}/image/points"


def image_opinion(camera: str, opinion: str) -> str:
    """Objects of somebody else's of which cameras say so, or which they lack, over the image."""
    return f"{image(camera)}/opinions/{_part(opinion)}"


def overlay_opinion(opinion: str) -> str:
    """The same over the bird's-eye image."""
    return overlay(f"opinions/{_part(opinion)}")


def channel(name: str) -> str:
    return f"{BEV}/{name}"


def overlay(what: str) -> str:
    """Over the bird's-eye image: tracks, their trails, the ground truth."""
    return f"{BEV}/overlay/{what}"


def robot(topic: str) -> str:
    return f"{ROBOT}{_topic(topic)}"


def rotation(topic: str) -> str:
    """Of an Imu."""
    return f"{ROTATION}{_topic(topic)}"


def acceleration(topic: str) -> str:
    """Of an Imu."""
    return f"{ACCELERATION}{_topic(topic)}"


def robot_overlay(topic: str) -> str:
    """What the robot published, over the bird's-eye image."""
    return overlay(f"robot{_topic(topic)}")


def diagnostic(name: str) -> str:
    """State lane of what the robot's diagnostics say of one part."""
    return f"{DIAGNOSTICS}/{_part(name)}"


def state(*lane: str) -> str:
    return "/".join((STATES, *lane))


def topic_state(topic: str) -> str:
    """Whether its messages come, and can be used."""
    return f"{STATES}/topics{_topic(topic)}"


def class_state(camera: str, class_name: str) -> str:
    """What became of the best detection of the class."""
    return state(camera, _part(class_name))


def why(what: str) -> str:
    """The chain of what ``bevviz why`` explains: points by their fate, boxes, frustums."""
    return f"{WHY}/{what}"


def difference(change: str) -> str:
    """Objects that differ in this way between two runs."""
    return f"{COMPARE}/objects/{_change(change)}"


def image_difference(camera: str, change: str) -> str:
    return f"{COMPARE}/{camera}/{_change(change)}"


def difference_count(change: str) -> str:
    return f"{COMPARE}/count/{_change(change)}"


def difference_state(class_name: str) -> str:
    return f"{COMPARE_STATES}/{_part(class_name)}"


def judged(what: str) -> str:
    """Objects that are true, false or missed."""
    return f"{EVALUATE}/objects/{what}"


def judged_count(what: str) -> str:
    return f"{EVALUATE}/count/{what}"


def sweep(metric: str) -> str:
    """A number over the parameter that was swept."""
    return f"{SWEEP}/{_part(metric)}"


def track_state(lane: int) -> str:
    return f"{TRACK_STATES}/{lane:02}"


def anomaly_state(kind: AnomalyKind) -> str:
    return f"{ANOMALY_STATES}/{kind}"


def stage_time(stage: str) -> str:
    return f"{HEALTH}/time_ms/{stage}"


def rate(what: str) -> str:
    return f"{HEALTH}/rate_hz/{what}"


def count(what: str) -> str:
    return f"{HEALTH}/count/{what}"


def sync_error(camera: str) -> str:
    return f"{HEALTH}/sync_error_ms/{camera}"


def tf_age(sensor: str) -> str:
    return f"{HEALTH}/tf_age_ms/{sensor}"


def latency(what: str) -> str:
    """From the arrival of the cloud until its results are logged: percentiles of the last frames."""
    return f"{HEALTH}/latency_ms/{what}"


def drops(where: str) -> str:
    """Frames that were left out so far, by the place that they were left out at."""
    return f"{HEALTH}/drops/{where}"


def viewer_lag(name: str) -> str:
    """From when a frame is logged until the process that shows it has taken it."""
    return f"{HEALTH}/viewer_lag_ms/{name}"


def process(what: str) -> str:
    """What the process itself takes."""
    return f"{HEALTH}/process/{what}"


def calib_result(camera: str) -> str:
    """What ``bevviz calib`` found, in words."""
    return f"{CALIB}/{camera}/result"


def calib_curve(camera: str, axis: str) -> str:
    """The score over the offset along one axis."""
    return f"{CALIB}/{camera}/score/{axis}"


def calib_stated(camera: str) -> str:
    """Image, points and edges with the calibration as stated."""
    return f"{CALIB}/{camera}/stated"


def calib_corrected(camera: str) -> str:
    """The same with what is off put right."""
    return f"{CALIB}/{camera}/corrected"


def _part(name: str) -> str:
    """One part of a path, of a name that others chose: nothing in it ends the part or needs an escape."""
    return re.sub(r"[\s/\\]", "_", name) or "_"


def _change(change: str) -> str:
    return _part(change).lower()


def _topic(topic: str) -> str:
    return "".join(f"/{_part(part)}" for part in topic.split("/") if part)


# --- class ids ---------------------------------------------------------------------------------


class ClassId(IntEnum):
    """Class ids of points and boxes; the annotation context of /world names and colours them."""

    UNCLASSIFIED = 0
    GROUND = 1
    OBSTACLE = 2
    DETECTION = 10  # + DetectionState
    CLUSTER = 20  # + ClusterState, for clusters outside the size limits
    TRACK = 100  # + number of the colour of the track


TRACK_COLORS = 64
DEPTH_BINS = 64  # class ids of the points projected into an image: bins of the depth
DEPTH_RANGE = 50.0  # metres that these bins span

DETECTION_CLASS = {state: ClassId.DETECTION + state for state in DetectionState}
CLUSTER_CLASS = {state: ClassId.CLUSTER + state for state in ClusterState}
