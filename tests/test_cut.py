"""Command ``bevviz cut``, held against rosbags' own reader."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader

import bevviz
from bevviz.cli import main
from tests.support import bags, datasets


def messages(path: Path) -> list[tuple[str, int, bytes]]:
    with AnyReader([path]) as reader:
        return [(connection.topic, time, bytes(data)) for connection, time, data in reader.messages()]


def test_a_window_with_chosen_topics_is_byte_for_byte(tmp_path: Path) -> None:
    drive = bags.write(tmp_path / "drive", bags.small_items())
    part = tmp_path / "part.mcap"
    command = ["cut", str(drive), "-o", str(part), "--start", "1", "--end", "2", "--topics", "/velo*"]
    assert main(command) == 0
    cut = messages(part)
    start = bags.START + 10**9
    inside = [row for row in messages(drive) if row[0] == bags.CLOUD and start <= row[1] < start + 10**9]
    assert [row for row in cut if row[0] == bags.CLOUD] == inside and len(inside) == 10
    counts = Counter(topic for topic, *_ in cut)
    assert counts["/tf_static"] == 1 and counts["/tf"] > 0 and bags.IMAGE not in counts
    with bevviz.open(part) as again:
        assert len(again) == 10 and again.raw(5).world_from_points is not None


def test_a_data_set_becomes_a_bag(tmp_path: Path) -> None:
    root, part = datasets.kitti_tracking(tmp_path / "training"), tmp_path / "part.mcap"
    assert main(["cut", str(root), "--sequence", "0000", "-o", str(part)]) == 0
    with bevviz.open(root, set={"source.sequence": "0000"}) as source, bevviz.open(part) as again:
        assert len(again) == len(source)
        assert (again.raw(1).points == source.raw(1).points).all()
        assert again.raw(1).truth is not None


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["-o", "part.db3"], "expected a file name that ends in .mcap"),
        (["-o", "part.mcap", "--start", "90"], "no message from 90 to its end: the drive has 2.9 s"),
        (["-o", "part.mcap", "--topics", "/nothing"], "--topics /nothing: no topic fits among"),
    ],
)
def test_a_wrong_cut_is_one_line(
    tmp_path: Path, options: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = bags.write(tmp_path / "drive", bags.small_items())
    assert main(["cut", str(drive), options[0], str(tmp_path / options[1]), *options[2:]]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / options[1]).exists()
