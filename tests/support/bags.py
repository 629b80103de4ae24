"""Real bags for tests, written with rosbags in every format and compression, from KITTI or made up."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from bevviz.messages import definitions
from bevviz.model import geometry
from bevviz.model.frame import F32, F64, Intrinsics

START = 1_700_000_000_000_000_000
PERIOD = 100_000_000

CLOUD, IMAGE, INFO = "/velodyne_points", "/camera/image_rect_color", "/camera/camera_info"
LIDAR_FRAME, CAMERA_FRAME = "velodyne", "camera_optical"


class Item(NamedTuple):
    """A message and when it was logged."""

    topic: str
    type: str
    received: int
    message: Any


class Messages:
    """Makes messages of ROS 2 Jazzy, or of ROS 1 Noetic."""

    def __init__(self, ros1: bool = False) -> None:
        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
        definitions.register(self.store)
        if ros1:
            tf2 = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(tf2, "tf2_msgs/msg/TFMessage"))

    def make(self, kind: str, **values: Any) -> Any:
        return self.store.types[kind](**values)

    def header(self, stamp: int, frame_id: str) -> Any:
        time = self.make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        seq = {"seq": 0} if self.ros1 else {}
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame_id, **seq)

    def cloud(self, stamp: int, points: F32, frame_id: str = LIDAR_FRAME) -> Any:
        """Make a PointCloud2 of (N, 4) x, y, z, intensity."""
        field = "sensor_msgs/msg/PointField"
        fields = [
            self.make(field, name=name, offset=4 * i, datatype=7, count=1)
            for i, name in enumerate(("x", "y", "z", "intensity"))
        ]
        return self.make(
            "sensor_msgs/msg/PointCloud2",
            header=self.header(stamp, frame_id),
            height=1,
            width=len(points),
            fields=fields,
            is_bigendian=False,
            point_step=16,
            row_step=16 * len(points),
            data=np.ascontiguousarray(points, "<f4").view(np.uint8).reshape(-1),
            is_dense=True,
        )

    def image(self, stamp: int, bgr: Any, frame_id: str = CAMERA_FRAME) -> Any:
        height, width = bgr.shape[:2]
        return self.make(
            "sensor_msgs/msg/Image",
            header=self.header(stamp, frame_id),
            height=height,
            width=width,
            encoding="bgr8",
            is_bigendian=0,
            step=3 * width,
            data=np.ascontiguousarray(bgr).reshape(-1),
        )

    def marker(
        self,
        frame_id: str,
        pose: Any,
        size: Sequence[float],
        *,
        ns: str,
        number: int = 0,
        kind: int = 1,
        action: int = 0,
        text: str = "",
    ) -> Any:
        """Make a visualization_msgs/Marker, by default a cube."""
        return self.make(
            "visualization_msgs/msg/Marker",
            header=self.header(START, frame_id),
            ns=ns,
            id=number,
            type=kind,
            action=action,
            pose=pose,
            scale=self.make("geometry_msgs/msg/Vector3", **dict(zip("xyz", size, strict=True))),
            color=self.make("std_msgs/msg/ColorRGBA", r=1.0, g=0.0, b=0.0, a=1.0),
            lifetime=self.make("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
            frame_locked=False,
            points=[],
            colors=[],
            texture_resource="",
            texture=self.compressed(0, b""),
            uv_coordinates=[],
            text=text,
            mesh_resource="",
            mesh_file=self.make("visualization_msgs/msg/MeshFile", filename="", data=np.zeros(0, np.uint8)),
            mesh_use_embedded_materials=False,
        )

    def compressed(self, stamp: int, encoded: bytes, form: str = "png", frame_id: str = CAMERA_FRAME) -> Any:
        return self.make(
            "sensor_msgs/msg/CompressedImage",
            header=self.header(stamp, frame_id),
            format=form,
            data=np.frombuffer(encoded, np.uint8),
        )

    def camera_info(self, stamp: int, intrinsics: Intrinsics, frame_id: str = CAMERA_FRAME) -> Any:
        values = {
            "d": np.zeros(5),
            "k": intrinsics.K.reshape(-1),
            "r": np.eye(3).reshape(-1),
            "p": np.column_stack([intrinsics.K, np.zeros(3)]).reshape(-1),
        }
        roi = self.make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(stamp, frame_id),
            height=intrinsics.height,
            width=intrinsics.width,
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=roi,
            **{name.upper() if self.ros1 else name: value for name, value in values.items()},
        )

    def transforms(self, stamp: int, *edges: tuple[str, str, F64]) -> Any:
        """Make a TFMessage of (parent, child, parent_from_child)."""
        return self.make("tf2_msgs/msg/TFMessage", transforms=[self._edge(stamp, *edge) for edge in edges])

    def _edge(self, stamp: int, parent: str, child: str, parent_from_child: F64) -> Any:
        x, y, z = map(float, parent_from_child[:3, 3])
        qx, qy, qz, qw = map(float, geometry.quaternion(parent_from_child))
        return self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(stamp, parent),
            child_frame_id=child,
            transform=self.make(
                "geometry_msgs/msg/Transform",
                translation=self.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
                rotation=self.make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
            ),
        )


@dataclass(frozen=True)
class Kitti:
    """One frame of the KITTI object benchmark, the camera being image_2."""

    points: F32  # (N, 4)
    png: bytes
    intrinsics: Intrinsics
    camera_from_lidar: F64
    pixels_from_lidar: F64  # (3, 4) P2 @ R0_rect @ Tr_velo_to_cam, as KITTI has it


def kitti(shared: Path, name: str) -> Kitti:
    """Read a frame. P2 = K [I | t]: its fourth column is where image_2 is beside the reference camera."""
    import cv2

    folder = shared / "kitti"
    rows = dict(
        line.split(":", 1) for line in (folder / "calib" / f"{name}.txt").read_text().splitlines() if line
    )
    numbers = {key: np.array(value.split(), np.float64) for key, value in rows.items()}
    p2 = numbers["P2"].reshape(3, 4)
    rectified, reference = np.eye(4), np.eye(4)
    rectified[:3, :3] = numbers["R0_rect"].reshape(3, 3)
    reference[:3] = numbers["Tr_velo_to_cam"].reshape(3, 4)
    beside = np.eye(4)
    beside[:3, 3] = np.linalg.solve(p2[:, :3], p2[:, 3])
    png = (folder / "image_2" / f"{name}.png").read_bytes()
    image: Any = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    height, width = image.shape[:2]
    return Kitti(
        points=np.fromfile(folder / "velodyne" / f"{name}.bin", np.float32).reshape(-1, 4),
        png=png,
        intrinsics=Intrinsics(width, height, p2[:, :3]),
        camera_from_lidar=beside @ rectified @ reference,
        pixels_from_lidar=p2 @ rectified @ reference,
    )


def kitti_items(
    shared: Path,
    messages: Messages | None = None,
    names: Sequence[str] = ("000000", "000001"),
    *,
    scans: int | None = None,
    compressed: bool = True,
    lidar_frame: str = LIDAR_FRAME,
    step: int = 1,
) -> list[Item]:
    """Return KITTI frames as a drive at 10 Hz: cloud, image, CameraInfo, and /tf_static before each scan.

    Args:
        shared: the folder of real test data.
        messages: makes the messages; its store has the types.
        names: of the KITTI frames.
        scans: number of scans; the frames take turns (default: each once).
        compressed: PNG as CompressedImage, else Image.
        lidar_frame: frame_id of the clouds.
        step: only each step-th point.
    """
    import cv2

    messages = messages or Messages()
    frames = [kitti(shared, name) for name in names]
    found: list[Item] = []
    for i in range(len(frames) if scans is None else scans):
        frame, stamp = frames[i % len(frames)], START + i * PERIOD
        mounting = (lidar_frame, CAMERA_FRAME, geometry.inverse(frame.camera_from_lidar))
        found.append(
            Item("/tf_static", "tf2_msgs/msg/TFMessage", stamp, messages.transforms(stamp, mounting))
        )
        info = messages.camera_info(stamp, frame.intrinsics)
        found.append(Item(INFO, "sensor_msgs/msg/CameraInfo", stamp, info))
        if compressed:
            image = messages.compressed(stamp, frame.png)
            found.append(Item(f"{IMAGE}/compressed", "sensor_msgs/msg/CompressedImage", stamp, image))
        else:
            bgr = cv2.imdecode(np.frombuffer(frame.png, np.uint8), cv2.IMREAD_COLOR)
            found.append(Item(IMAGE, "sensor_msgs/msg/Image", stamp, messages.image(stamp, bgr)))
        cloud = messages.cloud(stamp, frame.points[::step], lidar_frame)
        found.append(Item(CLOUD, "sensor_msgs/msg/PointCloud2", stamp + PERIOD // 10, cloud))
    return found


def small_items(messages: Messages | None = None, scans: int = 30, points: int = 200) -> list[Item]:
    """Make a drive without KITTI: random clouds, noise images of 64 x 48 and a drive straight ahead in /tf.

    The first point of scan i has x = i.
    """
    messages = messages or Messages()
    rng = np.random.default_rng(0)
    camera = Intrinsics(64, 48, np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]))
    lidar_from_camera = geometry.transform(np.array([0.1, 0, -0.2]), np.array([-0.5, 0.5, -0.5, 0.5]))
    mounting = [
        ("base_link", LIDAR_FRAME, geometry.transform(np.array([0, 0, 1.8]), np.array([0.0, 0, 0, 1]))),
        (LIDAR_FRAME, CAMERA_FRAME, lidar_from_camera),
    ]
    tf = "tf2_msgs/msg/TFMessage"
    found = [Item("/tf_static", tf, START, messages.transforms(START, *mounting))]
    for i in range(scans):
        stamp = START + i * PERIOD
        pose = geometry.transform(np.array([float(i), 0, 0]), np.array([0.0, 0, 0, 1]))
        found.append(Item("/tf", tf, stamp, messages.transforms(stamp, ("odom", "base_link", pose))))
        info = messages.camera_info(stamp, camera)
        found.append(Item(INFO, "sensor_msgs/msg/CameraInfo", stamp, info))
        bgr = rng.integers(0, 255, (48, 64, 3), np.uint8)
        found.append(Item(IMAGE, "sensor_msgs/msg/Image", stamp, messages.image(stamp, bgr)))
        xyzi = rng.normal(0, 10, (points, 4)).astype(np.float32)
        xyzi[0, 0] = i
        cloud = messages.cloud(stamp, xyzi)
        found.append(Item(CLOUD, "sensor_msgs/msg/PointCloud2", stamp + PERIOD // 10, cloud))
    return found


def write(
    path: Path,
    items: Iterable[Item],
    messages: Messages | None = None,
    *,
    form: str = "mcap",
    compression: str = "",
    topics: Iterable[tuple[str, str]] = (),
) -> Path:
    """Write a bag in order of log time: a folder, or a file for ROS 1.

    Args:
        path: of the bag, which must not exist.
        items: the messages with their topics and times.
        messages: makes the messages; its store has the types.
        form: mcap, sqlite3 or ros1.
        compression: of rosbag2 (file, message, storage) or of ROS 1 (bz2, lz4).
        topics: (name, type) of topics without messages.
    """
    messages = messages or Messages(form == "ros1")
    store = messages.store
    writer: Any
    if form == "ros1":
        writer = Writer1(path)
        if compression:
            writer.set_compression(Writer1.CompressionFormat[compression.upper()])
    else:
        writer = Writer(path, version=9, storage_plugin=StoragePlugin[form.upper()])
        if compression:
            writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    connections: dict[str, Any] = {}
    with writer:
        for topic, kind in topics:
            connections[topic] = writer.add_connection(topic, kind, typestore=store)
        for item in sorted(items, key=lambda i: i.received):
            if item.topic not in connections:
                connections[item.topic] = writer.add_connection(item.topic, item.type, typestore=store)
            serialize = store.serialize_ros1 if form == "ros1" else store.serialize_cdr
            data = item.message if isinstance(item.message, bytes) else serialize(item.message, item.type)
            writer.write(connections[item.topic], item.received, data)
    return path
