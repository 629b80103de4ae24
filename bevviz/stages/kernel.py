"""The one way loops are compiled: by numba, without the GIL, kept on disk where there is a place."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numba

F = TypeVar("F", bound=Callable[..., object])


def _has_place() -> bool:
    """Whether numba finds a folder to keep it in: beside the module, in the user's cache, or stated."""
    try:
        numba.njit(cache=True)(_has_place)
    except RuntimeError:  # a service without a home, a container whose disk is read-only
        return False
    return True


CACHED = _has_place()  # False: each run compiles anew


def kernel(function: F) -> F:
    """Compile ``function`` at its first call; division by zero is IEEE's, as in numpy."""
    compiled: F = numba.njit(cache=CACHED, nogil=True, error_model="numpy")(function)
    return compiled


def unordered_kernel(function: F) -> F:
    """The same with sums in any order and no NaN: several turns of a loop at once, other last digits."""
    allowed = {"reassoc", "nsz", "nnan"}
    compiled: F = numba.njit(cache=CACHED, nogil=True, error_model="numpy", fastmath=allowed)(function)
    return compiled
