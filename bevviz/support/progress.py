"""What takes a while is said, and shown as a bar, where somebody looks; in a library nobody does."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import cache
from typing import Any

_say: Callable[[str], None] | None = None
_bars = True


def to(say: Callable[[str], None] | None, *, bars: bool = True) -> None:
    """Have what is announced said by ``say``, None: by nobody; ``bars``: whether a terminal shows any."""
    global _say, _bars
    _say, _bars = say, bars


def heard() -> bool:
    """Whether anybody wants to know."""
    return _say is not None


def say(text: str) -> None:
    """One line, where anybody wants to know."""
    if _say is not None:
        _say(text)


def bar(*given: Any, **named: Any) -> Any:
    """``tqdm.tqdm`` of the same arguments, on a terminal alone."""
    return _bar()(*given, **named, disable=None if _bars else True)


@cache
def _bar() -> Any:
    from tqdm import tqdm

    class Bar(tqdm):  # type: ignore[misc]
        """One process draws: tqdm's own lock is a semaphore, which a worker that is killed leaves behind."""

        _lock = threading.RLock()

    return Bar
