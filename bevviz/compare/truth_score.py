"""Scores of two sides against the ground truth: which labelled objects each side finds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bevviz.evaluate import Truth
from bevviz.evaluate import judge as judge_objects
from bevviz.model.frame import Bool, Boxes3D
from bevviz.model.results import FrameResult, Objects


@dataclass(frozen=True, slots=True)
class TruthComparison:
    """Frame of both sides compared with the ground truth. Row i is the i-th object to be found."""

    labels: tuple[str, ...]
    boxes: Boxes3D  # in the frame of the points
    a: Bool  # found by A
    b: Bool
    wrong_a: tuple[str, ...]  # names of A's false objects
    wrong_b: tuple[str, ...]
    names: frozenset[str]  # names that the labels of this frame accept; other names are not judged

    @property
    def fixed(self) -> Sequence[int]:
        """Rows of objects that only B finds."""
        rows: list[int] = np.flatnonzero(self.b & ~self.a).tolist()
        return rows

    @property
    def broken(self) -> Sequence[int]:
        """Rows of objects that only A finds."""
        rows: list[int] = np.flatnonzero(self.a & ~self.b).tolist()
        return rows

    def text(self, row: int) -> str:
        """Return class and distance of an object, as ``person at 12.3 m``."""
        return f"{self.labels[row].lower()} at {np.hypot(*self.boxes.center[row, :2]):.1f} m"


def compare_with_truth(a: FrameResult, b: FrameResult, truth: Truth) -> TruthComparison:
    """Compare both sides of a frame with its ground truth."""
    to_find = np.flatnonzero(truth.must)
    (found_a, wrong_a), (found_b, wrong_b) = (_side(side.objects, truth) for side in (a, b))
    return TruthComparison(
        labels=tuple(truth.labels[k] for k in to_find),
        boxes=truth.boxes.chosen(to_find),
        a=found_a[to_find],
        b=found_b[to_find],
        wrong_a=wrong_a,
        wrong_b=wrong_b,
        names=frozenset().union(*truth.accepted),
    )


def _side(objects: Objects | None, truth: Truth) -> tuple[Bool, tuple[str, ...]]:
    """Return (K,) whether each labelled box is found, and the names of the false objects."""
    if objects is None:
        return np.zeros(len(truth.labels), bool), ()
    matches = judge_objects(objects, truth)
    return ~matches.missed, tuple(objects.names[j].lower() for j in np.flatnonzero(matches.false))
