"""Clouds as point_cloud_transport's plugins compress them."""

from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bevviz.bags.bag import Recording
from bevviz.bags.source import BagSource
from bevviz.cli import main
from bevviz.config import Config
from bevviz.config.sections import DetectorConfig
from bevviz.drivers.compressed_clouds import COMPRESSED
from bevviz.live.live_message import LiveMessage
from bevviz.messages.clouds import decode_cloud
from bevviz.messages.decoders import MessageError
from bevviz.report.redact import Redactor
from tests.support import bags
from tests.support.compressed_clouds import compressed, messages, packed, points


def decoded(message: Any) -> Any:
    raw = bytes(messages().store.serialize_cdr(message, COMPRESSED))
    return decode_cloud(LiveMessage("/points", COMPRESSED, 0, raw).decode(), "/points", 0)


@pytest.mark.parametrize("form", ["zstd", "zlib", "gzip"])
@pytest.mark.parametrize("ros1", [False, True])
def test_compressed_points_are_read_from_a_bag(tmp_path: Path, form: str, ros1: bool) -> None:
    made = messages(ros1)
    stamps = [bags.START + i * bags.PERIOD for i in range(3)]
    clouds = [made.cloud(stamp, points(number)) for number, stamp in enumerate(stamps)]
    name = "zlib" if form == "gzip" else form
    items = [
        bags.Item(
            f"/lidar/{name}",
            COMPRESSED,
            stamp,
            compressed(made, cloud, name, packed(form, cloud.data.tobytes())),
        )
        for stamp, cloud in zip(stamps, clouds, strict=True)
    ]
    path = bags.write(tmp_path / ("bag.bag" if ros1 else "bag"), items, made, form="ros1" if ros1 else "mcap")
    with BagSource([path], Config()) as source:
        assert source.roles.notes[f"/lidar/{name}"] == "LiDAR, by type and name"
        frames = list(source)
    assert [frame.stamp for frame in frames] == stamps
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.points, points(number)[:, :3])
        np.testing.assert_array_equal(frame.fields["intensity"], points(number)[:, 3])


def test_a_raw_cloud_is_preferred_to_its_compressed_copy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = messages()
    cloud = made.cloud(bags.START, points(0))
    items = [
        bags.Item("/points", "sensor_msgs/msg/PointCloud2", bags.START, cloud),
        bags.Item("/points/zstd", COMPRESSED, bags.START, compressed(made, cloud, "zstd", b"")),
    ]
    assert main(["info", str(bags.write(tmp_path / "bag", items, made))]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "/points: LiDAR, by type and name" in said
    assert "/points/zstd: not used: the sensor of /points, by its frame or name" in said


def test_a_redacted_report_may_keep_a_compressed_cloud_as_it_is(tmp_path: Path) -> None:
    made = messages()
    cloud = made.cloud(bags.START, points(0))
    content = compressed(made, cloud, "zstd", packed("zstd", cloud.data.tobytes()))
    path = bags.write(tmp_path / "bag", [bags.Item("/points/zstd", COMPRESSED, bags.START, content)], made)
    with Recording([path]) as recording:
        message = recording.first("/points/zstd")
        assert message is not None and recording.deserialize(message).format == "zstd"
        for patterns, kept in (((), None), (("/points*",), (message.connection, message.content()))):
            redactor = Redactor(DetectorConfig(model="demo"), recording, unredacted=patterns)
            assert redactor(message, message.content()) == kept


def test_undecodable_clouds_state_the_reason() -> None:
    made = messages()
    cloud = made.cloud(bags.START, points(0))
    whole = packed("zstd", cloud.data.tobytes())
    for message, said in (
        (
            compressed(made, cloud, "lzma", whole),
            "compressed by 'lzma' is not read: zstd, zlib and draco are",
        ),
        (compressed(made, cloud, "cloudini", whole), "compressed by 'cloudini' is not read"),
        (compressed(made, cloud, "zstd", b"nothing of the kind"), "its compressed data is damaged"),
        (compressed(made, cloud, "zstd", whole[:-9]), "the end of its compressed data is missing"),
        (compressed(made, cloud, "zlib", whole), "its compressed data is damaged"),
    ):
        with pytest.raises(MessageError, match=f"/points: not a {COMPRESSED}: .*{said}"):
            decoded(message)


@pytest.mark.parametrize("form", ["zstd", "zlib"])
def test_a_cloud_is_unpacked_to_the_size_that_it_states(form: str) -> None:
    made = messages()
    message = compressed(made, made.cloud(bags.START, points(0)), form, packed(form, bytes(200 << 20)))
    tracemalloc.start()
    with pytest.raises(MessageError, match="or it is too long"):
        decoded(message)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 60e6
