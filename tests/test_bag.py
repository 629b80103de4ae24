"""Bags of every format, whole and damaged, as a source of frames."""

from __future__ import annotations

import os
import shutil
import tracemalloc
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from bevviz.bags.bag import Recording
from bevviz.bags.mcap_writer import McapWriter
from bevviz.bags.reader import FileBytes
from bevviz.bags.source import BagSource, iso, parse_time
from bevviz.config import Config, load
from bevviz.errors import UserError
from bevviz.model import geometry
from bevviz.model.frame import Frame
from tests.support import bags

FORMATS = [
    ("mcap", ""),
    ("mcap", "storage"),
    ("mcap", "file"),
    ("mcap", "message"),
    ("sqlite3", ""),
    ("sqlite3", "file"),
    ("sqlite3", "message"),
    ("ros1", ""),
    ("ros1", "bz2"),
    ("ros1", "lz4"),
]
CLOUD = "sensor_msgs/msg/PointCloud2"


def make(folder: Path, form: str = "mcap", compression: str = "", name: str = "", **options: Any) -> Path:
    """Write a small drive; ``options`` are those of ``bags.small_items``."""
    messages = bags.Messages(form == "ros1")
    name = name or f"drive_{form}_{compression or 'plain'}"
    path = folder / (f"{name}.bag" if form == "ros1" else name)
    return bags.write(
        path, bags.small_items(messages, **options), messages, form=form, compression=compression
    )


def storage_file(bag: Path) -> Path:
    """Return the one file of a bag that holds its messages."""
    return bag if bag.is_file() else next(f for f in bag.iterdir() if f.name != "metadata.yaml")


def frames_of(*paths: Path, config: Config | None = None, **options: Any) -> list[Frame]:
    with BagSource(paths, config or Config(), **options) as source:
        return list(source)


def scans(frames: Sequence[Frame]) -> list[int]:
    """Return the scan number of each frame: the x of its first point."""
    return [int(frame.points[0, 0]) for frame in frames]


def content(*paths: Path) -> list[tuple[str, int, bytes]]:
    with Recording(paths) as recording:
        names = [topic.name for topic in recording.topics]
        return [(m.topic, m.received, bytes(m.content())) for m in recording.messages(names)]


def is_part(found: Sequence[Any], whole: Sequence[Any]) -> bool:
    """Whether ``found`` is ``whole`` with some of its items left out."""
    rest = iter(whole)
    return all(item in rest for item in found)


