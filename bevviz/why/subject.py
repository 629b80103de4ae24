"""Subjects of a question: an object, a ground truth object, a detection, a cluster, a pixel or a place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from bevviz.model.class_names import NUSCENES_CLASSES, accepted_names
from bevviz.model.frame import F32, I64, Bool, Boxes3D, Camera
from bevviz.stages.visibility import image_boxes

LINK = 0.3  # IoU from which an image box belongs to a projected object
NOISE = 0.05  # score below which a detection is as good as none
IN_VIEW = 0.1  # least share of a box inside the image for an object in view
MARGIN = 0.02  # metres around a ground truth box that still belong to it, because of sensor noise
FOOT = 0.03  # metres above the bottom of a box that belong to the road, because of sensor noise

Kind = Literal["truth", "object", "detection", "cluster", "track", "pixel", "point", "cell"]


@dataclass(frozen=True, slots=True)
class Subject:
    """One object or place to explain.

    Attributes:
        kind: kind of the subject.
        name: name in sentences.
        label: class name; empty where unknown.
        accepted: right class names for it in lower case; empty: any.
        row: row in the ground truth, the objects, the clusters or the camera's detections, else -1.
        camera: camera of a detection or pixel.
        xyxy: (4,) image box of a detection or pixel.
        box: 3D box in Frame.points_frame; for a point, the cube around the sphere.
        points: rows of Frame.points of a subject such as a cluster; None: the box or frustum selects them.
        asked: (4,) image box that the question drew around it; None: it was selected otherwise.
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
    asked: F32 | None = None

    @property
    def key(self) -> tuple[object, ...]:
        """Identity of the subject within a frame, the same in any list of subjects."""
        if self.xyxy is not None and self.kind == "pixel":
            return self.kind, self.camera, *self.xyxy.tolist()
        if self.box is not None and self.kind in ("point", "cell"):
            return self.kind, *self.box.center[0].tolist(), *self.box.size[0].tolist()
        return self.kind, self.camera, self.row

    @property
    def is_place(self) -> bool:
        """Whether only its position is known."""
        return self.kind in ("pixel", "point", "cell")

    def image_box(self, camera: Camera) -> F32 | None:
        """Return the (4,) box of the subject in a camera's image. None: it is not there."""
        if self.box is not None:
            return projected_box(self.box, camera)
        return self.xyxy if self.camera == camera.name else None

    def accepts(self, name: str) -> bool:
        """Return whether the class of a detection or object is right for the subject."""
        return not self.accepted or name.lower() in self.accepted

    def accepts_of_others(self, name: str) -> bool:
        """Return whether the class of an object that is not ours is right. It may have other class names."""
        return self.accepts(name) or NUSCENES_CLASSES.get(name, name).lower() in accepted_names(
            self.label, ()
        )


def count(number: int, noun: str) -> str:
    """Return a number with its noun: no points, 1 point, 2 points."""
    return f"{number} {noun}" if number == 1 else f"{number or 'no'} {noun}s"


# --- boxes -------------------------------------------------------------------------------------


def points_in_box(box: Boxes3D, points: F32, margin: float = 0.0, foot: float = 0.0) -> Bool:
    """Return (N,) which points are in one upright box, except near or below its bottom."""
    return points_in_boxes(box, points, margin, foot)


def points_in_boxes(boxes: Boxes3D, points: F32, margin: float = 0.0, foot: float = 0.0) -> Bool:
    """Return (N,) which points are each in its own upright box, see ``points_in_box``."""
    x, y, z = (points - boxes.center).T
    c, s = np.cos(boxes.yaw), np.sin(boxes.yaw)
    half = boxes.size.T / 2
    reach = half + np.float32(margin)
    inside = (np.abs(c * x + s * y) < reach[0]) & (np.abs(c * y - s * x) < reach[1])
    return np.asarray(inside & (z > foot - half[2]) & (z < reach[2]), np.bool_)


def projected_box(box: Boxes3D, camera: Camera) -> F32 | None:
    """Return the (4,) image box of a 3D box, cut at the image's edge; None: it is out of view."""
    around = image_boxes(box, camera)[0]
    return around if np.isfinite(around).all() else None
