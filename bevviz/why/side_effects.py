"""Effects of another configuration on the other objects of a frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bevviz.evaluate import Truth, match
from bevviz.evaluate.differences import Change, compare_objects, side_of
from bevviz.model.frame import Boxes3D
from bevviz.model.results import Objects
from bevviz.why.subject import Subject


@dataclass(frozen=True, slots=True)
class Effect:
    """One object that only one of two results of a frame has; -1: unknown row.

    Attributes:
        name: class and distance.
        truth: its row in the ground truth; -1: none, or there is no ground truth.
        before: row of the object in the first result.
        after: row of the object in the second result.
        missed: whether it was right and the second result has no object for it.
    """

    name: str
    truth: int = -1
    before: int = -1
    after: int = -1
    missed: bool = False


@dataclass(frozen=True, slots=True)
class Effects:
    """Objects that differ between two results of one frame.

    Attributes:
        made: objects of the ground truth, and the subject in question, that are new in the second result.
        more: other new objects. Those not in the ground truth have row -1.
        gone: objects that the second result lacks.
        changed: number of other objects that have moved or have another class.
        known: whether there is a ground truth.
        doubtful: number of doubtful objects that the second result has more. Ground truth makes it 0.
    """

    made: tuple[Effect, ...] = ()
    more: tuple[Effect, ...] = ()
    gone: tuple[Effect, ...] = ()
    changed: int = 0
    known: bool = False
    doubtful: int = 0

    @property
    def fixed(self) -> tuple[str, ...]:
        """Names of the objects made, the subject in question first."""
        return tuple(effect.name for effect in self.made)

    @property
    def added(self) -> tuple[str, ...]:
        """Names of the other new objects."""
        return tuple(effect.name for effect in self.more)

    @property
    def false(self) -> tuple[str, ...]:
        """Names of the added objects that are not in the ground truth."""
        return tuple(effect.name for effect in self.more if self.known and effect.truth < 0)

    @property
    def lost(self) -> tuple[str, ...]:
        """Names of the objects that are gone, except those that the ground truth calls false."""
        return tuple(effect.name for effect in self.gone if not self.known or effect.truth >= 0)

    @property
    def false_gone(self) -> tuple[str, ...]:
        """Names of the objects that are gone and that the ground truth calls false."""
        return tuple(effect.name for effect in self.gone if self.known and effect.truth < 0)

    @property
    def right(self) -> tuple[str, ...]:
        """Names of the lost objects that were right."""
        return tuple(effect.name for effect in self.gone if effect.missed)

    @property
    def good(self) -> int:
        """Number of objects that get better: new right ones, and false or doubtful ones that are gone."""
        invented = len(self.false_gone) if self.known else max(-self.doubtful, 0)
        return len(self.made) + invented

    @property
    def harm(self) -> int:
        """Number of objects that get worse. Without ground truth: new doubtful ones, and those that are gone.

        The objects that are gone then count without the doubtful ones among them.
        """
        if self.known:
            return len(self.false) + len(self.right)
        return max(self.doubtful, 0) + max(len(self.gone) + min(self.doubtful, 0), 0)

    @property
    def text(self) -> str:
        """All effects in brief, in the words of the page and of ``compare``."""
        named = {
            "fixed": self.fixed,
            "broken": self.right,
            "new false": self.false,
            "false gone": self.false_gone,
            "gone": [name for name in self.lost if name not in self.right],
            "new": [name for name in self.added if name not in self.false],
        }
        texts = [f"{what} {' and '.join(names)}" for what, names in named.items() if names]
        texts += [f"{self.doubtful} more doubtful"] if self.doubtful > 0 else []
        texts += [f"{self.changed} changed"] if self.changed else []
        return ", ".join(texts)


def effects(
    before: Objects | None,
    after: Objects | None,
    truth: Sequence[Subject],
    asked: int = -1,
    own: int = -1,
    doubtful: int = 0,
) -> Effects:
    """Compare the objects of two results of the same frame.

    Args:
        before: objects of the first result.
        after: objects of the second result.
        truth: objects of the ground truth; empty: unknown.
        asked: row of the ground truth object in question, -1: none.
        own: row in ``after`` of the object in question, -1: unknown.
        doubtful: number of doubtful objects that ``after`` has more.
    """
    before, after = before or Objects.empty(), after or Objects.empty()
    a, b = side_of(before), side_of(after)
    truth_before, truth_after = _truth_of(before, truth), _truth_of(after, truth)
    made: list[tuple[bool, str, Effect]] = []
    more, gone = [], []
    changed = 0
    for difference in compare_objects(a, b):
        i, j = difference.row_a, difference.row_b
        if difference.change is Change.SAME:
            continue
        if truth and j >= 0 and truth_after[j] >= 0 and truth_after[j] not in truth_before:
            name = truth[truth_after[j]].name.removeprefix("the ")
            made.append((truth_after[j] != asked, name, Effect(name, truth_after[j], i, j)))
        elif difference.change is Change.ONLY_B:
            name = _name(b.names[j], b.boxes, j)
            if j == own:
                made.append((False, name, Effect(name, truth_after[j], after=j)))
            else:
                more.append(Effect(name, truth_after[j], after=j))
        elif difference.change is Change.ONLY_A:
            missed = truth_before[i] >= 0 and truth_before[i] not in truth_after
            gone.append(Effect(_name(a.names[i], a.boxes, i), truth_before[i], before=i, missed=missed))
        else:
            changed += 1
    return Effects(
        tuple(effect for *_, effect in sorted(made, key=lambda one: one[:2])),
        tuple(more),
        tuple(gone),
        changed,
        bool(truth),
        0 if truth else doubtful,
    )


def _name(name: str, boxes: Boxes3D, row: int) -> str:
    """Return the class and distance of an object."""
    return f"{name} at {boxes.distance[row]:.1f} m"


def _truth_of(objects: Objects, subjects: Sequence[Subject]) -> list[int]:
    """Return the ground truth row of each object by the rule of ``evaluate``, -1: none."""
    boxes = Boxes3D.joined([subject.box for subject in subjects if subject.box is not None])
    accepted = tuple(subject.accepted for subject in subjects)
    labels = tuple(subject.label for subject in subjects)
    partner, _ = match(objects, Truth(boxes, labels, accepted, np.ones(len(labels), np.bool_)))
    return [int(row) for row in partner]
