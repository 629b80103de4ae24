"""Packets of an Ouster, byte by byte as its manual has them, in bags that rosbags writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bevviz.bags.source import BagSource
from bevviz.cli import main
from bevviz.config import Config
from bevviz.errors import UserError
from bevviz.extras.lidars import ouster
from tests.support import bags
from tests.support.ouster_packets import (
    COLUMNS,
    IMU,
    LIDAR,
    METADATA,
    PIXELS,
    bag,
    expected_point,
    metadata,
    millimetres,
)

PROFILES = ("LEGACY", "RNG19_RFL8_SIG16_NIR16", "RNG19_RFL8_SIG16_NIR16_DUAL", "RNG15_RFL8_NIR8")


@pytest.mark.parametrize("profile", PROFILES)
def test_scans_follow_the_manual(tmp_path: Path, profile: str) -> None:
    form = "ros1" if profile == "LEGACY" else "mcap"
    path = bag(
        tmp_path / ("bag.bag" if form == "ros1" else "bag"),
        profile,
        told=metadata(profile, nested=profile != "LEGACY"),
        form=form,
    )
    with BagSource([path], Config()) as source:
        assert source.roles.notes[LIDAR] == "LiDAR, by type and name"
        assert source.roles.notes[METADATA] == "metadata of the LiDAR"
        assert source.total == 4
        frames = list(source)
        again = source.frame(2)
    there = [(c, p) for c in range(COLUMNS) for p in range(PIXELS) if millimetres(c, p)]
    for number, frame in enumerate(frames):
        assert frame.stamp == bags.START + number * bags.PERIOD
        assert frame.points_frame == "os_lidar"
        np.testing.assert_allclose(frame.points, [expected_point(*beam) for beam in there], atol=1e-5)
        np.testing.assert_array_equal(frame.fields["ring"], [pixel for _, pixel in there])
        np.testing.assert_array_equal(frame.fields["reflectivity"], [40 + pixel for _, pixel in there])
        signal = 40 if profile == "RNG15_RFL8_NIR8" else 500
        np.testing.assert_array_equal(frame.fields["intensity"], [signal + pixel for _, pixel in there])
        np.testing.assert_allclose(frame.fields["time"], [column * 1e-3 for column, _ in there], atol=1e-7)
        assert frame.clouds[0].dropped == COLUMNS * PIXELS - len(there)
    assert again is not None and again.stamp == frames[2].stamp
    np.testing.assert_array_equal(again.points, frames[2].points)


def test_lost_and_reordered_packets_are_handled(tmp_path: Path) -> None:
    told = metadata("RNG15_RFL8_NIR8")
    # The second packet is lost, and the last one of the second scan comes after the third has begun.
    path = bag(tmp_path / "bag", told=told, clock=5_000_000_000, order=(0, 2, 3, 4, 5, 6, 8, 7, 9, 10, 11))
    with BagSource([path], Config()) as source:
        frames = list(source)
    sizes = [len(frame.points) for frame in frames]
    assert sizes[0] < sizes[2] > sizes[1] and len(sizes) == 3
    assert [frame.clouds[0].dropped for frame in frames] == [COLUMNS * PIXELS - size for size in sizes]
    assert [frame.stamp for frame in frames] == [
        bags.START + at for at in (16_000_000, 64_000_000, bags.PERIOD + 48_000_000)
    ]


def test_a_part_of_a_bag_has_the_same_scans(tmp_path: Path) -> None:
    path = bag(tmp_path / "bag", told=metadata("RNG15_RFL8_NIR8"), scans=8)
    with BagSource([path], Config()) as source:
        stamps = [frame.stamp for frame in source]
    with BagSource([path], Config(), start="0.2", end="0.6") as source:
        assert [frame.stamp for frame in source] == stamps[2:6]
    with BagSource([path], Config(), frames=(3, 5)) as source:
        assert [frame.stamp for frame in source] == stamps[3:5]


def test_metadata_may_be_a_file_and_are_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, file = bag(tmp_path / "bag"), tmp_path / "sensor.json"
    assert main(["info", str(path)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "packets of an Ouster without its metadata: record its metadata topic" in said
    assert f"{IMU}: not used: packets of an Ouster's IMU" in said
    option = f"source.lidar_calibration={{{LIDAR}: {file}}}"
    for text, why in (
        (None, "cannot be read: No such file"),
        ("{}", "is not the metadata (JSON) of an Ouster"),
        (metadata("RNG99"), "an Ouster with packets of the profile RNG99, which is not decoded here"),
    ):
        if text is not None:
            file.write_text(text)
        assert main(["info", str(path), "--set", option]) == 2
        assert why in " ".join(capsys.readouterr().err.split())
    file.write_text(metadata("RNG15_RFL8_NIR8"))
    assert main(["info", str(path), "--set", option]) == 0
    assert f"{LIDAR}: LiDAR, by type and name" in capsys.readouterr().out


def test_other_json_messages_are_no_metadata() -> None:
    for text in ("", "[]", '"a"', '{"beam_intrinsics": 5}', metadata("LEGACY").replace("64", "0")):
        with pytest.raises(UserError, match="here: is not the metadata"):
            ouster.read_sensor(text, "here")
