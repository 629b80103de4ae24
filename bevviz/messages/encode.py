"""Encoders of arrays into ROS 2 messages, as objects that rosbags serialises."""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype

from bevviz.messages.definitions import typestore
from bevviz.model import geometry
from bevviz.model.frame import F32, F64, I64, Boxes3D, Cloud, Image, Intrinsics

Hypotheses = Sequence[tuple[str, float]]  # class and score; the first one is that of the box itself


def encode_cloud(cloud: Cloud) -> Any:
    """Make a sensor_msgs/PointCloud2 with all fields of a cloud. It announces the dropped points, too."""
    columns = dict(zip("xyz", cloud.xyz.T, strict=True)) | dict(cloud.fields)
    layout = np.dtype([(name, values.dtype) for name, values in columns.items()], align=True)
    points = np.zeros(len(cloud.xyz), layout)
    for name, values in columns.items():
        points[name] = values
    return encode_points(cloud.stamp, cloud.frame_id, points, len(points) + cloud.dropped)


def encode_points(stamp: int, frame_id: str, points: NDArray[np.void], announced: int = 0) -> Any:
    """Make a sensor_msgs/PointCloud2 of (N,) structured points. The points are not copied.

    Args:
        stamp: nanoseconds.
        frame_id: frame of the header.
        points: structured array with fields of numbers.
        announced: number of points that the message states, if larger than N. The difference counts as lost.
    """
    layout, width = points.dtype, max(len(points), announced)
    fields = [
        make_message(
            "sensor_msgs/msg/PointField",
            name=name,
            offset=int(layout.fields[name][1]),  # type: ignore[index]
            datatype=POINT_FIELD[layout[name].str[1:]],
            count=1,
        )
        for name in layout.names or ()
    ]
    return make_message(
        "sensor_msgs/msg/PointCloud2",
        header=make_header(stamp, frame_id),
        height=1,
        width=width,
        fields=fields,
        point_step=layout.itemsize,
        row_step=layout.itemsize * width,
        data=points.view(np.uint8),
        is_dense=True,
    )


# Datatype of a PointField, by dtype.
POINT_FIELD: Mapping[str, int] = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def encode_image(image: Image) -> Any:
    """Make a sensor_msgs/Image in bgr8."""
    height, width = image.bgr.shape[:2]
    return make_message(
        "sensor_msgs/msg/Image",
        header=make_header(image.stamp, image.frame_id),
        height=height,
        width=width,
        encoding="bgr8",
        step=3 * width,
        data=np.ascontiguousarray(image.bgr).reshape(-1),
    )


def encode_compressed_image(stamp: int, frame_id: str, encoded: bytes, kind: str) -> Any:
    """Make a sensor_msgs/CompressedImage from the bytes of a file. ``kind`` is png or jpeg."""
    return make_message(
        "sensor_msgs/msg/CompressedImage",
        header=make_header(stamp, frame_id),
        format=kind,
        data=np.frombuffer(encoded, np.uint8),
    )


def encode_camera_info(image: Image, intrinsics: Intrinsics) -> Any:
    """Make the sensor_msgs/CameraInfo of an image."""
    return encode_intrinsics(image.stamp, image.frame_id, intrinsics)


def encode_intrinsics(stamp: int, frame_id: str, intrinsics: Intrinsics) -> Any:
    """Make a sensor_msgs/CameraInfo with a stamp and a frame."""
    k, size = intrinsics.K, (intrinsics.width, intrinsics.height)
    p = np.column_stack([k, np.zeros(3)]).reshape(-1)
    d = np.asarray(intrinsics.D, np.float64)
    return encode_camera(make_header(stamp, frame_id), size, intrinsics.distortion_model, d, k.reshape(-1), p)


def encode_camera(header: Any, size: tuple[int, int], model: str, d: F64, k: F64, p: F64) -> Any:
    """Make a sensor_msgs/CameraInfo.

    Args:
        header: std_msgs/Header.
        size: width and height, pixels.
        model: distortion model.
        d: coefficients of the distortion model.
        k: (9,) camera matrix, row by row.
        p: (12,) projection matrix, row by row; zeros are written for another size.
    """
    return make_message(
        "sensor_msgs/msg/CameraInfo",
        header=header,
        width=size[0],
        height=size[1],
        distortion_model=model,
        d=d,
        k=k,
        r=np.eye(3).reshape(-1),
        p=p if p.size == 12 else np.zeros(12),
    )


