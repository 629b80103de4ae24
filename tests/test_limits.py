"""Limits of what a file or a message of unknown origin may cost."""

from __future__ import annotations

import json
import shutil
from collections import Counter, namedtuple
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from backports import zstd

from bevviz.bags import bag, compression, mcap, reader
from bevviz.bags.bag import Recording
from bevviz.bags.source import BagSource
from bevviz.config import Config
from bevviz.config.sections import SourceConfig
from bevviz.errors import UserError
from bevviz.live.live_message import LiveMessage
from bevviz.messages import guard as guard_module
from bevviz.messages.decoders import MessageError
from bevviz.messages.detections import decode_detections_3d
from bevviz.messages.roles import find_roles
from bevviz.messages.topics import Topic
from bevviz.messages.transforms import StampedTransform
from bevviz.support.limits import MAX_BOXES, MAX_FRAMES, MAX_MESSAGE, MAX_SENSORS
from bevviz.sync.transform_tree import TransformBuffer
from tests.support import bags
from tests.support.commands import Capture, error_of

IMAGE, INFO, CLOUD = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/PointCloud2"
TF = "tf2_msgs/msg/TFMessage"


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    return bags.write(tmp_path / "drive", bags.small_items(scans=3))


@pytest.mark.long
@pytest.mark.parametrize("form", ["mcap", "sqlite3", "ros1"])
def test_files_with_too_many_topics_are_refused(
    tmp_path: Path, form: str, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    empty = [(f"/t{number}", IMAGE) for number in range(60)]
    made = bags.Messages(form == "ros1")
    name = "drive.bag" if made.ros1 else "drive"
    path = bags.write(tmp_path / name, bags.small_items(made, 1), made, form=form, topics=empty)
    monkeypatch.setattr(bag, "MAX_TOPICS", 50)
    assert "it has 65 topics: 50 at most are read" in error_of(capsys, "info", path)
    monkeypatch.setattr(reader, "MAX_CONNECTIONS", 20)
    assert "it has 65 connections: 20 at most are read" in error_of(capsys, "info", path)


def test_long_names_of_topics_are_refused(tmp_path: Path, capsys: Capture) -> None:
    path = bags.write(tmp_path / "drive", bags.small_items(scans=1), topics=[("/" + 2000 * "a", IMAGE)])
    assert "the name of a topic has 2,001 characters: 1,000 at most" in error_of(capsys, "info", path)


def test_the_topics_of_a_file_are_grouped_once(drive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The time to open a recording must not grow with the square of its topics."""
    reads = Counter[str]()
    monkeypatch.setattr(
        bag, "normalized", lambda msgtype: reads.update([msgtype]) or reader.normalized(msgtype)
    )
    with Recording([drive]) as recording:
        first = reads.total()
        for topic in recording.topics:
            recording.first(topic.name)
        assert reads.total() - first < 6 * len(recording.topics)


def test_roles_of_many_topics_take_linear_work(monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = Counter[str]()
    kind = vars(Topic)["kind"].fget
    monkeypatch.setattr(Topic, "kind", property(lambda self: kinds.update(["asked"]) or kind(self)))
    third = 500
    find_roles(
        [
            *(Topic(f"/a{n}/tf", TF, 1) for n in range(third)),
            *(Topic(f"/b/{n}/image", IMAGE, 1, "camera") for n in range(third)),
            *(Topic(f"/b/{n}/info", INFO, 1, "camera") for n in range(third)),
        ],
        SourceConfig(),
    )
    assert kinds["asked"] < 60 * 3 * third


@pytest.mark.parametrize(("kind", "key"), [(CLOUD, "lidar_topics"), (IMAGE, "camera_topics")])
def test_too_many_sensors_are_refused(kind: str, key: str) -> None:
    topics = [Topic(f"/s{n}/data", kind, 1, f"frame{n}") for n in range(MAX_SENSORS + 1)]
    with pytest.raises(UserError, match=rf"^65 topics look like .* --set source.{key}=\["):
        find_roles(topics, SourceConfig())
    roles = find_roles(topics, SourceConfig.model_validate({key: ("/s1/data",)}))
    assert (roles.lidars or (roles.cameras[0].topic,)) == ("/s1/data",)


@pytest.mark.long
@pytest.mark.parametrize("key", ["lidar_topics", "camera_topics"])
def test_settings_with_too_many_names_are_refused(drive: Path, key: str, capsys: Capture) -> None:
    path = drive.parent / "many.yaml"
    path.write_text(f"source:\n  {key}: {['/velodyne_points'] * 9000}\n")
    said = error_of(capsys, "info", drive, "--config", path)
    assert f"source.{key}" in said and "at most 64 items" in said and len(said) < 1000


def test_a_long_list_of_files_in_the_metadata_is_not_read(
    drive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = drive / "metadata.yaml"
    names = "".join(f"  - part_{n}.mcap\n" for n in range(30))
    path.write_text(path.read_text().replace("  relative_file_paths:\n", "  relative_file_paths:\n" + names))
    with Recording([drive]) as recording:
        (note,) = recording.warnings
        assert "part_0.mcap" in note and " ... of metadata.yaml is missing" in note and len(note) < 400
    monkeypatch.setattr(bag, "CONFIG_LIMIT", 500)
    monkeypatch.setattr(bag, "parse_yaml", lambda *_: pytest.fail("it is read"))
    with Recording([drive]) as recording:
        assert "not readable as metadata.yaml: read without" in recording.warnings[0]


# --- unpacking -----------------------------------------------------------------------------------


def _bomb(path: Path, megabytes: int) -> Path:
    piece = zstd.compress(bytes(1 << 20))
    path.write_bytes(zstd.compress(mcap.MAGIC) + piece * megabytes)
    return path


def test_a_file_unpacks_to_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.setattr(compression, "MIN_FILE", 4 << 20)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "scratch"))
    (tmp_path / "scratch").mkdir()
    said = error_of(capsys, "info", _bomb(tmp_path / "bomb.mcap.zstd", 200))
    assert "it unpacks to more than 4.2 MB" in said and "zstd -d" in said
    assert not list((tmp_path / "scratch").iterdir())


def test_unpacking_leaves_room_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(1 << 40, 1 << 40, (1 << 30) - 1))
    said = error_of(capsys, "info", _bomb(tmp_path / "drive.mcap.zstd", 1))
    assert "would fill the disk" in said and "TMPDIR" in said


def test_an_index_beyond_the_limit_is_not_read(drive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcap, "MAX_INDEX", 100)
    with Recording([drive]) as recording:
        assert recording.message_count == 13
        assert "its index has more than" in recording.warnings[0]


def test_attachments_are_read_up_to_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from mcap.writer import Writer

    path = tmp_path / "attached.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for number in range(9):
            writer.add_attachment(0, 0, f"{number}", "text/plain", bytes(1000))
        writer.finish()  # type: ignore[no-untyped-call]
    assert len(mcap.read_attachments(path)) == 9
    monkeypatch.setattr(mcap, "MAX_ATTACHMENT", 5000)
    assert len(mcap.read_attachments(path)) == 4
    monkeypatch.setattr(mcap, "MAX_ATTACHMENTS", 3)
    assert len(mcap.read_attachments(path)) == 2  # The header is a record, too.


def test_different_qos_profiles_are_read_up_to_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    texts = list[str]()

    def parse(text: str) -> list[Any]:
        texts.append(text)
        return []

    monkeypatch.setattr(mcap, "parse_qos", parse)
    channels = mcap.Channels()
    for number in range(500):
        channels.note(mcap.CHANNEL, _channel(number, f"- depth: {number}\n"))
        channels.note(mcap.CHANNEL, _channel(1000 + number, "- depth: 7\n"))
    channels.note(mcap.CHANNEL, _channel(2000, "#" * 20_000))
    assert len(channels.connections({})) == 1001
    assert len(texts) == 100 == len(set(texts))


def _channel(number: int, profiles: str) -> bytes:
    def string(value: bytes) -> bytes:
        return len(value).to_bytes(4, "little") + value

    metadata = string(b"offered_qos_profiles") + string(profiles.encode())
    head = number.to_bytes(2, "little") + bytes(2)
    return head + string(f"/t{number}".encode()) + string(b"cdr") + string(metadata)


# --- messages ------------------------------------------------------------------------------------


def test_a_cloud_that_states_too_much_is_not_unpacked(monkeypatch: pytest.MonkeyPatch) -> None:
    from bevviz.drivers import compressed_clouds

    monkeypatch.setattr(zstd, "ZstdDecompressor", lambda: pytest.fail("it is unpacked"))
    with pytest.raises(ValueError, match="after unpacking: 268,435,456 at most are taken"):
        compressed_clouds._unpack(None, b"", MAX_MESSAGE + 1)


def _boxes(count: int) -> Any:
    made = bags.Messages()
    pose = made.make(
        "geometry_msgs/msg/Pose",
        position=made.make("geometry_msgs/msg/Point", x=1.0, y=2.0, z=3.0),
        orientation=made.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
    )
    size = made.make("geometry_msgs/msg/Vector3", x=1.0, y=1.0, z=1.0)
    header = made.header(bags.START, bags.LIDAR_FRAME)
    box = made.make("vision_msgs/msg/BoundingBox3D", center=pose, size=size)
    detection = made.make("vision_msgs/msg/Detection3D", header=header, results=[], bbox=box, id="")
    return made.make("vision_msgs/msg/Detection3DArray", header=header, detections=[detection] * count)


def test_messages_with_too_many_boxes_are_not_used(tmp_path: Path) -> None:
    assert len(decode_detections_3d(_boxes(MAX_BOXES), "/boxes", 0).boxes) == MAX_BOXES
    items = [
        *bags.small_items(scans=1),
        bags.Item("/boxes", "vision_msgs/msg/Detection3DArray", bags.START, _boxes(MAX_BOXES + 1)),
    ]
    with BagSource([bags.write(tmp_path / "drive", items)], Config()) as source:
        (frame,) = source
        assert not frame.robot_boxes
        assert any("it has 5,001 boxes: 5,000 at most are taken" in text for text in source.warnings)


def test_long_messages_of_objects_are_not_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    kind = "vision_msgs/msg/Detection3DArray"
    data = bytes(bags.Messages().store.serialize_cdr(_boxes(20), kind))
    assert LiveMessage("/boxes", kind, 0, data).decode()
    monkeypatch.setattr(guard_module, "MAX_OBJECTS", 1000)
    with pytest.raises(MessageError, match=r"^/boxes: .* bytes is not taken: 1,000 at most"):
        LiveMessage("/boxes", kind, 0, data).decode()
    cloud = bags.Messages().cloud(bags.START, np.zeros((500, 4), np.float32))
    points = bytes(bags.Messages().store.serialize_cdr(cloud, CLOUD))
    assert LiveMessage("/points", CLOUD, 0, points).decode()


def _chain(count: int) -> Iterator[StampedTransform]:
    return (StampedTransform(0, f"f{n}", f"f{n + 1}", np.eye(4)) for n in range(count))


def test_frames_of_the_transforms_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    assert MAX_FRAMES >= 1000
    monkeypatch.setattr("bevviz.sync.transform_tree.MAX_FRAMES", 20)
    buffer = TransformBuffer()
    for transform in _chain(30):
        buffer.add(transform, static=True)
    assert len(buffer.tree()) == 20
    assert any("more than 20 frames: the others are ignored" in text for text in buffer.problems)
    buffer.add(StampedTransform(1, "f0", "f1", np.eye(4)), static=True)  # A known frame still moves.


def test_a_file_of_results_with_too_many_boxes_is_named(drive: Path) -> None:
    row = {"image_id": 0, "category_id": 1, "bbox": [1, 1, 9, 9], "score": 0.5}
    path = drive.parent / "results.json"
    path.write_text(json.dumps([row] * (MAX_BOXES + 1)))
    with BagSource([drive], Config.model_validate({"source": {"results": {"mine": str(path)}}})) as source:
        problems = [text for frame in source for text in frame.problems]
    assert any("it has 5,001 boxes: 5,000 at most are taken" in text for text in problems)
