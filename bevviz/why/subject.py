"""What is asked about: an object, of the ground truth or not, a detection, a cluster, a pixel, a place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from bevviz.model.class_names import CATEGORIES, accepted_names
from bevviz.model.frame import F32, I64, Bool, Boxes3D, Camera
from bevviz.stages.visibility import image_boxes

LINK = 0.3  # IoU from which a box is taken for one of a projected object
IN_VIEW = 0.1  # share of a box that is inside the image, if it is in view
MARGIN = 0.02  # metres around a box of the ground truth that are still its own: noise of the sensor
FOOT = 0.03  # metres above its bottom that are the road's: noise of the sensor, too

Kind = Literal["truth", "object", "detection", "cluster", "track", "pixel", "point", "cell"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """What to explain. Nothing given: the whole frame.

    The rows are those of ``Frame.truth``, of ``FrameResult.objects`` and ``clusters``, and of the detections
    of ``camera``.
    """

    label: str = ""  # class name
    box: tuple[float, ...] = ()  # u, v or u0, v0, u1, v1 in pixels
    point: tuple[float, ...] = ()  # x, y, z in Frame.points_frame
    cell: tuple[int, ...] = ()  # row, column of the bird's-eye view
    radius: float = 0.5  # metres around that point or cell
    camera: str = ""  # name, where there are several
    truth: int | None = None
    object: int | None = None
    detection: int | None = None
    cluster: int | None = None
    track: int | None = None  # its id

    @property
    def one(self) -> bool:
        """Whether it is of one thing, rather than of all of a kind."""
        rows = self.truth, self.object, self.detection, self.cluster, self.track
        return bool(self.box or self.point or self.cell) or any(row is not None for row in rows)


@dataclass(frozen=True, slots=True)
class Subject:
    """One thing, and where it is looked for.

    Attributes:
        kind: what it is.
        name: in words.
        label: class name; empty where none is known.
        accepted: names that are right for it, in lower case; empty: any.
        row: of the ground truth, the objects, the clusters or the camera's detections, else -1.
        camera: that it is a detection or pixel of.
        xyxy: (4,) image box of a detection or pixel.
        box: its 3D box in Frame.points_frame; of a point, the cube around the sphere.
        points: rows of Frame.points that are its own, where no box says which: of a cluster.
    """

    kind: Kind
    name: str
    label: str = ""
    accepted: frozenset[str] = frozenset()
    row: int = -1
    camera: str = ""
    xyxy: F32 | None = None
    box: Boxes3D | None = None
    points: I64 | None = None

    @property
    def key(self) -> tuple[object, ...]:
        """Which one it is: two lists of the same frame's subjects name it alike."""
        if self.xyxy is not None and self.kind == "pixel":
            return self.kind, self.camera, *self.xyxy.tolist()
        if self.box is not None and self.kind in ("point", "cell"):
            return self.kind, *self.box.center[0].tolist(), *self.box.size[0].tolist()
        return self.kind, self.camera, self.row

    @property
    def is_place(self) -> bool:
        """Whether nothing is known of it but where it is."""
        return self.kind in ("pixel", "point", "cell")

    def accepts(self, name: str) -> bool:
        """Whether a detection or an object of that class is a right one."""
        return not self.accepted or name.lower() in self.accepted

    def accepts_of_others(self, name: str) -> bool:
        """Whether an object of somebody else's, who need not have the detector's names, is a right one."""
        return self.accepts(name) or CATEGORIES.get(name, name).lower() in accepted_names(self.label, ())


def count(number: int, what: str) -> str:
    """In words: no points, 1 point, 2 points."""
    return f"{number} {what}" if number == 1 else f"{number or 'no'} {what}s"


# --- boxes -------------------------------------------------------------------------------------


def one_of(boxes: Boxes3D, row: int) -> Boxes3D:
    """One box of several."""
    return Boxes3D(boxes.center[[row]], boxes.size[[row]], boxes.yaw[[row]])


def in_box(box: Boxes3D, points: F32, margin: float = 0.0, foot: float = 0.0) -> Bool:
    """(N,) which points are in the one upright box, but for what is below it or near its bottom."""
    x, y, z = (points - box.center[0]).T
    c, s = np.cos(box.yaw[0]), np.sin(box.yaw[0])
    half = box.size[0] / 2 + np.float32(margin)
    inside = (np.abs(c * x + s * y) < half[0]) & (np.abs(c * y - s * x) < half[1])
    return np.asarray(inside & (z > -box.size[0, 2] / 2 + foot) & (z < half[2]), np.bool_)


def projected(box: Boxes3D, camera: Camera) -> F32 | None:
    """(4,) image box around what of a 3D box is before the camera, cut at the image's edge; None: nothing."""
    found = image_boxes(box, camera)[0]
    return found if np.isfinite(found).all() else None
