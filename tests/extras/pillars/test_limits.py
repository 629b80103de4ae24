"""Files of 3D detectors that do not fit, or need too much: refused in one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from bevviz.config import load
from bevviz.errors import UserError
from bevviz.pipeline.stage_loader import StageLoader
from bevviz.stages.detector import session
from tests.support import onnx_networks
from tests.support.onnx_networks import FLOAT, loop
from tests.support.pillar_networks import autoware, settings_of


def refused_3d(parameters: dict[str, Any]) -> str:
    with pytest.raises(UserError) as caught:
        StageLoader().load(load(settings=settings_of(parameters)))
    line = str(caught.value)
    assert line.startswith("objects.") and "\n" not in line
    return line


def encoder(folder: Path, output: NDArray[Any] | None = None, points: int = 32) -> str:
    answer_ = np.zeros((40, 9), np.float32) if output is None else output
    shape = ("input_features", [40, points, 9], FLOAT)
    return onnx_networks.answer(folder / "other.onnx", {"largest": answer_}, [shape])


def test_an_encoder_whose_answer_does_not_fit_is_refused(tmp_path: Path) -> None:
    sound = autoware(tmp_path)
    shapes = [(40, 8), (7, 9), (360,), (0, 9)]
    for shape in shapes:
        line = refused_3d({**sound, "encoder": encoder(tmp_path, np.zeros(shape, np.float32))})
        assert f"other.onnx: answers {list(shape)} to 8 pillars, and head.onnx takes 9 channels" in line


def test_pillars_of_very_many_points_are_refused(tmp_path: Path) -> None:
    line = refused_3d({**autoware(tmp_path), "encoder": encoder(tmp_path, points=5000)})
    assert "has 5,000 points of a pillar, and no more than 1,000 are possible" in line
    line = refused_3d({**autoware(tmp_path), "encoder": encoder(tmp_path, points=10**8)})
    assert "more than 200,000,000 numbers" in line


def test_a_3d_network_that_does_not_answer_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "SECONDS", 0.5)
    parameters = autoware(tmp_path)
    for key in ("method", "encoder"):
        path = Path(parameters[key])
        model = onnx.load(path)
        given = {"count": np.array(2**62), "yes": np.array(True), "start": np.zeros((), np.float32)}
        model.graph.initializer.extend(numpy_helper.from_array(value, name) for name, value in given.items())
        model.graph.node.append(loop("count", "yes", "start", "end", []))
        model.graph.output.append(helper.make_tensor_value_info("end", FLOAT, []))
        endless_model = path.with_name(f"endless_{path.name}")
        onnx.save(model, endless_model)
        line = refused_3d({**parameters, key: str(endless_model)})
        assert line.startswith(f"objects.{key} {endless_model}: does not answer within 0.5 s on an input")
