"""Poses of points, sensors and boxes at one time, to each other and in the world."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.messages.transforms import StampedTransform
from bevviz.model import geometry
from bevviz.model.frame import F64, Cloud, Frame, LabelledBoxes3D
from bevviz.sync.gravity import VerticalEstimate
from bevviz.sync.report import SyncReport
from bevviz.sync.transform_tree import Origin, TransformError, TransformResult

FIXED_FRAMES = {"map", "odom", "world", "earth", "global", "utm", "enu", "ned", "mocap", "vicon", "init"}
GLOBE_FRAMES = {"earth", "ecef", "utm"}  # their coordinates are too large for the float32 of a viewer
LEVEL = math.cos(math.radians(20))  # boxes in a frame that leans less, as on a road, count as upright


@dataclass(frozen=True, slots=True)
class ReferenceFrames:
    """Reference frames of the points of a frame.

    Attributes:
        stamp: stamp of the cloud, nanoseconds.
        points_frame: frame of the points.
        world_frame: fixed frame; empty: there is none.
        inertial_frame: smoothest fixed frame, for motion compensation; empty: there is none.
        upright: (4, 4) points from points_frame; None: points_frame is upright.
        world_from_points: (4, 4) pose; None: not known.
        tf_age: seconds from the stamp to the nearest transform.
    """

    stamp: int
    points_frame: str
    world_frame: str
    inertial_frame: str
    upright: F64 | None = None
    world_from_points: F64 | None = None
    tf_age: float = float("nan")

    def points_from(self, frame: TransformResult) -> TransformResult:
        """Convert a transform to ``points_frame`` into one to the points."""
        return frame if self.upright is None else replace(frame, matrix=self.upright @ frame.matrix)

    def from_points(self, matrix: F64) -> F64:
        """Convert a transform from ``points_frame`` into one from the points."""
        return matrix if self.upright is None else matrix @ geometry.inverse(self.upright)


class PoseLookup:
    """Finder of poses: the reference frames of each cloud, and the transforms to them.

    Args:
        config: source.base_frame, source.fixed_frame, source.extrinsics and the tolerances of ``sync``.
        report: counts missing transforms. It also holds the transforms.
        upright: estimate of the vertical.
        turned: whether clouds may need to be turned upright, because there is a LiDAR.
        merged: whether the points of several LiDARs are merged in source.base_frame.

    Attributes:
        odometry_frames: frames that odometry is in.
    """

    def __init__(
        self, config: Config, report: SyncReport, upright: VerticalEstimate, *, turned: bool, merged: bool
    ) -> None:
        self._config, self._report, self._upright = config, report, upright
        self._tf = report.tf
        self._turned, self._merged = turned, merged
        self.odometry_frames: set[str] = set()
        for names, pose in config.source.extrinsics.items():
            self._tf.add(_extrinsic(names, pose), static=True, origin=Origin.CONFIG)

    def take_over(self, former: PoseLookup) -> None:
        """Continue with the transforms of ``former``."""
        self._report, self._upright, self._tf = former._report, former._upright, former._tf
        self.odometry_frames = former.odometry_frames

    def of(self, cloud: Cloud, problems: list[str] | None = None) -> ReferenceFrames:
        """Find the reference frames of a cloud. With ``problems``, also find its pose in the world."""
        points_frame = cloud.frame_id.lstrip("/")
        base = self._config.source.base_frame
        if self._merged and self._tf.knows(base, points_frame):
            points_frame = base
        world, inertial = self.fixed(points_frame)
        reference = ReferenceFrames(cloud.stamp, points_frame, world, inertial)
        if problems is None:
            return reference
        turn = self._upright.turn(cloud, world) if self._turned else None
        if points_frame == cloud.frame_id.lstrip("/"):
            reference = replace(reference, upright=turn)
        if self._merged and points_frame != base:
            self._report.complain(
                problems,
                f"no transform from '{points_frame}' to source.base_frame '{base}': "
                f"the LiDARs are merged in '{points_frame}'",
            )
        if not world and not self._turned:
            return reference
        if not world:
            topic = self._config.source.odometry_topic
            remedy = (
                f"source.odometry_topic {topic} does not lead to it"
                if topic
                else "source.odometry_topic can name a nav_msgs/Odometry that does"
            )
            self._report.problems[
                f"no fixed frame (map, odom or the like) above '{points_frame}' in TF, so motion is not "
                f"compensated; {remedy}"
            ] += 1
            return reference
        try:
            lookup = self._tf.lookup(world, points_frame, cloud.stamp, self._config.sync.tf_tolerance)
        except TransformError as error:
            self._report.complain(problems, f"{error}: the cloud has no place in the world")
            return reference
        return replace(reference, world_from_points=reference.from_points(lookup.matrix), tf_age=lookup.age)

    def fixed(self, points_frame: str) -> tuple[str, str]:
        """Return the world frame and the smoothest fixed frame above ``points_frame``; empty if none."""
        path = self._tf.ancestors(points_frame)
        fixed = [f for f in path if f in self.odometry_frames or _words(f) & FIXED_FRAMES]
        near = [f for f in fixed if not _words(f) & GLOBE_FRAMES] or fixed
        stated = self._config.source.fixed_frame.lstrip("/")
        return stated or (near[-1] if near else ""), near[0] if near else stated

    def pose(self, frame: Frame, stamp: int) -> F64 | None:
        """Return (4, 4) smoothest fixed frame from points; None if the transforms do not reach the stamp."""
        inertial = self.fixed(frame.points_frame)[1]
        if not inertial:
            return None
        try:
            lookup = self._tf.lookup(inertial, frame.points_frame, stamp, self._config.sync.tf_tolerance)
        except TransformError:
            return None
        return lookup.matrix if frame.upright is None else lookup.matrix @ geometry.inverse(frame.upright)

    def moved(self, reference: ReferenceFrames, stamp: int, frame: str) -> tuple[TransformResult, bool]:
        """Return points at the cloud's stamp from ``frame`` at ``stamp``; and if motion is compensated."""
        tolerance = self._config.sync.tf_tolerance
        if self.compensates(reference):
            try:
                lookup = self._tf.lookup_moving(
                    reference.points_frame, reference.stamp, frame, stamp, reference.inertial_frame, tolerance
                )
                return reference.points_from(lookup), True
            except TransformError:
                pass  # fall back to no motion compensation
        return reference.points_from(
            self._tf.lookup(reference.points_frame, frame, reference.stamp, tolerance)
        ), False

    def compensates(self, reference: ReferenceFrames) -> bool:
        """Return whether motion is to be compensated."""
        return self._config.sync.motion_compensation and bool(reference.inertial_frame)

    def mounting(self, reference: ReferenceFrames, frame: str) -> F64 | None:
        """Return (4, 4) frame from points at the cloud's stamp; None if they are not connected."""
        try:
            lookup = self._tf.lookup(
                reference.points_frame, frame, reference.stamp, self._config.sync.tf_tolerance
            )
        except TransformError:
            return None
        return geometry.inverse(reference.points_from(lookup).matrix)

    def world_from(self, reference: ReferenceFrames, frame: str) -> F64 | None:
        """Return (4, 4) world from a frame at the cloud's stamp; None if they are not connected."""
        if not frame:
            return None
        from_points = self.mounting(reference, frame)
        if from_points is None:
            return None
        world = np.eye(4) if reference.world_from_points is None else reference.world_from_points
        return world @ geometry.inverse(from_points)

    def placed(
        self, boxes: LabelledBoxes3D, reference: ReferenceFrames, problems: list[str]
    ) -> LabelledBoxes3D:
        """Return the boxes with their pose in the world.

        Boxes that lean in the frame of the points, or are in several frames, become upright boxes in the
        points' frame.
        """
        if not len(boxes.boxes):
            return boxes  # an empty message may lack a frame
        world = reference.world_from_points
        stamp = reference.stamp if world is None else boxes.stamp
        target = reference.points_frame if world is None else reference.world_frame
        poses = dict[str, F64]()  # (4, 4) world from each frame of the boxes
        for frame in dict.fromkeys(boxes.frames or (boxes.frame_id,)):
            try:
                lookup = self._tf.lookup(target, frame, stamp, self._config.sync.tf_tolerance)
                poses[frame] = (reference.points_from(lookup) if world is None else lookup).matrix
            except TransformError as error:
                lost = "are left out" if boxes.frames else "have no place in the world"
                self._report.complain(problems, f"{error}: the boxes of {boxes.topic} {lost}")
        if not boxes.frames and not poses:
            return boxes
        points_from_world = np.eye(4) if world is None else geometry.inverse(world)
        if not boxes.frames and boxes.turns is None:
            pose = poses[boxes.frame_id]
            if (points_from_world @ pose)[2, 2] > LEVEL:
                return replace(boxes, world_from_boxes=pose)
        return _make_upright(
            boxes, {name: points_from_world @ pose for name, pose in poses.items()}, reference
        )


