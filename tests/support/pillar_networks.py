"""ONNX networks that stand for 3D detectors on pillars, with the references they are held to."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from bevviz.config import Config, load
from bevviz.extras.pillars.network import ObjectNetwork
from bevviz.extras.pillars.stage import PillarStage
from bevviz.pipeline.stage_loader import StageLoader
from tests.support.onnx_networks import FLOAT, INT64, Input, answer, node, save

REFERENCES = Path(__file__).parents[1] / "extras/pillars/references"
INPUTS: list[Input] = [
    ("voxels", ["n", 32, 4], FLOAT),
    ("num_points", ["n"], INT64),
    ("coors", ["n", 4], INT64),
]


LOW, SIZE, SHAPE, HIGH_Z = (0.0, -8.0, -3.0), (0.5, 0.5, 4.0), (48, 32), 1.0


class Reference:
    """A head's maps, parameters and boxes."""

    def __init__(self, name: str) -> None:
        with np.load(REFERENCES / f"{name}.npz") as file:
            self.params: dict[str, Any] = json.loads(str(file["params"]))
            self.boxes, self.score, self.label = file["boxes"], file["score"], file["label"]
            self.outputs = {
                key.removeprefix("output_"): file[key].astype(np.float32)
                for key in file.files
                if key.startswith("output_")
            }

    def settings(self, path: Path, **changed: Any) -> list[str]:
        model = answer(path, self.outputs, INPUTS)
        stated = {**self.params, **changed}
        return [f"objects.method={model}", *(f"objects.{k}={json.dumps(v)}" for k, v in stated.items())]

    def network(self, path: Path, **changed: Any) -> ObjectNetwork:
        return network(load(settings=self.settings(path, **changed)))


def network(config: Config) -> ObjectNetwork:
    found = StageLoader(store=False).load(config).objects
    assert found is not None and isinstance(found.call, PillarStage)
    return found.call.network


def autoware(folder: Path, features: int = 9) -> dict[str, Any]:
    """Save an encoder and a head with one object, by the names and shapes of Autoware's CenterPoint."""
    nodes = [node("ReduceMax", ["input_features"], ["largest"], axes=[1], keepdims=0)]
    encoder = save(
        folder / "encoder.onnx",
        nodes,
        {},
        {"largest": ((40, features), FLOAT)},
        [("input_features", [40, 32, features], FLOAT)],
    )
    cell, maps = (0, slice(None), 10, 20), {}
    for name, values in {
        "heatmap": (-9.0, 2.0),
        "reg": (0.25, 0.5),
        "height": (-0.5,),
        "dim": tuple(np.log([1.8, 4.5, 1.6])),
        "rot": (np.sin(0.3), np.cos(0.3)),
        "vel": (0.0, 0.0),
    }.items():
        maps[name] = np.zeros((1, len(values), 32, 48), np.float32)
        if name == "heatmap":
            maps[name][:] = -9
        maps[name][cell] = values
    head = answer(folder / "head.onnx", maps, [("spatial_features", [1, features, 32, 48], FLOAT)])
    decoration = ["mean_x", "mean_y", "mean_z", "center_x", "center_y", "center_z"]
    return {
        "method": head,
        "encoder": encoder,
        "point_range": [0, -8, -3, 24, 8, 1],
        "voxel_size": SIZE,
        "classes": ["CAR", "PEDESTRIAN"],
        "features": ["x", "y", "z", "time", *decoration][:features],
        "boxes": "wlh",
        "rotation": "sin_cos",
        "min_rotation": {"CAR": 0.3},
    }


def settings_of(parameters: dict[str, Any]) -> list[str]:
    return [f"objects.{key}={json.dumps(value)}" for key, value in parameters.items()]
