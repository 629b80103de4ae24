"""ONNX files that ask for too much, or are broken: one clear line each."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from bevviz.config import DetectorConfig
from bevviz.errors import UserError
from bevviz.stages.detector import Detector, session
from tests.support import onnx_networks
from tests.support.onnx_networks import FLOAT, Input, image_input, loop, node

H, W = 64, 96
CELLS = sum((H // s) * (W // s) for s in (8, 16, 32))
IMAGE = np.zeros((H, W, 3), np.uint8)
IMAGES = image_input(1, 3, H, W)
OPEN = image_input(1, 3, "height", "width")


def yolov8() -> NDArray[np.float32]:
    """Return the output of a YOLOv8 with three classes that finds nothing."""
    rows = np.zeros((1, 7, CELLS), np.float32)
    rows[0, :4] = 32
    return rows


def refused(model: str, **settings: Any) -> str:
    """Return the one line that refuses a model file."""
    with pytest.raises(UserError) as caught:
        Detector(DetectorConfig(model=model, **settings))
    line = str(caught.value)
    assert line.startswith(f"detector.model {model}: ") and len(line) < 2500
    return line


def constant(path: Path, metadata: Mapping[str, str], shape: Input = IMAGES) -> str:
    return onnx_networks.answer(path, {"output0": yolov8()}, (shape,), metadata)


def unchecked(
    path: Path, nodes: list[Any], weights: Mapping[str, NDArray[Any]], outputs: Mapping[str, int]
) -> str:
    """Save a network that onnx's own checks reject."""
    graph = helper.make_graph(
        nodes,
        "test",
        [helper.make_tensor_value_info("images", FLOAT, [1, 3, H, W])],
        [helper.make_tensor_value_info(name, kind, None) for name, kind in outputs.items()],
        [numpy_helper.from_array(value, name) for name, value in weights.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    path.write_bytes(model.SerializeToString())
    return str(path)


def endless(path: Path) -> str:
    """Save a network with a loop that never ends."""
    nodes = [loop("count", "yes", "images", "o", [1, 3, H, W])]
    return unchecked(path, nodes, {"count": np.array(2**62), "yes": np.array(True)}, {"o": FLOAT})


def expanded(path: Path, numbers: int) -> str:
    nodes = [node("ReduceSum", ["images"], ["sum"], keepdims=0), node("Expand", ["sum", "shape"], ["o"])]
    return unchecked(path, nodes, {"shape": np.array([numbers])}, {"o": FLOAT})


# --- metadata ----------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(
    ("names", "said"),
    [
        ("{999999999999: 'x'}", "give a name to class 999999999999, and classes are numbers from 0 to 99999"),
        ("{'0': 'car'}", "give a name to class '0'"),
        ("{(1, 2): 'car'}", r"give a name to class (1, 2)"),
        ("{-1: 'car'}", "give a name to class -1"),
        (f"['{'x' * 10_000}']", "hold a class name of 10,000 characters"),
        (f"['{'x' * 3_000_000}']", "hold a text 'names' of 3,"),
        (str([0] * 100_001), "hold 100,001 class names"),
    ],
)
def test_class_names_that_cannot_be_are_one_clear_line(names: str, said: str, tmp_path: Path) -> None:
    model = constant(tmp_path / "m.onnx", {"names": names})
    assert said in refused(model)
    if "text" not in said:
        assert len(Detector(DetectorConfig(model=model, names=three_names(tmp_path))).names) == 3


def three_names(folder: Path) -> str:
    (folder / "three.names").write_text("car\nperson\ncyclist\n")
    return str(folder / "three.names")


@pytest.mark.parametrize("text", ["(" * 100_000, "{[]: 1}", "\0", "9" * 10_000, "-" * 50_000 + "1"])
def test_metadata_that_are_no_literal_count_as_none(text: str, tmp_path: Path) -> None:
    metadata = dict.fromkeys(("names", "imgsz", "stride"), text)
    with_names = DetectorConfig(model=constant(tmp_path / "m.onnx", metadata), names=three_names(tmp_path))
    assert Detector(with_names).input_size == (H, W)
    refused(constant(tmp_path / "open.onnx", metadata, OPEN))  # its boxes are of another size than 640


@pytest.mark.parametrize(
    ("metadata", "said"),
    [
        ({"imgsz": "[None, None]"}, "state an imgsz of [None, None], which is no height and width"),
        ({"imgsz": "[60000, 60000]"}, "takes images of 60000 x 60000 pixels, and 8 to 4096 a side"),
        ({"imgsz": f"[{10**300}, 640]"}, "pixels, and 8 to 4096 a side are possible"),
        ({"imgsz": "[0, -5]"}, "takes images of -5 x 0 pixels"),
        ({"stride": "1000000000"}, "state a stride of 1000000000, and 1 to 256 are possible"),
        ({"stride": "-32"}, "state a stride of -32"),
    ],
)
def test_sizes_that_cannot_be_are_one_clear_line(metadata: dict[str, str], said: str, tmp_path: Path) -> None:
    assert said in refused(constant(tmp_path / "m.onnx", metadata, OPEN))


# --- sizes and types ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shape", "said"),
    [
        ((1, 3, 60_000, 60_000), "more than 200,000,000 numbers"),
        ((1, 3, 8, 5_000_000), "takes images of 5000000 x 8 pixels"),
        ((1, 3, 0, 64), "[1, 3, 0, 64], which holds nothing"),
        ((1, 3, 2, 64), "takes images of 64 x 2 pixels"),
    ],
)
def test_inputs_of_an_impossible_size_are_refused(shape: tuple[int, ...], said: str, tmp_path: Path) -> None:
    assert said in refused(constant(tmp_path / "m.onnx", {}, image_input(*shape)))


