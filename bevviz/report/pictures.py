"""Small pictures of a frame, and line plots laid out for the SVG in a page's template."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from bevviz.config import BevConfig
from bevviz.model import geometry
from bevviz.model.frame import F64, U8, Bool, Boxes3D
from bevviz.model.results import Bev, CameraResult, Decision, FrameResult
from bevviz.recording.entities import DEPTH_BINS, DEPTH_RANGE
from bevviz.stages.bev import bev
from bevviz.stages.voxel import spread_to_points
from bevviz.support.colors import Color, StateColor, class_color, color_rows, turbo
from bevviz.why import Answer
from bevviz.why.log import focus_point

Series = Sequence[tuple[float, float]]  # (x, y) pairs

WIDTH, HEIGHT = 560, 190
LEFT, RIGHT, TOP, BOTTOM = 52, 18, 10, 24  # margins around the lines, pixels

PLACE = 1.5  # metres, side of the box that marks the place of a subject without one
REACH, MOST_REACH = 15.0, 500.0  # metres that the picture from above shows on each side of the sensor
SUBJECT: Color = StateColor.SUBJECT.value


def camera_picture(
    result: CameraResult, width: int, *, labels: bool = False, points: bool = False
) -> U8 | None:
    """Return the camera's image with its kept detections, (h, width, 3) BGR, or None without an image.

    A matched box is drawn thick, an unmatched one thin.

    Args:
        result: result of one camera.
        width: width in pixels. A smaller image is not enlarged.
        labels: draw class, score and the reason of a missing match, where there is room.
        points: draw the obstacle points by depth, near red and far blue.
    """
    if result.camera.image is None:
        return None
    picture, scale = shrink(result.camera.image.bgr, width)
    if points:
        _draw_points(picture, result, scale)
    detections = result.detections
    if detections is None:
        return picture
    kept_rows = np.flatnonzero(detections.kept)
    matched = np.zeros(len(detections), bool)
    if result.fusion is not None:
        matched = result.fusion.detection_decision == Decision.MATCHED
    corners = np.round((detections.xyxy + 0.5) * scale - 0.5).astype(int)
    for row in kept_rows[::-1].tolist():
        x0, y0, x1, y1 = corners[row].tolist()
        width = 2 if matched[row] else 1
        cv2.rectangle(
            picture, (x0, y0), (x1, y1), class_color(detections.names[row])[::-1], width, cv2.LINE_AA
        )
    occupied = np.zeros(picture.shape[:2], bool)
    unmatched_first = sorted(kept_rows.tolist(), key=lambda row: bool(matched[row]))
    for row in unmatched_first if labels else ():
        text = f"{detections.names[row]} {detections.score[row]:.2f}"
        if not matched[row] and result.fusion is not None:
            decision = Decision(int(result.fusion.detection_decision[row]))
            text += f", {decision.name.lower().replace('_', ' ')}"
        x, y = corners[row, :2].tolist()
        _label(picture, occupied, text, x, y, class_color(detections.names[row])[::-1])
    return picture


def shrink(bgr: U8, width: int) -> tuple[U8, float]:
    """Return a copy with at most this width, and its scale."""
    scale = min(1.0, width / bgr.shape[1])
    if scale == 1.0:
        return bgr.copy(), scale
    size = max(1, round(bgr.shape[1] * scale)), max(1, round(bgr.shape[0] * scale))
    small: U8 = cv2.resize(bgr, size, interpolation=cv2.INTER_AREA)
    return small, scale


def crop_ahead(bev: Bev) -> U8:
    """Return the part of a bird's-eye image that is ahead and not far to the sides."""
    rows, columns = bev.image.shape[:2]
    return bev.image[rows // 20 : 5 * rows // 8, columns // 4 : 3 * columns // 4]


def jpeg(bgr: U8, quality: int = 80) -> bytes:
    """Return an image as JPEG."""
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return bytes(data.tobytes())


# --- the object that a report is about -----------------------------------------------------------


def marked_pictures(result: FrameResult, answer: Answer, width: int) -> list[tuple[U8, str]]:
    """Return BGR pictures that mark the subject, with captions: of each camera that shows it, and from above.

    Args:
        result: result of the frame.
        answer: answer about the subject.
        width: largest width of a picture in pixels.
    """
    marked = []
    for result_of_camera in result.cameras:
        camera = result_of_camera.camera
        box_in_image = answer.subject.image_box(camera)
        picture = None if box_in_image is None else camera_picture(result_of_camera, width)
        if box_in_image is None or picture is None or camera.image is None:
            continue
        outline = np.asarray(box_in_image, np.float64)[[[0, 1], [2, 1], [2, 3], [0, 3]]]
        scale = picture.shape[1] / camera.image.bgr.shape[1]
        _mark(picture, (outline + 0.5) * scale - 0.5, answer.subject.name)
        marked.append((picture, f"{camera.name}: white is {answer.subject.name}"))
    box = answer.subject.box or _box_around_points(result, answer)
    if box is not None and result.frame.lidar:
        picture, outline = _view_from_above(result, box, width)
        _mark(picture, outline, answer.subject.name)
        caption = f"from above, the sensor's front is up: white is {answer.subject.name}"
        marked.append((picture, caption))
    return marked


def _box_around_points(result: FrameResult, answer: Answer) -> Boxes3D | None:
    """Return a box at the points of a subject without one. None: it has no points."""
    focus = focus_point(result.frame, answer)
    size, yaw = np.full((1, 3), PLACE, np.float32), np.zeros(1, np.float32)
    return None if focus is None else Boxes3D(focus[None], size, yaw)


def _view_from_above(result: FrameResult, box: Boxes3D, width: int) -> tuple[U8, F64]:
    """Return a bird's-eye image that reaches beyond a box, and the (4, 2) corners of the box in it."""
    reach = min(max(REACH, 1.25 * float(np.abs(box.center[0, :2]).max())), MOST_REACH)
    config = BevConfig(range_x=reach, range_y=reach, resolution=2 * reach / width, channels=())
    ground = None
    if result.voxels is not None and result.ground is not None:
        ground = spread_to_points(result.ground.mask, result.voxels.inverse)
    image = bev(result.frame.points, None, ground, result.objects, result.clusters, config).image
    return image, np.asarray((reach - geometry.corners(box)[0, :4, 1::-1]) / config.resolution, np.float64)


def _mark(picture: U8, outline: F64, name: str) -> None:
    """Draw the closed outline of the subject and its name, white on black."""
    corners = np.round(np.clip(outline, -1e4, 1e4)).astype(np.int32)
    for color, thickness in (((0, 0, 0), 5), (SUBJECT, 2)):
        cv2.polylines(picture, [corners], True, color, thickness, cv2.LINE_AA)
    x, y = corners.min(axis=0).tolist()
    _label(picture, np.zeros(picture.shape[:2], bool), name, x, y - 4, SUBJECT)


def _draw_points(picture: U8, result: CameraResult, scale: float) -> None:
    """Draw the obstacle points of a camera, coloured by depth."""
    if result.uv is None or result.depth is None:
        return
    visible = np.isfinite(result.uv[:, 0])
    u, v = np.floor((result.uv[visible] + 0.5) * scale).astype(int).T
    colors = turbo(DEPTH_BINS)[::-1, ::-1][color_rows(result.depth[visible], 0, DEPTH_RANGE, DEPTH_BINS)]
    height, width = picture.shape[:2]
    picture[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)] = colors


