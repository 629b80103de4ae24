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
    """Input of a run, in order: frames of a bag, the synthetic drive or a robot, or anything made of them."""

    @property
    def scene(self) -> Scene:
        """Names that entities and blueprints are made from."""

    @property
    def total(self) -> int | None:
        """Number of expected items, or None if unknown."""

    @property
    def warnings(self) -> Sequence[str]:
        """Losses and suspicious data so far, one sentence each."""

    def __iter__(self) -> Iterator[T_co]: ...


class FrameSource(Items[Frame], Protocol):
    """Frames that can be read in order and one by one."""

    @property
    def total(self) -> int:
        """Number of frames."""

    @property
    def scans(self) -> I64:
        """(N,) log time of every scan in nanoseconds, in order of the scan's number."""

    def number_at(self, time: str | float) -> int:
        """Return the number of the frame at a time."""

    def frame(self, number: int) -> Frame | None:
        """Return a frame, or None if it cannot be made."""

    def close(self) -> None:
        """Release the files."""


class Processor(Protocol[T_contra, R]):
    """Computation of the result of each item of a run. A ``Session`` is one.

    The run calls ``perceive`` while it reads the next items, and ``finish`` while it perceives the next item.
    It calls each in the order of the items.
    """

    def perceive(self, item: T_contra, network: Executor | None = None, /) -> R:
        """Return the result of the stages that need no result of the item before."""

    def finish(self, result: R, /) -> R:
        """Complete a result of ``perceive``."""


class Observer(Generic[R_contra]):
    """Receiver of every result of a run, in order and in one thread.

    Attributes:
        name: label under which the run counts dropped results.
        queue_size: number of results that may wait for this observer in a thread of its own. The newest win.
            None: the run waits for the observer.
    """

    name = ""
    queue_size: int | None = None

    def begin(self, items: Items[object]) -> None:
        """Prepare before the first result."""

    def observe(self, result: R_contra) -> None:
        """Take one result. The next one comes only after this call returns."""

    def end(self) -> None:
        """Finish after the last result, also if the run was interrupted or failed.

        The run calls it only if ``begin`` was called.
        """
