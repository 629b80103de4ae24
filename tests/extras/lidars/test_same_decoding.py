"""Bags and live graphs decode the packets of LiDARs alike."""

from __future__ import annotations

from pathlib import Path

import pytest

from bevviz.bags.bag import Recording
from bevviz.live.live_message import LiveMessage
from bevviz.messages.packet_topics import PacketTopics
from bevviz.messages.topics import Topic
from bevviz.model.frame import Cloud
from tests.support import bags, lidar_packets, ouster_packets
from tests.support.decoded_messages import assert_same, both


def test_bags_and_live_decode_hesai_packets_alike(tmp_path: Path) -> None:
    made, data = (
        lidar_packets.messages(),
        lidar_packets.packet(lidar_packets.MODELS_BY_NAME["PandarXT16"], 0),
    )
    item = bags.Item("/p", lidar_packets.SCAN, 1, lidar_packets.scan(made, bags.START, [data]))
    in_bag, live = both(tmp_path / "bag", item, made)
    assert len(in_bag.xyz) > 100
    assert_same(in_bag, live)


def test_bags_and_live_decode_velodyne_packets_alike(tmp_path: Path) -> None:
    pytest.importorskip("velodyne_decoder")
    made, kind = lidar_packets.messages(), lidar_packets.VELODYNE
    block = b"\xff\xee\0\0" + b"\xe8\x03\x10" * 32
    data = block * 12 + bytes(4) + b"\x37\x22"  # a VLP-16 in the mode of strongest returns
    item = bags.Item("/v", kind, 1, lidar_packets.scan(made, bags.START, [data], kind))
    in_bag, live = both(tmp_path / "bag", item, made)
    assert len(in_bag.xyz) > 100
    assert_same(in_bag, live)


def test_bags_and_live_decode_ouster_scans_alike(tmp_path: Path) -> None:
    text, kind = ouster_packets.metadata("RNG15_RFL8_NIR8"), ouster_packets.KIND
    path = ouster_packets.bag(tmp_path / "bag", told=text, scans=1)
    topics, live = PacketTopics(), list[Cloud]()
    topics.describe(Topic(ouster_packets.LIDAR, kind), {})
    topics.add_metadata(ouster_packets.METADATA, text)
    with Recording([path]) as recording:
        for message in recording.messages([ouster_packets.LIDAR]):
            for scan in topics.add_packet(message.topic, message.received, bytes(message.content())):
                live.append(LiveMessage(message.topic, kind, message.received, b"", scan).decode())
        in_bag = [recording.decode(scan) for scan in recording.scans([ouster_packets.LIDAR])]
    assert len(in_bag) == 1 and len(in_bag[0].xyz) > 100
    assert_same(in_bag, live)
