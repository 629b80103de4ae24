"""The last messages of a topic, by their stamps."""

from __future__ import annotations

from bisect import bisect_left
from typing import Generic, TypeVar

T = TypeVar("T")

JUMP = 1_000_000_000  # a stamp that is this much older than its topic's newest means that the clock was reset


class Track(Generic[T]):
    """The last messages of one topic, in order of stamp, ``horizon`` nanoseconds of them."""

    def __init__(self, horizon: int) -> None:
        self._horizon = horizon
        self._stamps: list[int] = []
        self._items: list[T] = []

    def __len__(self) -> int:
        return len(self._items)

    @property
    def newest(self) -> int | None:
        return self._stamps[-1] if self._stamps else None

    def add(self, stamp: int, item: T) -> bool:
        """Whether it takes the place of another one with that stamp."""
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
        near = bisect_left(self._stamps, stamp)
        best = min(range(near - 1, near + 1), key=lambda i: self._distance(i, stamp))
        return (self._stamps[best], self._items[best]) if 0 <= best < len(self) else None

    def _distance(self, i: int, stamp: int) -> float:
        return abs(self._stamps[i] - stamp) if 0 <= i < len(self) else float("inf")

    def take(self, stamp: int, first: int, last: int) -> T | None:
        """Remove and return the item within [first, last] that is nearest to ``stamp``."""
        inside = [i for i, s in enumerate(self._stamps) if first <= s <= last]
        if not inside:
            return None
        best = min(inside, key=lambda i: self._distance(i, stamp))
        del self._stamps[best]
        return self._items.pop(best)

    def shed(self, last: int) -> list[T]:
        """Remove and return what has that stamp or an earlier one."""
        end = bisect_left(self._stamps, last + 1)
        gone, self._items = self._items[:end], self._items[end:]
        del self._stamps[:end]
        return gone

    def forget(self, before: int) -> None:
        """Drop what is older, but for the last of it, which may be the nearest to the next cloud."""
        first = max(0, bisect_left(self._stamps, before) - 1)
        del self._stamps[:first], self._items[:first]

    def keep(self, first: int, last: int) -> None:
        low, high = bisect_left(self._stamps, first), bisect_left(self._stamps, last + 1)
        self._stamps, self._items = self._stamps[low:high], self._items[low:high]


def too_far(nearest: tuple[int, object] | None, stamp: int, tolerance: int) -> str:
    """Of what is nearest to a stamp and not within the tolerance, both in nanoseconds."""
    within = f"within {tolerance * 1e-9:.2f} s"
    if nearest is None:
        return f"{within}: none at all around this time"
    away = (nearest[0] - stamp) * 1e-9
    return f"{within}: nearest is {abs(away):.2f} s {'later' if away > 0 else 'earlier'}"
