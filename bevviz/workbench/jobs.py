"""Background jobs that a page asks for: runs with other values, the search of a fix, and reports."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Generic, TypeVar

from bevviz.errors import UserError, first_line
from bevviz.support.json_form import LEFT_OUT, message_form
from bevviz.support.loggers import logger

_log = logger(__name__)


@message_form
@dataclass(slots=True)
class Job:
    """Work in a thread of its own.

    Attributes:
        number: number of the job among those of its kind, from 0.
        settings: settings that it is about.
        total: number of steps.
        state: waiting, running, over, cancelled or failed.
        error: reason of the failure.
        done: number of finished steps.
        stop: cancels the job when it is set.
    """

    number: int
    settings: tuple[str, ...] = ()
    total: int = 0
    state: str = "running"
    error: str = ""
    done: int = 0
    stop: Annotated[threading.Event, LEFT_OUT] = field(default_factory=threading.Event)

    @property
    def going(self) -> bool:
        """Whether the job is waiting or running."""
        return self.state in ("waiting", "running")

    def check(self) -> None:
        """Check that the job goes on.

        Raises:
            CancelledError: it was cancelled.
        """
        if self.stop.is_set():
            raise CancelledError


class CancelledError(Exception):
    """The job was cancelled."""


J = TypeVar("J", bound=Job)


class Jobs(Generic[J]):
    """Jobs of one kind. One at a time runs.

    Args:
        name: name of the kind.
        tell: tells the pages about progress.

    Attributes:
        jobs: the jobs, the newest last.
    """

    def __init__(self, name: str, tell: Callable[[], None]) -> None:
        self._name, self._tell = name, tell
        self._thread: threading.Thread | None = None
        self.jobs: list[J] = []

    def check_idle(self, text: str) -> None:
        """Check that no job is running.

        Raises:
            UserError: one is, which the text says.
        """
        if self.jobs and self.jobs[-1].going:
            raise UserError(f"{text}: wait for it, or cancel it")

    def start(self, job: J, work: Callable[[J], None]) -> None:
        """Start a job. Its result until then stays if it is cancelled."""
        self.jobs.append(job)
        self._thread = threading.Thread(target=self._run, args=(job, work), name=self._name, daemon=True)
        self._thread.start()
        self._tell()

    def cancel(self) -> None:
        """Cancel the newest job. It ends after its present step."""
        if self.jobs:
            self.jobs[-1].stop.set()

    def end(self, patience: float | None = None) -> None:
        """Cancel the newest job, and wait for its end, for these seconds at most."""
        self.cancel()
        if self._thread is not None:
            self._thread.join(patience)

    def _run(self, job: J, work: Callable[[J], None]) -> None:
        try:
            work(job)
            job.state = "cancelled" if job.stop.is_set() else "over"
        except CancelledError:
            job.state = "cancelled"
        except Exception as error:
            is_expected = isinstance(error, UserError)
            job.error = str(error) if is_expected else f"the {self._name} failed: {first_line(error)}"
            job.state = "failed"
            if not is_expected:
                _log.error(job.error, exc_info=error)
        self._tell()
