"""Names of the metrics: ``METRIC[.CLASS][@RANGE]``."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

from bevviz.evaluate.average_precision import OVERLAPS, VIEWS
from bevviz.evaluate.ground_truth import RANGE

EDGES = (0, 10, 20, 30, int(RANGE))  # metres, limits of the ranges that are counted separately

METRICS = {  # name without class and range -> meaning
    "recall": "share of the objects that had to be found",
    "precision": "share of the objects that were reported",
    "f1": "harmonic mean of the two",
    "missed": "objects that had to be found and were not",
    "false": "objects that are nothing",
    "missed_per_frame": "the same, mean of a frame",
    "false_per_frame": "the same, mean of a frame",
    "error_m": "metres between the centres, median",
    "error_90_m": "metres that nine in ten stay below",
    **{f"ap_{v}_{o}": f"average precision, IoU {o} {v}" for v in VIEWS for o in OVERLAPS},
    "hota": "higher order tracking accuracy",
    "deta": "its detection part",
    "assa": "its association part",
    "mota": "CLEAR MOT accuracy",
    "motp_m": "CLEAR MOT precision, metres",
    "idf1": "F1 of identities",
    "id_switches": "times that an object got another track",
    "fragmentations": "times that a track was broken",
    "detection_recall": "image boxes found, IoU 0.5",
    "detection_precision": "image boxes that are right",
    "ground_precision": "points called ground that are",
    "ground_recall": "points of the ground called so",
    "ground_iou": "intersection over union of the two",
    "object_points_kept": "points of objects not called ground",
}


def base_of(name: str) -> str | None:
    """Return METRIC of ``METRIC[.CLASS][@RANGE]``. None: there is no such metric."""
    fitting = [base for base in METRICS if name == base or name.startswith((f"{base}.", f"{base}@"))]
    return max(fitting, key=len, default=None)


def ranges() -> Iterator[tuple[int, int]]:
    """Yield start and end of each range, in metres."""
    return itertools.pairwise(EDGES)
