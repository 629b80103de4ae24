"""A bar on the terminal for what takes long."""

from __future__ import annotations

from typing import Any

from bevviz.model.protocols import Items, Observer
from bevviz.support import progress
from bevviz.support.text import printable


class Progress(Observer[object]):
    """Counts results.

    Args:
        what: name of the work; empty: that of what is worked through.
    """

    def __init__(self, what: str = "", unit: str = "frame") -> None:
        self._what, self._unit = what, unit
        self._bar: Any = None

    def begin(self, items: Items[object]) -> None:

        description = self._what or printable(items.scene.name)
        self._bar = progress.bar(total=items.total, unit=self._unit, desc=description)

    def see(self, result: object) -> None:
        self._bar.update()

    def end(self) -> None:
        self._bar.close()
