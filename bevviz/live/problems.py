"""The one list of what is wrong in a live run. Terminal, /diagnostics, lanes, page and exit are its views."""

from __future__ import annotations

import re
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime

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


@dataclass(slots=True)
class PastProblem:
    """Times at which a problem held. It may hold still."""

    finding: InputFinding  # as it was last
    begin: float  # of the first time, seconds since 1970
    times: int = 0
    seconds: float = 0.0  # of the times that are over
    end: float | None = None  # of the last time, seconds since 1970; None: it holds
    cases: int = 0  # messages or frames, where they are counted

    def __str__(self) -> str:
        """Return one sentence with begin and end."""
        begin = _clock(self.begin)
        span = f"since {begin}" if self.end is None else f"{begin} to {_clock(self.end)}"
        if self.times > 1:
            span = f"{span}, {self.times} times, {self.seconds:.0f} s"
        if self.cases:
            span = f"{span}, {self.cases:,} case{'s' if self.cases != 1 else ''}"
        return f"{self.finding} ({span})"


class CurrentProblems:
    """List of the problems. The user is told when one begins, changes or ends. Any thread may use it.

    Args:
        tell: called with one sentence.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        self.tell = tell
        self._lock = threading.Lock()
        self._problems: dict[tuple[str, str], Problem] = {}
        self._past: dict[tuple[str, str], PastProblem] = {}
        self._rows: Counter[tuple[str, str]] = Counter()  # calls in a row with a sentence; negative: without
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
        begins: int = 1,
        ends: int = 1,
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
            begins: calls in a row with a sentence from which on the problem holds.
            ends: calls in a row without one after which it is over.
        """
        remedy = Remedy(remedy) if isinstance(remedy, str) else remedy
        finding = InputFinding(kind, subject, text, remedy)
        key, now = (kind, subject), time.time()
        with self._lock:
            row = self._rows[key]
            self._rows[key] = row = max(1, row + 1) if text else min(-1, row - 1)
            before = self._problems.get(key)
            if (before is None and row < begins) or (before is not None and 0 < -row < ends):
                return
            self._problems.pop(key, None)
            if text:
                since = now if before is None else before.since
                self._problems[key] = Problem(finding, since, over or f"over: {text}")
                past = self._past.setdefault(key, PastProblem(finding, now))
                past.finding, past.end = finding, None
                past.times += before is None
            elif before is not None:
                past = self._past[key]
                past.end = now
                past.seconds += now - before.since
        if not text:
            if before is not None:
                self.tell(over or before.over)
        elif before is None or not (quiet or _without_values(str(finding)) == _without_values(str(before))):
            self.tell(str(finding))

    def count(self, kind: str, subject: str, cases: int) -> None:
        """Set the number of cases of a problem, if it has ever held."""
        with self._lock:
            if (past := self._past.get((kind, subject))) is not None:
                past.cases = cases

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

    @property
    def past(self) -> dict[tuple[str, str], PastProblem]:
        """All problems of the run by kind and subject, also those that hold, in order of their begin."""
        with self._lock:
            return {key: replace(past) for key, past in self._past.items()}


def _clock(seconds: float) -> str:
    return datetime.fromtimestamp(seconds).strftime("%H:%M:%S")


def _without_values(text: str) -> str:
    return _VALUES.sub("#", text)
