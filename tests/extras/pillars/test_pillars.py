"""3D detectors on pillars: held to what OpenPCDet, mmdetection3d and spconv make of the same numbers.

The references are made by ``make_references.py``; what they hold is said there.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from shapely import Polygon

from bevviz.config import Config, config_yaml, load
from bevviz.config.descriptions import describe_parameters
from bevviz.errors import UserError
from bevviz.extras.pillars.group import Pillars, group, scatter
from bevviz.extras.pillars.heads import anchor_boxes, decode_boxes
from bevviz.extras.pillars.network import PROBE_POINTS, PillarNetwork
from bevviz.extras.pillars.params import Feature, PillarParams
from bevviz.extras.pillars.rotated_boxes import survivors
from bevviz.model import geometry
from bevviz.model.frame import Boxes3D
from bevviz.pipeline.perceive import perceive
from bevviz.pipeline.stage_loader import StageLoader
from bevviz.pipeline.stage_log import Memo
from bevviz.workbench.page_messages import controls
from tests.support import kept_drives
from tests.support.onnx_networks import FLOAT, node, save
from tests.support.pillar_networks import (
    HIGH_Z,
    INPUTS,
    LOW,
    REFERENCES,
    SHAPE,
    SIZE,
    Reference,
    autoware,
    network,
    settings_of,
)

HEADS = ("openpcdet_anchors", "openpcdet_centers", "mmdetection3d_anchors", "mmdetection3d_centers")
CLOUD = np.random.default_rng(0).uniform((0, -8, -3), (24, 8, 1), (500, 3)).astype(np.float32)


def params_of(reference: Reference, **changed: Any) -> PillarParams:
    return PillarParams.model_validate({**reference.params, **changed})


def stated_params(config: Config) -> PillarParams:
    return PillarParams.model_validate(config.objects.params)


# --- against others ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", HEADS)
def test_boxes_equal_those_of_the_reference_implementations(name: str, tmp_path: Path) -> None:
    reference = Reference(name)
    boxes, score, names = reference.network(tmp_path / "net.onnx")(CLOUD)

    assert len(boxes) == len(reference.boxes) >= 50
    wanted = [reference.params["classes"][label] for label in reference.label]
    assert sorted(names) == sorted(wanted)
    # Equal scores come in any order: each of theirs is looked for. One box may have several classes.
    rows = np.column_stack([boxes.center, boxes.size])
    for box, its_score, its_name in zip(reference.boxes, reference.score, wanted, strict=True):
        k = int((np.abs(rows - box[:6]).max(axis=1) + (np.array(names) != its_name)).argmin())
        np.testing.assert_allclose(rows[k], box[:6], atol=2e-5)
        np.testing.assert_allclose(score[k], its_score, atol=1e-6)
        assert names[k] == its_name
        assert np.cos(boxes.yaw[k] - box[6]) == pytest.approx(1, abs=1e-6)


def test_pillars_equal_spconv_and_features_equal_openpcdet() -> None:
    with np.load(REFERENCES / "features.npz") as file:
        points, counts, cells, shown = (file[key] for key in ("points", "counts", "cells", "shown"))
    points = points.astype(np.float32)
    names: tuple[Feature, ...] = (
        "x",
        "y",
        "z",
        "intensity",
        "mean_x",
        "mean_y",
        "mean_z",
        "center_x",
        "center_y",
        "center_z",
    )

    xyz, intensity = points[:, :3].copy(), points[:, 3].copy()
    found = group(xyz, LOW, SIZE, SHAPE, HIGH_Z, 4, 300, (*names, "distance"), intensity)

    np.testing.assert_array_equal(found.counts, counts)
    np.testing.assert_array_equal(found.cells, cells)
    np.testing.assert_allclose(found.points, shown, atol=2e-6)
    assert found.left_out_points > 0 and found.left_out_pillars > 0


# --- pillars -----------------------------------------------------------------------------------


def grouped(points: NDArray[np.float32], max_points: int, max_pillars: int) -> Pillars:
    return group(points, LOW, SIZE, SHAPE, HIGH_Z, max_points, max_pillars, ("x", "y", "z"))


@given(st.integers(0, 400), st.integers(1, 8), st.integers(1, 200), st.integers(0, 99))
@settings(max_examples=50, deadline=None)
def test_every_point_is_in_its_pillar_or_counted(
    n: int, max_points: int, max_pillars: int, seed: int
) -> None:
    points = np.random.default_rng(seed).uniform((-2, -9, -4), (8, 0, 2), (n, 3)).astype(np.float32)
    found = grouped(points, max_points, max_pillars)

    low, size = np.array(LOW), np.array(SIZE)
    inside = ((points >= low) & (points < [24, 8, HIGH_Z])).all(axis=1)
    own = np.unique(np.floor((points[inside, :2] - low[:2]) / size[:2]), axis=0)
    assert len(found) == min(len(own), max_pillars)
    assert found.left_out_pillars == len(own) - len(found)
    assert (found.counts >= 1).all() and (found.counts <= max_points).all()
    kept = np.arange(max_points) < found.counts[:, None]
    assert not found.points[~kept].any()
    corner = low[:2] + found.cells * size[:2]
    offset = found.points[..., :2] - corner[:, None]
    assert ((offset >= -1e-5) & (offset <= size[:2] + 1e-5))[kept].all()
    if found.left_out_pillars == 0:
        assert found.counts.sum() + found.left_out_points == inside.sum()


def test_features_of_pillars_are_laid_out_with_x_fastest() -> None:
    cells = np.array([[3, 0], [0, 1]], np.int32)
    canvas = scatter(np.array([[1, 2], [3, 4]], np.float32), cells, (5, 4))
    assert canvas.shape == (1, 2, 4, 5)
    assert canvas[0, :, 0, 3].tolist() == [1, 2] and canvas[0, :, 1, 0].tolist() == [3, 4]
    assert np.count_nonzero(canvas) == 4


# --- boxes -------------------------------------------------------------------------------------


@given(st.integers(0, 999))
@settings(max_examples=20, deadline=None)
def test_a_box_that_is_stated_about_an_anchor_is_found_again(seed: int) -> None:
    anchors = anchor_boxes((4, 6), params_of(Reference("openpcdet_anchors")))
    draw = np.random.default_rng(seed)
    wanted = anchors + draw.uniform(-0.3, 0.3, anchors.shape)
    diagonal = np.hypot(anchors[:, 3], anchors[:, 4])
    deltas = wanted - anchors
    deltas[:, :2] /= diagonal[:, None]
    deltas[:, 2] /= anchors[:, 5]
    deltas[:, 3:6] = np.log(wanted[:, 3:6] / anchors[:, 3:6])
    np.testing.assert_allclose(decode_boxes(deltas, anchors), wanted, atol=1e-9)


@given(st.integers(0, 999))
@settings(max_examples=20, deadline=None)
def test_what_is_suppressed_overlaps_a_better_box_of_its_group(seed: int) -> None:
    draw = np.random.default_rng(seed)
    boxes = draw.uniform((0, 0, 0, 0.5, 0.5, 1, -4), (8, 8, 0, 5, 3, 2, 4), (25, 7))
    classes = draw.integers(0, 2, 25)
    alive = survivors(boxes, classes, 0.2, 0.0)

    flat = Boxes3D(*(part.astype(np.float32) for part in (boxes[:, :3], boxes[:, 3:6], boxes[:, 6])))
    outlines = [Polygon(one[:4, :2]) for one in geometry.corners(flat)]
    for i in range(25):
        over = [
            outlines[i].intersection(outlines[k]).area / outlines[i].union(outlines[k]).area
            for k in np.flatnonzero(alive[:i] & (classes[:i] == classes[i]))
        ]
        assert alive[i] == all(value <= 0.2 for value in over)


def test_centers_that_are_near_suppress_before_areas_do() -> None:
    boxes = np.array([[0, 0, 0, 4, 2, 1, 0], [0.4, 0, 0, 1, 1, 1, 0], [0.6, 0, 0, 0.2, 0.2, 1, 0]])
    same = np.zeros(3, np.int64)
    assert survivors(boxes, same, 1.0, 0.5).tolist() == [True, False, True]
    assert survivors(boxes, np.arange(3), 0.0, 0.5).all()


def test_a_lidar_at_another_height_finds_the_same_boxes_lower(tmp_path: Path) -> None:
    reference = Reference("openpcdet_anchors")
    plain = reference.network(tmp_path / "net.onnx")(CLOUD)[0]
    moved = reference.network(tmp_path / "net.onnx", z_offset=-1.2)(
        CLOUD + np.array([0, 0, 1.2], np.float32)
    )[0]
    np.testing.assert_allclose(moved.center - plain.center, np.tile([0, 0, 1.2], (len(plain), 1)), atol=1e-5)


def test_a_cloud_outside_the_range_has_no_objects(tmp_path: Path) -> None:
    boxes, score, names = Reference("openpcdet_anchors").network(tmp_path / "net.onnx")(CLOUD + 1000)
    assert len(boxes) == len(score) == len(names) == 0


def test_each_class_has_its_threshold(tmp_path: Path) -> None:
    reference = Reference("mmdetection3d_anchors")
    changed = {"score_threshold": 1.0, "score_thresholds": {"Car": 0.3}, "max_objects": 500}
    _, score, names = reference.network(tmp_path / "net.onnx", **changed)(CLOUD)
    assert set(names) == {"Car"} and len(names) > 1
    assert score.min() >= 0.3 and (np.diff(score) <= 0).all()


# --- two files ---------------------------------------------------------------------------------


def test_networks_of_two_files_are_supported(tmp_path: Path) -> None:
    found = network(load(settings=settings_of(autoware(tmp_path))))
    boxes, score, names = found(CLOUD)  # of which the encoder takes the first 40 pillars alone

    assert names == ["PEDESTRIAN"]
    assert score[0] == pytest.approx(1 / (1 + np.exp(-2)))
    # By its node: the centre in cells, sizes as w, l, h, and -yaw - pi/2.
    np.testing.assert_allclose(boxes.center[0], [20.25 * 0.5, 10.5 * 0.5 - 8, -0.5], atol=1e-5)
    np.testing.assert_allclose(boxes.size[0], [4.5, 1.8, 1.6], atol=1e-5)
    assert boxes.yaw[0] == pytest.approx(-0.3 - np.pi / 2, abs=1e-5)
    answered = found.network.infer(CLOUD)
    assert answered.left_out_pillars > 0


# --- configuration -----------------------------------------------------------------------------


def test_the_parameters_are_a_part_of_the_section(tmp_path: Path) -> None:
    reference = Reference("openpcdet_anchors")
    config = load(settings=reference.settings(tmp_path / "net.onnx"))
    params = stated_params(config)
    assert params == params_of(reference)
    (tmp_path / "config.yaml").write_text(config_yaml(config))
    assert stated_params(load(tmp_path / "config.yaml")) == params
    other = load(base=config, settings=["objects.method=other.onnx", "objects.nms_iou=0.5"])
    assert stated_params(other) == params_of(reference, nms_iou=0.5)
    assert load().objects.params == {}


def test_the_page_and_the_command_explain_its_parameters() -> None:
    config = load(settings=settings_of({**Reference("openpcdet_anchors").params, "method": "net.onnx"}))
    shown = {control["key"]: control for control in controls(config)}
    slider = shown["objects.params.score_threshold"]
    assert (slider["kind"], slider["low"], slider["high"], slider["value"]) == ("number", 0, 1, 0.1)
    assert shown["objects.params.nms"]["choices"] == ["all", "group", "class"]
    assert shown["objects.params.point_range"]["kind"] == "list"
    text = describe_parameters("objects.params.nms_iou", config)
    assert "at least 0, at most 1" in text and "'objects: {params: {nms_iou: VALUE}}'" in text


def test_the_configurations_in_the_docs_are_valid(tmp_path: Path) -> None:
    text = (Path(__file__).parents[3] / "docs/extras/pillars.md").read_text()
    blocks = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    first, changes, second = blocks
    (tmp_path / "kitti.yaml").write_text(first)
    (tmp_path / "changes.yaml").write_text(f"objects:\n  params:\n{changes}")
    (tmp_path / "autoware.yaml").write_text(second)
    kitti = stated_params(load([tmp_path / "kitti.yaml", tmp_path / "changes.yaml"]))
    assert kitti.grid == (432, 496) and kitti.labels == "each"
    autoware = stated_params(load(tmp_path / "autoware.yaml"))
    assert autoware.grid == (480, 480)


def test_a_network_is_loaded_once_for_equal_settings(tmp_path: Path) -> None:
    config = load(settings=Reference("openpcdet_anchors").settings(tmp_path / "net.onnx"))
    one, other, third = [
        network(load(base=config, settings=[text]))
        for text in ("objects.score_threshold=0.2", "objects.score_threshold=0.9", "objects.max_pillars=9")
    ]
    assert one.network is other.network is not third.network
    assert len(one(CLOUD)[0]) > len(other(CLOUD)[0]) > 0


@pytest.mark.parametrize(
    ("name", "changed", "words"),
    [
        (
            "openpcdet_anchors",
            {"features": ["x", "y", "z"]},
            "has 4 features of a point, objects.features states 3",
        ),
        ("openpcdet_anchors", {"max_points": 20}, "has 32 points of a pillar, objects.max_points states 20"),
        ("openpcdet_anchors", {"classes": ["Car"]}, "output cls_preds should be [1, 6, 32 / s, 48 / s]"),
        ("openpcdet_anchors", {"rotations": [0]}, "output cls_preds should be [1, 9, 32 / s, 48 / s]"),
        ("openpcdet_anchors", {"voxel_size": [1, 2, 4]}, "by classes, anchors and the 24 x 8 pillars"),
        ("openpcdet_anchors", {"anchor_places": None}, "objects.anchor_places is not set"),
        ("openpcdet_anchors", {"direction_offset": None}, "objects.direction_offset is not set"),
        ("openpcdet_anchors", {"anchors": []}, "no output is called heatmap or hm"),
        ("openpcdet_anchors", {"scores": "probabilities"}, "which are no probabilities"),
        (
            "openpcdet_anchors",
            {"voxel_size": [0.7, 0.5, 4]},
            "makes 34.29 pillars of the 24 m of point_range in x",
        ),
        ("openpcdet_anchors", {"voxel_size": [0.5, 0.5, 1]}, "these are voxels"),
        (
            "openpcdet_anchors",
            {"score_thresholds": {"car": 0.1}},
            "names 'car', which is none of classes: Car",
        ),
        ("openpcdet_anchors", {"point_range": [1, 0, 0, 0, 1, 1]}, "has a low end above its high one"),
        ("openpcdet_centers", {"groups": [["Car"]]}, "must hold the names of classes"),
        ("openpcdet_centers", {"groups": []}, "set objects.groups"),
        ("openpcdet_centers", {"boxes": None}, "objects.boxes is not set: lwh or wlh"),
        ("mmdetection3d_centers", {"rotation": None}, "objects.rotation is not set: sin_cos or cos_sin"),
        ("mmdetection3d_centers", {"groups": []}, "output bbox_pred0 should be [1, 6 or 8, 32 / s, 48 / s]"),
    ],
)
def test_mismatched_parameters_are_one_line(
    name: str, changed: dict[str, Any], words: str, tmp_path: Path
) -> None:
    with pytest.raises(UserError) as caught:
        Reference(name).network(tmp_path / "net.onnx", **changed)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unusable_files_and_pairs_are_one_line(tmp_path: Path) -> None:
    good = autoware(tmp_path)
    for changed, words in (
        ({"method": str(tmp_path / "none.onnx")}, "no such file"),
        ({"encoder": str(tmp_path / "none.onnx")}, "objects.encoder"),
        ({"encoder": ""}, "a network on pillars takes"),
        ({"method": good["encoder"], "encoder": ""}, "without the cell of each pillar it is an encoder"),
        ({"method": good["encoder"]}, "with objects.encoder it should take one map"),
        ({"voxel_size": [1, 1, 4]}, "the grid is 24 pillars in x, 16 in y"),
        ({"min_rotation": {"BUS": 1}}, "names 'BUS'"),
    ):
        with pytest.raises(UserError) as caught:
            network(load(settings=settings_of({**good, **changed})))
        assert words in str(caught.value), changed


def test_probabilities_are_not_passed_through_a_sigmoid_again(tmp_path: Path) -> None:
    reference = Reference("openpcdet_anchors")
    plain = reference.network(tmp_path / "net.onnx")(CLOUD)
    reference.outputs["cls_preds"] = 1 / (1 + np.exp(-reference.outputs["cls_preds"]))
    with pytest.raises(UserError, match=r"set objects\.scores to probabilities"):
        reference.network(tmp_path / "sigmoid.onnx")
    again = reference.network(tmp_path / "sigmoid.onnx", scores="probabilities")(CLOUD)
    np.testing.assert_allclose(again[0].center, plain[0].center, atol=1e-5)


# --- a drive -----------------------------------------------------------------------------------


def test_a_frame_has_its_objects_from_the_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its boxes are tied to clusters, and several configurations on a frame run it once."""
    config = load(settings=Reference("mmdetection3d_anchors").settings(tmp_path / "net.onnx"))
    other = load(base=config, settings=["objects.score_threshold=0.9"])
    frame, loader, memo = kept_drives.frame(0), StageLoader(store=False), Memo()
    stages = [loader.load(each) for each in (config, other)]
    runs, infer = list[int](), PillarNetwork._infer

    def counted(network: PillarNetwork, *cloud: Any) -> Any:
        runs.append(len(cloud[0]))
        return infer(network, *cloud)

    monkeypatch.setattr(PillarNetwork, "_infer", counted)
    one, few = (perceive(frame, *each, memo) for each in zip((config, other), stages, strict=True))

    assert one.failures == few.failures == ()
    assert one.objects is not None and few.objects is not None
    assert len(one.objects.boxes) == 50 and 0 < len(few.objects.boxes) < 50
    assert set(one.objects.names) <= {"Car", "Pedestrian", "Cyclist"}
    assert (few.objects.score >= 0.9).all() and (one.objects.cluster >= 0).any()
    assert one.timings["objects"] > 0 and len(runs) == 1


