"""The one way loops are compiled: by numba, without the GIL, kept on disk where there is a place."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar

import numba
from numba.core import event
from numba.core.caching import FunctionCache
from numba.core.runtime.nrt import rtsys

from bevviz.support import progress

F = TypeVar("F", bound=Callable[..., object])


def _has_place() -> bool:
    """Whether numba finds a folder to keep it in: beside the module, in the user's cache, or stated."""
    try:
        numba.njit(cache=True)(_has_place)
    except RuntimeError:  # a service without a home, a container whose disk is read-only
        return False
    return True


CACHED = _has_place()  # False: each run compiles anew


class _Compiling(event.Listener):  # type: ignore[misc]
    """How long was compiled, or fetched what was compiled before: by whom, and by all threads."""

    def __init__(self) -> None:
        self._local = threading.local()
        self.everywhere = 0.0

    @property
    def here(self) -> float:
        """Seconds, by this thread."""
        return getattr(self._local, "seconds", 0.0)

    def on_start(self, event: Any) -> None:
        depth = getattr(self._local, "depth", 0)
        if not depth:
            self._local.start = time.perf_counter()
        self._local.depth = depth + 1

    def on_end(self, event: Any) -> None:
        self._local.depth -= 1
        if not self._local.depth:
            seconds = time.perf_counter() - self._local.start
            self._local.seconds = self.here + seconds
            self.everywhere += seconds


class _Announcing(event.Listener):  # type: ignore[misc]
    """Says once that stages are compiled: the first frame after an installation takes a while."""

    def __init__(self) -> None:
        self._said = False

    def on_start(self, event: Any) -> None:
        if not self._said and event.data["dispatcher"].__module__.startswith("bevviz."):
            self._said = True
            kept = "once" if CACHED else "for this run, as there is no folder to keep it in"
            progress.say(f"compiling the stages for this machine, {kept}: about 15 s")

    def on_end(self, event: Any) -> None:
        pass


_compiling = _Compiling()
event.register("numba:compiler_lock", _compiling)
event.register("numba:compile", _Announcing())


def clock() -> float:
    """Seconds, as ``time.perf_counter``, that stand still while this thread compiles."""
    return time.perf_counter() - _compiling.here


def common_clock() -> float:
    """Seconds that stand still while any thread compiles, twice where two wait for one another."""
    return time.perf_counter() - _compiling.everywhere


class _Kept(FunctionCache):  # type: ignore[misc]
    """As numba's own, which imports before the first lookup what only compiling needs: 0.4 s.

    numba 0.68 has no public way around that: ``cache=True`` always takes its own class. Its events, used
    above, are documented (https://numba.readthedocs.io/en/stable/developer/event_api.html).
    """

    def load_overload(self, sig: object, target_context: Any) -> Any:
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)


def kernel(function: F) -> F:
    """Compile ``function`` at its first call; division by zero is IEEE's, as in numpy."""
    return _compiled(function)


def unordered_kernel(function: F) -> F:
    """The same with sums in any order and no NaN: several turns of a loop at once, other last digits."""
    return _compiled(function, fastmath={"reassoc", "nsz", "nnan"})


def _compiled(function: F, **options: Any) -> F:
    compiled = numba.njit(nogil=True, error_model="numpy", **options)(function)
    if CACHED:
        compiled._cache = _Kept(function)
    return compiled  # type: ignore[no-any-return]
