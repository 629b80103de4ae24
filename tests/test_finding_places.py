"""Every place that counts what went wrong counts the same, with and without ground truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from bevviz.extras.demo.bag import write_bag
from bevviz.extras.demo.drive import SyntheticSource
from tests.support.finding_places import FindingPlaces


def synthetic(path: Path, frames: int, seed: int, *, truth: bool) -> Path:
    source = SyntheticSource(frames, seed)
    write_bag(source, path, source if truth else (replace(frame, truth=None) for frame in source))
    return path


@pytest.mark.parametrize(
    ("truth", "kinds"),
    [
        pytest.param(True, {"missed"}, id="truth"),
        pytest.param(False, {"unmatched", "unnamed"}, id="without", marks=pytest.mark.long),
    ],
)
def test_all_places_count_the_same(truth: bool, kinds: set[str], tmp_path: Path) -> None:
    drive = synthetic(tmp_path / "drive.mcap", 3, 5, truth=truth)
    # Fewer detections and objects leave more to find.
    settings = ("detector.conf_threshold=0.5", "fusion.min_rating=0.4")
    places = FindingPlaces(drive, "demo", tmp_path / "runs", settings)
    assert places.has_truth == truth
    listed = places.listed()
    assert kinds <= {kind for _, kind in listed}
    assert places.disagreements() == {}


@pytest.mark.long
@pytest.mark.parametrize("name", ["kitti", "kitti_drive"])
def test_all_places_count_the_same_of_real_drives(name: str, shared: Path, tmp_path: Path) -> None:
    places = FindingPlaces(shared / name, str(shared / "models/yolox_nano.onnx"), tmp_path / "runs")
    assert places.has_truth == (name != "kitti_drive")
    assert places.listed()
    assert places.disagreements() == {}
