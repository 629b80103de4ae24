"""What is asked about: an object, of the ground truth or not, a detection, a cluster, a pixel, a place."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from bevviz import geometry
from bevviz.datasets.names import ACCEPTED
from bevviz.frame import F32, F64, I64, Bool, Boxes3D, Camera

LINK = 0.3  # IoU from which a box is taken for one of a projected object
IN_VIEW = 0.1  # share of a box that is inside the image, if it is in view
MARGIN = 0.02  # metres around a box of the ground truth that are still its own: noise of the sensor
FOOT = 0.03  # metres above its bottom that are the road's: noise of the sensor, too
NEAR_PLANE = 0.1  # metres before the camera, from which on a box is drawn in its image

Kind = Literal["truth", "object", "detection", "cluster", "track", "pixel", "point", "cell"]

_SYNONYMS = {label.lower(): names for label, names in ACCEPTED.items()} | {
    "cyclist": ACCEPTED["Cyclist"] | {"rider"}
}
_EDGES = np.array(
    [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]
)


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


def accepted_names(label: str, known: Iterable[str]) -> frozenset[str]:
    """What a detector may rightly call an object of the ground truth, in lower case.

    Its own name alone where the detector knows that; KITTI's names stand for several.
    """
    name = label.lower()
    if label in ACCEPTED:
        return frozenset(ACCEPTED[label] | _SYNONYMS[name])
    if any(name == other.lower() for other in known):
        return frozenset({name})
    return frozenset({name, *_SYNONYMS.get(name, ())})


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
    if camera.intrinsics is None or camera.camera_from_points is None:
        return None
    corners = geometry.apply(camera.camera_from_points, geometry.corners(box)[0]).astype(np.float64)
    a, b = corners[_EDGES[:, 0]], corners[_EDGES[:, 1]]
    cut = (a[:, 2] < NEAR_PLANE) != (b[:, 2] < NEAR_PLANE)
    a, b = a[cut], b[cut]
    crossing = a + (b - a) * ((NEAR_PLANE - a[:, 2]) / (b[:, 2] - a[:, 2]))[:, None]
    ahead = np.concatenate([corners[corners[:, 2] >= NEAR_PLANE], crossing])
    uv, _ = geometry.project(ahead, camera.intrinsics)
    uv = uv[np.isfinite(uv).all(axis=1)]
    if len(uv) == 0:
        return None
    limit = np.array([camera.intrinsics.width, camera.intrinsics.height], np.float32) - 0.5
    low, high = np.clip(uv.min(0), -0.5, limit), np.clip(uv.max(0), -0.5, limit)
    return np.concatenate([low, high]) if (high > low).all() else None


def in_view(boxes: Boxes3D, camera: Camera) -> F64:
    """(K,) share of each box that is inside the image; 0 where the camera's place is not known."""
    if camera.intrinsics is None or camera.camera_from_points is None or len(boxes) == 0:
        return np.zeros(len(boxes))
    steps = np.linspace(-0.45, 0.45, 5, dtype=np.float32)
    grid = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    local = grid[None] * boxes.size[:, None]
    c, s = np.cos(boxes.yaw)[:, None], np.sin(boxes.yaw)[:, None]
    x, y = c * local[..., 0] - s * local[..., 1], s * local[..., 0] + c * local[..., 1]
    points = np.stack([x, y, local[..., 2]], axis=-1) + boxes.center[:, None]
    uv, _ = geometry.project(
        geometry.apply(camera.camera_from_points, points.reshape(-1, 3)), camera.intrinsics
    )
    limit = np.array([camera.intrinsics.width, camera.intrinsics.height], np.float32) - 0.5
    with np.errstate(invalid="ignore"):
        inside = ((uv >= -0.5) & (uv < limit)).all(axis=1)
    return np.asarray(inside.reshape(len(boxes), -1).mean(axis=1), np.float64)
