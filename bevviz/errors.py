"""Errors that a user sees: one clear line each, never a traceback."""

from __future__ import annotations

from bevviz.support.text import printable

LONGEST = 4000  # characters of a line


class UserError(Exception):
    """What is wrong, in which file, topic or field, and what to do. The command exits with status 2."""

    def __str__(self) -> str:
        text = printable(super().__str__())  # it is shown on a terminal
        if len(text) > LONGEST:  # it repeats what a file holds
            text = f"{text[: LONGEST // 2]} ... {text[-LONGEST // 2 :]}"
        return text


class StageError(Exception):
    """What a stage was given or has returned is not what it must be, in one clear sentence."""


def first_line(error: object) -> str:
    """What a library says of an error, for the end of a sentence of ours."""
    return (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")


def interrupt_in(error: BaseException) -> bool:
    """Whether a KeyboardInterrupt became this error: compiled code tells its own in place of it."""
    seen: set[int] = set()
    current: BaseException | None = error
    while current is not None and id(current) not in seen:
        if isinstance(current, KeyboardInterrupt):
            return True
        seen.add(id(current))
        current = current.__cause__ or current.__context__
    return False
