"""The detector on networks made to measure, one for each layout, and on YOLOX-nano and a KITTI image."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from bevviz.config import DetectorConfig
from bevviz.errors import UserError
from bevviz.frame import Detections, DetectionState
from bevviz.geometry import iou
from bevviz.stages.detector import COCO, Detector, Layout, find_layout, nms
from bevviz.stages.detector.names import COCO_CATEGORIES

onnx = pytest.importorskip("onnx", reason="the test networks are built with onnx")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

H, W = 64, 96  # of the small networks' input
STRIDES = (8, 16, 32)
CELLS = sum((H // s) * (W // s) for s in STRIDES)
IMAGE = np.zeros((H, W, 3), np.uint8)  # of the input's size: boxes come back as they are, less half a pixel
KEPT, BELOW, SUPPRESSED = DetectionState.KEPT, DetectionState.BELOW_THRESHOLD, DetectionState.SUPPRESSED


def save(
    path: Path,
    nodes: list[Any],
    weights: dict[str, NDArray[Any]],
    output: list[int | str],
    input_shape: tuple[int | str | None, ...] = (1, 3, H, W),
    dtype: int = TensorProto.FLOAT,
    metadata: dict[str, str] | None = None,
) -> str:
    graph = helper.make_graph(
        nodes,
        "test",
        [helper.make_tensor_value_info("images", dtype, input_shape)],
        [helper.make_tensor_value_info("output0", dtype, output)],
        [numpy_helper.from_array(value, name) for name, value in weights.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    helper.set_model_props(model, metadata or {})
    onnx.checker.check_model(model)
    onnx.save(model, path)
    return str(path)


def constant(path: Path, output: NDArray[Any], **options: Any) -> str:
    """A network that answers ``output`` to every image."""
    nodes = [helper.make_node("Identity", ["answer"], ["output0"])]
    return save(path, nodes, {"answer": output}, list(output.shape), **options)


def head(
    layout: Layout, boxes: NDArray[Any], score: NDArray[Any], classes: NDArray[Any], count: int = 3
) -> NDArray[Any]:
    """The output in which a network of this layout states boxes x0, y0, x1, y1 of its input."""
    center, size = (boxes[:, :2] + boxes[:, 2:]) / 2, boxes[:, 2:] - boxes[:, :2]
    by_class = np.zeros((len(boxes), count))
    if layout is Layout.END_TO_END:
        rows = np.zeros((20, 6))
        rows[: len(boxes)] = np.column_stack([boxes, score, classes])
    elif layout is Layout.YOLOV8:
        by_class[np.arange(len(boxes)), classes] = score
        rows = np.zeros((CELLS, 4 + count))
        rows[: len(boxes)] = np.hstack([center, size, by_class])
        return np.asarray(rows.T[None], np.float32)
    else:
        by_class[np.arange(len(boxes)), classes] = 0.9
        objectness = (score / 0.9)[:, None]
        rows = np.zeros((CELLS * (1 if layout is Layout.YOLOX else 3), 5 + count))
        place = np.arange(len(boxes))
        if layout is Layout.YOLOX:  # the last cells: stride 32, row and column by hand
            place = CELLS - 1 - place
            grid = np.array([(2, 1), (1, 1), (0, 1), (2, 0)])[: len(boxes)]
            center, size = center / 32 - grid, np.log(size / 32)
        rows[place] = np.hstack([center, size, objectness, by_class])
    return np.asarray(rows[None], np.float32)


def to_input(layout: Layout, boxes: NDArray[Any], width: int, height: int) -> NDArray[Any]:
    """Boxes of an image of that size in the pixels of the network's input."""
    ratio = min(W / width, H / height)
    if layout is Layout.YOLOX:
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