def _make_upright(
    boxes: LabelledBoxes3D, poses: Mapping[str, F64], reference: ReferenceFrames
) -> LabelledBoxes3D:
    """Return upright boxes in the frame of the points. Boxes in frames that ``poses`` lacks are left out."""
    frames = boxes.frames or (boxes.frame_id,) * len(boxes.boxes)
    rows = [row for row, frame in enumerate(frames) if frame in poses]
    kept = boxes.boxes.chosen(rows)
    box_poses = np.empty((len(rows), 4, 4))
    for k, row in enumerate(rows):
        half = float(kept.yaw[k]) / 2
        turn = [0, 0, math.sin(half), math.cos(half)] if boxes.turns is None else boxes.turns[row]
        box_poses[k] = poses[frames[row]] @ geometry.transform(kept.center[k], turn)
    world = reference.world_from_points
    return replace(
        boxes,
        frame_id=reference.points_frame,
        boxes=geometry.upright_boxes(box_poses[:, :3, 3], kept.size, box_poses[:, :3, :3]),
        labels=tuple(boxes.labels[row] for row in rows),
        scores=boxes.scores[rows],
        ids=tuple(boxes.ids[row] for row in rows) if boxes.ids else (),
        world_from_boxes=np.eye(4) if world is None else world,
        turns=None,
        frames=(),
    )


def _words(frame: str) -> set[str]:
    return set(re.split(r"[/_]", frame.lower()))


def _extrinsic(names: str, pose: tuple[float, ...]) -> StampedTransform:
    parent, _, child = names.strip().partition(" ")
    if not parent or not child.strip():
        raise UserError(f"source.extrinsics: '{names}' should be 'parent child', two frame names")
    try:
        matrix = geometry.transform(np.array(pose[:3]), np.array(pose[3:]))
    except ValueError as error:
        raise UserError(f"source.extrinsics '{names}': {error}; expected x y z qx qy qz qw") from None
    return StampedTransform(0, parent, child.strip(), matrix)
