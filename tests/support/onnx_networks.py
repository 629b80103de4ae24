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
