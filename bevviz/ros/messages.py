"""ROS messages into arrays.

Only attributes are read, never types, so that what rosbags deserialises and what rclpy delivers are
both welcome, whichever the ROS version. Every function raises MessageError and nothing else, whatever is
in the message, and none takes more memory than a message of reasonable size asks for: see the limits below.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import wraps
from typing import Any, NamedTuple, ParamSpec, TypeAlias, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from bevviz import geometry
from bevviz.errors import UserError, first_line
from bevviz.frame import (
    F32,
    F64,
    U8,
    Boxes3D,
    Cloud,
    Image,
    ImageLabels,
    Intrinsics,
    LabelledBoxes2D,
    LabelledBoxes3D,
)
from bevviz.loggers import logger
from bevviz.ros.objects import decode_objects
from bevviz.ros.roles import VIDEO

_log = logger(__name__)

MOST_POINTS = 100_000_000  # of a cloud
MOST_FIELDS = 1024  # of a point; each element of a field counts
MOST_PIXELS = 100_000_000  # of an image

P = ParamSpec("P")
R = TypeVar("R")


class MessageError(UserError):
    """A message that cannot be used: its topic, what is wrong with it, and what would be accepted."""


def guarded(decode: Callable[P, R]) -> Callable[P, R]:
    """Whatever else ``decode`` raises, as a MessageError: a message may hold anything, even other fields."""

    @wraps(decode)
    def guarded(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return decode(*args, **kwargs)
        except MessageError:
            raise
        except Exception as error:
            topic = next((value for value in (*args, *kwargs.values()) if isinstance(value, str)), "message")
            _log.debug("%s cannot be used", topic, exc_info=True)
            what = f"{type(error).__name__}: {first_line(error)}"
            raise MessageError(f"{topic}: cannot be used ({what})") from None

    return guarded


@dataclass(frozen=True, slots=True)
class StampedTransform:
    """One edge of the transform tree at one time."""

    stamp: int  # nanoseconds
    parent: str
    child: str
    parent_from_child: F64  # (4, 4)


def stamp_ns(stamp: Any) -> int:
    """Nanoseconds of a builtin_interfaces/Time."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def read_header(data: bytes | memoryview, order: str, topic: str) -> tuple[int, str]:
    """Stamp in nanoseconds and frame_id of a serialised message that begins with a Header.

    Args:
        data: from four bytes before the stamp: the encoding of CDR, or the seq of ROS 1.
        order: ``<`` or ``>``, of the bytes.
        topic: for the error message.

    Raises:
        MessageError: there is no header.
    """
    try:
        sec, nanosec, size = struct.unpack_from(f"{order}iII", data, 4)
        (name,) = struct.unpack_from(f"{size}s", data, 16)
        return sec * 1_000_000_000 + nanosec, frame_name(name.rstrip(b"\0").decode())
    except (struct.error, UnicodeDecodeError):
        raise MessageError(f"{topic}: a message of {len(data)} bytes has no header") from None


def frame_name(name: str) -> str:
    return name.removeprefix("/")  # ROS 1 knew both spellings


# --- point clouds ------------------------------------------------------------------------------

_AXES = ("x", "y", "z")
_POINT_FIELD = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


@guarded
def decode_cloud(msg: Any, topic: str, received: int) -> Cloud:
    """Points and extra fields of a sensor_msgs/PointCloud2.

    Any field types, offsets, padding and byte order; organised clouds are flattened row by row. Points
    with a coordinate that is NaN or infinite are dropped, and so are those at (0, 0, 0), by which
    drivers mean a beam without a return, and those that the header announces but cut data no longer
    holds; all are counted in ``Cloud.dropped``. A field of several elements becomes one field for each:
    ``name_0``, ``name_1`` ...

    Raises:
        MessageError: x, y or z is missing, a field does not fit into its point, or the header announces more
            than ``MOST_POINTS`` points or ``MOST_FIELDS`` fields.
    """
    if (announced := int(msg.height) * int(msg.width)) > MOST_POINTS:
        raise MessageError(
            f"{topic}: a cloud of {msg.width} x {msg.height} points is not taken: "
            f"{MOST_POINTS} at most, and there are {len(msg.data)} bytes of data"
        )
    layout = _point_layout(msg, topic)
    grid = _point_grid(msg, layout)
    with np.errstate(over="ignore", invalid="ignore"):  # a float64 beyond float32 is infinite, and dropped
        xyz = _positions(grid)
        total = xyz[:, 0] + xyz[:, 1] + xyz[:, 2]
    usable = np.isfinite(total)
    if not total.all():
        usable &= xyz.any(axis=1)
    kept = None if usable.all() else np.flatnonzero(usable)
    fields: dict[str, NDArray[Any]] = {}
    for name in layout.fields or ():
        if name not in _AXES:
            values = grid[name].reshape(-1)
            # Copied: a view would be unaligned, read-only, and keep the whole message in memory.
            values = values.copy() if kept is None else values.take(kept)
            fields[name] = np.asarray(values, values.dtype.newbyteorder("="))
    if kept is not None:
        xyz = xyz.take(kept, axis=0)
    return Cloud(
        stamp=stamp_ns(msg.header.stamp),
        frame_id=frame_name(msg.header.frame_id),
        xyz=xyz,
        fields=fields,
        topic=topic,
        received=received,
        dropped=announced - len(xyz),
    )


