"""Table of the output layouts of detection models, and the rules that distinguish them.

A model file says little about its layout. The exporter's metadata count first, then names and shapes of the
outputs, then their values for an image without objects. An ambiguous model is refused, because boxes read
from the wrong columns look like a bad detector.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from bevviz.model.frame import I64
from bevviz.stages.detector import outputs as read
from bevviz.stages.detector.image import ImageFit, InputFormat, Resampling
from bevviz.stages.detector.names import COCO, COCO_CATEGORIES, MAX_CLASSES, default_names
from bevviz.stages.detector.outputs import BoxFormat, Candidates, ListedBoxes, ScoredBoxes
from bevviz.stages.detector.session import clip, list_tensors

CLASS_OFFSET = 7680.0  # pixels by which Ultralytics shifts the boxes of each class in its NMS


class LayoutMatch(NamedTuple):
    """Outputs to read with a layout."""

    outputs: tuple[str, ...]
    classes: int | None = None  # None: the outputs do not show how many


@dataclass(frozen=True, slots=True)
class ModelFacts:
    """Facts that a model file shows without documentation."""

    metadata: Mapping[str, str]
    inputs: tuple[str, ...]  # names
    dtype: type  # dtype of the image input
    rank: int  # number of axes of the image input
    size: tuple[int, int]  # height and width of the image input
    names: tuple[str, ...] | None  # class names
    outputs: Mapping[str, Any]  # name -> array, for an image without objects

    @property
    def ultralytics(self) -> bool:
        """Whether Ultralytics exported the model."""
        return self.metadata.get("author") == "Ultralytics"

    @property
    def task(self) -> str:
        """The task in the metadata, empty if missing."""
        return self.metadata.get("task", "")

    @property
    def tables(self) -> dict[str, Any]:
        """Outputs that are one table, by name, as (rows, columns) arrays."""
        return {name: o[0] for name, o in self.outputs.items() if o.ndim == 3 and len(o) == 1}

    @property
    def masks(self) -> int:
        """Number of columns that weight mask prototypes, an output of a quarter of the input size."""
        quarter = tuple(n // 4 for n in self.size)
        return next((o.shape[1] for o in self.outputs.values() if o.ndim == 4 and o.shape[2:] == quarter), 0)

    def named(self, *names: str) -> tuple[str, ...] | None:
        """Return the outputs with these names, also after a graph's name. Return None if one is missing."""
        matches = [[o for o in self.outputs if o == name or o.endswith(f"_{name}")] for name in names]
        return tuple(o[0] for o in matches) if all(len(o) == 1 for o in matches) else None

    def classes(self, columns: int) -> int | str:
        """Return how many of the columns after the boxes are classes, or why that is impossible."""
        if self.names is None:
            return columns - self.masks if columns > self.masks else "it has no scores of classes"
        extra = columns - len(self.names)
        if extra in (0, self.masks) or (extra > 0 and self.task in ("segment", "pose")):
            return len(self.names)
        return f"it scores {columns} classes, but has {len(self.names)} class names"


