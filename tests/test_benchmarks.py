"""The benchmark's own parts: a ratio is worth as much as the comparison behind it."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import accuracy, anomalies, calib, ground, ideal, kitti, large, performance, rigs, size
from benchmarks.bags import repeat
from benchmarks.measure import interleaved, run
from benchmarks.pages import write_section
from benchmarks.robot import transforms_of
from benchmarks.runs import counted, logged_points
from benchmarks.stages import same_clusters, side_by_side
from bevviz.bags.bag import Recording
from bevviz.cli import main
from bevviz.messages.definitions import typestore
from bevviz.stages.clustering import dbscan
from tests.support import bags

pytestmark = pytest.mark.long


def test_a_repeated_bag_goes_on_in_time(tmp_path: Path) -> None:
    folder = bags.write(tmp_path / "drive", bags.small_items(scans=5))
    drive = next(folder.glob("*.mcap"))
    longer = repeat(drive, tmp_path / "longer", 3 * drive.stat().st_size)
    with Recording([longer]) as recording:
        times = recording.times(bags.CLOUD)
        stamps = [message.header()[0] for message in recording.messages([bags.CLOUD])]
        poses = [recording.decode(m).transforms[0].header.stamp.sec for m in recording.messages(["/tf"])]
    assert len(times) == 15
    np.testing.assert_array_equal(np.diff(stamps), bags.PERIOD)
    np.testing.assert_array_equal(np.diff(times), bags.PERIOD)
    assert poses == sorted(poses)
    assert poses[-1] == stamps[-1] // 10**9


def test_every_point_of_a_bag_is_counted_in_its_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = bags.write(tmp_path / "drive", bags.small_items(scans=3, points=500))
    scans, points, received = counted(folder)
    assert (scans, points) == (3, 1500)
    assert np.diff(received).tolist() == [bags.PERIOD, bags.PERIOD]
    assert main(["bag", str(folder), "--save", "whole.rrd"]) == 0
    assert logged_points(Path("whole.rrd")) == 1500
    assert main(["bag", str(folder), "--frames", ":2", "--save", "part.rrd"]) == 0
    assert logged_points(Path("part.rrd")) == 1000


def test_the_robot_of_the_soak_writes_transforms_as_ros_does() -> None:
    values = [1.0, 2.0, 3.0, 0.0, 0.0, 0.6, 0.8]
    data = transforms_of(7_000_000_001, [("map", "base_link", values), ("base_link", "lidar", values)])
    message: Any = typestore().deserialize_cdr(data, "tf2_msgs/msg/TFMessage")
    assert [(t.header.frame_id, t.child_frame_id) for t in message.transforms] == [
        ("map", "base_link"),
        ("base_link", "lidar"),
    ]
    for transform in message.transforms:
        assert (transform.header.stamp.sec, transform.header.stamp.nanosec) == (7, 1)
        assert transform.transform.translation.z == 3.0
        assert transform.transform.rotation.w == 0.8


def test_clusters_are_equal_up_to_their_numbers() -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.normal(at, 0.2, (200, 3)) for at in (0, 5, 10)]).astype(np.float32)
    labels = dbscan(points, 0.5, 50)
    assert labels.max() == 2
    renamed = np.where(labels < 0, -1, (labels + 1) % 3).astype(np.int32)
    assert same_clusters(points, labels, renamed)
    merged = np.minimum(labels, 1).astype(np.int32)
    assert not same_clusters(points, labels, merged)
    assert not same_clusters(points, merged, labels)
    lost = labels.copy()
    lost[0] = -1
    assert not same_clusters(points, labels, lost)


def test_scans_side_by_side_are_no_denser_than_one() -> None:
    scan = np.random.default_rng(0).uniform(-100, 100, (400, 3)).astype(np.float32)
    points = side_by_side([scan], 1000)
    assert len(points) == 1000
    np.testing.assert_array_equal(points[400:800, [0, 2]], scan[:, [0, 2]])
    assert points[400:800, 1].min() > points[:400, 1].max()


def test_interleaved_sides_take_turns() -> None:
    said: list[str] = []
    times = interleaved(2, lambda: said.append("a"), lambda: said.append("b"))
    assert "".join(said) == "ab" + "abab"
    assert [len(t.all) for t in times] == [2, 2]
    assert all(t.best <= t.median for t in times)


def test_a_program_that_fails_ends_the_benchmark() -> None:
    with pytest.raises(SystemExit, match=r"(?i)unknown option"):
        run("python", "--no-such-option")


def test_memory_is_that_of_the_program_alone() -> None:
    mine = np.ones(40_000_000)  # 320 MB, which a child that is forked has for a moment
    small = run("python", "-c", "import time; time.sleep(0.3)")
    large = run("python", "-c", "import time; held = bytearray(b'1') * 200_000_000; time.sleep(0.3)")
    assert small.memory < 100 < 200 < large.memory < 300
    assert mine.all()


def test_a_section_replaces_only_its_older_version(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# Title\n\n## One\n\nold\n\n## Two\n\nkept\n")
    write_section(page, "## One\n\nnew\n")
    assert page.read_text() == "# Title\n\n## One\n\nnew\n\n## Two\n\nkept\n"
    write_section(page, "## Three\n\nlast\n")
    assert page.read_text().endswith("kept\n\n## Three\n\nlast\n")


def test_the_page_has_a_section_for_each_benchmark() -> None:
    page = (Path(__file__).parents[1] / "benchmarks/RESULTS.md").read_text()
    for module in (calib, performance):
        assert page.count(module.BEGIN) == page.count(module.END) == 1
    headings = [text.strip().splitlines()[0] for text in (ideal.HEADING, accuracy.SYNTHETIC, anomalies.INTRO)]
    headings.append(rigs.INTRO.splitlines()[0])
    sources = (inspect.getsource(module) for module in (kitti, size, large, ground))
    headings += [heading for source in sources for heading in re.findall(r'"(## [^"\n]+)', source)]
    assert len(headings) == 8
    for heading in headings:
        assert page.count(f"\n{heading}\n") == 1, heading


def test_targets_are_kept_off_the_page() -> None:
    assert (
        performance.without_target("| a | b | 1 s | 2 s | 2 x | 3 x | same |")
        == "| a | b | 1 s | 2 s | 2 x | same |"
    )
