"""Messages and boxes that could not be used: counted by topic, with the reason of the first."""

from __future__ import annotations

from collections import Counter


class Damage:
    """Of a bag as of a robot.

    Args:
        noun: what is counted.
    """

    def __init__(self, noun: str = "message(s)") -> None:
        self._noun = noun
        self._counts: Counter[str] = Counter()
        self._first: dict[str, str] = {}

    def add(self, topic: str, reason: str) -> int:
        """One more, and why, which names the topic. Returns how many of the topic there are."""
        self._counts[topic] += 1
        self._first.setdefault(topic, reason)
        return self._counts[topic]

    def extend(self, other: Damage) -> None:
        """What another one has counted."""
        self._counts += other._counts
        self._first = {**other._first, **self._first}

    @property
    def sentences(self) -> list[str]:
        """One for each topic."""
        return [
            f"{count} {self._noun} of {topic} could not be used, the first: {self._first[topic]}"
            for topic, count in self._counts.items()
        ]
