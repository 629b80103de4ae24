"""Transforms, odometry and accelerations of ROS messages."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bevviz.messages.decoders import MessageError, frame_name, stamp_ns
from bevviz.messages.poses import Vector, quaternion_of, vector_of
from bevviz.model import geometry
from bevviz.model.frame import F64


@dataclass(frozen=True, slots=True)
class StampedTransform:
    """Edge of the transform tree at one time.

    Attributes:
        stamp: nanoseconds.
        parent: parent frame.
        child: child frame.
        parent_from_child: (4, 4) pose.
    """

    stamp: int
    parent: str
    child: str
    parent_from_child: F64


def decode_transforms(
    msg: Any, topic: str = "/tf", refuse: Callable[[str], None] = lambda reason: None
) -> list[StampedTransform]:
    """Return the transforms of a tf2_msgs/TFMessage. Transforms that are not rigid are left out.

    Args:
        msg: the message, or the transforms that the decoder of another message type returned.
        topic: topic of the message, for errors.
        refuse: called with the reason for each transform that is left out beside others.

    Raises:
        MessageError: no transform is rigid.
    """
    transforms, problems = [], []
    for item in msg if isinstance(msg, list) else msg.transforms:
        try:
            transforms.append(
                _checked(item, topic)
                if isinstance(item, StampedTransform)
                else _stamped(
                    *(item.header, item.child_frame_id),
                    *(item.transform.translation, item.transform.rotation, topic),
                )
            )
        except MessageError as error:
            problems.append(error)
    if problems and not transforms:
        raise problems[0]
    for problem in problems:
        refuse(str(problem))
    return transforms


def decode_odometry(msg: Any, topic: str = "odometry") -> StampedTransform:
    """Return the pose of a nav_msgs/Odometry: header.frame_id from child_frame_id.

    Raises:
        MessageError: the transform is not rigid, or a frame name is missing.
    """
    pose = msg.pose.pose
    return _stamped(msg.header, msg.child_frame_id, pose.position, pose.orientation, topic)


@dataclass(frozen=True, slots=True)
class Acceleration:
    """Acceleration that an Imu measures in its own frame. At rest it is one g upwards.

    Attributes:
        stamp: nanoseconds.
        frame_id: frame of the Imu.
        acceleration: (3,) m/s^2, or g with some drivers.
    """

    stamp: int
    frame_id: str
    acceleration: F64


def decode_acceleration(msg: Any, topic: str = "imu") -> Acceleration:
    """Return the acceleration of a sensor_msgs/Imu.

    Raises:
        MessageError: the message states that it has no acceleration.
    """
    if msg.linear_acceleration_covariance[0] == -1:
        raise MessageError(f"{topic}: its covariance says that no acceleration is measured")
    return Acceleration(
        stamp_ns(msg.header.stamp),
        frame_name(msg.header.frame_id),
        np.array(vector_of(msg.linear_acceleration)),
    )


def decode_motion(msg: Any) -> tuple[Vector, Vector, int]:
    """Return rotation rate, acceleration and stamp of a sensor_msgs/Imu. Missing values are NaN."""
    none = (math.nan, math.nan, math.nan)
    rotation, acceleration = msg.angular_velocity, msg.linear_acceleration
    return (
        none if msg.angular_velocity_covariance[0] == -1 else vector_of(rotation),
        none if msg.linear_acceleration_covariance[0] == -1 else vector_of(acceleration),
        stamp_ns(msg.header.stamp),
    )


def _stamped(header: Any, child: str, translation: Any, rotation: Any, topic: str) -> StampedTransform:
    parent, child = frame_name(header.frame_id), frame_name(child)
    position, orientation = vector_of(translation), quaternion_of(rotation)
    try:
        matrix = geometry.transform(position, orientation)
    except ValueError as error:
        raise MessageError(f"{topic}: rotation from '{child}' to '{parent}': {error}") from None
    return _checked(StampedTransform(stamp_ns(header.stamp), parent, child, matrix), topic)


def _checked(edge: StampedTransform, topic: str) -> StampedTransform:
    """Return an edge. Raise MessageError if its frames or its translation cannot be used."""
    parent, child = edge.parent, edge.child
    if not parent or not child or parent == child:
        raise MessageError(f"{topic}: '{parent}' and '{child}' cannot be parent and child frame")
    if not all(map(math.isfinite, edge.parent_from_child[:3, 3].tolist())):
        raise MessageError(f"{topic}: the translation from '{child}' to '{parent}' is not finite")
    return edge
