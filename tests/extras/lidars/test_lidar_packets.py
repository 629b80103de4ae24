"""Packets of LiDARs, byte by byte as their manuals have them, in messages that rosbags serialises."""

from __future__ import annotations

import csv
import shutil
import struct
from math import cos, radians, sin
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from bevviz.bags.source import BagSource
from bevviz.cli import main
from bevviz.config import Config
from bevviz.extras.lidars import velodyne
from bevviz.extras.lidars.hesai import NOMINAL
from bevviz.live.live_message import LiveMessage
from bevviz.messages.clouds import decode_cloud
from bevviz.messages.decoders import MessageError
from tests.support import bags
from tests.support.lidar_packets import LAYOUTS, MODELS_BY_NAME, SCAN, VELODYNE, messages, packet, scan


def angles(name: str) -> list[tuple[float, float]]:
    rows = [row[1:] for row in csv.reader(NOMINAL.read_text().splitlines()) if row[0] == name]
    return [(float(elevation), float(azimuth)) for _, elevation, azimuth in rows]


def decoded(found: list[bytes], kind: str = SCAN, cut: int = 0) -> Any:
    made = messages()
    whole = bytes(made.store.serialize_cdr(scan(made, bags.START, found, kind), kind))
    message = LiveMessage("/packets", kind, 0, whole[: len(whole) - cut])
    return decode_cloud(message.decode(), "/packets", 0)


@pytest.mark.parametrize("name", list(LAYOUTS))
def test_a_hesai_scan_by_its_layout(name: str) -> None:
    model = MODELS_BY_NAME[name]
    cloud = decoded([packet(model, 0), packet(model, 1)])
    unit = 0.005 if name == "PandarXT32M" else 0.004
    expected = []
    for number in range(2):
        for block in range(model.blocks):
            for channel, (elevation, offset) in enumerate(angles(name)):
                if channel != 2:
                    far = unit * (1000 + 10 * channel + (block % 2) * (channel % 2))
                    turn, tilt = radians(block + 10 * number + offset), radians(elevation)
                    flat = far * cos(tilt)
                    expected.append((flat * sin(turn), flat * cos(turn), far * sin(tilt), channel))
    np.testing.assert_allclose(cloud.xyz, np.array(expected)[:, :3], atol=1e-5)
    np.testing.assert_array_equal(cloud.fields["ring"], np.array(expected)[:, 3])
    np.testing.assert_array_equal(cloud.fields["intensity"], np.array(expected)[:, 3])
    assert cloud.dropped == 2 * model.blocks  # the third beam of each block
    first, second = np.split(cloud.fields["time"], 2)
    np.testing.assert_allclose(second - first, 1e-3, atol=1e-6)  # though the second is over meanwhile
    assert (np.diff(cloud.fields["time"]) >= 0).all()
    assert np.abs(first).max() < 1e-3


@pytest.mark.parametrize("ros1", [False, True])
def test_a_bag_of_packets_gives_clouds(tmp_path: Path, ros1: bool) -> None:
    made, model = messages(ros1), MODELS_BY_NAME["PandarXT16"]
    stamps = [bags.START + i * bags.PERIOD for i in range(3)]
    scans = [
        scan(made, t, [packet(model, n) for n in range(4)], frame="a" * (n + 1)) for n, t in enumerate(stamps)
    ]
    items = [bags.Item("/pandar_packets", SCAN, t, m) for t, m in zip(stamps, scans, strict=True)]
    path = bags.write(tmp_path / ("bag.bag" if ros1 else "bag"), items, made, form="ros1" if ros1 else "mcap")
    with BagSource([path], Config()) as source:
        assert source.roles.notes["/pandar_packets"] == "LiDAR, by type and name"
        frames = list(source)
    assert [frame.stamp for frame in frames] == stamps
    assert [frame.points_frame for frame in frames] == ["a", "aa", "aaa"]
    for frame in frames:
        np.testing.assert_array_equal(frame.points, frames[0].points)
        assert len(frame.points) == 4 * 8 * 15


def test_equal_dual_returns_are_one_point() -> None:
    model = MODELS_BY_NAME["PandarXT32"]
    cloud = decoded([packet(model, 0, mode=0x39)])
    # Blocks go two by two, and only odd channels differ between them.
    assert len(cloud.xyz) == 4 * (16 * 2 + 15)
    assert cloud.dropped == 4


def test_the_angles_of_the_sensor_are_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made, model = messages(), MODELS_BY_NAME["PandarXT16"]
    item = bags.Item("/pandar", SCAN, bags.START, scan(made, bags.START, [packet(model, 0)]))
    path = bags.write(tmp_path / "bag", [item], made)
    file = tmp_path / "angles.csv"
    file.write_text("\ufeffChannel,Elevation,Azimuth,\r\n" + "".join(f"{i},0,90,,\r\n" for i in range(1, 17)))
    config = {"source": {"lidar_calibration": {"/pandar": str(file)}}}
    with BagSource([path], Config.model_validate(config)) as source:
        (frame,) = source
    assert np.abs(frame.points[:, 2]).max() == 0
    assert frame.points[0, 0] == pytest.approx(4.0)
    file.write_text("1,0,0\n2,0,0\n")
    for wrong, said in (
        (
            f"{{/pandar: {file}}}",
            "has 2 rows of channel, elevation and azimuth, but the packets are a PandarXT16",
        ),
        (f"{{/pandar: {tmp_path}/none.csv}}", "none.csv: cannot be read: No such file or directory"),
        (
            f"{{/panda: {file}}}",
            "source.lidar_calibration: there is no topic /panda; the nearest are /pandar",
        ),
    ):
        assert main(["info", str(path), "--set", f"source.lidar_calibration={wrong}"]) == 2
        assert said in " ".join(capsys.readouterr().err.split())


