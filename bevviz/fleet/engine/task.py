"""What the engine runs: tasks, each by one process at a time, and how they end."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from typing import Protocol, TypeAlias


@dataclass(frozen=True, slots=True)
class JobResult:
    """How a job ended. ``error`` is empty where its results are complete."""

    name: str
    frames: int = 0
    seconds: float = 0.0
    error: str = ""


JobResults: TypeAlias = Generator[JobResult, None, None]


class Task(Protocol):
    """A piece of work that another process, or another machine, can do by itself. It can be pickled."""

    @property
    def name(self) -> str:
        """No two tasks of a run have the same."""
        ...

    @property
    def identity(self) -> str:
        """No two tasks anywhere have the same, unless they make the same."""
        ...

    def run(self, threads: int, on_frame: Callable[[], None], /) -> JobResult:
        """Do it. ``threads``: at most so many; ``on_frame`` is called after each frame."""
        ...


class Engine(Protocol):
    """What runs tasks: ``local.Processes`` or ``dask.Cluster``. It is closed in the end, or before."""

    def close(self) -> None: ...

    @property
    def count(self) -> int:
        """Tasks that are run at the same time."""
        ...

    def run(
        self,
        jobs: Iterable[Task],
        retries: int,
        on_frame: Callable[[], None],
        tick: Callable[[], None] = lambda: None,
    ) -> JobResults:
        """Run the tasks, each once, and yield how they ended, as they end.

        Args:
            jobs: what to do; the first ones first. Each is asked for when a worker is free, or nearly so.
            retries: how often a task is run again that failed for no fault of its input.
            on_frame: called for each frame of any of them.
            tick: called every now and then; what it raises ends all.
        """
        ...
