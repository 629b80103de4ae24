"""Messages, as rosbags and rclpy deliver them, into arrays."""

from __future__ import annotations

import array
import math
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace as Message
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from bevviz.extras.datasets.folder_export import rectify
from bevviz.live.live_message import LiveMessage
from bevviz.messages import (
    camera_info,
    clouds,
    definitions,
    detections,
    images,
    transforms,
)
from bevviz.messages.decoders import MessageError
from bevviz.messages.guard import guard
from bevviz.model import geometry
from bevviz.stages import edges

SEC, NANOSEC = 1_700_000_000, 123_456_789
STAMP = SEC * 1_000_000_000 + NANOSEC


def header(frame_id: str = "sensor") -> Message:
    return Message(seq=0, stamp=Message(sec=SEC, nanosec=NANOSEC), frame_id=frame_id)


# --- point clouds ------------------------------------------------------------------------------

STRUCT = {1: "b", 2: "B", 3: "h", 4: "H", 5: "i", 6: "I", 7: "f", 8: "d"}
CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def cloud_message(points: NDArray[Any], height: int = 1, row_padding: int = 0, **changes: Any) -> Message:
    """Make a PointCloud2 of a structured array, whose dtype is the layout."""
    fields = []
    layout = points.dtype.fields
    assert layout is not None
    for name, (scalar, offset, *_) in layout.items():
        count = math.prod(scalar.shape)
        fields.append(Message(name=name, offset=offset, datatype=CODES[scalar.base.str[1:]], count=count))
    width, step = len(points) // height, points.dtype.itemsize
    rows = points.reshape(height, width)
    data = b"".join(row.tobytes() + b"\xff" * row_padding for row in rows)
    return Message(
        header=header("lidar"),
        height=height,
        width=width,
        fields=fields,
        is_bigendian=layout["x"][0].str[0] == ">",
        point_step=step,
        row_step=width * step + row_padding,
        data=data,
        is_dense=True,
        **changes,
    )


XYZI = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])


def random_points(n: int, dtype: Any = XYZI, seed: int = 0) -> NDArray[Any]:
    rng = np.random.default_rng(seed)
    points = np.zeros(n, dtype)
    for name in points.dtype.names or ():
        shape = points[name].shape
        points[name] = (
            rng.integers(0, 100, shape) if points[name].dtype.kind in "iu" else rng.normal(0, 9, shape)
        )
    return points


@st.composite
def layouts(draw: st.DrawFn) -> Message:
    """Draw a PointCloud2 of any layout. Its random bytes make small or non-finite coordinates."""
    big = draw(st.booleans())
    kinds = st.tuples(st.sampled_from(sorted(STRUCT)), st.integers(1, 3))
    extra = draw(
        st.dictionaries(st.sampled_from(["intensity", "ring", "t", "normal", "rgb"]), kinds, max_size=4)
    )
    axes = {axis: (draw(st.sampled_from(sorted(STRUCT))), 1) for axis in "xyz"}
    names = draw(st.permutations([*axes, *extra]))
    fields, end = [], 0
    for name in names:
        code, count = {**axes, **extra}[name]
        offset = end + draw(st.integers(0, 5))
        fields.append(Message(name=name, offset=offset, datatype=code, count=count))
        end = offset + count * struct.calcsize(STRUCT[code])
    step = end + draw(st.integers(0, 7))
    height, width = draw(st.integers(1, 4)), draw(st.integers(0, 6))
    row_step = width * step + (draw(st.integers(0, 9)) if height > 1 else 0)
    data = bytearray(draw(st.randoms(use_true_random=False)).randbytes(height * row_step))
    value = st.floats(-1e6, 1e6, width=32) | st.sampled_from([math.nan, math.inf, -math.inf])
    for row in range(height):
        for column in range(width):
            for f in fields:
                if f.datatype >= 7:
                    at = row * row_step + column * step + f.offset
                    numbers = [draw(value) for _ in range(f.count)]
                    struct.pack_into(("><"[not big]) + f.count * STRUCT[f.datatype], data, at, *numbers)
    return Message(
        header=header("lidar"),
        height=height,
        width=width,
        fields=fields,
        is_bigendian=big,
        point_step=step,
        row_step=row_step,
        data=bytes(data),
        is_dense=False,
    )


def unpack(msg: Message) -> list[dict[str, float]]:
    """Point by point, field by field: what the message says."""
    order = ">" if msg.is_bigendian else "<"
    points = []
    for row in range(msg.height):
        for column in range(msg.width):
            at = row * msg.row_step + column * msg.point_step
            point: dict[str, float] = {}
            for f in msg.fields:
                values = struct.unpack_from(order + f.count * STRUCT[f.datatype], msg.data, at + f.offset)
                names = [f.name] if f.count == 1 else [f"{f.name}_{i}" for i in range(f.count)]
                point.update(zip(names, values, strict=True))
            points.append(point)
    return points


@pytest.mark.long
@settings(max_examples=150, deadline=None)
@given(layouts())
def test_any_layout_equals_unpacking_point_by_point(msg: Message) -> None:
    expected = unpack(msg)
    kept = [
        p
        for p in expected
        if math.hypot(*(p[axis] for axis in "xyz")) <= clouds.FARTHEST
        and any(np.float32(p[axis]) for axis in "xyz")
    ]
    cloud = clouds.decode_cloud(msg, "/points", 7)
    assert cloud.dropped == len(expected) - len(kept)
    assert (
        cloud.xyz.dtype == np.float32 and cloud.xyz.shape == (len(kept), 3) and cloud.xyz.flags.c_contiguous
    )
    np.testing.assert_array_equal(
        cloud.xyz, np.array([[p[a] for a in "xyz"] for p in kept], "f4").reshape(-1, 3)
    )
    names = {n for p in expected for n in p} - set("xyz")
    assert names <= set(cloud.fields)
    for name in names:
        values = cloud.fields[name]
        assert values.dtype.isnative and values.flags.aligned and values.flags.c_contiguous
        np.testing.assert_array_equal(values, np.array([p[name] for p in kept], values.dtype))


