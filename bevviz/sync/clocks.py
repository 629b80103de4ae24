"""Clocks that stamp messages, compared with the clock that received them.

A camera with its own clock is fused with scans of another time, and its stamps do not show that. The lag from
stamp to receipt does: apart from delays, it is equal for all sensors of a robot.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from statistics import median

APART = 0.6  # seconds; a larger difference between the lags of two topics is hardly a delay
ENOUGH, LAST = 3, 50  # least and most messages of a topic for its lag
TAI = 37.0  # seconds that TAI is ahead of UTC since 2017
BY_RECEIPT = "--set sync.by=received goes by the time of receipt"
EPOCH = 10 * 365 * 86_400.0  # seconds; a clock that is off by ten years counts from its start


class Clocks:
    """Correction of stamps, with the lags of the last messages.

    Args:
        offsets: seconds to add to the stamps, by topic.
        by: ``stamp``; or ``received`` to use the time of receipt in place of the stamp.
    """

    def __init__(self, offsets: Mapping[str, float], by: str) -> None:
        self._offsets = {topic: round(seconds * 1e9) for topic, seconds in offsets.items()}
        self._received = by == "received"
        self._lags: dict[str, deque[int]] = defaultdict(partial(deque, maxlen=LAST))

    def stamp(self, topic: str, stamp: int, received: int) -> int:
        """Return the stamp to use, nanoseconds."""
        stamp = (received if self._received else stamp) + self._offsets.get(topic, 0)
        self._lags[topic].append(received - stamp)
        return stamp

    def lag(self, topic: str) -> float | None:
        """Return the median seconds from stamp to receipt; None if there are too few messages."""
        lags = self._lags.get(topic, ())
        return median(lags) * 1e-9 if len(lags) >= ENOUGH else None

    def differ_from_receipt(self, topic: str) -> bool:
        """Return whether the time of receipt tells the messages of a topic apart better than their stamps."""
        return not self._received and len(set(self._lags.get(topic, ()))) > 1

    def apart(self, topic: str, other: str) -> float:
        """Return the seconds that ``topic``'s clock is behind that of ``other``; 0 if it may be a delay."""
        lag, others = self.lag(topic), self.lag(other)
        difference = 0.0 if lag is None or others is None else lag - others
        return difference if abs(difference) > APART else 0.0

    def doubts(self, topics: Iterable[str]) -> Iterator[str]:
        """Yield a sentence for each topic whose clock is wrong.

        Args:
            topics: topics whose clocks must agree.
        """
        lags = {topic: lag for topic in topics if (lag := self.lag(topic)) is not None}
        right = min(lags, key=lambda topic: abs(lags[topic]), default="")
        for topic in lags:
            off = self.apart(topic, right)
            if off:
                yield f"{topic}: {_clock(off, right)}; {_remedy(topic, off)}"


def _clock(off: float, right: str) -> str:
    if off > EPOCH:
        return "its stamps count from when its clock was started, not from 1970"
    if abs(off + TAI) < APART:
        return f"its clock is {TAI:.0f} s ahead of that of {right}, as TAI is of UTC"
    if off > 0:
        return f"its clock is {off:.2f} s behind that of {right}, or its messages take as long"
    return f"its clock is {-off:.2f} s ahead of that of {right}"


def _remedy(topic: str, off: float) -> str:
    if abs(off) > EPOCH:
        return f"{BY_RECEIPT}; or let its driver stamp with the system's time"
    return f"--set sync.offsets='{{{topic}: {off:.2f}}}' sets it right, {BY_RECEIPT}"