def _positions(grid: NDArray[np.void]) -> F32:
    """(N, 3) coordinates of the points, a copy."""
    layout = grid.dtype
    assert layout.fields is not None
    formats, offsets = zip(*(layout.fields[name][:2] for name in _AXES), strict=True)
    if set(formats) == {np.dtype(np.float32)} and np.diff(offsets).tolist() == [4, 4]:
        # Side by side, as most drivers have them, they are copied in one piece.
        together = np.dtype(
            {"names": ["xyz"], "formats": ["V12"], "offsets": offsets[:1], "itemsize": layout.itemsize}
        )
        return grid.view(together)["xyz"].copy().view(np.float32).reshape(-1, 3)
    xyz = np.empty((*grid.shape, 3), np.float32)
    for axis, name in enumerate(_AXES):
        xyz[..., axis] = grid[name]
    return xyz.reshape(-1, 3)


def _point_layout(msg: Any, topic: str) -> np.dtype[np.void]:
    """The structured dtype of one point; ``itemsize`` is point_step."""
    if not 0 < msg.point_step < 1 << 31:
        raise MessageError(f"{topic}: a point of {msg.point_step} bytes cannot be")
    if sum(max(int(field.count), 1) for field in msg.fields) > MOST_FIELDS:
        raise MessageError(f"{topic}: its points have more than {MOST_FIELDS} fields, each element counted")
    order = ">" if msg.is_bigendian else "<"
    formats: dict[str, str] = {}
    offsets: dict[str, int] = {}
    for field in msg.fields:
        if field.datatype not in _POINT_FIELD:
            raise MessageError(f"{topic}: field '{field.name}' has the unknown datatype {field.datatype}")
        scalar = np.dtype(order + _POINT_FIELD[field.datatype])
        count = max(int(field.count), 1)  # old drivers leave it at 0
        if field.offset + count * scalar.itemsize > msg.point_step:
            raise MessageError(
                f"{topic}: field '{field.name}' ends at byte {field.offset + count * scalar.itemsize} "
                f"of a point, but point_step is {msg.point_step}"
            )
        for i in range(count):
            name = field.name if count == 1 else f"{field.name}_{i}"
            formats.setdefault(name, scalar.str)
            offsets.setdefault(name, field.offset + i * scalar.itemsize)
    if missing := [name for name in _AXES if name not in formats]:
        raise MessageError(
            f"{topic}: the cloud has no field {', '.join(missing)}; "
            f"its fields are {', '.join(formats) or 'none'}"
        )
    return np.dtype(
        {
            "names": list(formats),
            "formats": list(formats.values()),
            "offsets": list(offsets.values()),
            "itemsize": int(msg.point_step),
        }
    )


