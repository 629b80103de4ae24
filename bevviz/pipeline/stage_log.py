"""How stages are run: how long each took, why it failed, and which need not be run again."""

from __future__ import annotations

import threading
import traceback
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, TypeVar, TypeVarTuple, cast

from pydantic import BaseModel

from bevviz.config import Config
from bevviz.errors import StageError, UserError, interrupt_in
from bevviz.model.results import Failure
from bevviz.support.kernel import clock
from bevviz.support.loggers import logger

T = TypeVar("T")
Ts = TypeVarTuple("Ts")

_log = logger(__name__)


class Memo:
    """What stages made of one frame, for runs of other configurations on the same frame.

    A stage that gets the same arrays and equal parameters is not run again. To be cleared from one frame to
    the next.

    Args:
        size: results that are kept; the one that was not asked for the longest goes.
    """

    def __init__(self, size: int = 200) -> None:
        self._size = size
        self._results: OrderedDict[tuple[object, ...], tuple[tuple[object, ...], Any, float]] = OrderedDict()
        self._local = threading.local()

    @property
    def seconds_saved(self) -> float:
        """By this thread so far."""
        return getattr(self._local, "seconds_saved", 0.0)

    def clear(self) -> None:
        self._results.clear()

    def call(self, function: Callable[[*Ts], T], *args: *Ts) -> T:
        """The function's result, made now or before. A function may ask for others in turn."""
        key = (function, *map(_identity, args))
        if key in self._results:
            _, known, seconds = self._results[key]
            self._results.move_to_end(key)
            self._local.seconds_saved = self.seconds_saved + seconds
            return cast(T, known)
        start, before = clock(), self.seconds_saved
        result = function(*args)
        seconds = clock() - start + self.seconds_saved - before
        # The arguments are kept as well: nothing else can get their ids then.
        self._results[key] = args, result, seconds
        if len(self._results) > self._size:
            self._results.popitem(last=False)
        return result


def _identity(argument: object) -> object:
    """Parameters are the same when they are equal, arrays only when they are one."""
    if isinstance(argument, BaseModel) and not isinstance(argument, Config):
        return type(argument), argument.model_dump_json()
    return argument if isinstance(argument, str | int | float) else id(argument)


class StageLog:
    """Runs stages; keeps how long each took and why it failed.

    Args:
        memo: where to look for results; a stage that need not be run counts with the time it once took.
    """

    def __init__(self, memo: Memo | None = None) -> None:
        self.timings: dict[str, float] = {}
        self.failures: list[Failure] = []
        self.seconds_saved = 0.0
        self._memo = memo

    def run(self, stage: str, function: Callable[[*Ts], T], *args: *Ts) -> T | None:
        """The function's result, or None where it failed: one bad stage must not take the frame with it.

        Raises:
            KeyboardInterrupt: the user wants to end, whatever the stage made of that.
        """
        return self.guard(stage, lambda: self.call(function, *args))

    def guard(self, stage: str, work: Callable[[], T]) -> T | None:
        """As ``run``, of what is not to be looked up itself."""
        memo = self._memo
        start, before = clock(), memo.seconds_saved if memo else 0.0
        try:
            return work()
        except (UserError, StageError) as error:
            self._failed(stage, str(error), error)
        except Exception as error:
            if interrupt_in(error):
                raise KeyboardInterrupt from error
            self._failed(stage, f"{type(error).__name__}: {error}", error)
        finally:
            saved = memo.seconds_saved - before if memo else 0.0
            self.timings[stage] = self.timings.get(stage, 0.0) + clock() - start + saved
            self.seconds_saved += saved
        return None

    def call(self, function: Callable[[*Ts], T], *args: *Ts) -> T:
        """The function's result, from the memo where there is one."""
        return function(*args) if self._memo is None else self._memo.call(function, *args)

    def _failed(self, stage: str, reason: str, error: Exception) -> None:
        unforeseen = not isinstance(error, UserError | StageError)
        trace = "".join(traceback.format_exception(error)) if unforeseen else ""
        _log.warning("stage %s failed: %s", stage, reason, exc_info=error if unforeseen else None)
        self.failures.append(Failure(stage, reason, trace))
