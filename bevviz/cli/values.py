"""Parsers of the values of options. An error says what the text is not."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import suppress
from math import inf


def parse_whole(least: int, most: float, problem: str) -> Callable[[str], int]:
    """Return a parser of whole numbers from ``least`` to ``most``."""

    def parse(text: str) -> int:
        if not text.isdecimal() or not least <= int(text) <= most:
            raise argparse.ArgumentTypeError(f"'{text}' {problem}")
        return int(text)

    return parse


def parse_real(is_valid: Callable[[float], bool], problem: str) -> Callable[[str], float]:
    """Return a parser of numbers."""

    def parse(text: str) -> float:
        with suppress(ValueError):
            if is_valid(value := float(text)):
                return value
        raise argparse.ArgumentTypeError(f"'{text}' {problem}")

    return parse


def numbers(*counts: int) -> Callable[[str], tuple[float, ...]]:
    """Return a parser of several numbers with commas between. ``counts`` are the allowed ones."""

    def parse(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(part) for part in text.split(","))
        except ValueError:
            values = ()
        if len(values) not in counts or not all(abs(v) < 1e6 for v in values):
            wanted = " or ".join(map(str, counts))
            raise argparse.ArgumentTypeError(f"'{text}' is not {wanted} numbers with commas between")
        return values

    return parse


def frame_range(text: str) -> tuple[int | None, int | None]:
    """Parse ``A:B``. An empty end is None."""
    first, colon, last = text.partition(":")
    if not colon or not all(part == "" or part.isdecimal() for part in (first, last)):
        raise argparse.ArgumentTypeError(f"'{text}' is not A:B, for example 100:200, 100: or :50")
    return (int(first) if first else None, int(last) if last else None)


number = parse_whole(0, inf, "is no number, counted from 0")
positive = parse_whole(1, inf, "is no whole number of 1 or more")
metres = parse_real(lambda length: 0 < length < 1000, "is no length in metres")
port = parse_whole(1, 65534, "is no port (1 to 65534)")
seconds = parse_real(lambda duration: 0 <= duration < 1e6, "is no time in seconds")
