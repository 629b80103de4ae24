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


@dataclass(slots=True)
class Problem:
    """Finding that holds, or has held, with its times in seconds since 1970."""

    finding: InputFinding  # as it was last
    begin: float  # of the first time
    since: float  # begin of the last time
    over: str = ""  # sentence for its end
    times: int = 0
    seconds: float = 0.0  # of the times that are over
    end: float | None = None  # of the last time; None: it holds
    cases: int = 0  # messages or frames, where they are counted

    def __str__(self) -> str:
        return str(self.finding)

    @property
    def history(self) -> str:
        """One sentence with begin and end."""
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
        self._problems: dict[tuple[str, str], Problem] = {}  # of the whole run
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
            problem = self._problems.get(key) or Problem(finding, now, now, end=now)
            holds, before = problem.end is None, str(problem)
            if (not holds and row < begins) or (holds and 0 < -row < ends):
                return
            self._problems[key] = problem
            if text:
                problem.since = problem.since if holds else now
                problem.times += not holds
                problem.finding, problem.over, problem.end = finding, over or f"over: {text}", None
            else:
                problem.end = now
                problem.seconds += now - problem.since
        if not text:
            self.tell(over or problem.over)
        elif not holds or not (quiet or _without_values(str(finding)) == _without_values(before)):
            self.tell(str(finding))

    def count(self, kind: str, subject: str, cases: int) -> None:
        """Set the number of cases of a problem, if it has ever held."""
        with self._lock:
            if (problem := self._problems.get((kind, subject))) is not None:
                problem.cases = cases

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
            problems = [replace(problem) for problem in self._problems.values() if problem.end is None]
        return sorted(problems, key=lambda problem: problem.since)

    def of(self, subject: str) -> list[Problem]:
        """Return the current problems of a topic, sensor, viewer or stage."""
        return [problem for problem in self.current if problem.finding.subject == subject]

    @property
    def all(self) -> dict[tuple[str, str], Problem]:
        """All problems of the run by kind and subject, in order of their begin."""
        with self._lock:
            return {key: replace(problem) for key, problem in self._problems.items()}


def _clock(seconds: float) -> str:
    return datetime.fromtimestamp(seconds).strftime("%H:%M:%S")


def _without_values(text: str) -> str:
    return _VALUES.sub("#", text)
