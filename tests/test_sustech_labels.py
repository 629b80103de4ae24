"""Labels of SUSTechPOINTS beside the clouds of a folder are its ground truth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import bevviz
from bevviz.datasets.sustech_labels import read_labels
from bevviz.errors import UserError


def test_labels_of_a_shenzhen_street_are_ground_truth(shared: Path) -> None:
    with bevviz.open(shared / "sus") as drive:
        truths = [frame.truth for frame in drive.frames]
    counts = []
    for truth in truths:
        assert truth is not None
        counts.append(len(truth.boxes))
    assert counts == [19, 21, 23, 24]
    first = truths[0]
    assert first is not None
    assert first.labels[:3] == ("Car", "Bus", "Rider") and first.ids[0] == "8"
    assert first.boxes.center[0].tolist() == pytest.approx([4.145, -49.720, 1.831], abs=1e-3)
    assert first.boxes.size[0].tolist() == pytest.approx([4.5, 1.679, 1.657], abs=1e-3)
    assert float(first.boxes.yaw[0]) == pytest.approx(1.449, abs=1e-3)


def test_labels_numbered_apart_from_their_clouds_are_told(tmp_path: Path) -> None:
    """Clouds count from 0 and labels from 1, so that all labels but the last are of another cloud."""
    for folder in ("lidar", "label"):
        (tmp_path / folder).mkdir()
    places = {key: {"x": 4, "y": 2, "z": 1} for key in ("position", "scale", "rotation")}
    for number in range(3):
        np.save(tmp_path / f"lidar/{number:06d}.npy", np.ones((5, 4), np.float32))
        label = tmp_path / f"label/{number + 1:06d}.json"
        label.write_text(json.dumps([{"psr": places, "obj_type": "Car"}]))
    with bevviz.open(tmp_path) as drive:
        assert [frame.truth is not None for frame in drive.frames] == [False, True, True]
        said = f"{tmp_path.name}: label/000003.json: not read: no cloud has this name"
        assert said in drive.warnings


def test_a_label_without_its_class_is_refused_with_its_file(tmp_path: Path) -> None:
    corner = {"x": 0, "y": 0, "z": 0}
    file = tmp_path / "000001.json"
    file.write_text(f'[{{"psr": {{"position": {corner}, "scale": {corner}}}}}]'.replace("'", '"'))
    with pytest.raises(UserError, match=r"000001\.json: no boxes with psr and obj_type"):
        read_labels(file)


def test_rotations_in_degrees_are_refused(tmp_path: Path) -> None:
    file, corner = tmp_path / "000001.json", {"x": 0, "y": 0, "z": 0}
    psr = {"position": corner, "scale": corner, "rotation": {**corner, "z": 90}}
    file.write_text(json.dumps([{"psr": psr, "obj_type": "Car"}]))
    with pytest.raises(UserError, match=r"000001\.json: a rotation of 90 is no angle in radians"):
        read_labels(file)
