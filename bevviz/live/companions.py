"""Companions of a live run: programs and topics beside it that show its results or take requests."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from bevviz.support.contexts import Closable

if TYPE_CHECKING:
    from bevviz.config.reloading import ReloadableConfig
    from bevviz.live.runtime import Live


class Companion(Closable):
    """Base class of companions. Each method may stay as it is. ``close`` is called at the end of the run."""

    def close(self) -> None:
        """Release the resources."""

    def join(self, node: Any, settings: ReloadableConfig, save: Callable[[], Path]) -> None:
        """Act on the graph from now on. The run still waits for its robot.

        Args:
            node: an rclpy node that another thread spins.
            settings: the configuration of the run, which may be changed.
            save: saves the last seconds and returns the path, or raises a UserError with the reason why not.

        Raises:
            UserError: a setting of the node is refused.
        """

    def begin(self, live: Live) -> None:
        """Follow a run that begins: add to its ``receivers`` and ``followers``."""


class Watch(Protocol):
    """Origin of companions, registered in the group ``bevviz.watches``."""

    OPTIONS: type  # dataclass of the options of ``bevviz live`` by which a user asks for one

    def open(self, options: Any, *, observe: bool) -> Companion | None:
        """Return a companion. None: the options do not ask for it.

        Args:
            options: values of ``OPTIONS``.
            observe: whether the run makes no results.

        Raises:
            UserError: it cannot be started.
        """
