"""The detector on networks made to measure, and on YOLOX-nano and a KITTI image."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from bevviz.config import DetectorConfig
from bevviz.errors import UserError
from bevviz.model.frame import U8
from bevviz.model.geometry import iou
from bevviz.model.results import Detections, DetectionState
from bevviz.stages.detector import COCO, Detector, nms
from bevviz.stages.detector.names import COCO_CATEGORIES
from tests.support import onnx_networks
from tests.support.onnx_networks import (
    CELLS,
    FLOAT,
    FLOAT16,
    INT64,
    UINT8,
    H,
    W,
    answer,
    constant,
    head,
    image_input,
    node,
    save,
)

KEPT, BELOW, SUPPRESSED = DetectionState.KEPT, DetectionState.BELOW_THRESHOLD, DetectionState.SUPPRESSED
NAMES = {"names": "{0: 'car', 1: 'person', 2: 'cyclist'}"}
ULTRALYTICS = {**NAMES, "author": "Ultralytics", "task": "detect", "head": "Detect"}
IMAGE = np.zeros((H, W, 3), np.uint8)  # of the input's size: boxes come back as they are, less half a pixel

LAYOUTS = ("YOLOv8", "YOLOv5", "YOLOv6", "YOLOX", "YOLOX decoded", "end-to-end")


def to_input(layout: str, boxes: NDArray[Any], width: int, height: int) -> NDArray[Any]:
    """Boxes of an image of that size in the pixels of the network's input."""
    ratio = min(W / width, H / height)
    if "YOLOX" in layout:
        inner, offset = (int(width * ratio), int(height * ratio)), (0, 0)
    else:
        inner = (round(width * ratio), round(height * ratio))
        offset = ((W - inner[0]) // 2, (H - inner[1]) // 2)
    edges = boxes + 0.5  # networks count pixels from the corner of the first one
    return np.asarray(edges * np.tile([inner[0] / width, inner[1] / height], 2) + np.tile(offset, 2))


def detector(model: str, **options: Any) -> Detector:
    return Detector(DetectorConfig(model=model, threads=1, **options))


BOXES = np.array([[20.0, 30, 60, 90], [100, 10, 180, 50], [5, 100, 55, 119]])
SCORES = np.array([0.5, 0.8, 0.7])
CLASSES = np.array([2, 0, 1])


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize(("width", "height"), [(192, 128), (200, 120), (193, 131), (W, H * 2)])
def test_every_layout_gives_its_boxes_in_image_pixels(
    layout: str, width: int, height: int, tmp_path: Path
) -> None:
    boxes = BOXES * ([width / 200, height / 120] * 2)
    output = head(layout, to_input(layout, boxes, width, height), SCORES, CLASSES)
    found = detector(constant(tmp_path / "model.onnx", output, metadata=NAMES))
    assert str(found.layout) == layout
    assert found.names == ("car", "person", "cyclist")
    result = found(np.zeros((height, width, 3), np.uint8))
    order = np.argsort(-SCORES)
    np.testing.assert_allclose(result.xyxy, boxes[order], atol=0.01)
    np.testing.assert_allclose(result.score, SCORES[order], atol=1e-6)
    np.testing.assert_array_equal(result.class_id, CLASSES[order])
    assert result.names == tuple(found.names[c] for c in CLASSES[order])
    assert (result.state == KEPT).all()
    assert result.xyxy.dtype == result.score.dtype == result.overlap.dtype == np.float32
    assert result.class_id.dtype == result.state.dtype == result.suppressed_by.dtype == np.int32


def color_network(path: Path, layout: str) -> str:
    """Save a network whose class c in a cell of 8 x 8 pixels is the mean of channel c there."""
    scale = 1.0 if layout == "YOLOv8" else 1 / 255
    cells = (H // 8) * (W // 8)
    y, x = np.indices((H // 8, W // 8)).reshape(2, 1, -1).astype(np.float32)
    weights: dict[str, NDArray[Any]] = {"shape": np.array([1, 3, -1]), "scale": np.array([scale], np.float32)}
    nodes = [
        node("AveragePool", ["images"], ["pooled"], kernel_shape=[8, 8], strides=[8, 8]),
        node("Reshape", ["pooled", "shape"], ["flat"]),
        node("Mul", ["flat", "scale"], ["scores"]),
    ]
    inputs = [image_input(1, 3, H, W)]
    if layout == "YOLOv8":
        weights["boxes"] = np.stack([x * 8 + 4, y * 8 + 4, x * 0 + 8, x * 0 + 8], axis=1)
        nodes.append(node("Concat", ["boxes", "scores"], ["output0"], axis=1))
        return onnx_networks.save(path, nodes, weights, {"output0": ([1, 7, cells], FLOAT)}, inputs, NAMES)
    half, zero = np.full_like(x, 0.5), np.zeros_like(x)
    weights["boxes"] = np.stack([half, half, zero, zero, zero + 1], axis=1)
    weights["coarse"] = np.zeros((1, 8, CELLS - cells), np.float32)  # nothing at strides 16 and 32
    nodes.append(node("Concat", ["boxes", "scores"], ["fine"], axis=1))
    nodes.append(node("Concat", ["fine", "coarse"], ["rows"], axis=2))
    nodes.append(node("Transpose", ["rows"], ["output0"], perm=[0, 2, 1]))
    return onnx_networks.save(path, nodes, weights, {"output0": ([1, CELLS, 8], FLOAT)}, inputs)


@pytest.mark.parametrize(("layout", "channel"), [("YOLOv8", 0), ("YOLOX", 2)])
def test_the_network_sees_the_right_colours_at_the_right_place(
    layout: str, channel: int, tmp_path: Path
) -> None:
    see = detector(color_network(tmp_path / "colors.onnx", layout), conf_threshold=0.9)
    image = np.zeros((80, 192, 3), np.uint8)  # halved, with a border of 24 rows below, or 12 on either side
    cells_above = 12 if layout == "YOLOv8" else 0
    top, left = 2 * (24 - cells_above), 64
    image[top : top + 16, left : left + 32, 2] = 255  # red
    result = see(image)
    red = np.flatnonzero(result.state == KEPT)
    assert set(result.class_id[red]) == {channel}
    found = np.concatenate([result.xyxy[red, :2].min(axis=0), result.xyxy[red, 2:].max(axis=0)])
    np.testing.assert_allclose(found, [left - 0.5, top - 0.5, left + 31.5, top + 15.5], atol=0.01)


def test_the_border_is_grey(tmp_path: Path) -> None:
    see = detector(color_network(tmp_path / "colors.onnx", "YOLOX"), explain_threshold=0.01)
    result = see(np.zeros((32, 96, 3), np.uint8))
    assert len(result) == 0, "boxes of the border are outside the image"
    blob, _ = see.prepare(np.zeros((32, 96, 3), np.uint8))
    assert blob.shape == (1, 3, H, W)
    assert (blob[:, :, :32] == 0).all()
    assert (blob[:, :, 32:] == 114).all()


@settings(max_examples=40, deadline=None)
@given(
    width=st.integers(1, 4000),
    height=st.integers(1, 4000),
    layout=st.sampled_from(["YOLOv8", "YOLOX"]),
)
def test_boxes_map_back_for_images_of_any_size(
    width: int, height: int, layout: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    if max(width / height / (W / H), height * W / H / width) > 60:
        return  # less than a pixel wide in the network's input
    whole = np.array([[-0.5, -0.5, width - 0.5, height - 0.5]])
    output = head(layout, to_input(layout, whole, width, height), SCORES[:1], CLASSES[:1])
    path = tmp_path_factory.mktemp("whole") / "model.onnx"
    result = detector(constant(path, output))(np.zeros((height, width, 3), np.uint8))
    np.testing.assert_allclose(result.xyxy, whole, atol=1e-4 * max(width, height))


def test_float16_and_dynamic_sizes_are_supported(tmp_path: Path) -> None:
    rows = np.zeros((1, 7, 8400), np.float16)
    rows[0, :, 3] = 320, 200, 64, 32, 0, 0.75, 0
    inputs = (image_input("batch", 3, "height", "width", kind=FLOAT16),)
    see = detector(constant(tmp_path / "half.onnx", rows, inputs=inputs))
    assert see.input_size == (640, 640)
    assert str(see.layout) == "YOLOv8"
    result = see(np.zeros((360, 640, 3), np.uint8))
    # 360 rows are padded to 384, not to 640: 12 above.
    np.testing.assert_allclose(result.xyxy, [[287.5, 171.5, 351.5, 203.5]], atol=0.01)
    assert result.names == ("class_1",)


def test_metadata_states_the_input_size_of_the_training(tmp_path: Path) -> None:
    rows = np.zeros((1, 7, CELLS), np.float32)
    meta = {"imgsz": f"[{H}, {W}]", "stride": "32"}
    inputs = (image_input("b", 3, "h", "w"),)
    assert detector(constant(tmp_path / "m.onnx", rows, inputs=inputs, metadata=meta)).input_size == (H, W)


# --- non-maximum suppression -------------------------------------------------------------------

some_boxes = st.lists(
    st.tuples(st.floats(0, 60), st.floats(0, 60), st.floats(4, 40), st.floats(4, 40), st.integers(0, 1)),
    min_size=1,
    max_size=25,
)


@settings(deadline=None)
@given(some_boxes, st.floats(0.1, 0.9))
@example([(0, 0, 4, 4, 0), (0, 0, 4, 40, 0)], 0.1)  # their IoU is the float32 that is next to 0.1, and above
def test_nms_equals_its_definition(rows: list[tuple[float, ...]], threshold: float) -> None:
    table = np.array(rows, np.float32)
    boxes = np.hstack([table[:, :2], table[:, :2] + table[:, 2:4]])
    classes = table[:, 4].astype(np.int32)
    suppressor, overlap = nms(boxes, classes, threshold)
    value = iou(boxes, boxes)
    survivors: list[int] = []
    for i in range(len(boxes)):
        rivals = [j for j in survivors if classes[i] == classes[j] and float(value[j, i]) > threshold]
        assert suppressor[i] == (rivals[0] if rivals else -1)
        assert overlap[i] == (pytest.approx(value[rivals[0], i]) if rivals else 0)
        if not rivals:
            survivors.append(i)


@settings(deadline=None)
@given(st.integers(0, 10_000), st.floats(0.2, 0.8))
def test_nms_rounds_as_the_exporters_do(seed: int, threshold: float) -> None:
    """Against torchvision's loop on boxes moved by their class, all in float32."""
    rng = np.random.default_rng(seed)
    low = rng.uniform(0, 20, (40, 2))
    boxes = np.hstack([low, low + rng.uniform(3, 9, (40, 2))]).astype(np.float32)
    classes = rng.choice([3, 77, 79], 40).astype(np.int32)
    suppressor, _ = nms(boxes, classes, threshold, 7680)
    moved = boxes + (classes * np.float32(7680)).astype(np.float32)[:, None]
    area = (moved[:, 2] - moved[:, 0]) * (moved[:, 3] - moved[:, 1])
    gone = np.zeros(40, bool)
    for i in range(40):
        for j in range(i + 1, 40):
            side = np.minimum(moved[i, 2:], moved[j, 2:]) - np.maximum(moved[i, :2], moved[j, :2])
            shared = np.prod(np.maximum(side, np.float32(0)))
            if not gone[i] and shared / (area[i] + area[j] - shared) > threshold:
                gone[j] = True
    np.testing.assert_array_equal(suppressor >= 0, gone)


@pytest.mark.parametrize(("layout", "states"), [("YOLOv8", [KEPT, SUPPRESSED]), ("YOLOX", [KEPT, KEPT])])
def test_classes_are_kept_apart_as_each_family_does(layout: str, states: list[int], tmp_path: Path) -> None:
    """An IoU of 0.4496, which Ultralytics' offset of 79 x 7680 pixels rounds above 0.45."""
    boxes = np.array([[6, 5.375, 14.125, 20], [3.72, 2.298, 16.427, 23.098]])
    scores, classes = np.array([0.9, 0.8]), np.array([79, 79])
    model = constant(tmp_path / "m.onnx", head(layout, boxes, scores, classes, count=80))
    np.testing.assert_array_equal(detector(model)(IMAGE).state, states)


def test_an_overlap_of_the_threshold_is_allowed() -> None:
    boxes = np.array([[0, 0, 10, 10], [0, 0, 10, 5], [0, 0, 10, 5.5]], np.float32)
    suppressor, overlap = nms(boxes, np.zeros(3, np.int32), 0.5)
    np.testing.assert_array_equal(suppressor, [-1, -1, 0])
    assert overlap[2] == pytest.approx(0.55)


def test_boxes_are_clipped_after_the_nms(tmp_path: Path) -> None:
    """As in the exporters' own code: what can be seen of these two is one box, but they are not."""
    inside = [[0.0, 0, 40, 40], [0, 0, 40, 41]]
    boxes = np.array([[-50.0, -50, 40, 40], inside[1]])
    model = constant(tmp_path / "m.onnx", head("YOLOv8", boxes, np.array([0.9, 0.8]), np.array([1, 1])))
    result = detector(model)(IMAGE)
    np.testing.assert_array_equal(result.state, [KEPT, KEPT])
    np.testing.assert_allclose(result.xyxy, np.array(inside) - 0.5, atol=1e-5)


def test_boxes_outside_the_image_suppress_but_are_not_shown(tmp_path: Path) -> None:
    boxes = np.array([[-50.0, 0, -1, 40], [-49, 0, 1, 40], [50, 0, 90, 40]])
    model = constant(
        tmp_path / "m.onnx", head("YOLOv8", boxes, np.array([0.9, 0.8, 0.7]), np.array([1, 1, 1]))
    )
    result = detector(model)(IMAGE)
    np.testing.assert_allclose(result.xyxy, boxes[2:] - 0.5, atol=1e-5)
    np.testing.assert_array_equal(result.suppressed_by, [-1])


def overlapping(tmp_path: Path) -> str:
    rng = np.random.default_rng(1)
    low = rng.uniform(0, 50, (CELLS, 2))
    boxes = np.hstack([low, low + rng.uniform(8, 30, (CELLS, 2))])
    boxes[:, 3] = np.minimum(boxes[:, 3], H)
    return constant(
        tmp_path / "many.onnx",
        head("YOLOv8", boxes, rng.uniform(0, 1, CELLS), rng.integers(0, 3, CELLS)),
    )


def kept(result: Detections) -> set[tuple[float, ...]]:
    return {tuple(box) for box in result.xyxy[result.state == KEPT].tolist()}


def test_below_threshold_is_what_a_lower_threshold_would_keep(tmp_path: Path) -> None:
    model, image = overlapping(tmp_path), np.zeros((H, W, 3), np.uint8)
    high = detector(model, conf_threshold=0.6, explain_threshold=0.1, max_candidates=1000)(image)
    low = detector(model, conf_threshold=0.1, explain_threshold=0.1, max_candidates=1000)(image)
    for state in DetectionState:
        assert np.count_nonzero(high.state == state) > 3, "the case is rich enough to mean something"
    assert (np.diff(high.score) <= 0).all()
    weak = {tuple(box) for box in high.xyxy[high.state == BELOW].tolist()}
    assert kept(low) == kept(high) | weak
    assert (high.score[high.state == BELOW] < 0.6).all()
    gone = np.flatnonzero(high.state == SUPPRESSED)
    by = high.suppressed_by[gone]
    assert (high.state[by] != SUPPRESSED).all()
    assert (high.class_id[by] == high.class_id[gone]).all()
    np.testing.assert_allclose(high.overlap[gone], iou(high.xyxy, high.xyxy)[by, gone], atol=1e-3)
    assert (high.overlap[gone] > 0.45).all()
    assert (high.suppressed_by[high.state != SUPPRESSED] == -1).all()


def test_a_limit_on_candidates_never_costs_a_detection(tmp_path: Path) -> None:
    model, image = overlapping(tmp_path), np.zeros((H, W, 3), np.uint8)
    everything = detector(model, max_candidates=1000)(image)
    for limit in (1, 30, 60):
        few = detector(model, max_candidates=limit)(image)
        assert kept(few) == kept(everything)
        assert len(few) == max(limit, len(kept(everything)))
        gone = np.flatnonzero(few.state == SUPPRESSED)
        np.testing.assert_allclose(
            few.overlap[gone], iou(few.xyxy, few.xyxy)[few.suppressed_by[gone], gone], atol=1e-3
        )


def test_end_to_end_heads_are_not_suppressed_again(tmp_path: Path) -> None:
    boxes = np.array([[10.0, 10, 50, 50], [11, 10, 50, 50]])  # IoU 0.98
    model = constant(tmp_path / "e2e.onnx", head("end-to-end", boxes, np.array([0.9, 0.2]), np.array([1, 1])))
    result = detector(model)(np.zeros((H, W, 3), np.uint8))
    np.testing.assert_array_equal(result.state, [KEPT, BELOW])
    assert result.names == ("class_1", "class_1")


def test_only_the_configured_classes_are_kept(tmp_path: Path) -> None:
    output = head("YOLOv8", np.array([[0.0, 0, 20, 20], [40, 0, 60, 20]]), SCORES[:2], np.array([0, 2]))
    model = constant(tmp_path / "m.onnx", output, metadata={"names": "['car', 'person', 'cyclist']"})
    assert detector(model, classes=("cyclist",))(np.zeros((H, W, 3), np.uint8)).names == ("cyclist",)
    with pytest.raises(UserError, match="no class 'persn'; did you mean 'person'"):
        detector(model, classes=("persn",))


def test_empty_images_and_nan_outputs_have_no_detections(tmp_path: Path) -> None:
    boxes = np.array([[0.0, 0, np.nan, 20], [0, 0, np.inf, np.inf], [30, 30, 20, 20]])
    model = constant(tmp_path / "m.onnx", head("end-to-end", boxes, SCORES, CLASSES), metadata=ULTRALYTICS)
    assert len(detector(model)(np.zeros((H, W, 3), np.uint8))) == 0
    assert len(detector(model)(np.zeros((0, W, 3), np.uint8))) == 0


# --- layouts by shape --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shape", "size", "names", "layout", "count"),
    [
        ((1, 84, 8400), (640, 640), 0, "YOLOv8", 80),
        ((1, 5, 8400), (640, 640), 0, "YOLOv8", 1),
        ((1, 84, 5040), (384, 640), 0, "YOLOv8", 80),
        ((1, 8, 34000), (640, 640), 0, "YOLOv8", 4),  # P2 to P5
        ((1, 9, 1440), (288, 320), 0, "YOLOv8", 5),  # strides 8 alone
        ((1, 9, 777), (360, 640), 5, "YOLOv8", 5),  # of no grid, but of the right count
        ((1, 25200, 85), (640, 640), 0, "YOLOv5", 80),
        ((1, 25200, 6), (640, 640), 0, "YOLOv5", 1),
        ((1, 3549, 85), (416, 416), 0, "YOLOX", 80),
        ((1, 8400, 6), (640, 640), 0, "YOLOX", 1),
        ((1, 300, 6), (640, 640), 0, "end-to-end", 0),
        ((1, 300, 6), (640, 640), 80, "end-to-end", 80),
    ],
)
def test_the_layout_is_told_by_the_shape(
    shape: tuple[int, ...], size: tuple[int, int], names: int, layout: str, count: int, tmp_path: Path
) -> None:
    metadata = {"names": str([f"n{i}" for i in range(names)])}
    model = constant(
        tmp_path / "m.onnx",
        np.zeros(shape, np.float32),
        inputs=(image_input(1, 3, *size),),
        metadata=metadata,
    )
    found = detector(model)
    assert (str(found.layout), len(found.names)) == (layout, count)


def test_mask_columns_are_no_classes(tmp_path: Path) -> None:
    rows = np.zeros((1, 4 + 3 + 32, CELLS), np.float32)
    rows[0, :, 0] = [20, 20, 10, 10, 0, 0.6, 0, *[5.0] * 32]
    metadata = {"names": "{0: 'car', 1: 'person', 2: 'cyclist'}", "task": "segment"}
    result = detector(constant(tmp_path / "seg.onnx", rows, metadata=metadata))(np.zeros((H, W, 3), np.uint8))
    assert result.names == ("person",)
    assert result.score == pytest.approx(0.6)


# --- layouts that have names of their own ------------------------------------------------------


def single(values: NDArray[Any]) -> NDArray[np.float32]:
    return values.astype(np.float32)


def filled(values: NDArray[Any], fill: float) -> NDArray[Any]:
    return np.append(values, np.full(5, fill))


def fractions(boxes: NDArray[Any], width: int, height: int) -> NDArray[Any]:
    """Centres and sizes as fractions of an image."""
    center, size = (boxes[:, :2] + boxes[:, 2:]) / 2 + 0.5, boxes[:, 2:] - boxes[:, :2]
    return np.asarray(np.hstack([center, size]) / np.tile([width, height], 2))


def expect(result: Detections, boxes: NDArray[Any] = BOXES, atol: float = 0.01) -> None:
    order = np.argsort(-SCORES)
    assert (result.state == KEPT).all()
    np.testing.assert_allclose(result.xyxy, boxes[order], atol=atol)
    np.testing.assert_allclose(result.score, SCORES[order], atol=1e-6)
    np.testing.assert_array_equal(result.class_id, CLASSES[order])


@pytest.mark.parametrize(
    "metadata", [{"head": "RTDETRDecoder"}, {"description": "Ultralytics rtdetr-l model"}]
)
@pytest.mark.parametrize("listed", [True, False])
def test_rtdetr_of_ultralytics_is_stretched_with_fractions(
    metadata: dict[str, str], listed: bool, tmp_path: Path
) -> None:
    scored = np.column_stack([SCORES, CLASSES]) if listed else np.eye(3)[CLASSES] * SCORES[:, None]
    rows = np.hstack([fractions(BOXES, 200, 120), scored]).astype(np.float32)
    model = constant(tmp_path / "m.onnx", rows[None], metadata={**NAMES, "author": "Ultralytics", **metadata})
    found = detector(model)
    assert str(found.layout) == "RT-DETR"
    expect(found(np.zeros((120, 200, 3), np.uint8)))


def test_rtdetr_with_two_classes_is_told_from_its_older_form(tmp_path: Path) -> None:
    """Both have six columns: score and class, or two scores."""
    metadata = {"names": "['car', 'person']", "author": "Ultralytics", "head": "RTDETRDecoder"}
    for scored, score, class_id in (((0.9, 1.0), 0.9, 1), ((0.9, 0.3), 0.9, 0)):
        rows = np.array([[[0.5, 0.5, 0.2, 0.2, *scored]]], np.float32)
        result = detector(constant(tmp_path / "m.onnx", rows, metadata=metadata))(IMAGE)
        assert (result.score[0], result.class_id[0]) == (pytest.approx(score), class_id)


def test_rtdetr_and_dfine_of_their_repositories_are_read(tmp_path: Path) -> None:
    """They are told the image's size and answer in it: this one answers twice what it is told."""
    size = ("orig_target_sizes", ("N", 2), INT64)
    nodes = [
        node("Cast", ["orig_target_sizes"], ["size"], to=FLOAT),
        node("Tile", ["size", "twice"], ["four"]),
        node("Mul", ["fractions", "four"], ["boxes"]),
        node("Identity", ["constant_scores"], ["scores"]),
        node("Identity", ["constant_labels"], ["labels"]),
    ]
    corners = (BOXES + 0.5) / [200, 120, 200, 120]
    weights = {
        "twice": np.array([1, 2]),
        "fractions": corners[None].astype(np.float32),
        "constant_scores": SCORES[None].astype(np.float32),
        "constant_labels": CLASSES[None],
    }
    outputs = {
        "labels": ((1, 3), INT64),
        "boxes": ((1, 3, 4), FLOAT),
        "scores": ((1, 3), FLOAT),
    }
    inputs = (image_input("N", 3, H, W), size)
    model = onnx_networks.save(tmp_path / "m.onnx", nodes, weights, outputs, inputs)
    found = detector(model)
    assert (str(found.layout), found.names) == ("RT-DETR or D-FINE", ())
    assert "unnamed classes" in found.description
    result = found(np.zeros((120, 200, 3), np.uint8))
    expect(result)
    assert result.names == ("class_0", "class_1", "class_2")
    assert detector(model, names="coco")(IMAGE).names == ("person", "bicycle", "car")


def test_lists_without_a_batch_are_read(tmp_path: Path) -> None:
    """DEIMv2 answers with labels [300], boxes [300, 4] and scores [300]."""
    boxes = ((BOXES + 0.5) / [200, 120, 200, 120] * [W, H, W, H]).astype(np.float32)
    lists = {"labels": CLASSES, "boxes": boxes, "scores": SCORES.astype(np.float32)}
    inputs = (image_input("N", 3, H, W), ("orig_target_sizes", ("N", 2), INT64))
    found = detector(onnx_networks.answer(tmp_path / "m.onnx", lists, inputs), names="coco")
    assert str(found.layout) == "DEIM"
    result = found(np.zeros((120, 200, 3), np.uint8))
    expect(result)
    assert result.names == ("person", "bicycle", "car")
    mixed = {**lists, "scores": lists["scores"][None]}
    with pytest.raises(UserError, match=r"do not fit; its outputs: .*--model module:function \(docs/models"):
        detector(onnx_networks.answer(tmp_path / "m.onnx", mixed, inputs))


def test_rtdetr_of_its_repository_resamples_like_torchvision(tmp_path: Path) -> None:
    """From all pixels that a new one covers: stripes of one pixel become grey."""
    stripes = np.zeros((H, 3 * W, 3), np.uint8)
    stripes[:, ::2] = 200
    lists = {"labels": CLASSES[None], "boxes": single(BOXES[None]), "scores": single(SCORES[None])}
    inputs = (image_input("N", 3, H, W), ("orig_target_sizes", ("N", 2), INT64))
    blob, _ = detector(onnx_networks.answer(tmp_path / "m.onnx", lists, inputs)).prepare(stripes)
    np.testing.assert_allclose(blob[..., 1:-1], 100 / 255, atol=12 / 255)


@pytest.mark.parametrize("flat", [True, False])
def test_yolonas_with_its_own_processing_is_read(flat: bool, tmp_path: Path) -> None:
    """In a letterbox with a margin of two pixels on each side; lists are filled up with -1."""
    ratio = min((W - 4) / 200, (H - 4) / 120)
    inner = round(200 * ratio), round(120 * ratio)
    corner = (W - inner[0]) // 2, (H - inner[1]) // 2
    boxes = (BOXES + 0.5) * np.tile([inner[0] / 200, inner[1] / 120], 2) + np.tile(corner, 2)
    inputs = (image_input(1, 3, H, W, kind=UINT8),)
    if flat:
        rows = np.column_stack([np.zeros(3), boxes, SCORES, CLASSES]).astype(np.float32)
        model = onnx_networks.answer(tmp_path / "m.onnx", {"graph2_flat_predictions": rows}, inputs)
    else:
        empty = np.full((5, 4), -1)
        lists = {
            "graph2_num_predictions": np.array([[3]]),
            "graph2_pred_boxes": np.vstack([boxes, empty])[None].astype(np.float32),
            "graph2_pred_scores": filled(SCORES, -1)[None].astype(np.float32),
            "graph2_pred_classes": filled(CLASSES, -1)[None].astype(np.int64),
        }
        model = onnx_networks.answer(tmp_path / "m.onnx", lists, inputs)
    found = detector(model)
    assert str(found.layout) == "YOLO-NAS"
    expect(found(np.zeros((120, 200, 3), np.uint8)))
    blob, _ = found.prepare(np.full((120, 200, 3), (10, 20, 30), np.uint8))
    assert blob.dtype == np.uint8
    assert blob[0, :, H // 2, W // 2].tolist() == [30, 20, 10], "red first"
    assert (blob[:, :, :, :2] == 114).all()


def test_two_tables_are_read_where_ultralytics_exported_them(tmp_path: Path) -> None:
    boxes = np.full((1, CELLS, 4), 1, np.float32) * [0, 0, W, H]
    boxes[0, :3] = to_input("YOLOv8", BOXES, 200, 120)
    scores = np.zeros((1, CELLS, 3), np.float32)
    scores[0, np.arange(3), CLASSES] = SCORES
    tables = boxes.astype(np.float32), scores
    found = detector(constant(tmp_path / "ours.onnx", *tables, metadata={**NAMES, "author": "Ultralytics"}))
    assert str(found.layout) == "YOLO-NAS"
    expect(found(np.zeros((120, 200, 3), np.uint8)))
    for order in (tables, tables[::-1]):  # DAMO-YOLO puts the scores first
        with pytest.raises(UserError, match="nothing tells how it wants its image; export YOLO-NAS with"):
            detector(constant(tmp_path / "other.onnx", *order, metadata=NAMES))


def test_an_ambiguous_pixel_format_is_refused(tmp_path: Path) -> None:
    whole, real = image_input(1, 3, H, W, kind=UINT8), image_input(1, 3, H, W)
    rows = {"flat_predictions": np.zeros((0, 7), np.float32)}
    with pytest.raises(UserError, match="YOLO-NAS wants its pixels: export it with preprocessing=True"):
        detector(onnx_networks.answer(tmp_path / "nas.onnx", rows, (real,)))
    output = head("YOLOv8", BOXES / 3, SCORES, CLASSES)
    with pytest.raises(
        UserError, match=r"read as YOLOv8, it takes pixels as bytes, .*: export it for floats"
    ):
        detector(constant(tmp_path / "v8.onnx", output, inputs=(whole,)))


def test_yolov7_with_its_nms_is_read(tmp_path: Path) -> None:
    """Number of the image, box, class, score; one row alone is a list as well."""
    boxes = to_input("YOLOv8", BOXES, 200, 120)
    rows = np.column_stack([np.zeros(3), boxes, CLASSES, SCORES]).astype(np.float32)
    found = detector(constant(tmp_path / "m.onnx", rows, metadata=NAMES))
    assert str(found.layout) == "YOLOv7 with NMS"
    expect(found(np.zeros((120, 200, 3), np.uint8)))
    one = detector(constant(tmp_path / "one.onnx", rows[:1]))(np.zeros((120, 200, 3), np.uint8))
    np.testing.assert_allclose(one.xyxy, BOXES[:1], atol=0.01)


def test_torchvision_counts_its_classes_from_one(tmp_path: Path) -> None:
    lists = single(BOXES + 0.5), single(SCORES), CLASSES + 1
    inputs = (image_input(3, "h", "w"),)
    model = constant(tmp_path / "m.onnx", *lists, inputs=inputs, metadata=NAMES)
    result = detector(model)(np.zeros((120, 200, 3), np.uint8))
    np.testing.assert_allclose(result.xyxy, BOXES[np.argsort(-SCORES)], atol=1e-4)
    assert result.names == ("car", "person", "cyclist")
    assert detector(model, names="coco91").names == COCO_CATEGORIES
    assert detector(model, names="coco91")(np.zeros((120, 200, 3), np.uint8)).names[0] == "person"


def test_end_to_end_heads_with_masks_and_key_points_are_read(tmp_path: Path) -> None:
    rows = head("end-to-end", to_input("YOLOv8", BOXES, 200, 120), SCORES, CLASSES)
    more = np.concatenate([rows, np.full((1, 20, 32), 7, np.float32)], axis=2)
    metadata = {**ULTRALYTICS, "task": "pose", "end2end": "True"}
    expect(
        detector(constant(tmp_path / "pose.onnx", more, metadata=metadata))(np.zeros((120, 200, 3), np.uint8))
    )
    prototypes = np.zeros((1, 32, H // 4, W // 4), np.float32)
    expect(detector(constant(tmp_path / "seg.onnx", more, prototypes))(np.zeros((120, 200, 3), np.uint8)))
    with pytest.raises(UserError, match="no detector that is known here"):
        detector(constant(tmp_path / "unknown.onnx", more))


# --- what looks like one of them ---------------------------------------------------------------

LIST = np.column_stack([BOXES, SCORES, [2, 0, 1]])


@pytest.mark.parametrize(
    ("order", "said"),
    [
        ([0, 1, 2, 3, 5, 4], r"scores up to 2|classes such as 0\.5"),  # class, then score
        ([5, 4, 0, 1, 2, 3], "scores up to 180"),  # PaddleDetection
        ([4, 5, 0, 1, 2, 3], "scores up to 180"),
        ([2, 3, 0, 1, 4, 5], "not corners"),
    ],
)
def test_other_orders_of_six_columns_are_refused(order: list[int], said: str, tmp_path: Path) -> None:
    model = constant(tmp_path / "m.onnx", LIST[None, :, order].astype(np.float32))
    with pytest.raises(
        UserError, match=f"read as end-to-end, .*({said}).*; its outputs: output0 \\[1, 3, 6\\]"
    ):
        detector(model)


def test_lists_in_fractions_of_an_unknown_image_are_refused(tmp_path: Path) -> None:
    rows = LIST / [W * 3, H * 3, W * 3, H * 3, 1, 1]
    with pytest.raises(UserError, match=r"not in pixels, but numbers up to 0\.6"):
        detector(constant(tmp_path / "m.onnx", rows[None].astype(np.float32)))


@pytest.mark.parametrize("layout", ["YOLOv8", "YOLOv5", "YOLOv6"])
def test_boxes_in_fractions_and_scores_above_one_are_no_yolo(layout: str, tmp_path: Path) -> None:
    output = head(layout, BOXES / 3, SCORES, CLASSES)
    tall = output if layout == "YOLOv8" else output.transpose(0, 2, 1)
    small, loud = tall.copy(), tall.copy()
    small[:, :4] /= 96
    loud[:, -1, 0] = 3.5
    for changed, said in ((small, "boxes are not in pixels"), (loud, r"scores from 0 to 3\.5")):
        answer = changed if layout == "YOLOv8" else np.ascontiguousarray(changed.transpose(0, 2, 1))
        with pytest.raises(UserError, match=f"read as {layout}, .*{said}"):
            detector(constant(tmp_path / "m.onnx", answer, metadata=NAMES))


def test_a_table_of_more_scores_than_names_is_no_yolo(tmp_path: Path) -> None:
    for shape in ((1, 4 + 32, CELLS), (1, 3 * CELLS, 5 + 32), (1, CELLS, 5 + 32)):
        with pytest.raises(UserError, match="it scores 32 classes, but has 3 class names"):
            detector(constant(tmp_path / "m.onnx", np.zeros(shape, np.float32), metadata=NAMES))


def test_logits_are_no_scores(tmp_path: Path) -> None:
    """NanoDet's table, where distances to the sides follow the scores, has such numbers, too."""
    rows = np.random.default_rng(0).normal(0, 3, (1, CELLS, 37)).astype(np.float32)
    rows[:, :, :4] *= 50
    with pytest.raises(UserError, match=r"read as YOLOX decoded, it has scores from -.* to"):
        detector(constant(tmp_path / "m.onnx", rows, metadata={"names": str([str(i) for i in range(32)])}))


def test_a_decoded_grid_needs_names(tmp_path: Path) -> None:
    """[1, cells, 8] could be an objectness and three classes, or four classes."""
    model = constant(tmp_path / "m.onnx", head("YOLOX decoded", BOXES / 3, SCORES, CLASSES))
    with pytest.raises(UserError, match=r"fifth column may be an objectness or a class: set detector\.names"):
        detector(model)
    names = tmp_path / "names.txt"
    names.write_text("a\nb\nc")
    assert str(detector(model, names=str(names)).layout) == "YOLOX decoded"
    names.write_text("a\nb\nc\nd")
    with pytest.raises(UserError, match="scores 3 classes, but has 4 class names"):
        detector(model, names=str(names))


def test_an_angle_column_is_not_read_as_a_class(tmp_path: Path) -> None:
    """Without metadata the angle of oriented boxes looks like a class that is seen everywhere."""
    output = head("YOLOv8", BOXES / 3, SCORES, CLASSES, count=4)
    names = tmp_path / "names.txt"
    names.write_text("a\nb\nc\nd")
    for angle in (0.785, np.random.default_rng(0).uniform(0, 1, CELLS)):
        output[0, -1] = angle
        model = constant(tmp_path / "m.onnx", output)
        with pytest.raises(UserError, match=r"last class is everywhere, like angles .* detector\.names"):
            detector(model)
        assert detector(model, names=str(names)).names == ("a", "b", "c", "d")
    with pytest.raises(
        UserError, match=r"a model for the task 'obb': export one for detect, segment or pose; or wrap it"
    ):
        detector(constant(tmp_path / "m.onnx", output, metadata={**ULTRALYTICS, "task": "obb"}))


@pytest.mark.parametrize(
    ("names", "shapes", "said"),
    [
        (("logits", "pred_boxes"), ((1, 100, 92), (1, 100, 4)), "a DETR of Hugging Face"),
        (("dets", "labels"), ((1, 100, 5), (1, 100)), "a model of MMDeploy"),
        (
            ("cls", "reg"),
            ((1, H * W // 64 * 21 // 16, 80), (1, H * W // 64 * 21 // 16, 32)),
            "module:function",
        ),
        (("num_dets", "det_boxes"), ((1, 1), (1, 100, 4)), "export without --end2end"),
        (("a", "b", "c"), ((1, 3, 8, 12, 8), (1, 3, 4, 6, 8), (1, 3, 2, 3, 8)), "YOLOv7: --grid"),
    ],
)
def test_networks_of_other_kinds_are_named(
    names: tuple[str, ...], shapes: tuple[tuple[int, ...], ...], said: str, tmp_path: Path
) -> None:
    outputs = {name: np.zeros(shape, np.float32) for name, shape in zip(names, shapes, strict=True)}
    with pytest.raises(UserError, match=f"detector.model .*{said}"):
        detector(onnx_networks.answer(tmp_path / "m.onnx", outputs, (image_input(1, 3, H, W),)))


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ([10.0, 10, 30, 30, 300, 1], "scores up to 300"),
        ([10.0, 10, 30, 30, 0.9, 0.25], r"classes such as 0\.25"),
        ([10.0, 10, 30, 30, 0.9, 7], "class 7, but 3 class names"),
    ],
)
def test_an_empty_list_of_detections_is_checked_later(row: list[float], said: str, tmp_path: Path) -> None:
    """A network with NMS may find nothing in the image that tells its layout, this one in any dark image."""
    nodes = [
        node("ReduceMean", ["images"], ["mean"], axes=[1, 2, 3], keepdims=1),
        node("Squeeze", ["mean", "last"], ["level"]),
        node("Greater", ["level", "bright"], ["is_bright"]),
        node("Cast", ["is_bright"], ["factor"], to=FLOAT),
        node("Mul", ["rows", "factor"], ["output0"]),
    ]
    weights = {
        "last": np.array([3]),
        "bright": np.array(0.8, np.float32),
        "rows": np.array([[row]], np.float32),
    }
    outputs = {"output0": ((1, 1, 6), FLOAT)}
    model = onnx_networks.save(tmp_path / "m.onnx", nodes, weights, outputs, [image_input(1, 3, H, W)], NAMES)
    found = detector(model)
    assert len(found(IMAGE)) == 0
    with pytest.raises(UserError, match=f"detector.model .*: read as end-to-end, it has {said}"):
        found(IMAGE + np.uint8(255))


# --- names -------------------------------------------------------------------------------------


def test_class_names_come_from_a_file_or_coco(tmp_path: Path) -> None:
    coco = constant(tmp_path / "coco.onnx", np.zeros((1, 84, CELLS), np.float32))
    assert detector(coco).names == COCO
    assert (len(COCO), COCO[0], COCO[79]) == (80, "person", "toothbrush")
    three = constant(tmp_path / "three.onnx", np.zeros((1, 7, CELLS), np.float32))
    assert detector(three).names == ("class_0", "class_1", "class_2")
    names = tmp_path / "names.txt"
    names.write_text("car\nperson\n\ncyclist\n")
    assert detector(three, names=str(names)).names == ("car", "person", "cyclist")
    with pytest.raises(UserError, match=r"scores 80 classes, but has 3 class names; .*\[1, 84, 126\]"):
        detector(coco, names=str(names))
    assert detector(coco, names="coco").names == COCO
    assert (len(COCO_CATEGORIES), COCO_CATEGORIES[1], COCO_CATEGORIES[90]) == (91, "person", "toothbrush")
    names.write_text("\n")
    with pytest.raises(UserError, match="holds no class name"):
        detector(three, names=str(names))
    with pytest.raises(UserError, match=r"detector\.names .*cannot be read"):
        detector(three, names=str(tmp_path / "missing.txt"))


# --- what is no detector -----------------------------------------------------------------------


def test_files_that_are_no_model_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such file"):
        detector(str(tmp_path / "missing.onnx"))
    with pytest.raises(UserError, match="no such file"):
        detector(str(tmp_path))
    text = tmp_path / "text.onnx"
    text.write_text("not a protobuf")
    with pytest.raises(UserError, match="cannot load it"):
        detector(str(text))
    weights = tmp_path / "yolo.pt"
    weights.write_bytes(b"PK")
    with pytest.raises(UserError, match="yolo export"):
        detector(str(weights))


@pytest.mark.parametrize("shape", [(1, 1, H, W), (1, H, W, 3), (H, W), (1, 3, 1, H, W)])
def test_inputs_that_are_no_colour_image_are_refused(shape: tuple[int, ...], tmp_path: Path) -> None:
    model = constant(tmp_path / "m.onnx", np.zeros((1, 7, CELLS), np.float32), inputs=(image_input(*shape),))
    with pytest.raises(UserError, match=r"no detector of one colour image .*; its inputs: images \["):
        detector(model)


def test_inputs_beside_the_image_are_refused(tmp_path: Path) -> None:
    zeros = np.zeros((1, 7, CELLS), np.float32)
    several = constant(tmp_path / "batch.onnx", zeros, inputs=(image_input(4, 3, H, W),))
    with pytest.raises(
        UserError, match=r"takes 4 images at a time \(images \[4, 3, 64, 96\]\); export it with"
    ):
        detector(several)
    inputs = (image_input(1, 3, H, W), image_input(1, 2, name="scale_factor"))  # as PaddleDetection
    with pytest.raises(
        UserError, match=r"no detector of one .*; its inputs: images .*, scale_factor \[1, 2\]"
    ):
        detector(constant(tmp_path / "two.onnx", zeros, inputs=inputs))


@pytest.mark.parametrize("shape", [(1, 1000), (1, 197, 768), (1, 21, 64, 64), (1, 9, 777)])
def test_outputs_that_are_no_detections_are_refused(shape: tuple[int, ...], tmp_path: Path) -> None:
    model = constant(tmp_path / "m.onnx", np.zeros(shape, np.float32))
    with pytest.raises(
        UserError, match=r"no detector that is known here; its outputs: output0 \[1, .*YOLOv8"
    ):
        detector(model)


def test_unsupported_tensor_types_are_refused(tmp_path: Path) -> None:
    inputs = (image_input(1, 3, H, W, kind=onnx_networks.DOUBLE),)
    with pytest.raises(UserError, match="supported: tensor"):
        detector(constant(tmp_path / "double.onnx", np.zeros((1, 7, CELLS), np.float32), inputs=inputs))


def test_execution_providers_are_chosen_by_name(tmp_path: Path) -> None:
    model = constant(tmp_path / "m.onnx", np.zeros((1, 7, CELLS), np.float32))
    assert detector(model, provider="cpu").provider == "CPU"
    assert detector(model, provider="CPUExecutionProvider").provider == "CPU"
    assert f"YOLOv8, {W} x {H}, 3 classes" in detector(model).description
    with pytest.raises(UserError, match=r"detector.provider TPU: not here; available: .*CPU"):
        detector(model, provider="TPU")


# --- real --------------------------------------------------------------------------------------


def test_yolox_nano_finds_the_pedestrian_of_kitti(shared: Path) -> None:
    see = detector(str(shared / "models/yolox_nano.onnx"))
    assert (str(see.layout), see.input_size, see.names) == ("YOLOX", (416, 416), COCO)
    image = cv2.imread(str(shared / "kitti/image_2/000000.png"))
    assert image is not None
    result = see(np.asarray(image, np.uint8))
    label = np.array([[712.40, 143.00, 810.73, 307.92]], np.float32)
    found = np.flatnonzero(result.state == KEPT)
    assert [result.names[d] for d in found] == ["person"]
    assert iou(result.xyxy[found], label)[0, 0] > 0.8
    assert result.score[found[0]] > 0.7


# --- a detector that can never answer ----------------------------------------------------------


@pytest.mark.parametrize(
    ("boxes", "score", "classes", "reason"),
    [
        ([[100.0, 60, 40, 30]], [0.9], [0], "not corners, but perhaps centre and size"),
        ([[60.0, 60, 90, 90], [150, 100, 30, 20]], [0.9, 0.6], [0, 1], "not corners"),
        ([[0.2, 0.2, 0.4, 0.4]], [0.9], [0], "its boxes are not in pixels, but numbers up to 0.4"),
        ([[20.0, 30, 60, 90]], [0.0], [0.9], "score and class are exchanged"),
    ],
)
def test_a_list_that_is_read_in_the_wrong_way_is_refused(
    tmp_path: Path, boxes: list[list[float]], score: list[float], classes: list[float], reason: str
) -> None:
    """A grey image tells nothing about a list, so the first images with candidates are checked."""
    rows = np.column_stack([boxes, score, classes])
    path = reacting(tmp_path / "m.onnx", rows)
    network = detector(path)
    assert len(network(np.full((H, W, 3), 114, np.uint8))) == 0
    with pytest.raises(UserError, match=reason):
        network(red_image())


def test_a_list_of_corners_answers(tmp_path: Path) -> None:
    rows = np.column_stack([[[20.0, 30, 60, 90]], [0.9], [1]])
    assert detector(reacting(tmp_path / "m.onnx", rows))(red_image()).score.tolist() == pytest.approx([0.9])


def red_image() -> U8:
    image = np.full((H, W, 3), 114, np.uint8)
    image[20:60, 20:60] = 0, 0, 255
    return image


def reacting(path: Path, rows: NDArray[Any]) -> str:
    """Save a network with a list of boxes that is empty unless there is red in the image."""
    table = np.zeros((1, 300, 6), np.float32)
    table[0, : len(rows)] = rows
    red = np.array([1, -0.5, -0.5], np.float32).reshape(1, 3, 1, 1)
    nodes = [
        node("Conv", ["images", "red"], ["redness"]),
        node("ReduceMax", ["redness"], ["most"], keepdims=0),
        node("Greater", ["most", "half"], ["is_red"]),
        node("Cast", ["is_red"], ["factor"], to=FLOAT),
        node("Mul", ["table", "factor"], ["output0"]),
    ]
    weights = {"table": table, "red": red, "half": np.float32(0.5)}
    arrays: dict[str, NDArray[Any]] = {name: np.asarray(value) for name, value in weights.items()}
    return save(path, nodes, arrays, {"output0": ([1, 300, 6], FLOAT)}, [image_input(1, 3, H, W)], NAMES)


def test_scores_quantised_like_boxes_are_refused(tmp_path: Path) -> None:
    step = 640 / 255  # pixels, and units of the score
    y, x = np.mgrid[0:20, 0:20] * 32 + 16
    boxes = np.stack([x, y, 0 * x + 32, 0 * x + 32]).reshape(4, 400)
    table = np.vstack([np.rint(boxes / step) * step, np.zeros((2, 400))])[None].astype(np.float32)
    names = {"names": "{0: 'a', 1: 'b'}"}
    path = answer(tmp_path / "m.onnx", {"output0": table}, [image_input(1, 3, 640, 640)], names)
    with pytest.raises(UserError, match=r"scores are all 0, because they have steps of 2\.5"):
        detector(path)


@pytest.mark.parametrize(("of_class", "expected"), [(0.5, 0.8), (0.48, 0.8), (0.9999, 0.8)])
def test_the_score_of_an_untrained_class_is_left_out(
    tmp_path: Path, of_class: float, expected: float
) -> None:
    """YOLOv7 does not train the class score where there is one class, and leaves it out of its own NMS."""
    table = np.zeros((1, 25200, 6), np.float32)
    table[0, :, :4] = 320, 320, 99, 99
    table[0, 0, 4] = 0.8
    table[0, :, 5] = of_class + np.linspace(-0.01, 0, 25200)
    path = answer(tmp_path / "m.onnx", {"output": table}, [image_input(1, 3, 640, 640)])
    assert detector(path)(np.zeros((640, 640, 3), np.uint8)).score.max() == pytest.approx(expected)


def test_the_score_of_a_trained_class_counts(tmp_path: Path) -> None:
    table = np.zeros((1, 25200, 6), np.float32)
    table[0, :, :4] = 320, 320, 99, 99
    table[0, 0, 4], table[0, 0, 5] = 0.8, 0.5
    path = answer(tmp_path / "m.onnx", {"output": table}, [image_input(1, 3, 640, 640)])
    assert detector(path)(np.zeros((640, 640, 3), np.uint8)).score.max() == pytest.approx(0.4)
