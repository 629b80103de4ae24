"""2D object detection with any YOLO-like ONNX file, through onnxruntime."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime as ort

from bevviz.config import DetectorConfig
from bevviz.errors import UserError, first_line
from bevviz.frame import F32, I32, U8, Detections, DetectionState
from bevviz.stages.detector.names import default_names, literal, metadata_names, read_names
from bevviz.stages.detector.suppression import nms

DEMO_MODEL = Path(__file__).parents[2] / "data" / "demo_detector.onnx"
DEFAULT_SIZE = 640  # of models that leave their input size open, as Ultralytics and Megvii train them
MAX_CANDIDATES = 30_000  # that enter the NMS, best first, as Ultralytics bounds what a nonsense model costs
CLASS_OFFSET = 7680.0  # pixels by which Ultralytics moves the boxes of each class in its NMS
GREY = 114  # of the letterbox's border, the same in all these families

# From the fastest down. DirectML and others that are not named here are used when asked for.
PREFERRED_PROVIDERS = ("Tensorrt", "CUDA", "MIGraphX", "ROCM", "OpenVINO", "CoreML", "CPU")


class Layout(StrEnum):
    """How the rows of a model's output are to be read."""

    YOLOV8 = "YOLOv8"  # [1, 4 + classes, N]: centre, size, class scores
    YOLOV5 = "YOLOv5"  # [1, N, 5 + classes], 3 anchors a cell: centre, size, objectness, class scores
    YOLOX = "YOLOX"  # the same with 1 anchor a cell, centre and size still relative to the cell
    END_TO_END = "end-to-end"  # [1, N, 6], as YOLOv10 and YOLO26 export: corners, score, class; no NMS


SUPPORTED = (
    "[1, 4 + classes, N] (YOLOv8, 11), [1, N, 5 + classes] (YOLOv5, YOLOX raw grid), "
    "[1, N, 6] (end-to-end YOLOv10, 26)"
)


@dataclass(frozen=True, slots=True)
class Inference:
    """What a network said of an image, before any threshold."""

    output: Any
    input_size: tuple[int, int]  # height, width of the network's input
    scale: F32  # (2,) x, y: from the image to that input ...
    offset: F32  # (2,) ... and then its shift
    image_size: tuple[int, int]  # width, height


