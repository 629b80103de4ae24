"""Progress bar of a run."""

from __future__ import annotations

from typing import Any

from bevviz.model.protocols import Items, Observer
from bevviz.support import progress
from bevviz.support.text import printable


class Progress(Observer[object]):
    """Observer that shows the number of results on the terminal.

    Args:
        what: name of the work. Empty: the name of the source.
        unit: name of one item.
    """

    def __init__(self, what: str = "", unit: str = "frame") -> None:
        self._what, self._unit = what, unit
        self._bar: Any = None

    def begin(self, items: Items[object]) -> None:
        """Show the bar."""
        description = self._what or printable(items.scene.name)
        self._bar = progress.bar(total=items.total, unit=self._unit, desc=description)

    def observe(self, result: object) -> None:
        """Count one result."""
        self._bar.update()

    def end(self) -> None:
        """Close the bar."""
        self._bar.close()
