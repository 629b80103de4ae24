"""Interfaces between sources, runs and observers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from typing import Generic, Protocol, TypeVar

from bevviz.model.frame import I64, Frame, Scene

R = TypeVar("R")
T_co = TypeVar("T_co", covariant=True)
T_contra = TypeVar("T_contra", contravariant=True)
R_contra = TypeVar("R_contra", contravariant=True)


class Items(Protocol[T_co]):
    """Input of a run: a ``Source`` of frames, or any other sequence that describes its scene."""

    @property
    def scene(self) -> Scene: ...

    @property
    def total(self) -> int | None: ...

    @property
    def warnings(self) -> Sequence[str]: ...

    def __iter__(self) -> Iterator[T_co]: ...


class Frames(Protocol):
    """Source whose frames can be read in order and one by one."""

    @property
    def scene(self) -> Scene: ...

    @property
    def total(self) -> int: ...

    @property
    def warnings(self) -> Sequence[str]: ...

    @property
    def scans(self) -> I64:
        """(N,) log time of every scan in nanoseconds, in order of the scan's number."""
        ...

    def __iter__(self) -> Iterator[Frame]: ...

    def number_at(self, time: str | float) -> int: ...

    def frame(self, number: int) -> Frame | None: ...

    def close(self) -> None: ...


class Processor(Protocol[T_contra, R]):
    """Computes the result of each item of a run, as a ``Session`` does.

    The run calls ``perceive`` while it reads the next items, and ``finish`` while it perceives the next item.
    It calls each in the order of the items.
    """

    def perceive(self, item: T_contra, network: Executor | None = None, /) -> R: ...

    def finish(self, result: R, /) -> R: ...


class Observer(Generic[R_contra]):
    """Receives every result of a run, in order and in one thread.

    Attributes:
        name: label under which the run counts dropped results.
        beside: number of results that may wait for this observer in a thread of its own; the newest win.
            None: the run waits for the observer.
    """

    name = ""
    beside: int | None = None

    def begin(self, items: Items[object]) -> None:
        """Prepare before the first result."""

    def see(self, result: R_contra) -> None:
        """Take one result. The next one comes only after this call returns."""

    def end(self) -> None:
        """Finish after the last result, also when the run was interrupted or failed.

        The run calls it only if ``begin`` was called.
        """