STORES = {"ros1": get_typestore(Stores.ROS1_NOETIC), "ros2": get_typestore(Stores.ROS2_JAZZY)}
definitions.register(STORES["ros2"])
TF = get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
STORES["ros1"].register(TF)  # a bag brings the definition


def through(store: Typestore, kind: str, msg: Message) -> Any:
    """Serialise the message with rosbags and deserialise it again."""

    def build(name: str, value: Any) -> Any:
        cls = store.types[name]
        _, fields = store.fielddefs[name]
        return cls(**{n: convert(desc, getattr(value, n, None)) for n, desc in fields})

    def convert(desc: Any, value: Any) -> Any:
        node, detail = desc
        if node.name == "NAME":
            return build(detail, value)
        if node.name in ("ARRAY", "SEQUENCE"):
            inner, name = detail[0]
            if inner.name == "NAME":
                return [build(name, v) for v in value]
            return np.frombuffer(value, np.uint8) if isinstance(value, bytes) else np.asarray(value, name[0])
        return value

    instance = build(kind, msg)
    if store is STORES["ros1"]:
        return store.deserialize_ros1(store.serialize_ros1(instance, kind), kind)
    return store.deserialize_cdr(store.serialize_cdr(instance, kind), kind)


@pytest.mark.parametrize("ros", STORES)
def test_a_kitti_scan_through_ros_is_the_scan(shared: Path, ros: str) -> None:
    scan = np.fromfile(shared / "kitti/velodyne/000000.bin", np.float32).reshape(-1, 4)
    points = np.ascontiguousarray(scan).view(XYZI).reshape(-1)
    msg = through(STORES[ros], "sensor_msgs/msg/PointCloud2", cloud_message(points))
    cloud = clouds.decode_cloud(msg, "/velodyne_points", 5)
    assert (cloud.stamp, cloud.frame_id, cloud.topic, cloud.received) == (
        STAMP,
        "lidar",
        "/velodyne_points",
        5,
    )
    assert cloud.dropped == 0
    np.testing.assert_array_equal(cloud.xyz, scan[:, :3])
    np.testing.assert_array_equal(cloud.fields["intensity"], scan[:, 3])


def test_messages_of_rclpy_are_read() -> None:
    msg = cloud_message(random_points(50))
    msg.data = array.array("B", msg.data)
    np.testing.assert_array_equal(clouds.decode_cloud(msg, "/p", 0).xyz[:, 0], random_points(50)["x"])


def test_a_cloud_of_nothing_but_nan_is_empty_and_counted() -> None:
    points = random_points(64)
    points["y"] = np.nan
    cloud = clouds.decode_cloud(cloud_message(points, height=4), "/p", 0)
    assert cloud.xyz.shape == (0, 3) and cloud.fields["intensity"].shape == (0,) and cloud.dropped == 64


def test_beams_that_end_at_one_range_are_named() -> None:
    points = random_points(1000)
    assert not clouds.decode_cloud(cloud_message(points), "/p", 0).doubt
    for axis, value in zip("xyz", (0.0, -120.0, 0.0), strict=True):
        points[axis][:250] = value
    cloud = clouds.decode_cloud(cloud_message(points), "/p", 0)
    assert cloud.doubt.startswith("25 % of the points of a cloud have the range 120 m") and not cloud.dropped


def test_a_cloud_without_points_is_empty() -> None:
    cloud = clouds.decode_cloud(cloud_message(random_points(0)), "/p", 0)
    assert cloud.xyz.shape == (0, 3) and cloud.dropped == 0


@pytest.mark.parametrize(("padding", "whole"), [(0, 2 * 25 + 7), (8, 2 * 25)])
def test_whole_points_of_cut_data_are_kept_and_others_counted(padding: int, whole: int) -> None:
    points = random_points(100)
    msg = cloud_message(points, height=4, row_padding=padding)
    msg.data = msg.data[: 2 * msg.row_step + 7 * msg.point_step + 3]
    cloud = clouds.decode_cloud(msg, "/p", 0)
    assert cloud.dropped == 100 - whole
    np.testing.assert_array_equal(cloud.xyz[:, 2], points["z"][:whole])


@pytest.mark.parametrize("size", [0, 1, 15, 16, 17])
def test_data_cut_to_a_few_bytes_are_survived(size: int) -> None:
    for padding in (0, 8):
        msg = cloud_message(random_points(100), height=4, row_padding=padding)
        msg.data = msg.data[:size]
        cloud = clouds.decode_cloud(msg, "/p", 0)
        assert len(cloud.xyz) + cloud.dropped == 100


@pytest.mark.parametrize("padding", [0, 8])
@pytest.mark.parametrize("row_step", [16, 24 * 16, 25 * 16 + 1, 62 * 16, 100 * 16, 1 << 31])
def test_the_length_of_the_data_decides_over_a_wrong_row_step(row_step: int, padding: int) -> None:
    points = random_points(100)
    msg = cloud_message(points, height=4, row_padding=padding)
    msg.row_step = row_step
    cloud = clouds.decode_cloud(msg, "/p", 0)
    if padding and row_step <= 25 * 16:  # nothing tells of the padding
        assert "up to" in cloud.doubt
        return
    np.testing.assert_array_equal(cloud.xyz[:, 1], points["y"])
    assert cloud.dropped == 0
    assert bool(cloud.doubt) == bool(padding)


def test_a_stale_height_or_width_is_said_with_the_lost_points() -> None:
    points = random_points(100)
    flat = cloud_message(points)
    flat.height = 0
    assert len(clouds.decode_cloud(flat, "/p", 0).xyz) == 100
    wide = cloud_message(points, height=4)
    wide.width = 30
    cloud = clouds.decode_cloud(wide, "/p", 0)
    assert len(cloud.xyz) == 100 and cloud.dropped == 20
    assert cloud.doubt.endswith("does not fit its 1600 bytes of data: 20 of 120 points are missing")
    narrow = cloud_message(points)
    narrow.width = 60
    assert clouds.decode_cloud(narrow, "/p", 0).doubt.endswith("up to 40 points are not read")


