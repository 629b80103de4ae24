"""Colour where a terminal shows it. NO_COLOR (no-color.org) is without, FORCE_COLOR with it everywhere."""

from __future__ import annotations

import os
import sys
from typing import TextIO


def error(text: str) -> str:
    return _styled(text, "1;31", sys.stderr)


def warning(text: str) -> str:
    return _styled(text, "33", sys.stderr)


def _styled(text: str, code: str, stream: TextIO) -> str:
    return f"\x1b[{code}m{text}\x1b[0m" if _shows_colour(stream) else text


def _shows_colour(stream: TextIO) -> bool:
    if os.environ.get("NO_COLOR"):
        return False
    if os.environ.get("FORCE_COLOR"):
        return True
    return os.environ.get("TERM") != "dumb" and stream.isatty()
