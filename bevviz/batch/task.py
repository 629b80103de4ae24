"""What the engine runs: tasks, each by one process at a time, and how they end."""

from __future__ import annotations

from collections.abc import Callable, Generator
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
