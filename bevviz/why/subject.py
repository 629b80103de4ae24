"""What is asked about: an object of the ground truth, a detection, a pixel or a place."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from bevviz import geometry
from bevviz.errors import UserError
from bevviz.frame import (
    F32,
    Bool,
    Boxes3D,
    Camera,
    CameraResult,
    Decision,
    DetectionState,
    Frame,
    FrameResult,
    Intrinsics,
)

LINK = 0.3  # IoU from which a detection is taken for one of a projected object
VISIBLE = 0.3  # share of an object's image box that is inside the image, if it is in view
PIXELS = 6.0  # half edge of what is looked at around a pixel under no detection
MARGIN = 0.05  # metres around a box of the ground truth that are still its own: noise of the sensor

# What a detector may rightly call an object of the ground truth, beside its own name.
_NAMES = {
    "pedestrian": {"person"},
    "person_sitting": {"person"},
    "cyclist": {"bicycle", "person", "rider"},
    "van": {"car", "truck"},
    "truck": {"car"},
}


@dataclass(frozen=True, slots=True)
class Selection:
    """What to explain. Nothing given: whatever did not end as an object of its own."""

    label: str = ""  # class name
    box: tuple[float, ...] = ()  # u, v or u0, v0, u1, v1 in pixels
    point: tuple[float, ...] = ()  # x, y, z in Frame.points_frame
    radius: float = 0.5  # metres around that point
    camera: str = ""  # name, where there are several


@dataclass(frozen=True, slots=True)
class Subject:
    """One object, and where it is looked for.

    Attributes:
        kind: ``truth``, ``detection``, ``pixel`` or ``point``.
        name: in words.
        label: class name; empty where none is known.
        row: of the ground truth or of the camera's detections, else -1.
        camera: that it is a detection or pixel of.
        xyxy: (4,) image box of a detection or pixel.
        box: its 3D box in Frame.points_frame, of ground truth; of a point, the cube around the sphere.
    """

    kind: Literal["truth", "detection", "pixel", "point"]
    name: str
    label: str = ""
    row: int = -1
    camera: str = ""
    xyxy: F32 | None = None
    box: Boxes3D | None = None

    @property
    def key(self) -> tuple[str, str, int]:
        """Which one it is: two lists of the same frame's subjects name it alike."""
        return self.kind, self.camera, self.row

    def place(self, frame: Frame, points: F32) -> Bool:
        """(N,) which of the points are there: in the 3D box, the sphere, or the frustum of the image box."""
        if self.box is not None and self.kind == "point":
            away = np.linalg.norm(points - self.box.center[0], axis=1)
            return np.asarray(away < self.box.size[0, 0] / 2, np.bool_)
        if self.box is not None:
            return in_box(self.box, points, MARGIN)
        camera = next(c for c in frame.cameras if c.name == self.camera)
        if self.xyxy is None or camera.intrinsics is None or camera.camera_from_points is None:
            return np.zeros(len(points), np.bool_)
        uv, _ = geometry.project(geometry.apply(camera.camera_from_points, points), camera.intrinsics)
        with np.errstate(invalid="ignore"):
            inside = (uv >= self.xyxy[:2]) & (uv <= self.xyxy[2:])
        return np.asarray(inside.all(axis=1), np.bool_)

    def accepts(self, name: str) -> bool:
        """Whether a detection of that class is a right one."""
        return not self.label or name.lower() in {self.label.lower(), *_NAMES.get(self.label.lower(), ())}


def in_box(box: Boxes3D, points: F32, margin: float = 0.0) -> Bool:
    """(N,) which points are in the one upright box, but for what is below it."""
    x, y, z = (points - box.center[0]).T
    c, s = np.cos(box.yaw[0]), np.sin(box.yaw[0])
    half = box.size[0] / 2 + np.float32(margin)
    inside = (np.abs(c * x + s * y) < half[0]) & (np.abs(c * y - s * x) < half[1])
    return np.asarray(inside & (z > -box.size[0, 2] / 2) & (z < half[2]), np.bool_)


