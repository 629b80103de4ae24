"""Compile loops with numba, without the GIL, with a cache on disk if possible."""

from __future__ import annotations

import atexit
import hashlib
import os
import threading
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core import config, event
from numba.core.caching import FunctionCache, _CacheLocator
from numba.core.runtime.nrt import rtsys

from bevviz.errors import UserError
from bevviz.support import progress
from bevviz.support.files import check_owned
from bevviz.support.scratch_folder import ScratchFolder

F = TypeVar("F", bound=Callable[..., object])

# numba reads .numba_config.yaml of the working directory, which may have come with a bag. That file can name
# the folder of the cache, whose pickles numba loads. Variables of the environment hold as ever.
config._config_fname = os.devnull
config.reload_config()


def _has_cache_folder() -> bool:
    """Return whether numba finds a cache folder: beside the module, in the user's cache, or stated."""
    try:
        numba.njit(cache=True)(_has_cache_folder)
    except RuntimeError:  # A service may have no home folder, or a container a read-only disk.
        return False
    return True


CACHED = _has_cache_folder()  # False: each run compiles again


class _CompileTimer(event.Listener):  # type: ignore[misc]
    """Time spent on compiling, or on loading compiled code: by the current thread, and by all threads."""

    def __init__(self) -> None:
        self._local = threading.local()
        self.everywhere = 0.0

    @property
    def here(self) -> float:
        """Seconds of the current thread."""
        return getattr(self._local, "seconds", 0.0)

    def on_start(self, event: Any) -> None:
        """Start the clock of this thread, unless it compiles already."""
        depth = getattr(self._local, "depth", 0)
        if not depth:
            self._local.start = time.perf_counter()
        self._local.depth = depth + 1

    def on_end(self, event: Any) -> None:
        """Add the time of the outermost compilation."""
        self._local.depth -= 1
        if not self._local.depth:
            seconds = time.perf_counter() - self._local.start
            self._local.seconds = self.here + seconds
            self.everywhere += seconds


class _CompileAnnouncer(event.Listener):  # type: ignore[misc]
    """Announces once that the stages are compiled, since the first frame after an installation takes long."""

    def __init__(self) -> None:
        self._is_announced = False

    def on_start(self, event: Any) -> None:
        """Print the announcement before the first compilation of our code."""
        if not self._is_announced and event.data["dispatcher"].__module__.startswith("bevviz."):
            self._is_announced = True
            kept = "once" if CACHED else "for this run, as there is no folder to keep it in"
            progress.say(f"compiling the stages for this machine, {kept}: about 15 s")

    def on_end(self, event: Any) -> None:
        """Do nothing."""


_compile_timer = _CompileTimer()
event.register("numba:compiler_lock", _compile_timer)
event.register("numba:compile", _CompileAnnouncer())


def thread_clock() -> float:
    """Return seconds, as ``time.perf_counter``, without the time in which this thread compiled."""
    return time.perf_counter() - _compile_timer.here


def common_clock() -> float:
    """Return seconds without the time in which any thread compiled.

    If one thread waits for another to compile, the time counts twice.
    """
    return time.perf_counter() - _compile_timer.everywhere


class _LazyCache(FunctionCache):  # type: ignore[misc]
    """Cache that delays imports until a compilation needs them, which saves 0.4 s.

    numba 0.68 has no public way to do this: ``cache=True`` always takes its own class. Its events, used
    above, are documented (https://numba.readthedocs.io/en/stable/developer/event_api.html).
    """

    def load_overload(self, sig: object, target_context: Any) -> Any:
        """Load compiled code, without the imports of numba's method."""
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)


class _UserCodeLocator(_CacheLocator):  # type: ignore[misc]
    """Place of the compiled functions of a user's module: a folder that only the user and bevviz write.

    A cache of numba is a pickle, and one that lies beside a module may have come with it.
    """

    def __init__(self, function: Any, source: Any) -> None:
        self._line = function.__code__.co_firstlineno
        self._sha256 = source.source_sha256
        place = hashlib.sha256(os.fsencode(source.path)).hexdigest()[:32]
        self._folder = _user_kernel_folder() / place

    def get_cache_path(self) -> str:
        """Return the folder of this module."""
        return str(self._folder)

    def get_source_stamp(self) -> str:
        """Return the hash of the source that runs. Functions of another content are compiled again."""
        return str(self._sha256)

    def get_disambiguator(self) -> str:
        """Return what tells functions of one name apart."""
        return str(self._line)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> _UserCodeLocator | None:
        """Return the place of a function, or None if it is of no user's module."""
        loader = getattr(py_func.__globals__.get("__spec__"), "loader", None)
        return cls(py_func, loader) if hasattr(loader, "source_sha256") else None


@cache
def keep_user_kernels_apart() -> None:
    """Let numba keep and look for compiled functions of users' modules in bevviz's folder alone."""
    FunctionCache._impl_class._locator_classes.insert(0, _UserCodeLocator)


@cache
def _user_kernel_folder() -> Path:
    """Return the folder of users' compiled functions: in the user's cache, else one of this process."""
    try:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "bevviz" / "kernels"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        for place in (folder.parent, folder):
            check_owned(place, "XDG_CACHE_HOME")
    except (OSError, RuntimeError, UserError):
        scratch = ScratchFolder()
        atexit.register(scratch.close)
        return scratch.new()
    return folder


def kernel(function: F) -> F:
    """Compile a function at its first call. Division by zero is IEEE's, as in numpy."""
    return _compiled(function)


def unordered_kernel(function: F) -> F:
    """Compile a function as ``kernel``, but with sums in any order and without NaN.

    Several iterations of a loop then run at once, and the last digits may differ.
    """
    return _compiled(function, fastmath={"reassoc", "nsz", "nnan"})


def _compiled(function: F, **options: Any) -> F:
    """Compile a function with options of numba."""
    compiled = numba.njit(nogil=True, error_model="numpy", **options)(function)
    if CACHED:
        compiled._cache = _LazyCache(function)
    return compiled  # type: ignore[no-any-return]
