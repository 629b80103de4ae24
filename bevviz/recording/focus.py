"""Views that go to a subject: each has a coordinate frame, whose pose brings the subject before the eye.

A layout that is sent again loses what its user has chosen: tabs, sizes, the turn of the eye. So the layout
stays, and poses are logged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Self

import cv2
import numpy as np
import rerun as rr

from bevviz.model.frame import F32, F64, Camera, Frame
from bevviz.model.results import FrameResult
from bevviz.recording import entities
from bevviz.recording.labels import EYE, LOOK_TARGET
from bevviz.recording.marks import MARK_COLORS
from bevviz.recording.primitives import blob
from bevviz.recording.writer import Writer
from bevviz.support.colors import GROUND, Color, class_color

SPACE, ABOVE = "space", "above"  # names of the views of a scene
FROM_ABOVE = "Bird's-eye view"  # title of the view from above
IMAGE_WIDTH, IMAGE_HEIGHT = 1000.0, 562.5  # width of a whole image in its view, and height of the view
_AHEAD = 12.0  # metres from the robot to the middle of the view from above, without a subject
_FLAT = 0.05  # height of objects in the view from above, so that they hide nothing
_AWAY, _AWAY_SIZES = 4.0, 1.2  # metres from the eye to a subject, and further lengths of it
_USUAL = float(np.linalg.norm(np.subtract(EYE, LOOK_TARGET)))  # metres from the eye to what it looks at
_SIZES = 4.0  # sizes of a subject that its view of an image is wide or high
_LEAST = 0.35  # of the width of an image is shown at least
_BORDER = 0.35  # of the width of a view is the least distance of a subject from its border
_VEIL, _VEIL_ORDER = 165, 38.0  # opacity of what covers the rest of an image, and its order over the image
_DIM = 0.35  # brightness of what is no subject
_BEFORE, _STEP, _MOST = 1_000_000, 1_000, 999  # nanoseconds before a frame, between two poses, and poses
_RINGS = np.arange(10, 61, 10)  # metres around the robot
_ARROW = np.array([(1.2, 0, 0), (-0.8, 0.9, 0), (-0.3, 0, 0), (-0.8, -0.9, 0), (1.2, 0, 0)], np.float32)
_TURN = np.linspace(0, 2 * np.pi, 97)


@dataclass(frozen=True, slots=True)
class ViewPose:
    """Pose of a view's coordinate frame among the points of a frame.

    Attributes:
        center: (3,) position of its origin.
        yaw: its turn about z.
        scale: (3,) metres for each of its units.
    """

    center: F64
    yaw: float = 0.0
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def position(self, position: Sequence[float]) -> tuple[float, ...]:
        """Return where a position in the view is among the points."""
        x, y, z = np.multiply(position, self.scale)
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        turned = np.array([cos * x - sin * y, sin * x + cos * y, z])
        return tuple((self.center + turned).tolist())


@dataclass(frozen=True, slots=True)
class ImagePose:
    """Part of an image that its view shows.

    Attributes:
        corner: (2,) first pixel, as Rerun counts.
        scale: pixels for each unit of the view.
    """

    corner: tuple[float, float]
    scale: float

    def position(self, position: Sequence[float]) -> tuple[float, ...]:
        """Return the pixel at a position in the view."""
        pixel = np.add(self.corner, np.multiply(self.scale, position))
        return tuple(np.round(pixel, 1).tolist())


@dataclass(frozen=True, slots=True)
class Focus:
    """Poses of all views.

    Attributes:
        views: poses of the views of the scene by name.
        images: parts of the images by camera.
    """

    views: Mapping[str, ViewPose]
    images: Mapping[str, ImagePose] = field(default_factory=dict)

    @classmethod
    def usual(cls, frame: Frame, cameras: Sequence[str] = ()) -> Self:
        """Return the focus without a subject: ahead of the robot, and whole images.

        Args:
            frame: the frame.
            cameras: names of further cameras, whose images it may lack.
        """
        views = {
            SPACE: ViewPose(np.array(LOOK_TARGET)),
            ABOVE: ViewPose(np.array([_AHEAD, 0.0, 0.0]), scale=(1.0, 1.0, 1 / _FLAT)),
        }
        images = dict.fromkeys(cameras, ImagePose((0.0, 0.0), 1.0))
        for camera in frame.cameras:
            if (size := _image_size(camera)) is not None:
                images[camera.name] = ImagePose((0.0, 0.0), size[0] / IMAGE_WIDTH)
        return cls(views, images)

    @classmethod
    def on(cls, frame: Frame, center: F32 | None, length: float, boxes: Mapping[str, F32]) -> Self:
        """Return the focus on a subject.

        Args:
            frame: the frame.
            center: (3,) position of the subject among the points. None: unknown.
            length: its longest side in metres.
            boxes: (4,) its box in the image of each camera.
        """
        usual = cls.usual(frame)
        views, images = dict(usual.views), dict(usual.images)
        if center is not None:
            scale, place = eye_distance(length) / _USUAL, center.astype(np.float64)
            views[SPACE] = ViewPose(place, float(np.arctan2(place[1], place[0])), (scale,) * 3)
            views[ABOVE] = ViewPose(place, scale=usual.views[ABOVE].scale)
        for camera in frame.cameras:
            size = _image_size(camera)
            if size is not None and camera.name in boxes:
                images[camera.name] = _part(size, boxes[camera.name])
        return cls(views, images)

    def position(self, view: str, position: Sequence[float]) -> Sequence[float]:
        """Return a clicked position among the points or in the image.

        Args:
            view: title of the view.
            position: 2 or 3 numbers in the view.
        """
        if len(position) == 3:
            return self.views[ABOVE if view == FROM_ABOVE else SPACE].position(position)
        pose = self.images.get(view)
        return position if pose is None or len(position) != 2 else pose.position(position)


def eye_distance(length: float) -> float:
    """Return the metres from the eye to a subject with a longest side of ``length`` metres."""
    return _AWAY + _AWAY_SIZES * length


def frame_name(view: str) -> str:
    """Return the name of the coordinate frame of a view."""
    return f"focus:{view}"


def log_focus(to: Writer, frame: Frame, focus: Focus, number: int) -> None:
    """Move the views from a frame on.

    The viewer may take the older one of two poses at one time. So each has its own time before the frame.

    Args:
        to: writer of the answers, or of the first frame.
        frame: the frame.
        focus: where the views look.
        number: number of this focus among those of the page.
    """
    before = _BEFORE - min(number, _MOST) * _STEP
    to.set_time(frame.index, frame.stamp - before, frame.received and frame.received - before)
    lidar = entities.space(entities.SENSOR.path(frame.lidar))
    for view, pose in focus.views.items():
        turn = rr.RotationAxisAngle((0, 0, 1), rr.Angle(rad=pose.yaw))
        _log_pose(to, view, lidar, rr.Transform3D(translation=pose.center, rotation=turn, scale=pose.scale))
    for camera, part in focus.images.items():
        image = entities.space(entities.IMAGE.path(camera))
        _log_pose(to, camera, image, rr.Transform3D(translation=(*part.corner, 0.0), scale=part.scale))


def log_robot_from_above(to: Writer, lidar: str) -> None:
    """Log the robot and the rings around it for the view from above, as static data."""
    circle = np.stack([np.cos(_TURN), np.sin(_TURN), np.zeros(len(_TURN))], axis=1)
    rings = [(radius * circle).astype(np.float32) for radius in _RINGS]
    colors = [(210, 212, 220)] + [GROUND] * len(rings)
    path = entities.FOCUS.path("robot")
    to.static(path, rr.LineStrips3D([_ARROW, *rings], colors=colors, radii=rr.Radius.ui_points(0.75)))
    to.static(path, rr.CoordinateFrame(entities.space(entities.SENSOR.path(lidar))))


def _log_pose(to: Writer, view: str, parent: str, pose: rr.Transform3D) -> None:
    named = rr.Transform3D.from_fields(parent_frame=parent, child_frame=frame_name(view))
    to.write(entities.FOCUS.path(view), pose, named)


def _image_size(camera: Camera) -> tuple[int, int] | None:
    """Return width and height of a camera's image."""
    if camera.intrinsics is not None:
        return camera.intrinsics.width, camera.intrinsics.height
    return None if camera.image is None else (camera.image.bgr.shape[1], camera.image.bgr.shape[0])