def _point_grid(msg: Any, layout: np.dtype[np.void]) -> NDArray[np.void]:
    """(rows, columns) view of the points that are whole in the data."""
    data = np.frombuffer(msg.data, np.uint8)
    rows, columns, step = int(msg.height), int(msg.width), layout.itemsize
    row_bytes = columns * step
    row_step = max(int(msg.row_step), row_bytes)  # some drivers leave it at 0
    if row_step == row_bytes or rows == 1:
        rows, columns = 1, min(rows * columns, data.size // step)
    else:
        rows = min(rows, max(data.size - row_bytes, -row_step) // row_step + 1)
    return np.ndarray((rows, columns), layout, data, strides=(row_step, step))


# --- images ------------------------------------------------------------------------------------


class _Encoding(NamedTuple):
    to_bgr: int | None  # OpenCV's conversion
    channels: int = 1
    scalar: str = "u1"
    rows: float = 1.0  # rows of data for each row of pixels


_ENCODINGS: Mapping[str, _Encoding] = {
    "bgr8": _Encoding(None, 3),
    "rgb8": _Encoding(cv2.COLOR_RGB2BGR, 3),
    "bgra8": _Encoding(cv2.COLOR_BGRA2BGR, 4),
    "rgba8": _Encoding(cv2.COLOR_RGBA2BGR, 4),
    "mono8": _Encoding(cv2.COLOR_GRAY2BGR),
    "mono16": _Encoding(cv2.COLOR_GRAY2BGR, scalar="u2"),
    "8UC1": _Encoding(cv2.COLOR_GRAY2BGR),
    "8UC3": _Encoding(None, 3),
    "8UC4": _Encoding(cv2.COLOR_BGRA2BGR, 4),
    "16UC1": _Encoding(cv2.COLOR_GRAY2BGR, scalar="u2"),
    "bayer_rggb8": _Encoding(cv2.COLOR_BayerRGGB2BGR),
    "bayer_bggr8": _Encoding(cv2.COLOR_BayerBGGR2BGR),
    "bayer_gbrg8": _Encoding(cv2.COLOR_BayerGBRG2BGR),
    "bayer_grbg8": _Encoding(cv2.COLOR_BayerGRBG2BGR),
    "bayer_rggb16": _Encoding(cv2.COLOR_BayerRGGB2BGR, scalar="u2"),
    "bayer_bggr16": _Encoding(cv2.COLOR_BayerBGGR2BGR, scalar="u2"),
    "bayer_gbrg16": _Encoding(cv2.COLOR_BayerGBRG2BGR, scalar="u2"),
    "bayer_grbg16": _Encoding(cv2.COLOR_BayerGRBG2BGR, scalar="u2"),
    "yuv422": _Encoding(cv2.COLOR_YUV2BGR_UYVY, 2),
    "uyvy": _Encoding(cv2.COLOR_YUV2BGR_UYVY, 2),
    "yuv422_yuy2": _Encoding(cv2.COLOR_YUV2BGR_YUY2, 2),
    "yuyv": _Encoding(cv2.COLOR_YUV2BGR_YUY2, 2),
    "nv12": _Encoding(cv2.COLOR_YUV2BGR_NV12, rows=1.5),
    "nv21": _Encoding(cv2.COLOR_YUV2BGR_NV21, rows=1.5),
}


@guarded
def decode_image(msg: Any, topic: str, received: int) -> Image:
    """A sensor_msgs/Image as BGR; bgr8 without row padding is a view of the message's data.

    Images of 16 bits are reduced to 8 as ``to_8_bits`` says.

    Raises:
        MessageError: unknown encoding, no pixels, or less data than the size asks for.
    """
    encoding = _ENCODINGS.get(msg.encoding)
    if encoding is None:
        raise MessageError(
            f"{topic}: image encoding '{msg.encoding}' is not supported; "
            f"supported are {', '.join(_ENCODINGS)}"
        )
    width, height = int(msg.width), int(msg.height)
    if not width or not height:
        raise MessageError(f"{topic}: the image is {width} x {height} and has no pixels")
    data = np.frombuffer(msg.data, np.uint8)
    scalar = np.dtype((">" if msg.is_bigendian else "<") + encoding.scalar)
    rows, pixel_bytes = int(height * encoding.rows), encoding.channels * scalar.itemsize
    step = int(msg.step) or width * pixel_bytes
    needed = (rows - 1) * step + width * pixel_bytes
    if step < width * pixel_bytes or data.size < needed:
        raise MessageError(
            f"{topic}: a {width} x {height} {msg.encoding} image needs {rows} rows of "
            f"{width * pixel_bytes} bytes, but step is {step} and there are {data.size} bytes of data"
        )
    pixels = np.ndarray(
        (rows, width, encoding.channels), scalar, data, strides=(step, pixel_bytes, scalar.itemsize)
    )
    if scalar.itemsize == 2:
        pixels = to_8_bits(np.asarray(pixels, np.uint16))
    try:
        bgr = pixels if encoding.to_bgr is None else cv2.cvtColor(pixels, encoding.to_bgr)
    except cv2.error as error:
        raise MessageError(
            f"{topic}: a {width} x {height} image cannot be {msg.encoding} (OpenCV: {error.err})"
        ) from None
    return Image(
        stamp=stamp_ns(msg.header.stamp),
        frame_id=frame_name(msg.header.frame_id),
        bgr=np.ascontiguousarray(bgr),
        topic=topic,
        received=received,
    )


def to_8_bits(pixels: NDArray[np.uint16]) -> U8:
    """16 bit pixels as 8 bit ones, by the bit depth that the brightest pixel asks for.

    Sensors of 10, 12 and 14 bits are published in 16, mostly unshifted: the full scale is taken as the
    smallest of 8, 10, 12, 14 and 16 bits that holds every pixel.
    """
    brightest = int(pixels.max())
    depth = next(bits for bits in (8, 10, 12, 14, 16) if brightest < 1 << bits)
    scaled: U8 = cv2.convertScaleAbs(pixels, alpha=255.0 / ((1 << depth) - 1))
    return scaled


_MEDIA_TYPES = {  # by what the data begins with
    "image/jpeg": re.compile(rb"\xff\xd8\xff"),
    "image/png": re.compile(rb"\x89PNG\r\n\x1a\n"),
    "image/webp": re.compile(rb"RIFF.{4}WEBP", re.DOTALL),
}
_ANNEX_B = (b"\0\0\0\1", b"\0\0\1")  # what every unit of an H.264 or H.265 stream begins with


@guarded
def decode_compressed_image(msg: Any, topic: str, received: int) -> Image:
    """A JPEG, PNG or WebP in a sensor_msgs/CompressedImage, decoded.

    The kind is taken from the data, as the format field has many spellings. The encoded bytes are kept
    beside, untouched, but of WebP, which Rerun does not read, and of a PNG of 16 bits: it is reduced as
    ``to_8_bits`` says, and would look different.

    Raises:
        MessageError: depth images, other kinds, data that is damaged or cut, and more than ``MOST_PIXELS``
            pixels, which is known before they are decoded.
    """
    if "compressedDepth" in msg.format:
        raise MessageError(f"{topic}: '{msg.format}' is a depth image; choose a topic with colour images")
    data = np.frombuffer(msg.data, np.uint8)
    encoded = data.tobytes()
    media_type = next((kind for kind, magic in _MEDIA_TYPES.items() if magic.match(encoded)), "")
    if encoded.startswith(_ANNEX_B):
        raise MessageError(f"{topic}: '{msg.format}' is {VIDEO}")
    if not media_type:
        raise MessageError(
            f"{topic}: compressed image of format '{msg.format}' holds neither JPEG, PNG nor WebP data "
            f"({len(encoded)} bytes)"
        )
    width, height = _size_of(encoded)
    if width * height > MOST_PIXELS:
        raise MessageError(
            f"{topic}: an image of {width} x {height} pixels is not taken: {MOST_PIXELS} at most"
        )
    cut = not width or not height
    if media_type == "image/jpeg" and encoded.rfind(b"\xff\xd9") < 0:
        cut = True  # decoders would fill the rest with grey
    # Orientation: the calibration belongs to the pixels as they are stored, not as EXIF would turn them.
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        bgr = None if cut else cv2.imdecode(data, flags)
    except cv2.error:
        bgr = None
    if bgr is None:
        raise MessageError(f"{topic}: the {media_type} data ({len(encoded)} bytes) is damaged or cut")
    deep = bgr.dtype == np.uint16
    kept = not deep and media_type != "image/webp"
    return Image(
        stamp=stamp_ns(msg.header.stamp),
        frame_id=frame_name(msg.header.frame_id),
        bgr=to_8_bits(bgr) if deep else bgr,
        encoded=encoded if kept else None,
        media_type=media_type if kept else "",
        topic=topic,
        received=received,
    )


def _size_of(encoded: bytes) -> tuple[int, int]:
    """Width and height in the header of a PNG, JPEG or WebP; 0 where there is none, or the data is cut."""
    if encoded.startswith(b"RIFF"):
        return _size_of_webp(encoded)
    if encoded.startswith(b"\x89PNG"):
        at = 8
        while encoded[at + 4 : at + 8] != b"IEND":  # a decoder makes room for a part before it reads it
            at += 12 + int.from_bytes(encoded[at : at + 4], "big")
            if at + 8 > len(encoded):
                return 0, 0
        return int.from_bytes(encoded[16:20], "big"), int.from_bytes(encoded[20:24], "big")
    at = 2
    while at + 9 <= len(encoded):
        marker, size = encoded[at + 1], int.from_bytes(encoded[at + 2 : at + 4], "big")
        if encoded[at] != 0xFF or marker == 0xFF:  # between segments there may be anything
            at += 1
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # start of a frame
            height, width = struct.unpack_from(">HH", encoded, at + 5)
            return width, height
        elif marker == 0xDA:  # start of the pixels
            break
        else:
            at += 2 if marker in (0x01, *range(0xD0, 0xD9)) else 2 + max(size, 2)
    return 0, 0


def _size_of_webp(encoded: bytes) -> tuple[int, int]:
    """As RFC 9649 has it."""
    if len(encoded) < max(30, 8 + int.from_bytes(encoded[4:8], "little")):
        return 0, 0
    first, bits = encoded[12:16], int.from_bytes(encoded[21:25], "little")
    if first == b"VP8X":  # with alpha, a profile or several pictures
        return 1 + int.from_bytes(encoded[24:27], "little"), 1 + int.from_bytes(encoded[27:30], "little")
    if first == b"VP8L":  # lossless
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    width, height = struct.unpack_from("<HH", encoded, 26)
    return (width & 0x3FFF, height & 0x3FFF) if first == b"VP8 " else (0, 0)


# --- camera models -----------------------------------------------------------------------------

_DISTORTION = {
    "plumb_bob": "plumb_bob",
    "": "plumb_bob",  # coefficients without a name
    "rational_polynomial": "rational_polynomial",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
}


@guarded
def decode_camera_info(msg: Any, rectified: bool, topic: str = "camera_info") -> Intrinsics:
    """The camera model of a sensor_msgs/CameraInfo, for images as they are published.

    The region of interest and binning are applied as image_geometry does: first the offset, then the
    scale. K of a message is for the full sensor.

    Args:
        msg: ROS 1 (upper-case K, D, P) or ROS 2.
        rectified: the images are rectified: the left 3 x 3 of P and no distortion. Without P, K.
        topic: for the error messages.

    Raises:
        MessageError: an uncalibrated camera, or a distortion model that is not known.
    """
    K, D, P = (np.asarray(_either(msg, n, n.lower()), np.float64) for n in "KDP")
    matrix, baseline = K.reshape(3, 3), (0.0, 0.0)
    if rectified and P[0]:
        matrix = P.reshape(3, 4)[:, :3]
        baseline = -float(P[3] / P[0]), -float(P[7] / P[5] if P[5] else 0.0)
    if not np.isfinite(matrix).all() or matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        raise MessageError(f"{topic}: the camera is uncalibrated (K is zero or not finite); calibrate it")
    model = ""
    if not rectified and np.any(D):
        model = _distortion(msg.distortion_model, D, topic)
    matrix = matrix.copy()
    matrix[0, 2] -= msg.roi.x_offset
    matrix[1, 2] -= msg.roi.y_offset
    binning = np.array([max(int(msg.binning_x), 1), max(int(msg.binning_y), 1)])
    matrix[:2] /= binning[:, None]
    width, height = np.array([msg.roi.width or msg.width, msg.roi.height or msg.height], int) // binning
    return Intrinsics(int(width), int(height), matrix, model, D if model else np.zeros(0), baseline)


def _distortion(name: str, D: F64, topic: str) -> str:
    model = _DISTORTION.get(name.lower())
    if model is None:
        raise MessageError(
            f"{topic}: distortion model '{name}' is not supported; supported are "
            f"{', '.join(sorted(set(_DISTORTION.values())))}"
        )
    if not np.isfinite(D).all() or np.any(D[8:]) or (model == "equidistant" and len(D) < 4):
        raise MessageError(f"{topic}: {list(D)} are no coefficients of the distortion model '{name}'")
    return model


def _either(msg: Any, *names: str) -> Any:
    """The first attribute that exists: message definitions differ between versions of ROS."""
    for name in names:
        if hasattr(msg, name):
            return getattr(msg, name)
    raise MessageError(f"message {type(msg).__name__} has no field {' or '.join(names)}")


# --- transforms --------------------------------------------------------------------------------


@guarded
def decode_transforms(msg: Any, topic: str = "/tf") -> list[StampedTransform]:
    """The transforms of a tf2_msgs/TFMessage; one that is no rigid transform is left out.

    Raises:
        MessageError: none of them is one.
    """
    transforms, problems = [], []
    for item in msg.transforms:
        moved = item.transform
        try:
            transforms.append(
                _stamped(item.header, item.child_frame_id, moved.translation, moved.rotation, topic)
            )
        except MessageError as error:
            problems.append(error)
    if problems and not transforms:
        raise problems[0]
    return transforms


@guarded
def decode_odometry(msg: Any, topic: str = "odometry") -> StampedTransform:
    """The pose of a nav_msgs/Odometry: header.frame_id from child_frame_id.

    Raises:
        MessageError: no rigid transform, or no frame names.
    """
    pose = msg.pose.pose
    return _stamped(msg.header, msg.child_frame_id, pose.position, pose.orientation, topic)


Vector: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Acceleration:
    """What an Imu feels, in its own frame: at rest one g upwards."""

    stamp: int
    frame_id: str
    acceleration: F64  # (3,) m/s^2, or in g: drivers differ


def decode_acceleration(msg: Any, topic: str = "imu") -> Acceleration:
    """Of a sensor_msgs/Imu.

    Raises:
        MessageError: the message says that it has none.
    """
    if msg.linear_acceleration_covariance[0] == -1:
        raise MessageError(f"{topic}: its covariance says that no acceleration is measured")
    felt = msg.linear_acceleration
    return Acceleration(
        stamp_ns(msg.header.stamp), frame_name(msg.header.frame_id), np.array([felt.x, felt.y, felt.z])
    )


def decode_motion(msg: Any) -> tuple[Vector, Vector, int]:
    """Rotation rate and acceleration of a sensor_msgs/Imu, NaN where it says it has none, and its stamp."""
    none = (math.nan, math.nan, math.nan)
    turn, felt = msg.angular_velocity, msg.linear_acceleration
    return (
        none if msg.angular_velocity_covariance[0] == -1 else (turn.x, turn.y, turn.z),
        none if msg.linear_acceleration_covariance[0] == -1 else (felt.x, felt.y, felt.z),
        stamp_ns(msg.header.stamp),
    )


def _stamped(header: Any, child: str, translation: Any, rotation: Any, topic: str) -> StampedTransform:
    parent, child = frame_name(header.frame_id), frame_name(child)
    if not parent or not child or parent == child:
        raise MessageError(f"{topic}: '{parent}' and '{child}' cannot be parent and child frame")
    xyz = translation.x, translation.y, translation.z
    try:
        matrix = geometry.transform(xyz, (rotation.x, rotation.y, rotation.z, rotation.w))
    except ValueError as error:
        raise MessageError(f"{topic}: rotation from '{child}' to '{parent}': {error}") from None
    if not all(map(math.isfinite, xyz)):
        raise MessageError(f"{topic}: the translation from '{child}' to '{parent}' is not finite")
    return StampedTransform(stamp_ns(header.stamp), parent, child, matrix)


# --- detections --------------------------------------------------------------------------------


@guarded
def decode_detections_2d(msg: Any, topic: str, received: int) -> LabelledBoxes2D:
    """The image boxes of a vision_msgs/Detection2DArray, of ROS 1 or any version of ROS 2.

    A turned box becomes the upright one around it. Boxes that are not finite are left out.

    Raises:
        MessageError: not laid out as any known version of the message.
    """

    def row(detection: Any) -> tuple[float, ...]:
        center, box = detection.bbox.center, detection.bbox
        position = getattr(center, "position", center)  # flat up to ROS 2 Galactic
        return position.x, position.y, center.theta, box.size_x, box.size_y

    values, labels, scores, _ = _rows(msg, row, 5, topic)
    x, y, theta, w, h = values.T
    cos, sin = np.abs(np.cos(theta)), np.abs(np.sin(theta))
    dx, dy = (w * cos + h * sin) / 2, (w * sin + h * cos) / 2
    return LabelledBoxes2D(
        topic=topic,
        stamp=stamp_ns(msg.header.stamp),
        frame_id=frame_name(msg.header.frame_id),
        xyxy=np.stack([x - dx, y - dy, x + dx, y + dy], axis=1).astype(np.float32),
        labels=labels,
        scores=scores,
        received=received,
    )


@guarded
def decode_boxes(msg: Any, topic: str, received: int, stated: Mapping[str, str]) -> LabelledBoxes3D:
    """The boxes of a Detection3DArray, or of another message, see ``bevviz.ros.objects``.

    Raises:
        MessageError: they cannot be found in it.
    """
    if hasattr(msg, "detections") and not stated:
        return decode_detections_3d(msg, topic, received)
    try:
        return decode_objects(msg, topic, received, stated)
    except (ValueError, TypeError, AttributeError) as error:
        raise MessageError(f"{topic}: no boxes in a {type(msg).__name__}: {first_line(error)}") from None


@guarded
def decode_detections_3d(msg: Any, topic: str, received: int) -> LabelledBoxes3D:
    """The boxes of a vision_msgs/Detection3DArray, of ROS 1 or any version of ROS 2, or of bevviz_msgs.

    Only the turn about z is kept of an orientation; one left at zero is none. Boxes that are not finite
    are left out.

    Raises:
        MessageError: not laid out as any known version of the message.
    """

    def row(detection: Any) -> tuple[float, ...]:
        center, size = detection.bbox.center, detection.bbox.size
        p, q = center.position, center.orientation
        return p.x, p.y, p.z, size.x, size.y, size.z, q.x, q.y, q.z, q.w

    values, labels, scores, ids = _rows(msg, row, 10, topic)
    x, y, z, w = values[:, 6:].T
    yaw = np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)  # holds at any length, zero too
    center, size = values[:, :3].astype(np.float32), values[:, 3:6].astype(np.float32)
    return LabelledBoxes3D(
        topic=topic,
        stamp=stamp_ns(msg.header.stamp),
        frame_id=frame_name(msg.header.frame_id),
        boxes=Boxes3D(center, size, yaw.astype(np.float32)),
        labels=labels,
        scores=scores,
        received=received,
        ids=ids if all(ids) else (),
        image=_image_labels(msg, len(labels)),
    )


def _image_labels(msg: Any, boxes: int) -> ImageLabels | None:
    """What a data set says of the image, see ``encode_labels``; None: it says nothing."""
    if not hasattr(msg, "image_boxes") or len(msg.truncated) != boxes:
        return None
    return ImageLabels(
        np.array(msg.image_boxes, np.float32).reshape(boxes, 4),
        np.array(msg.truncated, np.float32),
        np.array(msg.occluded, np.int32),
        np.array(msg.dont_care, np.float32).reshape(-1, 4),
    )


def _rows(
    msg: Any, row: Callable[[Any], tuple[float, ...]], width: int, topic: str
) -> tuple[F64, tuple[str, ...], F32, tuple[str, ...]]:
    """(K, width) numbers, labels, scores and ids of the detections whose numbers are all finite."""
    try:
        rows = [(row(d), *_hypothesis(d.results), str(getattr(d, "id", ""))) for d in msg.detections]
    except AttributeError as error:
        raise MessageError(f"{topic}: unknown version of vision_msgs: {error}") from None
    rows = [r for r in rows if all(map(math.isfinite, r[0]))]
    values = np.array([r[0] for r in rows], np.float64).reshape(-1, width)
    scores = np.nan_to_num(np.array([r[2] for r in rows], np.float32))
    return values, tuple(r[1] for r in rows), scores, tuple(r[3] for r in rows)


def _hypothesis(results: Iterable[Any]) -> tuple[str, float]:
    """Label and score of the best result.

    Fusion nodes append the class to the hypotheses of the cluster, whose own ``cluster_<i>`` has score 1:
    such a name counts only where there is no other.
    """
    hypotheses = [getattr(result, "hypothesis", result) for result in results]  # flat up to ROS 2 Foxy
    if not hypotheses:
        return "", 0.0
    labels = [(str(_either(h, "class_id", "id")), float(h.score)) for h in hypotheses]
    named = [item for item in labels if not item[0].startswith("cluster_")]
    return max(named, key=lambda item: 0.0 if math.isnan(item[1]) else item[1]) if named else labels[0]