def test_row_step_and_count_that_old_drivers_leave_at_zero() -> None:
    msg = cloud_message(random_points(100), height=4)
    msg.row_step = 0
    for field in msg.fields:
        field.count = 0
    assert len(clouds.decode_cloud(msg, "/p", 0).xyz) == 100


def test_coordinates_beyond_float32_are_dropped_silently() -> None:
    points = random_points(3, [("x", "<f8"), ("y", "<f8"), ("z", "<f8")])
    points["x"][1] = 1e300
    points["y"][0] = 4_500_000.25
    cloud = clouds.decode_cloud(cloud_message(points), "/p", 0)
    assert cloud.dropped == 1 and cloud.xyz[0, 1] == np.float32(4_500_000.25)


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("far", [1e30, -1e30, 3e38, 1e12])
@pytest.mark.parametrize("axis", "xyz")
def test_points_beyond_any_sensor_are_dropped_and_counted(axis: str, far: float) -> None:
    points = random_points(5)
    points[axis][2] = far
    points["y"][0] = 9_999_999.0  # a northing of UTM
    points["intensity"][1] = far
    cloud = clouds.decode_cloud(cloud_message(points), "/p", 0)
    assert cloud.dropped == 1
    np.testing.assert_array_equal(cloud.xyz[:, 1], np.delete(points["y"], 2))
    np.testing.assert_array_equal(cloud.fields["intensity"], np.delete(points["intensity"], 2))


def test_padding_fields_of_the_same_name_do_no_harm() -> None:
    msg = cloud_message(random_points(10))
    msg.fields += [
        Message(name="_", offset=0, datatype=2, count=1),
        Message(name="_", offset=4, datatype=2, count=1),
    ]
    np.testing.assert_array_equal(clouds.decode_cloud(msg, "/p", 0).xyz[:, 0], random_points(10)["x"])


def test_bad_layouts_are_named() -> None:
    msg = cloud_message(random_points(10))
    msg.fields = msg.fields[:1] + msg.fields[3:]
    with pytest.raises(MessageError, match="/p: the cloud has no field y, z; its fields are x, intensity"):
        clouds.decode_cloud(msg, "/p", 0)
    msg = cloud_message(random_points(10))
    msg.fields[3].offset = 13
    with pytest.raises(MessageError, match=r"/p: field 'intensity' ends at byte 17 .* point_step is 16"):
        clouds.decode_cloud(msg, "/p", 0)
    msg.fields[3].datatype = 11
    with pytest.raises(MessageError, match="/p: field 'intensity' has the unknown datatype 11"):
        clouds.decode_cloud(msg, "/p", 0)


# --- images ------------------------------------------------------------------------------------


def image_message(pixels: NDArray[Any], encoding: str, padding: int = 0, **changes: Any) -> Message:
    """Make a sensor_msgs/Image of (H, W) or (H, W, C) pixels. NV12 has 1.5 rows of data per row of pixels."""
    rows, width = pixels.shape[:2]
    data = b"".join(row.tobytes() + b"\x7f" * padding for row in pixels)
    msg = Message(
        header=header("cam"),
        height=rows,
        width=width,
        encoding=encoding,
        is_bigendian=int(pixels.dtype.str[0] == ">"),
        step=len(data) // rows,
        data=np.frombuffer(data, np.uint8),
    )
    msg.__dict__.update(changes)
    return msg


def random_pixels(*shape: int, dtype: str = "u1", high: int = 256) -> NDArray[Any]:
    return np.random.default_rng(1).integers(0, high, shape).astype(dtype)


ORDERS = {"bgr8": (0, 1, 2), "rgb8": (2, 1, 0), "bgra8": (0, 1, 2), "rgba8": (2, 1, 0), "8UC3": (0, 1, 2)}


@pytest.mark.long
@pytest.mark.parametrize("encoding", [*ORDERS, "8UC4", "mono8", "8UC1"])
@given(height=st.integers(1, 9), width=st.integers(1, 9), padding=st.integers(0, 5))
def test_8_bit_images_are_decoded(encoding: str, height: int, width: int, padding: int) -> None:
    channels = 4 if "a8" in encoding or encoding == "8UC4" else 1 if encoding in ("mono8", "8UC1") else 3
    pixels = random_pixels(height, width, channels)
    image = images.decode_image(image_message(pixels, encoding, padding), "/image", 3)
    order = (0, 0, 0) if channels == 1 else ORDERS.get(encoding, (0, 1, 2))
    np.testing.assert_array_equal(image.bgr, pixels[..., list(order)])
    assert image.bgr.dtype == np.uint8 and image.bgr.flags.c_contiguous
    assert (image.stamp, image.frame_id, image.topic, image.received) == (STAMP, "cam", "/image", 3)


def test_bgr8_is_not_copied() -> None:
    msg = image_message(random_pixels(6, 8, 3), "bgr8")
    assert np.shares_memory(images.decode_image(msg, "/image", 0).bgr, msg.data)


@pytest.mark.parametrize("dtype", ["<u2", ">u2"])
@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("encoding", ["mono16", "16UC1"])
def test_16_bit_images_use_the_bits_that_they_need(encoding: str, bits: int, dtype: str) -> None:
    pixels = random_pixels(6, 8, dtype=dtype, high=1 << bits)
    pixels[0, 0] = (1 << bits) - 1
    bgr = images.decode_image(image_message(pixels, encoding, padding=2), "/image", 0).bgr
    expected = np.rint(pixels.astype(float) * 255 / ((1 << bits) - 1))
    assert np.abs(bgr.astype(float) - expected[..., None]).max() <= 0.5
    assert bgr[0, 0].tolist() == [255, 255, 255]


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("bits", [8, 16])
def test_bayer_images_of_one_colour_show_that_colour(pattern: str, bits: int) -> None:
    colour = {"b": 20, "g": 130, "r": 250}
    scale = 257 if bits == 16 else 1
    tile = np.array([colour[c] * scale for c in pattern], f"<u{bits // 8}").reshape(2, 2)
    pixels = np.tile(tile, (5, 6))
    if bits == 16:
        pixels[0, 0] = 65535  # the brightest pixel tells the depth
    msg = image_message(pixels, f"bayer_{pattern}{bits}")
    np.testing.assert_array_equal(
        images.decode_image(msg, "/image", 0).bgr[4:7, 4:7], np.full((3, 3, 3), [20, 130, 250])
    )


