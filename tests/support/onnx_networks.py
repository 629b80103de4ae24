"""Small ONNX networks made to measure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

onnx = pytest.importorskip("onnx", reason="the test networks are built with onnx")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

FLOAT, FLOAT16, DOUBLE = TensorProto.FLOAT, TensorProto.FLOAT16, TensorProto.DOUBLE
INT64, UINT8 = TensorProto.INT64, TensorProto.UINT8

Input = tuple[str, Sequence[int | str | None], int]  # name, shape, type


def node(kind: str, inputs: list[str], outputs: list[str], **attributes: Any) -> Any:
    return helper.make_node(kind, inputs, outputs, **attributes)


def save(
    path: Path,
    nodes: Sequence[Any],
    weights: Mapping[str, NDArray[Any]],
    outputs: Mapping[str, tuple[Sequence[int], int]],
    inputs: Sequence[Input],
    metadata: Mapping[str, str] | None = None,
) -> str:
    """Save a network of these nodes; ``outputs`` has shape and type by name."""
    graph = helper.make_graph(
        list(nodes),
        "test",
        [helper.make_tensor_value_info(name, kind, shape) for name, shape, kind in inputs],
        [helper.make_tensor_value_info(name, kind, shape) for name, (shape, kind) in outputs.items()],
        [numpy_helper.from_array(value, name) for name, value in weights.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    helper.set_model_props(model, dict(metadata or {}))
    onnx.checker.check_model(model)
    onnx.save(model, path)
    return str(path)


def answer(
    path: Path,
    outputs: Mapping[str, NDArray[Any]],
    inputs: Sequence[Input],
    metadata: Mapping[str, str] | None = None,
) -> str:
    """Save a network that gives these outputs for every image."""
    nodes = [node("Identity", [f"constant_{name}"], [name]) for name in outputs]
    kinds = {n: (o.shape, helper.np_dtype_to_tensor_dtype(o.dtype)) for n, o in outputs.items()}
    weights = {f"constant_{name}": np.ascontiguousarray(output) for name, output in outputs.items()}
    return save(path, nodes, weights, kinds, inputs, metadata)


def image_input(*shape: int | str | None, name: str = "images", kind: int = FLOAT) -> Input:
    return name, shape, kind


H, W = 64, 96  # of the small networks' input
STRIDES = (8, 16, 32)
CELLS = sum((H // s) * (W // s) for s in STRIDES)


def constant(
    path: Path,
    *outputs: NDArray[Any],
    inputs: tuple[Input, ...] = (image_input(1, 3, H, W),),
    metadata: dict[str, str] | None = None,
) -> str:
    """Save a network that gives these outputs for every image."""
    return answer(path, {f"output{i}": o for i, o in enumerate(outputs)}, inputs, metadata)


def head(
    layout: str, boxes: NDArray[Any], score: NDArray[Any], classes: NDArray[Any], count: int = 3
) -> NDArray[Any]:
    """Encode boxes x0, y0, x1, y1 of the network input as the output of a network of this layout."""
    center, size = (boxes[:, :2] + boxes[:, 2:]) / 2, boxes[:, 2:] - boxes[:, :2]
    by_class = np.zeros((len(boxes), count))
    if layout == "end-to-end":
        rows = np.zeros((20, 6))
        rows[: len(boxes)] = np.column_stack([boxes, score, classes])
    elif layout == "YOLOv8":
        by_class[np.arange(len(boxes)), classes] = score
        rows = np.zeros((CELLS, 4 + count))
        rows[:] = [W / 2, H / 2, W, H, *[0] * count]
        rows[: len(boxes)] = np.hstack([center, size, by_class])
        return np.asarray(rows.T[None], np.float32)
    else:
        by_class[np.arange(len(boxes)), classes] = score if layout == "YOLOv6" else 0.9
        objectness = (score * 0 + 1 if layout == "YOLOv6" else score / 0.9)[:, None]
        rows = np.zeros((CELLS * (3 if layout == "YOLOv5" else 1), 5 + count))
        place = np.arange(len(boxes))
        if layout == "YOLOX":  # the last cells: stride 32, row and column by hand
            place = CELLS - 1 - place
            grid = np.array([(2, 1), (1, 1), (0, 1), (2, 0)])[: len(boxes)]
            center, size = center / 32 - grid, np.log(size / 32)
        else:
            rows[:] = [W / 2, H / 2, W, H, layout == "YOLOv6", *[0] * count]
        rows[place] = np.hstack([center, size, objectness, by_class])
    return np.asarray(rows[None], np.float32)


def loop(count: str, go_on: str, start: str, end: str, shape: list[int]) -> Any:
    """Make a node that doubles a tensor again and again."""
    boolean = TensorProto.BOOL
    inputs = [("i", INT64, []), ("go", boolean, []), ("x", FLOAT, shape)]
    outputs = [("go_on", boolean, []), ("y", FLOAT, shape)]
    body = helper.make_graph(
        [node("Identity", ["go"], ["go_on"]), node("Add", ["x", "x"], ["y"])],
        "body",
        [helper.make_tensor_value_info(*tensor) for tensor in inputs],
        [helper.make_tensor_value_info(*tensor) for tensor in outputs],
    )
    return node("Loop", [count, go_on, start], [end], body=body)