Finder = Callable[[ModelFacts], LayoutMatch | str | None]
"""Return the outputs to read, None for another layout, or why a model of this layout cannot be read."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Output format of one family of networks, and the input that it needs."""

    name: str
    find: Finder
    split: Callable[..., ScoredBoxes | ListedBoxes]
    boxes: BoxFormat
    feed: InputFormat
    class_offset: float | None = None  # pixels, for the NMS; None: the network does its own NMS
    batch: bool = True  # the first axis of the outputs is the batch
    background: bool = False  # class 0 is the background

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True, slots=True)
class Head:
    """Reader of one model's outputs."""

    layout: Layout
    outputs: tuple[str, ...]
    classes: int | None
    names: tuple[str, ...]  # class names, empty if unknown
    prototypes: str = ""  # output with mask prototypes; empty: none
    trusted: bool = False  # Ultralytics exported the model
    objectness_alone: bool = False  # the score of the only class says nothing

    @property
    def wanted(self) -> list[str]:
        """Names of all outputs to read."""
        return [*self.outputs, *filter(None, [self.prototypes])]

    def split(self, outputs: Sequence[Any]) -> ScoredBoxes | ListedBoxes:
        """Split the outputs into boxes, scores and classes."""
        batch = self.layout.batch
        split = self.layout.split(self.classes, *(output[0] if batch else output for output in outputs))
        if self.objectness_alone and isinstance(split, ScoredBoxes):
            return split._replace(scores=np.ones_like(split.scores))
        return split

    def candidates(self, outputs: Sequence[Any], size: tuple[int, int], least: float) -> Candidates:
        """Return the detections of a run with a score of ``least`` or more.

        Args:
            outputs: the wanted outputs for one image.
            size: height and width of the input.
            least: lowest score.

        Raises:
            ValueError: the numbers contradict the layout.
        """
        split = self.split(outputs[: len(self.outputs)])
        best = read.candidates(split, self.layout.boxes, size, least)
        class_id = split.class_id[split.score >= least] if isinstance(split, ListedBoxes) else best.class_id
        boxes = split.boxes[best.row]
        wrong = read.wrong_list(best.score, class_id, self.names)
        wrong = wrong or read.wrong_candidates(boxes, best.score, self.layout.boxes, self.trusted)
        if isinstance(split, ListedBoxes):
            wrong = wrong or read.swapped_columns(split.score, split.class_id)
        if wrong:
            raise ValueError(f"read as {self.layout}, {wrong}{ADAPTER}")
        return best

    def coefficients(self, outputs: Sequence[Any], rows: I64) -> Any:
        """Return the (K, C) weights of the prototypes in these rows. They are the last columns."""
        table = outputs[0][0].T if self.layout.split is read.columns else outputs[0][0]
        return table[rows, -outputs[-1].shape[1] :]

    def doubt(self, facts: ModelFacts) -> str:
        """Return why the outputs for an image without objects contradict the layout, empty if they do not."""
        split = self.split([facts.outputs[name] for name in self.outputs])
        if isinstance(split, ListedBoxes):
            is_real = split.score > 0
            split = ListedBoxes(*(column[is_real] for column in split))
            wrong = read.wrong_list(split.score, split.class_id, self.names)
        else:
            counted = facts.ultralytics or facts.names is not None or self.classes == len(COCO)
            wrong = read.wrong_scores(split, counted) or read.coarse_scores(split)
        return wrong or read.wrong_boxes(split.boxes, self.layout.boxes, facts.ultralytics)


# --- rules that distinguish layouts ------------------------------------------------------------


def _in_a_table(find: Callable[[ModelFacts, str, Any], LayoutMatch | str | None]) -> Finder:
    """Apply ``find`` to each table until one matches.

    There is no match if the boxes have a table of their own.
    """

    def find_in_any(facts: ModelFacts) -> LayoutMatch | str | None:
        if any(table.shape[1] == 4 for table in facts.tables.values()):
            return None
        reason = None
        for name, table in facts.tables.items():
            match = find(facts, name, table)
            if isinstance(match, LayoutMatch):
                return match
            reason = reason or match
        return reason

    return find_in_any


def _match(outputs: tuple[str, ...], classes: int | str) -> LayoutMatch | str:
    """Return the match, or the reason why it cannot be read."""
    return classes if isinstance(classes, str) else LayoutMatch(outputs, classes)


def _are_whole_numbers(values: Any) -> bool:
    """Return whether all values are whole numbers."""
    return bool((values == np.rint(values)).all())


def _is_rtdetr(facts: ModelFacts) -> bool:
    """Return whether it is an RT-DETR of Ultralytics. Older files do not name the head."""
    head = facts.metadata.get("head")
    described = "rtdetr" in facts.metadata.get("description", "").lower()
    return facts.ultralytics and (head == "RTDETRDecoder" or (head is None and described))


@_in_a_table
def _rtdetr_list(facts: ModelFacts, name: str, table: Any) -> LayoutMatch | str | None:
    """Find an RT-DETR of Ultralytics with a list of boxes."""
    is_list = table.shape[1] == 6 and _are_whole_numbers(table[:, 5])
    return LayoutMatch((name,)) if is_list and _is_rtdetr(facts) else None


@_in_a_table
def _rtdetr_scores(facts: ModelFacts, name: str, table: Any) -> LayoutMatch | str | None:
    """Find an RT-DETR of Ultralytics with a score of each class."""
    return _match((name,), facts.classes(table.shape[1] - 4)) if _is_rtdetr(facts) else None


def _rtdetr_repository(facts: ModelFacts) -> LayoutMatch | str | None:
    """Find an RT-DETR or D-FINE of the authors' repositories."""
    names = facts.named("boxes", "scores", "labels")
    if not names or "orig_target_sizes" not in facts.inputs:
        return None
    ranks = tuple(facts.outputs[name].ndim for name in names)
    return LayoutMatch(names) if ranks == (3, 2, 2) else None