def bt601(y: NDArray[Any], u: NDArray[Any], v: NDArray[Any]) -> NDArray[Any]:
    """ITU-R BT.601, studio swing."""
    y, u, v = 1.164 * np.maximum(y.astype(float) - 16, 0), u.astype(float) - 128, v.astype(float) - 128
    return np.clip(np.stack([y + 2.018 * u, y - 0.813 * v - 0.391 * u, y + 1.596 * v], axis=-1), 0, 255)


@pytest.mark.parametrize(("encoding", "luma"), [("yuv422", 1), ("uyvy", 1), ("yuv422_yuy2", 0), ("yuyv", 0)])
def test_yuv422_images_are_decoded(encoding: str, luma: int) -> None:
    pixels = random_pixels(6, 8, 2)
    chroma = pixels[..., 1 - luma]
    expected = bt601(pixels[..., luma], np.repeat(chroma[:, ::2], 2, 1), np.repeat(chroma[:, 1::2], 2, 1))
    bgr = images.decode_image(image_message(pixels, encoding, padding=4), "/image", 0).bgr
    assert np.abs(bgr - expected).max() <= 2


@pytest.mark.parametrize(("encoding", "u"), [("nv12", 0), ("nv21", 1)])
def test_yuv420_images_are_decoded(encoding: str, u: int) -> None:
    planes = random_pixels(9, 8)
    chroma = planes[6:].reshape(3, 4, 2).repeat(2, 0).repeat(2, 1)
    expected = bt601(planes[:6], chroma[..., u], chroma[..., 1 - u])
    bgr = images.decode_image(image_message(planes, encoding, height=6), "/image", 0).bgr
    assert bgr.shape == (6, 8, 3) and np.abs(bgr - expected).max() <= 2


@pytest.mark.parametrize("step", [0, 8, 100, 1000])
def test_rows_without_padding_are_read_whatever_their_step(step: int) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (6, 8, 3), np.uint8)
    image = images.decode_image(image_message(pixels, "bgr8", step=step), "/image", 0)
    np.testing.assert_array_equal(image.bgr, pixels)


def test_bad_images_are_named() -> None:
    pixels = random_pixels(6, 8, 3)
    with pytest.raises(
        MessageError, match="/image: image encoding '32FC1' is not supported; supported are bgr8, rgb8"
    ):
        images.decode_image(image_message(pixels, "32FC1"), "/image", 0)
    with pytest.raises(
        MessageError, match=r"/image: a 8 x 7 bgr8 image needs 7 rows of 24 bytes, .* 144 bytes of data"
    ):
        images.decode_image(image_message(pixels, "bgr8", height=7), "/image", 0)
    with pytest.raises(MessageError, match="but step is 8"):
        images.decode_image(image_message(pixels, "bgr8", step=8, height=5), "/image", 0)
    with pytest.raises(MessageError, match="/image: the image is 0 x 6 and has no pixels"):
        images.decode_image(image_message(pixels, "bgr8", width=0), "/image", 0)
    with pytest.raises(MessageError, match="/image: a 7 x 6 image cannot be yuv422"):
        images.decode_image(image_message(random_pixels(6, 7, 2), "yuv422"), "/image", 0)


def compressed(data: bytes, kind: str) -> Message:
    return Message(header=header("cam"), format=kind, data=np.frombuffer(data, np.uint8))


def encoded(extension: str, pixels: NDArray[Any]) -> bytes:
    return bytes(cv2.imencode(extension, pixels)[1].tobytes())


@pytest.mark.parametrize("ros", STORES)
def test_a_kitti_image_as_png_stays_as_it_is(shared: Path, ros: str) -> None:
    path = shared / "kitti/image_2/000000.png"
    msg = through(
        STORES[ros], "sensor_msgs/msg/CompressedImage", compressed(path.read_bytes(), "bgr8; png compressed")
    )
    image = images.decode_compressed_image(msg, "/image/compressed", 4)
    assert image.encoded == path.read_bytes() and image.media_type == "image/png"
    np.testing.assert_array_equal(image.bgr, cv2.imread(str(path)))
    assert (image.stamp, image.frame_id, image.received) == (STAMP, "cam", 4)


def test_the_kind_of_a_compressed_image_is_that_of_its_data() -> None:
    pixels = cv2.GaussianBlur(random_pixels(64, 48, 3), (0, 0), 5)
    data = encoded(".jpg", pixels)
    for kind in ("jpeg", "rgb8; png compressed bgr8", ""):
        image = images.decode_compressed_image(compressed(data, kind), "/image", 0)
        assert image.media_type == "image/jpeg" and image.encoded == data
        assert np.abs(image.bgr.astype(int) - pixels).mean() < 3


def test_a_grey_png_of_16_bits_is_shown_as_it_was_reduced() -> None:
    pixels = random_pixels(6, 8, dtype="u2", high=4096)
    pixels[0, 0] = 4095
    image = images.decode_compressed_image(compressed(encoded(".png", pixels), "mono16; png"), "/image", 0)
    assert image.encoded is None and not image.media_type
    assert np.abs(image.bgr[..., 1] - pixels * 255.0 / 4095).max() <= 0.5


@pytest.mark.parametrize("bits", [8, 16])
def test_compressed_bayer_pixels_are_shown_in_colour(bits: int) -> None:
    """As compressed_image_transport does with bayer; they were shown as a grey checkerboard."""
    scale = 257 if bits == 16 else 1
    tile = np.array([[130, 20], [250, 130]], np.uint16) * scale  # green, blue, red, green
    pixels = np.tile(tile, (5, 6)).astype(f"u{bits // 8}")
    if bits == 16:
        pixels[0, 0] = 65535
    data = encoded(".png", pixels)
    image = images.decode_compressed_image(compressed(data, f"bayer_gbrg{bits}; png compressed "), "/i", 0)
    np.testing.assert_array_equal(image.bgr[4:7, 4:7], np.full((3, 3, 3), [20, 130, 250]))
    assert image.encoded is None and not image.media_type
    grey = compressed(encoded(".png", pixels.astype(np.uint8)), f"bayer_gbrg{bits}; jpeg compressed mono8")
    image = images.decode_compressed_image(grey, "/i", 0)
    assert image.encoded is not None and (np.ptp(image.bgr, axis=2) == 0).all()


