"""Search of slices: conjunctions of conditions under which an outcome is far more frequent than elsewhere.

This is subgroup discovery by beam search with sequential covering (Lavrac et al., "Subgroup discovery with
CN2-SD", JMLR 2004). A condition on a number is its best interval (Mampaey et al., "Efficient algorithms for
finding richer subgroup descriptions in numeric and nominal data", ICDM 2012). The quality is the
log-likelihood ratio of the slice against its complement. Each condition has to pay for the number of
conditions that were tried (Webb, "Layered critical values", Machine Learning 2008), which bounds the chance
of any false slice. Rows of one object are not independent, so that the ratio is scaled by objects per row.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevviz.model.frame import F64, I64, Bool

BEAM = 8  # slices that are refined at each depth
DEPTH = 4  # conditions of a slice, at most
KEPT_RATE = 0.9  # least rate without a condition, relative to the rate with it, if it is to be left out
CHANCE = 0.01  # that a search returns any slice although nothing depends on the attributes
LEAST_RATIO = 1.5  # least rate inside a slice, relative to the rate outside
LEAST_UNITS = 4  # objects of a slice with the outcome, at least


@dataclass(frozen=True, slots=True)
class Attribute:
    """One column in bins.

    Attributes:
        name: name of the column.
        codes: (N,) bin of each row, -1: unknown.
        bins: number of bins.
        ordered: whether neighbouring bins may be joined to an interval.
    """

    name: str
    codes: NDArray[np.int16]
    bins: int
    ordered: bool

    @property
    def cost(self) -> float:
        """Logarithm of the number of conditions on this attribute."""
        return math.log(self.bins * (self.bins + 1) / 2 if self.ordered else self.bins)


@dataclass(frozen=True, slots=True, order=True)
class Condition:
    """Interval of bins of an attribute, both ends included."""

    attribute: str
    first: int
    last: int


@dataclass(frozen=True, slots=True)
class Slice:
    """Conjunction of conditions with its counts among the rows that no earlier slice covers.

    Attributes:
        conditions: conditions, sorted by attribute.
        target: name of the outcome.
        score: logarithm of the likelihood ratio, less the cost of the search. Above 0, it is significant.
        rows: rows in the slice.
        positives: rows in the slice with the outcome.
    """

    conditions: tuple[Condition, ...]
    target: str
    score: float
    rows: I64
    positives: I64


def find_slices(
    attributes: Sequence[Attribute],
    targets: Mapping[str, Bool],
    units: I64,
    most: int,
    accepts: Callable[[Slice], bool],
) -> Iterator[Slice]:
    """Yield slices, the most significant first. Each covers its rows for the following ones.

    A slice that is not accepted covers its rows for its own target alone.

    Args:
        attributes: columns of N rows.
        targets: (N,) rows with an outcome, by its name. The best slice of all targets comes next.
        units: (N,) object of each row. Rows of one object count less than as many objects.
        most: largest number of slices.
        accepts: whether a significant slice says enough.
    """
    free = np.ones(len(units), bool)
    free_of = {name: free.copy() for name in targets}
    best: dict[str, Slice | None] = {}
    for _ in range(most if attributes else 0):
        for name, positive in targets.items():
            if name not in best:
                best[name] = found = _purest(attributes, name, positive, free & free_of[name], units)
                while found is not None and not accepts(found):
                    free_of[name][found.rows] = False
                    best[name] = found = _purest(attributes, name, positive, free & free_of[name], units)
        slices = [found for found in best.values() if found is not None]
        if not slices:
            return
        top = max(slices, key=lambda found: found.score)
        yield top
        free[top.rows] = False
        # A search whose slice lost no row is still right: only rows outside of its slice have gone.
        best = {
            name: found for name, found in best.items() if found is not None and free[found.rows].all()
        } | {name: None for name, found in best.items() if found is None}


def _purest(
    attributes: Sequence[Attribute], target: str, positive: Bool, free: Bool, units: I64
) -> Slice | None:
    """Return the best slice of a target. A mixture of several slices is narrowed to the best one inside."""
    search = _Search(attributes, target, positive, free, units)
    found = search.best()
    while found is not None:
        within = np.zeros(len(free), bool)
        within[found.rows] = True
        inner = _Search(attributes, target, positive, within, units).best()
        if inner is None:
            break
        narrower = search.narrowed(found, inner)
        if len(narrower.positives) * len(found.rows) <= len(found.positives) * len(narrower.rows):
            break  # The rate is no higher, so that the loop ends.
        found = narrower
    return found


class _Search:
    """Search of the best slice of one target among free rows."""

    def __init__(
        self, attributes: Sequence[Attribute], target: str, positive: Bool, free: Bool, units: I64
    ) -> None:
        self._attributes = {attribute.name: attribute for attribute in attributes}
        self._target, self._positive, self._free, self._units = target, positive, free, units
        self._number, self._positives = int(free.sum()), int((positive & free).sum())
        objects = len(np.unique(units[positive & free]))
        self._scale = objects / max(self._positives, 1)
        self._fixed = math.log(len(self._attributes)) - math.log(CHANCE) / DEPTH

    def best(self) -> Slice | None:
        """Return the best slice; None: none is significant."""
        if not self._positives or self._positives == self._number:
            return None
        beam: list[tuple[float, tuple[Condition, ...]]] = [(0.0, ())]
        top: tuple[float, tuple[Condition, ...]] = (0.0, ())
        for _ in range(DEPTH):
            refined: dict[tuple[Condition, ...], float] = {}
            for _, conditions in beam:
                rows, used = self._rows(conditions), {c.attribute for c in conditions}
                for attribute in self._attributes.values():
                    if attribute.name in used:
                        continue
                    for gain, condition in self._intervals(attribute, rows):
                        refined[tuple(sorted((*conditions, condition)))] = gain - self._cost(
                            (*conditions, condition)
                        )
            beam = sorted(((score, c) for c, score in refined.items()), reverse=True)[:BEAM]
            if not beam or beam[0][0] <= top[0]:
                break
            top = self._polished(*beam[0])
        return self._plain(top[1]) if top[0] > 0 else None

    def narrowed(self, outer: Slice, inner: Slice) -> Slice:
        """Return the slice with the conditions of both, without those that keep no rate up."""
        joint = {condition.attribute: condition for condition in outer.conditions}
        for condition in inner.conditions:
            wider = joint.get(condition.attribute, condition)
            first, last = max(wider.first, condition.first), min(wider.last, condition.last)
            joint[condition.attribute] = Condition(condition.attribute, first, last)
        return self._plain(tuple(joint.values())) or outer

    def _plain(self, conditions: tuple[Condition, ...]) -> Slice | None:
        """Return a slice without the conditions that keep no rate up; None: of too few objects."""
        for condition in conditions:
            fewer = tuple(c for c in conditions if c is not condition)
            if fewer and self._rate(fewer) >= KEPT_RATE * self._rate(conditions):
                return self._plain(fewer)
        conditions = tuple(sorted(conditions))
        rows = self._rows(conditions)
        positives = rows[self._positive[rows]]
        if len(np.unique(self._units[positives])) < LEAST_UNITS:
            return None
        score = self._gain_of(rows) - self._cost(conditions)
        return Slice(conditions, self._target, score, rows, positives)

    def _rate(self, conditions: tuple[Condition, ...]) -> float:
        return float(self._positive[self._rows(conditions)].mean())

    def _polished(
        self, score: float, conditions: tuple[Condition, ...]
    ) -> tuple[float, tuple[Condition, ...]]:
        """Set each interval anew, given the others, until none changes, and leave out needless conditions."""
        improved = True
        while improved:
            improved = False
            for condition in conditions:
                others = tuple(c for c in conditions if c is not condition)
                rows = self._rows(others)
                choices = [(self._gain_of(rows), others)] if others else []
                choices += [
                    (gain, tuple(sorted((*others, other))))
                    for gain, other in self._intervals(self._attributes[condition.attribute], rows)
                ]
                for gain, choice in choices:
                    if gain - self._cost(choice) > score + 1e-9:
                        score, conditions, improved = gain - self._cost(choice), choice, True
                if improved:
                    break
        return score, conditions

    def _cost(self, conditions: tuple[Condition, ...]) -> float:
        return sum(self._attributes[c.attribute].cost + self._fixed for c in conditions)

    def _rows(self, conditions: tuple[Condition, ...]) -> I64:
        inside = self._free.copy()
        for condition in conditions:
            codes = self._attributes[condition.attribute].codes
            inside &= (codes >= condition.first) & (codes <= condition.last)
        return np.flatnonzero(inside)

    def _gain_of(self, rows: I64) -> float:
        positive = self._positive[rows].sum()
        return float(self._gain(np.array([len(rows)]), np.array([positive]))[0])

    def _intervals(self, attribute: Attribute, rows: I64) -> list[tuple[float, Condition]]:
        """Return the two best conditions on an attribute among rows, with their gains."""
        codes = attribute.codes[rows] + 1
        n = np.bincount(codes, minlength=attribute.bins + 1)[1:]
        p = np.bincount(codes[self._positive[rows]], minlength=attribute.bins + 1)[1:]
        if attribute.ordered:
            first, last = np.triu_indices(attribute.bins)
            occupied = (n[first] > 0) & (n[last] > 0)
            first, last = first[occupied], last[occupied]
            total_n, total_p = np.concatenate([[0], n.cumsum()]), np.concatenate([[0], p.cumsum()])
            n, p = total_n[last + 1] - total_n[first], total_p[last + 1] - total_p[first]
        else:
            first = last = np.arange(attribute.bins)
        gain = self._gain(n, p)
        found: list[tuple[float, Condition]] = []
        for i in np.argsort(-gain, kind="stable")[:40].tolist():
            if gain[i] <= 0 or len(found) == 2:
                break
            # The second interval has to be another one, not a bin more.
            if any(first[i] <= c.last and last[i] >= c.first for _, c in found):
                continue
            found.append((float(gain[i]), Condition(attribute.name, int(first[i]), int(last[i]))))
        return found

    def _gain(self, n: I64, p: I64) -> F64:
        """Return the log-likelihood ratio of slices against one common rate; -inf: too few, or not higher."""
        rest_n, rest_p = self._number - n, self._positives - p
        ratio = _likelihood(n, p) + _likelihood(rest_n, rest_p)
        ratio -= _likelihood(np.array([self._number]), np.array([self._positives]))
        higher = p * np.maximum(rest_n, 1) > LEAST_RATIO * np.maximum(rest_p, 0) * n
        return np.where(higher & (p * self._scale >= LEAST_UNITS), self._scale * ratio, -np.inf)


def _likelihood(n: I64, p: I64) -> F64:
    """Return the greatest log-likelihood of p outcomes in n rows."""
    with np.errstate(divide="ignore", invalid="ignore"):
        hits = np.where(p > 0, p * np.log(p / np.maximum(n, 1)), 0.0)
        others = np.where(n - p > 0, (n - p) * np.log((n - p) / np.maximum(n, 1)), 0.0)
    return np.asarray(hits + others, np.float64)
