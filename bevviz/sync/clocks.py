"""Clocks that stamp messages, compared with the clock that received them.

A camera with its own clock is fused with scans of another time, and its stamps do not show that. The lag from
stamp to receipt does: apart from delays, it is equal for all sensors of a robot. A delay is told from a clock
that is behind by the stamps: sensors that are triggered together have the same ones.
"""

from __future__ import annotations

import math
from collections import defaultdict, deque
from collections.abc import Iterable, Iterator
from functools import partial
from statistics import median

import numpy as np

from bevviz.config import SyncConfig
from bevviz.model.frame import F64

APART = 0.6  # seconds; a larger difference between the lags of two topics is hardly a usual delay
ENOUGH, LAST = 3, 50  # least and most messages of a topic for its lag
LIVE = 9  # the most beside a robot: at 5 Hz half of them come in a second, and two looks take another
TRIED = 500  # most messages of a topic on which a remedy is tried
TAI = 37.0  # seconds that TAI is ahead of UTC since 2017
BY_RECEIPT = "--set sync.by=received goes by the time of receipt"
EPOCH = 10 * 365 * 86_400.0  # seconds; a clock that is off by ten years counts from its start
AHEAD = 0.1  # seconds; a stamp so long after its receipt is of a wrong clock
LONGEST = 60.0  # seconds; no message is received so late
LATENCY = 2.0  # seconds that an image is kept for a cloud that is received later, besides sync.max_wait
AGREE = 0.02  # share of the period; stamps that differ by less are of one trigger