@pytest.mark.parametrize("channels", [3, 4])  # with transparency the file has another header
@pytest.mark.parametrize("quality", [95, 101])  # with loss, and without
def test_webp_is_decoded_and_goes_on_raw(channels: int, quality: int) -> None:
    """Rerun reads none, so that the bytes do not go along."""
    pixels = cv2.GaussianBlur(random_pixels(48, 64, channels), (0, 0), 5)
    pixels[..., 3:] = 255 - np.arange(64)[None, :, None] // 32  # nearly opaque
    _, data = cv2.imencode(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, quality])
    image = images.decode_compressed_image(compressed(data.tobytes(), "webp"), "/image", 0)
    assert image.bgr.shape == (48, 64, 3) and image.encoded is None and not image.media_type
    worst = 0 if quality > 100 and channels == 3 else 3
    assert np.abs(image.bgr.astype(int) - pixels[..., :3]).mean() <= worst


def test_a_webp_that_is_too_large_is_known_before_it_is_decoded() -> None:
    _, encoding = cv2.imencode(".webp", random_pixels(8, 8, 4), [cv2.IMWRITE_WEBP_QUALITY, 80])
    data = bytearray(encoding)
    assert data[12:16] == b"VP8X"
    data[24:30] = b"\xff\xff\x00" * 2
    with pytest.raises(MessageError, match="an image of 65536 x 65536 pixels is not taken"):
        images.decode_compressed_image(compressed(bytes(data), "webp"), "/image", 0)


