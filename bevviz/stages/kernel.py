"""The one way loops are compiled: by numba, without the GIL, kept on disk between runs."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numba

F = TypeVar("F", bound=Callable[..., object])


def kernel(function: F) -> F:
    """Compile ``function`` at its first call; division by zero is IEEE's, as in numpy."""
    compiled: F = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    return compiled


def unordered_kernel(function: F) -> F:
    """The same with sums in any order and no NaN: several turns of a loop at once, other last digits."""
    allowed = {"reassoc", "nsz", "nnan"}
    compiled: F = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=allowed)(function)
    return compiled
