"""What does not arrive as it should: told at once, and told again when it is over."""

from __future__ import annotations

import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from statistics import median
from typing import Literal

from bevviz.sync.unusable_messages import Damage

SILENCE = 2.0  # seconds without a message that are told, or five usual steps
STREAM = 5  # messages after which a topic is taken for a stream that should go on
AGAIN = 10  # unusable messages in a row that are told again, after usable ones

TopicState = Literal["ok", "silent", "unusable", "no publisher"]


@dataclass(slots=True)
class _Arrivals:
    """Of one topic."""

    count: int = 0
    bytes: int = 0
    times: deque[float] = field(default_factory=lambda: deque(maxlen=20))  # seconds, monotonic
    row: int = 0  # unusable ones since the last that could be used


class Watch:
    """Keeps account of what was received, and of what holds now and should be known.

    Args:
        tell: called with one sentence each time something begins or ends to hold.
        clock: seconds, for tests.
    """

    def __init__(self, tell: Callable[[str], None], clock: Callable[[], float] = time.monotonic) -> None:
        self.tell, self._clock = tell, clock
        self._told: set[str] = set()
        self._topics: dict[str, _Arrivals] = defaultdict(_Arrivals)
        self._damage = Damage()
        self._notes: dict[str, str] = {}  # what a sentence is about -> the sentence, while it holds

    # --- messages ------------------------------------------------------------------------------

    @property
    def received(self) -> Counter[str]:
        """Topic -> messages, since the start."""
        return Counter({name: topic.count for name, topic in self._topics.items()})

    @property
    def volume(self) -> Counter[str]:
        """Topic -> bytes, since the start."""
        return Counter({name: topic.bytes for name, topic in self._topics.items()})

    def add(self, topic: str, size: int) -> bool:
        """A message has come. True: the first one."""
        arrivals = self._topics[topic]
        arrivals.count += 1
        arrivals.bytes += size
        arrivals.times.append(self._clock())
        return arrivals.count == 1

    def usable(self, topic: str) -> None:
        arrivals = self._topics[topic]
        arrivals.row = 0
        self.note(f"{topic} unusable", "", f"{topic}: its messages can be used again")

    def unusable(self, topic: str, reason: str) -> None:
        """What cannot be used, and the reason, which names the topic."""
        arrivals = self._topics[topic]
        arrivals.row += 1
        if self._damage.add(topic, reason) == 1 or arrivals.row == AGAIN:
            self.note(f"{topic} unusable", f"a message cannot be used: {reason}")

    def silent_for(self, topic: str) -> float:
        """Seconds since the last message of a stream, where that is longer than usual; else 0."""
        if topic not in self._topics or len(self._topics[topic].times) < STREAM:
            return 0.0
        times = self._topics[topic].times
        steps = [after - before for before, after in zip(times, list(times)[1:], strict=False)]
        silent = self._clock() - times[-1]
        return silent if silent > max(SILENCE, 5 * median(steps)) else 0.0

    def state(self, topic: str, published: bool) -> TopicState:
        """How a topic does; ``published``: whether anybody still does."""
        if not published:
            return "no publisher"
        if self.silent_for(topic):
            return "silent"
        return "unusable" if topic in self._topics and self._topics[topic].row else "ok"

    # --- what holds ----------------------------------------------------------------------------

    def note(self, about: str, text: str, over: str = "") -> None:
        """Tell ``text`` when it begins to hold, and ``over`` when it is empty again."""
        before = self._notes.pop(about, "")
        if text:
            self._notes[about] = text
        if text != before and (text or over):
            self.tell(text or over)

    def once(self, text: str) -> None:
        """Tell it when it is found out, and not again."""
        if text not in self._told:
            self._told.add(text)
            self.tell(text)

    @property
    def warnings(self) -> list[str]:
        """What holds now, and how much could not be used."""
        holds = [text for about, text in self._notes.items() if not about.endswith(" unusable")]
        return [*holds, *self._damage.sentences]

    def states(self, published: Mapping[str, bool]) -> dict[str, TopicState]:
        """Of each topic, given whether anybody publishes it."""
        return {name: self.state(name, there) for name, there in published.items()}
