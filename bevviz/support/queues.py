"""Queue between two threads that drops the oldest items."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from typing import Generic, TypeVar

T = TypeVar("T")


class NewestQueue(Generic[T]):
    """Queue of up to ``size`` items. Another item pushes the oldest out, and ``dropped`` counts it.

    ``put`` never blocks. Iteration takes items, oldest first, and ends after ``close``.

    Args:
        size: most items that wait.
        catch_up: whether a slow consumer gets only the newest item. A consumer is slow if several items wait,
            and at least as many wait the next time. Without this, items wait even then.
    """

    def __init__(self, size: int = 1, *, catch_up: bool = False) -> None:
        self.dropped = 0
        self._catch_up = catch_up
        self._size = size
        self._items: deque[T] = deque()
        self._closed = False
        self._changed = threading.Condition()

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: T) -> None:
        """Add an item, unless the queue is closed."""
        with self._changed:
            if self._closed:
                return
            if len(self._items) == self._size:
                self._items.popleft()
                self.dropped += 1
            self._items.append(item)
            self._changed.notify()

    @property
    def oldest(self) -> T | None:
        """Next item, or None if no item waits."""
        with self._changed:
            return self._items[0] if self._items else None

    def clear(self) -> None:
        """Drop all waiting items."""
        with self._changed:
            self.dropped += len(self._items)
            self._items.clear()

    def close(self) -> None:
        """Accept no more items. Iteration still returns the waiting ones."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def __iter__(self) -> Iterator[T]:
        waited_before = 1  # number of items that waited the last time
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._items or self._closed)
                if not self._items:
                    return
                waiting = len(self._items)
                if self._catch_up and waiting >= waited_before > 1:
                    self.dropped += waiting - 1
                    self._items = deque([self._items[-1]])
                waited_before = waiting
                item = self._items.popleft()
            yield item
