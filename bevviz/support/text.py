"""Text from users and robots (topics, frames, class names, notes), made safe for terminals and Markdown."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from reprlib import Repr

from bevviz.errors import printable

# Characters with a meaning in Markdown anywhere, and those with a meaning only at the beginning of a line.
_MARKS = re.compile(r"[\\`*\[\]<~|&$]|_(?:(?<![^\W_]_)|(?![^\W_]))")
_START = re.compile(r"[#>+=:-]|\d+(?=[.)])")
_SHORT = Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 200
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = _SHORT.maxset = 20
_PLAIN = re.compile(r"[A-Za-z][\w .,:;()'%/>=+-]*", re.ASCII)  # most sentences: only _ may need work


def short_repr(value: object) -> str:
    """Return a stated value as Python writes it, without the middle of a long one.

    >>> shown("a" * 1000)[:8]
    "'aaaaaaa"
    """
    try:
        return _SHORT.repr(value)
    except ValueError:  # Python writes no integer of more than 4300 digits.
        return "a number of thousands of digits"


def path_text(path: Path | str) -> str:
    """Return a file name as text that can be stored. Bytes that are no UTF-8 are escaped as in Python."""
    return os.fsencode(path).decode("utf-8", "backslashreplace")


def markdown(text: str) -> str:
    r"""Escape text for a line of Markdown, so that it is shown unchanged. White space becomes one blank.

    Harmless text stays as it is, so that users can search for a sentence with ``detector.conf_threshold``.

    >>> markdown("*x* of min_points")
    '\\*x\\* of min_points'
    """
    if _PLAIN.fullmatch(text) and "  " not in text and ("_" not in text or not _MARKS.search(text)):
        return text
    line = _MARKS.sub(r"\\\g<0>", printable(" ".join(text.split())))
    if start := _START.match(line):
        at = start.end() if start.group().isdigit() else 0
        line = f"{line[:at]}\\{line[at:]}"
    return f"{line[:-1]}\\#" if line.endswith((" #", "##")) else line  # the end of a heading


def fenced(text: str, language: str = "") -> str:
    """Return a code block in Markdown. The text may contain fences."""
    runs = re.findall(r"`{3,}", text)
    fence = "`" * (max(map(len, runs), default=2) + 1)
    return f"{fence}{language}\n{text.removesuffix(chr(10))}\n{fence}"


def section(title: str, items: Sequence[str]) -> list[str]:
    """Return the Markdown lines of a heading and a list. Without items, there is none."""
    return ["", f"#### {title}", "", *(f"- {item}" for item in items)] if items else []


def did_you_mean(name: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    """Return the end of a sentence about an unknown name: the nearest known name, or an empty string.

    Args:
        name: the unknown name.
        known: names to choose from.
        cutoff: least similarity from 0 to 1, see ``difflib.get_close_matches``.

    >>> did_you_mean("--modle", ["--model", "--set"])
    "; did you mean '--model'?"
    """
    nearest = difflib.get_close_matches(name, list(known), 1, cutoff)
    return f"; did you mean '{nearest[0]}'?" if nearest else ""
