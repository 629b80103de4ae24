"""What raw points can be coloured by: class ids that are labelled, one view for each, and no point twice."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import rerun as rr
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from rerun.chunk import RrdReader

import bevviz
from bevviz.config import load
from bevviz.config.sections import Quantity
from bevviz.live.encoder import is_cloud, sample_rows, thin_cloud
from bevviz.model.frame import F32, Scene
from bevviz.recording import blueprints
from bevviz.recording.cloud import COMPONENTS, quantity_annotations, quantity_ids
from bevviz.recording.components import Components

QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
XYZ: F32 = np.array([[3.0, 4.0, 0.0], [30.0, 40.0, 0.0], [0.0, 0.0, 1.0]], np.float32)


@cache
def labels() -> dict[int, str]:
    context = quantity_annotations().as_component_batches()[0].as_arrow_array().to_pylist()[0]
    return {one["class_id"]: one["class_description"]["info"]["label"] or "" for one in context}


def said(quantity: Quantity, **fields: NDArray[Any]) -> list[str]:
    found = quantity_ids([quantity], XYZ, np.full(3, 16, np.uint8), fields)[quantity]
    known = labels()
    return [known[number] for number in found.tolist()]


def test_labels_say_the_value() -> None:
    assert said("distance") == ["5 m away", "49 m away", "1 m away"]
    assert said("height") == ["0.0 m high"] * 3
    assert said("ring", ring=np.array([0, 17, 63], np.uint16)) == ["ring 0", "ring 17", "ring 63"]
    assert said("time", t=np.array([7, 50_000_007, 99_999_999], np.uint32)) == [
        "0 % into the scan",
        "50 % into the scan",
        "96 % into the scan",
    ]
    assert said("time", timestamp=1.7e9 + np.array([0.1, 0.0, 0.051])) == [
        "96 % into the scan",
        "0 % into the scan",
        "50 % into the scan",
    ]


@pytest.mark.parametrize("full", [1.0, 255.0, 65535.0])
def test_intensity_is_shown_by_its_own_scale(full: float) -> None:
    values = np.array([0.0, 0.5, 1.0], np.float32) * full
    dark, half, bright = (int(text.split()[1]) for text in said("intensity", intensity=values))
    assert dark == 0
    assert 30 <= half < bright <= 100


def test_a_missing_field_is_reported() -> None:
    assert said("ring") == said("time") == said("intensity") == ["not in this cloud"]


@given(
    values=arrays(np.float32, (3,), elements=st.floats(width=32, allow_nan=True, allow_infinity=True)),
    field=st.sampled_from(["intensity", "time"]),
)
@pytest.mark.filterwarnings("error")
def test_every_id_has_a_label_whatever_the_sensor_sends(values: F32, field: Quantity) -> None:
    assert all(said(field, **{field: values}))


def test_thinned_points_keep_their_colours() -> None:
    points = np.arange(300, dtype=np.float32).reshape(100, 3)
    ids: dict[Quantity, Any] = {
        "ring": np.arange(256, 356, dtype=np.uint16),
        "time": np.array([3], np.uint8),
    }
    cloud = Components(rr.Points3D, {"positions": points}, ids, COMPONENTS)
    assert is_cloud(cloud, 10)
    thinned = {b.component_descriptor().component: b.as_arrow_array() for b in thin_cloud(cloud, 10, 1)}
    rows = sample_rows(100, 10, 1)
    assert thinned["ColorBy:ring"].to_pylist() == (rows + 256).tolist()
    assert thinned["ColorBy:time"].to_pylist() == [3]
    assert thinned["Points3D:positions"].to_pylist() == points[rows].tolist()


def test_a_name_with_half_a_character_is_logged() -> None:
    page = Components(rr.TextDocument, {"text": ["car \ud800"]}, {"says": ["\udcff", "car"]})
    assert [b.as_arrow_array().to_pylist() for b in page.as_component_batches()] == [["car ?"], ["?", "car"]]


def columns(path: Path, entity: str) -> dict[str, int]:
    """Rows of each column of an entity's frames."""
    found: dict[str, int] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and "frame" in batch.schema.names:
            for name in batch.schema.names:
                found[name] = found.get(name, 0) + batch.num_rows
    return found


def test_a_recording_has_points_once_and_requested_fields(tmp_path: Path) -> None:
    with bevviz.simulate(frames=1, seed=1, set={"logging.color_by": ["height", "ring"]}) as drive:
        path = drive.save(tmp_path / "drive.rrd")
        lidar = drive.scene.lidar
    found = columns(path, f"/world/{lidar}/points")
    assert found["Points3D:positions"] == 1
    assert {name for name in found if name.startswith("ColorBy:")} == {"ColorBy:height", "ColorBy:ring"}


def mapped(path: Path) -> dict[str, str]:
    """Of each visualizer of the raw points that a layout names: target -> source."""
    found = {}
    reader = RrdReader(path)
    for chunk in reader.stream(store=reader.blueprints()[0]):
        batch = chunk.to_record_batch()
        for row in batch.to_pylist():
            for one in row.get("VisualizerInstruction:component_map") or ():
                if one["source_component"]:
                    found[one["source_component"]] = one["target"]
    return found


@pytest.mark.parametrize("name", ["debug", "live", "workbench", "workbench_live", "bug_report"])
def test_layouts_have_a_view_for_each_field(name: str, tmp_path: Path) -> None:
    scene, path = Scene("a", "lidar", ("lidar",), ("camera",)), tmp_path / "layout.rbl"
    blueprints.load(name, scene, load()).save("bevviz", str(path))
    assert mapped(path) == {f"ColorBy:{quantity}": "Points3D:class_ids" for quantity in QUANTITIES}
    for setting in ("logging.color_by=[]", "logging.raw_cloud=false", "logging.keep=inspect"):
        blueprints.load(name, scene, load(settings=[setting])).save("bevviz", str(path))
        assert mapped(path) == {}