def test_an_answer_beyond_all_measure_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "MAX_OUTPUT_NUMBERS", 1_000_000)
    line = refused(expanded(tmp_path / "m.onnx", 2_000_000))
    assert "answers more than 1,000,000 numbers: o [2000000]" in line


def test_outputs_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    text = {"text": np.array(["a", "b"], object)}
    strings = unchecked(
        tmp_path / "s.onnx", [node("Identity", ["text"], ["o"])], text, {"o": TensorProto.STRING}
    )
    assert "its output o is a tensor(string), no tensor of numbers" in refused(strings)


def test_a_file_with_very_many_outputs_has_a_short_error(tmp_path: Path) -> None:
    many = {f"{'o' * 500}{i}": np.zeros((1, 2), np.float32) for i in range(90)}
    line = refused(onnx_networks.answer(tmp_path / "m.onnx", many, (IMAGES,)))
    assert "no detector that is known here" in line and "and 82 more" in line
    many |= {f"more{i}": np.zeros((1, 2), np.float32) for i in range(20)}
    assert "has 110 outputs, and no more than 100 are read" in refused(
        onnx_networks.answer(tmp_path / "n.onnx", many, (IMAGES,))
    )


@pytest.mark.parametrize(
    ("value", "said"),
    [(np.nan, "scores are no numbers (NaN)"), (np.inf, "it has scores from 0 to inf")],
)
def test_scores_that_are_not_finite_are_refused(value: float, said: str, tmp_path: Path) -> None:
    answer = yolov8()
    answer[0, 5, 3] = value
    assert said in refused(onnx_networks.answer(tmp_path / "m.onnx", {"output0": answer}, (IMAGES,)))


@pytest.mark.parametrize("shape", [(), (0,), (1, 0, 0), (1, 7, 0), (0, 7, CELLS), (1, 0, 85), (1,) * 6])
def test_empty_outputs_and_odd_ranks_are_one_clear_line(shape: tuple[int, ...], tmp_path: Path) -> None:
    refused(onnx_networks.answer(tmp_path / "m.onnx", {"output0": np.zeros(shape, np.float32)}, (IMAGES,)))


