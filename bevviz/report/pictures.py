"""Small pictures of a frame, and line plots laid out for the SVG in a page's template."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from bevviz.model import geometry
from bevviz.model.frame import F32, F64, I64, U8, Bool, Boxes3D
from bevviz.model.results import Bev, CameraResult, Decision, FrameResult
from bevviz.recording.entities import DEPTH_BINS, DEPTH_RANGE
from bevviz.recording.primitives import edges
from bevviz.support.colors import CONTEXT, GROUND, Color, StateColor, class_color, color_rows, turbo
from bevviz.why import Answer
from bevviz.why.log import COLORS, NAMES, focus_point
from bevviz.why.subject import projected_box

Series = Sequence[tuple[float, float]]  # (x, y) pairs

WIDTH, HEIGHT = 560, 190
LEFT, RIGHT, TOP, BOTTOM = 52, 18, 10, 24  # margins around the lines, pixels

SIDE = 640, 480  # width and height of a picture in 3D or from above, pixels
REACH = 15.0  # metres that a picture from above shows on each side of the sensor, at least
BACK, UP, ASIDE = 9.0, 5.0, 2.5  # metres from the subject to the eye of the picture in 3D
NEAR = 0.5  # metres in front of the eye below which nothing is drawn
BACKGROUND = np.array((18, 14, 13), np.uint8)  # BGR, as in the viewer
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


@dataclass(frozen=True, slots=True)
class MarkedPicture:
    """A picture with the subject of an answer marked, and its caption."""

    picture: U8  # (h, w, 3) BGR
    caption: str


def marked_pictures(result: FrameResult, answer: Answer, width: int) -> list[MarkedPicture]:
    """Return pictures that mark the subject: in each image that shows it, in 3D and from above.

    Args:
        result: result of the frame.
        answer: answer about the subject.
        width: width of the images in pixels.
    """
    marked = []
    for camera in result.cameras:
        picture = _marked_image(camera, answer, width)
        if picture is not None:
            marked.append(MarkedPicture(picture, f"{camera.camera.name}: white is {answer.subject.name}"))
    focus = focus_point(result.frame, answer) if len(answer.fate) == len(result.frame.points) else None
    if focus is None:
        return marked
    counts = np.bincount(answer.fate, minlength=1)
    points = ", ".join(
        f"{counts[fate]} {NAMES[fate]}" for fate in COLORS if len(counts) > fate and counts[fate]
    )
    about = f"white is {answer.subject.name}; of its points: {points}" if points else "it has no points"
    return [
        *marked,
        MarkedPicture(_space(result, answer, focus), f"in 3D, seen from the sensor's side: {about}"),
        MarkedPicture(
            _above(result, answer, focus), "from above, the sensor's front is up; boxes are what was reported"
        ),
    ]


def _marked_image(result: CameraResult, answer: Answer, width: int) -> U8 | None:
    """Return a camera's image with the subject over the kept detections. None: it does not show it."""
    subject, camera = answer.subject, result.camera
    xyxy = subject.xyxy if subject.camera == camera.name else None
    if subject.box is not None:
        xyxy = projected_box(subject.box, camera)
    if xyxy is None or (picture := camera_picture(result, width)) is None or camera.image is None:
        return None
    scale = picture.shape[1] / camera.image.bgr.shape[1]
    x0, y0, x1, y1 = np.round((xyxy + 0.5) * scale - 0.5).astype(int).tolist()
    for color, thickness in (((0, 0, 0), 5), (SUBJECT, 2)):
        cv2.rectangle(picture, (x0 - 2, y0 - 2), (x1 + 2, y1 + 2), color, thickness, cv2.LINE_AA)
    _label(picture, np.zeros(picture.shape[:2], bool), subject.name, x0 - 2, y0 - 4, SUBJECT)
    return picture


def _space(result: FrameResult, answer: Answer, focus: F32) -> U8:
    """Return a picture in perspective, from an eye on the sensor's side of the subject."""
    target = np.asarray(focus, np.float64)
    away = max(float(np.hypot(*target[:2])), 1e-6)
    ahead = np.array([target[0] / away, target[1] / away, 0.0])
    eye = target - BACK * ahead + ASIDE * np.array([-ahead[1], ahead[0], 0.0]) + [0.0, 0.0, UP]
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward])  # rows: right, down and forward
    width, height = SIDE
    middle = np.array([width, height]) / 2

    def project(points: F64) -> F64:
        """Return (N, 3) columns, rows and depths."""
        seen = (points - eye) @ axes.T
        depth = np.maximum(seen[:, 2], NEAR)
        return np.column_stack([seen[:, :2] / depth[:, None] * width * 0.8 + middle, seen[:, 2]])

    return _drawn(result, answer, project, (width, height))


