"""Text that others chose (topics, frames, class names, notes), made safe for where it is shown."""

from __future__ import annotations

import os
import re
from pathlib import Path
from reprlib import Repr

# What Markdown would take for its own anywhere, and what only at the beginning of a line.
_MARKS = re.compile(r"[\\`*\[\]<~|&$]|_(?:(?<![^\W_]_)|(?![^\W_]))")
_START = re.compile(r"[#>+=:-]|\d+(?=[.)])")
_SHORT = Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 200
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = _SHORT.maxset = 20
_PLAIN = re.compile(r"[A-Za-z][\w .,:;()'%/>=+-]*", re.ASCII)  # most sentences: nothing but perhaps _ to do


def printable(text: str) -> str:
    r"""For a terminal: what is no visible character is told as Python would, and so cannot act.

    >>> printable("/points\x1b[2J\n")
    '/points\\x1b[2J\\n'
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def shown(value: object) -> str:
    """A value that somebody stated, as Python writes it; the middle of a long one is left out.

    >>> shown("a" * 1000)[:8]
    "'aaaaaaa"
    """
    try:
        return _SHORT.repr(value)
    except ValueError:  # Python writes no whole number of more than 4300 digits
        return "a number of thousands of digits"


def path_text(path: Path | str) -> str:
    """A file name as text that can be stored: bytes of it that are no UTF-8 are told as Python would."""
    return os.fsencode(path).decode("utf-8", "backslashreplace")


def markdown(text: str) -> str:
    r"""For a line of Markdown, which shows it as it is; runs of white space become a blank.

    What is harmless stays as it is: a sentence with ``detector.conf_threshold`` can be searched for.

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
    """A block of code in Markdown, whatever is in it."""
    runs = re.findall(r"`{3,}", text)
    fence = "`" * (max(map(len, runs), default=2) + 1)
    return f"{fence}{language}\n{text.removesuffix(chr(10))}\n{fence}"
