"""Publisher of the results on the topics of the tutorial's four nodes, and of the tracks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bevviz.live.status import Notes
from bevviz.messages.definitions import typestore
from bevviz.messages.encode import (
    encode_boxes_2d,
    encode_boxes_3d,
    encode_cloud,
    encode_image,
    encode_markers,
    encode_transforms,
)
from bevviz.model import geometry
from bevviz.model.frame import F32, F64, I64, Boxes3D, Cloud, Image
from bevviz.model.protocols import Observer
from bevviz.model.results import FrameResult, Tracks

BEV = "/visualization/bev_image"
OBSTACLES = "/lidar/points_no_ground"
CLUSTERS = "/detection/lidar_clusters"
DETECTIONS = "/detection/camera_2d"
FUSED = "/detection/fused_3d"
TRACKS = "/detection/tracks_3d"
MARKERS = "/visualization/tracks"
TRANSFORMS = "/tf"
SPEED = "speed_m_s"  # class of a track's second result; the score of that result is the speed
TOPICS = {
    BEV: "sensor_msgs/msg/Image",
    OBSTACLES: "sensor_msgs/msg/PointCloud2",
    CLUSTERS: "vision_msgs/msg/Detection3DArray",
    DETECTIONS: "vision_msgs/msg/Detection2DArray",
    FUSED: "vision_msgs/msg/Detection3DArray",
    TRACKS: "vision_msgs/msg/Detection3DArray",
    MARKERS: "visualization_msgs/msg/MarkerArray",
    TRANSFORMS: "tf2_msgs/msg/TFMessage",
}


class Receiver:
    """Base class of receivers of the results. Each method may stay as it is. One thread calls all."""

    def observe(self, result: FrameResult) -> None:
        """Take a result. Only the newest comes."""

    def wants(self, topic: str) -> bool:
        """Return whether anybody receives a topic of ``TOPICS``."""
        return False

    def send(self, topic: str, data: bytes, stamp: int) -> None:
        """Send a message in CDR with its stamp in nanoseconds."""


class Publisher(Observer[FrameResult]):
    """Observer that publishes each result that somebody receives, with the header of its cloud or image.

    Clusters are the kept ones, with ``cluster_<row>`` as their class. Fused boxes are the objects with a
    class. Their class is the second result, after ``cluster_<row>``, where the tutorial's nodes look for it.
    Tracks have their number as ``id``, and their speed as the second result. Any RViz shows them as markers.

    Args:
        receivers: receivers of the messages.
        notes: takes a warning the first time that publishing fails.
    """

    name = "publishing"
    queue_size = 1

    def __init__(self, receivers: Sequence[Receiver], notes: Notes) -> None:
        self._receivers, self._notes = receivers, notes
        self._failed = False
        self._stamp = 0

    def observe(self, result: FrameResult) -> None:
        """Publish a result, and show it to the receivers."""
        try:
            self.publish(result)
            for receiver in self._receivers:
                receiver.observe(result)
        except Exception as error:
            if not self._failed:
                self._notes.warn(f"results cannot be published: {type(error).__name__}: {error}")
            self._failed = True

    def publish(self, result: FrameResult) -> None:
        """Publish the results of a frame. Several cameras take turns on one topic."""
        frame = result.frame
        stamp, frame_id = frame.stamp, frame.points_frame
        self._stamp = stamp
        back = None if frame.upright is None else geometry.inverse(frame.upright)
        if result.bev is not None and self._wanted(BEV):
            self._send(BEV, encode_image(Image(stamp, frame_id, result.bev.image)))
        if result.obstacles is not None and self._wanted(OBSTACLES):
            self._send(OBSTACLES, encode_cloud(Cloud(stamp, frame_id, _moved(result.obstacles, back))))
        if result.clusters is not None and self._wanted(CLUSTERS):
            rows = np.flatnonzero(result.clusters.kept)
            boxes = _rows(result.clusters.boxes(result.config.clustering), rows)
            names = [[(f"cluster_{row}", 1.0)] for row in rows]
            self._send(CLUSTERS, encode_boxes_3d(stamp, frame_id, boxes, names, back))
        if self._wanted(DETECTIONS):
            self._send_detections(result)
        if result.objects is not None and self._wanted(FUSED):
            objects = result.objects
            scored = zip(objects.cluster.tolist(), objects.names, objects.score.tolist(), strict=True)
            results = [[(f"cluster_{row}", 1.0), (name, score)] for row, name, score in scored]
            self._send(FUSED, encode_boxes_3d(stamp, frame_id, objects.boxes, results, back))
        if self._wanted(TRANSFORMS):
            self._send_pose(result, back)
        if result.tracks is not None:
            self._send_tracks(result, result.tracks, back)

    def _send_tracks(self, result: FrameResult, tracks: Tracks, back: F64 | None) -> None:
        """Publish the confirmed tracks, in the fixed frame if there is one."""
        stamp, pose = result.frame.stamp, None if tracks.absolute else back
        rows = np.flatnonzero(tracks.confirmed)
        boxes, speed = _rows(tracks.boxes, rows), tracks.speed
        if self._wanted(TRACKS):
            results = [[(tracks.names[t], 1.0), (SPEED, float(speed[t]))] for t in rows.tolist()]
            ids = [str(number) for number in tracks.id[rows].tolist()]
            self._send(TRACKS, encode_boxes_3d(stamp, tracks.frame_id, boxes, results, pose, ids))
        if self._wanted(MARKERS):
            texts = [f"{tracks.names[t]} #{tracks.id[t]} {speed[t]:.1f} m/s" for t in rows.tolist()]
            velocity, ids_ = tracks.velocity[rows], tracks.id[rows]
            markers = encode_markers(stamp, tracks.frame_id, boxes, velocity, ids_, texts, pose)
            self._send(MARKERS, markers)

    def _send_detections(self, result: FrameResult) -> None:
        """Publish the kept detections of each camera."""
        for camera in result.cameras:
            image, detections = camera.camera.image, camera.detections
            if image is None or detections is None:
                continue
            rows = np.flatnonzero(detections.kept)
            results = [[(detections.names[row], float(detections.score[row]))] for row in rows]
            self._send(
                DETECTIONS, encode_boxes_2d(image.stamp, image.frame_id, detections.xyxy[rows], results)
            )

    def _send_pose(self, result: FrameResult, back: F64 | None) -> None:
        """Publish the pose of the points in the fixed frame, and of the frame of the tracks."""
        frame = result.frame
        if frame.world_from_points is None or frame.world_frame == frame.points_frame:
            return
        pose = frame.pose if back is None else frame.pose @ geometry.inverse(back)
        self._send(
            TRANSFORMS, encode_transforms(frame.stamp, [(frame.world_frame, frame.points_frame, pose)])
        )

    def _wanted(self, topic: str) -> bool:
        return any(receiver.wants(topic) for receiver in self._receivers)

    def _send(self, topic: str, message: Any) -> None:
        """Serialise a message and pass it to everyone who receives its topic."""
        data = bytes(typestore().serialize_cdr(message, TOPICS[topic]))
        for receiver in self._receivers:
            if receiver.wants(topic):
                receiver.send(topic, data, self._stamp)


def _moved(points: F32, pose: F64 | None) -> F32:
    """Return points moved by a pose, or as they are without one."""
    return points if pose is None else geometry.apply(pose, points)


def _rows(boxes: Boxes3D, rows: I64) -> Boxes3D:
    return Boxes3D(boxes.center[rows], boxes.size[rows], boxes.yaw[rows])