def projected(box: Boxes3D, camera: Camera) -> F32 | None:
    """(4,) image box around a 3D box, cut at the image's edge; None where too little of it is in view."""
    if camera.intrinsics is None or camera.camera_from_points is None:
        return None
    corners = geometry.apply(camera.camera_from_points, geometry.corners(box)[0])
    if corners[:, 2].min() < 0.1:
        return None
    uv, _ = geometry.project(corners, camera.intrinsics)
    if not np.isfinite(uv).all():
        return None
    limit = np.array([camera.intrinsics.width, camera.intrinsics.height], np.float32) - 0.5
    low, high = np.clip(uv.min(0), -0.5, limit), np.clip(uv.max(0), -0.5, limit)
    in_view = np.prod(high - low) > VISIBLE * np.prod(uv.max(0) - uv.min(0))
    return np.concatenate([low, high]) if in_view else None


def truth_box(frame: Frame, row: int) -> Boxes3D:
    """One box of the ground truth, in Frame.points_frame."""
    truth = frame.truth
    assert truth is not None
    points_from_boxes = np.eye(4)
    if truth.world_from_boxes is not None and frame.world_from_points is not None:
        points_from_boxes = geometry.inverse(frame.world_from_points) @ truth.world_from_boxes
    yaw = truth.boxes.yaw[[row]] + np.float32(geometry.yaw(points_from_boxes))
    center = geometry.apply(points_from_boxes, truth.boxes.center[[row]])
    return Boxes3D(center, truth.boxes.size[[row]], yaw)


# --- selection ---------------------------------------------------------------------------------


def select(result: FrameResult, selection: Selection, classes: Sequence[str]) -> list[Subject]:
    """The subjects of a selection.

    Args:
        result: the frame and what became of it.
        selection: what is asked for.
        classes: names that the detector knows.

    Raises:
        UserError: unknown class or camera, pixel outside the image, several cameras and none named.
    """
    if selection.point:
        return [_point(selection)]
    if selection.box:
        return [_pixel(result, selection)]
    if selection.camera:
        _camera(result, selection.camera)
    subjects = [
        *(s for s in _truth(result) if _seen(result, s, selection.camera)),
        *_detections(result, selection.camera),
    ]
    if not selection.label:
        return subjects
    known = dict.fromkeys([*classes, *(result.frame.truth.labels if result.frame.truth else ())])
    wanted = selection.label.lower()
    if not any(wanted == name.lower() or wanted in _NAMES.get(name.lower(), ()) for name in known):
        near = difflib.get_close_matches(selection.label, known, 1, 0.5)
        hint = f"did you mean '{near[0]}'?" if near else f"there are {', '.join(sorted(known)) or 'none'}"
        raise UserError(f"--class {selection.label}: no such class; {hint}")
    return [s for s in subjects if s.label.lower() == wanted or (s.kind == "truth" and s.accepts(wanted))]


def _point(selection: Selection) -> Subject:
    x, y, z = selection.point
    center, edge = np.array([[x, y, z]], np.float32), 2 * selection.radius
    cube = Boxes3D(center, np.full((1, 3), edge, np.float32), np.zeros(1, np.float32))
    return Subject("point", f"what is at {x:g}, {y:g}, {z:g} m", box=cube)


def _pixel(result: FrameResult, selection: Selection) -> Subject:
    """The detection there, the surest one that is nobody's duplicate; else the pixel itself."""
    found = _camera(result, selection.camera)
    size = found.camera.intrinsics or _image_size(found.camera)
    if size is None:
        raise UserError(f"--box: {found.camera.name} has no image in this frame")
    low, high = np.array(selection.box[:2]), np.array(selection.box[-2:])
    if (low < -0.5).any() or (high > [size.width - 0.5, size.height - 0.5]).any() or (high < low).any():
        raise UserError(
            f"--box {','.join(f'{v:g}' for v in selection.box)}: outside the image of {found.camera.name}, "
            f"which has {size.width} x {size.height} pixels"
        )
    wanted = np.concatenate([low, high]).astype(np.float32)
    detections = found.detections
    if detections is not None and len(detections):
        if len(selection.box) == 4:
            fit = geometry.iou(wanted[None], detections.xyxy)[0]
            fit[fit < LINK] = 0
        else:
            inside = (low >= detections.xyxy[:, :2]) & (low <= detections.xyxy[:, 2:])
            fit = inside.all(axis=1) * detections.score
        fit = fit * np.where(detections.state == DetectionState.SUPPRESSED, 0.01, 1.0)
        if fit.max() > 0:
            detection = _detection(found, int(fit.argmax()))
            return _object_of(result, found.camera, detection) or detection
    if len(selection.box) == 2:
        wanted += np.array([-PIXELS, -PIXELS, PIXELS, PIXELS], np.float32)
    u, v = (wanted[:2] + wanted[2:]) / 2
    return Subject("pixel", f"what is at pixel {u:g}, {v:g}", camera=found.camera.name, xyxy=wanted)