def test_a_report_brings_the_sensors_own_angles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made, model = messages(), MODELS_BY_NAME["PandarXT16"]
    stamps = [bags.START + i * bags.PERIOD for i in range(3)]
    found = [packet(model, n) for n in range(4)]
    items = [bags.Item("/front/pandar", SCAN, stamp, scan(made, stamp, found)) for stamp in stamps]
    path = bags.write(tmp_path / "bag", items, made)
    file = tmp_path / "secret_folder" / "angles.csv"
    file.parent.mkdir()
    file.write_text("".join(f"{i},{i / 4},90\n" for i in range(1, 17)))
    there = ["--set", f"source.lidar_calibration={{/front/pandar: {file}}}"]
    report = tmp_path / "bug.rrd"
    assert main(["report", str(path), "--at", "0.1", *there, "-o", str(report)]) == 0
    config = Config.model_validate({"source": {"lidar_calibration": {"/front/pandar": str(file)}}})
    with BagSource([path], config) as source:
        points = next(iter(source)).points
    bag = tmp_path / "bug.mcap"
    with bag.open("rb") as data:  # as another library reads it
        (attached,) = make_reader(data).iter_attachments()
    assert (attached.name, attached.data) == ("lidar_calibration/front/pandar/angles.csv", file.read_bytes())

    shutil.rmtree(file.parent)
    monkeypatch.chdir(tmp_path)
    assert main(["report", "--check", str(report)]) == 0
    assert not any(b"secret_folder" in made.read_bytes() for made in tmp_path.glob("bug.*"))
    whole = bag.read_bytes()
    for end in (len(whole), -30):  # alone, and cut
        bag.write_bytes(whole[:end])
        with BagSource([bag], Config()) as source:
            np.testing.assert_array_equal(next(iter(source)).points, points)


def test_undecodable_packets_state_the_reason() -> None:
    model = MODELS_BY_NAME["PandarXT32"]
    cut = decoded([packet(model, n) for n in range(4)], cut=1600)  # into the second to last
    assert (len(cut.xyz), cut.dropped) == (2 * 8 * 31, 2 * 8 + 2 * 8 * 32)
    mixed = [
        packet(model, 0),
        packet(model, 1, mode=0x38),
        packet(MODELS_BY_NAME["PandarXT16"], 0),
        packet(model, 1),
    ]
    some = decoded([*mixed, packet(model, 2)[:700]])
    assert (len(some.xyz), some.dropped) == (2 * 8 * 31, 2 * 8 + 3 * 8 * 32)
    for found, said in (
        (
            [bytes.fromhex("eeff01048000") + bytes(800)],
            "begin with eeff010480000000.* of no model that is dec",
        ),
        ([packet(model, 0)[:700]], "a packet of 700 bytes is too short for a PandarXT32's 1075"),
        ([packet(model, 0, mode=0x12)], "a PandarXT32 with the return mode 0x12"),
        ([], "there are no packets in it"),
    ):
        with pytest.raises(MessageError, match=f"/packets: not a {SCAN}: .*{said}"):
            decoded(found)
    for end in range(0, 60, 7):
        with pytest.raises(MessageError, match=f"/packets: not a {SCAN}: "):
            LiveMessage("/packets", SCAN, 0, b"\0\1\0\0" + bytes(range(end))).decode()


def test_a_velodyne_scan_equals_its_manual() -> None:
    pytest.importorskip("velodyne_decoder")
    blocks = b""
    for block in range(12):
        blocks += struct.pack("<HH", 0xEEFF, 9000 + 40 * block)
        blocks += b"".join(struct.pack("<HB", 2500, channel % 16) for channel in range(32))
    data = [blocks + struct.pack("<IBB", 1_000_000 + 1327 * n, 0x37, 0x22) for n in range(3)]
    cloud = decoded(data, VELODYNE)
    assert len(cloud.xyz) == 3 * 12 * 32
    assert cloud.stamp == bags.START
    np.testing.assert_allclose(np.linalg.norm(cloud.xyz[:, :2], axis=1).max(), 5.0, atol=0.01)
    assert cloud.xyz[:, 1].max() < -4.7  # 90 degrees and on are at the right
    np.testing.assert_array_equal(np.unique(cloud.fields["ring"]), np.arange(16))
    assert sorted(cloud.fields) == ["intensity", "ring", "time"]
    # The last packet came 2 ms after the header's stamp; to the sensor it is 2 x 1.3 ms after the first.
    np.testing.assert_allclose(np.ptp(cloud.fields["time"]), 3 * 1327e-6, atol=1e-4)
    np.testing.assert_allclose(cloud.fields["time"].min(), 2e-3 - 2 * 1327e-6, atol=1e-4)
    assert len(decoded([*data, data[0][:-1] + b"\x21"], VELODYNE).xyz) == len(cloud.xyz)
    with pytest.raises(MessageError, match="velodyne-decoder does not take the packets"):
        decoded([data[0][:-1] + b"\x77"], VELODYNE)


def test_without_its_library_a_velodyne_says_what_to_install(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(velodyne, "find_spec", lambda name: None)
    made = messages()
    item = bags.Item("/velodyne_packets", VELODYNE, bags.START, scan(made, bags.START, [b""], VELODYNE))
    assert main(["info", str(bags.write(tmp_path / "bag", [item], made))]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "/velodyne_packets holds packets of the sensor, which velodyne-decoder reads: " in said
    assert "pip install 'bevviz[lidars]'" in said
