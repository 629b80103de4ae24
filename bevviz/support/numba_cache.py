"""Compile loops with numba, with a cache on disk if possible. Only compiling and loading import this."""

from __future__ import annotations

import atexit
import fcntl
import hashlib
import os
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

import numba
from numba.core import config, event
from numba.core.caching import FunctionCache, _CacheLocator
from numba.core.runtime.nrt import rtsys

from bevviz.errors import UserError
from bevviz.support import progress
from bevviz.support.compile_clock import compile_timer
from bevviz.support.files import check_owned
from bevviz.support.scratch_folder import ScratchFolder

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


class _CompileListener(event.Listener):  # type: ignore[misc]
    """Listener that passes the compilations of each thread to ``compile_timer``."""

    def on_start(self, event: Any) -> None:
        """Start the clock of this thread."""
        compile_timer.start()

    def on_end(self, event: Any) -> None:
        """Stop the clock of this thread."""
        compile_timer.stop()


class _CompileAnnouncer(event.Listener):  # type: ignore[misc]
    """Announces once that the stages are compiled, since the first frame after an installation takes long.

    A second process then compiles a part of the kernels: numba compiles one at a time in a process.
    """

    def __init__(self) -> None:
        self._is_announced = False
        self._helper: subprocess.Popen[bytes] | None = None

    def on_start(self, event: Any) -> None:
        """Print the announcement before the first compilation of our code, and start the second process."""
        if not self._is_announced and event.data["dispatcher"].__module__.startswith("bevviz."):
            self._is_announced = True
            kept = "once" if CACHED else "for this run, as there is no folder to keep it in"
            progress.say(f"compiling the stages for this machine, {kept}: about {10 if CACHED else 15} s")
            if CACHED:
                command = [sys.executable, "-P", "-m", "bevviz.support.compile_ahead"]
                with suppress(OSError):  # Without the process this one compiles them all.
                    self._helper = subprocess.Popen(
                        command,
                        stdin=subprocess.DEVNULL,
                        stdout=subprocess.DEVNULL,
                        stderr=subprocess.DEVNULL,
                    )

    def on_end(self, event: Any) -> None:
        """Do nothing."""


announcer = _CompileAnnouncer()
event.register("numba:compiler_lock", _CompileListener())
event.register("numba:compile", announcer)


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


def compiled(function: Callable[..., object], options: Mapping[str, object]) -> Any:
    """Return a function that numba compiles at its first call, with options of ``numba.njit``."""
    # No C function calls a kernel. To compile an entry for one takes a twentieth of the whole time.
    dispatcher = numba.njit(no_cfunc_wrapper=True, **options)(function)
    if CACHED:
        kernel_cache, compile_now = _LazyCache(function), dispatcher.compile

        def compile_alone(signature: object) -> Any:
            with _other_processes_wait(kernel_cache):
                return compile_now(signature)

        dispatcher._cache, dispatcher.compile = kernel_cache, compile_alone
    return dispatcher


@contextmanager
def _other_processes_wait(kernel_cache: FunctionCache) -> Iterator[None]:
    """Let other processes wait for a kernel, which they then load. Each kernel has a byte of a lock file."""
    place = zlib.crc32(kernel_cache._cache_file._index_name.encode())
    try:
        kernel_cache._impl.locator.ensure_cache_path()
        handle = _lock_file(kernel_cache.cache_path)
        fcntl.lockf(handle, fcntl.LOCK_EX, 1, place)
    except OSError:  # The folder is read-only, or its file system has no locks.
        yield
        return
    try:
        yield
    finally:
        fcntl.lockf(handle, fcntl.LOCK_UN, 1, place)


@cache
def _lock_file(folder: str) -> BinaryIO:
    """Return the open lock file of a cache folder. To close it would release all locks of the process."""
    return (Path(folder) / "kernels.lock").open("ab")
