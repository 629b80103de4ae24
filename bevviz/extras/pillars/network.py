"""A 3D detector on pillars: a cloud in, boxes out, with one ONNX file or two."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort

from bevviz.errors import UserError
from bevviz.extras.pillars.group import Pillars, group, scatter
from bevviz.extras.pillars.heads import find_head
from bevviz.extras.pillars.params import MAX_POINTS, PillarParams
from bevviz.extras.pillars.rotated_boxes import survivors
from bevviz.model.frame import F32, Boxes3D
from bevviz.stages.detector.providers import open_session, say_once
from bevviz.stages.detector.session import NetworkSession, clip, list_tensors, reading_answer

FLOATS = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
NUMBERS = {**FLOATS, "tensor(int32)": np.int32, "tensor(int64)": np.int64}
PROBE_POINTS = 8  # points of the first test cloud
MAX_BOX_SIDE = 200.0  # metres: a longer box is no object
MAX_DISTANCE = 10_000.0  # metres: no LiDAR reaches farther


@dataclass(frozen=True, slots=True, eq=False)
class NetworkOutput:
    """Output of a network for one cloud, before any threshold.

    Attributes:
        outputs: name -> array.
        left_out_points: number of points dropped because their pillar was full.
        left_out_pillars: number of pillars dropped because the maximum was reached.
    """

    outputs: Mapping[str, Any]
    left_out_points: int
    left_out_pillars: int


class PillarNetwork:
    """ONNX files of a 3D detector, with the preparation of their inputs.

    One file takes pillars (N, points, features), and optionally the number of points in each (N,) and its
    cell (N, 4), batch z y x, or (N, 3). With two files the encoder takes only the pillars and returns (N,
    channels). These are laid out on the grid [1, channels, y, x] for the second file.

    Args:
        path: ONNX file; with ``params.encoder`` the file of the second part.
        params: only the parameters in ``INPUT_PARAMS`` and ``encoder`` are used.
        provider: onnxruntime execution provider, as ``detector.provider``.
        threads: as ``detector.threads``.

    Attributes:
        provider: execution provider in use, such as ``CPU``.
        probe: output for a few points.

    Raises:
        UserError: the file is missing or no ONNX file, or its inputs do not fit the parameters.
    """

    def __init__(self, path: Path, params: PillarParams, provider: str, threads: int) -> None:
        self.where, self._path = f"objects.method {path}", path
        self._params = params
        self._session = _open(path, self.where, provider, threads)
        self.provider = self._session.provider
        self._encoder = None
        first, at = self._session, self.where
        if params.encoder:
            at = f"objects.encoder {params.encoder}"
            first = self._encoder = _open(params.encoder, at, provider, threads)
        self._latest: tuple[bytes, NetworkOutput] | None = None
        self._inputs = _inputs(first, at, alone=bool(params.encoder))
        self._max_points, self._fixed = self._fitting(self._inputs["pillars"], at)
        if self._encoder is not None:
            self._canvas = self._check_canvas()
        elif self._fixed:
            raise UserError(
                f"{at}: takes {self._fixed} pillars, no more and no less; export it with that axis dynamic"
            )
        # The probe has several pillars, because OpenPCDet's encoder loses an axis with a single one.
        across = np.linspace(params.point_range[:3], params.point_range[3:], PROBE_POINTS + 2)[1:-1]
        self.probe = self.infer((across - [0, 0, params.z_offset]).astype(np.float32))

    def infer(self, points: F32, intensity: F32 | None = None) -> NetworkOutput:
        """Run the network on a cloud. The latest cloud is not run again, so that thresholds cost little.

        Args:
            points: (N, 3) float32, upright, in metres.
            intensity: (N,) of the points, or None.

        Raises:
            UserError: the network fails.
        """
        cloud = _digest(points, intensity)
        latest = self._latest
        if latest is None or latest[0] != cloud:
            latest = self._latest = cloud, self._infer(points, intensity)
        return latest[1]

    def _infer(self, points: F32, intensity: F32 | None) -> NetworkOutput:
        """Run the network on a cloud, as ``infer`` does."""
        params = self._params
        if params.z_offset:
            points = points + np.array([0, 0, params.z_offset], np.float32)
        if intensity is not None and params.intensity_scale != 1:
            intensity = np.asarray(intensity * np.float32(params.intensity_scale), np.float32)
        pillars = group(
            points,
            params.point_range[:3],
            params.voxel_size,
            params.grid,
            params.point_range[5],
            self._max_points,
            min(params.max_pillars, self._fixed or params.max_pillars),
            params.features,
            intensity,
        )
        outputs = self._run(pillars) if len(pillars) else {}
        return NetworkOutput(outputs, pillars.left_out_points, pillars.left_out_pillars)

    def _run(self, pillars: Pillars) -> dict[str, Any]:
        """Run the file or both files on pillars. Return the outputs by name."""
        feed = {}
        for role, wanted in self._inputs.items():
            if role == "pillars":
                value: Any = pillars.points
            elif role == "counts":
                value = pillars.counts
            else:
                value = np.zeros((len(pillars), wanted.shape[1]), np.int32)
                value[:, -1], value[:, -2] = pillars.cells.T
            feed[wanted.name] = value.astype(NUMBERS[wanted.type], copy=False)
        if self._encoder is None:
            return self._session.run(feed)
        if self._fixed:
            ((name, value),) = feed.items()
            feed = {
                name: np.concatenate(
                    [value, np.zeros((self._fixed - len(value), *value.shape[1:]), value.dtype)]
                )
            }
        encoded = next(iter(self._encoder.run(feed).values()))
        channels = self._canvas.shape[1]
        if encoded.ndim < 2 or encoded.size != len(encoded) * channels or len(encoded) < len(pillars):
            raise UserError(
                f"objects.encoder {self._params.encoder}: answers {list(encoded.shape)} to {len(pillars)} "
                f"pillars, and {self._path.name} takes {channels} channels of each"
            )
        encoded = encoded.reshape(len(encoded), channels)[: len(pillars)]
        canvas = scatter(encoded, pillars.cells, self._params.grid)
        return self._session.run({self._canvas.name: canvas.astype(NUMBERS[self._canvas.type], copy=False)})

    def _fitting(self, pillars: Any, at: str) -> tuple[int, int]:
        """Return the number of points of a pillar and the number of pillars, 0 for any number."""
        count, points, features = pillars.shape
        params = self._params
        if isinstance(features, int) and features != len(params.features):
            raise UserError(
                f"{at}: input {pillars.name} has {features} features of a point, objects.features states "
                f"{len(params.features)}: {', '.join(params.features)}"
            )
        if isinstance(points, int):
            if points > MAX_POINTS:
                raise UserError(
                    f"{at}: input {clip(pillars.name)} has {points:,} points of a pillar, and no more than "
                    f"{MAX_POINTS:,} are possible; export it with fewer"
                )
            if params.max_points not in (None, points):
                raise UserError(
                    f"{at}: input {pillars.name} has {points} points of a pillar, "
                    f"objects.max_points states {params.max_points}"
                )
        elif params.max_points is None:
            raise UserError(
                f"{at}: input {pillars.name} leaves the points of a pillar open: set objects.max_points"
            )
        else:
            points = params.max_points
        return points, count if isinstance(count, int) else 0

    def _check_canvas(self) -> Any:
        """Return the input of the second file."""
        inputs, (nx, ny) = self._session.inputs, self._params.grid
        shape = inputs[0].shape
        inputs_text = list_tensors((i.name, i.shape) for i in inputs)
        known = len(inputs) == 1 and len(shape) == 4 and isinstance(shape[1], int)
        if not known or inputs[0].type not in FLOATS:
            raise UserError(
                f"{self.where}: with objects.encoder it should take one map [1, channels, y, x]; "
                f"its inputs: {inputs_text}"
            )
        if any(
            isinstance(n, int) and n != wanted for n, wanted in zip(shape, (1, shape[1], ny, nx), strict=True)
        ):
            raise UserError(
                f"{self.where}: takes {inputs_text}, and by objects.point_range and objects.voxel_size the "
                f"grid is {nx} pillars in x, {ny} in y"
            )
        return inputs[0]


class ObjectNetwork:
    """Decoder of a pillar network's outputs to boxes.

    Args:
        network: the network.
        params: thresholds, and how to read the outputs.

    Raises:
        UserError: the outputs do not fit the parameters.
    """

    def __init__(self, network: PillarNetwork, params: PillarParams) -> None:
        self.network = network
        self._params = params
        with reading_answer(network.where):
            self._head = find_head(network.probe.outputs, params)
        self.interpret(network.probe)  # also compiles the kernels for the first cloud

    @property
    def names(self) -> tuple[str, ...]:
        """Class names of the network."""
        return self._params.classes

    def __call__(self, points: F32, intensity: F32 | None = None) -> tuple[Boxes3D, F32, list[str]]:
        """Detect objects in a cloud.

        Args:
            points: (N, 3) float32, upright, in metres.
            intensity: (N,) of the points, or None.

        Returns:
            Boxes in the frame of the points, best first, their scores, and their class names.

        Raises:
            UserError: the network fails or returns impossible numbers.
        """
        return self.interpret(self.network.infer(points, intensity))

    def interpret(self, output: NetworkOutput) -> tuple[Boxes3D, F32, list[str]]:
        """Apply the thresholds to the network's output. The result is that of ``__call__``."""
        params, where = self._params, self.network.where
        if output.left_out_pillars:
            say_once(
                f"{where}: clouds hold more than {params.max_pillars:,} pillars (objects.max_pillars); "
                "those that come last are left out"
            )
        if not output.outputs:
            return Boxes3D.empty(), np.zeros(0, np.float32), []
        with reading_answer(where):
            candidates = self._head.candidates(output.outputs)
        is_valid = np.isfinite(candidates.boxes).all(axis=1)
        is_valid &= ((candidates.boxes[:, 3:6] > 0) & (candidates.boxes[:, 3:6] < MAX_BOX_SIDE)).all(axis=1)
        is_valid &= (np.abs(candidates.boxes[:, :3]) < MAX_DISTANCE).all(axis=1)
        rows = np.flatnonzero(is_valid)
        rows = rows[np.argsort(-candidates.score[rows], kind="stable")]
        boxes, class_id = candidates.boxes[rows], candidates.class_id[rows]
        shared = {"all": np.zeros_like(class_id), "group": candidates.group[rows], "class": class_id}[
            params.nms
        ]
        alive = survivors(boxes, shared, params.nms_iou, params.nms_distance)
        kept = np.flatnonzero(alive)[: params.max_objects]
        final = boxes[kept]
        final[:, 2] -= params.z_offset
        final[:, 6] = np.arctan2(np.sin(final[:, 6]), np.cos(final[:, 6]))
        rows32 = final.astype(np.float32)
        names = [params.classes[c] for c in class_id[kept].tolist()]
        return Boxes3D(rows32[:, :3], rows32[:, 3:6], rows32[:, 6]), candidates.score[rows][kept], names


