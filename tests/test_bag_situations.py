"""Bags as users and drivers record them, rebuilt from public reports; see the table in tests/README.md."""

from __future__ import annotations

import re
import shutil
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from backports import zstd
from mcap.writer import Writer

from bevviz.bags.source import BagSource
from bevviz.config import load
from bevviz.errors import UserError
from bevviz.model import geometry
from bevviz.model.frame import F64, Frame
from tests.support import bags, foxglove_bags, kept_drives
from tests.support.single_frames import assert_as_in_the_run


@pytest.mark.parametrize("row_step", [16 * 200, 16 * 53, 0])
def test_a_cloud_with_a_wrong_row_step_has_all_its_points(tmp_path: Path, row_step: int) -> None:
    items = bags.small_items(scans=2)
    for item in items:
        if item.topic == bags.CLOUD:
            item.message.height, item.message.width, item.message.row_step = 4, 50, row_step
    with BagSource([bags.write(tmp_path / "drive", items)], load()) as source:
        assert [len(frame.points) for frame in source] == [200, 200]
        assert not source.warnings


def test_points_that_the_data_lack_are_said(tmp_path: Path) -> None:
    items = bags.small_items(scans=3)
    for item in items:
        if item.topic == bags.CLOUD:
            item.message.height, item.message.width, item.message.row_step = 4, 60, 16 * 60
    with BagSource([bags.write(tmp_path / "drive", items)], load()) as source:
        assert [len(frame.points) for frame in source] == [200, 200, 200]
        (said,) = source.doubts
    assert said.startswith(f"{bags.CLOUD}: a cloud states 60 x 4 points of 16 bytes and a row_step of 960")
    assert said.endswith("40 of 240 points are missing")


@pytest.mark.parametrize("stated", [True, False])
def test_points_in_the_other_byte_order_are_read(tmp_path: Path, stated: bool) -> None:
    items = bags.small_items(scans=2)
    for item in items:
        if item.topic == bags.CLOUD:
            item.message.is_bigendian = stated
            if not stated:
                item.message.data = item.message.data.view("<u4").byteswap().view(np.uint8)
    sound, _ = read(bags.write(tmp_path / "sound", bags.small_items(scans=2)))
    frame, doubts = read(bags.write(tmp_path / "drive", items))
    np.testing.assert_array_equal(frame.points, sound.points)
    (said,) = doubts
    assert said.startswith(f"{bags.CLOUD}: is_bigendian is {stated}, but only the other byte order gives")


# --- time --------------------------------------------------------------------------------------

SECOND = 1_000_000_000
PIXELS = f"source.camera_topics=[{bags.IMAGE}]"


def late(items: list[bags.Item], seconds: float, *topics: str) -> list[bags.Item]:
    """Return the messages with some topics received later."""
    return [
        item._replace(received=item.received + round(seconds * SECOND)) if item.topic in topics else item
        for item in items
    ]


@pytest.mark.long
@pytest.mark.parametrize("seconds", [0.0, 0.45, 0.55, 0.65, 1.5, 2.4])
def test_a_late_lidar_has_its_images_in_a_run_and_alone(tmp_path: Path, seconds: float) -> None:
    bag = bags.write(tmp_path / "drive", late(bags.small_items(scans=40), seconds, bags.CLOUD))
    run = assert_as_in_the_run([bag])
    assert [f.cameras[0].image and f.cameras[0].image.stamp for f in run] == [f.stamp for f in run]
    with BagSource([bag], load()) as source:
        list(source)
        assert not source.doubts


LATE = [(bags.IMAGE, 0.3), (bags.IMAGE, 1.2), ("/tf", 0.4), ("/tf", 1.0), (bags.CLOUD, 0.6), (bags.CLOUD, 3)]