def _part(size: tuple[int, int], box: F32) -> ImagePose:
    """Return the part of an image around a box. The box stays away from the border of its view."""
    lengths, image = box[2:] - box[:2], np.array(size, np.float64)
    needed = _SIZES * max(lengths[0], lengths[1] * IMAGE_WIDTH / IMAGE_HEIGHT)
    share = min(1.0, max(_LEAST, needed / image[0]))
    shown = share * image
    center = np.clip((box[:2] + box[2:]) / 2, (0.5 - _BORDER) * shown, image - (0.5 - _BORDER) * shown)
    u, v = (center - shown / 2).tolist()
    return ImagePose((u, v), float(shown[0] / IMAGE_WIDTH))


# --- the rest ------------------------------------------------------------------------------------


def dim_rest(to: Writer, result: FrameResult, boxes: Mapping[str, F32]) -> None:
    """Dim all marks and objects at the writer's current time, and all of each image outside of the subject.

    The next frame has colours of its own.

    Args:
        to: writer of the answers.
        result: result of the frame.
        boxes: (4,) the subject's box in the image of each camera.
    """
    names = [] if result.objects is None else result.objects.names
    if names:
        colors = [_dimmed(class_color(name)) for name in names]
        to.write(entities.FUSED, rr.Boxes3D.from_fields(colors=colors))
        to.write(entities.OUTLINES.path(entities.FUSED), rr.LineStrips3D.from_fields(colors=colors))
    for state, color in MARK_COLORS.items():
        to.write(entities.MARKED.path(state), rr.LineStrips3D.from_fields(colors=[_dimmed(color)]))
    for camera in result.frame.cameras:
        if (size := _image_size(camera)) is not None and camera.name in boxes:
            _log_veil(to, camera.name, size, boxes[camera.name])


def _dimmed(color: Color) -> Color:
    r, g, b = (round(_DIM * value) for value in color)
    return r, g, b


def _log_veil(to: Writer, camera: str, size: tuple[int, int], box: F32) -> None:
    """Cover an image outside of a box."""
    width, height = size
    left, top = np.floor(np.maximum(box[:2], 0)).astype(int)
    right, bottom = np.ceil(box[2:]).astype(int) + 1
    veil = np.zeros((height, width, 4), np.uint8)
    veil[..., 3] = _VEIL
    veil[top:bottom, left:right, 3] = 0
    path = entities.WHY_PART.path(f"{camera}/veil")
    _, data = cv2.imencode(".png", veil, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    to.static(path, rr.CoordinateFrame(entities.space(entities.IMAGE.path(camera))))
    image = rr.EncodedImage(contents=blob(data), media_type="image/png", draw_order=_VEIL_ORDER)
    to.write(path, image)
