"""Text tables for a terminal, for Markdown and as CSV. The first row is the heading."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Sequence
from io import StringIO
from pathlib import Path

from bevviz.errors import printable
from bevviz.support import text
from bevviz.support.files import save_text

Rows = Sequence[Sequence[str]]


def lines(rows: Rows, align: str = "") -> Iterator[str]:
    """Yield the lines of a table for a terminal.

    Args:
        rows: rows of the same length.
        align: ``l`` or ``r`` for each column. Default: the first to the left, the others to the right.
    """
    cells = [[printable(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    sides = align or _default(rows)
    for row in cells:
        padded = [
            cell.ljust(width) if side == "l" else cell.rjust(width)
            for cell, width, side in zip(row, widths, sides, strict=True)
        ]
        yield "  ".join(padded).rstrip()


def markdown(rows: Rows, align: str = "") -> str:
    """Return a table in Markdown. The arguments are those of ``lines``."""
    rules = ["---" if side == "l" else "---:" for side in align or _default(rows)]
    head, *body = [[text.markdown(cell) for cell in row] for row in rows]
    return "\n".join(
        "|" + "".join(f" {cell} |" if cell else " |" for cell in row) for row in [head, rules, *body]
    )


def save_csv(target: Path, rows: Iterable[Sequence[object]], option: str) -> None:
    """Write rows as CSV, see ``save_text``.

    Raises:
        UserError: the file cannot be written.
    """
    file = StringIO()
    csv.writer(file).writerows(rows)
    save_text(target, file.getvalue(), option)


def _default(rows: Rows) -> str:
    """Return the default alignment."""
    return "l" + "r" * (len(rows[0]) - 1)