def _digest(*arrays: F32 | None) -> bytes:
    """Return the hash of arrays."""
    total = hashlib.blake2b(digest_size=16)
    for array in arrays:
        total.update(b"" if array is None else np.ascontiguousarray(array).data)
    return total.digest()


def _open(path: Path, where: str, provider: str, threads: int) -> NetworkSession:
    """Open the session of one file."""
    if not path.is_file():
        raise UserError(f"{where}: no such file")
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # as in the 2D detector
    return open_session(path, provider, options, where)


def _inputs(session: NetworkSession, where: str, *, alone: bool) -> dict[str, Any]:
    """Return role -> input. The number of axes of an input determines its role."""
    inputs = session.inputs
    inputs_text = list_tensors((i.name, i.shape) for i in inputs)
    roles: dict[str, Any] = {}
    for node in inputs:
        shape = node.shape
        role = {3: "pillars", 2: "cells", 1: "counts"}.get(len(shape), "")
        fits = node.type in (FLOATS if role == "pillars" else NUMBERS) and role not in roles
        fits &= role != "cells" or shape[1] in (3, 4)
        fits &= role != "counts" or shape[0] != 1
        if not role or not fits:
            roles = {}
            break
        roles[role] = node
    if "pillars" not in roles or (alone and len(roles) > 1):
        wanted = "pillars [N, points, features]"
        if not alone:
            wanted += ", and if need be the number of points in each [N] and its cell [N, 4]"
        raise UserError(f"{where}: its inputs are {inputs_text}; a network on pillars takes {wanted}")
    if not alone and "cells" not in roles:
        raise UserError(
            f"{where}: its inputs are {inputs_text}: without the cell of each pillar it is an encoder; set "
            "objects.method to the file behind it, and objects.encoder to this one"
        )
    return roles
