"""Watch over the messages that arrive. Each problem is reported when it begins and when it ends."""

from __future__ import annotations

import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from statistics import median
from typing import Literal

from bevviz.sync.report import UnusableMessages

SILENCE = 2.0  # seconds without a message that are reported, unless five usual steps are longer
STREAM = 5  # messages after which a topic counts as a stream that should continue
AGAIN = 10  # unusable messages in a row that are reported once more

TopicState = Literal["ok", "silent", "unusable", "no publisher"]


@dataclass(slots=True)
class _Arrivals:
    """Arrivals of one topic."""

    count: int = 0
    bytes: int = 0
    times: deque[float] = field(default_factory=lambda: deque(maxlen=20))  # seconds, monotonic
    row: int = 0  # unusable messages since the last usable one


class Watch:
    """Counter of received messages and record of the current problems.

    Args:
        tell: called with one sentence each time a problem begins or ends.
        clock: returns seconds, for tests.
    """

    def __init__(self, tell: Callable[[str], None], clock: Callable[[], float] = time.monotonic) -> None:
        self.tell, self._clock = tell, clock
        self._told: set[str] = set()
        self._topics: dict[str, _Arrivals] = defaultdict(_Arrivals)
        self._damage = UnusableMessages()
        self._notes: dict[str, str] = {}  # subject -> its sentence, while it holds

    # --- messages ------------------------------------------------------------------------------

    @property
    def received(self) -> Counter[str]:
        """Messages since the start, by topic."""
        return Counter({name: topic.count for name, topic in self._topics.items()})

    @property
    def volume(self) -> Counter[str]:
        """Bytes since the start, by topic."""
        return Counter({name: topic.bytes for name, topic in self._topics.items()})

    def add(self, topic: str, size: int) -> bool:
        """Count a message. Return whether it is the first of its topic."""
        arrivals = self._topics[topic]
        arrivals.count += 1
        arrivals.bytes += size
        arrivals.times.append(self._clock())
        return arrivals.count == 1

    def usable(self, topic: str) -> None:
        """Record that a message of a topic could be used."""
        arrivals = self._topics[topic]
        arrivals.row = 0
        self.note(f"{topic} unusable", "", f"{topic}: its messages can be used again")

    def unusable(self, topic: str, reason: str) -> None:
        """Record a message that cannot be used. The reason names the topic."""
        arrivals = self._topics[topic]
        arrivals.row += 1
        if self._damage.add(topic, reason) == 1 or arrivals.row == AGAIN:
            self.note(f"{topic} unusable", f"a message cannot be used: {reason}")

    def silent_for(self, topic: str) -> float:
        """Return the seconds since the last message of a stream, or 0 if that is a usual time."""
        if topic not in self._topics or len(self._topics[topic].times) < STREAM:
            return 0.0
        times = self._topics[topic].times
        steps = [after - before for before, after in zip(times, list(times)[1:], strict=False)]
        silent = self._clock() - times[-1]
        return silent if silent > max(SILENCE, 5 * median(steps)) else 0.0

    def state(self, topic: str, published: bool) -> TopicState:
        """Return the state of a topic. ``published``: whether it has a publisher."""
        if not published:
            return "no publisher"
        if self.silent_for(topic):
            return "silent"
        return "unusable" if topic in self._topics and self._topics[topic].row else "ok"

    # --- current problems ----------------------------------------------------------------------

    def note(self, about: str, text: str, over: str = "") -> None:
        """Report ``text`` when it begins to hold, and ``over`` when ``text`` is empty again."""
        before = self._notes.pop(about, "")
        if text:
            self._notes[about] = text
        if text != before and (text or over):
            self.tell(text or over)

    def once(self, text: str) -> None:
        """Report a sentence the first time, and never again."""
        if text not in self._told:
            self._told.add(text)
            self.tell(text)

    @property
    def warnings(self) -> list[str]:
        """Sentences that hold now, followed by the counts of unusable messages."""
        holds = [text for about, text in self._notes.items() if not about.endswith(" unusable")]
        return [*holds, *self._damage.sentences]

    def states(self, published: Mapping[str, bool]) -> dict[str, TopicState]:
        """Return the state of each topic, given whether it has a publisher."""
        return {name: self.state(name, is_published) for name, is_published in published.items()}
