"""Write the drive as an MCAP bag with the topics of the ROS 2 tutorial pipeline."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Any

from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)

from bevviz.bags.mcap_writer import McapWriter
from bevviz.errors import UserError
from bevviz.extras.demo import drive
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.messages.definitions import typestore
from bevviz.messages.encode import (
    encode_boxes_3d,
    encode_camera_info,
    encode_cloud,
    encode_compressed_image,
    encode_image,
    encode_odometry,
    encode_transforms,
)
from bevviz.model import geometry
from bevviz.model.frame import Frame

TOPICS = {
    drive.LIDAR_TOPIC: "sensor_msgs/msg/PointCloud2",
    drive.IMAGE_TOPIC: "sensor_msgs/msg/Image",
    drive.CAMERA_INFO_TOPIC: "sensor_msgs/msg/CameraInfo",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    drive.ODOMETRY_TOPIC: "nav_msgs/msg/Odometry",
    drive.TRUTH_TOPIC: "vision_msgs/msg/Detection3DArray",
}
JPEG_TOPIC = f"{drive.IMAGE_TOPIC}/compressed"  # in place of the images, where these have the bytes of a JPEG
JPEG_TYPE = "sensor_msgs/msg/CompressedImage"

ODOMETRY_PERIOD = 20_000_000  # nanoseconds


class BagWriter:
    """Context manager that writes frames to a bag. The file appears only if there was no error.

    Call ``write`` for each frame of ``source`` in order.

    Args:
        source: its poses and calibration are written beside the frames.
        path: the ``.mcap`` file to make.
        compress: compress what is written.

    Raises:
        UserError: ``path`` does not end in .mcap, exists already, or cannot be written.
    """

    def __init__(self, source: SyntheticSource, path: Path, compress: bool = False) -> None:
        if path.suffix != ".mcap":
            raise UserError(f"{path}: a bag is written as MCAP, so its name must end in .mcap")
        if path.exists():
            raise UserError(f"{path} exists already; remove it or give another name")
        self._source = source
        self._writer = McapWriter(path, lambda connection: connection.msgdef, compress=compress)
        self._types = {**TOPICS, JPEG_TOPIC: JPEG_TYPE}
        self._connections = {topic: _connection(topic, kind) for topic, kind in self._types.items()}

    def __enter__(self) -> BagWriter:
        self._writer.__enter__()
        self._put("/tf_static", drive.START, mounting(self._source))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.__exit__(kind, error, trace)

    def write(self, frame: Frame) -> None:
        """Append one frame, with odometry and transforms up to the next frame."""
        for topic, received, message in messages(self._source, frame):
            self._put(topic, received, message)

    def _put(self, topic: str, received: int, message: Any) -> None:
        """Append one message."""
        data = typestore().serialize_cdr(message, self._types[topic])
        self._writer.write(self._connections[topic], received, data)


def mounting(source: SyntheticSource) -> Any:
    """Return the message of /tf_static."""
    edges = [
        (drive.BASE, drive.LIDAR_FRAME, source.base_from_lidar),
        (drive.BASE, drive.CAMERA_FRAME, source.base_from_camera),
    ]
    return encode_transforms(drive.START, edges)


def messages(source: SyntheticSource, frame: Frame) -> list[tuple[str, int, Any]]:
    """Return topic, time of receipt and message of a frame and the time up to the next frame, in order."""
    cloud, camera, truth = frame.clouds[0], frame.cameras[0], frame.truth
    timed_messages = [(drive.LIDAR_TOPIC, cloud.received, encode_cloud(cloud))]
    for stamp in range(frame.stamp, frame.stamp + drive.PERIOD, ODOMETRY_PERIOD):
        timed_messages += _poses(source, stamp)
    if truth is not None:
        results = [[pair] for pair in zip(truth.labels, truth.scores.tolist(), strict=True)]
        boxes = encode_boxes_3d(truth.stamp, truth.frame_id, truth.boxes, results, ids=truth.ids)
        timed_messages.append((drive.TRUTH_TOPIC, truth.received, boxes))
    if camera.image is not None and camera.intrinsics is not None:
        received, info = camera.image.received, encode_camera_info(camera.image, camera.intrinsics)
        timed_messages += [
            (drive.CAMERA_INFO_TOPIC, received, info),
            (drive.IMAGE_TOPIC, received, encode_image(camera.image)),
        ]
        if (jpeg := camera.image.encoded) is not None:
            message = encode_compressed_image(camera.image.stamp, camera.image.frame_id, jpeg, "jpeg")
            timed_messages[-1] = (JPEG_TOPIC, received, message)
    return sorted(timed_messages, key=lambda m: m[1])


def _poses(source: SyntheticSource, stamp: int) -> list[tuple[str, int, Any]]:
    """Return the transforms and the odometry at a stamp."""
    odom_from_map = geometry.inverse(source.map_from_odom)
    pose = odom_from_map @ source.map_from_base(stamp)
    later = odom_from_map @ source.map_from_base(stamp + 1_000_000)
    chain = [(drive.MAP, drive.ODOM, source.map_from_odom), (drive.ODOM, drive.BASE, pose)]
    odometry = encode_odometry(stamp, drive.ODOM, drive.BASE, pose, later, 1e-3)
    return [("/tf", stamp, encode_transforms(stamp, chain)), (drive.ODOMETRY_TOPIC, stamp, odometry)]


def write_bag(
    source: SyntheticSource, path: Path, frames: Iterable[Frame] | None = None, compress: bool = False
) -> None:
    """Write the whole drive to one MCAP file. An image that has the bytes of a JPEG is written as these.

    Args:
        source: the drive.
        path: the ``.mcap`` file to make.
        frames: the source's frames, if the caller already iterates over them, e.g. with a progress bar.
        compress: compress what is written.

    Raises:
        UserError: ``path`` does not end in .mcap, exists already, or cannot be written.
    """
    with BagWriter(source, path, compress) as bag:
        for frame in source if frames is None else frames:
            bag.write(frame)


def _connection(topic: str, kind: str) -> Connection:
    definition, digest = typestore().generate_msgdef(kind, ros_version=2)
    message = MessageDefinition(MessageDefinitionFormat.MSG, definition)
    extra = ConnectionExtRosbag2("cdr", [_qos(latched=topic == "/tf_static")])
    return Connection(0, topic, kind, message, digest, 0, extra, None)


def _qos(latched: bool) -> Qos:
    forever = QosTime(9223372036, 854775807)
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=1 if latched else 10,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=forever,
        lifespan=forever,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=forever,
        avoid_ros_namespace_conventions=False,
    )
