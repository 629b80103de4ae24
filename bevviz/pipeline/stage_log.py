"""Run stages with their times and failures, and reuse results that are known already."""

from __future__ import annotations

import threading
import traceback
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import fields
from typing import Any, TypeVar, TypeVarTuple, cast

from pydantic import BaseModel

from bevviz.config import Config
from bevviz.errors import FunctionError, StageError, UserError, interrupt_in
from bevviz.model.results import CameraResult, Failure
from bevviz.support.compile_clock import thread_clock
from bevviz.support.loggers import logger

T = TypeVar("T")
Ts = TypeVarTuple("Ts")

_log = logger(__name__)


class Memo:
    """Results of stages on one frame, shared by configurations that run on the same frame.

    A stage with the same arrays and equal parameters does not run again. The cache must be cleared before the
    next frame. Several threads may use it.

    Args:
        size: most results that are kept. The least recently used one goes first.
    """

    def __init__(self, size: int = 200) -> None:
        self._size = size
        self._results: OrderedDict[tuple[object, ...], tuple[tuple[object, ...], Any, float]] = OrderedDict()
        self._local, self._lock = threading.local(), threading.Lock()

    @property
    def seconds_saved(self) -> float:
        """Seconds that this thread has saved so far."""
        return getattr(self._local, "seconds_saved", 0.0)

    def clear(self) -> None:
        """Forget all results."""
        with self._lock:
            self._results.clear()

    def call(self, function: Callable[[*Ts], T], *args: *Ts) -> T:
        """Return the function's result, from the cache if possible. The function may use the cache itself."""
        key = (function, *map(_identity, args))
        with self._lock:
            known = self._results.get(key)
            if known is not None:
                self._results.move_to_end(key)
        if known is not None:
            _, result_before, seconds = known
            self._local.seconds_saved = self.seconds_saved + seconds
            return cast(T, result_before)
        start, before = thread_clock(), self.seconds_saved
        result = function(*args)
        seconds = thread_clock() - start + self.seconds_saved - before
        # Keeping the arguments prevents other objects from getting their ids.
        with self._lock:
            self._results[key] = args, result, seconds
            if len(self._results) > self._size:
                self._results.popitem(last=False)
        return result


def _identity(argument: object) -> object:
    """Return a key that is equal for equal parameters, but for arrays only if they are the same object.

    Tuples and results of cameras are compared item by item: each run puts them together anew.
    """
    if isinstance(argument, tuple):
        return tuple(map(_identity, argument))
    if isinstance(argument, CameraResult):
        return CameraResult, *(id(getattr(argument, field.name)) for field in fields(argument))
    if isinstance(argument, BaseModel) and not isinstance(argument, Config):
        return type(argument), argument.model_dump_json()
    return argument if isinstance(argument, str | int | float) else id(argument)


class StageLog:
    """Times and failures of the stages that it runs.

    Args:
        memo: cache of results. A stage from the cache counts with the time that it once took.
    """

    def __init__(self, memo: Memo | None = None) -> None:
        self.timings: dict[str, float] = {}
        self.failures: list[Failure] = []
        self.seconds_saved = 0.0
        self._memo = memo

    def run(self, stage: str, function: Callable[[*Ts], T], *args: *Ts) -> T | None:
        """Return the function's result, or None if it failed. A failed stage does not stop the frame.

        Raises:
            KeyboardInterrupt: the user wants to end, even if the stage turned that into another error.
        """
        return self.guard(stage, lambda: self.call(function, *args))

    def guard(self, stage: str, work: Callable[[], T]) -> T | None:
        """Run a stage as ``run`` does, but without a look-up of its own result."""
        memo = self._memo
        start, saved_before = thread_clock(), memo.seconds_saved if memo else 0.0
        try:
            return work()
        except (UserError, StageError) as error:
            self._failed(stage, str(error), error)
        except Exception as error:
            if interrupt_in(error):
                raise KeyboardInterrupt from error
            self._failed(stage, f"{type(error).__name__}: {error}", error)
        finally:
            saved = memo.seconds_saved - saved_before if memo else 0.0
            self.timings[stage] = self.timings.get(stage, 0.0) + thread_clock() - start + saved
            self.seconds_saved += saved
        return None

    def call(self, function: Callable[[*Ts], T], *args: *Ts) -> T:
        """Return the function's result, from the cache if there is one."""
        return function(*args) if self._memo is None else self._memo.call(function, *args)

    def _failed(self, stage: str, reason: str, error: Exception) -> None:
        """Record and log a failure."""
        cause = error.__cause__ if isinstance(error, FunctionError) else error
        is_unexpected = not isinstance(cause, UserError | StageError)
        details = "".join(traceback.format_exception(cause)) if is_unexpected else ""
        _log.warning("stage %s failed: %s", stage, reason, exc_info=cause if is_unexpected else None)
        self.failures.append(Failure(stage, reason, details))