# --- formats -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("form", "compression"), FORMATS)
def test_every_format_gives_the_same_frames(tmp_path: Path, form: str, compression: str) -> None:
    path = make(tmp_path, form, compression)
    with BagSource([path], Config()) as source:
        assert source.total == 30
        frames = list(source)
        assert not source.warnings
    assert scans(frames) == [f.index for f in frames] == list(range(30))
    assert [f.stamp for f in frames] == [bags.START + i * bags.PERIOD for i in range(30)]
    assert [f.received - f.stamp for f in frames] == [bags.PERIOD // 10] * 30
    assert source.scene.lidars == ("velodyne",)
    assert source.scene.cameras == ("camera",)
    for frame in frames:
        (camera,) = frame.cameras
        assert not camera.problems
        assert camera.image is not None
        assert camera.image.bgr.shape == (48, 64, 3)
        assert frame.world_frame == "odom"
        assert frame.world_from_points is not None
        assert frame.world_from_points[0, 3] == pytest.approx(scans([frame])[0])


@pytest.mark.parametrize(("form", "compression"), FORMATS)
def test_messages_come_back_as_written(tmp_path: Path, form: str, compression: str) -> None:
    messages = bags.Messages(form == "ros1")
    items = bags.small_items(messages, scans=5)
    serialize = messages.store.serialize_ros1 if messages.ros1 else messages.store.serialize_cdr
    path = bags.write(tmp_path / "drive.bag", items, messages, form=form, compression=compression)
    written = [(i.topic, i.received, bytes(serialize(i.message, i.type))) for i in items]
    assert sorted(content(path)) == sorted(written)


@pytest.mark.parametrize("form", ["mcap", "sqlite3"])
def test_files_and_folders_without_metadata_are_read(tmp_path: Path, form: str) -> None:
    bag = make(tmp_path, form)
    assert len(frames_of(storage_file(bag))) == 30
    (bag / "metadata.yaml").unlink()
    with BagSource([bag], Config()) as source:
        assert len(list(source)) == 30
        assert any("metadata.yaml is missing" in w for w in source.warnings)


def test_the_file_type_is_recognized_by_its_content(tmp_path: Path) -> None:
    lone = tmp_path / "recording"
    storage_file(make(tmp_path)).rename(lone)
    assert len(frames_of(lone)) == 30


def test_metadata_that_is_no_yaml_is_told(tmp_path: Path) -> None:
    bag = make(tmp_path)
    (bag / "metadata.yaml").write_text("rosbag2: [")
    with BagSource([bag], Config()) as source:
        assert source.total == 30
        assert any("not readable as metadata.yaml" in w for w in source.warnings)


def test_several_bags_are_one_recording_in_order_of_time(tmp_path: Path) -> None:
    items = bags.small_items()
    cut = bags.START + 15 * bags.PERIOD
    first = bags.write(tmp_path / "b", [i for i in items if i.received < cut])
    second = bags.write(tmp_path / "a", [i for i in items if i.received >= cut], form="sqlite3")
    for paths in ([first, second], [second, first]):
        assert scans(frames_of(*paths)) == list(range(30))


def test_a_folder_of_split_files_is_one_recording(tmp_path: Path) -> None:
    items = bags.small_items()
    bag = tmp_path / "split"
    bag.mkdir()
    for part in range(3):
        chosen = [i for i in items if (i.received - bags.START) // (10 * bags.PERIOD) == part]
        piece = bags.write(tmp_path / f"part_{2 - part}", chosen)
        storage_file(piece).rename(bag / f"part_{2 - part}.mcap")
    assert scans(frames_of(bag)) == list(range(30))


@dataclass(frozen=True)
class DefinedMessages:
    """Messages of one topic for ``write_defined``."""

    msgtype: str
    text: str
    values: Sequence[dict[str, object]]


STRING = DefinedMessages("std_msgs/msg/String", "string data", [{"data": f"text {i}"} for i in range(3)])
NUMBER = DefinedMessages("std_msgs/msg/UInt32", "uint32 data", [{"data": i} for i in range(4)])
OLD = DefinedMessages("robot/msg/Reading", "int32 code", [{"code": 7}] * 2)
NEW = DefinedMessages("robot/msg/Reading", "float64 level\nint32 code", [{"level": 0.5, "code": 8}] * 2)


def write_defined(path: Path, form: str, *messages: DefinedMessages, start: int = 0) -> Path:
    """Write messages of /a one after the other, each sort on a connection of its own."""
    writer: Any = (
        Writer1(path)
        if form == "ros1"
        else Writer(path, version=9, storage_plugin=StoragePlugin[form.upper()])
    )
    with writer:
        time = start
        for sort in messages:
            store = get_typestore(Stores.EMPTY)
            store.register(get_types_from_msg(sort.text, sort.msgtype))
            serialize = store.serialize_ros1 if form == "ros1" else store.serialize_cdr
            if form == "ros1":
                text, digest = store.generate_msgdef(sort.msgtype)
                connection = writer.add_connection("/a", sort.msgtype, msgdef=text, md5sum=digest)
            else:
                connection = writer.add_connection("/a", sort.msgtype, typestore=store)
            for values in sort.values:
                time += 1
                message: Any = store.types[sort.msgtype]
                writer.write(connection, time, serialize(message(**values), sort.msgtype))
    return path


@pytest.mark.parametrize(
    ("form", "files"),  # A database names a topic once.
    [("mcap", 1), ("mcap", 2), ("sqlite3", 2), ("ros1", 1), ("ros1", 2)],
)
def test_a_topic_of_two_types_has_the_messages_of_the_first(tmp_path: Path, form: str, files: int) -> None:
    if files == 1:
        paths = [write_defined(tmp_path / "0.bag", form, STRING, NUMBER)]
    else:
        paths = [write_defined(tmp_path / "0.bag", form, STRING)]
        paths.append(write_defined(tmp_path / "1.bag", form, NUMBER, start=100))
    with Recording(paths) as recording:
        (topic,) = recording.topics
        texts = [recording.decode(message).data for message in recording.messages(["/a"])]
        assert texts == ["text 0", "text 1", "text 2"]
        assert topic.type == "std_msgs/msg/String"
        assert topic.count == len(recording.times("/a")) == recording.message_count == 3
        assert recording.warnings[-1] == (
            "/a is recorded both as std_msgs/msg/String and as std_msgs/msg/UInt32: only the former is used"
        )


@pytest.mark.parametrize("form", ["mcap", "sqlite3", "ros1"])
def test_each_message_is_decoded_by_its_own_definition(tmp_path: Path, form: str) -> None:
    paths = [write_defined(tmp_path / "0.bag", form, OLD)]
    paths.append(write_defined(tmp_path / "1.bag", form, NEW, start=100))
    with Recording(paths) as recording:
        decoded = [recording.decode(message) for message in recording.messages(["/a"])]
        assert [message.code for message in decoded] == [7, 7, 8, 8]
        assert [getattr(message, "level", None) for message in decoded] == [None, None, 0.5, 0.5]
        assert recording.topics[0].count == len(recording.times("/a")) == 4


def test_ros1_and_ros2_messages_of_a_topic_keep_their_encoding(tmp_path: Path) -> None:
    paths = [write_defined(tmp_path / "0.bag", "ros1", STRING)]
    paths.append(write_defined(tmp_path / "1", "mcap", STRING, start=100))
    with Recording(paths) as recording:
        with McapWriter(tmp_path / "cut.mcap", recording.types.definition) as bag:
            for message in recording.messages(["/a"]):
                bag.write(message.connection, message.received, message.data)
        with Recording([tmp_path / "cut.mcap"]) as cut:
            assert [cut.decode(message).data for message in cut.messages(["/a"])] == [
                *("text 0", "text 1", "text 2"),
                *("text 0", "text 1", "text 2"),
            ]


def test_messages_outside_chunks_may_be_out_of_order(tmp_path: Path) -> None:
    """As rosbag2's 'fastwrite' profile writes them, by several threads."""
    whole = make(tmp_path, scans=8)
    data = storage_file(whole).read_bytes()
    head = 8 + 9 + int.from_bytes(data[9:17], "little")
    start = head + 9 + 32 + 8  # the rosbags writer does not compress: the chunk's name is empty
    size = int.from_bytes(data[start - 8 : start], "little")
    records, offset = [], start
    while offset < start + size:
        end = offset + 9 + int.from_bytes(data[offset + 1 : offset + 9], "little")
        records.append(data[offset:end])
        offset = end
    others = [r for r in records if r[0] != 5]
    messages = [r for r in records if r[0] == 5]
    flat = tmp_path / "flat.mcap"
    flat.write_bytes(
        data[:head] + b"".join(others + messages[::-1]) + b"\x0f" + (4).to_bytes(8, "little") + bytes(4)
    )
    found = content(flat)
    assert sorted(found) == sorted(content(whole))
    assert [time for _, time, _ in found] == sorted(time for _, time, _ in found)
    assert scans(frames_of(flat)) == list(range(8))


# --- parts -------------------------------------------------------------------------------------


def test_start_and_end_limit_the_frames(tmp_path: Path) -> None:
    bag = make(tmp_path)
    assert scans(frames_of(bag, start="1.0", end="1.5")) == [10, 11, 12, 13, 14]
    stamp = bags.START / 1e9
    assert scans(frames_of(bag, start=f"{stamp + 2.5}")) == [25, 26, 27, 28, 29]
    assert scans(frames_of(bag, end="2023-11-14T22:13:20.300")) == [0, 1, 2]
    assert scans(frames_of(bag, start="2023-11-14T23:13:22.75+01:00")) == [28, 29]


@pytest.mark.parametrize("form", ["mcap", "sqlite3", "ros1"])
def test_latched_messages_before_start_still_hold(tmp_path: Path, form: str) -> None:
    messages = bags.Messages(form == "ros1")
    items = bags.small_items(messages)
    once = [i for i in items if i.topic == bags.INFO][:1]
    items = [i for i in items if i.topic != bags.INFO] + once
    path = bags.write(tmp_path / "drive.bag", items, messages, form=form)
    (frame,) = frames_of(path, start="2.5", frames=(0, 1))
    (camera,) = frame.cameras
    assert scans([frame]) == [25]
    assert not camera.problems
    assert camera.intrinsics is not None and camera.intrinsics.width == 64
    assert camera.camera_from_points is not None
    assert frame.world_from_points is not None


def test_every_and_frames_select_frames(tmp_path: Path) -> None:
    bag = make(tmp_path)
    assert scans(frames_of(bag, every=10)) == [0, 10, 20]
    assert scans(frames_of(bag, frames=(3, 6))) == [3, 4, 5]
    assert scans(frames_of(bag, frames=(5, 20), every=7)) == [5, 12, 19]
    assert scans(frames_of(bag, frames=(-2, None))) == [28, 29]
    late = frames_of(bag, start="1.0", frames=(2, 4))
    assert scans(late) == [12, 13]
    assert [f.index for f in late] == [2, 3]
    with BagSource([bag], Config(), every=4, frames=(1, 22)) as source:
        assert source.total == len(list(source)) == 6


def test_the_scan_nearest_to_a_time_is_returned(tmp_path: Path) -> None:
    bag = make(tmp_path)
    for time, number in (("0", 0), ("1.04", 10), ("1.07", 11), ("2.9", 29)):
        (frame,) = frames_of(bag, at=time)
        assert scans([frame]) == [number] == [frame.index]
        assert frame.world_from_points is not None
    with pytest.raises(UserError, match="outside the recording"):
        frames_of(bag, at="77")


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    every=st.integers(1, 8),
    first=st.none() | st.integers(-12, 12),
    last=st.none() | st.integers(-12, 12),
)
def test_frame_ranges_work_like_python_slices(
    tmp_path_factory: pytest.TempPathFactory, every: int, first: int | None, last: int | None
) -> None:
    bag = tmp_path_factory.getbasetemp() / "sliced"
    if not bag.exists():
        bags.write(bag, bags.small_items(scans=10, points=20))
    expected = list(range(10))[first:last][::every]
    if not expected:
        with pytest.raises(UserError, match="none of them is among --frames"):
            frames_of(bag, every=every, frames=(first, last))
        return
    assert scans(frames_of(bag, every=every, frames=(first, last))) == expected


def test_skipped_messages_are_not_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    decoded: list[str] = []
    original = Recording.decode

    def counting(self: Recording, message: Any) -> Any:
        decoded.append(message.topic)
        return original(self, message)

    monkeypatch.setattr(Recording, "decode", counting)
    frames_of(make(tmp_path), every=10)
    assert decoded.count(bags.CLOUD) == 3
    assert decoded.count(bags.IMAGE) == 3


@pytest.mark.parametrize("text", ["soon", "-1", "nan", "2026-13-01"])
def test_an_invalid_time_is_refused(text: str) -> None:
    with pytest.raises(UserError, match="is no time"):
        parse_time(text, 0)


def test_times_are_read_and_printed() -> None:
    assert parse_time("12.5", 10**9) == 13_500_000_000
    assert parse_time("1700000000.5", 5) == 1_700_000_000_500_000_000
    assert parse_time("2023-11-14T22:13:20Z", 5) == 1_700_000_000_000_000_000
    assert iso(1_700_000_000_250_000_000) == "2023-11-14T22:13:20.250Z"


def test_a_part_outside_the_recording_is_told(tmp_path: Path) -> None:
    bag = make(tmp_path)
    with pytest.raises(UserError, match=r"outside the recording, which has 2\.9 s"):
        frames_of(bag, start="100")
    with pytest.raises(UserError, match="no scan in the time asked for"):
        frames_of(bag, start="2", end="1")


# --- damage ------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(
    ("form", "compression"),
    [("mcap", ""), ("mcap", "storage"), ("sqlite3", ""), ("ros1", ""), ("ros1", "lz4")],
)
@pytest.mark.parametrize("share", [0.999, 0.83, 0.5, 0.37])
def test_a_cut_bag_gives_all_before_the_cut(
    tmp_path: Path, form: str, compression: str, share: float
) -> None:
    path = storage_file(make(tmp_path, form, compression, scans=60, points=1000))
    whole = content(path)
    data = path.read_bytes()
    cut = path.with_name(f"cut_{path.name}")
    cut.write_bytes(data[: int(share * len(data))])
    with BagSource([cut], Config()) as source:
        frames = list(source)
        found = source.recording.message_count
        warnings = source.warnings
    assert is_part(content(cut), whole)
    # Of what is not compressed only the message that is cut may be missing.
    before = sum(data.find(m[2]) + len(m[2]) <= int(share * len(data)) for m in whole)
    if not compression and form != "sqlite3":
        assert content(cut) == whole[:before]
    assert found >= int(share * len(whole)) - 12
    assert scans(frames) == list(range(len(frames)))
    if found < len(whole):
        assert any(f"read {found} messages" in w for w in warnings)