def _above(result: FrameResult, answer: Answer, focus: F32) -> U8:
    """Return a picture from above. x of the points' frame points up, and y to the left."""
    width, height = SIDE
    x, y = focus[:2].tolist()
    ahead, behind, across = max(REACH, 1.25 * x), max(0.2 * REACH, -1.25 * x), max(0.6 * REACH, 1.25 * abs(y))
    scale = min(height / (ahead + behind), width / 2 / across)
    origin = np.array([width / 2, ahead * scale])

    def project(points: F64) -> F64:
        """Return (N, 3) columns, rows and heights; a greater height is drawn later."""
        pixels = origin - scale * points[:, 1::-1]
        return np.column_stack([pixels, 1000.0 - points[:, 2]])

    picture = _drawn(result, answer, project, (width, height))
    u, v = origin.astype(int).tolist()
    cv2.drawMarker(picture, (u, v), CONTEXT, cv2.MARKER_TRIANGLE_UP, 12, 2)
    return picture


def _drawn(result: FrameResult, answer: Answer, project: Callable[[F64], F64], size: tuple[int, int]) -> U8:
    """Draw points, reported boxes and the subject.

    Args:
        result: result of the frame.
        answer: answer about the subject.
        project: returns (N, 3) columns, rows and depths of (N, 3) points.
        size: width and height in pixels.
    """
    width, height = size
    picture = np.empty((height, width, 3), np.uint8)
    picture[:] = BACKGROUND
    _scatter(picture, project(result.frame.points.astype(np.float64)), GROUND)
    if result.obstacles is not None:
        _scatter(picture, project(result.obstacles.astype(np.float64)), CONTEXT)
    for fate, color in COLORS.items():
        own = result.frame.points[answer.fate == fate]
        _scatter(picture, project(own.astype(np.float64)), color, 2)
    occupied = np.zeros((height, width), bool)
    objects = result.objects
    for row in range(0 if objects is None else len(objects.names)):
        assert objects is not None
        box = objects.boxes.chosen(np.array([row]))
        _outline(picture, project, box, class_color(objects.names[row]), 1)
    if answer.subject.box is not None:
        _outline(picture, project, answer.subject.box, SUBJECT, 2)
        corners = project(geometry.corners(answer.subject.box)[0].astype(np.float64))
        x, y = corners[:, 0].min(), corners[:, 1].min() - 4
    else:
        x, y, _ = project(np.asarray(focus_point(result.frame, answer), np.float64)[None])[0]
        cv2.circle(picture, (int(x), int(y)), 12, SUBJECT, 2, cv2.LINE_AA)
        y -= 16
    _label(picture, occupied, answer.subject.name, int(x), int(y), SUBJECT)
    return picture


def _scatter(picture: U8, pixels: F64, color: Color, size: int = 1) -> None:
    """Draw points as squares of ``size`` pixels."""
    height, width = picture.shape[:2]
    inside = (pixels[:, 2] > NEAR) & (np.abs(pixels[:, :2]) < 1e5).all(axis=1)
    columns, rows = np.floor(pixels[inside, :2]).astype(np.int64).T
    for right in range(size):
        for down in range(size):
            _set_pixels(picture, rows + down, columns + right, height, width, color)


def _set_pixels(picture: U8, rows: I64, columns: I64, height: int, width: int, color: Color) -> None:
    """Set the pixels that are inside the picture."""
    seen = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    picture[rows[seen], columns[seen]] = color[::-1]


def _outline(picture: U8, project: Callable[[F64], F64], box: Boxes3D, color: Color, thickness: int) -> None:
    """Draw the edges of one box, but none that is behind the eye."""
    strip = project(edges(geometry.corners(box)[0]).astype(np.float64))
    for start, end in pairwise(strip):
        if min(start[2], end[2]) > NEAR and np.abs(np.concatenate([start[:2], end[:2]])).max() < 1e4:
            first, last = (tuple(np.round(end_[:2]).astype(int).tolist()) for end_ in (start, end))
            cv2.line(picture, first, last, color[::-1], thickness, cv2.LINE_AA)


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
