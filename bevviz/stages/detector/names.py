"""Class names of a model: from the metadata of its exporter, from a file, or from COCO."""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bevviz.config.methods import CLASS_LISTS
from bevviz.errors import UserError
from bevviz.stages.detector.session import clip
from bevviz.support.files import read_text
from bevviz.support.limits import CONFIG_LIMIT

DEFAULT_SIZE = 640  # pixels a side for an open input; most families are trained with this size
DEFAULT_STRIDE, MAX_STRIDE = 32, 256  # pixels; the coarsest grids of known families have 128
# Characters of one value. 100,000 class names fit; Python takes 0.3 GB to parse as much.
MAX_TEXT = 2_000_000


def literal(metadata: Mapping[str, str], key: str) -> Any:
    """Return the Python literal in a metadata value, None if there is none.

    Raises:
        ValueError: the text is too long.
    """
    text = metadata.get(key, "")
    if len(text) > MAX_TEXT:
        raise ValueError(f"its metadata hold a text '{key}' of {len(text):,} characters; export it again")
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError):
        return None


def stated_size(metadata: Mapping[str, str]) -> tuple[int, int]:
    """Return height and width of the input that the model was exported for.

    Raises:
        ValueError: the value cannot be a size.
    """
    size = literal(metadata, "imgsz")
    if not isinstance(size, list) or len(size) != 2:
        return DEFAULT_SIZE, DEFAULT_SIZE
    if not all(isinstance(side, int) for side in size):
        raise ValueError(
            f"its metadata state an imgsz of {clip(size)}, which is no height and width; "
            "export it with a fixed size"
        )
    return size[0], size[1]


def stated_stride(metadata: Mapping[str, str]) -> int:
    """Return the pixels that the sides of the input must be a multiple of.

    Raises:
        ValueError: the value cannot be a stride.
    """
    stride = literal(metadata, "stride")
    if not isinstance(stride, int) or stride == 0:
        return DEFAULT_STRIDE
    if not 0 < stride <= MAX_STRIDE:
        raise ValueError(
            f"its metadata state a stride of {clip(stride)}, and 1 to {MAX_STRIDE} are possible; "
            "export it with a fixed size"
        )
    return stride


MAX_CLASSES = 100_000  # the largest set of classes, ImageNet-21k, has 21,841
MAX_NAME = 200  # characters of a class name; every frame of a recording repeats the name

COCO = (
    "person", "bicycle", "car", "motorcycle", "airplane", "bus", "train", "truck", "boat", "traffic light",
    "fire hydrant", "stop sign", "parking meter", "bench", "bird", "cat", "dog", "horse", "sheep", "cow",
    "elephant", "bear", "zebra", "giraffe", "backpack", "umbrella", "handbag", "tie", "suitcase", "frisbee",
    "skis", "snowboard", "sports ball", "kite", "baseball bat", "baseball glove", "skateboard", "surfboard",
    "tennis racket", "bottle", "wine glass", "cup", "fork", "knife", "spoon", "bowl", "banana", "apple",
    "sandwich", "orange", "broccoli", "carrot", "hot dog", "pizza", "donut", "cake", "chair", "couch",
    "potted plant", "bed", "dining table", "toilet", "tv", "laptop", "mouse", "remote", "keyboard",
    "cell phone", "microwave", "oven", "toaster", "sink", "refrigerator", "book", "clock", "vase", "scissors",
    "teddy bear", "hair drier", "toothbrush",
)  # fmt: skip
# COCO's annotations number 80 categories up to 90. These ids are unused, and 0 is the background.
COCO_GAPS = (0, 12, 26, 29, 30, 45, 66, 68, 69, 71, 83)
_coco_names = iter(COCO)
COCO_CATEGORIES = tuple(
    "background" if i == 0 else f"unused_{i}" if i in COCO_GAPS else next(_coco_names) for i in range(91)
)
NAME_LISTS = dict(zip(CLASS_LISTS, (COCO, COCO_CATEGORIES), strict=True))


def metadata_names(metadata: Mapping[str, str]) -> tuple[str, ...] | None:
    """Return the class names in a model's metadata, None if there are none.

    Ultralytics writes ``names`` as a dict of class id -> name, others as a list.

    Raises:
        ValueError: the names are no names, or too many.
    """
    stated = literal(metadata, "names")
    if isinstance(stated, list):
        return _check_names("its metadata", [str(name) for name in stated]) or None
    if not isinstance(stated, dict) or not stated:
        return None
    wrong = next((key for key in stated if not isinstance(key, int) or not 0 <= key < MAX_CLASSES), None)
    if wrong is not None:
        raise ValueError(
            f"its metadata give a name to class {clip(repr(wrong))}, and classes are numbers from 0 to "
            f"{MAX_CLASSES - 1}; name them by detector.names"
        )
    return _check_names("its metadata", [str(stated.get(i, f"class_{i}")) for i in range(max(stated) + 1)])


def _check_names(where: str, names: Sequence[str]) -> tuple[str, ...]:
    """Return the names as a tuple, or raise a ValueError if they are too many or too long."""
    if len(names) > MAX_CLASSES:
        raise ValueError(
            f"{where} hold {len(names):,} class names, and no more than {MAX_CLASSES:,} are read"
        )
    long = next((name for name in names if len(name) > MAX_NAME), None)
    if long is not None:
        raise ValueError(
            f"{where} hold a class name of {len(long):,} characters, and no more than {MAX_NAME} are read: "
            f"{long[:40]}...; name the classes by detector.names"
        )
    return tuple(names)


def read_names(value: str) -> tuple[str, ...]:
    """Return the class names that ``detector.names`` refers to.

    Raises:
        UserError: the file is missing or has no names.
    """
    if value in NAME_LISTS:
        return NAME_LISTS[value]
    text = read_text(Path(value), CONFIG_LIMIT, problem=f"detector.names {value}: cannot be read")
    names = tuple(line.strip() for line in text.splitlines() if line.strip())
    if not names:
        raise UserError(f"detector.names {value}: holds no class name; expected one a line")
    try:
        return _check_names("its lines", names)
    except ValueError as error:
        raise UserError(f"detector.names {value}: {error}") from None


def default_names(count: int | None) -> tuple[str, ...]:
    """Return the names of COCO if the count fits, otherwise numbered names. No count gives no names."""
    known = {len(names): names for names in NAME_LISTS.values()}
    return known.get(count or 0) or tuple(f"class_{i}" for i in range(count or 0))
