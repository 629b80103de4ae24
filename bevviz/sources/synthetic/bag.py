"""The drive as a real MCAP bag, with the topics of the ROS 2 tutorial pipeline."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from bevviz import geometry
from bevviz.errors import UserError
from bevviz.frame import F64, Cloud, Frame, Image, Intrinsics, LabelledBoxes3D
from bevviz.sources import vision_msgs
from bevviz.sources.synthetic import drive
from bevviz.sources.synthetic.drive import SyntheticSource

TOPICS = {
    drive.LIDAR_TOPIC: "sensor_msgs/msg/PointCloud2",
    drive.IMAGE_TOPIC: "sensor_msgs/msg/Image",
    drive.CAMERA_INFO_TOPIC: "sensor_msgs/msg/CameraInfo",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    drive.ODOMETRY_TOPIC: "nav_msgs/msg/Odometry",
    drive.TRUTH_TOPIC: "vision_msgs/msg/Detection3DArray",
}

ODOMETRY_PERIOD = 20_000_000  # nanoseconds


class BagWriter:
    """Context manager: ``write`` each frame of ``source`` in order; the file appears when all went well.

    Args:
        source: whose poses and calibration are written beside the frames.
        path: the ``.mcap`` file to make.

    Raises:
        UserError: ``path`` does not end in .mcap, exists already, or cannot be written.
    """

    def __init__(self, source: SyntheticSource, path: Path) -> None:
        if path.suffix != ".mcap":
            raise UserError(f"{path}: a bag is written as MCAP, so its name must end in .mcap")
        if path.exists():
            raise UserError(f"{path} exists already; remove it or give another name")
        self._source, self._path = source, path
        self._store = get_typestore(Stores.ROS2_JAZZY)
        vision_msgs.register(self._store)

    def __enter__(self) -> BagWriter:
        try:
            # rosbags makes a folder with metadata.yaml; one .mcap is complete without, and is moved out.
            self._folder = tempfile.TemporaryDirectory(prefix=".bevviz-", dir=self._path.parent)
        except OSError as error:
            raise UserError(f"{self._path}: cannot write the bag: {error.strerror}") from None
        self._writer = Writer(Path(self._folder.name) / "bag", version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.open()
        self._topics = {
            topic: self._writer.add_connection(
                topic, kind, typestore=self._store, offered_qos_profiles=[_qos(latched=topic == "/tf_static")]
            )
            for topic, kind in TOPICS.items()
        }
        self._write_mounting()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._writer.close()
                next(Path(self._folder.name).glob("bag/*.mcap")).replace(self._path)
            else:
                self._writer.abort()
        except OSError as failure:
            raise UserError(f"{self._path}: cannot write the bag: {failure.strerror}") from None
        finally:
            self._folder.cleanup()

    def write(self, frame: Frame) -> None:
        """Append one frame, with odometry and transforms up to the next one."""
        cloud, camera, truth = frame.clouds[0], frame.cameras[0], frame.truth
        messages = [(drive.LIDAR_TOPIC, cloud.received, self._cloud(cloud))]
        for stamp in range(frame.stamp, frame.stamp + drive.PERIOD, ODOMETRY_PERIOD):
            messages += self._poses(stamp)
        if truth is not None:
            messages.append((drive.TRUTH_TOPIC, truth.received, self._boxes(truth)))
        if camera.image is not None and camera.intrinsics is not None:
            received, info = camera.image.received, self._camera_info(camera.image, camera.intrinsics)
            messages += [
                (drive.CAMERA_INFO_TOPIC, received, info),
                (drive.IMAGE_TOPIC, received, self._image(camera.image)),
            ]
        for topic, received, message in sorted(messages, key=lambda m: m[1]):
            self._put(topic, received, message)

    def _put(self, topic: str, received: int, message: Any) -> None:
        data = self._store.serialize_cdr(message, TOPICS[topic])
        try:
            self._writer.write(self._topics[topic], received, data)
        except OSError as error:
            raise UserError(f"{self._path}: cannot write the bag: {error.strerror}") from None

    def _make(self, kind: str, **values: Any) -> Any:
        return self._store.types[kind](**values)

    def _header(self, stamp: int, frame_id: str) -> Any:
        time = self._make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        return self._make("std_msgs/msg/Header", stamp=time, frame_id=frame_id)

    def _vector(self, kind: str, xyz: Iterable[float]) -> Any:
        x, y, z = map(float, xyz)
        return self._make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    def _rotation(self, a_from_b: F64) -> Any:
        x, y, z, w = map(float, geometry.quaternion(a_from_b))
        return self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _pose(self, a_from_b: F64) -> Any:
        position = self._vector("Point", a_from_b[:3, 3])
        return self._make("geometry_msgs/msg/Pose", position=position, orientation=self._rotation(a_from_b))

    def _transform(self, stamp: int, parent: str, child: str, parent_from_child: F64) -> Any:
        transform = self._make(
            "geometry_msgs/msg/Transform",
            translation=self._vector("Vector3", parent_from_child[:3, 3]),
            rotation=self._rotation(parent_from_child),
        )
        return self._make(
            "geometry_msgs/msg/TransformStamped",
            header=self._header(stamp, parent),
            child_frame_id=child,
            transform=transform,
        )

    def _write_mounting(self) -> None:
        stamp = drive.START
        mounts = [
            self._transform(stamp, drive.BASE, drive.LIDAR_FRAME, self._source.base_from_lidar),
            self._transform(stamp, drive.BASE, drive.CAMERA_FRAME, self._source.base_from_camera),
        ]
        self._put("/tf_static", stamp, self._make("tf2_msgs/msg/TFMessage", transforms=mounts))

    def _poses(self, stamp: int) -> list[tuple[str, int, Any]]:
        source = self._source
        odom_from_map = geometry.inverse(source.map_from_odom)
        pose = odom_from_map @ source.map_from_base(stamp)
        later = odom_from_map @ source.map_from_base(stamp + 1_000_000)
        step = geometry.inverse(pose) @ later
        turn = [step[2, 1] - step[1, 2], step[0, 2] - step[2, 0], step[1, 0] - step[0, 1]]
        twist = self._make(
            "geometry_msgs/msg/Twist",
            linear=self._vector("Vector3", step[:3, 3] / 1e-3),
            angular=self._vector("Vector3", np.divide(turn, 2e-3)),
        )
        chain = [
            self._transform(stamp, drive.MAP, drive.ODOM, source.map_from_odom),
            self._transform(stamp, drive.ODOM, drive.BASE, pose),
        ]
        none = np.zeros(36)
        odometry = self._make(
            "nav_msgs/msg/Odometry",
            header=self._header(stamp, drive.ODOM),
            child_frame_id=drive.BASE,
            pose=self._make("geometry_msgs/msg/PoseWithCovariance", pose=self._pose(pose), covariance=none),
            twist=self._make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=none),
        )
        transforms = self._make("tf2_msgs/msg/TFMessage", transforms=chain)
        return [("/tf", stamp, transforms), (drive.ODOMETRY_TOPIC, stamp, odometry)]

    def _cloud(self, cloud: Cloud) -> Any:
        columns = dict(zip("xyz", cloud.xyz.T, strict=True)) | dict(cloud.fields)
        layout = np.dtype([(name, values.dtype) for name, values in columns.items()], align=True)
        points = np.zeros(len(cloud.xyz), layout)
        for name, values in columns.items():
            points[name] = values
        codes = {"uint16": 4, "float32": 7}  # sensor_msgs/PointField
        fields = [
            self._make(
                "sensor_msgs/msg/PointField",
                name=name,
                offset=int(layout.fields[name][1]),  # type: ignore[index]
                datatype=codes[values.dtype.name],
                count=1,
            )
            for name, values in columns.items()
        ]
        return self._make(
            "sensor_msgs/msg/PointCloud2",
            header=self._header(cloud.stamp, cloud.frame_id),
            height=1,
            width=len(points),
            fields=fields,
            is_bigendian=False,
            point_step=layout.itemsize,
            row_step=layout.itemsize * len(points),
            data=points.view(np.uint8),
            is_dense=True,
        )

    def _image(self, image: Image) -> Any:
        height, width = image.bgr.shape[:2]
        return self._make(
            "sensor_msgs/msg/Image",
            header=self._header(image.stamp, image.frame_id),
            height=height,
            width=width,
            encoding="bgr8",
            is_bigendian=0,
            step=3 * width,
            data=image.bgr.reshape(-1),
        )

    def _camera_info(self, image: Image, intrinsics: Intrinsics) -> Any:
        k = intrinsics.K
        region = self._make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self._make(
            "sensor_msgs/msg/CameraInfo",
            header=self._header(image.stamp, image.frame_id),
            height=intrinsics.height,
            width=intrinsics.width,
            distortion_model=intrinsics.distortion_model,
            d=np.asarray(intrinsics.D, np.float64),
            k=k.reshape(-1),
            r=np.eye(3).reshape(-1),
            p=np.column_stack([k, np.zeros(3)]).reshape(-1),
            binning_x=0,
            binning_y=0,
            roi=region,
        )

    def _boxes(self, truth: LabelledBoxes3D) -> Any:
        boxes, header = truth.boxes, self._header(truth.stamp, truth.frame_id)
        detections = []
        for k, label in enumerate(truth.labels):
            half = float(boxes.yaw[k]) / 2
            pose = self._pose(
                geometry.transform(boxes.center[k], np.array([0, 0, np.sin(half), np.cos(half)]))
            )
            hypothesis = self._make(
                "vision_msgs/msg/ObjectHypothesisWithPose",
                hypothesis=self._make(
                    "vision_msgs/msg/ObjectHypothesis", class_id=label, score=float(truth.scores[k])
                ),
                pose=self._make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
            )
            bbox = self._make(
                "vision_msgs/msg/BoundingBox3D", center=pose, size=self._vector("Vector3", boxes.size[k])
            )
            detections.append(
                self._make(
                    "vision_msgs/msg/Detection3D", header=header, results=[hypothesis], bbox=bbox, id=""
                )
            )
        return self._make("vision_msgs/msg/Detection3DArray", header=header, detections=detections)


def write_bag(source: SyntheticSource, path: Path, frames: Iterable[Frame] | None = None) -> None:
    """Write the whole drive to one MCAP file.

    Args:
        source: the drive.
        path: the ``.mcap`` file to make.
        frames: the source's frames, where the caller already iterates them (under a progress bar, say).

    Raises:
        UserError: ``path`` does not end in .mcap, exists already, or cannot be written.
    """
    with BagWriter(source, path) as bag:
        for frame in source if frames is None else frames:
            bag.write(frame)


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
