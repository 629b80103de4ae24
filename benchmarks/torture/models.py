"""Hostile and broken ONNX files: each is loaded and run on an image or a cloud, in a process that is watched.

A case is a sound model, changed in one to three ways. Half of the cases are damaged bytes, the others are
valid protobuf with impossible contents. The same seed gives the same files.
"""

from __future__ import annotations

import io
import os
import random
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from tqdm import tqdm

from benchmarks.torture.worker import Outcome, Worker
from tests.support.onnx_networks import answer, image_input, node, save

SECONDS = 3.0  # that a network has to load, and to answer, in place of the 120 s of users
MEMORY = 2**30  # bytes that a network may take, in place of the 8 GiB of users
SLOWEST = 30.0  # seconds that a case may take: two limits, and a machine that does other things, too
MOST_MEMORY = 3 * MEMORY / 1e6  # MB that a case may take: an answer is copied, and the network still has it
COMMANDS = 5  # every fifth file that is refused goes through the command line, too
LONGEST = 3000  # characters of an error message
H, W = 64, 96  # pixels of the detectors' input

Model = Any  # onnx.ModelProto, which has no types for mypy
Change = Callable[[Model, random.Random], None]


@dataclass
class Tried:
    """Counts of what became of the files."""

    files: int = 0
    refused: int = 0  # with one clear line
    commands: int = 0  # of the command line
    tracebacks: int = 0  # errors that nobody foresaw, ends of the process, and noise beside the one line
    hangs: int = 0  # cases that took longer than they may
    large: int = 0  # cases that took more memory than they may
    slowest: float = 0.0  # seconds
    memory: float = 0.0  # MB at most
    examples: list[str] = field(default_factory=list)

    @property
    def well(self) -> bool:
        return not (self.tracebacks or self.hangs or self.large)


@dataclass(frozen=True)
class Case:
    """A changed model, and how to load it.

    Attributes:
        settings: of the configuration, ``section.key=value``; the changed file is named in them.
        section: ``detector`` or ``objects``.
        uses_command: run the command line, too, where the file is refused.
    """

    settings: tuple[str, ...]
    section: str
    uses_command: bool = False


# --- sound models ------------------------------------------------------------------------------