def _deim(facts: ModelFacts) -> LayoutMatch | str | None:
    """Find a DEIM, whose outputs are those of RT-DETR without the axis of the batch."""
    names = facts.named("boxes", "scores", "labels")
    if not names or "orig_target_sizes" not in facts.inputs:
        return None
    ranks = tuple(facts.outputs[name].ndim for name in names)
    return LayoutMatch(names) if ranks == (2, 1, 1) else "its lists of boxes, scores and labels do not fit"


def _rfdetr(facts: ModelFacts) -> LayoutMatch | str | None:
    """Find an RF-DETR."""
    names = facts.named("dets", "labels")
    if names is None or any(name not in facts.tables for name in names):
        return None
    columns = facts.tables[names[1]].shape[1]
    # COCO's weights have a column for each category id. Other weights have the background as last column.
    classes = columns if columns == len(COCO_CATEGORIES) else columns - 1
    if facts.names is not None and len(facts.names) != classes:
        return f"it scores {classes} classes, but has {len(facts.names)} class names"
    return LayoutMatch(names, classes)


def _supergradients(*names: str) -> Finder:
    """Return a finder of YOLO-NAS with these outputs."""

    def find(facts: ModelFacts) -> LayoutMatch | str | None:
        outputs = facts.named(*names)
        if outputs and facts.dtype is not np.uint8:
            return "nothing tells how YOLO-NAS wants its pixels: export it with preprocessing=True"
        return LayoutMatch(outputs) if outputs else None

    return find


def _torchvision(facts: ModelFacts) -> LayoutMatch | str | None:
    """Find a torchvision detector."""
    if facts.rank != 3:
        return None
    boxes = [name for name, o in facts.outputs.items() if o.ndim == 2 and o.shape[1] == 4]
    score = [name for name, o in facts.outputs.items() if o.ndim == 1 and o.dtype.kind == "f"]
    label = [name for name, o in facts.outputs.items() if o.ndim == 1 and o.dtype.kind == "i"]
    return LayoutMatch((boxes[0], score[0], label[0])) if boxes and score and label else None


def _two_tables(facts: ModelFacts) -> LayoutMatch | str | None:
    """Find a model with one table of boxes and one of scores."""
    shapes = {name: table.shape for name, table in facts.tables.items()}
    boxes = next((name for name, shape in shapes.items() if shape[1] == 4), None)
    if boxes is None:
        return None
    scores = [name for name in shapes if name != boxes and shapes[name][0] == shapes[boxes][0]]
    if not scores:
        return None
    if not facts.ultralytics:
        return "nothing tells how it wants its image; export YOLO-NAS with its pre- and postprocessing"
    return _match((boxes, scores[0]), facts.classes(shapes[scores[0]][1]))


def _yolov7_list(facts: ModelFacts) -> LayoutMatch | str | None:
    """Find a YOLOv7 with NMS."""
    lists = [name for name, o in facts.outputs.items() if o.ndim == 2 and o.shape[1] == 7]
    return LayoutMatch((lists[0],)) if lists else None


@_in_a_table
def _yolov8(facts: ModelFacts, name: str, table: Any) -> LayoutMatch | str | None:
    """Find a YOLOv8 or one of its relatives."""
    rows, columns = table.shape
    # These boxes are decoded already, so the right number of classes is sufficient.
    known = columns in read.cells(facts.size) or (facts.names is not None and rows - 4 == len(facts.names))
    return _match((name,), facts.classes(rows - 4)) if known and columns > rows > 4 else None


def _with_objectness(facts: ModelFacts, name: str, table: Any, anchors: int) -> LayoutMatch | str | None:
    """Find a table with a row for each anchor of each cell: box, objectness, classes."""
    rows, columns = table.shape
    # The rows could also be a list, usually of 300. Therefore only complete pyramids count.
    pyramids = [count for count, strides in read.cells(facts.size).items() if {8, 16, 32} <= set(strides)]
    if rows % anchors or rows // anchors not in pyramids or columns < 6:
        return None
    if any(len(other) == rows for key, other in facts.tables.items() if key != name):
        return None  # Scores and boxes are in tables of their own, as NanoDet and PicoDet have them.
    if facts.ultralytics or (columns == 6 and table[:, 5].any() and _are_whole_numbers(table[:, 5])):
        return None  # no head of Ultralytics has an objectness, and whole numbers are the classes of a list
    return _match((name,), facts.classes(columns - 5))


