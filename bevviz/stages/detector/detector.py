"""Run an ONNX detector on an image and apply the thresholds to its candidates."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort

from bevviz.config import DetectorConfig
from bevviz.errors import UserError
from bevviz.model.frame import F32, I32, I64, U8
from bevviz.model.results import Detections, DetectionState, Masks
from bevviz.stages.detector.image import Placement
from bevviz.stages.detector.layouts import ADAPTER, ModelFacts, find_head
from bevviz.stages.detector.masks import masks as make_masks
from bevviz.stages.detector.names import (
    DEFAULT_STRIDE,
    metadata_names,
    read_names,
    stated_size,
    stated_stride,
)
from bevviz.stages.detector.providers import open_session
from bevviz.stages.detector.session import NetworkSession, list_tensors, reading_answer
from bevviz.stages.detector.suppression import nms
from bevviz.support.onnx_files import DEMO_MODEL
from bevviz.support.text import did_you_mean

MIN_SIDE, MAX_SIDE = 8, 4096  # pixels of the input: one cell of a grid, and the widest cameras of vehicles
MAX_CANDIDATES = 30_000  # best candidates that enter the NMS; Ultralytics has the same limit

# Supported types of the image input.
TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}


@dataclass(frozen=True, slots=True)
class Inference:
    """Candidates of a network for one image in pixels of its input, before the thresholds of a configuration.

    Attributes:
        xyxy: (N, 4) boxes.
        score: (N,) scores.
        class_id: (N,) classes.
        where: placement of the image in the input.
        masks: function that returns the masks of some candidates, from their rows, the detections that they
            became, and the number of all detections. None: the network gives no masks.
    """

    xyxy: F32
    score: F32
    class_id: I32
    where: Placement
    masks: Callable[[I64, I64, int], Masks] | None = None


class Detector:
    """An ONNX detector: BGR image in, 2D boxes in that image's pixels out.

    The model itself tells which input it needs (size, type, colour order, letterbox) and how to read its
    output (``layout``). The sources are its inputs, its metadata, and its output for an image without
    objects.

    Args:
        config: model file, thresholds, provider and threads.

    Attributes:
        path: the ONNX file.
        names: class names by class id, empty if unknown.
        layout: layout of the output.
        provider: onnxruntime execution provider in use, such as ``CPU``.
        input_size: height, width of the network's input; the largest size if the model leaves it open.
        description: all of this in one line.

    Raises:
        UserError: the file is missing or no ONNX file, the detector is unknown, class names are wrong, or the
            provider is missing.
    """

    def __init__(self, config: DetectorConfig) -> None:
        self._config = config
        self.path = path = DEMO_MODEL if config.model == "demo" else Path(config.model)
        self._where = f"detector.model {path}"
        self._session = _open(path, config)
        self.provider = self._session.provider
        metadata = self._session.metadata
        image, *others = self._session.inputs
        self._input, self._rank = image.name, len(image.shape)
        self._check_inputs(image, others)
        self._dtype = TYPES[image.type]
        self._sized = others[0].name if others else None  # name of an input for the size of the image

        height, width = image.shape[-2:]
        self._is_open = not isinstance(height, int), not isinstance(width, int)
        try:
            self._stride = stated_stride(metadata) if any(self._is_open) else DEFAULT_STRIDE
            size = stated_size(metadata) if any(self._is_open) else (height, width)
            names = read_names(config.names) if config.names else metadata_names(metadata)
        except ValueError as error:
            raise UserError(f"{self._where}: {error}") from None
        self.input_size: tuple[int, int] = (
            size[0] if self._is_open[0] else height,
            size[1] if self._is_open[1] else width,
        )
        self._check_size()
        facts = ModelFacts(
            metadata=metadata,
            inputs=tuple(i.name for i in (image, *others)),
            dtype=self._dtype,
            rank=self._rank,
            size=self.input_size,
            names=names,
            outputs=self._probe(),
        )
        with reading_answer(self._where):
            self._head = find_head(facts)
        self.names, self.layout = self._head.names, self._head.layout
        self._wanted = self._wanted_classes()
        self.description = (
            f"{path.name}: {self.layout}, {self.input_size[1]} x {self.input_size[0]}, "
            f"{len(self.names) or 'unnamed'} classes, {self.provider}"
        )

    def __call__(self, bgr: U8) -> Detections:
        """Detect in an (H, W, 3) uint8 BGR image.

        Returns:
            Candidates with a score of ``detector.explain_threshold`` or more, best first: all KEPT
            candidates, and the best of the others up to ``detector.max_candidates`` in total. The candidates
            BELOW_THRESHOLD are exactly those that a lower ``detector.conf_threshold`` would keep. A weak
            candidate that overlaps a stronger one of its class is SUPPRESSED.

        Raises:
            UserError: the model returns impossible numbers, such as scores above 1.
        """
        if not bgr.size:
            return Detections.empty()
        return self.interpret(self.infer(bgr, self._config.explain_threshold))

    def restated(self, config: DetectorConfig) -> Detector:
        """Return a detector with other thresholds or classes that shares this network.

        Raises:
            UserError: class names are wrong.
        """
        other = copy(self)
        other._config = config
        other._wanted = other._wanted_classes()
        return other

    @property
    def has_masks(self) -> bool:
        """Whether the network gives instance masks."""
        return bool(self._head.prototypes)

    @property
    def identity(self) -> str:
        """Text that differs where the same file gives other candidates: provider, layout and class names."""
        return f"{self.provider} {self.layout} {self.input_size} {self.names}"

    def place(self, bgr: U8) -> Placement:
        """Return the placement of an image in the network's input."""
        size = bgr.shape[0], bgr.shape[1]
        return self.layout.feed.place(size, self.input_size, self._is_open, self._stride)

    def prepare(self, bgr: U8) -> tuple[Any, Placement]:
        """Return the network's input for a non-empty image, and the placement of the image in it."""
        where = self.place(bgr)
        return self.layout.feed.blob(bgr, where, self._dtype), where

    def infer(self, bgr: U8, least: float) -> Inference:
        """Return the candidates of a non-empty image with a score of ``least`` or more, before the NMS.

        Raises:
            UserError: as in ``__call__``.
        """
        blob, where = self.prepare(bgr)
        outputs = tuple(self._run(self._head.wanted, blob).values())
        with reading_answer(self._where):
            xyxy, score, class_id, row = self._head.candidates(outputs, where.input_size, least)
            if not self.has_masks:
                return Inference(xyxy, score, class_id, where)
            weights = self._head.coefficients(outputs, row)
        prototypes = outputs[-1][0]

        def masks(rows: I64, kept: I64, count: int) -> Masks:
            with reading_answer(self._where):
                return make_masks(weights[rows], prototypes, xyxy[rows], kept, count, where)

        return Inference(xyxy, score, class_id, where, masks)

    def interpret(self, inference: Inference) -> Detections:
        """Apply the thresholds to the candidates. The result is that of ``__call__``."""
        config, where = self._config, inference.where
        xyxy, score, class_id = inference.xyxy, inference.score, inference.class_id
        is_valid = np.isfinite(xyxy).all(axis=1) & (score >= config.explain_threshold)
        if self._wanted is not None:
            is_valid &= np.isin(class_id, self._wanted)
        order = np.flatnonzero(is_valid)
        order = order[np.argsort(-score[order], kind="stable")[:MAX_CANDIDATES]]
        xyxy, score, class_id = xyxy[order], score[order], class_id[order]

        offset = self.layout.class_offset
        if offset is None:
            suppressor, overlap = np.full(len(order), -1, np.int32), np.zeros(len(order), np.float32)
        else:
            suppressor, overlap = nms(xyxy, class_id, config.iou_threshold, offset)
        # Boxes are clipped after the NMS, as the families' own code does: boxes outside the image suppress,
        # too.
        xyxy = where.to_image(xyxy)
        np.clip(xyxy, 0, np.array(where.image_size[::-1] * 2, np.float32), out=xyxy)
        is_visible = (xyxy[:, 2] > xyxy[:, 0]) & (xyxy[:, 3] > xyxy[:, 1])
        is_visible &= (suppressor < 0) | is_visible[suppressor]
        state = np.where(score >= config.conf_threshold, DetectionState.KEPT, DetectionState.BELOW_THRESHOLD)
        state[suppressor >= 0] = DetectionState.SUPPRESSED

        row = _best(np.flatnonzero(is_visible), state, config.max_candidates)
        suppressor = np.where(suppressor[row] >= 0, np.searchsorted(row, suppressor[row]), -1)
        masks = None
        if inference.masks is not None:
            kept = np.flatnonzero(state[row] == DetectionState.KEPT)
            masks = inference.masks(order[row[kept]], kept, len(row))
        return Detections(
            xyxy=xyxy[row] - np.float32(0.5),  # networks count pixels from the corner of the first pixel
            score=score[row],
            class_id=class_id[row],
            names=tuple(self._name(c) for c in class_id[row].tolist()),
            state=state[row].astype(np.int32),
            suppressed_by=suppressor.astype(np.int32),
            overlap=overlap[row],
            masks=masks,
        )

    def _check_inputs(self, image: Any, others: list[Any]) -> None:
        """Raise a UserError if the inputs are not those of a detector."""
        shape = image.shape
        inputs = list_tensors((i.name, i.shape) for i in (image, *others))
        batch = shape[0] if self._rank == 4 and isinstance(shape[0], int) else 1
        sizes = [i.type == "tensor(int64)" and len(i.shape) == 2 and i.shape[1] == 2 for i in others]
        if self._rank not in (3, 4) or shape[-3] != 3 or len(sizes) > 1 or not all(sizes):
            raise UserError(
                f"{self._where}: no detector of one colour image [1, 3, height, width]; its inputs: {inputs}"
                f"{ADAPTER}"
            )
        if batch != 1:
            raise UserError(
                f"{self._where}: takes {batch} images at a time ({inputs}); export it with a batch of 1"
            )
        if image.type not in TYPES:
            raise UserError(f"{self._where}: its input is {image.type}; supported: {', '.join(TYPES)}")

    def _check_size(self) -> None:
        """Raise a UserError if the input is too small or too large."""
        height, width = self.input_size
        if any(not MIN_SIDE <= side <= MAX_SIDE for side in self.input_size):
            raise UserError(
                f"{self._where}: takes images of {width} x {height} pixels, and {MIN_SIDE} to {MAX_SIDE} "
                "a side are possible; export it with another size"
            )

    def _run(self, outputs: list[str] | None, blob: Any) -> dict[str, Any]:
        """Run the network on one blob and return the outputs by name."""
        feed = {self._input: blob if self._rank == 4 else blob[0]}
        if self._sized is not None:
            feed[self._sized] = np.array([blob.shape[:1:-1]], np.int64)  # boxes come in pixels of it
        return self._session.run(feed, outputs)

    def _probe(self) -> dict[str, Any]:
        """Run the network on grey patches without objects. The output helps to find the layout.

        This also makes the allocations of the first run before the first real image.
        """
        height, width = self.input_size
        patch = np.random.default_rng(0).uniform(0.3, 0.6, (1, 3, -(-height // 32), -(-width // 32)))
        grey = patch.repeat(32, axis=2).repeat(32, axis=3)[:, :, :height, :width]
        whole = self._dtype is np.uint8
        blob = (grey * 255 if whole else grey).astype(self._dtype)
        return self._run(None, blob)

    def _wanted_classes(self) -> I32 | None:
        """Return the ids of the configured classes, None for all classes."""
        for name in self._config.classes:
            if name not in self.names:
                hint = did_you_mean(name, self.names)
                raise UserError(f"detector.classes: the model has no class '{name}'{hint}")
        if not self._config.classes:
            return None
        return np.array([self.names.index(name) for name in self._config.classes], np.int32)

    def _name(self, class_id: int) -> str:
        """Return the name of a class, or its number as a name."""
        return self.names[class_id] if 0 <= class_id < len(self.names) else f"class_{class_id}"


def _best(row: Any, state: Any, limit: int) -> Any:
    """Return the rows that are KEPT and the best of the others, at most ``limit`` in total.

    ``row`` is sorted, best score first. All KEPT rows are returned even if they are more than ``limit``.
    """
    kept = state[row] == DetectionState.KEPT
    room = max(limit - np.count_nonzero(kept), 0)
    others = np.flatnonzero(~kept)
    # Survivors of the NMS come first: a duplicate explains least, and never outlives its suppressor.
    others = others[np.argsort(state[row[others]], kind="stable")]
    return np.delete(row, others[room:])


def _open(path: Path, config: DetectorConfig) -> NetworkSession:
    """Open the session of a detector file."""
    if not path.is_file():
        raise UserError(f"detector.model {path}: no such file")
    if path.suffix == ".pt":
        raise UserError(
            f"detector.model {path}: PyTorch weights; export them: yolo export model={path} format=onnx"
        )
    options = ort.SessionOptions()
    options.intra_op_num_threads = config.threads
    # Spinning threads would use as much processor time as the network, and the LiDAR stages need that time.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return open_session(path, config.provider, options)