@pytest.mark.long
@settings(max_examples=20, deadline=None)
@given(share=st.floats(0, 1, exclude_max=True))
@example(share=0.9546)  # in the index behind the only chunk of the MCAP: all its messages were lost
@example(share=0.957)
@example(share=0.9594)
@pytest.mark.parametrize("form", ["mcap", "sqlite3", "ros1"])
def test_a_cut_at_any_byte_never_gives_wrong_messages(
    tmp_path_factory: pytest.TempPathFactory, form: str, share: float
) -> None:
    folder = tmp_path_factory.getbasetemp()
    bag = folder / (f"any_{form}.bag" if form == "ros1" else f"any_{form}")
    if not bag.exists():
        make(folder, form, name=f"any_{form}", scans=12, points=50)
    path = storage_file(bag)
    whole = content(path)
    size = path.stat().st_size
    cut = folder / f"any_cut_{form}"
    cut.write_bytes(path.read_bytes()[: int(share * size)])
    try:
        found = content(cut)
    except UserError:
        assert cut.stat().st_size < 0.35 * size
        return
    assert is_part(found, whole)
    if form != "sqlite3":  # there a long message may lie behind a later short one
        assert found == whole[: len(found)]


def test_a_cut_compressed_file_yields_what_precedes_the_cut(tmp_path: Path) -> None:
    bag = make(tmp_path, "mcap", "file", scans=60)
    file = storage_file(bag)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with BagSource([bag], Config()) as source:
        frames = list(source)
        assert 20 <= len(frames) < 60
        assert any("compressed file is damaged" in w for w in source.warnings)
        assert any("are lost" in w and "metadata.yaml counts 241 messages" in w for w in source.warnings)


