"""Entity paths, timelines and class ids of a recording (see docs/recordings.md)."""

from __future__ import annotations

import re
from enum import IntEnum

from bevviz.config import AnomalyKind
from bevviz.model.results import ClusterState, DetectionState

# --- timelines ---------------------------------------------------------------------------------

STAMP = "stamp"  # sensor time, from the header of the cloud
TRIED = "tried"  # sensor time, for results with tried values in bevviz open
FRAME = "frame"  # sequence number of the frame
VERSION = "version"  # sequence number of the configuration, in bevviz tune
REPORTED = "report"  # sequence number of the frame, up to the frame that a bug report is about
RECEIVED = "received"  # when the cloud was received, or logged into the bag

TIME_TOLERANCE = 1000  # nanoseconds of tolerance for times from a viewer, which counts them in doubles

# --- entities ----------------------------------------------------------------------------------

WORLD = "/world"
DIAGNOSTICS = "/robot/diagnostics"
FUSED = "/world/fused"
MEASURED = "/world/fused/measured"
FUSION = "/world/fusion"  # result of our fusion, if the objects come from another source
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
PROPERTY = "bevviz"  # property of a recording that says how it was made
BAG = "bag"  # property of a recording that says what it was made from
B = "/b"  # root of the second run's tree in a comparison
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
    """Return the entity of a LiDAR or a camera. It carries the sensor's pose."""
    return f"{WORLD}/{name}"


def space(path: str) -> str:
    """Return the coordinate frame that Rerun gives to an entity."""
    return f"tf#{path}"


def points(lidar: str) -> str:
    """Return the entity of a LiDAR's raw points."""
    return f"{WORLD}/{lidar}/points"


def ground(lidar: str) -> str:
    """Return the entity of a LiDAR's ground voxels."""
    return f"{WORLD}/{lidar}/points/ground"


def obstacles(lidar: str) -> str:
    """Return the entity of a LiDAR's obstacle voxels."""
    return f"{WORLD}/{lidar}/points/obstacles"


def clusters(lidar: str) -> str:
    """Return the entity of a LiDAR's kept clusters."""
    return f"{WORLD}/{lidar}/clusters"


def set_aside(lidar: str) -> str:
    """Return the entity of clusters outside the size limits."""
    return f"{WORLD}/{lidar}/clusters/set_aside"


def image(camera: str) -> str:
    """Return the entity of a camera's image."""
    return f"{WORLD}/{camera}/image"


def masks(camera: str) -> str:
    """Return the entity of the detections' mask outlines in a camera's image."""
    return f"{WORLD}/{camera}/image/detections/masks"


def detections(camera: str) -> str:
    """Return the entity of the kept detections in a camera's image."""
    return f"{WORLD}/{camera}/image/detections"


def weak(camera: str) -> str:
    """Return the entity of detections below the threshold or suppressed by a better one."""
    return f"{WORLD}/{camera}/image/detections/weak"


def outlines(boxes: str) -> str:
    """Return the entity of the outlines over boxes. Each has a sentence; see ``bevviz.recording.labels``."""
    return f"{boxes}/outlines"


def names(boxes: str) -> str:
    """Return the entity of the names next to boxes."""
    return f"{boxes}/names"


def boxes_of(path: str) -> str:
    """Return the entity of the boxes of these outlines or names. Other entities are returned unchanged."""
    return path.removesuffix("/outlines").removesuffix("/names")


def projected(camera: str) -> str:
    """Return the entity of the obstacle points in a camera's image."""
    return f"{WORLD}/{camera}/image/points"


def image_opinion(camera: str, opinion: str) -> str:
    """Return the entity of objects that share an opinion of the cameras, drawn over a camera's image.

    The objects are external, from a 3D detector or a topic, or they are missed by it.
    """
    return f"{image(camera)}/opinions/{_path_part(opinion)}"


def overlay_opinion(opinion: str) -> str:
    """Return the entity of objects that share an opinion of the cameras, drawn over the bird's-eye image."""
    return overlay(f"opinions/{_path_part(opinion)}")


def channel(name: str) -> str:
    """Return the entity of a channel of the bird's-eye view."""
    return f"{BEV}/{name}"


def overlay(layer: str) -> str:
    """Return the entity of an overlay on the bird's-eye image: tracks, trails, ground truth."""
    return f"{BEV}/overlay/{layer}"


def robot(topic: str) -> str:
    """Return the entity of data that the robot published on a topic."""
    return f"{ROBOT}{_topic_path(topic)}"


def rotation(topic: str) -> str:
    """Return the entity of an IMU's rotation rates."""
    return f"{ROTATION}{_topic_path(topic)}"


def acceleration(topic: str) -> str:
    """Return the entity of an IMU's accelerations."""
    return f"{ACCELERATION}{_topic_path(topic)}"


def robot_overlay(topic: str) -> str:
    """Return the entity of a topic's boxes, drawn over the bird's-eye image."""
    return overlay(f"robot{_topic_path(topic)}")