@_in_a_table
def _yolov5(facts: ModelFacts, name: str, table: Any) -> LayoutMatch | str | None:
    """Find a YOLOv5."""
    return _with_objectness(facts, name, table, anchors=3)


@_in_a_table
def _yolox(facts: ModelFacts, name: str, table: Any) -> LayoutMatch | str | None:
    """Find a YOLOX."""
    match = _with_objectness(facts, name, table, anchors=1)
    # The coordinates are in strides. Pixels would be distributed over the whole input.
    return match if match is not None and np.median(np.abs(table[:, :2])) <= 8 else None


@_in_a_table
def _yolov6(facts: ModelFacts, name: str, table: Any) -> LayoutMatch | str | None:
    """Find a YOLOv6. Its objectness is constant."""
    constant = table.shape[1] > 4 and (table[:, 4] == 1).all()
    return _with_objectness(facts, name, table, anchors=1) if constant else None


@_in_a_table
def _yolox_decoded(facts: ModelFacts, name: str, table: Any) -> LayoutMatch | str | None:
    """Find a YOLOX with decoded boxes."""
    match = _with_objectness(facts, name, table, anchors=1)
    if isinstance(match, LayoutMatch) and facts.names is None and match.classes != len(COCO):
        return "its fifth column may be an objectness or a class: set detector.names"
    return match


@_in_a_table
def _end_to_end(facts: ModelFacts, name: str, table: Any) -> LayoutMatch | str | None:
    """Find a list of boxes after NMS inside the network."""
    has_nms = facts.metadata.get("end2end") == "True" or "'nms': True" in facts.metadata.get("args", "")
    extra = table.shape[1] - 6
    known = extra in (0, facts.masks) or (extra > 0 and facts.ultralytics and has_nms)
    return LayoutMatch((name,)) if known else None


# --- the table ---------------------------------------------------------------------------------

LETTERBOX = InputFormat(ImageFit.CENTRE)
SQUARE = InputFormat(ImageFit.STRETCH)
MEGVII = InputFormat(ImageFit.CORNER, rgb=False, divisor=1)
DETR = InputFormat(ImageFit.STRETCH, resampling=Resampling.ALL)
ROBOFLOW = InputFormat(
    ImageFit.STRETCH, resampling=Resampling.UNROUNDED, mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225)
)
DECI = InputFormat(ImageFit.CENTRE, divisor=1, margin=4)  # the network divides the pixels itself
NATIVE = InputFormat(ImageFit.NATIVE)

NAS_LISTS = _supergradients("pred_boxes", "pred_scores", "pred_classes")
NAS_LIST = _supergradients("flat_predictions")

# The first match counts. Layouts with typical names or metadata come before layouts with only a shape.
LAYOUTS = (
    Layout("RT-DETR", _rtdetr_list, read.one_list(0, 4, 5), BoxFormat.FRACTIONS, SQUARE),
    Layout("RT-DETR", _rtdetr_scores, read.rows, BoxFormat.FRACTIONS, SQUARE),
    Layout("RT-DETR or D-FINE", _rtdetr_repository, read.three_lists, BoxFormat.CORNERS, DETR),
    Layout("DEIM", _deim, read.three_lists, BoxFormat.CORNERS, DETR, batch=False),
    Layout("RF-DETR", _rfdetr, read.queries, BoxFormat.FRACTIONS, ROBOFLOW),
    Layout("YOLO-NAS", NAS_LISTS, read.three_lists, BoxFormat.CORNERS, DECI),
    Layout("YOLO-NAS", NAS_LIST, read.one_list(1, 5, 6), BoxFormat.CORNERS, DECI, batch=False),
    Layout("YOLO-NAS", _two_tables, read.two_tables, BoxFormat.CORNERS, LETTERBOX, CLASS_OFFSET),
    Layout(
        "torchvision", _torchvision, read.three_lists, BoxFormat.CORNERS, NATIVE, batch=False, background=True
    ),
    Layout(
        "YOLOv7 with NMS", _yolov7_list, read.one_list(1, 6, 5), BoxFormat.CORNERS, LETTERBOX, batch=False
    ),
    Layout("YOLOv8", _yolov8, read.columns, BoxFormat.CENTRE, LETTERBOX, CLASS_OFFSET),
    Layout("YOLOv5", _yolov5, read.rows_with_objectness, BoxFormat.CENTRE, LETTERBOX, CLASS_OFFSET),
    Layout("YOLOv6", _yolov6, read.rows_with_objectness, BoxFormat.CENTRE, LETTERBOX, CLASS_OFFSET),
    Layout("YOLOX", _yolox, read.rows_with_objectness, BoxFormat.CELLS, MEGVII, 0.0),
    Layout("YOLOX decoded", _yolox_decoded, read.rows_with_objectness, BoxFormat.CENTRE, MEGVII, 0.0),
    Layout("end-to-end", _end_to_end, read.one_list(0, 4, 5), BoxFormat.CORNERS, LETTERBOX),
)
ADAPTER = "; or wrap it in a function of your own: --model module:function (docs/models.md#any-other-network)"
SUPPORTED = ", ".join(dict.fromkeys(map(str, LAYOUTS)))


