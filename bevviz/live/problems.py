"""The one list of what is wrong now in a live run. Terminal, /diagnostics, lanes and page are its views."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from bevviz.model.input_findings import InputFinding, Remedy

_VALUES = re.compile(r"(?<![\w/])\d[\d,.]*")  # numbers that are no part of a name


@dataclass(frozen=True, slots=True)
class Problem:
    """Finding that holds now, and the time since which it does, in seconds since 1970."""

    finding: InputFinding
    since: float
    over: str  # sentence for its end

    def __str__(self) -> str:
        return str(self.finding)


class CurrentProblems:
    """List of the current problems. The user is told when one begins, changes or ends. Any thread may use it.

    Args:
        tell: called with one sentence.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        self.tell = tell
        self._lock = threading.Lock()
        self._problems: dict[tuple[str, str], Problem] = {}
        self._events: set[str] = set()

    def set(
        self,
        kind: str,
        subject: str,
        text: str,
        over: str = "",
        remedy: Remedy | str | None = None,
        *,
        quiet: bool = False,
    ) -> None:
        """Set the problem of this kind and subject.

        Numbers in the sentence may change without a further line.

        Args:
            kind: word for the kind, such as ``silence``.
            subject: topic, sensor, viewer or stage.
            text: one sentence. Empty: the problem does not hold.
            over: sentence for its end. Empty: ``text`` is told to be over.
            remedy: what would end it.
            quiet: whether a changed sentence needs no further line.
        """
        remedy = Remedy(remedy) if isinstance(remedy, str) else remedy
        finding = InputFinding(kind, subject, text, remedy)
        with self._lock:
            before = self._problems.pop((kind, subject), None)
            if text:
                since = time.time() if before is None else before.since
                over = over or f"{subject}: over: {text}"
                self._problems[kind, subject] = Problem(finding, since, over)
        if not text:
            if before is not None:
                self.tell(over or before.over)
        elif before is None or not (quiet or _without_values(str(finding)) == _without_values(str(before))):
            self.tell(str(finding))

    def tell_once(self, text: str) -> None:
        """Tell about an event the first time, and never again. It is no lasting problem."""
        with self._lock:
            known = text in self._events
            self._events.add(text)
        if not known:
            self.tell(text)

    @property
    def current(self) -> list[Problem]:
        """The problems that hold now, the oldest first."""
        with self._lock:
            return sorted(self._problems.values(), key=lambda problem: problem.since)

    @property
    def sentences(self) -> list[str]:
        """The same as sentences."""
        return [str(problem) for problem in self.current]

    def of(self, subject: str) -> list[Problem]:
        """Return the current problems of a topic, sensor, viewer or stage."""
        return [problem for problem in self.current if problem.finding.subject == subject]


def _without_values(text: str) -> str:
    return _VALUES.sub("#", text)
