"""A robot for the soak: publishes a rendered drive over DDS, forth and back, until it is terminated.

Run by ``benchmarks.soak --dds`` in a process of its own. Its messages are those of rclpy; tf2_msgs has no
wheel, so that its one message is written here. Of bevviz it takes nothing but rclpy's class for that type.
The folder has ``scan_N.npy`` (a table of points), ``image_N.npy``, ``camera.json`` and ``poses.json``.
"""

from __future__ import annotations

import array
import json
import signal
import struct
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

CLOUD, IMAGE, CAMERA, MOTION, MOUNTING = "/points", "/image_raw", "/camera_info", "/tf", "/tf_static"
POSES = 5  # transforms from one scan to the next, as of odometry with 50 Hz
FIELDS = {"<f4": 7, "<u2": 4}  # numbers of PointField


def main(folder: Path, rate: float) -> None:
    import rclpy
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from rclpy.signals import SignalHandlerOptions
    from sensor_msgs.msg import CameraInfo, Image, PointCloud2

    from bevviz.live.typesupport import message_type

    about, poses = (json.loads((folder / f"{name}.json").read_text()) for name in ("camera", "poses"))
    clouds = [cloud_of(np.load(path), about["lidar"]) for path in sorted(folder.glob("scan_*.npy"))]
    images = [image_of(np.load(path), about["camera"]) for path in sorted(folder.glob("image_*.npy"))]
    info = CameraInfo(
        width=images[0].width, height=images[0].height, distortion_model="plumb_bob", d=[0.0] * 5
    )
    info.k, info.header.frame_id = about["K"], about["camera"]
    info.p = [*info.k[0:3], 0.0, *info.k[3:6], 0.0, *info.k[6:9], 0.0]

    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("soak_robot")
    transforms, latched = message_type("tf2_msgs/msg/TFMessage"), DurabilityPolicy.TRANSIENT_LOCAL
    mounting = node.create_publisher(transforms, MOUNTING, QoSProfile(depth=1, durability=latched))
    mounting.publish(transforms_of(time.time_ns(), about["mounting"]))
    motion = node.create_publisher(transforms, MOTION, 100)
    classes = {CLOUD: PointCloud2, IMAGE: Image, CAMERA: CameraInfo}
    publishers = {topic: node.create_publisher(kind, topic, 5) for topic, kind in classes.items()}

    # Scan, image and its calibration begin a period, and the poses divide it.
    order = [*range(len(clouds)), *range(len(clouds) - 2, 0, -1)]
    start, begin, step = time.monotonic(), time.time_ns(), 1 / (rate * POSES)
    number = 0
    while not ended.wait(max(0.0, start + number * step - time.monotonic())):
        stamp = begin + round(number * step * 1e9)
        scan, part = divmod(number, POSES)
        forth = scan % len(order) < len(clouds) - 1
        pose = poses[POSES * order[scan % len(order)] + (part if forth else -part)]
        motion.publish(transforms_of(stamp, [pose]))
        if part == 0:
            row = order[scan % len(order)]
            for topic, message in ((CLOUD, clouds[row]), (CAMERA, info), (IMAGE, images[row])):
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
                publishers[topic].publish(message)
        number += 1


def cloud_of(points: NDArray[Any], frame_id: str) -> Any:
    """Return the message of a table of points."""
    from sensor_msgs.msg import PointCloud2, PointField

    size, count = points.dtype.itemsize, len(points)
    cloud = PointCloud2(height=1, width=count, point_step=size, row_step=size * count, is_dense=True)
    for name, (kind, offset, *_) in (points.dtype.fields or {}).items():
        cloud.fields.append(PointField(name=name, offset=offset, datatype=FIELDS[kind.str], count=1))
    cloud.data, cloud.header.frame_id = array.array("B", points.tobytes()), frame_id
    return cloud


def image_of(pixels: NDArray[np.uint8], frame_id: str) -> Any:
    """Return the message of an image in BGR."""
    from sensor_msgs.msg import Image

    height, width, _ = pixels.shape
    image = Image(width=width, height=height, encoding="bgr8", step=3 * width)
    image.data, image.header.frame_id = array.array("B", pixels.tobytes()), frame_id
    return image


def transforms_of(stamp: int, transforms: list[Any]) -> bytes:
    """Return a serialised TFMessage of parent, child, and position with quaternion."""
    data = bytearray(struct.pack("<I", len(transforms)))
    for parent, child, values in transforms:
        data += bytes(-len(data) % 4) + struct.pack("<iI", *divmod(stamp, 10**9))
        for name in (parent, child):
            data += bytes(-len(data) % 4) + struct.pack("<I", len(name) + 1) + name.encode() + b"\0"
        data += bytes(-len(data) % 8) + struct.pack("<7d", *values)
    return b"\0\1\0\0" + bytes(data)  # CDR, little endian


if __name__ == "__main__":
    main(Path(sys.argv[1]), float(sys.argv[2]))