def find_head(facts: ModelFacts) -> Head:
    """Find out how to read a model.

    Raises:
        ValueError: the model cannot be read. The message says why, and how to fix it.
    """
    unsupported = _unsupported_family(facts)
    if unsupported:
        raise ValueError(f"{unsupported}{ADAPTER}")
    reason = "no detector that is known here"
    for layout in LAYOUTS:
        match = layout.find(facts)
        if isinstance(match, LayoutMatch):
            names = _names(layout, match, facts)
            prototypes = _prototypes(layout, match, facts)
            head = Head(layout, match.outputs, match.classes, names, prototypes, facts.ultralytics)
            split = head.split([facts.outputs[name] for name in head.outputs])
            if isinstance(split, ScoredBoxes) and split.scores.size and read.has_unused_class(split):
                head = replace(head, objectness_alone=True)
            doubt = _byte_input_problem(layout, facts) or head.doubt(facts)
            if not doubt:
                return head
            match = f"read as {layout}, {doubt}"
        if match is not None:
            reason = match
            break
    shapes = list_tensors((name, np.shape(output)) for name, output in facts.outputs.items())
    raise ValueError(f"{reason}; its outputs: {shapes}; supported: {SUPPORTED}{ADAPTER}")


def _prototypes(layout: Layout, match: LayoutMatch, facts: ModelFacts) -> str:
    """Return the output with mask prototypes if the table has weights for it, else an empty name."""
    by_columns, is_list = layout.split is read.columns, match.classes is None
    if len(match.outputs) > 1 or match.outputs[0] not in facts.tables or not facts.masks:
        return ""
    table = facts.tables[match.outputs[0]]
    known = 6 if is_list else (4 if by_columns else 5) + (match.classes or 0)
    if table.shape[0 if by_columns else 1] - known != facts.masks:
        return ""
    return next(name for name, o in facts.outputs.items() if o.ndim == 4 and o.shape[1] == facts.masks)


def _names(layout: Layout, match: LayoutMatch, facts: ModelFacts) -> tuple[str, ...]:
    """Return the class names, with a background class if the layout has one."""
    if (match.classes or 0) > MAX_CLASSES:
        raise ValueError(
            f"read as {layout}, it scores {match.classes:,} classes, "
            f"and no more than {MAX_CLASSES:,} are read"
        )
    names = facts.names or default_names(match.classes)
    if names and layout.background and names[0].strip("_").lower() != "background":
        return ("background", *names)
    return names


def _byte_input_problem(layout: Layout, facts: ModelFacts) -> str:
    """Return why an input of bytes cannot be used, else empty.

    The colour order of such an input is known only for networks that divide the pixels themselves.
    """
    if facts.dtype is np.uint8 and layout.feed is not DECI:
        return "it takes pixels as bytes, and nothing tells the order of colours: export it for floats"
    return ""


def _unsupported_family(facts: ModelFacts) -> str:
    """Return why a known family cannot be read and how to fix it, else empty."""
    names, maps = set(facts.outputs), [o for o in facts.outputs.values() if o.ndim in (4, 5)]
    if facts.ultralytics and facts.task not in ("", "detect", "segment", "pose"):
        return f"a model for the task '{clip(facts.task)}': export one for detect, segment or pose"
    if {"logits", "pred_boxes"} <= names:
        return "a DETR of Hugging Face, whose file does not tell how it wants its image: export the original"
    if {"num_dets", "det_boxes"} <= names:
        return "a YOLO with NMS, whose file does not tell the order of colours: export without --end2end"
    if {"dets", "labels"} <= names and facts.outputs["dets"].shape[-1] == 5:
        return "a model of MMDeploy, whose file does not tell how it wants its image"
    if len(maps) > 1 and len(maps) == len(names):
        return "feature maps, not boxes: export with the grid (YOLOv7: --grid)"
    return ""
