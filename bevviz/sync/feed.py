"""Handlers that decode the messages of each role for the synchroniser, for bags and live robots."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

from bevviz.drivers.video import decode_packet
from bevviz.messages.camera_info import decode_camera_info
from bevviz.messages.clouds import decode_cloud, decode_laser_scan
from bevviz.messages.decoders import MessageError
from bevviz.messages.detections import decode_boxes, decode_detections_2d, decode_detections_3d
from bevviz.messages.guard import TypedMessage, guard
from bevviz.messages.images import decode_compressed_image, decode_image
from bevviz.messages.roles import Roles
from bevviz.messages.surroundings import decode_mark, decode_shapes, decode_statuses
from bevviz.messages.topics import CameraRole
from bevviz.messages.transforms import (
    StampedTransform,
    decode_acceleration,
    decode_motion,
    decode_odometry,
    decode_transforms,
)
from bevviz.model.frame import Cloud, LabelledBoxes3D
from bevviz.sync.synchronizer import Synchronizer
from bevviz.sync.video import Rewind, Video


class Message(TypedMessage, Protocol):
    """Serialised message as it was received."""

    @property
    def received(self) -> int:
        """Time of receipt, nanoseconds."""

    def header(self) -> tuple[int, str]:
        """Return stamp (nanoseconds) and frame_id. Raise MessageError if there is no header."""


M = TypeVar("M", bound=Message)
T = TypeVar("T")
P = ParamSpec("P")
Handler = Callable[[M], None]


def make_handlers(
    sync: Synchronizer, roles: Roles, decode: Callable[[M], Any], rewind: Rewind | None = None
) -> dict[str, Handler[M]]:
    """Return a handler for each topic, which decodes a message and adds it to the synchroniser.

    Images are decoded only when a frame takes them. The handlers and ``decode`` raise MessageError for
    unusable messages.

    Args:
        sync: synchroniser that gets the messages.
        roles: roles of the topics.
        decode: makes an object with the fields of a message.
        rewind: reads earlier packets of a video again, see ``Video``; None: they cannot be read.
    """

    def read(message: M, decoder: Callable[Concatenate[Any, P], T], *args: P.args, **kwargs: P.kwargs) -> T:
        return guard(message, decoder, decode(message), *args, **kwargs)

    def read_received(message: M, decoder: Callable[[Any, str, int], T]) -> T:
        return read(message, decoder, message.topic, message.received)

    def read_cloud(message: M) -> Cloud:
        decoder = decode_laser_scan if message.type.endswith("LaserScan") else decode_cloud
        return read_received(message, decoder)

    def add_transforms(message: M, static: bool) -> None:
        for transform in read(message, decode_transforms, message.topic, sync.tf.refuse):
            held = message.topic in roles.tf_held
            timed = transform if static else clocked(message, transform)
            sync.add_transform(timed, static, held=held, topic=message.topic)

    def clocked(message: M, transform: StampedTransform) -> StampedTransform:
        """Return the transform with the corrected stamp."""
        stamp = sync.stamped(message.topic, transform.stamp, message.received)
        return transform if stamp == transform.stamp else replace(transform, stamp=stamp)

    def add_image(message: M, camera: CameraRole) -> None:
        stamp, frame_id = message.header()
        decoder = decode_compressed_image if camera.kind == "CompressedImage" else decode_image
        sync.add_image(
            message.topic, stamp, frame_id, message.received, partial(read_received, message, decoder)
        )

    def add_packet(message: M) -> None:
        packet = read_received(message, decode_packet)
        video = sync.videos[packet.topic]
        if video.add(packet):
            sync.report.untold[packet.topic, packet.codec] += 1
        if not packet.is_header:
            load = partial(video.image, packet.place)
            sync.add_image(packet.topic, packet.stamp, packet.frame_id, packet.received, load)

    def add_info(message: M, rectified: bool) -> None:
        try:
            info = read(message, decode_camera_info, rectified, message.topic)
        except MessageError as error:
            sync.refuse_camera_info(message.topic, str(error))
            raise
        stamp, frame_id = message.header()
        sync.add_camera_info(message.topic, info, stamp, message.received, frame_id)

    def add_odometry(message: M) -> None:
        if sync.followed and not sync.tf.needs_odometry(sync.followed):
            return
        transform = read(message, decode_odometry, message.topic)
        sync.followed = transform.child
        sync.add_transform(clocked(message, transform), fallback=True)

    def add_imu(message: M) -> None:
        content = decode(message)
        rotation, acceleration, stamp = guard(message, decode_motion, content)
        at = sync.clocks.stamp(message.topic, stamp, message.received)
        sync.around.add_motion(message.topic, at, message.received, rotation, acceleration)
        if sync.upright.needs_gravity:
            sync.upright.add_acceleration(guard(message, decode_acceleration, content, message.topic))

    def add_truth(message: M) -> None:
        topic, received = message.topic, message.received
        if roles.boxes.get("topic") == topic:  # such a message may lack a header
            boxes = read_boxes(message)
            sync.add_truth(topic, boxes.stamp, received, partial(replace, boxes))
        else:
            stamp, _ = message.header()
            sync.add_truth(topic, stamp, received, partial(read_received, message, decode_detections_3d))

    def read_boxes(message: M) -> LabelledBoxes3D:
        stated = roles.boxes if roles.boxes.get("topic") == message.topic else {}
        return read(message, decode_boxes, message.topic, message.received, stated)

    handlers: dict[str, Handler[M]] = {}
    for topic in roles.lidars:
        handlers[topic] = lambda m: sync.add_cloud(read_cloud(m))
    for camera in roles.cameras:
        if camera.kind == "CompressedVideo":
            sync.videos.setdefault(camera.topic, Video(camera.topic, rewind))
            handlers[camera.topic] = add_packet
        else:
            handlers[camera.topic] = partial(add_image, camera=camera)
        if camera.info_topic:
            handlers[camera.info_topic] = partial(add_info, rectified=camera.rectified)
    for topic in roles.tf:
        handlers[topic] = partial(add_transforms, static=False)
    for topic in roles.tf_static:
        handlers[topic] = partial(add_transforms, static=True)
    if roles.odometry:
        handlers[roles.odometry] = add_odometry
    for topic in roles.imus:
        handlers[topic] = add_imu
    for topic in roles.robot_clouds:
        handlers[topic] = lambda m: sync.add_robot_cloud(read_cloud(m))
    for topic in roles.robot_detections_2d:
        handlers[topic] = lambda m: sync.add_detections(read_received(m, decode_detections_2d))
    for topic in roles.robot_detections_3d:
        handlers[topic] = lambda m: sync.add_boxes(read_boxes(m))
    if roles.truth:
        handlers[roles.truth] = add_truth
    return handlers | make_around_handlers(sync, roles, decode)


def make_around_handlers(
    sync: Synchronizer, roles: Roles, decode: Callable[[M], Any]
) -> dict[str, Handler[M]]:
    """Return a handler for each topic around perception."""

    def add(message: M, kind: str, short: str) -> None:
        content = decode(message)
        if kind == "mark":
            sync.around.add_mark(guard(message, decode_mark, content))
        elif kind == "status":
            sync.around.add_statuses(guard(message, decode_statuses, content))
        else:
            shapes = guard(message, decode_shapes, content, short, message.topic)
            sync.around.add_shapes(message.topic, shapes)

    return {topic: partial(add, kind=kind, short=short) for topic, kind, short in roles.around}
