"""Delete temporary files when a signal kills the process."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

# Name of threads that run compiled code which may never end. A normal exit would free the memory that they
# work on, and cause a segmentation fault.
ENDLESS_THREAD = "bevviz endless"

_unfinished: list[object] = []
_removals: dict[object, Callable[[], None]] = {}


@contextmanager
def must_finish() -> Iterator[None]:
    """Mark a block that must finish: a signal does not kill the process inside it."""
    mark = object()
    _unfinished.append(mark)
    try:
        yield
    finally:
        _unfinished.remove(mark)


def is_any_unfinished() -> bool:
    """Return whether any thread is inside ``must_finish``."""
    return bool(_unfinished)


def register(owner: object, remove: Callable[[], None]) -> None:
    """Register the function that deletes an owner's files, until ``unregister``."""
    _removals[owner] = remove


def unregister(owner: object) -> None:
    """Unregister the function of an owner, who has deleted the files."""
    _removals.pop(owner, None)


def remove_all() -> None:
    """Delete the files of all registered owners."""
    for removal in list(_removals.values()):
        with suppress(OSError):
            removal()
