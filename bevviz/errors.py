"""Errors that a user sees: one clear line each, never a traceback."""

from __future__ import annotations

from bevviz.text import printable


class UserError(Exception):
    """What is wrong, in which file, topic or field, and what to do. The command exits with status 2."""

    def __str__(self) -> str:
        return printable(super().__str__())  # it is shown on a terminal


def first_line(error: object) -> str:
    """What a library says of an error, for the end of a sentence of ours."""
    return (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