def diagnostic(name: str) -> str:
    """Return the state lane of a component in the robot's diagnostics."""
    return f"{DIAGNOSTICS}/{_path_part(name)}"


def state(*lane: str) -> str:
    """Return the entity of a state lane."""
    return "/".join((STATES, *lane))


def topic_state(topic: str) -> str:
    """Return the lane that shows whether a topic's messages arrive and can be used."""
    return f"{STATES}/topics{_topic_path(topic)}"


def class_state(camera: str, class_name: str) -> str:
    """Return the lane that shows the decision about the best detection of a class."""
    return state(camera, _path_part(class_name))


def why(part: str) -> str:
    """Return the entity of a part of a ``bevviz why`` explanation: points by fate, boxes, frustums."""
    return f"{WHY}/{part}"


def difference(change: str) -> str:
    """Return the entity of objects that differ in this way between two runs."""
    return f"{COMPARE}/objects/{_change(change)}"


def image_difference(camera: str, change: str) -> str:
    """Return the entity of detections that differ in this way between two runs, in a camera's image."""
    return f"{COMPARE}/{camera}/{_change(change)}"


def difference_count(change: str) -> str:
    """Return the entity of the number of such differences."""
    return f"{COMPARE}/count/{_change(change)}"


def difference_state(class_name: str) -> str:
    """Return the lane of the differences of a class."""
    return f"{COMPARE_STATES}/{_path_part(class_name)}"


def judged(outcome: str) -> str:
    """Return the entity of objects that are true, false or missed."""
    return f"{EVALUATE}/objects/{outcome}"


def marked(state: str) -> str:
    """Return the entity of marked objects: missed, false or unexplained."""
    return f"{WORLD}/{state}"


def image_mark(camera: str, state: str) -> str:
    """Return the entity of marked objects, drawn over a camera's image."""
    return f"{image(camera)}/{state}"


def judged_count(outcome: str) -> str:
    """Return the entity of the number of true, false or missed objects."""
    return f"{EVALUATE}/count/{outcome}"


def sweep(metric: str) -> str:
    """Return the entity of a metric over the parameter of a sweep."""
    return f"{SWEEP}/{_path_part(metric)}"


def track_state(lane: int) -> str:
    """Return the entity of a track lane."""
    return f"{TRACK_STATES}/{lane:02}"


def anomaly_state(kind: AnomalyKind) -> str:
    """Return the lane of an anomaly kind."""
    return f"{ANOMALY_STATES}/{kind}"


def stage_time(stage: str) -> str:
    """Return the entity of a stage's time in milliseconds."""
    return f"{HEALTH}/time_ms/{stage}"


def rate(name: str) -> str:
    """Return the entity of a rate in Hz."""
    return f"{HEALTH}/rate_hz/{name}"


def count(name: str) -> str:
    """Return the entity of a count."""
    return f"{HEALTH}/count/{name}"


def sync_error(camera: str) -> str:
    """Return the entity of a camera's sync error in milliseconds."""
    return f"{HEALTH}/sync_error_ms/{camera}"


def tf_age(sensor: str) -> str:
    """Return the entity of the age of a sensor's transform in milliseconds."""
    return f"{HEALTH}/tf_age_ms/{sensor}"


def latency(percentile: str) -> str:
    """Return the entity of a latency percentile in milliseconds.

    Latency is the time from a cloud's arrival until its results are logged, over the last frames.
    """
    return f"{HEALTH}/latency_ms/{percentile}"


def drops(stage: str) -> str:
    """Return the entity of the number of frames dropped so far at one point of the pipeline."""
    return f"{HEALTH}/drops/{stage}"


def viewer_lag(name: str) -> str:
    """Return the entity of a viewer's lag in milliseconds, from logging a frame until the viewer has it."""
    return f"{HEALTH}/viewer_lag_ms/{name}"


def process(resource: str) -> str:
    """Return the entity of a resource that the process itself uses."""
    return f"{HEALTH}/process/{resource}"


def calib_result(camera: str) -> str:
    """Return the entity of the text result of ``bevviz calib``."""
    return f"{CALIB}/{camera}/result"


def calib_curve(camera: str, axis: str) -> str:
    """Return the entity of the score over the offset along one axis."""
    return f"{CALIB}/{camera}/score/{axis}"


def calib_stated(camera: str) -> str:
    """Return the entity of image, points and edges with the stated calibration."""
    return f"{CALIB}/{camera}/stated"


def calib_corrected(camera: str) -> str:
    """Return the entity of image, points and edges with the corrected calibration."""
    return f"{CALIB}/{camera}/corrected"


def _path_part(name: str) -> str:
    """Turn an external name into one path part. No character in it ends the part or needs an escape."""
    return re.sub(r"[\s/\\]", "_", name) or "_"


def _change(change: str) -> str:
    return _path_part(change).lower()


def _topic_path(topic: str) -> str:
    return "".join(f"/{_path_part(part)}" for part in topic.split("/") if part)


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