@pytest.mark.long
@pytest.mark.parametrize("settings", [[], ["sync.max_wait=0.1"], ["sync.queue=2"], ["sync.tolerance=0.04"]])
@pytest.mark.parametrize(("topic", "seconds"), LATE)
def test_single_frames_pair_as_the_run_does(
    tmp_path: Path, topic: str, seconds: float, settings: list[str]
) -> None:
    bag = bags.write(tmp_path / "drive", late(bags.small_items(scans=30, points=20), seconds, topic))
    assert_as_in_the_run([bag], *settings)


@pytest.mark.parametrize("seconds", [0.7, 2.5, 5.0])
def test_the_remedy_for_late_images_is_tried_and_pairs_all(tmp_path: Path, seconds: float) -> None:
    items = late(bags.small_items(scans=80, points=20), seconds, bags.IMAGE)
    bag = bags.write(tmp_path / "drive", items)
    with BagSource([bag], load()) as source:
        list(source)
        (doubt,) = source.doubts
        source.frame(20)
        assert seconds > 2 or source.doubts
    assert f"{bags.IMAGE}: its messages come {seconds:.2f} s later than those of /tf, at the same" in doubt
    assert "sync.offsets" not in doubt and "sync.by" not in doubt
    settings = re.findall(r"--set (\S+)", doubt)
    assert [setting.partition("=")[0] for setting in settings] == ["sync.max_wait", "sync.queue"]
    run = assert_as_in_the_run([bag], *settings)
    assert [f.cameras[0].image and f.cameras[0].image.stamp for f in run] == [f.stamp for f in run]
    assert not [problem for frame in run for problem in frame.cameras[0].problems]


def numbered(log_times: list[int]) -> list[bags.Item]:
    """Return clouds with right stamps and these log times. The first point of cloud i has x = i."""
    clouds = [item for item in bags.small_items(scans=len(log_times)) if item.topic == bags.CLOUD]
    return [item._replace(received=time) for item, time in zip(clouds, log_times, strict=True)]


