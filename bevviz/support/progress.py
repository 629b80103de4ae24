"""Messages and progress bars for slow work. As a library, bevviz shows none."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from typing import Any

_say: Callable[[str], None] | None = None
_bars = True


def set_receiver(say: Callable[[str], None] | None, *, bars: bool = True) -> None:
    """Set the receiver of messages.

    Args:
        say: function that shows a message. None: messages are discarded.
        bars: whether a terminal shows progress bars.
    """
    global _say, _bars
    _say, _bars = say, bars


def has_receiver() -> bool:
    """Return whether messages have a receiver."""
    return _say is not None


def say(text: str) -> None:
    """Send one line to the receiver, if there is one."""
    if _say is not None:
        _say(text)


def bar(*args: Any, **options: Any) -> Any:
    """Return ``tqdm.tqdm`` of the same arguments. It shows nothing outside a terminal."""
    return _bar()(*args, **options, disable=None if _bars else True)


def cleared() -> AbstractContextManager[object]:
    """Return a context in which no progress bar is on the terminal, for a line on stderr."""
    if not _bar.cache_info().currsize:
        return nullcontext()
    context: AbstractContextManager[object] = _bar().external_write_mode(sys.stderr)
    return context


@cache
def _bar() -> Any:
    """Return the class of progress bars."""
    from tqdm import tqdm

    class Bar(tqdm):  # type: ignore[misc]
        """Progress bar of one process. tqdm's own lock is a semaphore that outlives a killed worker."""

        _lock = threading.RLock()

    return Bar
