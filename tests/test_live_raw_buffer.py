"""The raw seconds: what is kept of the messages beside the frames, and that it gives the same again.

The messages are handed over inside this process. tests/test_live_ros.py saves those of a robot over DDS.
"""

from __future__ import annotations

import errno
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat
from ruamel.yaml import YAML

from bevviz.bags.mcap_writer import McapWriter
from bevviz.bags.source import BagSource
from bevviz.config import load
from bevviz.errors import UserError
from bevviz.extras.demo.drive import LIDAR_TOPIC
from bevviz.model.protocols import Observer
from bevviz.model.results import FrameResult
from bevviz.pipeline.bag_info import describe_bag
from bevviz.pipeline.run import run as run_frames
from bevviz.pipeline.session import Session
from bevviz.recording.source_lookup import read_origin
from bevviz.report.fingerprints import compare, digest
from bevviz.support.files import write_all
from tests.support.played_drive import drive_of
from tests.support.recordings import Recording, verify_when_indexed
from tests.support.ros_player import Play

pytest.importorskip("rclpy", reason="needs rclpy: pip install 'bevviz[ros]'")

from bevviz.config.reloading import ReloadableConfig
from bevviz.live.raw_recorder import LatchedMessages, RawMessage, RawRecorder, children
from bevviz.live.run_outputs import Outputs
from bevviz.live.runtime import Live
from bevviz.live.source import LiveSource
from bevviz.live.status import Notes
from bevviz.messages.definitions import typestore
from bevviz.messages.encode import encode_transforms
from tests.support.fed_graph import FedGraph, Player, fed_graph, play_in_step
from tests.support.live_sessions import CalledReceiver, run_beside

SECONDS = 1.0  # that the flight recorder holds: with three seconds before them less than the run takes
POINTS = 3000
STRING = "std_msgs/msg/String"
TYPES = drive_of(Play()).types


@dataclass
class Flight:
    """A run beside a robot, what it made, and what it saved."""

    folder: Path
    results: dict[int, Any]  # stamp -> digest
    said: list[str]
    sizes: list[tuple[int, float]]  # of the raw recorder: bytes, seconds


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Flight]:
    folder = tmp_path_factory.mktemp("flight")
    with fed_graph() as graph, pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(folder))
        patch.chdir(folder)
        yield fly(folder, graph)


def fly(folder: Path, graph: FedGraph) -> Flight:
    from rclpy.qos import DurabilityPolicy, QoSProfile

    said: list[str] = []
    results: dict[int, Any] = {}
    sizes: list[tuple[int, float]] = []
    settings = ReloadableConfig(None, [f"live.flight_time={SECONDS} s"])
    raw = RawRecorder(settings)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    description = graph.advertise("/robot_description", STRING, qos=latched)
    graph.publish(description, typestore().types[STRING](data="<robot name='r'/>"))
    graph.advertise("/depth/image", "sensor_msgs/msg/Image")  # bulky by its type, the next one by its size
    heights = graph.advertise("/heightmap", STRING)
    wide = bytes(typestore().serialize_cdr(typestore().types[STRING](data=500_000 * "x"), STRING))
    player = Player(graph, frames=3, points=POINTS)
    with LiveSource(settings.config, tell=said.append, raw=raw) as source:
        player.play(2.0)
        assert source.wait(0), source.missing
        live = Live(
            source,
            settings,
            Outputs(save=Path("all.rrd"), raw=Path("all.mcap")),
            Notes(said.append),
        )
        live.receivers.append(
            CalledReceiver(lambda result: results.update({result.frame.stamp: digest(result)}))
        )
        live.encoder.clock = lambda: graph.now

        def feed() -> None:
            for _ in range(50):
                graph.publish(heights, wide)
                play_in_step(player, live, source)
                sizes.append((raw.size, raw.seconds))
            live.flight.save(Path("snap.rrd"))

        run_beside(live, feed)
    return Flight(folder, results, said, sizes)


class Digests(Observer[FrameResult]):
    def __init__(self) -> None:
        self.by_stamp: dict[int, Any] = {}
        self.results: list[FrameResult] = []

    def observe(self, result: FrameResult) -> None:
        self.by_stamp[result.frame.stamp] = digest(result)
        self.results.append(result)


@pytest.mark.long
@pytest.mark.parametrize("bag", ["snap.mcap", "all.mcap"])
def test_the_saved_messages_give_identical_results(flight: Flight, bag: str) -> None:
    config = load()
    again = Digests()
    with BagSource([flight.folder / bag], config) as source:
        run_frames(source, Session(config), [again])
        assert source.scene.lidar == "rslidar" and source.scene.cameras == ("zed",)
    shown = Recording((flight.folder / bag).with_suffix(".rrd")).times["stamp"].values()
    shared = flight.results.keys() & set(shown)
    assert len(shared) > 5 and shared <= again.by_stamp.keys()
    assert [found for s in shared if (found := compare(flight.results[s], again.by_stamp[s]))] == []
    last = again.results[-1].frame
    assert last.world_frame == "map" and last.cameras[0].intrinsics is not None


