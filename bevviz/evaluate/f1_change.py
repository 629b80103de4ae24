"""Which of two configurations is better on the same frames, and is that more than noise?

The noise is estimated by a bootstrap over parts of drives. It draws whole parts instead of single frames,
because neighbouring frames show the same objects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from bevviz.model.frame import F64

DRAWS = 2000  # of the bootstrap
PARTS = 20  # parts of one drive


@dataclass(frozen=True, slots=True)
class F1Change:
    """F1 of two configurations, and the 95 % interval of its change.

    Attributes:
        before: F1 of the first configuration.
        after: F1 of the second configuration.
        low: lower end of the interval of the change.
        high: upper end of the interval of the change.
        one_object: change of F1 if one more object were right.
    """

    before: float
    after: float
    low: float
    high: float
    one_object: float

    @property
    def is_better(self) -> bool:
        """Whether the second configuration is better by more than noise, and by more than one object."""
        return self.low > 0 and self.after - self.before > self.one_object


def f1(counts: F64) -> F64:
    """Return the F1 of (..., 3) numbers of true, missed and false objects. Nothing at all is 0."""
    true, missed, false = np.moveaxis(counts, -1, 0)
    return np.asarray(2 * true / np.maximum(2 * true + missed + false, 1e-9))


def f1_change(before: F64, after: F64, parts: Sequence[str] | None = None) -> F1Change:
    """Compare two configurations on the same frames.

    Args:
        before: (F, 3) numbers of true, missed and false objects of each frame.
        after: (F, 3) the same of the second configuration.
        parts: (F,) part of a drive that each frame belongs to. None: the frames are of one drive, in order.
    """
    place = np.arange(len(before)) * PARTS // max(len(before), 1)
    names, part = np.unique(place if parts is None else np.array(parts), return_inverse=True)
    sums = np.zeros((2, len(names), 3))
    for side, counts in enumerate((before, after)):
        np.add.at(sums[side], part, counts)
    drawn = f1(_draws(len(names)) @ sums)
    low, high = np.quantile(drawn[1] - drawn[0], [0.025, 0.975]).tolist()
    old, new = f1(sums.sum(axis=1)).tolist()
    true, missed, false = sums[1].sum(axis=0).tolist()
    return F1Change(old, new, low, high, 2 / max(2 * true + missed + false, 1))


@lru_cache(maxsize=8)
def _draws(number: int) -> F64:
    """Return (D, number) how often each bootstrap sample holds each part."""
    rng = np.random.default_rng(0)
    return rng.multinomial(number, np.full(number, 1 / number), DRAWS).astype(np.float64)
