"""Selection of an object or a place that a question is about, and its address."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from bevviz.errors import UserError

ROWS = ("truth", "object", "detection", "cluster", "track")  # kinds that a row or an id selects
PLACES = {"pixel": 2, "point": 3, "cell": 2}  # kinds that a place selects, with the count of its numbers


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """One object of a frame, a place in it, or a class. An empty selection means the whole frame.

    The rows are those of ``Frame.truth``, of ``FrameResult.objects`` and ``clusters``, and of the detections
    of ``camera``.
    """

    label: str = ""  # class name
    box: tuple[float, ...] = ()  # u, v or u0, v0, u1, v1 in pixels
    point: tuple[float, ...] = ()  # x, y, z in Frame.points_frame
    cell: tuple[int, ...] = ()  # row, column of the bird's-eye view
    radius: float = 0.5  # metres around the point or cell
    camera: str = ""  # name; required if there are several
    truth: int | None = None
    object: int | None = None
    detection: int | None = None
    cluster: int | None = None
    track: int | None = None  # id

    @property
    def kind(self) -> str:
        """Kind of the one subject or place; empty for a whole class or frame."""
        row_kind = next((kind for kind in ROWS if getattr(self, kind) is not None), "")
        return row_kind or ("pixel" if self.box else "point" if self.point else "cell" if self.cell else "")

    @property
    def row(self) -> int:
        """Row or id of the subject, -1 for a place."""
        return getattr(self, self.kind) if self.kind in ROWS else -1

    @property
    def place(self) -> tuple[float, ...]:
        """Numbers of the place, empty for a row."""
        return self.box or self.point or self.cell

    @property
    def one(self) -> bool:
        """Whether the selection is one subject or place, and not a whole class or frame."""
        return bool(self.kind)

    @property
    def is_place(self) -> bool:
        """Whether the selection is a place, which may hold any number of objects."""
        return self.kind in PLACES

    def __str__(self) -> str:
        """Return the text of the page's address: ``detection/front/3``, ``point//1.5,2,0``."""
        numbers = ",".join(f"{v:.4g}" for v in self.place) if self.is_place else str(self.row)
        return f"{self.kind}/{self.camera}/{numbers}"

    @classmethod
    def of(cls, kind: str, row: int = -1, camera: str = "", place: Sequence[float] = ()) -> Self:
        """Return the selection of a row or of a place."""
        value = row if kind in ROWS else tuple(map(int, place)) if kind == "cell" else tuple(place)
        field = "box" if kind == "pixel" else kind
        return cls(camera=camera, **{field: value})  # type: ignore[arg-type]

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the selection of an address such as ``detection/front/3``.

        Raises:
            UserError: the address is not valid.
        """
        kind, _, rest = text.partition("/")
        camera, _, numbers_text = rest.rpartition("/")
        try:
            numbers = tuple(float(part) for part in numbers_text.split(","))
        except ValueError:
            numbers = ()
        known = kind in ROWS or kind in PLACES
        if not known or len(numbers) != PLACES.get(kind, 1) or not np.isfinite(numbers).all():
            raise UserError(f"'{text}' is nothing that can be asked about")
        return cls.of(kind, int(numbers[0]), camera, numbers)
