"""What a process would leave behind if a signal ended it at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

# Name of threads that run compiled code which may never end. An exit in the usual way takes the memory that
# they work on away, and ends in a segmentation fault.
ENDLESS_THREAD = "bevviz endless"

_unfinished: list[object] = []
_removals: dict[object, Callable[[], None]] = {}


@contextmanager
def unfinished() -> Iterator[None]:
    """Within, something is made that needs an end: the process must come to it."""
    mark = object()
    _unfinished.append(mark)
    try:
        yield
    finally:
        _unfinished.remove(mark)


def any_unfinished() -> bool:
    return bool(_unfinished)


def remember(owner: object, remove: Callable[[], None]) -> None:
    """How to remove what the owner has made, until ``forget``."""
    _removals[owner] = remove


def forget(owner: object) -> None:
    _removals.pop(owner, None)


def remove() -> None:
    """All that is remembered."""
    for removal in list(_removals.values()):
        with suppress(OSError):
            removal()