def test_long_texts_of_a_file_are_cut_in_errors(tmp_path: Path) -> None:
    task = {"author": "Ultralytics", "task": "x" * 5000}
    assert f"for the task '{'x' * 200}...'" in refused(constant(tmp_path / "m.onnx", task))
    outputs = {"y" * 5000: yolov8()}
    line = refused(onnx_networks.answer(tmp_path / "n.onnx", outputs, (IMAGES,)))
    assert f"output {'y' * 200}... has a name of 5,000 characters" in line


# --- time and memory ---------------------------------------------------------------------------


def test_a_network_that_does_not_answer_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "SECONDS", 0.5)
    start = time.monotonic()
    line = refused(endless(tmp_path / "loop.onnx"))
    assert "does not answer within 0.5 s on an input of [1, 3, 64, 96]; use a smaller network" in line
    assert time.monotonic() - start < 20


def test_a_later_image_has_the_same_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A network that is quick on the first image may hang on another."""
    monkeypatch.setattr(session, "SECONDS", 0.5)
    nodes = [
        node("ReduceMax", ["images"], ["brightest"], keepdims=0),
        node("Greater", ["brightest", "limit"], ["bright"]),
        node("Where", ["bright", "endless", "once"], ["count"]),
        loop("count", "yes", "zero", "end", []),
        node("Add", ["table", "end"], ["output0"]),
    ]
    weights = {
        "limit": np.array(0.9, np.float32),
        "endless": np.array(2**62),
        "once": np.array(1),
        "yes": np.array(True),
        "zero": np.array(0, np.float32),
        "table": yolov8(),
    }
    model = unchecked(tmp_path / "m.onnx", nodes, weights, {"output0": FLOAT})
    detect = Detector(DetectorConfig(model=model))
    assert len(detect(IMAGE)) == 0
    with pytest.raises(UserError, match=r"m\.onnx: does not answer within 0\.5 s on an input of"):
        detect(IMAGE + np.uint8(255))


def test_memory_for_tensors_is_limited(tmp_path: Path) -> None:
    line = refused(expanded(tmp_path / "m.onnx", 10**12))
    assert "needs more than" in line and "GiB of memory; use a smaller network" in line


def test_memory_beyond_the_tensors_is_watched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate a file whose nested functions grow while it is loaded."""
    resident = iter([0, *[10**12] * 1000])
    monkeypatch.setattr(session, "_resident", lambda: next(resident))
    ended: list[bool] = []
    with pytest.raises(session._LimitError, match=r"needs more than .* GiB of memory"):
        session._watch(lambda: time.sleep(1), lambda: ended.append(True), 30)
    assert ended == [True]


def test_a_file_that_does_not_load_in_time_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "SECONDS", 0.2)
    monkeypatch.setattr("onnxruntime.InferenceSession", lambda *_, **__: time.sleep(3))
    line = refused(constant(tmp_path / "m.onnx", {}))
    assert "does not load within 0.2 s; use a smaller network" in line


def functions(path: Path, depth: int) -> str:
    """Functions that call one another twice each: 2 ** depth nodes."""
    versions = [helper.make_opsetid("", 13), helper.make_opsetid("local", 1)]
    model = onnx.load(constant(path, {}))
    for level in range(depth):
        called = {"op_type": f"f{level - 1}", "domain": "local"} if level else {"op_type": "Identity"}
        calls = [helper.make_node(inputs=[x], outputs=[y], **called) for x, y in (("x", "a"), ("a", "y"))]
        model.functions.append(helper.make_function("local", f"f{level}", ["x"], ["y"], calls, versions))
    model.opset_import.append(versions[1])
    model.graph.node.append(helper.make_node(f"f{depth - 1}", ["images"], ["o"], domain="local"))
    model.graph.output.append(helper.make_tensor_value_info("o", FLOAT, None))
    path.write_bytes(model.SerializeToString())
    return str(path)