class Detector:
    """An ONNX detector: BGR image in, 2D boxes in that image's pixels out.

    What the model wants (input size, type, colour order, letterbox) and how its output is to be read
    (``layout``) comes from the model itself: its inputs, its metadata, and the shape that one run on a
    grey image returns.

    Args:
        config: model file, thresholds, provider and threads.

    Attributes:
        names: class names by class id.
        layout: how the output is read.
        provider: onnxruntime execution provider in use, such as ``CPU``.
        input_size: height, width of the network's input; the largest one where the model leaves it open.
        description: all of this in one line.

    Raises:
        UserError: no such file, no ONNX file, no detector, wrong class names, or no such provider.
    """

    def __init__(self, config: DetectorConfig) -> None:
        self._config = config
        path = DEMO_MODEL if config.model == "demo" else Path(config.model)
        self._session, self.provider = _open(path, config)
        inputs = self._session.get_inputs()
        where = f"detector.model {path}"
        shape = inputs[0].shape
        batch = shape[0] if isinstance(shape[0], int) else 1
        if len(inputs) != 1 or len(shape) != 4 or (batch, shape[1]) != (1, 3):
            found = ", ".join(f"{i.name} {i.shape}" for i in inputs)
            raise UserError(
                f"{where}: no detector of one colour image [1, 3, height, width]; its inputs: {found}"
            )
        types = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
        if inputs[0].type not in types:
            raise UserError(f"{where}: its input is {inputs[0].type}; supported: {', '.join(types)}")
        self._input, self._dtype = inputs[0].name, types[inputs[0].type]

        metadata = self._session.get_modelmeta().custom_metadata_map
        self._stride = int(literal(metadata.get("stride"), int) or 32)
        size = literal(metadata.get("imgsz"), list) or []
        size = size if len(size) == 2 else [DEFAULT_SIZE, DEFAULT_SIZE]
        self._open_axes = tuple(not isinstance(n, int) for n in shape[2:])
        self.input_size = tuple(
            n if isinstance(n, int) else int(s) for n, s in zip(shape[2:], size, strict=True)
        )
        names = read_names(config.names) if config.names else metadata_names(metadata)
        more = metadata.get("task") in ("segment", "pose")  # these append columns to the class scores
        self._output, self.layout, count = self._probe(where, len(names) if names else None, more)
        self.names = names or default_names(count)
        self._wanted = self._wanted_classes()
        self.description = (
            f"{path.name}: {self.layout}, {self.input_size[1]} x {self.input_size[0]}, "
            f"{len(self.names) or 'unnamed'} classes, {self.provider}"
        )

    def __call__(self, bgr: U8) -> Detections:
        """Detect in an (H, W, 3) uint8 BGR image.

        Returns:
            Candidates with a score of ``detector.explain_threshold`` or more, best first: every one that
            is KEPT, and the best of the others up to ``detector.max_candidates`` in all. Those
            BELOW_THRESHOLD are exactly what a lower ``detector.conf_threshold`` would keep: a weak
            candidate that overlaps a stronger one of its class is SUPPRESSED.
        """
        return self.interpret(self.infer(bgr)) if bgr.size else Detections.empty()

    def restated(self, config: DetectorConfig) -> Detector:
        """The same network with other thresholds or classes; it is not loaded again.

        Raises:
            UserError: wrong class names.
        """
        other = copy(self)
        other._config = config
        other._wanted = other._wanted_classes()
        return other

    def infer(self, bgr: U8) -> Inference:
        """Run the network alone, on an image that is not empty."""
        blob, scale, offset = self._letterbox(bgr)
        output = self._session.run([self._output], {self._input: blob})[0][0]
        return Inference(output, blob.shape[2:], scale, offset, (bgr.shape[1], bgr.shape[0]))

    def interpret(self, found: Inference) -> Detections:
        """What the thresholds make of the network's output; ``__call__`` says what."""
        config = self._config
        xyxy, score, class_id = self._decode(found.output, found.input_size)
        sound = np.isfinite(xyxy).all(axis=1)
        if self._wanted is not None:
            sound &= np.isin(class_id, self._wanted)
        order = np.flatnonzero(sound)
        order = order[np.argsort(-score[order], kind="stable")[:MAX_CANDIDATES]]
        xyxy, score, class_id = xyxy[order], score[order], class_id[order]

        if self.layout is Layout.END_TO_END:
            suppressor, overlap = np.full(len(order), -1, np.int32), np.zeros(len(order), np.float32)
        else:
            offset = 0.0 if self.layout is Layout.YOLOX else CLASS_OFFSET
            suppressor, overlap = nms(xyxy, class_id, config.iou_threshold, offset)
        # Clipped after the NMS, as in the families' own post-processing: what lies outside suppresses, too.
        xyxy -= np.tile(found.offset, 2)
        xyxy /= np.tile(found.scale, 2)
        np.clip(xyxy, 0, np.array(found.image_size * 2, np.float32), out=xyxy)
        seen = (xyxy[:, 2] > xyxy[:, 0]) & (xyxy[:, 3] > xyxy[:, 1])
        seen &= (suppressor < 0) | seen[suppressor]
        state = np.where(score >= config.conf_threshold, DetectionState.KEPT, DetectionState.BELOW_THRESHOLD)
        state[suppressor >= 0] = DetectionState.SUPPRESSED
        row = _best(np.flatnonzero(seen), state, config.max_candidates)
        suppressor = np.where(suppressor[row] >= 0, np.searchsorted(row, suppressor[row]), -1)
        return Detections(
            xyxy=xyxy[row] - np.float32(0.5),  # networks count from the corner of the first pixel
            score=score[row],
            class_id=class_id[row],
            names=tuple(self._name(c) for c in class_id[row].tolist()),
            state=state[row].astype(np.int32),
            suppressed_by=suppressor.astype(np.int32),
            overlap=overlap[row],
        )

    def _letterbox(self, bgr: U8) -> tuple[Any, F32, F32]:
        """The network's input, with the scale and offset (x, y) that took the image there."""
        size = np.array(bgr.shape[:2])
        ratio = float(np.min(np.array(self.input_size) / size))
        yolox = self.layout is Layout.YOLOX
        # Megvii cuts the resized image's fraction of a pixel off, Ultralytics rounds it.
        inner = np.maximum((size * ratio).astype(int) if yolox else np.rint(size * ratio).astype(int), 1)
        padded = -(-inner // self._stride) * self._stride
        outer = np.where(self._open_axes, padded, self.input_size)
        top, left = (0, 0) if yolox else ((outer - inner) // 2).tolist()
        height, width = inner.tolist()
        canvas = np.full((*outer, 3), GREY, np.uint8)
        canvas[top : top + height, left : left + width] = cv2.resize(bgr, (width, height))
        blob = cv2.dnn.blobFromImage(canvas, 1.0 if yolox else 1 / 255, swapRB=not yolox)
        scale = (inner / size)[::-1].astype(np.float32)
        return blob.astype(self._dtype, copy=False), scale, np.array([left, top], np.float32)

    def _decode(self, output: Any, size: Sequence[int]) -> tuple[F32, F32, I32]:
        """Boxes x0, y0, x1, y1 in pixels of the network's input, scores and classes above the threshold."""
        least = self._config.explain_threshold
        if self.layout is Layout.END_TO_END:
            rows = output[output[:, 4] >= least].astype(np.float32)
            return rows[:, :4], rows[:, 4], rows[:, 5].astype(np.int32)
        if self.layout is Layout.YOLOV8:
            scores = output[4 : 4 + len(self.names)]
            row = np.flatnonzero(scores.max(axis=0) >= least)
            boxes, scores = output[:4, row].T.astype(np.float32), scores[:, row].T
        else:
            row = np.flatnonzero(output[:, 4] >= least)  # no product with a class score exceeds objectness
            boxes = output[row, :4].astype(np.float32)
            scores = output[row, 5 : 5 + len(self.names)] * output[row, 4:5]
        class_id = scores.argmax(axis=1).astype(np.int32)
        score = np.take_along_axis(scores, class_id[:, None], axis=1)[:, 0].astype(np.float32)
        if self.layout is Layout.YOLOX:
            cell, stride = _grid(size, _cells(size)[len(output)])
            boxes[:, :2] = (boxes[:, :2] + cell[row]) * stride[row]
            boxes[:, 2:] = np.exp(boxes[:, 2:]) * stride[row]
        half = boxes[:, 2:] / 2
        strong = score >= least
        xyxy = np.hstack([boxes[:, :2] - half, boxes[:, :2] + half])
        return xyxy[strong], score[strong], class_id[strong]

    def _probe(self, where: str, classes: int | None, more: bool) -> tuple[str, Layout, int | None]:
        """Run once on grey; name of the detections' output, its layout and the count of classes.

        This also pays the first run's allocations before the first real image.
        """
        grey = np.full((1, 3, *self.input_size), 0.5, self._dtype)
        try:
            outputs = self._session.run(None, {self._input: grey})
        except Exception as error:  # onnxruntime's errors have no common base class
            raise UserError(
                f"{where}: fails on an input of {list(grey.shape)}: {first_line(error)}"
            ) from None
        names = [o.name for o in self._session.get_outputs()]
        shapes = [list(np.shape(o)) for o in outputs]
        for name, output, shape in zip(names, outputs, shapes, strict=True):
            layout, count = find_layout(shape, self.input_size, classes, more)
            if layout is Layout.YOLOX and np.median(np.abs(output[0, :, :2])) > 8:
                raise UserError(
                    f"{where}: one box a cell {shape} with boxes decoded already; export the raw grid"
                )
            if layout is not None:
                return name, layout, count
        found = ", ".join(f"{name} {shape}" for name, shape in zip(names, shapes, strict=True))
        named = f" for {classes} class names" if classes else ""
        raise UserError(f"{where}: no detector{named}; its outputs: {found}; supported: {SUPPORTED}")

    def _wanted_classes(self) -> I32 | None:
        for name in self._config.classes:
            if name not in self.names:
                near = difflib.get_close_matches(name, self.names, 1)
                hint = f"; did you mean '{near[0]}'?" if near else ""
                raise UserError(f"detector.classes: the model has no class '{name}'{hint}")
        if not self._config.classes:
            return None
        return np.array([self.names.index(name) for name in self._config.classes], np.int32)

    def _name(self, class_id: int) -> str:
        return self.names[class_id] if 0 <= class_id < len(self.names) else f"class_{class_id}"


def _best(row: Any, state: Any, limit: int) -> Any:
    """Every row that is KEPT, and the best of the others up to that many in all; rows have the best first."""
    kept = state[row] == DetectionState.KEPT
    room = max(limit - np.count_nonzero(kept), 0)
    others = np.flatnonzero(~kept)
    # Survivors of NMS first: a duplicate is the least worth a word, and never outlives its suppressor.
    others = others[np.argsort(state[row[others]], kind="stable")]
    return np.delete(row, others[room:])


def find_layout(
    shape: Sequence[int], input_size: Sequence[int], classes: int | None = None, more: bool = False
) -> tuple[Layout | None, int | None]:
    """Layout and count of classes of an output, None where it is none of a detector's.

    One box a cell, summed over neighbouring strides, tells a grid from other lists: 8400 for 640 x 640 and
    strides 8, 16, 32, three times that with YOLOv5's anchors. YOLOv8's boxes need no grid to be decoded:
    the right count of classes will do.

    Args:
        shape: of the output.
        input_size: height and width of the network's input.
        classes: how many there are, None where unknown.
        more: further columns follow those of the classes.
    """
    if len(shape) != 3 or shape[0] != 1:
        return None, None
    _, rows, columns = shape
    cells = _cells(input_size)
    # Rows could also be those of an end-to-end head, 300 as a rule, so that only whole pyramids count.
    pyramids = {count for count, strides in cells.items() if {8, 16, 32} <= set(strides)}
    for fits, layout, count in (
        ((columns in cells or rows - 4 == classes) and columns > rows, Layout.YOLOV8, rows - 4),
        (rows in pyramids, Layout.YOLOX, columns - 5),
        (rows % 3 == 0 and rows // 3 in pyramids, Layout.YOLOV5, columns - 5),
    ):
        if fits and count > 0 and (classes is None or count == classes or (more and count > classes)):
            return layout, classes or count
    return (Layout.END_TO_END, classes) if columns == 6 else (None, None)


def _cells(size: Sequence[int]) -> dict[int, tuple[int, ...]]:
    """Count of grid cells -> strides, for every run of neighbouring strides that divide the input."""
    height, width = size
    whole = [s for s in (4, 8, 16, 32, 64) if height % s == 0 and width % s == 0]
    runs = [tuple(whole[i:j]) for i in range(len(whole)) for j in range(i + 1, len(whole) + 1)]
    return {sum((height // s) * (width // s) for s in run): run for run in runs}


def _grid(size: Sequence[int], strides: Sequence[int]) -> tuple[F32, F32]:
    """(N, 2) column and row, and (N, 1) stride, of each cell in the order of YOLOX's output."""
    cell, stride = [], []
    for s in strides:
        rows, columns = np.indices((size[0] // s, size[1] // s), np.float32)
        cell.append(np.column_stack([columns.ravel(), rows.ravel()]))
        stride.append(np.full((columns.size, 1), s, np.float32))
    return np.concatenate(cell), np.concatenate(stride)


def _open(path: Path, config: DetectorConfig) -> tuple[Any, str]:
    """The session of an ONNX file and the short name of the execution provider it runs on."""
    if not path.is_file():
        raise UserError(f"detector.model {path}: no such file")
    if path.suffix == ".pt":
        raise UserError(
            f"detector.model {path}: PyTorch weights; export them: yolo export model={path} format=onnx"
        )
    available = {name.removesuffix("ExecutionProvider"): name for name in ort.get_available_providers()}
    chosen = [name for name in PREFERRED_PROVIDERS if name in available]
    if config.provider.lower() != "auto":
        asked = config.provider.lower().removesuffix("executionprovider")
        chosen = [name for name in available if name.lower() == asked]
        if not chosen:
            raise UserError(
                f"detector.provider {config.provider}: not here; available: {', '.join(available)}"
            )
    options = ort.SessionOptions()
    options.intra_op_num_threads = config.threads
    options.log_severity_level = 3
    # Threads that spin between runs cost as much processor time as the network, and the LiDAR stages need it.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = ort.InferenceSession(path, options, [available[name] for name in chosen])
    except Exception as error:  # onnxruntime's errors have no common base class
        raise UserError(f"detector.model {path}: onnxruntime cannot load it: {first_line(error)}") from None
    used = session.get_providers()[0].removesuffix("ExecutionProvider")
    if config.provider.lower() != "auto" and used != chosen[0]:
        raise UserError(
            f"detector.provider {config.provider}: could not be started, onnxruntime fell back to {used}"
        )
    return session, used