def test_bad_compressed_images_are_named() -> None:
    webp = encoded(".webp", random_pixels(64, 48, 3))
    jpeg, png = encoded(".jpg", random_pixels(64, 48, 3)), encoded(".png", random_pixels(64, 48, 3))
    cut = [data[: len(data) // 2] for data in (jpeg, png, webp)]
    for data in (*cut, png[:8], webp[:20], webp[:-1], jpeg[:3] + b"\xff\xd9", webp[:12] + bytes(len(webp))):
        with pytest.raises(
            MessageError, match=r"/image: the image/(jpeg|png|webp) data \(\d+ bytes\) is damaged or cut"
        ):
            images.decode_compressed_image(compressed(data, ""), "/image", 0)
    with pytest.raises(MessageError, match=r"/image: .*'avif' holds neither JPEG, PNG nor WebP data"):
        images.decode_compressed_image(compressed(b"\0\0\0\x1cftypavif", "avif"), "/image", 0)
    with pytest.raises(MessageError, match=r"/image: 'h264' is video of a kind that is not decoded"):
        images.decode_compressed_image(compressed(b"\0\0\0\1abc", "h264"), "/image", 0)
    with pytest.raises(MessageError, match="/image: '16UC1; compressedDepth png' is a depth image"):
        images.decode_compressed_image(compressed(png, "16UC1; compressedDepth png"), "/image", 0)


# --- camera models -----------------------------------------------------------------------------

K = [500.0, 0, 320, 0, 510, 180, 0, 0, 1]
P = [450.0, 0, 310, -60, 0, 455, 175, 0, 0, 0, 1, 0]


def info_message(model: str = "plumb_bob", d: Any = (0.1, -0.2, 0.01, 0.02, 0.03), **changes: Any) -> Message:
    roi = Message(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    values = {
        "distortion_model": model,
        "height": 360,
        "width": 640,
        "binning_x": 0,
        "binning_y": 0,
        "roi": roi,
    }
    for name, value in {"d": d, "k": K, "r": np.eye(3).ravel(), "p": P}.items():
        values[name] = values[name.upper()] = value
    return Message(header=header("cam"), **(values | changes))


@pytest.mark.parametrize("ros", STORES)
def test_camera_info_of_both_ros_versions(ros: str) -> None:
    msg = through(STORES[ros], "sensor_msgs/msg/CameraInfo", info_message())
    raw = camera_info.decode_camera_info(msg, rectified=False)
    assert (raw.width, raw.height, raw.distortion_model) == (640, 360, "plumb_bob")
    np.testing.assert_array_equal(raw.K, np.reshape(K, (3, 3)))
    np.testing.assert_array_equal(raw.D, [0.1, -0.2, 0.01, 0.02, 0.03])
    rectified = camera_info.decode_camera_info(msg, rectified=True)
    np.testing.assert_array_equal(rectified.K, [[450, 0, 310], [0, 455, 175], [0, 0, 1]])
    assert not rectified.D.size and not rectified.distortion_model
    assert rectified.raw is not None and raw.raw is None
    np.testing.assert_array_equal(rectified.raw.D, raw.D)
    np.testing.assert_array_equal(rectified.raw.K, raw.K)


def test_a_rectified_camera_without_p_keeps_k() -> None:
    intrinsics = camera_info.decode_camera_info(info_message(p=np.zeros(12), P=np.zeros(12)), rectified=True)
    np.testing.assert_array_equal(intrinsics.K, np.reshape(K, (3, 3)))


@pytest.mark.parametrize(
    ("given_model", "coefficients", "model"),
    [
        ("rational_polynomial", 8, "rational_polynomial"),
        ("equidistant", 4, "equidistant"),
        ("fisheye", 4, "equidistant"),
        ("kannala_brandt", 4, "equidistant"),
        ("", 5, "plumb_bob"),
    ],
)
def test_every_distortion_model_is_decoded(given_model: str, coefficients: int, model: str) -> None:
    d = np.linspace(0.01, 0.02, coefficients)
    intrinsics = camera_info.decode_camera_info(info_message(given_model, d), rectified=False)
    assert intrinsics.distortion_model == model
    np.testing.assert_array_equal(intrinsics.D, d)


@pytest.mark.parametrize("model", ["", "plumb_bob", "whatever"])
def test_coefficients_of_zero_are_no_distortion(model: str) -> None:
    intrinsics = camera_info.decode_camera_info(info_message(model, np.zeros(5)), rectified=False)
    assert not intrinsics.distortion_model and not intrinsics.D.size


def test_an_equidistant_lens_without_coefficients_is_no_pinhole() -> None:
    intrinsics = camera_info.decode_camera_info(info_message("equidistant", np.zeros(4)), rectified=False)
    points = np.array([[3.0, 1.0, 2.0], [-1.0, 0.5, 4.0]])
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), intrinsics.K, np.zeros(4)
    )
    np.testing.assert_allclose(geometry.project(points, intrinsics)[0], expected[:, 0], atol=1e-3)
    assert not camera_info.decode_camera_info(info_message("equidistant", np.zeros(4)), True).distortion_model


def test_region_of_interest_and_binning_are_applied() -> None:
    roi = Message(x_offset=100, y_offset=60, width=320, height=200, do_rectify=False)
    msg = info_message(binning_x=2, binning_y=4, roi=roi)
    intrinsics = camera_info.decode_camera_info(msg, rectified=False)
    assert (intrinsics.width, intrinsics.height) == (160, 50)
    np.testing.assert_allclose(intrinsics.K, np.array([[250, 0, 110], [0, 127.5, 30], [0, 0, 1]]))
    assert msg.k[2] == 320  # the message is another reader's too


def test_bad_camera_infos_are_named() -> None:
    zero = np.zeros(9)
    with pytest.raises(MessageError, match="/cam/camera_info: the camera is uncalibrated"):
        camera_info.decode_camera_info(info_message(k=zero, K=zero), False, "/cam/camera_info")
    with pytest.raises(
        MessageError,
        match="/info: distortion model 'mei' is not supported; supported are equidistant, plumb_bob",
    ):
        camera_info.decode_camera_info(info_message("mei"), False, "/info")
    with pytest.raises(MessageError, match=r"/info: more than 14 coefficients .* OpenCV has 14"):
        camera_info.decode_camera_info(info_message("rational_polynomial", np.full(15, 0.01)), False, "/info")
    with pytest.raises(MessageError, match=r"/info: .* are no coefficients"):
        camera_info.decode_camera_info(info_message(d=[math.nan]), False, "/info")
    for model, d in [("equidistant", np.full(5, 0.01)), ("plumb_bob", [1e9]), ("plumb_bob", [-math.inf])]:
        with pytest.raises(MessageError, match="/info: "):
            camera_info.decode_camera_info(info_message(model, d), False, "/info")
    for wrong in ({0: 1e30}, {2: math.nan}, {4: 1e9}, {5: -math.inf}, {1: 1e200}):
        k = np.array(K, np.float64)
        for place, number in wrong.items():
            k[place] = number
        with pytest.raises(MessageError, match=r"/info: .*calibrate"):
            camera_info.decode_camera_info(info_message(k=k, K=k), False, "/info")
    p = np.array(P, np.float64)
    p[3] = math.nan
    with pytest.raises(MessageError, match=r"/info: .*calibrate"):
        camera_info.decode_camera_info(info_message(p=p, P=p), True, "/info")


@pytest.mark.parametrize("model", ["plumb_bob", "rational_polynomial", "equidistant", ""])
@pytest.mark.parametrize("count", range(1, 15))
def test_any_number_of_coefficients_is_the_lens_that_it_states(model: str, count: int) -> None:
    """OpenCV takes 4, 5, 8, 12 or 14. Each further coefficient is zero, which is the same lens."""
    stated = np.zeros(count)
    limit = 4 if model == "equidistant" else 14
    stated[:limit] = np.linspace(0.01, 0.02, 14)[: min(count, limit)]
    intrinsics = camera_info.decode_camera_info(info_message(model, stated), rectified=False)
    points = np.array([[0.3, 0.1, 2.0], [-1.0, 0.5, 4.0]])
    full = np.zeros(limit)
    full[: min(count, limit)] = stated[:limit]
    lens = cv2.fisheye.projectPoints if model == "equidistant" else cv2.projectPoints
    expected = lens(points[:, None], np.zeros(3), np.zeros(3), intrinsics.K, full)[0][:, 0]
    pixels, _ = geometry.project(points, intrinsics)
    np.testing.assert_allclose(pixels, expected, atol=1e-3)
    np.testing.assert_allclose(
        geometry.rays(pixels, intrinsics)[:, :2], points[:, :2] / points[:, 2:], atol=1e-5
    )
    image = np.zeros((36, 64, 3), np.uint8)
    assert edges.undistort(image, intrinsics).shape == rectify(image, intrinsics).shape == image.shape


# --- transforms --------------------------------------------------------------------------------


def transform_message(parent: str, child: str, xyz: Any = (1, 2, 3), xyzw: Any = (0, 0, 1, 1)) -> Message:
    return Message(
        header=header(parent),
        child_frame_id=child,
        transform=Message(
            translation=Message(**dict(zip("xyz", xyz, strict=True))),
            rotation=Message(**dict(zip("xyzw", xyzw, strict=True))),
        ),
    )


@pytest.mark.parametrize("ros", STORES)
def test_transforms_are_decoded(ros: str) -> None:
    msg = Message(transforms=[transform_message("/map", "base"), transform_message("base", "lidar")])
    first, second = transforms.decode_transforms(through(STORES[ros], "tf2_msgs/msg/TFMessage", msg))
    assert (first.stamp, first.parent, first.child) == (STAMP, "map", "base")
    assert (second.parent, second.child) == ("base", "lidar")
    np.testing.assert_allclose(first.parent_from_child @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-12)


BAD_TRANSFORMS = [
    (transform_message("a", "b", xyzw=(0, 0, 0, 0)), "rotation from 'b' to 'a'"),
    (transform_message("a", "b", xyz=(0, math.nan, 0)), "translation from 'b' to 'a' is not finite"),
    (transform_message("a", "a"), "cannot be parent and child"),
    (transform_message("", "a"), "cannot be parent and child"),
]


@pytest.mark.parametrize(("bad", "text"), BAD_TRANSFORMS)
def test_bad_transforms_are_named_and_spare_the_good_ones(bad: Message, text: str) -> None:
    with pytest.raises(MessageError, match=f"/tf: .*{text}"):
        transforms.decode_transforms(Message(transforms=[bad]))
    good = transform_message("base", "lidar")
    refused: list[str] = []
    mixed = Message(transforms=[bad, good])
    assert [t.child for t in transforms.decode_transforms(mixed, "/tf_static", refused.append)] == ["lidar"]
    (said,) = refused
    assert said.startswith("/tf_static: ") and text in said


def test_odometry_is_decoded() -> None:
    pose = Message(position=Message(x=1, y=2, z=3), orientation=Message(x=0, y=0, z=1, w=1))
    msg = Message(header=header("odom"), child_frame_id="base_link", pose=Message(pose=pose))
    moved = transforms.decode_odometry(msg)
    assert (moved.stamp, moved.parent, moved.child) == (STAMP, "odom", "base_link")
    np.testing.assert_allclose(moved.parent_from_child @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-12)
    msg.child_frame_id = ""
    with pytest.raises(MessageError, match="/odom: 'odom' and '' cannot be parent and child"):
        transforms.decode_odometry(msg, "/odom")


# --- detections --------------------------------------------------------------------------------


def result(name: str, score: float) -> Message:
    return Message(hypothesis=Message(class_id=name, score=score), pose=POSE)


POSE = Message(
    pose=Message(position=Message(x=0.0, y=0.0, z=0.0), orientation=Message(x=0.0, y=0.0, z=0.0, w=1.0)),
    covariance=np.zeros(36),
)


def detection_2d(x: float, y: float, w: float, h: float, *results: Message, theta: float = 0.0) -> Message:
    center = Message(position=Message(x=x, y=y), theta=theta)
    return Message(
        header=header(), results=list(results), bbox=Message(center=center, size_x=w, size_y=h), id=""
    )


def detection_3d(
    xyz: tuple[float, ...],
    size: tuple[float, ...],
    *results: Message,
    xyzw: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0),
) -> Message:
    center = Message(
        position=Message(**dict(zip("xyz", xyz, strict=True))),
        orientation=Message(**dict(zip("xyzw", xyzw, strict=True))),
    )
    bbox = Message(center=center, size=Message(**dict(zip("xyz", size, strict=True))))
    return Message(header=header(), results=list(results), bbox=bbox, id="")