@pytest.mark.long
def test_other_libraries_read_it(flight: Flight) -> None:
    path = flight.folder / "snap.mcap"
    verify_when_indexed(path.with_suffix(".rrd"))
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        channels = {channel.topic: channel for channel in summary.channels.values()}
        assert channels.keys() >= {*TYPES, "/robot_description"}
        schemas = summary.schemas
        for topic, kind in TYPES.items():
            schema = schemas[channels[topic].schema_id]
            assert (schema.name, schema.encoding) == (kind, "ros2msg")
            assert channels[topic].message_encoding == "cdr"
            assert channels[topic].metadata["topic_type_hash"].startswith("RIHS01_")
        (profile,) = YAML(typ="safe").load(channels["/tf_static"].metadata["offered_qos_profiles"])
        assert (profile["durability"], profile["reliability"]) == ("transient_local", "reliable")
        messages = list(reader.iter_messages(log_time_order=False))
    times = [message.log_time for _, _, message in messages]
    assert times == sorted(times)
    assert {channel.topic for _, channel, _ in messages[:3]} >= {"/tf_static", "/robot_description"}
    with AnyReader([path]) as other:
        counts = {connection.topic: connection.msgcount for connection in other.connections}
        clouds = [c for c in other.connections if c.topic == LIDAR_TOPIC]
        for connection, _, data in other.messages(clouds):
            cloud: Any = other.deserialize(data, connection.msgtype)
            assert cloud.width == POINTS
    assert counts["/tf_static"] == counts["/robot_description"] == 1
    assert counts[LIDAR_TOPIC] >= len(Recording(path.with_suffix(".rrd")).times["stamp"]) > 5


def test_a_recording_stands_for_the_bag_beside_it(flight: Flight, tmp_path: Path) -> None:
    info = describe_bag([flight.folder / "snap.rrd"], load())
    assert info.size == (flight.folder / "snap.mcap").stat().st_size
    assert tuple(info.missing) == ("no detector: --model FILE.onnx",) and info.cameras[0].width
    how, _ = read_origin(flight.folder / "snap.rrd")
    assert "flight_time" in how
    alone = tmp_path / "snap.rrd"
    alone.write_bytes((flight.folder / "snap.rrd").read_bytes())
    with pytest.raises(UserError, match=r"snap\.mcap, which 'bevviz live' saves with it, is not beside it"):
        describe_bag([alone], load())


def test_the_buffer_is_bounded_and_shown(flight: Flight) -> None:
    assert max(seconds for _, seconds in flight.sizes) <= SECONDS + 3.2
    assert max(size for size, _ in flight.sizes) < 500e6
    (saved,) = [text for text in flight.said if text.startswith("flight recorder saved")]
    told = re.search(r"snap\.rrd and snap\.mcap, (\d+) messages of (\d+) s", saved)
    with (flight.folder / "snap.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None and summary.statistics is not None
    statistics = summary.statistics
    assert told is not None and int(told[1]) == statistics.message_count
    span = (statistics.message_end_time - statistics.message_start_time) / 1e9
    assert abs(int(told[2]) - span) <= 1 and span >= SECONDS
    (left_out,) = [text for text in flight.said if text.startswith("not in snap.mcap")]
    assert "/depth/image (it plays no role and is no small one)" in left_out
    assert "/heightmap (it plays no role and has " in left_out


def test_a_message_stays_until_another_one_takes_its_place() -> None:
    def said(topic: str, kind: str, received: int, data: bytes) -> RawMessage:
        nothing = MessageDefinition(MessageDefinitionFormat.NONE, "")
        connection = Connection(0, topic, kind, nothing, "", 0, ConnectionExtRosbag2("cdr", []), None)
        return RawMessage(connection, received, received, data)

    def pose(received: int, *names: str) -> RawMessage:
        edges = [("a frame", name, np.eye(4)) for name in names]
        data = typestore().serialize_cdr(encode_transforms(received, edges), "tf2_msgs/msg/TFMessage")
        return said("/tf", "tf2_msgs/msg/TFMessage", received, bytes(data))

    latched = LatchedMessages()
    messages = [
        said("/map", "nav_msgs/msg/OccupancyGrid", 1, b"old"),
        pose(2, "odom", "b"),
        pose(3, "odom"),
        said("/points", "sensor_msgs/msg/PointCloud2", 4, b"cloud"),
        said("/map", "nav_msgs/msg/OccupancyGrid", 5, b"new!"),
        pose(6, "odom"),
    ]
    for message in messages:
        latched.add(message)
    kept = latched.before(1000)
    assert [(m.sent, m.received) for m in kept] == [(2, 997), (5, 998), (6, 999)]
    assert latched.size == sum(len(m.data) for m in kept)
    assert children(messages[1].data) == ("odom", "b") and children(b"\0\1\0\0\5") == ()


def test_a_full_disk_leaves_a_bag_that_can_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = MessageDefinition(MessageDefinitionFormat.NONE, "")
    connection = Connection(0, "/x", "a/msg/X", nothing, "", 0, ConnectionExtRosbag2("cdr", []), None)
    written, room = write_all, 12_000_000

    def limited(file: int, data: bytes) -> None:
        nonlocal room
        if len(data) > room:
            written(file, data[:room])
            raise OSError(errno.ENOSPC, "No space left on device")
        room -= len(data)
        written(file, data)

    monkeypatch.setattr("bevviz.bags.completion.write_all", limited)
    random_bytes = np.random.default_rng(0).bytes
    with McapWriter(tmp_path / "x.mcap", lambda connection: connection.msgdef) as bag:
        with pytest.raises(UserError, match="No space left"):
            for time_ in range(100):
                bag.write(connection, time_, random_bytes(1_000_000))
        room = 1_000_000  # of the chunk that did not fit
    with (tmp_path / "x.mcap").open("rb") as file:
        assert len(list(make_reader(file, validate_crcs=True).iter_messages())) == 10
