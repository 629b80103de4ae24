"""How right fused objects are: held against the truth, by class and place."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from bevviz.evaluate.ground_truth import MAX_DISTANCE, Truth
from bevviz.model.frame import F32, F64, I32, Bool
from bevviz.model.results import Objects


@dataclass(frozen=True, slots=True)
class Matches:
    """A frame's objects against its truth.

    An object is true if it is something that had to be found, false if it is nothing. What is something that
    need not be found, or lies where nothing was labelled, is neither.
    """

    partner: I32  # (J,) row of the truth that each object is, else -1
    distance: F64  # (J,) metres on the ground plane between the centres, NaN where it is none
    true: Bool  # (J,)
    false: Bool  # (J,) whatever its name: one that no label accepts is for the caller to leave out
    missed: Bool  # (K,) had to be found, and was not


class Classes:
    """The labels of the frames so far, and what may be called so."""

    def __init__(self) -> None:
        self._accepted: dict[str, frozenset[str]] = {}

    def add(self, truth: Truth) -> None:
        """One frame's."""
        for label, names in zip(truth.labels, truth.accepted, strict=True):
            self._accepted[label.lower()] = self._accepted.get(label.lower(), frozenset()) | names

    def of(self, name: str) -> str | None:
        """What counts for which class where it is nothing that is labelled; None: it is not judged.

        For that of its own name; where no label has it, for the label that has fewest other names: what is
        called a person is a pedestrian rather than a cyclist.
        """
        fits = [label for label, names in self._accepted.items() if name in names]
        return name if name in fits else min(fits, key=lambda f: (len(self._accepted[f]), f), default=None)

    def with_false(
        self, labels: Mapping[str, Counter[str]], false: Mapping[str, int], what: str
    ) -> dict[str, Counter[str]]:
        """Counts by label, and in them as ``what`` the counts by name of what is nothing."""
        counts = {label: Counter(found) for label, found in labels.items()}
        for name, number in false.items():
            if (cls := self.of(name)) is not None:
                counts.setdefault(cls, Counter())[what] += number
        return counts


@dataclass
class Score:
    """Counts over frames. A name that no label accepts in any frame is not judged."""

    judged: Classes = field(default_factory=Classes)
    errors: list[float] = field(default_factory=list)  # metres, of the right ones
    _labels: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    _false: Counter[str] = field(default_factory=Counter)  # by name

    def add(self, found: Objects, truth: Truth) -> Matches:
        """Pair one frame's objects with the truth, best score first, and count."""
        self.judged.add(truth)
        matches = judge(found, truth)
        self._false.update(found.names[j].lower() for j in np.flatnonzero(matches.false))
        best_first = np.argsort(-found.score, kind="stable")
        for j in best_first[matches.true[best_first]]:
            self._labels[truth.labels[matches.partner[j]].lower()]["tp"] += 1
            self.errors.append(float(matches.distance[j]))
        for k in np.flatnonzero(matches.missed):
            self._labels[truth.labels[k].lower()]["fn"] += 1
        return matches

    @property
    def classes(self) -> dict[str, Counter[str]]:
        """Right ones (tp), false ones (fp) and missed ones (fn) of each class, in lower case."""
        return self.judged.with_false(self._labels, self._false, "fp")

    @property
    def total(self) -> Counter[str]:
        """The same of all classes."""
        return sum(self.classes.values(), Counter())

    @property
    def precision(self) -> float:
        """NaN where nothing was found."""
        total = self.total
        return share(total["tp"], total["fp"])

    @property
    def recall(self) -> float:
        """NaN where nothing had to be found."""
        total = self.total
        return share(total["tp"], total["fn"])

    @property
    def f1(self) -> float:
        """Harmonic mean of the two."""
        total = self.total
        return share(2 * total["tp"], total["fp"] + total["fn"])


def share(right: int, wrong: int) -> float:
    """NaN where there is neither."""
    return right / (right + wrong) if right + wrong else float("nan")


def judge(found: Objects, truth: Truth) -> Matches:
    """What each object of a frame is, and what was missed."""
    partner, distance = match(found, truth)
    paired = partner >= 0
    missed = truth.must.copy()
    missed[partner[paired]] = False
    true = paired.copy()
    true[paired] = truth.must[partner[paired]]
    return Matches(partner, distance, true, ~paired & ~truth.unlabelled(found.boxes), missed)


def match(found: Objects, truth: Truth) -> tuple[I32, F64]:
    """Which box of the truth each object is: of the same class, the nearest within 2 m, best score first.

    Returns:
        partner: (J,) row of the truth, else -1.
        distance: (J,) metres on the ground plane to that one, else NaN.
    """
    best_first = np.argsort(-found.score, kind="stable")
    right = accepts(truth, [found.names[j] for j in best_first])
    away = found.boxes.center[best_first][:, None, :2] - truth.boxes.center[None, :, :2]
    distance = np.where(right, np.linalg.norm(away, axis=2), np.inf)
    partners, _ = pair_in_order(distance, MAX_DISTANCE)
    partner, error = np.full(len(distance), -1, np.int32), np.full(len(distance), np.nan)
    partner[best_first] = partners
    paired = np.flatnonzero(partners >= 0)
    error[best_first[paired]] = distance[paired, partners[paired]]
    return partner, error


def accepts(truth: Truth, names: list[str]) -> Bool:
    """(J, K) which names are right for which box of the truth."""
    right = np.array([[name.lower() in accepted for accepted in truth.accepted] for name in names], bool)
    return right.reshape(len(names), len(truth.accepted))


def pair_in_order(distance: F32, limit: float) -> tuple[np.ndarray[tuple[int], np.dtype[np.int32]], Bool]:
    """Each row in turn takes the nearest column within ``limit`` that is still free.

    Args:
        distance: (N, M).
        limit: largest distance of a pair.

    Returns:
        partner: (N,) column of each row, else -1.
        free: (M,) columns that nobody took.
    """
    free = np.ones(distance.shape[1], bool)
    partner = np.full(len(distance), -1, np.int32)
    for row, values in enumerate(distance):
        candidates = np.flatnonzero(free & (values <= limit))
        if len(candidates):
            partner[row] = candidates[values[candidates].argmin()]
            free[partner[row]] = False
    return partner, free
