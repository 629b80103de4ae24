"""What another configuration changes in a frame beside what it was tried for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bevviz.compare.differences import Change, compare_objects, seen
from bevviz.evaluate import MAX_DISTANCE, pair_in_order
from bevviz.frame import Boxes3D
from bevviz.why.subject import count
from bevviz.why.traces import Traces, joined


@dataclass(frozen=True, slots=True)
class Effects:
    """Objects that differ between two results of one frame, each in words: class and distance.

    Attributes:
        fixed: of the ground truth, that were missing and are there now, the subject first.
        added: further ones that are there now; ``false``: those of them that are none, as the truth says.
        lost: that are not there any more; ``right``: those of them that were right.
        changed: others that have moved or have another class.
    """

    fixed: tuple[str, ...] = ()
    added: tuple[str, ...] = ()
    false: tuple[str, ...] = ()
    lost: tuple[str, ...] = ()
    right: tuple[str, ...] = ()
    changed: int = 0

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


def effects(before: Traces, after: Traces, asked: int = -1, own: int = -1) -> Effects:
    """How the objects of two results differ.

    Args:
        before, after: of the same frame.
        asked: row of the truth that it was tried for, -1: it is none of it.
        own: row of the object that the subject is after, -1: not known.
    """
    a, b = seen(before.result), seen(after.result)
    was, now = _truth_of(before), _truth_of(after)
    fixed, added, false, lost, right = [], [], [], [], []
    changed = 0
    truth = before.truth
    for difference in compare_objects(a, b):
        i, j = difference.row_a, difference.row_b
        if difference.change is Change.SAME:
            continue
        if truth and j >= 0 and now[j] >= 0 and now[j] not in was:
            fixed.append((now[j] != asked, truth[now[j]].name.removeprefix("the ")))
        elif difference.change is Change.ONLY_B:
            if j == own:
                fixed.append((False, _name(b.names[j], b.boxes, j)))
                continue
            added.append(_name(b.names[j], b.boxes, j))
            if truth and now[j] < 0:
                false.append(added[-1])
        elif difference.change is Change.ONLY_A:
            lost.append(_name(a.names[i], a.boxes, i))
            if truth and was[i] >= 0 and was[i] not in now:
                right.append(lost[-1])
        else:
            changed += 1
    names = tuple(name for _, name in sorted(fixed))
    return Effects(names, tuple(added), tuple(false), tuple(lost), tuple(right), changed)


def _name(name: str, boxes: Boxes3D, row: int) -> str:
    return f"{name} at {float(np.hypot(*boxes.center[row, :2])):.1f} m"


def _truth_of(traces: Traces) -> list[int]:
    """Row of the truth that each object is, -1: none. One for one, best score first, as in ``evaluate``."""
    objects = traces.result.objects
    if objects is None:
        return []
    found = [-1] * len(objects)
    truth = joined([s.box for s in traces.truth if s.box is not None])
    order = np.argsort(-objects.score, kind="stable")
    away = np.linalg.norm(objects.boxes.center[order][:, None, :2] - truth.center[None, :, :2], axis=2)
    right = np.array([[s.accepts(objects.names[j]) for s in traces.truth] for j in order], bool)
    partner, _ = pair_in_order(np.where(right.reshape(away.shape), away, np.inf), MAX_DISTANCE)
    for j, row in zip(order.tolist(), partner.tolist(), strict=True):
        found[j] = row
    return found
