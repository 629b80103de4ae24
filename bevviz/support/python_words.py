"""Sentences for the Python interface: options of the commands become arguments."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

from bevviz.errors import UserError

# A setting in quotes, with a quoted or bracketed value, or one word.
_SET = re.compile(
    r"--set (?:\"(?P<double>[^\"]*)\"|'(?P<single>[^']*)'"
    r"|(?P<key>[\w.]+=)(?:'(?P<quoted>[^']*)'|(?P<word>\[[^\]]*\]|\S*?)(?=[:;,.)]*(?:\s|$))))"
)
_SOURCE = re.compile(r"--(dataset|sequence)(?: ([\w./-]*\w))?")
_ARGUMENT = re.compile(
    r"--(model|config|preset|start|end|every|frames|bag|truth|kitti-labels|at-frame|at)(?![\w-])"
    r"(?: ([\w./:-]*\w))?"
)
_NAMES = {"at": "time", "at-frame": "frame", "kitti-labels": "kitti_labels"}


def python_words(text: str) -> str:
    """Return a sentence with arguments of ``bevviz.open`` and ``Drive.at`` in place of options."""
    text = _SET.sub(_setting, text)
    text = _SOURCE.sub(lambda m: f'set={{"source.{m[1]}": {_quoted(m[2] or "NAME")}}}', text)
    return _ARGUMENT.sub(_argument, text)


def _setting(match: re.Match[str]) -> str:
    value = match["double"] or match["single"]
    return f"set=[{_quoted(value or match['key'] + (match['quoted'] or match['word'] or ''))}]"


def _argument(match: re.Match[str]) -> str:
    name = _NAMES.get(match[1], match[1])
    if match[2] is None:
        return f"{name}="
    return f"{name}={match[2] if match[2].isdigit() else _quoted(match[2])}"


def _quoted(text: str) -> str:
    return f"'{text}'" if '"' in text else f'"{text}"'


@contextmanager
def errors_about_arguments() -> Iterator[None]:
    """Turn the options that a UserError names into arguments."""
    try:
        yield
    except UserError as error:
        text = python_words(str(error))
        if text == str(error):
            raise
        raise type(error)(text) from error.__cause__
