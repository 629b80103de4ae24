"""Colours of text in a terminal. NO_COLOR (no-color.org) disables them, FORCE_COLOR forces them."""

from __future__ import annotations

import os
import sys
from typing import TextIO


def error(text: str) -> str:
    """Return the text in the colour of errors."""
    return _styled(text, "1;31", sys.stderr)


def warning(text: str) -> str:
    """Return the text in the colour of warnings."""
    return _styled(text, "33", sys.stderr)


def _styled(text: str, code: str, stream: TextIO) -> str:
    return f"\x1b[{code}m{text}\x1b[0m" if _shows_colour(stream) else text


def _shows_colour(stream: TextIO) -> bool:
    if os.environ.get("NO_COLOR"):
        return False
    if os.environ.get("FORCE_COLOR"):
        return True
    return os.environ.get("TERM") != "dumb" and stream.isatty()