def _object_of(result: FrameResult, camera: Camera, detection: Subject) -> Subject | None:
    """The object of the ground truth that a detection is of."""
    best, most = None, LINK
    for subject in _truth(result):
        box = projected(subject.box, camera) if subject.box is not None else None
        if box is not None and detection.xyxy is not None and subject.accepts(detection.label):
            overlap = float(geometry.iou(box[None], detection.xyxy[None])[0, 0])
            best, most = (subject, overlap) if overlap >= most else (best, most)
    return best


def competing(result: FrameResult, subjects: Sequence[Subject]) -> list[Subject]:
    """Those that a cluster may be shared with: weak detections take nothing from anybody."""
    states = {c.camera.name: c.detections.state for c in result.cameras if c.detections is not None}
    return [s for s in subjects if s.kind != "detection" or states[s.camera][s.row] == DetectionState.KEPT]


def _image_size(camera: Camera) -> Intrinsics | None:
    if camera.image is None:
        return None
    height, width = camera.image.bgr.shape[:2]
    return Intrinsics(width, height, np.eye(3))


def _camera(result: FrameResult, name: str) -> CameraResult:
    names = [c.camera.name for c in result.cameras]
    if not names:
        raise UserError("this recording has no camera: ask with --point x,y,z")
    if not name and len(names) > 1:
        raise UserError(f"several cameras: say which with --camera, one of {', '.join(names)}")
    if name and name not in names:
        raise UserError(f"--camera {name}: there is none of that name; there are {', '.join(names)}")
    return result.cameras[names.index(name) if name else 0]


def _seen(result: FrameResult, subject: Subject, camera: str) -> bool:
    """Whether a camera has it in view; where there is no camera, everything counts."""
    cameras = [c.camera for c in result.cameras if not camera or c.camera.name == camera]
    usable = [c for c in cameras if c.intrinsics is not None and c.camera_from_points is not None]
    return not usable or any(
        subject.box is not None and projected(subject.box, c) is not None for c in usable
    )


def _truth(result: FrameResult) -> Iterator[Subject]:
    truth = result.frame.truth
    for row in range(len(truth.boxes) if truth is not None else 0):
        assert truth is not None
        box = truth_box(result.frame, row)
        away = float(np.hypot(*box.center[0, :2]))
        label = truth.labels[row]
        yield Subject("truth", f"the {label.lower()} at {away:.1f} m", label, row, box=box)


def _detections(result: FrameResult, camera: str) -> Iterator[Subject]:
    """Detections that are of no object of the ground truth. Duplicates speak through what suppressed them."""
    boxes = [s.box for s in _truth(result) if s.box is not None]
    for found in result.cameras:
        detections = found.detections
        if detections is None or (camera and camera != found.camera.name):
            continue
        seen = [b for b in (projected(box, found.camera) for box in boxes) if b is not None]
        for row in np.flatnonzero(detections.state != DetectionState.SUPPRESSED).tolist():
            overlap = geometry.iou(detections.xyxy[[row]], np.array(seen or np.zeros((0, 4))))
            if overlap.max(initial=0) < LINK:
                yield _detection(found, row)


def _detection(found: CameraResult, row: int) -> Subject:
    detections = found.detections
    assert detections is not None
    name = f"{detections.names[row]} {detections.score[row]:.2f} in {found.camera.name}"
    fusion = found.fusion
    if fusion is not None and fusion.detection_decision[row] == Decision.MATCHED:
        pair = fusion.pair(row, int(fusion.detection_cluster[row]))
        name += f" at {pair.depth:.1f} m" if pair is not None else ""
    return Subject(
        "detection", f"the {name}", detections.names[row], row, found.camera.name, detections.xyxy[row]
    )
