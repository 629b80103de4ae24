"""Picks as the questions of ``bevviz why``."""

from __future__ import annotations

from bevviz.why import Selection
from bevviz.workbench.pick import Pick


def selection(pick: Pick) -> Selection:
    """What to ask a ``Questioner``."""
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
