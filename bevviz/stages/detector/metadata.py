"""Read values that exporters write into a model's metadata as Python literals."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from typing import Any

from bevviz.stages.detector.session import clip

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
