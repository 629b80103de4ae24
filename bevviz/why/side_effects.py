"""What another configuration changes in a frame beside what it was tried for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bevviz.compare.differences import Change, Seen, compare_objects
from bevviz.evaluate import MAX_DISTANCE, pair_in_order
from bevviz.model.frame import Boxes3D
from bevviz.model.results import Objects
from bevviz.why.frame_index import joined
from bevviz.why.subject import Subject, count


@dataclass(frozen=True, slots=True)
class Effect:
    """One object that two results of a frame do not both have; -1 where a row is not known.

    Attributes:
        name: class and distance.
        truth: row of the ground truth that it is; -1: none, or there is none.
        before, after: row of the object in that result.
        missed: it was right, and nothing else stands for it now.
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
        made: that were missing and are there now: of the ground truth, or what it was tried for.
        more: further ones that are there now; those that are no object of the truth have no row of it.
        gone: that are not there any more.
        changed: others that have moved or have another class.
        known: whether there is a ground truth.
    """

    made: tuple[Effect, ...] = ()
    more: tuple[Effect, ...] = ()
    gone: tuple[Effect, ...] = ()
    changed: int = 0
    known: bool = False

    @property
    def fixed(self) -> tuple[str, ...]:
        """In words, what was asked about first."""
        return tuple(effect.name for effect in self.made)

    @property
    def added(self) -> tuple[str, ...]:
        return tuple(effect.name for effect in self.more)

    @property
    def false(self) -> tuple[str, ...]:
        """Those of the added that are none, as the truth says."""
        return tuple(effect.name for effect in self.more if self.known and effect.truth < 0)

    @property
    def lost(self) -> tuple[str, ...]:
        return tuple(effect.name for effect in self.gone)

    @property
    def right(self) -> tuple[str, ...]:
        """Those of the lost that were right."""
        return tuple(effect.name for effect in self.gone if effect.missed)

    @property
    def good(self) -> int:
        """How many objects it makes better: found, or no longer invented."""
        invented = sum(effect.truth < 0 for effect in self.gone) if self.known else 0
        return len(self.made) + invented

    @property
    def harm(self) -> int:
        """How many objects it makes worse; without a ground truth, how many come or go."""
        return len(self.false) + len(self.right)

    @property
    def text(self) -> str:
        """In brief."""
        said = [f"fixes {' and '.join(self.fixed)}"] if self.fixed else []
        said += [f"adds {name}" + (" (false)" if name in self.false else "") for name in self.added]
        said += [f"loses {name}" + (" (right)" if name in self.right else "") for name in self.lost]
        said += [f"changes {count(self.changed, 'other')}"] if self.changed else []
        return ", ".join(said)


def effects(
    before: Objects | None,
    after: Objects | None,
    truth: Sequence[Subject],
    asked: int = -1,
    own: int = -1,
) -> Effects:
    """How the objects of two results of the same frame differ.

    Args:
        before, after: the objects.
        truth: what is really there; empty: not known.
        asked: row of the truth that it was tried for, -1: it is none of it.
        own: row of the object after it that the subject is, -1: not known.
    """
    a, b = _seen(before), _seen(after)
    was, now = _truth_of(before, truth), _truth_of(after, truth)
    made: list[tuple[bool, str, Effect]] = []
    more, gone = [], []
    changed = 0
    for difference in compare_objects(a, b):
        i, j = difference.row_a, difference.row_b
        if difference.change is Change.SAME:
            continue
        if truth and j >= 0 and now[j] >= 0 and now[j] not in was:
            name = truth[now[j]].name.removeprefix("the ")
            made.append((now[j] != asked, name, Effect(name, now[j], i, j)))
        elif difference.change is Change.ONLY_B:
            name = _name(b.names[j], b.boxes, j)
            if j == own:
                made.append((False, name, Effect(name, now[j], after=j)))
            else:
                more.append(Effect(name, now[j], after=j))
        elif difference.change is Change.ONLY_A:
            missed = was[i] >= 0 and was[i] not in now
            gone.append(Effect(_name(a.names[i], a.boxes, i), was[i], before=i, missed=missed))
        else:
            changed += 1
    return Effects(
        tuple(effect for *_, effect in sorted(made, key=lambda one: one[:2])),
        tuple(more),
        tuple(gone),
        changed,
        bool(truth),
    )


def _seen(objects: Objects | None) -> Seen:
    if objects is None:
        return Seen(Boxes3D.empty(), (), np.zeros(0, np.float32))
    return Seen(objects.boxes, objects.names, objects.score)


def _name(name: str, boxes: Boxes3D, row: int) -> str:
    return f"{name} at {float(np.hypot(*boxes.center[row, :2])):.1f} m"


def _truth_of(objects: Objects | None, subjects: Sequence[Subject]) -> list[int]:
    """Row of the truth that each object is, -1: none. One for one, best score first, as in ``evaluate``."""
    if objects is None:
        return []
    found = [-1] * len(objects)
    truth = joined([s.box for s in subjects if s.box is not None])
    order = np.argsort(-objects.score, kind="stable")
    away = np.linalg.norm(objects.boxes.center[order][:, None, :2] - truth.center[None, :, :2], axis=2)
    right = np.array([[s.accepts(objects.names[j]) for s in subjects] for j in order], bool)
    partner, _ = pair_in_order(np.where(right.reshape(away.shape), away, np.inf), MAX_DISTANCE)
    for j, row in zip(order.tolist(), partner.tolist(), strict=True):
        found[j] = row
    return found
