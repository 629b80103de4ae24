"""Base class of closable objects, and a context without garbage collection."""

from __future__ import annotations

import gc
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Self


class Closable(ABC):
    """Base class of context managers that call ``close`` at the end of their block."""

    @abstractmethod
    def close(self) -> None:
        """Release the resources."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextmanager
def garbage_collection_off() -> Iterator[None]:
    """Pause the garbage collection of cycles.

    Imports make many objects and leave no cycles behind.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
