"""How much faster a second command is that finds the detections of the first one in the store.

``bevviz evaluate`` runs over a drive with an empty store, then with another ``clustering.eps``, and each once
more without a store (``BEVVIZ_STORE=``). The results with and without a store must be equal. The networks are
YOLOX-nano, where it is stated, and two of random weights that take images of 640 x 640 and cost as much as
YOLOv8n and YOLOv8s. What these find makes no sense.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks import bags
from benchmarks.measure import children_time, machine

FRAMES = 60  # of the synthetic drive
EPS = (0.5, 0.6)  # of the first and the second run
WANTED = {"YOLOX-nano": 1.5}
WANTED_640 = 3.0
# Channels, and layers of that number, after each halving of the image. With a width of 1 it takes 4.5e9
# multiplications for an image, as YOLOv8n takes 4.4e9; with 2 four times as many, as YOLOv8s.
STAGES = ((16, 1), (32, 4), (64, 5), (128, 5), (256, 4))
SIZE, CLASSES = 640, 80


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--drive", type=Path, help="a labelled drive, else a simulated one")
    parser.add_argument("--model", type=Path, help="YOLOX-nano as ONNX file")
    parser.add_argument("--repetitions", type=int, default=3, metavar="N", help="of each run (default: 3)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        drive = options.drive or bags.simulate(FRAMES, folder / "drive.mcap")
        models = {"YOLOX-nano": options.model} if options.model else {}
        for name, width in (("640 x 640, as YOLOv8n", 1), ("640 x 640, as YOLOv8s", 2)):
            models[name] = make_network(folder / f"random_{width}.onnx", width)
        rows = [_row(name, model, drive, options.repetitions, folder) for name, model in models.items()]
    print(
        machine(),
        "",
        "| network | first, s | second, s | ratio | processor time | wanted | results |",
        "| --- | ---: | ---: | ---: | ---: | ---: | --- |",
        *rows,
        sep="\n",
    )
    return 0


def _row(name: str, model: Path, drive: Path, repetitions: int, folder: Path) -> str:
    """Return the row of a network.

    Raises:
        SystemExit: the store changes a result.
    """
    store = folder / "store"
    runs: dict[str, list[tuple[float, float]]] = {"first": [], "second": []}
    _evaluate(drive, model, EPS[0], "")  # so that nothing is compiled or loaded meanwhile
    for _ in tqdm(range(repetitions), unit="round", desc=name, disable=None):
        shutil.rmtree(store, ignore_errors=True)
        for which, eps in zip(runs, EPS, strict=True):
            result, wall, processor = _evaluate(drive, model, eps, str(store))
            runs[which].append((wall, processor))
            if result != _evaluate(drive, model, eps, "")[0]:
                raise SystemExit(f"{name}, clustering.eps={eps}: the store changes the result")
    (first, first_processor), (second, second_processor) = (
        [median(column) for column in zip(*runs[which], strict=True)] for which in runs
    )
    return (
        f"| {name} | {first:.1f} | {second:.1f} | {first / second:.1f} "
        f"| {first_processor / second_processor:.1f} | {WANTED.get(name, WANTED_640)} | equal |"
    )


def _evaluate(drive: Path, model: Path, eps: float, store: str) -> tuple[Any, float, float]:
    """Return the metrics of a run, its seconds, and its seconds of processor time."""
    command = [sys.executable, "-m", "bevviz", "evaluate", str(drive), "--model", str(model), "--json"]
    before, start = children_time(), time.perf_counter()
    done = subprocess.run(
        [*command, "--set", f"clustering.eps={eps}"],
        env={**os.environ, "BEVVIZ_STORE": store},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(done.stderr[-2000:])
    return json.loads(done.stdout), time.perf_counter() - start, children_time() - before


def make_network(path: Path, width: int) -> Path:
    """Write a network of random weights with the input and output of YOLOv8, and about its cost."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    rng = np.random.default_rng(0)
    nodes: list[Any] = []
    weights: list[Any] = []

    def convolution(source: str, channels: int, kernel: int, stride: int, made: int) -> str:
        """Add a layer and return the name of its output."""
        name = f"layer_{len(weights)}"
        spread = np.sqrt(2 / (channels * kernel**2))
        weight = rng.normal(0, spread, (made, channels, kernel, kernel)).astype(np.float32)
        weights.append(numpy_helper.from_array(weight, f"{name}_weight"))
        weights.append(numpy_helper.from_array(np.zeros(made, np.float32), f"{name}_bias"))
        attributes = {"strides": [stride] * 2, "pads": [kernel // 2] * 4, "kernel_shape": [kernel] * 2}
        inputs = [source, f"{name}_weight", f"{name}_bias"]
        nodes.append(helper.make_node("Conv", inputs, [name], **attributes))
        return name

    def operation(kind: str, inputs: list[str], **attributes: Any) -> str:
        name = f"{kind.lower()}_{len(nodes)}"
        nodes.append(helper.make_node(kind, inputs, [name], **attributes))
        return name

    weights.append(numpy_helper.from_array(np.array([1, 4 + CLASSES, -1]), "flat"))
    weights.append(numpy_helper.from_array(np.array([4, CLASSES]), "parts"))
    source, channels = "images", 3
    heads: list[str] = []
    for made, layers in STAGES:
        for i in range(layers):
            convolved = convolution(source, channels, 3, 2 if i == 0 else 1, made * width)
            source, channels = operation("Relu", [convolved]), made * width
        if made < 64:  # YOLO has no output of so small strides.
            continue
        deep = operation("Relu", [convolution(source, channels, 3, 1, 64 * width)])
        heads.append(operation("Reshape", [convolution(deep, 64 * width, 1, 1, 4 + CLASSES), "flat"]))
    whole = operation("Concat", heads, axis=2)
    nodes.append(helper.make_node("Split", [whole, "parts"], ["boxes", "logits"], axis=1))
    weights.append(numpy_helper.from_array(np.array([-7], np.float32), "doubt"))
    scores = operation("Sigmoid", [operation("Add", ["logits", "doubt"])])
    pixels = operation("Abs", ["boxes"])
    weights.append(numpy_helper.from_array(np.array([100], np.float32), "large"))
    nodes.append(
        helper.make_node("Concat", [operation("Mul", [pixels, "large"]), scores], ["output0"], axis=1)
    )
    count = sum((SIZE // s) ** 2 for s in (8, 16, 32))
    graph = helper.make_graph(
        nodes,
        "random",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, SIZE, SIZE])],
        [helper.make_tensor_value_info("output0", TensorProto.FLOAT, [1, 4 + CLASSES, count])],
        weights,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, path)
    return path


if __name__ == "__main__":
    sys.exit(main())
