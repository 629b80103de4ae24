"""Results that the robot published, used as a stage instead of ours: ``topic:NAME``."""

from __future__ import annotations

import itertools

import numpy as np

from bevviz.errors import StageError
from bevviz.model import geometry
from bevviz.model.box_points import inside_each
from bevviz.model.frame import F32, F64, Bool, Boxes3D, Camera, Frame, LabelledBoxes2D, LabelledBoxes3D
from bevviz.model.results import Clusters, ClusterState, Detections, Ground, Objects
from bevviz.stages.cells import cell_keys
from bevviz.stages.user_stages import heights_above_ground, make_objects

SAME_POINT_DISTANCE = 0.05  # metres: our point is the same as a point of the robot's within it


def segment(points: F32, frame: Frame, topic: str, voxel: float) -> Ground:
    """Return as ground all points that are not in the robot's cloud of obstacles.

    A point is an obstacle if one of the robot's points is within a voxel's diagonal, at least 5 cm. Both
    sides may have downsampled the same scan in different ways.

    Raises:
        StageError: the robot published no cloud at this time.
    """
    cloud = next((c for c in frame.robot_clouds if c.topic == topic), None)
    if cloud is None:
        raise _missing(topic, "cloud of obstacles")
    reach = max(SAME_POINT_DISTANCE, voxel * 3**0.5)
    obstacle = _within(points, cloud.xyz, reach)
    return Ground(~obstacle, heights_above_ground(points, ~obstacle))


def cluster(points: F32, frame: Frame, topic: str) -> Clusters:
    """Return the robot's boxes as clusters.

    A point in several boxes belongs to the box with the nearest centre.

    Raises:
        StageError: the robot published no boxes at this time.
    """
    boxes = in_points_frame(frame.pose, _boxes(frame, topic))
    labels = np.full(len(points), -1, np.int32)
    nearest = np.full(len(points), np.inf, np.float32)
    centroid = boxes.center.astype(np.float32)
    for k, inside in inside_each(points, boxes):
        away = np.linalg.norm(points[inside] - boxes.center[k], axis=1)
        nearer = inside[away < nearest[inside]]
        labels[nearer], nearest[nearer] = k, away[away < nearest[inside]]
    count = np.bincount(labels[labels >= 0], minlength=len(boxes)).astype(np.int32)
    for axis in range(3):
        total = np.bincount(labels[labels >= 0], points[labels >= 0, axis], minlength=len(boxes))
        np.divide(total, count, out=centroid[:, axis], where=count > 0, casting="unsafe")
    corners = geometry.corners(boxes)
    low, high = corners.min(axis=1), corners.max(axis=1)
    aligned = Boxes3D((low + high) / 2, high - low, np.zeros(len(boxes), np.float32))
    state = np.full(len(boxes), ClusterState.KEPT, np.int32)
    return Clusters(labels, state, count, centroid, aligned, boxes)


def detect(frame: Frame, camera: Camera, topic: str) -> Detections:
    """Return the robot's boxes in the camera's image, all of them kept.

    Raises:
        StageError: the robot published no detections at this time, or it is unknown which of several cameras
            they belong to.
    """
    for boxes in frame.robot_detections:
        if boxes.topic == topic and not boxes.camera and len(frame.cameras) > 1:
            raise StageError(
                f"{topic} does not say which camera its boxes are of: no image is in the frame "
                f"'{boxes.frame_id}' of its header; name the one camera: source.camera_topics"
            )
        if boxes.topic == topic and boxes.camera in ("", camera.name):
            return detections_of(boxes)
    raise _missing(topic, "detections")


def find_objects(frame: Frame, topic: str, obstacles: F32 | None, clusters: Clusters | None) -> Objects:
    """Return the robot's named boxes.

    Raises:
        StageError: the robot published no boxes at this time.
    """
    labelled = _boxes(frame, topic)
    return make_objects(
        in_points_frame(frame.pose, labelled), labelled.labels, labelled.scores, obstacles, clusters
    )


def detections_of(labelled: LabelledBoxes2D) -> Detections:
    """Make detections from labelled image boxes, best score first. All are kept."""
    order = np.argsort(-labelled.scores, kind="stable")
    names = [labelled.labels[d] for d in order]
    return Detections.of_boxes(labelled.xyxy[order], labelled.scores[order], names)


def in_points_frame(pose: F64, labelled: LabelledBoxes3D) -> Boxes3D:
    """Move labelled 3D boxes into the frame of the points, which has this (4, 4) pose."""
    points_from_boxes = np.eye(4)
    if labelled.world_from_boxes is not None:
        points_from_boxes = geometry.inverse(pose) @ labelled.world_from_boxes
    return geometry.transform_boxes(labelled.boxes, points_from_boxes)


def _boxes(frame: Frame, topic: str) -> LabelledBoxes3D:
    """Return the boxes of a topic, from the robot or from the ground truth."""
    for labelled in (*frame.robot_boxes, frame.truth):
        if labelled is not None and labelled.topic == topic:
            return labelled
    raise _missing(topic, "boxes")


def _within(points: F32, others: F32, reach: float) -> Bool:
    """Return the (N,) mask of points with one of the others in their cell or in a cell beside it.

    A cell is ``reach`` wide.
    """
    is_near = np.zeros(len(points), np.bool_)
    if not len(points) or not len(others):
        return is_near
    keys, strides = cell_keys(np.concatenate([points, others]), reach, reach=1)
    occupied = np.unique(keys[len(points) :])
    for offset in sorted(itertools.product((0, -1, 1), repeat=3), key=np.count_nonzero):
        remaining = np.flatnonzero(~is_near)
        wanted = keys[remaining] + np.array(offset) @ strides
        place = np.minimum(np.searchsorted(occupied, wanted), len(occupied) - 1)
        is_near[remaining] = occupied[place] == wanted
    return is_near


def _missing(topic: str, what: str) -> StageError:
    """Return the error of a topic without a message."""
    return StageError(f"the robot published no {what} on {topic} at the time of this scan")