@pytest.mark.long
@pytest.mark.parametrize(
    ("form", "compression", "magic"),
    [
        ("mcap", "storage", b"\x28\xb5\x2f\xfd"),
        ("ros1", "lz4", b"\x04\x22\x4d\x18"),
        ("ros1", "bz2", b"BZh9"),
    ],
)
def test_a_damaged_chunk_costs_its_own_messages(
    tmp_path: Path, form: str, compression: str, magic: bytes
) -> None:
    path = storage_file(make(tmp_path, form, compression, scans=200, points=2000))
    whole = content(path)
    data = bytearray(path.read_bytes())
    middle = data.index(magic, len(data) // 2)
    data[middle : middle + 8] = bytes(8)
    path.write_bytes(data)
    with Recording([path]) as recording:
        found = [
            (m.topic, m.received, bytes(m.content())) for m in recording.messages({t for t, *_ in whole})
        ]
        assert any("damaged chunk(s)" in w and "messages lost" in w for w in recording.warnings)
    assert set(found) <= set(whole)
    assert len(whole) / 2 < len(found) < len(whole)


def test_a_damaged_message_is_counted_and_the_others_go_on(tmp_path: Path) -> None:
    items = bags.small_items()
    clouds = [i for i, item in enumerate(items) if item.topic == bags.CLOUD]
    for i in clouds[10:12]:
        items[i] = items[i]._replace(message=b"\0\1\0\0" + bytes(40))
    with BagSource([bags.write(tmp_path / "drive", items)], Config()) as source:
        assert scans(list(source)) == [*range(10), *range(12, 30)]
        assert any(f"2 message(s) of {bags.CLOUD} could not be used" in w for w in source.warnings)


def test_a_damaged_page_costs_its_own_messages(tmp_path: Path) -> None:
    path = storage_file(make(tmp_path, "sqlite3", scans=60))
    whole = content(path)
    data = bytearray(path.read_bytes())
    leaves = [at for at in range(0, len(data), 4096) if data[at] == 0x0D]
    data[leaves[len(leaves) // 2]] = 0xFF
    path.write_bytes(data)
    with BagSource([path], Config()) as source:
        assert any("is malformed" in w and "rescued" in w for w in source.warnings)
        assert 50 < len(list(source)) <= 60
    found = content(path)
    assert is_part(found, whole)
    assert len(whole) - 10 < len(found) < len(whole)


def test_a_recorder_that_was_killed_leaves_an_unindexed_bag(tmp_path: Path) -> None:
    path = make(tmp_path, "ros1")
    data = bytearray(path.read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    data[at : at + 8] = bytes(8)
    path.write_bytes(data)
    with BagSource([path], Config()) as source:
        assert scans(list(source)) == list(range(30))
        assert any("index is missing" in w for w in source.warnings)


# --- what is no bag ----------------------------------------------------------------------------


def test_a_missing_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"nowhere\.mcap: no such file or folder"):
        frames_of(tmp_path / "nowhere.mcap")


def test_a_folder_without_a_bag_is_one_line(tmp_path: Path) -> None:
    make(tmp_path)
    with pytest.raises(UserError, match=r"a folder without a bag.*there are bags in its folders: drive"):
        frames_of(tmp_path)


def test_an_empty_file_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "empty.mcap"
    path.touch()
    with pytest.raises(UserError, match=r"empty\.mcap: the file is empty"):
        frames_of(path)


@pytest.mark.parametrize("form", ["mcap", "sqlite3", "ros1"])
def test_an_empty_bag_is_one_line(tmp_path: Path, form: str) -> None:
    bag = bags.write(tmp_path / "empty.bag", [], form=form, topics=[(bags.CLOUD, CLOUD)])
    with pytest.raises(UserError, match=r"empty\.bag: there are no messages in it"):
        frames_of(bag)


@pytest.mark.parametrize(
    ("head", "what"),
    [
        (b"hello, this is text", "not a bag"),
        (b"RRF2" + bytes(20), "a Rerun recording"),
        (b"PK\x03\x04" + bytes(20), "a zip archive"),
        (b"#ROSBAG V1.2\n" + bytes(20), "rosbag fix"),
        (b"\x89MCAP0\r\n", "there are no messages"),
        (b"SQLite format 3\0" + bytes(2000), "nothing of it is left"),
    ],
)
def test_files_of_other_types_are_refused(tmp_path: Path, head: bytes, what: str) -> None:
    path = tmp_path / "drive.mcap"
    path.write_bytes(head)
    with pytest.raises(UserError, match=what):
        frames_of(path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_an_unreadable_file_is_one_line(tmp_path: Path) -> None:
    path = storage_file(make(tmp_path))
    path.chmod(0)
    with pytest.raises(UserError, match="permission denied"):
        frames_of(path)


def test_one_bad_file_among_several_is_told(tmp_path: Path) -> None:
    bag = make(tmp_path)
    (bag / "other.mcap").touch()
    with BagSource([bag], Config()) as source:
        assert len(list(source)) == 30
        assert any("other.mcap left out, which metadata.yaml does not list" in w for w in source.warnings)


@pytest.mark.parametrize("form", ["mcap", "sqlite3", "ros1"])
def test_a_lidar_topic_without_messages_is_one_line(tmp_path: Path, form: str) -> None:
    messages = bags.Messages(form == "ros1")
    items = [i for i in bags.small_items(messages) if i.topic != bags.CLOUD]
    path = bags.write(tmp_path / "drive.bag", items, messages, form=form, topics=[(bags.CLOUD, CLOUD)])
    with pytest.raises(UserError, match=r"topic /velodyne_points has no messages; nor has any other"):
        frames_of(path)


def test_the_lidar_topic_that_is_offered_has_messages(tmp_path: Path) -> None:
    path = bags.write(tmp_path / "drive", bags.small_items(), topics=[("/rear/points", CLOUD)])
    with pytest.raises(UserError, match=r"--set source\.lidar_topics=\[/velodyne_points\]$"):
        frames_of(path, config=load(settings=["source.lidar_topics=[/rear/points]"]))
    assert frames_of(path, config=load(settings=["source.lidar_topics=[/velodyne_points]"]))


def test_a_bag_without_a_lidar_is_one_line(tmp_path: Path) -> None:
    path = bags.write(
        tmp_path / "drive", [i for i in bags.small_items() if i.topic not in (bags.CLOUD, bags.IMAGE)]
    )
    with pytest.raises(UserError, match=r"no LiDAR: none of 3 topics is .*/tf \(TFMessage\)"):
        frames_of(path)


# --- the whole ---------------------------------------------------------------------------------


@pytest.mark.long
def test_memory_does_not_grow_with_the_length(tmp_path: Path) -> None:
    def peak(bag: Path) -> int:
        tracemalloc.start()
        try:
            with BagSource([bag], Config()) as source:
                for _ in source:
                    pass
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    short = make(tmp_path, name="short", scans=60, points=10_000)
    long = make(tmp_path, name="long", scans=180, points=10_000)
    peak(short)  # what is made once, as the generated decoders
    assert peak(long) < 1.15 * peak(short)


@pytest.mark.parametrize("name", ["000000", "000001"])
@pytest.mark.parametrize("form", ["mcap", "ros1"])
def test_projection_equals_kittis(shared: Path, tmp_path: Path, name: str, form: str) -> None:
    messages = bags.Messages(form == "ros1")
    items = bags.kitti_items(shared, messages, [name])
    (frame,) = frames_of(bags.write(tmp_path / "kitti.bag", items, messages, form=form))
    (camera,) = frame.cameras
    assert camera.intrinsics is not None and camera.camera_from_points is not None
    reference = bags.kitti(shared, name)
    np.testing.assert_array_equal(frame.points, reference.points[:, :3])
    points = frame.points.astype(np.float64)
    homogeneous = np.column_stack([points, np.ones(len(points))]) @ reference.pixels_from_lidar.T
    ahead = homogeneous[:, 2] > 1
    expected = homogeneous[ahead, :2] / homogeneous[ahead, 2:]
    rigid = camera.camera_from_points
    uv, depth = geometry.project(points[ahead] @ rigid[:3, :3].T + rigid[:3, 3], camera.intrinsics)
    inside = (np.abs(expected) < 2000).all(axis=1)
    assert inside.sum() > 10_000
    np.testing.assert_allclose(uv[inside], expected[inside], atol=0.01)
    np.testing.assert_allclose(depth[inside], homogeneous[ahead, 2][inside], atol=1e-3)


def test_images_pass_through_untouched(shared: Path, tmp_path: Path) -> None:
    (frame,) = frames_of(bags.write(tmp_path / "kitti", bags.kitti_items(shared, names=["000000"])))
    image = frame.cameras[0].image
    assert image is not None
    assert image.encoded == bags.kitti(shared, "000000").png
    raw = bags.kitti_items(shared, names=["000000"], compressed=False)
    (plain,) = frames_of(bags.write(tmp_path / "plain", raw))
    assert plain.cameras[0].image is not None
    np.testing.assert_array_equal(plain.cameras[0].image.bgr, image.bgr)


def test_stated_roles_are_used(tmp_path: Path) -> None:
    bag = make(tmp_path)
    with BagSource([bag], load(settings=[f"source.camera_topics=[{bags.IMAGE}]"])) as source:
        assert source.roles.cameras[0].topic == bags.IMAGE
    with pytest.raises(UserError, match="there is no topic /other"):
        frames_of(bag, config=load(settings=["source.lidar_topics=[/other]"]))


def test_a_source_can_be_read_twice(tmp_path: Path) -> None:
    bag = make(tmp_path, scans=5)
    with BagSource([bag], Config()) as source:
        assert scans(list(source)) == scans(list(source)) == list(range(5))
    shutil.rmtree(bag)  # nothing holds it


# --- single frames -----------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(("form", "compression"), FORMATS)
def test_a_single_frame_is_that_of_the_run(tmp_path: Path, form: str, compression: str) -> None:
    bag = make(tmp_path, form, compression)
    with BagSource([bag], Config()) as source:
        run = list(source)
        for number in (len(run) - 1, 0, 14):
            single = source.frame(number)
            assert single is not None
            assert (single.index, single.stamp, single.problems) == (
                number,
                run[number].stamp,
                run[number].problems,
            )
            np.testing.assert_array_equal(single.points, run[number].points)
            for camera, same in zip(single.cameras, run[number].cameras, strict=True):
                assert (camera.image is None) == (same.image is None)
                if camera.image is not None and same.image is not None:
                    np.testing.assert_array_equal(camera.image.bgr, same.image.bgr)
                if camera.camera_from_points is not None:
                    np.testing.assert_array_equal(camera.camera_from_points, same.camera_from_points)


@pytest.fixture(scope="module")
def long_drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Drive of 60 clouds of 40,000 points, which is not packed."""
    folder = tmp_path_factory.mktemp("long")
    return make(folder, name="long", scans=60, points=40_000)


def test_a_single_frame_reads_no_old_clouds(long_drive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    size = storage_file(long_drive).stat().st_size
    read = 0

    def counted(self: FileBytes, offset: int, length: int) -> bytes:
        nonlocal read
        data = pread(self, offset, length)
        read += len(data)
        return data

    with BagSource([long_drive], Config()) as source:
        run = list(source)
        source.frame(0)
        pread = FileBytes._pread
        monkeypatch.setattr(FileBytes, "_pread", counted)
        frame = source.frame(50)
    assert frame is not None and frame.stamp == run[50].stamp
    assert 0 < read < size / 4  # 15 clouds; the search for transforms goes back by 20


def test_a_message_that_is_not_where_the_index_says_is_named(long_drive: Path, tmp_path: Path) -> None:
    bag = tmp_path / "wrong"
    shutil.copytree(long_drive, bag)
    file = storage_file(bag)
    with BagSource([bag], Config()) as source:
        whole = source.frame(50)
        chunks = source.recording.files[0]._reader._index.chunks  # type: ignore[attr-defined]
        stamp = int(source.scans[50]) - 1_500_000_000
        chunk = next(one for one in chunks if one.start <= stamp <= one.end)
        (tf,) = [c.id for c in source.recording.files[0].connections if c.topic == "/tf"]
        at = chunk.index[tf]
    data = bytearray(file.read_bytes())
    data[at + 15 + 8 : at + 15 + 16] = (chunk.size - 5).to_bytes(8, "little")  # offset of its first message
    file.write_bytes(data)
    with BagSource([bag], Config()) as source:
        frame = source.frame(50)
        assert frame is not None and whole is not None and frame.stamp == whole.stamp
        assert any("chunk" in text for text in source.warnings)