class Clocks:
    """Correction of stamps, with the lags of the last messages.

    Args:
        config: seconds to add to the stamps, or that the time of receipt is used in their place.
        driver: topic whose messages make the frames.
        last: most messages of a topic for its lag.
    """

    def __init__(self, config: SyncConfig, driver: str, last: int = LAST) -> None:
        self._config, self.driver, self._last = config, driver, last
        self._offsets = {topic: round(seconds * 1e9) for topic, seconds in config.offsets.items()}
        self._received = config.by == "received"
        # Stamp and time of receipt of the last messages.
        self._times: dict[str, deque[tuple[int, int]]] = defaultdict(partial(deque, maxlen=TRIED))

    def stamp(self, topic: str, stamp: int, received: int) -> int:
        """Return the stamp to use, nanoseconds."""
        stamp = (received if self._received else stamp) + self._offsets.get(topic, 0)
        self._times[topic].append((stamp, received))
        return stamp

    def forget(self) -> None:
        """Forget the lags, as the clock of the robot has jumped. Those of another time would be no faults."""
        self._times.clear()

    def lag(self, topic: str) -> float | None:
        """Return the median seconds from stamp to receipt; None if there are too few messages."""
        lags = [received - stamp for stamp, received in list(self._times.get(topic, ()))[-self._last :]]
        return median(lags) * 1e-9 if len(lags) >= ENOUGH else None

    def differ_from_receipt(self, topic: str) -> bool:
        """Return whether the time of receipt tells the messages of a topic apart better than their stamps."""
        lags = {received - stamp for stamp, received in self._times.get(topic, ())}
        return not self._received and len(lags) > 1

    def apart(self, topic: str, other: str) -> float:
        """Return the seconds from the lag of ``other`` to that of ``topic``; 0 if it may be a usual delay."""
        lag, others = self.lag(topic), self.lag(other)
        difference = 0.0 if lag is None or others is None else lag - others
        return difference if abs(difference) > APART else 0.0

    def wrong(self, topic: str, other: str) -> float:
        """Return the seconds that a clock is off; 0 if it is right, or if messages may come so late."""
        off = self.apart(topic, other)
        lags = [lag for lag in (self.lag(topic), self.lag(other)) if lag is not None]
        return off if abs(off) > LONGEST or min(lags, default=0.0) < -AHEAD else 0.0

    def reference(self, topics: Iterable[str]) -> str:
        """Return the topic whose stamps are nearest to their receipt. Its clock is taken for right."""
        lags = {topic: lag for topic in topics if (lag := self.lag(topic)) is not None}
        return min(lags, key=lambda topic: abs(lags[topic]), default="")

    def doubts(self, topics: Iterable[str]) -> Iterator[str]:
        """Yield a sentence for each topic whose clock is wrong, or whose messages come too late.

        Args:
            topics: topics whose clocks must agree.
        """
        topics = list(topics)
        right = self.reference(topics)
        for topic in topics:
            off = self.apart(topic, right)
            if off and self.wrong(topic, right):
                yield f"{topic}: {_clock(off, right)}; {_remedy(topic, off)}"
            elif off:
                yield from self._late(topic, off, right)

    def _late(self, topic: str, off: float, right: str) -> Iterator[str]:
        """Yield a sentence about messages that come late, or whose clock is behind, unless all is well."""
        agree = self._agree(topic, right)
        drives = topic == self.driver
        spare = self._config.max_wait + (LATENCY if drives else 0.0)
        if off < spare and (agree or not drives):
            return  # They are waited for.
        what = f"{topic}: its messages come {off:.2f} s later than those of {right}"
        remedies = []
        arrivals = self._arrivals(right if drives else topic) if off >= spare else np.zeros((0, 2))
        if len(arrivals):  # else there are too few messages to try it
            wait, queue = self._needed(arrivals)
            now = self._in_time(arrivals, self._config.max_wait, self._config.queue)
            remedies.append(
                f"--set sync.max_wait={wait:g} --set sync.queue={queue} waits for them, so that "
                f"{self._in_time(arrivals, wait, queue)} of {len(arrivals)} scans have the message of their "
                f"stamp in place of {now}"
            )
        if agree:
            yield "; ".join([f"{what}, at the same stamps", *remedies])
            return
        offset = f"--set sync.offsets='{{{topic}: {off:.2f}}}' sets it right"
        remedies.append(f"if its clock is behind, {offset}" if remedies else offset)
        yield f"{topic}: {_clock(off, right)}; {'; '.join(remedies)}"

    def _agree(self, topic: str, other: str) -> bool:
        """Return whether two topics have equal stamps, as sensors with one trigger and one clock do."""
        stamps, others = self._stamps(topic), self._stamps(other)
        first, last = max(stamps[0], others[0]), min(stamps[-1], others[-1])
        common = stamps[(stamps >= first) & (stamps <= last)]
        if len(common) < ENOUGH or len(others) < ENOUGH:
            return False
        period = float(np.median(np.diff(others)))
        return float(np.median(_distances(common, others))) < AGREE * period

    def _stamps(self, topic: str) -> F64:
        """Return the sorted stamps of the last messages in seconds."""
        origin = self._times[self.driver][0][0] if self._times.get(self.driver) else 0
        return np.sort(np.array([stamp - origin for stamp, _ in self._times[topic]], np.float64)) * 1e-9

    def _arrivals(self, topic: str) -> F64:
        """Return for each of the last scans its time of receipt, and that of the message nearest in stamp.

        The scans are in order of receipt, and in seconds. Scans beyond the messages are left out.
        """
        origin = self._times[self.driver][0][1] if self._times.get(self.driver) else 0
        scans, messages = (
            (np.array(self._times[name] or np.zeros((0, 2)), np.int64) - origin) * 1e-9
            for name in (self.driver, topic)
        )
        messages = messages[np.argsort(messages[:, 0])]
        if not len(scans) or len(messages) < ENOUGH:
            return np.zeros((0, 2))
        inside = (scans[:, 0] >= messages[0, 0]) & (scans[:, 0] <= messages[-1, 0])
        scans = scans[inside][np.argsort(scans[inside, 1])]
        nearest = np.abs(messages[None, :, 0] - scans[:, None, 0]).argmin(axis=1)
        return np.stack([scans[:, 1], messages[nearest, 1]], axis=1)

    def _needed(self, arrivals: F64) -> tuple[float, int]:
        """Return ``sync.max_wait`` and ``sync.queue`` with which all scans have the nearest message."""
        if not len(arrivals):
            return self._config.max_wait, self._config.queue
        behind = arrivals[:, 1] - arrivals[:, 0]
        wait = math.ceil(10 * float(max(behind.max(), (-behind).max() - LATENCY)) + 1) / 10
        wait = min(max(wait, self._config.max_wait), LONGEST)
        queue = math.ceil(wait / float(np.median(np.diff(arrivals[:, 0])))) + 1 if len(arrivals) > 1 else 1
        return wait, min(max(queue, self._config.queue), 1000)

    def _in_time(self, arrivals: F64, wait: float, queue: int) -> int:
        """Return how many scans have the nearest message, as the synchroniser waits and keeps messages."""
        until = arrivals[:, 0] + wait
        until[:-queue] = np.minimum(until[:-queue], arrivals[queue:, 0])
        kept = arrivals[:, 0] - wait - LATENCY - self._config.tolerance
        return int(((arrivals[:, 1] >= kept) & (arrivals[:, 1] <= until)).sum())


def _distances(stamps: F64, others: F64) -> F64:
    """Return the distance from each stamp to the nearest of the others."""
    after = np.clip(np.searchsorted(others, stamps), 1, len(others) - 1)
    return np.minimum(np.abs(others[after] - stamps), np.abs(others[after - 1] - stamps))


def _clock(off: float, right: str) -> str:
    if off > EPOCH:
        return "its stamps count from when its clock was started, not from 1970"
    if abs(off + TAI) < APART:
        return f"its clock is {TAI:.0f} s ahead of that of {right}, as TAI is of UTC"
    if off > LONGEST:
        return f"its clock is {off:.2f} s behind that of {right}"
    if off > 0:
        return f"its clock is {off:.2f} s behind that of {right}, or its messages take as long"
    return f"its clock is {-off:.2f} s ahead of that of {right}"


def _remedy(topic: str, off: float) -> str:
    if abs(off) > EPOCH:
        return f"{BY_RECEIPT}; or let its driver stamp with the system's time"
    return f"--set sync.offsets='{{{topic}: {off:.2f}}}' sets it right, {BY_RECEIPT}"