def detector(path: Path) -> str:
    """Write a YOLOv8 with two layers and three classes."""
    rng = np.random.default_rng(0)
    weights = {
        "kernel": rng.normal(0, 0.01, (7, 3, 8, 8)).astype(np.float32),
        "bias": np.array([40, 30, 20, 20, 0.4, 0.1, 0.1], np.float32),
        "shape": np.array([1, 7, -1]),
    }
    nodes = [
        node("Conv", ["images", "kernel", "bias"], ["cells"], strides=[8, 8]),
        node("Relu", ["cells"], ["positive"]),
        node("Reshape", ["positive", "shape"], ["output0"]),
    ]
    metadata = {"names": "{0: 'car', 1: 'person', 2: 'bus'}", "imgsz": f"[{H}, {W}]", "stride": "32"}
    shapes: dict[str, Any] = {"output0": ([1, 7, H * W // 64], TensorProto.FLOAT)}
    return save(path, nodes, weights, shapes, [image_input(1, 3, H, W)], metadata)


def end_to_end(path: Path) -> str:
    """Write a model with free sizes, masks and a list of boxes."""
    rows = np.zeros((1, 20, 38), np.float32)
    rows[0, :3, :6] = [[10, 10, 40, 40, 0.9, 1], [30, 20, 70, 60, 0.8, 0], [5, 5, 15, 30, 0.6, 2]]
    outputs = {"output0": rows, "output1": np.ones((1, 32, H // 4, W // 4), np.float32)}
    metadata = {
        "names": "{0: 'car', 1: 'person', 2: 'bus'}",
        "author": "Ultralytics",
        "task": "segment",
        "end2end": "True",
        "imgsz": f"[{H}, {W}]",
    }
    return answer(path, outputs, (image_input(1, 3, "height", "width"),), metadata)


def samples(folder: Path) -> list[tuple[Path, Case]]:
    """Write the sound models; returns each file with the case that loads it."""
    from bevviz.support.onnx_files import DEMO_MODEL
    from tests.support.pillar_networks import Reference, autoware, settings_of

    found = []
    for write in (detector, end_to_end):
        path = Path(write(folder / f"{write.__name__}.onnx"))
        found += [(path, Case((f"detector.model={path}",), "detector"))] * 2
    demo = folder / "demo.onnx"
    demo.write_bytes(DEMO_MODEL.read_bytes())
    found.append((demo, Case((f"detector.model={demo}",), "detector")))
    two_files = autoware(folder)
    for name in ("method", "encoder"):
        found.append((Path(two_files[name]), Case(tuple(settings_of(two_files)), "objects")))
    path = folder / "anchors.onnx"
    found.append((path, Case(tuple(Reference("openpcdet_anchors").settings(path)), "objects")))
    return found


# --- damaged bytes -----------------------------------------------------------------------------


def flipped(data: bytearray, rng: random.Random) -> None:
    for _ in range(rng.randrange(1, 9)):
        data[_place(data, rng)] ^= 1 << rng.randrange(8)


def overwritten(data: bytearray, rng: random.Random) -> None:
    at = _place(data, rng)
    noise = rng.choice([rng.randbytes(rng.randrange(1, 32)), b"\xff" * 10, bytes(64), b"\x7f" * 5])
    data[at : at + len(noise)] = noise


def cut(data: bytearray, rng: random.Random) -> None:
    del data[rng.randrange(len(data)) :]


def taken_out(data: bytearray, rng: random.Random) -> None:
    at = _place(data, rng)
    del data[at : at + rng.randrange(1, 200)]


def doubled(data: bytearray, rng: random.Random) -> None:
    at = _place(data, rng)
    data[at:at] = data[at : at + rng.randrange(1, 500)]


def _place(data: bytearray, rng: random.Random) -> int:
    """Choose a byte. Graphs stand at the beginning and at the end of a file, weights between."""
    near = rng.randrange(min(len(data), 3000))
    return rng.choice([near, len(data) - 1 - near, rng.randrange(len(data))])


DAMAGES: Sequence[Callable[[bytearray, random.Random], None]] = (
    flipped,
    flipped,
    overwritten,
    cut,
    taken_out,
    doubled,
)

# --- impossible contents -----------------------------------------------------------------------

SIZES = (0, -1, 1, 2, 7, 85, 4097, 60_000, 10**7, 2**31, 2**40, 2**63 - 1)
TYPES = [kind for kind in TensorProto.DataType.values() if kind]
TEXTS = (
    *("", "None", "[None, None]", "[60000, 60000]", "[0, 0]", "['a', 'b']", "[640]", "640", "-1", "1e99"),
    *("{999999999999: 'x'}", "{'a': 1}", "{(1, 2): 'x'}", "{[]: 1}", "{0: None}", "{0.5: 'x'}", "[[]]"),
    *("(" * 5000, "[" * 300 + "]" * 300, "9" * 6000, "\0", "\x1b[2J", "detect", "pose", "True", "1000000000"),
    *("['" + "x" * 5000 + "']", str(list(range(2000))), "__import__('os').getcwd()"),
)
OPERATORS = (
    *(
        "Relu",
        "Exp",
        "Sqrt",
        "Neg",
        "Identity",
        "Softmax",
        "Transpose",
        "Shape",
        "Size",
        "NonZero",
        "Flatten",
    ),
    *("ReduceSum", "ReduceMax", "ArgMax", "Not", "IsNaN", "MatMul", "Concat", "Reshape", "Expand", "Tile"),
    *("NonMaxSuppression", "TopK", "Gather", "Resize", "Pad", "Slice", "Loop", "If", "Scan", "LSTM", "Conv"),
    *("ConstantOfShape", "Range", "RandomNormal", "EyeLike", "OneHot", "SequenceEmpty", "StringNormalizer"),
    *("MaxPool", "ConvTranspose", "Einsum", "Nonsense", "DequantizeLinear", "Unique", "Compress", "Upsample"),
)


def metadata(model: Model, rng: random.Random) -> None:
    key = rng.choice(["names", "names", "imgsz", "stride", "task", "author", "head", "args", "end2end"])
    kept = {entry.key: entry.value for entry in model.metadata_props}
    helper.set_model_props(model, {**kept, key: rng.choice(TEXTS)})


def input_shape(model: Model, rng: random.Random) -> None:
    _reshape(rng.choice(model.graph.input), rng)


def output_shape(model: Model, rng: random.Random) -> None:
    _reshape(rng.choice(model.graph.output), rng)


def _reshape(value: Any, rng: random.Random) -> None:
    tensor = value.type.tensor_type
    if rng.random() < 0.4:
        tensor.elem_type = rng.choice(TYPES)
        return
    axes = tensor.shape.dim
    if rng.random() < 0.3:
        if rng.random() < 0.5 and axes:
            del axes[rng.randrange(len(axes))]
        else:
            axes.add().dim_value = rng.choice(SIZES)
    for axis in axes:
        if rng.random() < 0.4:
            axis.Clear()
            if rng.random() < 0.7:
                axis.dim_value = rng.choice(SIZES)
            elif rng.random() < 0.5:
                axis.dim_param = rng.choice(["n", "x" * 3000, "\n"])


def inputs(model: Model, rng: random.Random) -> None:
    graph, kind = model.graph, rng.randrange(4)
    if kind == 0:
        del graph.input[:]
    elif kind == 1:
        graph.input.append(graph.input[0])
    elif kind == 2:
        graph.input.append(helper.make_tensor_value_info("more", rng.choice(TYPES), [1, rng.choice(SIZES)]))
    else:
        graph.input[0].CopyFrom(
            helper.make_tensor_sequence_value_info(graph.input[0].name, TensorProto.FLOAT, [1, 3])
        )


def outputs(model: Model, rng: random.Random) -> None:
    graph, kind = model.graph, rng.randrange(5)
    if kind == 0:
        del graph.output[:]
    elif kind == 1:
        del graph.output[rng.randrange(len(graph.output))]
    elif kind == 2:
        graph.output.append(graph.output[0])
    elif kind == 3:
        graph.output[0].name = rng.choice(["", "nothing", graph.input[0].name if graph.input else "x"])
    else:
        for i in range(200):
            graph.node.append(node("Identity", [graph.output[0].name], [f"copy{i}"]))
            graph.output.append(helper.make_tensor_value_info(f"copy{i}", TensorProto.FLOAT, None))


def operator(model: Model, rng: random.Random) -> None:
    chosen = rng.choice(model.graph.node)
    if rng.random() < 0.2:
        chosen.domain = rng.choice(["com.example", "ai.onnx.ml", "com.microsoft", "x" * 1000])
    else:
        chosen.op_type = rng.choice(OPERATORS)


def attribute(model: Model, rng: random.Random) -> None:
    chosen = rng.choice(model.graph.node)
    if not chosen.attribute or rng.random() < 0.5:
        name = rng.choice(["axis", "axes", "to", "strides", "pads", "kernel_shape", "dilations", "group"])
        values = [rng.choice(SIZES) for _ in range(rng.randrange(1, 5))]
        chosen.attribute.append(helper.make_attribute(name, values if rng.random() < 0.6 else values[0]))
        return
    changed = rng.choice(chosen.attribute)
    if changed.ints:
        changed.ints[rng.randrange(len(changed.ints))] = rng.choice(SIZES)
    else:
        changed.i = rng.choice(SIZES)


def wiring(model: Model, rng: random.Random) -> None:
    nodes, kind = model.graph.node, rng.randrange(4)
    if kind == 0:
        del nodes[rng.randrange(len(nodes))]
    elif kind == 1:
        nodes.append(rng.choice(nodes))
    elif kind == 2:
        chosen = rng.choice(nodes)
        if chosen.input:
            chosen.input[rng.randrange(len(chosen.input))] = rng.choice(["", "nothing", chosen.output[0]])
    else:
        first = nodes[0]
        nodes.remove(first)
        nodes.append(first)


def weights(model: Model, rng: random.Random) -> None:
    tensors = model.graph.initializer
    if not tensors:
        return
    tensor, kind = rng.choice(tensors), rng.randrange(6)
    if kind == 0:
        tensor.dims.append(rng.choice(SIZES))
    elif kind == 1 and tensor.dims:
        tensor.dims[rng.randrange(len(tensor.dims))] = rng.choice(SIZES)
    elif kind == 2:
        tensor.data_type = rng.choice(TYPES)
    elif kind == 3:
        tensor.raw_data = tensor.raw_data[: rng.randrange(len(tensor.raw_data) + 1)]
    elif kind == 4:
        tensor.data_location = TensorProto.EXTERNAL
        place = rng.choice(["../x", "/etc/passwd", "/dev/zero", "", "missing", "*/_ORT_MEM_ADDR_/*", "."])
        for key, value in {"location": place, "offset": "0", "length": str(rng.choice(SIZES))}.items():
            tensor.external_data.add(key=key, value=value)
    elif tensor.data_location != TensorProto.EXTERNAL:  # an earlier change may have made it so
        values = numpy_helper.to_array(tensor).copy()
        if values.dtype.kind == "f" and values.size:
            odd = rng.choice([np.nan, np.inf, -np.inf, 1e30, -5.0, 0.0])
            chance = np.random.default_rng(rng.randrange(2**32)).random(values.shape)
            values[chance < rng.choice([0.01, 0.5, 1.1])] = odd
        elif values.size:
            values.flat[rng.randrange(values.size)] = rng.choice(SIZES)
        tensor.CopyFrom(numpy_helper.from_array(values, tensor.name))


def versions(model: Model, rng: random.Random) -> None:
    kind = rng.randrange(4)
    if kind == 0:
        model.ir_version = rng.choice([0, 1, 2, 99, 2**40])
    elif kind == 1:
        model.opset_import[0].version = rng.choice([0, 1, 5, 999, -1, 2**40])
    elif kind == 2:
        del model.opset_import[:]
    else:
        model.opset_import.append(helper.make_opsetid(rng.choice(["com.example", "x" * 500, ""]), 1))


def answers(model: Model, rng: random.Random) -> None:
    """Put an operator behind an output, so that the answer has another shape, type or size."""
    graph = model.graph
    if not graph.output:
        return
    output = rng.choice(graph.output)
    name, inner = output.name, f"{output.name}_inner"
    for each in graph.node:
        each.output[:] = [inner if given == name else given for given in each.output]
    sizes = [rng.choice((1, 2, 1000, 10**5, 10**7)) for _ in range(rng.randrange(1, 4))]
    arguments: dict[str, Any] = {
        "Expand": [np.array([*sizes, 1, 1])],
        "Tile": [np.array(([*sizes, 1, 1, 1])[:3])],
        "Reshape": [np.array(rng.choice([[-1], [1, 1, -1], [-1, 6], [0, 0, -1]]))],
        "Transpose": [],
        "Cast": [],
        "ReduceSum": [],
        "Div": [np.zeros(1, np.float32)],
        "Mul": [np.array(rng.choice([np.nan, np.inf, 1e6, -1.0, 1e-6]), np.float32)],
        "Slice": [np.array([rng.choice([-3, 0, 5])]), np.array([rng.choice([0, 1, 3, 10**9])])],
        "Unsqueeze": [np.array([0])],
        "Sin": [],
        "Softmax": [],
        "Round": [],
    }
    kind = rng.choice(list(arguments))
    names = [f"given{len(graph.initializer) + i}" for i in range(len(arguments[kind]))]
    for argument, given in zip(arguments[kind], names, strict=True):
        graph.initializer.append(numpy_helper.from_array(argument, given))
    attributes = {"Cast": {"to": rng.choice(TYPES)}}.get(kind, {})
    graph.node.append(node(kind, [inner, *names], [name], **attributes))
    output.type.tensor_type.ClearField("shape")
    if kind == "Cast":
        output.type.tensor_type.elem_type = attributes["to"]


def bombs(model: Model, rng: random.Random) -> None:
    """Add what takes endless time or memory."""
    graph = model.graph
    kinds: Sequence[Callable[[Any, random.Random], None]] = (_expand, _multiply, _loop, _repeat)
    if rng.random() < 0.25:
        _functions(model, rng)
    else:
        rng.choice(kinds)(graph, rng)


def _expand(graph: Any, rng: random.Random) -> None:
    size = np.array([rng.choice([10**8, 10**9, 10**12, 2**62])])
    graph.initializer.append(numpy_helper.from_array(size, "bomb_size"))
    graph.node.append(node("ConstantOfShape", ["bomb_size"], ["bomb"]))
    graph.output.append(helper.make_tensor_value_info("bomb", TensorProto.FLOAT, None))


def _multiply(graph: Any, rng: random.Random) -> None:
    side = np.array([rng.choice([3000, 6000])] * 2)
    graph.initializer.append(numpy_helper.from_array(side, "bomb_side"))
    graph.node.append(node("ConstantOfShape", ["bomb_side"], ["bomb0"]))
    for i in range(200):
        graph.node.append(node("MatMul", [f"bomb{i}", f"bomb{i}"], [f"bomb{i + 1}"]))
    graph.node.append(node("ReduceSum", ["bomb200"], ["bomb"]))
    graph.output.append(helper.make_tensor_value_info("bomb", TensorProto.FLOAT, None))


def _loop(graph: Any, rng: random.Random) -> None:
    grows = rng.random() < 0.5
    tensors = [("i", TensorProto.INT64, []), ("go", TensorProto.BOOL, []), ("x", TensorProto.FLOAT, ["n"])]
    results = [("go_on", TensorProto.BOOL, []), ("y", TensorProto.FLOAT, ["m"])]
    body = helper.make_graph(
        [node("Identity", ["go"], ["go_on"]), node("Concat", ["x"] * (1 + grows), ["y"], axis=0)],
        "body",
        [helper.make_tensor_value_info(*tensor) for tensor in tensors],
        [helper.make_tensor_value_info(*tensor) for tensor in results],
    )
    given = {"bomb_count": np.array(2**62), "bomb_go": np.array(True), "bomb_x": np.ones(1, np.float32)}
    graph.initializer.extend(numpy_helper.from_array(value, name) for name, value in given.items())
    graph.node.append(node("Loop", list(given), ["bomb"], body=body))
    graph.output.append(helper.make_tensor_value_info("bomb", TensorProto.FLOAT, None))


def _repeat(graph: Any, rng: random.Random) -> None:
    """Many nodes, or a name that is long."""
    length, count = rng.choice([(10, 5000), (10**6, 1)])
    name = "x" * length
    for _ in range(count):
        graph.node.append(node("Relu", [graph.output[0].name], [f"{name}{len(graph.node)}"]))


def _functions(model: Model, rng: random.Random) -> None:
    """Functions that call one another twice each, so that a few lines become millions of nodes."""
    depth, versions_ = rng.choice([8, 24]), [helper.make_opsetid("", 13), helper.make_opsetid("local", 1)]
    for level in range(depth):
        below = f"f{level - 1}"
        calls = [
            helper.make_node(below if level else "Identity", [x], [y], domain="local" if level else "")
            for x, y in (("x", "a"), ("a", "y"))
        ]
        model.functions.append(helper.make_function("local", f"f{level}", ["x"], ["y"], calls, versions_))
    model.opset_import.append(helper.make_opsetid("local", 1))
    call = helper.make_node(f"f{depth - 1}", [model.graph.output[0].name], ["bomb"], domain="local")
    model.graph.node.append(call)
    model.graph.output.append(helper.make_tensor_value_info("bomb", TensorProto.FLOAT, None))


CHANGES: Sequence[Change] = (
    *(metadata, input_shape, output_shape, inputs, outputs, operator, attribute, wiring, weights, weights),
    *(versions, answers, answers, answers, bombs),
)


def changed(data: bytes, rng: random.Random) -> tuple[bytes, list[str]]:
    """Change a model; returns the file, and the names of what was done to it."""
    names = []
    if rng.random() < 0.5:
        damaged = bytearray(data)
        for _ in range(rng.choice([1, 1, 2])):
            if damaged:
                damage = rng.choice(DAMAGES)
                damage(damaged, rng)
                names.append(damage.__name__)
        return bytes(damaged), names
    model = onnx.load_from_string(data)
    for _ in range(rng.choice([1, 1, 2, 3])):
        change = rng.choice(CHANGES)
        try:
            change(model, rng)
        except (IndexError, ValueError, TypeError):  # an earlier change left nothing to change
            continue
        names.append(change.__name__)
    return model.SerializeToString(), names


# --- the trial ---------------------------------------------------------------------------------


def try_model(case: Case) -> Outcome:
    """Load a changed model and run it twice.

    Returns:
        The outcome. ``said`` holds the error line, where there is one, and a word for a command that ran.
    """
    from bevviz.errors import UserError
    from bevviz.stages.detector import session

    session.SECONDS = SECONDS
    session.MAX_MEMORY = MEMORY
    session.memory_limit.cache_clear()
    outcome = Outcome()
    with _printed() as lines:
        try:
            _load_and_run(case)
        except UserError as error:
            outcome.said.append(str(error))
        except Exception:
            outcome.traceback = traceback.format_exc()
        if case.uses_command and outcome.said and not _limited(outcome):
            outcome.traceback += _command(case)
            outcome.said.append("command")
    outcome.traceback += "".join(f"printed: {line}\n" for line in lines if not line.startswith("bevviz: "))
    if any(not line or "\n" in line or len(line) > LONGEST for line in outcome.said):
        outcome.traceback += f"no clear line: {outcome.said[0][:500]!r}"
    return outcome


def _limited(outcome: Outcome) -> bool:
    """Whether the network took too much time or memory, and may still do so."""
    return any("within" in line or "GiB of memory" in line for line in outcome.said)


def _load_and_run(case: Case) -> None:
    from bevviz.config import load
    from bevviz.pipeline.stage_loader import StageLoader

    rng = np.random.default_rng(0)
    config = load(settings=list(case.settings))
    stages = StageLoader().load(config)
    if case.section == "detector":
        assert stages.detector is not None
        for size in ((H, W, 3), (120, 50, 3)):
            stages.detector(rng.integers(0, 255, size, np.uint8))
    else:
        assert stages.objects is not None
        for number, count in enumerate((500, 20)):
            points = rng.uniform((0, -8, -3, 0), (24, 8, 1, 1), (count, 4)).astype(np.float32)
            stages.objects(points, stamp=0, number=number, sensor="top")


def _command(case: Case) -> str:
    """Run ``bevviz demo`` with the model; returns what is wrong with how it ended, else nothing."""
    from bevviz.cli import main

    said, settings = io.StringIO(), [part for text in case.settings for part in ("--set", text)]
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(io.StringIO()), redirect_stderr(said):
        save_to = ["--save", str(Path(folder) / "demo.rrd")]
        status = main(["demo", "--frames", "1", *save_to, *settings])
    lines = [line for line in said.getvalue().splitlines() if "bevviz: error" in line]
    if status == 2 and len(lines) == 1:
        return ""
    return f"the command ended with status {status}: {said.getvalue()[-500:]}"


@contextmanager
def _printed() -> Iterator[list[str]]:
    """Collect what is printed to standard error meanwhile, by libraries as well."""
    lines: list[str] = []
    kept = os.dup(2)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            yield lines
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            file.seek(0)
            lines += file.read().decode("utf-8", "replace").splitlines()[:5]


def run(seed: int, files: int) -> Iterator[Tried]:
    """Try ``files`` changed models; yields once, at the end."""
    total = Tried()
    with tempfile.TemporaryDirectory(prefix="bevviz-torture-") as name, Worker() as worker:
        folder = Path(name)
        sound = samples(folder)
        contents = {path: path.read_bytes() for path, _ in sound}
        for path, case in dict(sound).items():  # so that what is loaded once counts for nobody
            outcome = worker.do(try_model, case)
            if outcome.said or outcome.traceback:
                raise RuntimeError(f"{path.name} is not sound: {outcome.said} {outcome.traceback}")
        for number in tqdm(range(files), unit="file", desc="models", disable=None):
            rng = random.Random(f"{seed} models {number}")
            path, case = rng.choice(sound)
            data, names = changed(contents[path], rng)
            path.write_bytes(data)
            if number % COMMANDS == 0:
                case = Case(case.settings, case.section, uses_command=True)
            _try(worker, case, f"file {number} ({path.name}: {', '.join(names)})", total)
            path.write_bytes(contents[path])
    yield total


def _try(worker: Worker, case: Case, title: str, total: Tried) -> None:
    start = time.monotonic()
    outcome = worker.do(try_model, case)
    seconds = time.monotonic() - start
    if _limited(outcome):
        worker.restart()
    total.files += 1
    total.commands += len(outcome.said[1:])
    total.refused += len(outcome.said[:1])
    total.tracebacks += bool(outcome.traceback)
    total.hangs += int(outcome.hung or seconds > SLOWEST)
    total.large += int(outcome.memory > MOST_MEMORY)
    total.slowest = max(total.slowest, seconds)
    total.memory = max(total.memory, outcome.memory)
    if outcome.traceback or outcome.hung or seconds > SLOWEST or outcome.memory > MOST_MEMORY:
        trace = outcome.traceback[-1500:]
        total.examples.append(f"{title}: {seconds:.0f} s, {outcome.memory:.0f} MB, {outcome.said} {trace}")


HEAD = (
    "| ONNX files | refused in one line | through a command, too | tracebacks, ends, noise | hangs "
    "| too much memory | slowest, s | memory, MB |\n| ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"
)


def row(total: Tried) -> str:
    return (
        f"| {total.files} | {total.refused} | {total.commands} | {total.tracebacks} | {total.hangs} "
        f"| {total.large} | {total.slowest:.1f} | {total.memory:.0f} |"
    )
