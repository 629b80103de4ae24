"""Counter of messages and boxes that could not be used."""

from __future__ import annotations

from collections import Counter


class UnusableMessages:
    """Counts of unusable messages by topic, with the reason for the first one.

    Args:
        noun: name of the counted things.
    """

    def __init__(self, noun: str = "message(s)") -> None:
        self._noun = noun
        self._counts: Counter[str] = Counter()
        self._first: dict[str, str] = {}

    def add(self, topic: str, reason: str) -> int:
        """Count a message. Return the count of its topic.

        Args:
            topic: topic of the message.
            reason: a sentence that names the topic.
        """
        self._counts[topic] += 1
        self._first.setdefault(topic, reason)
        return self._counts[topic]

    @property
    def sentences(self) -> list[str]:
        """A sentence for each topic."""
        return [
            f"{count} {self._noun} of {topic} could not be used, the first: {self._first[topic]}"
            for topic, count in self._counts.items()
        ]