def encode_boxes_3d(
    stamp: int,
    frame_id: str,
    boxes: Boxes3D,
    results: Iterable[Hypotheses],
    pose: F64 | None = None,
    ids: Sequence[str] = (),
) -> Any:
    """Make a vision_msgs/Detection3DArray.

    Args:
        stamp: nanoseconds.
        frame_id: frame of the header.
        boxes: boxes in a frame of their own.
        results: hypotheses of each box.
        pose: (4, 4) frame_id from the frame of the boxes; None: both are the same.
        ids: id of each box; empty: the boxes have none.
    """
    turn = np.eye(4) if pose is None else pose
    about = make_header(stamp, frame_id)
    detections = []
    names = ids or [""] * len(boxes)
    for center, size, yaw, hypotheses, name in zip(
        boxes.center, boxes.size, boxes.yaw, results, names, strict=True
    ):
        turned = bool(np.isfinite(yaw))
        half = float(yaw) / 2 if turned else 0.0
        place = _pose(turn @ geometry.transform(center, np.array([0, 0, np.sin(half), np.cos(half)])))
        if not turned:  # marks an unknown orientation for readers of the message
            place.orientation.w = np.nan
        box = make_message("vision_msgs/msg/BoundingBox3D", center=place, size=_vector("Vector3", size))
        kept = _results(hypotheses, place)
        detection = make_message("vision_msgs/msg/Detection3D", header=about, results=kept, bbox=box, id=name)
        detections.append(detection)
    return make_message("vision_msgs/msg/Detection3DArray", header=about, detections=detections)


def encode_markers(
    stamp: int, frame_id: str, boxes: Boxes3D, velocity: F32, ids: I64, texts: Iterable[str], pose: F64 | None
) -> Any:
    """Make a visualization_msgs/MarkerArray.

    Each box becomes a cube, an arrow for its way in one second, and a text. The markers expire by themselves
    after half a second.

    Args:
        stamp: nanoseconds.
        frame_id: frame of the header.
        boxes: boxes in a frame of their own.
        velocity: (N, 3) m/s.
        ids: number of each box, for its colour and its marker.
        texts: text of each box.
        pose: (4, 4) frame_id from the frame of the boxes; None: both are the same.
    """
    turn, markers = np.eye(4) if pose is None else pose, []
    about = make_header(stamp, frame_id)
    lasting = make_message("builtin_interfaces/msg/Duration", nanosec=500_000_000)
    for center, size, yaw, way, number, text in zip(
        boxes.center, boxes.size, boxes.yaw, velocity, ids.tolist(), texts, strict=True
    ):
        half, color = float(yaw) / 2, _hue(number)
        box = turn @ geometry.transform(center, np.array([0, 0, np.sin(half), np.cos(half)]))
        above = center + np.array([0, 0, size[2] / 2 + 0.3])
        top = turn @ geometry.transform(above, np.array([0, 0, 0, 1.0]))
        ends = geometry.apply(turn, np.stack([center, center + way]).astype(np.float32))
        shapes: list[tuple[str, int, Any, Any, float, list[Any], str]] = [
            ("boxes", 1, _pose(box), size, 0.4, [], ""),
            ("names", 9, _pose(top), np.array([0, 0, 0.4]), 1.0, [], text),
        ]
        if np.linalg.norm(way) > 0.1:
            points = [_vector("Point", end) for end in ends]
            shapes.append(("ways", 0, _pose(np.eye(4)), np.array([0.1, 0.25, 0]), 1.0, points, ""))
        for space, kind, place, scale, alpha, points, words in shapes:
            markers.append(
                make_message(
                    "visualization_msgs/msg/Marker",
                    header=about,
                    ns=space,
                    id=number % 2**31,
                    type=kind,
                    pose=place,
                    scale=_vector("Vector3", scale),
                    color=make_message("std_msgs/msg/ColorRGBA", r=color[0], g=color[1], b=color[2], a=alpha),
                    lifetime=lasting,
                    points=points,
                    text=words,
                )
            )
    return make_message("visualization_msgs/msg/MarkerArray", markers=markers)


def _hue(number: int) -> tuple[float, float, float]:
    """Return a colour. Consecutive numbers get colours that differ strongly."""
    return colorsys.hsv_to_rgb(number * 0.618034 % 1, 0.6, 1.0)


def encode_boxes_2d(stamp: int, frame_id: str, xyxy: F32, results: Iterable[Hypotheses]) -> Any:
    """Make a vision_msgs/Detection2DArray. ``results`` are the hypotheses of each box."""
    about, nowhere = make_header(stamp, frame_id), _pose(np.eye(4))
    detections = []
    for (x0, y0, x1, y1), hypotheses in zip(xyxy.tolist(), results, strict=True):
        middle = make_message("vision_msgs/msg/Point2D", x=(x0 + x1) / 2, y=(y0 + y1) / 2)
        box = make_message(
            "vision_msgs/msg/BoundingBox2D",
            center=make_message("vision_msgs/msg/Pose2D", position=middle),
            size_x=x1 - x0,
            size_y=y1 - y0,
        )
        detections.append(
            make_message(
                "vision_msgs/msg/Detection2D",
                header=about,
                results=_results(hypotheses, nowhere),
                bbox=box,
            )
        )
    return make_message("vision_msgs/msg/Detection2DArray", header=about, detections=detections)


