"""Convert picks to selections, and answers to picks."""

from __future__ import annotations

from bevviz.why import Answer, Selection
from bevviz.why.pick import Pick


def selection_of(pick: Pick) -> Selection:
    """Return the selection of a pick for a ``Questioner``."""
    if pick.kind == "truth":
        return Selection(truth=pick.row)
    if pick.kind == "object":
        return Selection(object=pick.row)
    if pick.kind == "cluster":
        return Selection(cluster=pick.row)
    if pick.kind == "detection":
        return Selection(detection=pick.row, camera=pick.camera)
    if pick.kind == "pixel":
        return Selection(box=pick.place, camera=pick.camera)
    if pick.kind == "cell":
        return Selection(cell=tuple(map(int, pick.place)))
    return Selection(point=pick.place)


def surroundings_of(pick: Pick, answer: Answer) -> Selection | None:
    """Return a selection of everything around the answered subject; None: its position is unknown.

    A user who clicked on one object may mean another one at the same place.
    """
    subject = answer.subject
    if pick.kind == "detection" and subject.xyxy is not None:
        u0, v0, u1, v1 = (float(v) for v in subject.xyxy)
        return Selection(box=((u0 + u1) / 2, (v0 + v1) / 2), camera=pick.camera)
    if subject.box is not None:
        x, y, z = (float(v) for v in subject.box.center[0])
        return Selection(point=(x, y, z), radius=max(0.5, float(subject.box.size[0].min()) / 2))
    return None


def pick_of(answer: Answer) -> Pick | None:
    """Return the pick that selects the subject of an answer again; None: it is a place."""
    subject = answer.subject
    if subject.kind in ("truth", "object", "cluster", "detection"):
        return Pick(subject.kind, subject.row, subject.camera)
    return None