@pytest.mark.long
def test_a_command_ends_well_while_a_network_still_loads(tmp_path: Path) -> None:
    """A thread of onnxruntime cannot be ended, and must not crash the process that leaves."""
    model = functions(tmp_path / "m.onnx", 28)
    script = f"""
import sys
from bevviz.cli import main
from bevviz.stages.detector import session
session.SECONDS = 3.0
sys.argv = ["bevviz", "demo", "--frames", "1", "--save", "x.rrd", "--set", "detector.model={model}"]
sys.exit(main())
"""
    ended = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False
    )
    assert ended.returncode == 2, ended.stderr
    assert ended.stderr.startswith(f"bevviz: error: detector.model {model}: does not load within 3 s")
    assert len(ended.stderr.splitlines()) == 1


# --- files -------------------------------------------------------------------------------------


def external(path: Path, location: str, length: int | None = None) -> str:
    tensor = onnx.TensorProto(name="w", data_type=FLOAT, dims=[10])
    tensor.data_location = onnx.TensorProto.EXTERNAL
    entries = {"location": location, **({} if length is None else {"length": str(length)})}
    for key, value in entries.items():
        tensor.external_data.add(key=key, value=value)
    graph = helper.make_graph(
        [node("Identity", ["w"], ["o"])],
        "test",
        [helper.make_tensor_value_info("images", FLOAT, [1, 3, H, W])],
        [helper.make_tensor_value_info("o", FLOAT, None)],
        [tensor],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    path.write_bytes(model.SerializeToString())
    return str(path)


@pytest.mark.parametrize(
    "location",
    [
        "../secret.bin",
        "sub/../../secret.bin",
        "/etc/passwd",
        "link.bin",
        "up/secret.bin",
        "missing.bin",
        "/dev/zero",
    ],
)
def test_weights_outside_of_the_folder_are_not_read(location: str, tmp_path: Path) -> None:
    (tmp_path / "secret.bin").write_bytes(bytes(4000))
    folder = tmp_path / "model"
    folder.mkdir()
    (folder / "link.bin").symlink_to(tmp_path / "secret.bin")
    (folder / "up").symlink_to(tmp_path)
    (folder / "sub").mkdir()
    reason = refused(external(folder / "m.onnx", location))
    assert "onnxruntime cannot load it: External data path" in reason
    assert reason.endswith("put the file with the weights beside it (FILE.onnx.data)")


@pytest.mark.parametrize("version", ["1.20.0", "1.23.2", "1.24.0"])
def test_an_onnxruntime_that_reads_such_weights_is_refused(
    version: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("onnxruntime.__version__", version)
    said = refused(constant(tmp_path / "m.onnx", {}))
    assert f"onnxruntime {version} lets a model read files outside of its folder: install 1.24.1" in said


def unknown_operator(path: Path) -> str:
    return unchecked(path, [node("Nonsense", ["images"], ["o"])], {}, {"o": FLOAT})


def foreign_domain(path: Path) -> str:
    nodes = [node("Sort", ["images"], ["o"], domain="com.example")]
    return unchecked(path, nodes, {}, {"o": FLOAT})


def cut(path: Path) -> str:
    constant(path, {})
    path.write_bytes(path.read_bytes()[:-500])
    return str(path)


def large(path: Path) -> str:
    with path.open("wb") as file:
        file.truncate(3 << 30)  # takes no place
    return str(path)


def empty(path: Path) -> str:
    path.write_bytes(b"")
    return str(path)


@pytest.mark.parametrize("make", [unknown_operator, foreign_domain, cut, large, empty])
def test_broken_files_are_one_line_without_noise(
    make: Callable[[Path], str], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    line = refused(make(tmp_path / "m.onnx"))
    assert "onnxruntime_src" not in line and "[ONNXRuntimeError]" not in line
    assert capfd.readouterr() == ("", "")