def _results(hypotheses: Hypotheses, place: Any) -> list[Any]:
    covered = make_message("geometry_msgs/msg/PoseWithCovariance", pose=place)
    return [
        make_message(
            "vision_msgs/msg/ObjectHypothesisWithPose",
            hypothesis=make_message("vision_msgs/msg/ObjectHypothesis", class_id=name, score=float(score)),
            pose=covered,
        )
        for name, score in hypotheses
    ]


def encode_transforms(stamp: int, edges: Iterable[tuple[str, str, F64]]) -> Any:
    """Make a tf2_msgs/TFMessage of (parent, child, parent_from_child)."""
    transforms = [
        make_message(
            "geometry_msgs/msg/TransformStamped",
            header=make_header(stamp, parent),
            child_frame_id=child,
            transform=make_message(
                "geometry_msgs/msg/Transform",
                translation=_vector("Vector3", pose[:3, 3]),
                rotation=_rotation(pose),
            ),
        )
        for parent, child, pose in edges
    ]
    return make_message("tf2_msgs/msg/TFMessage", transforms=transforms)


def encode_odometry(
    stamp: int, parent: str, child: str, parent_from_child: F64, later: F64, dt: float
) -> Any:
    """Make a nav_msgs/Odometry. Its velocities lead to the pose ``later``, which is ``dt`` seconds later."""
    step = geometry.inverse(parent_from_child) @ later
    turn = np.array([step[2, 1] - step[1, 2], step[0, 2] - step[2, 0], step[1, 0] - step[0, 1]]) / 2
    twist = make_message(
        "geometry_msgs/msg/Twist",
        linear=_vector("Vector3", step[:3, 3] / dt),
        angular=_vector("Vector3", turn / dt),
    )
    return make_message(
        "nav_msgs/msg/Odometry",
        header=make_header(stamp, parent),
        child_frame_id=child,
        pose=make_message("geometry_msgs/msg/PoseWithCovariance", pose=_pose(parent_from_child)),
        twist=make_message("geometry_msgs/msg/TwistWithCovariance", twist=twist),
    )


# --- parts -------------------------------------------------------------------------------------


def make_message(kind: str, **fields: Any) -> Any:
    """Make a message of a type in ``typestore``. Fields that are not stated are zero, false or empty."""
    blanks = {name: blank() for name, blank in _blanks(kind).items() if name not in fields}
    return typestore().types[kind](**fields, **blanks)


@cache
def _blanks(kind: str) -> Mapping[str, Callable[[], Any]]:
    """Return for each field of a message type a function that makes its blank value."""
    return {name: _blank(*field) for name, field in typestore().fielddefs[kind][1]}


def _blank(node: Nodetype, about: Any) -> Callable[[], Any]:
    """Return a function that makes a blank value of a field, given the definition of the field."""
    if node == Nodetype.NAME:
        return partial(make_message, about)
    if node == Nodetype.BASE:
        return {"string": str, "wstring": str, "bool": bool, "float32": float, "float64": float}.get(
            about[0], int
        )
    (element, kind), length = about
    length = length if node == Nodetype.ARRAY else 0
    if element == Nodetype.BASE and kind[0] not in ("string", "wstring"):
        return partial(np.zeros, length, np.dtype(_NUMPY.get(kind[0], kind[0])))
    make_element = _blank(element, kind)
    return lambda: [make_element() for _ in range(length)]


_NUMPY = {"octet": "uint8", "byte": "uint8", "char": "uint8"}  # dtype of ROS's other names


def make_header(stamp: int, frame_id: str) -> Any:
    """Make a std_msgs/Header. The stamp is in nanoseconds."""
    time = make_message("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
    return make_message("std_msgs/msg/Header", stamp=time, frame_id=frame_id)


def _vector(kind: str, xyz: Iterable[float]) -> Any:
    x, y, z = map(float, xyz)
    return make_message(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)


def _rotation(a_from_b: F64) -> Any:
    x, y, z, w = map(float, geometry.quaternion(a_from_b))
    return make_message("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def _pose(a_from_b: F64) -> Any:
    position = _vector("Point", a_from_b[:3, 3])
    return make_message("geometry_msgs/msg/Pose", position=position, orientation=_rotation(a_from_b))
