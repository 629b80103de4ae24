"""The planted faults: real geometry, in the ground truth, and it fools the preset that it is said to fool."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bevviz.cli import main
from bevviz.errors import UserError
from bevviz.extras.demo import command
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.extras.demo.faults import FAULTS, SENSOR_FAULTS
from bevviz.model.frame import I32
from bevviz.model.results import Decision
from tests.support.planted_faults import at, drive, planted, run


def clusters_on(name: str, preset: str, row: int) -> I32:
    """Labels of the obstacle points on an object, noise included."""
    result, shot = run(name, preset), at(name)
    assert result.voxels is not None and result.ground is not None and result.clusters is not None
    voxel = np.unique(result.voxels.inverse[shot.point_object == shot.truth_object[row]])
    obstacle = np.cumsum(~result.ground.mask) - 1
    labels: I32 = result.clusters.labels[obstacle[voxel[~result.ground.mask[voxel]]]]
    return labels


@pytest.mark.long
def test_the_hidden_person_is_there_and_nobody_sees_it() -> None:
    (row,) = planted("hidden_person", "person", 16.3)
    shot = at("hidden_person")
    assert shot.truth_hits[row] == 0
    assert not (shot.pixel_object == shot.truth_object[row]).any()
    (van,) = planted("hidden_person", "car", 11.9)
    assert shot.truth_hits[van] > 1000


@pytest.mark.long
def test_the_flat_car_is_ground_for_one_plane_only() -> None:
    (row,) = planted("flat_car", "car", 10.0)
    truth = at("flat_car").frame.truth
    assert truth is not None and truth.boxes.size[row, 2] < 0.55
    assert at("flat_car").truth_hits[row] > 200
    assert (clusters_on("flat_car", "default", row) >= 0).sum() > 100
    assert not (clusters_on("flat_car", "reference", row) >= 0).any()


@pytest.mark.parametrize("preset", ["lidar", "reference"])
def test_the_two_people_are_one_cluster(preset: str) -> None:
    rows = planted("merged_people", "person", 9.9)
    assert len(rows) == 2
    one, other = (set(clusters_on("merged_people", preset, row)) - {-1} for row in rows)
    assert one == other and len(one) == 1


def test_the_box_names_two_clusters_in_the_reference() -> None:
    (row,) = planted("shared_box", "person", 8.7)
    result = run("shared_box", "reference")
    fusion, clusters = result.cameras[0].fusion, result.clusters
    assert fusion is not None and clusters is not None
    own = int(np.bincount(clusters_on("shared_box", "reference", row)).argmax())
    behind = int(np.argmin(np.hypot(*(clusters.centroid[:, :2] - (10.0, -3.9)).T)))
    assert behind != own and np.hypot(*(clusters.centroid[behind, :2] - (10.0, -3.9))) < 0.5
    assert fusion.cluster_decision[[own, behind]].tolist() == [Decision.MATCHED] * 2
    assert fusion.cluster_detection[own] == fusion.cluster_detection[behind]


def test_faults_leave_the_rest_of_the_drive_unchanged() -> None:
    plain, changed = SyntheticSource(frames=75).world, drive().world
    there = {(a.s, a.lateral) for a in changed.actors}
    gone = [a for a in plain.actors if (a.s, a.lateral) not in there]
    assert 0 < len(gone) < 20
    assert all(-6.4 < a.lateral < 0 for a in gone)
    numbers = {(a.s, a.lateral): a.number for a in plain.actors}
    known = [a for a in changed.actors if (a.s, a.lateral) in numbers]
    assert all(a.number == numbers[a.s, a.lateral] for a in known)
    assert len({a.number for a in changed.actors}) == len(changed.actors)


@pytest.mark.parametrize(
    ("name", "frames", "message"),
    [
        ("flat_cat", 75, "plant flat_cat: unknown; did you mean 'flat_car'"),
        ("x", 75, "unknown; there are hidden_person, "),
        ("flat_car", 20, "it is seen after 3 s and the drive has 1.9 s; give it more frames"),
    ],
)
def test_an_impossible_fault_is_one_line(name: str, frames: int, message: str) -> None:
    with pytest.raises(UserError, match=message):
        SyntheticSource(frames, plant=[name])


@pytest.mark.long
def test_demo_teaches_and_plants_every_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    taught = [line.split()[0] for line in command.PLANTS.splitlines() if line.startswith("  ")]
    assert taught == [*FAULTS, *SENSOR_FAULTS]
    monkeypatch.chdir(tmp_path)
    assert main(["demo", "--frames", "11", "--plant", "hidden_person", "-o", "a.mcap"]) == 0
    capsys.readouterr()
    why = ["why", "a.mcap", "--at", "1", "--class", "person", "--model", "demo", "--preset", "reference"]
    assert main([*why, "--limit", "1"]) == 0
    said = capsys.readouterr().out
    listed = said[said.index("out of the sensors' sight") :]
    (row,) = planted("hidden_person", "person", 16.3)
    boxes = at("hidden_person").frame.truth
    assert boxes is not None
    distance = float(np.hypot(*boxes.boxes.center[row, :2]))
    assert f"The person at {distance:.1f} m was not reported" in listed
    assert main(["demo", "--frames", "11", "--plant", "flat_car", "-o", "b.mcap"]) == 2
    assert "give it more frames" in capsys.readouterr().err