def array_of(*detections: Message) -> Message:
    return Message(header=header("rslidar"), detections=list(detections))


def test_2d_detections_are_decoded() -> None:
    msg = array_of(
        detection_2d(100, 50, 20, 10, result("person", 0.5)),
        detection_2d(100, 50, 20, 10, theta=math.pi / 2),
    )
    msg = through(STORES["ros2"], "vision_msgs/msg/Detection2DArray", msg)
    boxes = detections.decode_detections_2d(msg, "/detection/camera_2d", 9)
    np.testing.assert_allclose(boxes.xyxy, [[90, 45, 110, 55], [95, 40, 105, 60]], atol=1e-5)
    assert boxes.labels == ("person", "") and boxes.scores.tolist() == [0.5, 0]
    assert (boxes.topic, boxes.stamp, boxes.frame_id, boxes.received) == (
        "/detection/camera_2d",
        STAMP,
        "rslidar",
        9,
    )


def test_boxes_without_any_score_count_fully() -> None:
    msg = array_of(detection_2d(9, 9, 4, 4, result("person", 0.0)), detection_2d(9, 9, 4, 4))
    assert detections.decode_detections_2d(msg, "/detections", 9).scores.tolist() == [1, 1]


def test_3d_detections_are_decoded() -> None:
    half = math.radians(15)
    msg = array_of(
        detection_3d((1, 2, 3), (4, 5, 6), result("car", 0.75), xyzw=(0, 0, math.sin(half), math.cos(half))),
        detection_3d((7, 8, 9), (1, 1, 2), result("cluster_1", 1.0)),
    )
    msg = through(STORES["ros2"], "vision_msgs/msg/Detection3DArray", msg)
    found = detections.decode_detections_3d(msg, "/detection/fused_3d", 9)
    np.testing.assert_array_equal(found.boxes.center, [[1, 2, 3], [7, 8, 9]])
    np.testing.assert_array_equal(found.boxes.size, [[4, 5, 6], [1, 1, 2]])
    np.testing.assert_allclose(found.boxes.yaw, [math.radians(30), 0], atol=1e-6)
    assert found.labels == ("car", "cluster_1") and found.scores.tolist() == [0.75, 1]
    assert found.boxes.center.dtype == np.float64  # it may be in a map, far from its origin
    assert found.boxes.size.dtype == found.boxes.yaw.dtype == np.float32


def test_the_class_counts_more_than_the_name_of_the_cluster() -> None:
    fused = [result("cluster_3", 1.0), result("car", 0.4), result("person", 0.8), result("truck", math.nan)]
    msg = array_of(detection_3d((0, 0, 0), (1, 1, 1), *fused))
    found = detections.decode_detections_3d(msg, "/fused", 0)
    assert found.labels == ("person",) and found.scores[0] == np.float32(0.8)


def test_older_versions_of_vision_msgs_are_decoded() -> None:
    flat = Message(id=3, score=0.5, pose=POSE)
    box = Message(center=Message(x=100, y=50, theta=0), size_x=20, size_y=10)
    boxes = detections.decode_detections_2d(array_of(Message(results=[flat], bbox=box)), "/boxes", 0)
    np.testing.assert_array_equal(boxes.xyxy, [[90, 45, 110, 55]])
    assert boxes.labels == ("3",) and boxes.scores.tolist() == [0.5]


