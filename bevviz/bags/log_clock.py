"""Jumps of the clock of log times, as of a recorder that waits for the first /clock."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from bevviz.bags.reader import LAST_TIME
from bevviz.model.frame import I64

SECOND = 1_000_000_000
PAUSE = 10 * SECOND  # nanoseconds without a message; a jump of the clock is longer
ODD_START = SECOND  # log times before it are of a clock that was not set
LONG_SPAN = 7 * 86_400 * SECOND  # nanoseconds; no recording is so long
MOST_PIECES = 100  # more pauses are those of a recording


@dataclass(frozen=True, slots=True)
class Piece:
    """Messages whose log times are of one clock.

    Attributes:
        low: first log time in the files, nanoseconds.
        high: end of the log times.
        shift: nanoseconds to add to them.
        count: number of messages.
    """

    low: int
    high: int
    shift: int = 0
    count: int = 0


def is_odd(start: int, end: int) -> bool:
    """Return whether a clock may have jumped between the first and the last log time."""
    return end - start > LONG_SPAN or (start < ODD_START and end - start > PAUSE)


def find_pieces(times: I64, lag: Callable[[int, int], int | None]) -> Sequence[Piece]:
    """Return the pieces between jumps of the clock, on the time line of the largest; nothing without a jump.

    A pause of the recording is no jump: there the lag from stamps to log times stays.

    Args:
        times: sorted log times of all messages.
        lag: returns the lag of the first stamped message with low <= log time < high; None: there is none.
    """
    breaks = np.flatnonzero(np.diff(times) > PAUSE) + 1
    if not 0 < len(breaks) <= MOST_PIECES:
        return ()
    bounds = [0, *breaks.tolist(), len(times)]
    ends = [*(int(times[row]) for row in breaks), LAST_TIME]
    pieces = [
        Piece(0 if i == 0 else int(times[low]), ends[i], count=high - low)
        for i, (low, high) in enumerate(pairwise(bounds))
    ]
    largest = max(pieces, key=lambda piece: piece.count)
    usual = lag(largest.low, largest.high)
    lags = [lag(piece.low, piece.high) for piece in pieces]
    if usual is None:
        return ()
    starts = [int(times[low]) for low in bounds[:-1]]
    shifts = [0 if own is None or abs(usual - own) < SECOND else usual - own for own in lags]
    if not any(shifts):
        return ()
    known = zip(starts, shifts, lags, strict=True)
    first = min(start + shift for start, shift, own in known if own is not None)
    for i, own in enumerate(lags):
        if own is None and starts[i] < ODD_START:  # as transforms that were sent before the first /clock
            shifts[i] = first - int(times[bounds[i + 1] - 1])
    return [replace(piece, shift=shift) for piece, shift in zip(pieces, shifts, strict=True)]


def describe(pieces: Sequence[Piece]) -> str:
    """Return a sentence about the jumps."""
    moved = sum(piece.count for piece in pieces if piece.shift)
    first = max((piece for piece in pieces if piece.shift), key=lambda piece: piece.count)
    total = sum(piece.count for piece in pieces)
    return (
        f"the log time jumps by {abs(first.shift) / SECOND:,.1f} s, as if recorded before the first /clock "
        f"or by another clock: {moved} of {total} messages are moved to the time line of the others, by "
        "their stamps"
    )
