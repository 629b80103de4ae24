"""What of a frame is worth a click: objects that were missed, false ones, and what nothing explains."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from bevviz.evaluate import RANGE, Truth, match
from bevviz.frame import Decision, FrameResult
from bevviz.workbench.pick import Pick

FEW = 30  # points, below which a cluster that no detection names is no object that one would miss


@dataclass(frozen=True, slots=True)
class Find:
    """One of them.

    Attributes:
        frame: number of its scan.
        stamp: of that, nanoseconds.
        what: missed, false, unmatched or unnamed.
        name: of its class, or of the cluster.
        distance: horizontal metres; NaN where it is not known.
        pick: that asks about it.
        reason: what the fusion says, where it says something.
    """

    frame: int
    stamp: int
    what: str
    name: str
    distance: float
    pick: Pick
    reason: str = ""

    def as_dict(self) -> dict[str, Any]:
        """For the page."""
        away = None if np.isnan(self.distance) else round(self.distance, 1)
        return {
            "frame": self.frame,
            "stamp": str(self.stamp),  # pages count in doubles
            "what": self.what,
            "name": self.name,
            "distance": away,
            "pick": str(self.pick),
            "reason": self.reason,
        }


def finds(result: FrameResult, truth: Truth | None) -> list[Find]:
    """Those of a frame within 40 m, the nearest first.

    With the truth what had to be found and was not, and objects that are none; without it kept detections
    that have no cluster, and clusters in view that no detection names.
    """
    found = list(_judged(result, truth) if truth is not None else _unexplained(result))
    near = [find for find in found if not find.distance > RANGE]
    return sorted(near, key=lambda find: (find.what == "false", np.nan_to_num(find.distance, nan=RANGE)))


def _judged(result: FrameResult, truth: Truth) -> Iterator[Find]:
    when, objects = (result.frame.index, result.frame.stamp), result.objects
    free = truth.must.copy()
    if objects is not None and len(objects):
        partner, _ = match(objects, truth)
        free[partner[partner >= 0]] = False
        judged = frozenset().union(*truth.accepted)
        for row in np.flatnonzero(partner < 0).tolist():
            name, away = objects.names[row], float(np.hypot(*objects.boxes.center[row, :2]))
            if name.lower() in judged:
                yield Find(*when, "false", name, away, Pick("object", row))
    own = result.frame.truth is not None
    for row in np.flatnonzero(free).tolist():
        center = truth.boxes.center[row]
        place = Pick("truth", row) if own else Pick("point", place=tuple(map(float, center)))
        yield Find(*when, "missed", truth.labels[row].lower(), float(np.hypot(*center[:2])), place)


def _unexplained(result: FrameResult) -> Iterator[Find]:
    when, clusters = (result.frame.index, result.frame.stamp), result.clusters
    named = np.zeros(0 if clusters is None else len(clusters), bool)
    seen = named.copy()
    for camera in result.cameras:
        detections, fusion = camera.detections, camera.fusion
        if detections is None or fusion is None:
            continue
        named |= fusion.cluster_decision == Decision.MATCHED
        seen |= fusion.cluster_decision == Decision.NO_DETECTION
        for row in np.flatnonzero(detections.kept & (fusion.detection_decision != Decision.MATCHED)).tolist():
            reason = Decision(int(fusion.detection_decision[row])).name.lower().replace("_", " ")
            away = float("nan")
            if (cluster := int(fusion.detection_cluster[row])) >= 0 and clusters is not None:
                away = float(np.hypot(*clusters.centroid[cluster, :2]))
            place = Pick("detection", row, camera.camera.name)
            yield Find(*when, "unmatched", detections.names[row], away, place, reason)
    if clusters is None:
        return
    for row in np.flatnonzero(seen & ~named & clusters.kept & (clusters.count >= FEW)).tolist():
        away = float(np.hypot(*clusters.centroid[row, :2]))
        name = f"cluster of {clusters.count[row]} points"
        yield Find(*when, "unnamed", name, away, Pick("cluster", row), "no detection")