def test_detections_that_are_not_finite_are_left_out() -> None:
    good = detection_3d((1, 2, 3), (1, 1, 1), result("car", math.nan))
    bad = [detection_3d((1, math.nan, 3), (1, 1, 1)), detection_3d((1, 2, 3), (math.inf, 1, 1))]
    found = detections.decode_detections_3d(array_of(bad[0], good, bad[1]), "/boxes", 0)
    assert len(found.boxes) == 1 and found.labels == ("car",) and found.scores.tolist() == [0]
    nothing = detections.decode_detections_2d(array_of(detection_2d(math.nan, 0, 1, 1)), "/boxes", 0)
    assert nothing.xyxy.shape == (0, 4) and nothing.labels == () and nothing.scores.shape == (0,)


def test_an_unknown_layout_of_a_detection_is_named() -> None:
    kind = "vision_msgs/msg/Detection3DArray"
    received = LiveMessage("/boxes", kind, 0, b"")
    with pytest.raises(MessageError, match=rf"^/boxes: not a {kind}: .*bbox"):
        msg = array_of(Message(results=[], box=None))
        guard(received, detections.decode_detections_3d, msg, "/boxes", 0)


# --- what a message may hold ---------------------------------------------------------------------


def test_a_cloud_beyond_the_limits_is_refused_in_one_line() -> None:
    msg = cloud_message(random_points(10))
    msg.height = msg.width = 2**32 - 1
    with pytest.raises(MessageError, match="/p: a cloud of 4294967295 x 4294967295 points is not taken"):
        clouds.decode_cloud(msg, "/p", 0)
    for step in (2**31, 2**32 - 1, 0):
        msg = cloud_message(random_points(10))
        msg.point_step = step
        with pytest.raises(MessageError, match=rf"/p: a point of {step} bytes cannot be"):
            clouds.decode_cloud(msg, "/p", 0)
    msg = cloud_message(random_points(10))
    msg.fields[3].count, msg.fields[3].datatype, msg.point_step = 10**6, 2, 2_000_000
    with pytest.raises(MessageError, match="/p: its points have more than 1024 fields, each element counted"):
        clouds.decode_cloud(msg, "/p", 0)


def png_of(width: int, height: int) -> bytes:
    """Make a black PNG of one bit per pixel. The file is small even for a large image."""

    def part(kind: bytes, content: bytes) -> bytes:
        crc = zlib.crc32(kind + content)
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", crc)

    head = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    rows = zlib.compress((b"\0" + bytes(-(-width // 8))) * height)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", rows) + part(b"IEND", b"")


@pytest.mark.long
def test_an_image_of_gigabytes_is_refused_by_its_header(monkeypatch: pytest.MonkeyPatch) -> None:
    bomb = png_of(32_000, 32_000)
    jpeg = encoded(".jpg", random_pixels(16, 16, 3))
    at = jpeg.index(b"\xff\xc0") + 5
    monkeypatch.setattr(cv2, "imdecode", None)  # nothing is decoded
    for data in (bomb, jpeg[:at] + struct.pack(">HH", 32_000, 32_000) + jpeg[at + 4 :]):
        with pytest.raises(MessageError, match=r"/i: an image of 32000 x 32000 pixels is not taken: 1000000"):
            images.decode_compressed_image(compressed(data, ""), "/i", 0)
    monkeypatch.undo()
    large = images.decode_compressed_image(compressed(png_of(4000, 3000), ""), "/i", 0)
    assert large.bgr.shape == (3000, 4000, 3)


def test_a_png_with_overlong_chunks_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    png = encoded(".png", random_pixels(24, 32, 3))
    at = png.index(b"IDAT") - 4
    monkeypatch.setattr(cv2, "imdecode", None)  # which would take four gigabytes
    with pytest.raises(MessageError, match=r"/i: the image/png data \(\d+ bytes\) is damaged or cut"):
        bomb = png[:at] + struct.pack(">I", 2**31 - 1) + png[at + 4 :]
        images.decode_compressed_image(compressed(bomb, ""), "/i", 0)


@given(
    width=st.integers(1, 80),
    height=st.integers(1, 80),
    grey=st.booleans(),
    form=st.sampled_from([".jpg", ".png", ".webp"]),
)
def test_the_size_in_a_header_is_that_of_the_image(width: int, height: int, grey: bool, form: str) -> None:
    pixels = random_pixels(height, width) if grey else random_pixels(height, width, 3)
    options = {
        ".jpg": [cv2.IMWRITE_JPEG_PROGRESSIVE, int(width % 2)],
        ".webp": [cv2.IMWRITE_WEBP_QUALITY, 80 + 21 * (width % 2)],  # above 100: without loss
    }.get(form, [])
    data = bytes(cv2.imencode(form, pixels, options)[1].tobytes())
    assert images.encoded_size(data) == (width, height)


DECODERS: dict[str, Callable[[Any], object]] = {
    "cloud": lambda m: clouds.decode_cloud(m, "/t", 0),
    "image": lambda m: images.decode_image(m, "/t", 0),
    "compressed": lambda m: images.decode_compressed_image(m, "/t", 0),
    "info": lambda m: camera_info.decode_camera_info(m, True, "/t"),
    "transforms": lambda m: transforms.decode_transforms(m, "/t"),
    "odometry": lambda m: transforms.decode_odometry(m, "/t"),
    "boxes": lambda m: detections.decode_detections_2d(m, "/t", 0),
    "boxes 3d": lambda m: detections.decode_detections_3d(m, "/t", 0),
}


@pytest.mark.parametrize("kind", DECODERS)
@pytest.mark.parametrize(
    "msg",
    [
        Message(),
        Message(header=None, data="text", fields=5, height="9", width=None, transforms=[None], format=7),
        Message(
            header=header(), detections=[Message(results=[Message()])], encoding="bgr8", K=(), D=(), P=()
        ),
    ],
)
def test_messages_with_other_fields_are_counted_as_failures(kind: str, msg: Message) -> None:
    with pytest.raises(MessageError, match=r"^/t: .*\S$") as caught:
        guard(LiveMessage("/t", "some/msg/Kind", 0, b""), DECODERS[kind], msg)
    assert "\n" not in str(caught.value)