def test_a_network_that_fails_on_a_cloud_is_a_reason(tmp_path: Path) -> None:
    maps = [np.zeros((1, count, 16, 24), np.float32) - 9 for count in (18, 42, 12)]
    names = ("cls_score0", "bbox_pred0", "dir_cls_pred0")
    shape = np.array([8, 32, 4], np.int64)  # as many pillars as it is shown at first
    nodes = [
        node("Reshape", ["voxels", "shape"], ["reshaped"]),
        node("ReduceSum", ["reshaped"], ["sum"], keepdims=0),
        node("Mul", ["sum", "zero"], ["nothing"]),
        *(node("Add", [f"map_{name}", "nothing"], [name]) for name in names),
    ]
    weights: dict[str, NDArray[Any]] = {"shape": shape, "zero": np.zeros((), np.float32)}
    weights |= {f"map_{name}": value for name, value in zip(names, maps, strict=True)}
    outputs = {name: (value.shape, FLOAT) for name, value in zip(names, maps, strict=True)}
    model = save(tmp_path / "net.onnx", nodes, weights, outputs, INPUTS)
    config = load(
        settings=[
            *Reference("mmdetection3d_anchors").settings(tmp_path / "x.onnx"),
            f"objects.method={model}",
        ]
    )
    frame = kept_drives.frame(0)
    result = perceive(frame, config, StageLoader().load(config))
    (failure,) = result.failures
    assert failure.stage == "objects" and "net.onnx: fails on" in failure.reason
    assert result.objects is None and result.clusters is not None


def test_boxes_are_kept_in_the_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BEVVIZ_STORE", str(tmp_path / "store"))
    settings = Reference("openpcdet_anchors").settings(tmp_path / "net.onnx")
    cloud = np.column_stack([CLOUD, np.zeros(len(CLOUD), np.float32)])

    def found(*more: str) -> Any:
        stage = StageLoader().load(load(settings=[*settings, *more])).objects
        assert stage is not None
        return stage(cloud, 0, 0, "lidar")

    plain, first = found("store.size=0"), found()
    runs, infer = set[int](), PillarNetwork._infer

    def counted(network: PillarNetwork, *cloud: Any) -> Any:
        runs.add(len(cloud[0]))
        return infer(network, *cloud)

    monkeypatch.setattr(PillarNetwork, "_infer", counted)
    again = found()
    assert runs <= {PROBE_POINTS}, "the network runs on the cloud no second time"
    assert len(first[0]) > 1
    for one in (first, again):
        assert one[0].tobytes() == plain[0].tobytes() and one[1].tobytes() == plain[1].tobytes()
        assert list(one[2]) == plain[2]
    assert len(found("objects.score_threshold=0.9")[0]) < len(first[0])
