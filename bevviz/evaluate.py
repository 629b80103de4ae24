"""How right fused objects are: against labelled boxes, by class and place."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bevviz import geometry
from bevviz.datasets.kitti import ACCEPTED, label_files, read_labels
from bevviz.errors import UserError
from bevviz.frame import F32, F64, I32, Bool, Boxes3D, Frame, LabelledBoxes3D, Objects
from bevviz.ros.roles import Roles
from bevviz.stages.robot import in_points_frame

MIN_HITS = 10  # LiDAR points on an object that must be found
MAX_DISTANCE = 2.0  # metres between the centres, on the ground plane, of a box and its object
RANGE = 40.0  # metres


@dataclass(frozen=True, slots=True)
class Truth:
    """What is really there, in the frame of the points."""

    boxes: Boxes3D
    labels: tuple[str, ...]
    accepted: tuple[frozenset[str], ...]  # names that are right for each, in lower case
    must: Bool  # (K,) has to be found; the others may be


@dataclass
class Score:
    """Counts over frames. A name that no label accepts in any frame is not judged."""

    classes: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    names: set[str] = field(default_factory=set)  # that labels accept
    errors: list[float] = field(default_factory=list)  # metres, of the right ones

    def add(self, found: Objects, truth: Truth) -> None:
        """Pair one frame's objects with the truth, best score first, and count."""
        self.names.update(*truth.accepted)
        partners, distance = match(found, truth)
        free = np.ones(len(truth.labels), bool)
        free[partners[partners >= 0]] = False
        for j in np.argsort(-found.score, kind="stable").tolist():
            partner = int(partners[j])
            if partner < 0:
                self.classes[found.names[j].lower()]["fp"] += 1
            elif truth.must[partner]:
                self.classes[truth.labels[partner].lower()]["tp"] += 1
                self.errors.append(float(distance[j]))
        for k in np.flatnonzero(free & truth.must):
            self.classes[truth.labels[k].lower()]["fn"] += 1

    @property
    def total(self) -> Counter[str]:
        """Right ones (tp), false ones of the names that are judged (fp), missed ones (fn)."""
        total: Counter[str] = Counter()
        for name, counts in self.classes.items():
            total.update({k: n for k, n in counts.items() if k != "fp" or name in self.names})
        return total

    @property
    def precision(self) -> float:
        """NaN where nothing was found."""
        return _share(self.total["tp"], self.total["fp"])

    @property
    def recall(self) -> float:
        """NaN where nothing had to be found."""
        return _share(self.total["tp"], self.total["fn"])

    @property
    def f1(self) -> float:
        """Harmonic mean of the two."""
        total = self.total
        return _share(2 * total["tp"], total["fp"] + total["fn"])


def _share(right: int, wrong: int) -> float:
    return right / (right + wrong) if right + wrong else float("nan")


def match(found: Objects, truth: Truth) -> tuple[I32, F64]:
    """Which box of the truth each object is: of the same class, the nearest within 2 m, best score first.

    Returns:
        partner: (J,) row of the truth, else -1.
        distance: (J,) metres on the ground plane to that one, else NaN.
    """
    best_first = np.argsort(-found.score, kind="stable")
    names = [found.names[j].lower() for j in best_first]
    away = found.boxes.center[best_first][:, None, :2] - truth.boxes.center[None, :, :2]
    right = np.array([[name in accepted for accepted in truth.accepted] for name in names], bool)
    distance = np.where(right.reshape(away.shape[:2]), np.linalg.norm(away, axis=2), np.inf)
    partners, _ = pair_in_order(distance, MAX_DISTANCE)
    partner, error = np.full(len(names), -1, np.int32), np.full(len(names), np.nan)
    partner[best_first] = partners
    paired = np.flatnonzero(partners >= 0)
    error[best_first[paired]] = distance[paired, partners[paired]]
    return partner, error


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


def truth_source(
    roles: Roles, topic: str | None, kitti: Path | None, scans: int
) -> Callable[[Frame], Truth | None] | None:
    """Where the truth of each frame comes from; None: there is none.

    Args:
        roles: of the bag's topics.
        topic: Detection3DArray that was asked for; None: the one that is called ground truth.
        kitti: label file or folder that was asked for.
        scans: how many the bag has, each of which has its labels.

    Raises:
        UserError: no such topic or file, or not as many label files as scans.
    """
    if kitti is not None:
        files = label_files(kitti)
        if len(files) != scans:
            count = f"{len(files)} label file{'s' * (len(files) > 1)}"
            raise UserError(
                f"--kitti-labels {kitti}: {count} and {scans} scans: one for each scan, in order, is needed"
            )

        def of_kitti(frame: Frame) -> Truth | None:
            labelled = read_labels(files[frame.index])
            return truth_of(frame, labelled, [ACCEPTED[label] for label in labelled.labels])

        return of_kitti
    there = (*roles.robot_detections_3d, *([roles.truth] if roles.truth else []))
    if topic is not None and topic not in there:
        raise UserError(
            f"--truth {topic}: no such Detection3DArray topic; there are: {', '.join(there) or 'none'}"
        )
    if topic is None and not roles.truth:
        return None

    def published(frame: Frame) -> Truth | None:
        labelled = frame.truth if topic in (None, roles.truth) else None
        labelled = labelled or next((boxes for boxes in frame.robot_boxes if boxes.topic == topic), None)
        return None if labelled is None else truth_of(frame, labelled)

    return published


def truth_of(
    frame: Frame, labelled: LabelledBoxes3D, accepted: Sequence[frozenset[str]] | None = None
) -> Truth:
    """Labelled boxes as truth for a frame.

    An object must be found if its centre lies within 40 m and in the image of some camera, where there is
    one, and if 10 LiDAR points or more lie in its box.

    Args:
        frame: the frame.
        labelled: boxes, in any frame whose pose they come with.
        accepted: names that are right for each box, in lower case; default: its label alone.
    """
    boxes = in_points_frame(frame, labelled)
    must = (np.hypot(*boxes.center[:, :2].T) <= RANGE) & _in_view(frame, boxes)
    must[must] = [
        geometry.inside(frame.points, boxes, k).sum() >= MIN_HITS for k in np.flatnonzero(must).tolist()
    ]
    own = [frozenset((label.lower(),)) for label in labelled.labels]
    return Truth(boxes, labelled.labels, tuple(accepted if accepted is not None else own), must)


def _in_view(frame: Frame, boxes: Boxes3D) -> Bool:
    """(K,) whether some camera has the centre in its image; every box where no camera has a place."""
    seen, asked = np.zeros(len(boxes), bool), False
    for camera in frame.cameras:
        if camera.image is None or camera.intrinsics is None or camera.camera_from_points is None:
            continue
        asked = True
        uv, _ = geometry.project(geometry.apply(camera.camera_from_points, boxes.center), camera.intrinsics)
        size = np.array([camera.intrinsics.width, camera.intrinsics.height], np.float32)
        with np.errstate(invalid="ignore"):
            seen |= ((uv >= -0.5) & (uv < size - 0.5)).all(axis=1)
    return seen if asked else ~seen
