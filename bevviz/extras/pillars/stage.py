"""The stage that ``objects.method=FILE.onnx`` names, by the entry point ``objects.onnx``."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from bevviz.extras.pillars.network import ObjectNetwork, PillarNetwork
from bevviz.extras.pillars.params import INPUT_PARAMS, PillarParams
from bevviz.model.frame import F32

Params = PillarParams

_networks: WeakValueDictionary[tuple[object, ...], PillarNetwork] = WeakValueDictionary()


class PillarStage:
    """3D detector of one ONNX file or two. Stages that differ only in thresholds share a network.

    Args:
        params: encoding of the input, decoding of the output, and thresholds.
        file: ONNX file that ``objects.method`` names.
        provider: as ``detector.provider``.
        threads: as ``detector.threads``.

    Attributes:
        network: the network and the decoder of its outputs.
        provider: what the network runs on.
        identity: what the boxes depend on beside the cloud and the files.

    Raises:
        UserError: a file is missing, or does not fit the parameters.
    """

    def __init__(self, params: PillarParams, *, file: Path, provider: str, threads: int) -> None:
        self.network = ObjectNetwork(_shared_network(params, file, provider, threads), params)
        self.provider = self.network.network.provider
        self.identity = f"{self.provider} {params.model_dump_json()}"

    def __call__(self, points: F32) -> tuple[NDArray[np.float32], F32, list[str]]:
        """Return boxes (K, 7), scores and class names of a cloud (N, 4) of x, y, z and intensity."""
        xyz, intensity = np.ascontiguousarray(points[:, :3]), np.ascontiguousarray(points[:, 3])
        boxes, score, names = self.network(xyz, intensity)
        return np.column_stack([boxes.center, boxes.size, boxes.yaw]), score, names


def _shared_network(params: PillarParams, file: Path, provider: str, threads: int) -> PillarNetwork:
    """Return the network of files and input parameters, which is loaded once while a stage has it."""
    inputs = params.model_dump_json(include={*INPUT_PARAMS, "encoder"})
    files = [file, *([params.encoder] if params.encoder else [])]
    key = inputs, provider, threads, *((str(path), _state(path)) for path in files)
    network = _networks.get(key)
    if network is None:
        network = _networks[key] = PillarNetwork(file, params, provider, threads)
    return network


def _state(path: Path) -> Any:
    """Return what changes with the content of a file. None: there is no file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size, status.st_ino
