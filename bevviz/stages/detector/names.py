"""Class names: of a model's metadata, of a file, or of COCO."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bevviz.config.methods import CLASS_LISTS
from bevviz.errors import UserError
from bevviz.files import CONFIG_LIMIT, read_text

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
# COCO's annotations number 80 categories up to 90: these ids are left out, and 0 is the background.
COCO_GAPS = (0, 12, 26, 29, 30, 45, 66, 68, 69, 71, 83)
_found = iter(COCO)
COCO_CATEGORIES = tuple(
    "background" if i == 0 else f"unused_{i}" if i in COCO_GAPS else next(_found) for i in range(91)
)
GIVEN = dict(zip(CLASS_LISTS, (COCO, COCO_CATEGORIES), strict=True))


def literal(text: str | None, kind: type) -> Any:
    """The Python literal in a metadata value, None where there is none of that kind."""
    try:
        value = ast.literal_eval(text or "")
    except (ValueError, SyntaxError):
        return None
    return value if isinstance(value, kind) else None


def metadata_names(metadata: Mapping[str, str]) -> tuple[str, ...] | None:
    """Ultralytics writes ``names`` as a dict of class id -> name, others as a list."""
    by_id = literal(metadata.get("names"), dict)
    if by_id:
        return tuple(str(by_id.get(i, f"class_{i}")) for i in range(max(by_id) + 1))
    return tuple(map(str, literal(metadata.get("names"), list) or ())) or None


def read_names(value: str) -> tuple[str, ...]:
    """The names that ``detector.names`` stands for.

    Raises:
        UserError: no such file, or one without names.
    """
    if value in GIVEN:
        return GIVEN[value]
    text = read_text(Path(value), CONFIG_LIMIT, problem=f"detector.names {value}: cannot be read")
    names = tuple(line.strip() for line in text.splitlines() if line.strip())
    if not names:
        raise UserError(f"detector.names {value}: holds no class name; expected one a line")
    return names


def default_names(count: int | None) -> tuple[str, ...]:
    """COCO's where their number says so, else numbers; none where not even their number is known."""
    known = {len(names): names for names in GIVEN.values()}
    return known.get(count or 0) or tuple(f"class_{i}" for i in range(count or 0))
