"""What takes a while is said where somebody looks: on a terminal, or nowhere in a library."""

from __future__ import annotations

from collections.abc import Callable

_say: Callable[[str], None] | None = None


def to(say: Callable[[str], None]) -> None:
    """Have what is announced said by ``say``."""
    global _say
    _say = say


def say(text: str) -> None:
    """One line, where anybody wants to know."""
    if _say is not None:
        _say(text)