def _label(picture: U8, occupied: Bool, text: str, x: int, y: int, color: tuple[int, ...]) -> None:
    """Draw a text above a point, unless another text is there."""
    font, size = cv2.FONT_HERSHEY_SIMPLEX, 0.45
    (width, height), below = cv2.getTextSize(text, font, size, 1)
    x = max(0, min(x, picture.shape[1] - width - 4))
    y = max(y, height + below + 2)
    area = np.s_[y - height - below - 2 : y, x : x + width + 4]
    if occupied[area].any():
        return
    occupied[area] = True
    picture[area] = color
    ink = (0, 0, 0) if sum(color) > 330 else (255, 255, 255)
    cv2.putText(picture, text, (x + 2, y - below), font, size, ink, 1, cv2.LINE_AA)


# --- plots -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Tick:
    """A tick of an axis, at a pixel."""

    at: float
    label: str


@dataclass(frozen=True, slots=True)
class Line:
    """A line in pixels, with the name of its series."""

    name: str
    points: Sequence[tuple[float, float]]


@dataclass(frozen=True, slots=True)
class Plot:
    """A plot. All lengths are in pixels from the top left corner."""

    title: str
    lines: Sequence[Line]
    x_ticks: Sequence[Tick]
    y_ticks: Sequence[Tick]
    mark: float  # column of the marked time
    width: int = WIDTH
    height: int = HEIGHT
    left: int = LEFT  # edge of the area of the lines
    right: int = WIDTH - RIGHT
    top: int = TOP
    bottom: int = HEIGHT - BOTTOM


def plot(title: str, series: Mapping[str, Series], at: float) -> Plot | None:
    """Lay out one line per series over seconds, with a mark at the time ``at``. None: there is no data."""
    nonempty = {name: points for name, points in series.items() if points}
    if not nonempty:
        return None
    x, y = np.array([point for points in nonempty.values() for point in points], np.float64).T
    bottom, top = min(y.min(), 0.0), max(y.max(), 0.0)
    x_ticks, y_ticks = ticks(x.min(), x.max(), 6), ticks(bottom, top if top > bottom else 1.0, 4)
    left, right = min(x.min(), at), max(x.max(), at, x.min() + 1e-9)
    low, high = y_ticks[0], y_ticks[-1]

    def column(value: float) -> float:
        return round(float(LEFT + (value - left) / (right - left) * (WIDTH - LEFT - RIGHT)), 1)

    def row(value: float) -> float:
        return round(float(HEIGHT - BOTTOM - (value - low) / (high - low) * (HEIGHT - TOP - BOTTOM)), 1)

    return Plot(
        title=title,
        lines=[
            Line(name, [(column(seconds), row(number)) for seconds, number in points])
            for name, points in nonempty.items()
        ],
        x_ticks=[Tick(column(tick), f"{tick:g} s") for tick in x_ticks if left <= tick <= right],
        y_ticks=[Tick(row(tick), f"{tick:g}") for tick in y_ticks],
        mark=column(at),
    )


def ticks(low: float, high: float, count: int) -> list[float]:
    """Return about ``count`` round numbers that enclose ``low`` to ``high``, at least two.

    >>> ticks(0, 9.3, 4)
    [0.0, 2.5, 5.0, 7.5, 10.0]
    """
    span = max(float(high - low), abs(float(high)) * 1e-9, 1e-9)
    power = 10.0 ** np.floor(np.log10(span / count))
    step = float(
        power * next(factor for factor in (1, 2, 2.5, 5, 10, 20) if factor * power * count >= span * 0.999)
    )
    first, last = int(np.floor(low / step + 1e-9)), int(np.ceil(high / step - 1e-9))
    return [round(n * step, 12) for n in range(first, max(last, first + 1) + 1)]
