"""Look up which points an instance mask covers."""

from __future__ import annotations

import math

import numpy as np

from bevviz.model.frame import F32, I32, U8, Bool
from bevviz.model.results import Masks
from bevviz.support.numba_kernel import kernel


def is_covered(masks: Masks, d: int, uv: F32, margin: float = 0.0) -> Bool:
    """Return the (N,) mask of pixels that a detection's object covers. NaN pixels are not covered.

    ``margin``: a pixel also counts if the object covers a position this many pixels left, right, above or
    below it.
    """
    return _cover(masks.packed, masks.start(d), masks.place[d], masks.grid, uv, margin)


@kernel
def _cover(packed: U8, start: int, place: I32, grid: F32, uv: F32, margin: float) -> Bool:
    covered = np.zeros(len(uv), np.bool_)
    for n in range(len(uv)):
        if np.isnan(uv[n, 0]) or np.isnan(uv[n, 1]):
            continue
        for beside in range(5 if margin > 0 else 1):
            u, v = uv[n, 0] + 0.5, uv[n, 1] + 0.5
            if beside == 1:
                u += margin
            elif beside == 2:
                u -= margin
            elif beside == 3:
                v += margin
            elif beside == 4:
                v -= margin
            column = math.floor(u * grid[0] + grid[2]) - place[0]
            row = math.floor(v * grid[1] + grid[3]) - place[1]
            if 0 <= column < place[2] and 0 <= row < place[3]:
                bit = start + row * place[2] + column
                if (packed[bit >> 3] >> (7 - (bit & 7))) & 1:
                    covered[n] = True
                    break
    return covered
