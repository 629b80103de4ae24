"""Errors that a user sees: one clear line each, never a traceback. And text made safe for a terminal."""

from __future__ import annotations

LONGEST = 4000  # most characters of a line


class UserError(Exception):
    """A problem that the user can solve. The command prints one line and exits with status 2.

    The text names the problem, the file, topic or field concerned, and the action to take.
    """

    def __str__(self) -> str:
        text = printable(super().__str__())  # for a terminal
        if len(text) > LONGEST:  # The text repeats the content of a file.
            text = f"{text[: LONGEST // 2]} ... {text[-LONGEST // 2 :]}"
        return text


class StageError(Exception):
    """Invalid input or output of a stage, in one clear sentence."""


class FunctionError(StageError):
    """Exception in a user's function, with its file and line. The cause is the exception itself."""


def first_line(error: object) -> str:
    """Return the first line of a library's error, as the end of a sentence."""
    return (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")


def interrupt_in(error: BaseException) -> bool:
    """Return whether a KeyboardInterrupt caused an error. Compiled code raises its own error in its place."""
    seen: set[int] = set()
    current: BaseException | None = error
    while current is not None and id(current) not in seen:
        if isinstance(current, KeyboardInterrupt):
            return True
        seen.add(id(current))
        current = current.__cause__ or current.__context__
    return False


def printable(text: str) -> str:
    r"""Return text for a terminal. Invisible characters are escaped as in Python, and so have no effect.

    >>> printable("/points\x1b[2J\n")
    '/points\\x1b[2J\\n'
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