@pytest.mark.parametrize("layout", Layout)
@pytest.mark.parametrize(("width", "height"), [(192, 128), (200, 120), (193, 131), (W, H * 2)])
def test_every_layout_gives_its_boxes_in_image_pixels(
    layout: Layout, width: int, height: int, tmp_path: Path
) -> None:
    boxes = BOXES * ([width / 200, height / 120] * 2)
    output = head(layout, to_input(layout, boxes, width, height), SCORES, CLASSES)
    names = {"names": "{0: 'car', 1: 'person', 2: 'cyclist'}"}
    found = detector(constant(tmp_path / "model.onnx", output, metadata=names))
    assert found.layout is layout
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


def color_network(path: Path, layout: Layout, shape: tuple[int | None, ...] = (1, 3, H, W)) -> str:
    """A network that sees: class c of a cell of 8 x 8 pixels is the mean of channel c in it."""
    scale = 1.0 if layout is Layout.YOLOV8 else 1 / 255
    cells = (H // 8) * (W // 8)
    y, x = np.indices((H // 8, W // 8)).reshape(2, 1, -1).astype(np.float32)
    weights: dict[str, NDArray[Any]] = {"shape": np.array([1, 3, -1]), "scale": np.array([scale], np.float32)}
    nodes = [
        helper.make_node("AveragePool", ["images"], ["pooled"], kernel_shape=[8, 8], strides=[8, 8]),
        helper.make_node("Reshape", ["pooled", "shape"], ["flat"]),
        helper.make_node("Mul", ["flat", "scale"], ["scores"]),
    ]
    if layout is Layout.YOLOV8:
        weights["boxes"] = np.stack([x * 8 + 4, y * 8 + 4, x * 0 + 8, x * 0 + 8], axis=1)
        nodes.append(helper.make_node("Concat", ["boxes", "scores"], ["output0"], axis=1))
        return save(path, nodes, weights, [1, 7, cells], shape)
    half, zero = np.full_like(x, 0.5), np.zeros_like(x)
    weights["boxes"] = np.stack([half, half, zero, zero, zero + 1], axis=1)
    weights["coarse"] = np.zeros((1, 8, CELLS - cells), np.float32)  # nothing at strides 16 and 32
    nodes.append(helper.make_node("Concat", ["boxes", "scores"], ["fine"], axis=1))
    nodes.append(helper.make_node("Concat", ["fine", "coarse"], ["rows"], axis=2))
    nodes.append(helper.make_node("Transpose", ["rows"], ["output0"], perm=[0, 2, 1]))
    return save(path, nodes, weights, [1, CELLS, 8], shape)


@pytest.mark.parametrize(("layout", "channel"), [(Layout.YOLOV8, 0), (Layout.YOLOX, 2)])
def test_the_network_sees_the_right_colours_at_the_right_place(
    layout: Layout, channel: int, tmp_path: Path
) -> None:
    see = detector(color_network(tmp_path / "colors.onnx", layout), conf_threshold=0.9)
    image = np.zeros((80, 192, 3), np.uint8)  # halved, with a border of 24 rows below, or 12 on either side
    cells_above = 12 if layout is Layout.YOLOV8 else 0
    top, left = 2 * (24 - cells_above), 64
    image[top : top + 16, left : left + 32, 2] = 255  # red
    result = see(image)
    red = np.flatnonzero(result.state == KEPT)
    assert set(result.class_id[red]) == {channel}
    found = np.concatenate([result.xyxy[red, :2].min(axis=0), result.xyxy[red, 2:].max(axis=0)])
    np.testing.assert_allclose(found, [left - 0.5, top - 0.5, left + 31.5, top + 15.5], atol=0.01)


def test_the_border_is_grey(tmp_path: Path) -> None:
    see = detector(color_network(tmp_path / "colors.onnx", Layout.YOLOX), explain_threshold=0.01)
    result = see(np.zeros((32, 96, 3), np.uint8))
    assert len(result) == 0, "boxes of the border are outside the image"
    blob, _, _ = see._letterbox(np.zeros((32, 96, 3), np.uint8))
    assert blob.shape == (1, 3, H, W)
    assert (blob[:, :, :32] == 0).all()
    assert (blob[:, :, 32:] == 114).all()


@settings(max_examples=40, deadline=None)
@given(
    width=st.integers(1, 4000),
    height=st.integers(1, 4000),
    layout=st.sampled_from([Layout.YOLOV8, Layout.YOLOX]),
)
def test_the_whole_image_comes_back_whatever_its_size(
    width: int, height: int, layout: Layout, tmp_path_factory: pytest.TempPathFactory
) -> None:
    if max(width / height / (W / H), height * W / H / width) > 60:
        return  # less than a pixel wide in the network's input
    whole = np.array([[-0.5, -0.5, width - 0.5, height - 0.5]])
    output = head(layout, to_input(layout, whole, width, height), SCORES[:1], CLASSES[:1])
    path = tmp_path_factory.mktemp("whole") / "model.onnx"
    result = detector(constant(path, output))(np.zeros((height, width, 3), np.uint8))
    np.testing.assert_allclose(result.xyxy, whole, atol=1e-4 * max(width, height))


def test_float16_and_open_sizes(tmp_path: Path) -> None:
    rows = np.zeros((1, 7, 8400), np.float16)
    rows[0, :, 3] = 320, 200, 64, 32, 0, 0.75, 0
    shape = ("batch", 3, "height", "width")
    see = detector(constant(tmp_path / "half.onnx", rows, input_shape=shape, dtype=TensorProto.FLOAT16))
    assert see.input_size == (640, 640)
    assert see.layout is Layout.YOLOV8
    result = see(np.zeros((360, 640, 3), np.uint8))
    # 360 rows are padded to 384, not to 640: 12 above.
    np.testing.assert_allclose(result.xyxy, [[287.5, 171.5, 351.5, 203.5]], atol=0.01)
    assert result.names == ("class_1",)


def test_metadata_gives_the_size_that_the_model_was_trained_with(tmp_path: Path) -> None:
    rows = np.zeros((1, 7, CELLS), np.float32)
    meta = {"imgsz": f"[{H}, {W}]", "stride": "32"}
    assert detector(
        constant(tmp_path / "m.onnx", rows, input_shape=("b", 3, "h", "w"), metadata=meta)
    ).input_size == (H, W)


# --- non-maximum suppression -------------------------------------------------------------------

some_boxes = st.lists(
    st.tuples(st.floats(0, 60), st.floats(0, 60), st.floats(4, 40), st.floats(4, 40), st.integers(0, 1)),
    min_size=1,
    max_size=25,
)


@settings(deadline=None)
@given(some_boxes, st.floats(0.1, 0.9))
def test_nms_keeps_what_the_definition_keeps(rows: list[tuple[float, ...]], threshold: float) -> None:
    table = np.array(rows, np.float32)
    boxes = np.hstack([table[:, :2], table[:, :2] + table[:, 2:4]])
    classes = table[:, 4].astype(np.int32)
    suppressor, overlap = nms(boxes, classes, threshold)
    value = iou(boxes, boxes)
    survivors: list[int] = []
    for i in range(len(boxes)):
        rivals = [j for j in survivors if classes[i] == classes[j] and value[j, i] > threshold]
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
    model = constant(tmp_path / "m.onnx", head(Layout(layout), boxes, scores, classes, count=80))
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
    model = constant(tmp_path / "m.onnx", head(Layout.YOLOV8, boxes, np.array([0.9, 0.8]), np.array([1, 1])))
    result = detector(model)(IMAGE)
    np.testing.assert_array_equal(result.state, [KEPT, KEPT])
    np.testing.assert_allclose(result.xyxy, np.array(inside) - 0.5, atol=1e-5)


def test_what_lies_outside_the_image_suppresses_but_is_not_shown(tmp_path: Path) -> None:
    boxes = np.array([[-50.0, 0, -1, 40], [-49, 0, 1, 40], [50, 0, 90, 40]])
    model = constant(
        tmp_path / "m.onnx", head(Layout.YOLOV8, boxes, np.array([0.9, 0.8, 0.7]), np.array([1, 1, 1]))
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
        head(Layout.YOLOV8, boxes, rng.uniform(0, 1, CELLS), rng.integers(0, 3, CELLS)),
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
    model = constant(
        tmp_path / "e2e.onnx", head(Layout.END_TO_END, boxes, np.array([0.9, 0.2]), np.array([1, 1]))
    )
    result = detector(model)(np.zeros((H, W, 3), np.uint8))
    np.testing.assert_array_equal(result.state, [KEPT, BELOW])
    assert result.names == ("class_1", "class_1")


def test_only_the_wanted_classes(tmp_path: Path) -> None:
    output = head(Layout.YOLOV8, np.array([[0.0, 0, 20, 20], [40, 0, 60, 20]]), SCORES[:2], np.array([0, 2]))
    model = constant(tmp_path / "m.onnx", output, metadata={"names": "['car', 'person', 'cyclist']"})
    assert detector(model, classes=("cyclist",))(np.zeros((H, W, 3), np.uint8)).names == ("cyclist",)
    with pytest.raises(UserError, match="no class 'persn'; did you mean 'person'"):
        detector(model, classes=("persn",))


def test_an_empty_image_and_a_broken_answer_give_no_detection(tmp_path: Path) -> None:
    boxes = np.array([[0.0, 0, np.nan, 20], [0, 0, np.inf, np.inf], [30, 30, 20, 20]])
    model = constant(tmp_path / "m.onnx", head(Layout.END_TO_END, boxes, SCORES, CLASSES))
    assert len(detector(model)(np.zeros((H, W, 3), np.uint8))) == 0
    assert len(detector(model)(np.zeros((0, W, 3), np.uint8))) == 0


# --- layouts and names -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shape", "size", "classes", "layout", "count"),
    [
        ((1, 84, 8400), (640, 640), None, Layout.YOLOV8, 80),
        ((1, 5, 8400), (640, 640), None, Layout.YOLOV8, 1),
        ((1, 84, 5040), (384, 640), None, Layout.YOLOV8, 80),
        ((1, 8, 34000), (640, 640), None, Layout.YOLOV8, 4),  # P2 to P5
        ((1, 9, 1440), (288, 320), None, Layout.YOLOV8, 5),  # strides 8 alone
        ((1, 25200, 85), (640, 640), None, Layout.YOLOV5, 80),
        ((1, 25200, 6), (640, 640), None, Layout.YOLOV5, 1),
        ((1, 3549, 85), (416, 416), None, Layout.YOLOX, 80),
        ((1, 8400, 6), (640, 640), None, Layout.YOLOX, 1),
        ((1, 300, 6), (640, 640), None, Layout.END_TO_END, None),
        ((1, 300, 6), (640, 640), 80, Layout.END_TO_END, 80),
        ((1, 9, 777), (360, 640), 5, Layout.YOLOV8, 5),  # of no grid, but of the right count
        ((1, 9, 777), (360, 640), None, None, None),
        ((1, 84, 8400), (640, 640), 3, None, None),  # names of another model
        ((1, 197, 768), (224, 224), None, None, None),  # a transformer's tokens
        ((1, 1000), (224, 224), None, None, None),
        ((1, 21, 64, 64), (512, 512), None, None, None),
        ((2, 84, 8400), (640, 640), None, None, None),
    ],
)
def test_the_layout_is_told_by_the_shape(
    shape: tuple[int, ...],
    size: tuple[int, int],
    classes: int | None,
    layout: Layout | None,
    count: int | None,
) -> None:
    assert find_layout(shape, size, classes) == (layout, count)


def test_mask_columns_are_no_classes(tmp_path: Path) -> None:
    rows = np.zeros((1, 4 + 3 + 32, CELLS), np.float32)
    rows[0, :, 0] = [20, 20, 10, 10, 0, 0.6, 0, *[5.0] * 32]
    metadata = {"names": "{0: 'car', 1: 'person', 2: 'cyclist'}", "task": "segment"}
    result = detector(constant(tmp_path / "seg.onnx", rows, metadata=metadata))(np.zeros((H, W, 3), np.uint8))
    assert result.names == ("person",)
    assert result.score == pytest.approx(0.6)


def test_names(tmp_path: Path) -> None:
    coco = constant(tmp_path / "coco.onnx", np.zeros((1, 84, CELLS), np.float32))
    assert detector(coco).names == COCO
    assert (len(COCO), COCO[0], COCO[79]) == (80, "person", "toothbrush")
    three = constant(tmp_path / "three.onnx", np.zeros((1, 7, CELLS), np.float32))
    assert detector(three).names == ("class_0", "class_1", "class_2")
    names = tmp_path / "names.txt"
    names.write_text("car\nperson\n\ncyclist\n")
    assert detector(three, names=str(names)).names == ("car", "person", "cyclist")
    with pytest.raises(UserError, match=r"no detector for 3 class names; .*\[1, 84, 126\]"):
        detector(coco, names=str(names))
    assert detector(coco, names="coco").names == COCO
    assert (len(COCO_CATEGORIES), COCO_CATEGORIES[1], COCO_CATEGORIES[90]) == (91, "person", "toothbrush")
    names.write_text("\n")
    with pytest.raises(UserError, match="holds no class name"):
        detector(three, names=str(names))
    with pytest.raises(UserError, match=r"detector\.names .*cannot be read"):
        detector(three, names=str(tmp_path / "missing.txt"))


# --- what is no detector -----------------------------------------------------------------------


def test_files_that_are_no_model(tmp_path: Path) -> None:
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


@pytest.mark.parametrize("input_shape", [(1, 1, H, W), (4, 3, H, W), (1, H, W, 3), (1, 3, H)])
def test_inputs_that_are_no_colour_image(input_shape: tuple[int, ...], tmp_path: Path) -> None:
    model = constant(tmp_path / "m.onnx", np.zeros((1, 7, CELLS), np.float32), input_shape=input_shape)
    with pytest.raises(UserError, match=r"no detector of one colour image .*; its inputs: images \["):
        detector(model)


def test_outputs_that_are_no_detections(tmp_path: Path) -> None:
    model = constant(tmp_path / "classifier.onnx", np.zeros((1, 1000), np.float32))
    with pytest.raises(UserError, match=r"no detector; its outputs: output0 \[1, 1000\]; supported: \[1, 4"):
        detector(model)
    decoded = np.full((1, CELLS, 8), 48, np.float32)
    with pytest.raises(UserError, match="decoded already"):
        detector(constant(tmp_path / "decoded.onnx", decoded))
    with pytest.raises(UserError, match="supported: tensor"):
        detector(constant(tmp_path / "double.onnx", np.zeros((1, 7, CELLS)), dtype=TensorProto.DOUBLE))


def test_execution_providers(tmp_path: Path) -> None:
    model = constant(tmp_path / "m.onnx", np.zeros((1, 7, CELLS), np.float32))
    assert detector(model, provider="cpu").provider == "CPU"
    assert detector(model, provider="CPUExecutionProvider").provider == "CPU"
    assert f"YOLOv8, {W} x {H}, 3 classes" in detector(model).description
    with pytest.raises(UserError, match=r"detector.provider TPU: not here; available: .*CPU"):
        detector(model, provider="TPU")


# --- real --------------------------------------------------------------------------------------


def test_yolox_nano_finds_the_pedestrian_of_kitti(shared: Path) -> None:
    see = detector(str(shared / "models/yolox_nano.onnx"))
    assert (see.layout, see.input_size, see.names) == (Layout.YOLOX, (416, 416), COCO)
    image = cv2.imread(str(shared / "kitti/image_2/000000.png"))
    assert image is not None
    result = see(np.asarray(image, np.uint8))
    label = np.array([[712.40, 143.00, 810.73, 307.92]], np.float32)
    found = np.flatnonzero(result.state == KEPT)
    assert [result.names[d] for d in found] == ["person"]
    assert iou(result.xyxy[found], label)[0, 0] > 0.8
    assert result.score[found[0]] > 0.7
