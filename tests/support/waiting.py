"""How tests wait, and what they watch or do beside the code that they run."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread
from typing import TypeVar

T = TypeVar("T")

PATIENCE = (
    120.0  # seconds for what takes one or two on an idle machine; two tries stay below faulthandler_timeout
)


def until(done: Callable[[], T | None], what: str = "what was waited for", every: float = 0.05) -> T:
    """Wait until ``done`` returns a true value, and return it. The time limit allows for a busy machine."""
    end = time.monotonic() + PATIENCE
    while not (found := done()):
        assert time.monotonic() < end, f"never: {what}"
        time.sleep(every)
    return found


@contextmanager
def meanwhile(look: Callable[[], object], every: float = 0.005) -> Iterator[None]:
    """Call this in a thread of its own every few milliseconds while the block runs, and once more after it.

    Files and folders may come and go under it: ``glob`` of Python 3.11 raises where the folder it is in does.
    What else it raises fails the test.
    """
    ended = Event()
    failed: list[Exception] = []

    def work() -> None:
        last = False
        while not (last or failed):
            last = ended.wait(every)
            try:
                look()
            except FileNotFoundError:
                pass
            except Exception as error:
                failed.append(error)

    thread = Thread(target=work, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
    if failed:
        raise failed[0]