@pytest.mark.parametrize(
    "log_times",
    [
        [bags.START + i // 2 * 200_000_000 for i in range(6)],
        [0] * 6,
        [0, 0, 0, 5 * SECOND, 5 * SECOND, 6 * SECOND],
    ],
)
@pytest.mark.parametrize("form", ["mcap", "sqlite3", "ros1"])
def test_scans_of_equal_log_time_are_told_apart(tmp_path: Path, log_times: list[int], form: str) -> None:
    messages = bags.Messages(form == "ros1")
    items = [i for i in bags.small_items(messages, scans=6) if i.topic == bags.CLOUD]
    items = [item._replace(received=time) for item, time in zip(items, log_times, strict=True)]
    bag = bags.write(tmp_path / "drive.bag", items, messages, form=form)
    run = assert_as_in_the_run([bag])
    assert [frame.points[0, 0] for frame in run] == [frame.index for frame in run] == list(range(6))


def test_equal_log_times_and_stamps_keep_the_numbers(tmp_path: Path) -> None:
    items = numbered([bags.START + i // 3 * SECOND for i in range(9)])
    items[4].message.header.stamp = items[3].message.header.stamp
    bag = bags.write(tmp_path / "drive", items)
    with BagSource([bag], load()) as source:
        assert [(f.index, f.points[0, 0]) for f in source] == [(i, i) for i in range(9) if i != 4]
        assert [f.points[0, 0] for i in range(9) if (f := source.frame(i)) is not None] == list(range(9))
    with BagSource([bag], load(), at="1.0") as source:
        assert [(f.index, f.points[0, 0]) for f in source] == [(3, 3)]
    with BagSource([bag], load(), start="1.0", every=2) as source:
        assert [(f.index, f.points[0, 0]) for f in source] == [(0, 3), (2, 5), (4, 7)]


@pytest.mark.long
def test_single_frames_of_other_bags_are_those_of_the_run(tmp_path: Path, shared: Path) -> None:
    """The drive that ships with bevviz, one of Foxglove's messages, and one of KITTI."""
    assert_as_in_the_run([kept_drives.BAG])
    assert_as_in_the_run([foxglove_bags.write(tmp_path / "foxglove.mcap")])
    assert_as_in_the_run([bags.write(tmp_path / "kitti", bags.kitti_items(shared, scans=4, step=20))])


# --- files and channels ------------------------------------------------------------------------


def stamps_of(path: Path) -> tuple[list[int], list[str]]:
    """Return the stamps of all frames, in units of the period, and the warnings about the recording."""
    with BagSource([path], load()) as source:
        frames = [(frame.stamp - bags.START) // bags.PERIOD for frame in source]
        return frames, source.recording.warnings


@pytest.mark.parametrize("left_beside", [True, False])
@pytest.mark.parametrize("form", ["mcap", "sqlite3"])
def test_an_unpacked_bag_is_read_once(tmp_path: Path, form: str, left_beside: bool) -> None:
    bag = bags.write(tmp_path / "drive", bags.small_items(scans=5), form=form, compression="file")
    (packed,) = bag.glob("*.zstd")
    packed.with_suffix("").write_bytes(zstd.decompress(packed.read_bytes()))
    if not left_beside:
        packed.unlink()
    stamps, warnings = stamps_of(bag)
    assert stamps == list(range(5))
    names = [packed.with_suffix("").name] if left_beside else []
    assert [name in warning for name, warning in zip(names, warnings, strict=True)] == [True] * len(names)


def test_a_packed_bag_is_that_of_its_metadata(tmp_path: Path) -> None:
    bag = bags.write(tmp_path / "drive", bags.small_items(scans=5))
    (file,) = bag.glob("*.mcap")
    file.with_name(f"{file.name}.zstd").write_bytes(zstd.compress(file.read_bytes()))
    file.unlink()
    assert stamps_of(bag) == (list(range(5)), [])


def test_metadata_decide_which_files_are_the_bag(tmp_path: Path) -> None:
    bag = bags.write(tmp_path / "drive", bags.small_items(scans=5))
    part = bags.write(tmp_path / "part", bags.small_items(scans=3), form="sqlite3")
    shutil.copy(next(part.glob("*.db3")), bag / "converted.db3")
    stamps, (warning,) = stamps_of(bag)
    assert stamps == list(range(5))
    assert warning.startswith(
        f"{bag}: converted.db3 left out, which metadata.yaml does not list; if it is no"
    )


def test_a_copy_beside_a_bag_without_metadata_is_left_out(tmp_path: Path) -> None:
    bag = bags.write(tmp_path / "drive", bags.small_items(scans=5))
    other = bags.write(tmp_path / "other", bags.small_items(scans=5), form="sqlite3")
    shutil.copy(next(other.glob("*.db3")), bag / "other.db3")
    (bag / "metadata.yaml").unlink()
    stamps, warnings = stamps_of(bag)
    assert stamps == list(range(5))
    assert f"{bag}: other.db3 left out: a copy of another file" in warnings


def channel(path: Path, msgtype: str, schema: tuple[str, bytes] | None, encoding: str, topic: str) -> Path:
    """Write five clouds to an MCAP file with one channel."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        number = 0 if schema is None else writer.register_schema(msgtype, *schema)
        sent = writer.register_channel(topic, encoding, number)
        messages = bags.Messages()
        for item in [i for i in bags.small_items(messages, scans=5) if i.topic == bags.CLOUD]:
            data = bytes(messages.store.serialize_cdr(item.message, item.type))
            writer.add_message(sent, item.received, data, item.received)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


@pytest.mark.parametrize(
    ("msgtype", "schema", "topic", "name"),
    [
        ("sensor_msgs/msg/PointCloud2", ("ros2msg", b""), "/points", "/points"),
        ("sensor_msgs/msg/PointCloud2", ("ros2idl", b" \n"), "/points", "/points"),
        ("sensor_msgs/msg/PointCloud2", ("", b""), "/points", "/points"),
        (
            "sensor_msgs::msg::dds_::PointCloud2_",
            ("omgidl", b"module sensor_msgs {};"),
            "rt/points",
            "/points",
        ),
        ("sensor_msgs::msg::dds_::PointCloud2_", ("", b""), "rt/a/points", "/a/points"),
    ],
)
def test_channels_of_other_writers_are_read(
    tmp_path: Path, msgtype: str, schema: tuple[str, bytes], topic: str, name: str
) -> None:
    path = channel(tmp_path / "drive.mcap", msgtype, schema, "cdr", topic)
    with BagSource([path], load()) as source:
        assert source.roles.lidars == (name,)
        assert len(list(source)) == 5
        assert not source.recording.warnings


@pytest.mark.parametrize(
    ("msgtype", "schema", "encoding", "what"),
    [
        ("", None, "cdr", "/points: its channel has no schema"),
        (
            "foxglove.PointCloud",
            ("flatbuffer", b"bfbs"),
            "flatbuffer",
            "flatbuffer, .*; write protobuf, JSON or CDR",
        ),
        (
            "sensor_msgs/msg/PointCloud2",
            ("jsonschema", b"{}"),
            "json",
            "/points: encoded as json, .*; write CDR",
        ),
        (
            "sensor_msgs/msg/PointCloud2",
            ("ros2msg", b""),
            "cbor",
            "/points: encoded as cbor, which is not read",
        ),
    ],
)
def test_an_encoding_that_is_not_read_is_named(
    tmp_path: Path, msgtype: str, schema: tuple[str, bytes] | None, encoding: str, what: str
) -> None:
    path = channel(tmp_path / "drive.mcap", msgtype, schema, encoding, "/points")
    with pytest.raises(UserError, match=what):
        BagSource([path], load())


@pytest.mark.parametrize(
    "change",
    [
        "UPDATE message_definitions SET encoding = 'unknown', encoded_message_definition = ''",
        "UPDATE topics SET offered_qos_profiles = '- history: 1'",
        "ALTER TABLE topics DROP COLUMN type_description_hash",
        "DROP TABLE message_definitions",
    ],
)
def test_tables_of_other_recorders_are_no_damage(tmp_path: Path, change: str) -> None:
    """A recorder that lacks a definition writes ``unknown``; older ones lack columns and tables."""
    folder = bags.write(tmp_path / "drive", bags.small_items(scans=3), form="sqlite3")
    with closing(sqlite3.connect(folder / "drive.db3")) as database:
        database.execute(change)
        database.commit()
    folder = folder.rename(tmp_path / "drive #1?")  # These characters have a meaning in a URI.
    with BagSource([folder], load()) as source:
        assert [frame.points[0, 0] for frame in source] == [0, 1, 2]
        assert not source.warnings


def test_transforms_without_a_stamp_hold_when_received(tmp_path: Path) -> None:
    items = bags.small_items(scans=6)
    for item in items:
        if item.topic == "/tf":
            item.message.transforms[0].header.stamp.sec = 0
            item.message.transforms[0].header.stamp.nanosec = 0
        if item.topic == bags.INFO:
            item.message.header.stamp.sec = item.message.header.stamp.nanosec = 0
    with BagSource([bags.write(tmp_path / "drive", items)], load()) as source:
        assert [frame.pose[0, 3] for frame in source] == pytest.approx(range(6))
        said = [f"{name}: no stamp in the header 6 times" for name in ("/tf", bags.INFO)]
        assert sorted(warning.partition(", ")[0] for warning in source.warnings) == sorted(said)


def test_definitions_with_the_line_ends_of_windows_are_read(tmp_path: Path) -> None:
    text, _ = bags.Messages().store.generate_msgdef("sensor_msgs/msg/PointCloud2", ros_version=2)
    schema = "ros2msg", text.replace("\n", "\r\n").encode()
    path = channel(tmp_path / "drive.mcap", "sensor_msgs/msg/PointCloud2", schema, "cdr", "/points")
    with BagSource([path], load()) as source:
        assert len(list(source)) == 5
        assert not source.recording.warnings


# --- frames and transforms ---------------------------------------------------------------------

FORWARD = geometry.transform(np.zeros(3), np.array([0.0, 0, 0, 1]))
OPTICAL = geometry.transform(np.array([0.1, 0, -0.2]), np.array([-0.5, 0.5, -0.5, 0.5]))
TURN = geometry.transform(np.zeros(3), np.array([0, 0, np.sin(np.radians(4)), np.cos(np.radians(4))]))
TF = "tf2_msgs/msg/TFMessage"


def pose_of(frame: Frame) -> F64:
    """Return the transform into the first camera."""
    pose = frame.cameras[0].camera_from_points
    assert pose is not None
    return pose


def read(path: Path, *settings: str) -> tuple[Frame, Sequence[str]]:
    """Return the last frame of a bag, and the doubts about the bag."""
    with BagSource([path], load(settings=list(settings))) as source:
        frames = list(source)
        assert source.frame(len(frames) - 1) is not None
        return frames[-1], source.doubts


def test_a_later_part_of_a_bag_names_the_first(tmp_path: Path) -> None:
    items = bags.small_items(scans=4)
    parts = ([i for i in items if i.topic == "/tf_static"], [i for i in items if i.topic != "/tf_static"])
    folders = [bags.write(tmp_path / f"part{number}", part) for number, part in enumerate(parts)]
    first, later = (
        next(folder.glob("*.mcap")).rename(tmp_path / f"drive_{number}.mcap")
        for number, folder in enumerate(folders)
    )
    with BagSource([later], load()) as source:
        assert any("begins with drive_0.mcap: give both, or their folder" in said for said in source.warnings)
    with BagSource([first, later], load()) as source:
        assert not any("drive_0.mcap" in said for said in source.warnings)


def again(topic: str, pose: F64, count: int = 1) -> list[bags.Item]:
    """Return the mounting of the camera, stated again with another pose."""
    times = [bags.START + 1 + i * bags.PERIOD // 2 for i in range(count)]
    messages = bags.Messages()
    edge = (bags.LIDAR_FRAME, bags.CAMERA_FRAME, pose)
    return [bags.Item(topic, TF, time, messages.transforms(time, edge)) for time in times]


@pytest.mark.parametrize(("topic", "count"), [("/tf_static", 1), ("/tf", 20)])
def test_a_transform_that_is_stated_twice_is_said(tmp_path: Path, topic: str, count: int) -> None:
    items = [*bags.small_items(scans=5), *again(topic, TURN @ OPTICAL, count)]
    bag = bags.write(tmp_path / "drive", items)
    frame, (doubt,) = read(bag)
    where = "twice on /tf_static" if topic == "/tf_static" else "on /tf_static and on /tf"
    what = f"'{bags.LIDAR_FRAME}' -> '{bags.CAMERA_FRAME}' is stated {where}, 8.0 degrees and 0.01"
    assert what in doubt and "the newer one is used" in doubt
    np.testing.assert_allclose(pose_of(frame), geometry.inverse(TURN @ OPTICAL), atol=1e-6)
    (setting,) = re.findall(r"--set (source.extrinsics)='(.*)'", doubt)
    frame, doubts = read(bag, "=".join(setting))
    np.testing.assert_allclose(pose_of(frame), geometry.inverse(OPTICAL), atol=1e-5)
    assert not doubts


@pytest.mark.parametrize("topic", ["/tf_static", "/tf"])
def test_a_transform_that_is_stated_twice_alike_is_not_said(tmp_path: Path, topic: str) -> None:
    rounded = OPTICAL + np.pad(np.full((3, 1), 1e-5), ((0, 1), (3, 0)))
    items = [*bags.small_items(scans=5), *again(topic, OPTICAL, 3), *again(topic, rounded, 5)]
    assert read(bags.write(tmp_path / "drive", items))[1] == []


def framed(image: str, info: str, *edges: tuple[str, str, F64]) -> list[bags.Item]:
    """Return a drive whose images and CameraInfo state these frames."""
    messages = bags.Messages()
    items = bags.small_items(messages, scans=3)
    for item in items:
        if item.topic in (bags.IMAGE, bags.INFO):
            item.message.header.frame_id = image if item.topic == bags.IMAGE else info
    items = [item for item in items if item.topic != "/tf_static"]
    return [bags.Item("/tf_static", TF, bags.START, messages.transforms(bags.START, *edges)), *items]


LINK = ("velodyne", "camera_link", FORWARD)
BELOW_LINK = ("camera_link", "camera_optical", OPTICAL)
MOUNTED = ("velodyne", "camera_optical", OPTICAL)


@pytest.mark.parametrize(
    ("image", "info", "edges", "said"),
    [
        ("camera_optical", "camera_optical", (LINK, BELOW_LINK), ""),
        ("/camera_optical", "camera_optical", (MOUNTED,), ""),
        (
            "camera_link",
            "camera_optical",
            (LINK, BELOW_LINK),
            "'camera_link', and .* states 'camera_optical'",
        ),
        (
            "camera_optical",
            "camera_link",
            (LINK, BELOW_LINK),
            "'camera_optical', and .* states 'camera_link'",
        ),
        ("rgb", "camera_optical", (MOUNTED,), "the frame 'rgb', which no transform has: 'camera_optical' of"),
        ("", "camera_optical", (MOUNTED,), "state no frame: 'camera_optical' of"),
    ],
)
def test_the_optical_frame_is_that_of_image_or_camera_info(
    tmp_path: Path, image: str, info: str, edges: tuple[tuple[str, str, F64], ...], said: str
) -> None:
    bag = bags.write(tmp_path / "drive", framed(image, info, *edges))
    frame, doubts = read(bag)
    np.testing.assert_allclose(pose_of(frame), geometry.inverse(OPTICAL), atol=1e-9)
    assert frame.cameras[0].image is not None and frame.cameras[0].image.frame_id.endswith("optical")
    assert bool(doubts) == bool(said) and all(re.search(said, doubt) for doubt in doubts)
    for setting in re.findall(r"--set source.frames='(.*)'", " ".join(doubts)):
        other, doubts = read(bag, f"source.frames={setting}")
        assert not doubts
        np.testing.assert_allclose(pose_of(other), geometry.inverse(FORWARD), atol=1e-9)


def test_a_frame_can_be_stated_for_a_recorded_bag(tmp_path: Path) -> None:
    items = framed("", "", MOUNTED)
    for item in items:
        if item.topic == bags.CLOUD:
            item.message.header.frame_id = ""
    bag = bags.write(tmp_path / "drive", items)
    frame, _ = read(bag, f"source.frames={{{bags.IMAGE}: camera_optical, {bags.CLOUD}: velodyne}}")
    np.testing.assert_allclose(pose_of(frame), geometry.inverse(OPTICAL), atol=1e-9)


# --- calibrations and robots -------------------------------------------------------------------


def with_info(**values: object) -> list[bags.Item]:
    """Return a drive whose CameraInfo has these values. Its images have the centre (32, 24)."""
    items = bags.small_items(scans=3)
    for item in items:
        if item.topic == bags.INFO:
            for name, value in values.items():
                setattr(item.message, name, value)
    return items


def roi(x: int, y: int, width: int, height: int) -> object:
    return bags.Messages().make(
        "sensor_msgs/msg/RegionOfInterest",
        x_offset=x,
        y_offset=y,
        height=height,
        width=width,
        do_rectify=False,
    )


def camera_matrix(f: float, x: float, y: float, other: float = 0.0) -> F64:
    return np.array([f, 0, x, 0, other or f, y, 0, 0, 1.0])


@pytest.mark.parametrize(
    ("values", "focal", "centre", "doubt"),
    [
        (
            {"width": 128, "height": 96, "binning_x": 2, "binning_y": 2},
            60,
            (32, 24),
            "by binning 2 x 2 .* is that of the images",
        ),
        (
            {"width": 128, "height": 96, "binning_x": 2, "binning_y": 2, "k": camera_matrix(120, 64, 48)},
            60,
            (32, 24),
            "",
        ),
        ({"k": camera_matrix(120, 64, 48)}, 120, (64, 48), r"the principal point \(64, 48\) is far from"),
        ({"k": camera_matrix(120, 64, 48), "width": 0, "height": 0}, 120, (64, 48), "far from the middle"),
        (
            {"width": 128, "height": 96, "k": camera_matrix(120, 90, 20), "roi": roi(64, 0, 64, 48)},
            120,
            (26, 20),
            "",
        ),
        (
            {"width": 128, "height": 96, "roi": roi(30, 20, 64, 48)},
            60,
            (32, 24),
            "by its region of interest .* is that of the images",
        ),
        ({"roi": roi(30, 20, 64, 48)}, 60, (32, 24), "by its region of interest .* is that of the images"),
        ({"k": camera_matrix(60, 32, 24, 120)}, 60, (32, 24), "no square pixels"),
        ({"k": camera_matrix(5, 32, 24)}, 5, (32, 24), "a field of view of 162 degrees"),
        (
            {"k": camera_matrix(5, 32, 24), "distortion_model": "equidistant", "d": np.zeros(4)},
            5,
            (32, 24),
            "",
        ),
        (
            {"k": camera_matrix(22, 32, 24), "d": np.array([-0.006, 0.04, -0.04, 0.006])},  # RealSense T265
            22,
            (32, 24),
            "its coefficients of plumb_bob are of a lens 13 % off .*must be equidistant",
        ),
        (
            {"k": camera_matrix(18, 32, 24), "d": np.array([-0.03, -0.01, 0.003, -0.001])},
            18,
            (32, 24),
            "plumb_bob fold: they reach the columns 6 to 58 only of images of 64 x 48",
        ),
        (  # a webcam of 72 degrees
            {"k": camera_matrix(44, 32, 24), "d": np.array([-0.361976, 0.110510, 0.001014, 0.000505, 0])},
            44,
            (32, 24),
            "",
        ),
    ],
)
def test_the_camera_matrix_is_checked_against_the_image(
    tmp_path: Path, values: dict[str, object], focal: float, centre: tuple[float, float], doubt: str
) -> None:
    frame, doubts = read(bags.write(tmp_path / "drive", with_info(**values)), "source.rectified=no")
    intrinsics = frame.cameras[0].intrinsics
    assert intrinsics is not None
    assert (intrinsics.K[0, 0], *intrinsics.K[:2, 2]) == (focal, *centre)
    assert len(doubts) == bool(doubt) and all(re.search(doubt, text) for text in doubts)


def of_robot(name: str, *, frames: bool, own_tf: bool) -> list[bags.Item]:
    """Return a drive with the topics, and perhaps the frames and transforms, of one of several robots."""
    items = bags.small_items(scans=3)
    for item in items:
        edges = item.message.transforms if item.type == TF else [item.message]
        for message in edges if frames else ():
            message.header.frame_id = f"{name}/{message.header.frame_id}"
            if item.type == TF:
                message.child_frame_id = f"{name}/{message.child_frame_id}"
    return [i._replace(topic=f"/{name}{i.topic}") if own_tf or i.type != TF else i for i in items]


@pytest.mark.parametrize(("frames", "own_tf"), [(True, False), (False, True), (True, True)])
def test_one_of_two_robots_is_shown_and_the_other_is_offered(
    tmp_path: Path, frames: bool, own_tf: bool
) -> None:
    items = [item for name in ("a", "b") for item in of_robot(name, frames=frames, own_tf=own_tf)]
    bag = bags.write(tmp_path / "drive", items)
    with BagSource([bag], load()) as source:
        assert source.roles.lidars == (f"/a{bags.CLOUD}",)
        assert [camera.topic for camera in source.roles.cameras] == [f"/a{bags.IMAGE}"]
        assert all(not frame.problems and not frame.cameras[0].problems for frame in source)
        (said,) = source.doubts
        assert said in source.warnings
    assert said.startswith("the topics are of 2 robots, a and b: a is shown; ")
    (setting,) = re.findall(r"--set (\S+) shows b", said)
    with BagSource([bag], load(settings=[setting])) as source:
        assert source.roles.lidars == (f"/b{bags.CLOUD}",)
        assert [camera.topic for camera in source.roles.cameras] == [f"/b{bags.IMAGE}"]
        assert all(not frame.problems and not frame.cameras[0].problems for frame in source)
        assert not source.doubts


def test_a_robot_may_be_without_a_namespace(tmp_path: Path) -> None:
    """Their frames have the same names, and the other one is 5 m beside."""
    other = of_robot("b", frames=False, own_tf=True)
    for item in other:
        if item.topic == "/b/tf":
            item.message.transforms[0].transform.translation.y = 5.0
    bag = bags.write(tmp_path / "drive", [*bags.small_items(scans=3), *other])
    for settings, name, y in (([], "", 0), ([f"source.lidar_topics=[/b{bags.CLOUD}]"], "/b", 5)):
        with BagSource([bag], load(settings=settings)) as source:
            assert source.roles.lidars == (f"{name}{bags.CLOUD}",)
            assert [camera.topic for camera in source.roles.cameras] == [f"{name}{bags.IMAGE}"]
            assert [frame.pose[:2, 3].tolist() for frame in source] == [[x, y] for x in range(3)]
            said = "the topics are of 2 robots, / and b: / is shown; --set source.lidar_topics="
            assert any(text.startswith(said) for text in source.doubts) != bool(settings)


def test_two_sensor_heads_of_one_robot_are_no_robots(tmp_path: Path) -> None:
    items = [item for name in ("front", "rear") for item in of_robot(name, frames=False, own_tf=False)]
    for item in items:
        if item.topic.startswith("/rear") and item.type != TF:
            item.message.header.frame_id = f"rear_{item.message.header.frame_id}"
    with BagSource([bags.write(tmp_path / "drive", items)], load()) as source:
        assert len(source.roles.lidars) == len(source.roles.cameras) == 2
        assert not source.roles.robots


# --- log times ---------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("early", [0, 2, 5])
@pytest.mark.parametrize("clock", ["zero", "wall", "start"])
def test_a_jump_of_the_log_clock_is_said_and_set_right(tmp_path: Path, clock: str, early: int) -> None:
    """The simulation begins at 100 s. The first scans are logged by another clock."""
    limit = bags.START + early * bags.PERIOD

    def logged(received: int) -> int:
        simulated = received - bags.START + 100 * SECOND
        if received >= limit:
            return simulated
        return {"zero": 0, "wall": received, "start": received - bags.START}[clock]

    items = bags.small_items(scans=20)
    bag = bags.write(tmp_path / "drive", [i._replace(received=logged(i.received)) for i in items])
    run = assert_as_in_the_run([bag])
    assert [(frame.stamp - bags.START) // bags.PERIOD for frame in run] == list(range(20))
    assert all(frame.cameras[0].image is not None for frame in run)
    with BagSource([bag], load()) as source:
        jumps = [text for text in source.warnings if "the log time jumps by" in text]
        assert len(jumps) == bool(early)
        assert source.recording.end - source.recording.start < 3 * SECOND
        frame = source.frame(source.number_at("1.0"))
        assert frame is not None and frame.points[0, 0] in (9, 10)


@pytest.mark.parametrize("pause", [60, 10 * 86_400])
def test_a_pause_of_the_recording_is_no_jump_of_its_clock(tmp_path: Path, pause: int) -> None:
    late = bags.START + 10 * bags.PERIOD
    items = bags.small_items(scans=20)
    for item in items:
        if item.received >= late and item.type != TF:
            item.message.header.stamp.sec += pause
    items = [i._replace(received=i.received + (i.received >= late) * pause * SECOND) for i in items]
    with BagSource([bags.write(tmp_path / "drive", items)], load()) as source:
        assert len(list(source)) == 20
        assert source.recording.end - source.recording.start > pause * SECOND
        assert not [text for text in source.warnings if "log time" in text]
