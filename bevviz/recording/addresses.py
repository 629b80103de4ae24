"""Addresses of drawn items: the row of a table of the frame that each item of an entity shows.

A logger notes them while it draws, so that a click in a view is a look-up.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

KEPT = 1_000  # frames of a ``RowCache``; one takes about 10 kB


class Address(NamedTuple):
    """Row of a table of a frame.

    Attributes:
        table: ``truth``, ``object``, ``cluster``, ``detection``, ``track`` or ``point``.
        row: row in the table; id of a track.
        camera: camera of a detection.
    """

    table: str
    row: int
    camera: str = ""


@dataclass(frozen=True, slots=True)
class Rows:
    """Rows that the items of an entity show, one for each item.

    Attributes:
        tables: table of all items, or of each.
        rows: row of each item in its table.
        cameras: camera of all items, or of each; empty: the table is of no camera.
    """

    tables: str | Sequence[str]
    rows: Sequence[int] | NDArray[np.integer]
    cameras: str | Sequence[str] = ""

    def at(self, instance: int) -> Address | None:
        """Return the address of an item. None: the entity has no such item."""
        if not 0 <= instance < len(self.rows):
            return None
        table = self.tables if isinstance(self.tables, str) else self.tables[instance]
        camera = self.cameras if isinstance(self.cameras, str) else self.cameras[instance]
        return Address(table, int(self.rows[instance]), camera)

    def doubled(self) -> Self:
        """Return the rows of an entity whose single item is drawn twice."""
        tables = self.tables if isinstance(self.tables, str) else [*self.tables] * 2
        cameras = self.cameras if isinstance(self.cameras, str) else [*self.cameras] * 2
        return type(self)(tables, [*self.rows] * 2, cameras)


EntityRows: TypeAlias = Mapping[str, Rows]  # rows behind the items of each entity of a frame


class RowCache:
    """Rows behind the entities of the frames that were logged last. Any thread may use it.

    Args:
        size: number of frames that are kept.
    """

    def __init__(self, size: int = KEPT) -> None:
        self._size, self._lock = size, threading.Lock()
        self._rows: OrderedDict[Hashable, EntityRows] = OrderedDict()

    def put(self, key: Hashable, rows: EntityRows) -> None:
        """Keep the rows of a frame in place of the oldest ones."""
        with self._lock:
            self._rows[key] = rows
            self._rows.move_to_end(key)
            while len(self._rows) > self._size:
                self._rows.popitem(last=False)

    def get(self, key: Hashable) -> EntityRows | None:
        """Return the rows of a frame. None: they are not kept, or no longer."""
        with self._lock:
            return self._rows.get(key)
