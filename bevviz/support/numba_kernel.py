"""Loops that numba compiles without the GIL. Before the first call of a loop, numba is not even imported."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import update_wrapper
from typing import Any, TypeVar, cast

from bevviz.support.compile_clock import compile_timer

F = TypeVar("F", bound=Callable[..., object])


class _Kernel:
    """Function that is compiled at its first call. Other kernels can call it, too."""

    _lock = threading.RLock()

    def __init__(self, function: Callable[..., object], **options: object) -> None:
        update_wrapper(self, function)
        self._function, self._options = function, options
        self._dispatcher: Any = None

    def __call__(self, *args: object, **named: object) -> object:
        """Call the compiled function."""
        return (self._dispatcher or self._compiled())(*args, **named)

    @property
    def _numba_type_(self) -> Any:
        """Type by which numba knows this function in another kernel."""
        return (self._dispatcher or self._compiled())._numba_type_

    def compile(self, arguments: tuple[object, ...]) -> None:
        """Compile the function for arguments of these types of numba."""
        (self._dispatcher or self._compiled()).compile(arguments)

    def _compiled(self) -> Any:
        """Return numba's dispatcher of the function."""
        with self._lock:
            if self._dispatcher is None:
                compile_timer.start()
                try:
                    # numba takes a quarter of a second, and many commands call no kernel.
                    from bevviz.support.numba_cache import compiled

                    self._dispatcher = compiled(self._function, self._options)
                finally:
                    compile_timer.stop()
        return self._dispatcher


def kernel(function: F) -> F:
    """Compile a function at its first call. Division by zero is IEEE's, as in numpy.

    A kernel copies rows number by number. For ``a[i] = b[j]`` of arrays numba compiles the text of an error
    about shapes as well, which takes longer than most kernels.
    """
    return cast(F, _Kernel(function, nogil=True, error_model="numpy"))


def unordered_kernel(function: F) -> F:
    """Compile a function as ``kernel``, but with sums in any order and without NaN.

    Several iterations of a loop then run at once, and the last digits may differ.
    """
    options = {"fastmath": {"reassoc", "nsz", "nnan"}}
    return cast(F, _Kernel(function, nogil=True, error_model="numpy", **options))
