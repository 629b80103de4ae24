"""Interfaces of the engine: tasks, how they end, and what runs them."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from typing import Protocol, TypeAlias


@dataclass(frozen=True, slots=True)
class JobResult:
    """Outcome of a job. ``error`` is empty if its results are complete."""

    name: str
    frames: int = 0
    seconds: float = 0.0
    error: str = ""


JobResults: TypeAlias = Generator[JobResult, None, None]


class Task(Protocol):
    """Picklable work for another process or machine. One process runs one task at a time."""

    @property
    def name(self) -> str:
        """Name that is unique in the run."""
        ...

    @property
    def identity(self) -> str:
        """Name that is unique everywhere. Two tasks share it only if they make the same result."""
        ...

    def run(self, threads: int, on_frame: Callable[[], None], /) -> JobResult:
        """Run the task.

        Args:
            threads: largest number of threads.
            on_frame: called after each frame.
        """
        ...


class Engine(Protocol):
    """Runner of tasks: ``local.Processes`` or ``dask.Cluster``. The caller closes it."""

    def close(self) -> None:
        """End the workers."""
        ...

    @property
    def count(self) -> int:
        """Number of tasks that run at the same time."""
        ...

    def run(
        self,
        jobs: Iterable[Task],
        retries: int,
        on_frame: Callable[[], None],
        tick: Callable[[], None] = lambda: None,
    ) -> JobResults:
        """Run each task once and yield its outcome as soon as it ends.

        Args:
            jobs: the tasks, in order. Each is taken when a worker is free, or nearly so.
            retries: how often a task is run again if its input is not the cause of the failure.
            on_frame: called for each frame of any task.
            tick: called regularly. An exception in it ends the run.
        """
        ...
