"""Buffer of the last messages of a topic, by stamp."""

from __future__ import annotations

from bisect import bisect_left
from typing import Generic, TypeVar

T = TypeVar("T")

# Nanoseconds. A stamp that is older than its topic's newest by more means that the clock was reset.
JUMP = 1_000_000_000


class TopicBuffer(Generic[T]):
    """Buffer of the messages of one topic, in order of stamp. It keeps the last ``horizon`` nanoseconds."""

    def __init__(self, horizon: int) -> None:
        self._horizon = horizon
        self._stamps: list[int] = []
        self._items: list[T] = []

    def __len__(self) -> int:
        return len(self._items)

    @property
    def newest(self) -> int | None:
        """Newest stamp; None: the buffer is empty."""
        return self._stamps[-1] if self._stamps else None

    def add(self, stamp: int, item: T) -> bool:
        """Add a message. Return whether it replaces one with the same stamp."""
        if self._stamps and stamp < self._stamps[-1] - JUMP:
            self.keep(0, -1)
        i = bisect_left(self._stamps, stamp)
        if i < len(self._stamps) and self._stamps[i] == stamp:
            self._items[i] = item
            return True
        self._stamps.insert(i, stamp)
        self._items.insert(i, item)
        self.forget(self._stamps[-1] - self._horizon)
        return False

    def nearest(self, stamp: int) -> tuple[int, T] | None:
        """Return stamp and message nearest to a stamp; None if the buffer is empty."""
        near = bisect_left(self._stamps, stamp)
        best = min(range(near - 1, near + 1), key=lambda i: self._distance(i, stamp))
        return (self._stamps[best], self._items[best]) if 0 <= best < len(self) else None

    def _distance(self, i: int, stamp: int) -> float:
        return abs(self._stamps[i] - stamp) if 0 <= i < len(self) else float("inf")

    def take(self, stamp: int, first: int, last: int) -> T | None:
        """Remove and return the message within [first, last] that is nearest to ``stamp``."""
        inside = [i for i, s in enumerate(self._stamps) if first <= s <= last]
        if not inside:
            return None
        best = min(inside, key=lambda i: self._distance(i, stamp))
        del self._stamps[best]
        return self._items.pop(best)

    def shed(self, last: int) -> list[T]:
        """Remove and return the messages up to a stamp."""
        end = bisect_left(self._stamps, last + 1)
        removed, self._items = self._items[:end], self._items[end:]
        del self._stamps[:end]
        return removed

    def forget(self, before: int) -> None:
        """Drop older messages, except the last of them: it may be the nearest to the next cloud."""
        first = max(0, bisect_left(self._stamps, before) - 1)
        del self._stamps[:first], self._items[:first]

    def keep(self, first: int, last: int) -> None:
        """Drop the messages outside [first, last]."""
        low, high = bisect_left(self._stamps, first), bisect_left(self._stamps, last + 1)
        self._stamps, self._items = self._stamps[low:high], self._items[low:high]


def describe_distance(nearest: tuple[int, object] | None, stamp: int, tolerance: int) -> str:
    """Describe how far the nearest message is from a stamp (nanoseconds), for the end of a sentence."""
    within = f"within {tolerance * 1e-9:.2f} s"
    if nearest is None:
        return f"{within}: none at all around this time"
    away = (nearest[0] - stamp) * 1e-9
    return f"{within}: nearest is {abs(away):.2f} s {'later' if away > 0 else 'earlier'}"
