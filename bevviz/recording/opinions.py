"""Log the opinions of cameras on external objects, and the objects of our fusion for comparison."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr

from bevviz.model import geometry
from bevviz.model.counts import OPINIONS as COUNTED
from bevviz.model.frame import F32, F64, I64, Boxes3D, Camera
from bevviz.model.results import FrameResult, Objects, Opinion
from bevviz.recording import entities
from bevviz.recording.health import COUNTS
from bevviz.recording.images import bev_pixels, ground_outlines, image_frame
from bevviz.recording.labels import (
    FROM_ABOVE,
    IN_IMAGE,
    LETTER_WIDTH,
    choose_named,
    choose_named_in_3d,
    log_box_labels,
    log_labelled_outlines,
    log_name_style,
)
from bevviz.recording.primitives import (
    CORNER,
    OUTLINE,
    boxes3d,
    image_outlines,
    scored,
    texts_by_row,
    transform,
)
from bevviz.recording.writer import Writer
from bevviz.support.colors import OPINION_COLORS, SERIES_COLORS, Color, StateColor, class_color

SHARED_OBJECT_BRIGHTNESS = 0.65  # factor on the class colour of objects that both methods have
MISSED = "missed"
NAMED_OPINIONS = ("contradicted", "named otherwise", MISSED)  # opinions whose objects get a name

_DOUBT_COLORS = {
    opinion: OPINION_COLORS[opinion.word] for opinion in (Opinion.CONTRADICTED, Opinion.NAMED_OTHERWISE)
}


def log_opinion_style(to: Writer, cameras: Iterable[str]) -> None:
    """Log the static style of opinions. Lines are thinner than those of the objects."""
    thin = rr.Radius.ui_points(0.5)
    to.static(entities.FUSION, rr.Boxes3D.from_fields(radii=thin, show_labels=False, fill_mode=OUTLINE))
    lines = rr.LineStrips3D.from_fields(radii=rr.Radius.ui_points(1.0))
    to.static(entities.OUTLINES.path(entities.FUSION), lines)
    points = rr.Points3D.from_fields(
        radii=rr.Radius.ui_points(0.0), colors=[StateColor.DOUBTFUL.value], show_labels=True
    )
    to.static(entities.NAMES.path(entities.FUSION), points)
    for camera in cameras:
        for opinion in OPINION_COLORS:
            path = entities.IMAGE_OPINION.path(camera, opinion)
            _log_outline_style(to, path, opinion)
            if to.root:
                for entity in (path, entities.NAMES.path(path)):
                    to.static(entity, image_frame(camera))
    for opinion in OPINION_COLORS:
        _log_outline_style(to, entities.OVERLAY_OPINION.path(opinion), opinion)
    for name, color in zip(COUNTED, SERIES_COLORS[len(COUNTS) :], strict=False):
        to.static(entities.COUNT.path(name), rr.SeriesLines(colors=[color], widths=[1.5]))


def log_fusion(to: Writer, result: FrameResult) -> None:
    """Log the objects of our fusion. Objects that the method has too are dim. Missed objects have a name."""
    opinions = result.opinions
    if opinions is None or not len(opinions.fused):
        return
    fused, missed = opinions.fused, opinions.missed
    reasons = texts_by_row(result.explanations, "fused")
    labels = scored(fused.names, fused.score)
    colors = [
        class_color(name) if is_missed else _dim(class_color(name))
        for name, is_missed in zip(fused.names, missed.tolist(), strict=True)
    ]
    to.put(
        entities.FUSION,
        transform(result.frame.pose),
        boxes3d(fused.boxes, np.arange(len(fused)), labels, colors=colors),
        rr.AnyValues(
            class_name=list(fused.names),
            score=fused.score,
            cluster=fused.cluster,
            camera=list(fused.camera),
            missed=missed,
            reason=[reasons.get(row, "") for row in range(len(fused))],
        ),
    )
    has_name = choose_named_in_3d(fused.boxes.center, missed) & missed
    log_box_labels(
        to,
        entities.FUSION,
        fused.boxes,
        [f"{label}, missed" if is_named else "" for label, is_named in zip(labels, has_name, strict=True)],
        [reasons.get(row, label) for row, label in enumerate(labels)],
        colors,
    )


# --- in the images and from above --------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class OpinionOutlines:
    """Outlines of the objects in a view that share one opinion.

    Attributes:
        opinion: one of ``OPINION_COLORS``.
        rows: rows in the method's objects; for missed objects, rows in the objects of our fusion.
        strokes: (M, 2) pixels of each outline.
    """

    opinion: str
    rows: list[int]
    strokes: list[F32]


def opinion_outlines_in_image(result: FrameResult, camera: Camera) -> Mapping[str, OpinionOutlines]:
    """Return the outlines of objects in a camera's image, by the entity of their opinion."""
    return {
        entities.IMAGE_OPINION.path(camera.name, opinion): outlines
        for opinion, boxes, rows in _by_opinion(result)
        if (outlines := _visible_outlines(opinion, rows, image_outlines(boxes.chosen(rows), camera))).rows
    }


def opinion_outlines_in_bev(result: FrameResult) -> Mapping[str, OpinionOutlines]:
    """Return the outlines of objects in the bird's-eye view, by the entity of their opinion.

    Only objects with their centre in the view count.
    """
    config = result.config.bev
    reach = np.array([config.range_x, config.range_y], np.float32)
    outlines_by_entity = {}
    for opinion, boxes, all_rows in _by_opinion(result):
        rows = all_rows[(np.abs(boxes.center[all_rows, :2]) < reach).all(axis=1)]
        if len(rows):
            outlines = ground_outlines(geometry.corners(boxes.chosen(rows)))
            strokes = [*bev_pixels(config, np.eye(4), outlines)]
            outlines_by_entity[entities.OVERLAY_OPINION.path(opinion)] = OpinionOutlines(
                opinion, rows.tolist(), strokes
            )
    return outlines_by_entity


def log_opinions_in_images(to: Writer, result: FrameResult) -> None:
    """Log object outlines over each image, in the colour of the cameras' opinion."""
    for camera_result in result.cameras if result.opinions is not None else ():
        camera = camera_result.camera
        if (outlines := opinion_outlines_in_image(result, camera)) and camera.intrinsics is not None:
            width = camera.intrinsics.width
            layout = _NameLayout(np.array(IN_IMAGE) * width, LETTER_WIDTH * width, CORNER, over=True)
            _log_outlines(to, result, outlines, layout)


def log_opinions_in_bev(to: Writer, result: FrameResult) -> None:
    """Log object outlines over the bird's-eye image, which has the names of the method's objects already."""
    if result.opinions is not None:
        room = np.array(FROM_ABOVE) / result.config.bev.resolution
        _log_outlines(to, result, opinion_outlines_in_bev(result), _NameLayout(room, 0.0, 0.0, over=False))


def _by_opinion(result: FrameResult) -> Iterator[tuple[str, Boxes3D, I64]]:
    """Yield each opinion with the boxes it may refer to, and the rows of the boxes that have it."""
    opinions, objects = result.opinions, result.objects
    if opinions is None or objects is None:
        return
    words = np.array([Opinion(value).word for value in opinions.opinion.tolist()], np.str_)
    for opinion in OPINION_COLORS:
        if opinion == MISSED:
            yield opinion, opinions.fused.boxes, np.flatnonzero(opinions.missed)
        else:
            yield opinion, objects.boxes, np.flatnonzero(words == opinion)


def _visible_outlines(opinion: str, rows: I64, strokes: Sequence[F32]) -> OpinionOutlines:
    """Return the outlines that are in the view."""
    shown = [(row, stroke) for row, stroke in zip(rows.tolist(), strokes, strict=True) if len(stroke)]
    return OpinionOutlines(opinion, [row for row, _ in shown], [stroke for _, stroke in shown])


@dataclass(frozen=True, slots=True)
class _NameLayout:
    """Layout of names in a view.

    Attributes:
        room: (2,) width and height of a name in pixels.
        letter: width of a letter of a longer name, in pixels.
        corner: Rerun's offset of a pixel.
        over: write names above the outlines, as detections have theirs below; False: below the outlines.
    """

    room: F64
    letter: float
    corner: float
    over: bool

    def place(self, stroke: F32) -> tuple[float, float]:
        """Return the centre of the name's upper edge in pixels."""
        (left, top), (right, bottom) = stroke.min(axis=0).tolist(), stroke.max(axis=0).tolist()
        return (left + right) / 2, max(top - float(self.room[1]), 0.0) if self.over else bottom


def _log_outlines(
    to: Writer, result: FrameResult, outlines_by_entity: Mapping[str, OpinionOutlines], layout: _NameLayout
) -> None:
    """Log outlines, and names of doubtful objects as long as names do not overlap.

    Missed objects come last, because their detection has a name already. Among the others the nearest comes
    first.
    """
    doubtful = [outlines for outlines in outlines_by_entity.values() if outlines.opinion in NAMED_OPINIONS]
    places = np.array(
        [layout.place(stroke) for outlines in doubtful for stroke in outlines.strokes], np.float32
    )
    centers = [
        _indexed_objects(result, outlines.opinion).boxes.center[outlines.rows, :2] for outlines in doubtful
    ]
    distances = np.hypot(*np.concatenate([np.zeros((0, 2), np.float32), *centers]).T)
    is_contradicted = np.array(
        [outlines.opinion != MISSED for outlines in doubtful for _ in outlines.rows], bool
    )
    letters = [len(name) for outlines in doubtful for name in _outline_names(result, outlines)]
    across = np.maximum(layout.room[0], layout.letter * np.array(letters, np.float64))
    named = iter(
        choose_named(
            places.reshape(-1, 2), distances, (across, float(layout.room[1])), is_contradicted
        ).tolist()
    )
    for path, outlines in outlines_by_entity.items():
        subject = "fused" if outlines.opinion == MISSED else "object"
        sentences = texts_by_row(result.explanations, subject)
        names = _outline_names(result, outlines)
        has_name = (
            [next(named) for _ in names] if outlines.opinion in NAMED_OPINIONS else [False] * len(names)
        )
        log_labelled_outlines(
            to,
            path,
            [stroke + np.float32(layout.corner) for stroke in outlines.strokes],
            [name if is_named else "" for name, is_named in zip(names, has_name, strict=True)],
            [sentences.get(row, name) for row, name in zip(outlines.rows, names, strict=True)],
            np.array([layout.place(stroke) for stroke in outlines.strokes], np.float32),
        )


def _outline_names(result: FrameResult, outlines: OpinionOutlines) -> list[str]:
    objects = _indexed_objects(result, outlines.opinion)
    return [f"{objects.names[row]} {outlines.opinion}" for row in outlines.rows]


def _indexed_objects(result: FrameResult, opinion: str) -> Objects:
    """Return the ``Objects`` that the rows of this opinion index."""
    assert result.opinions is not None and result.objects is not None
    return result.opinions.fused if opinion == MISSED else result.objects


def _log_outline_style(to: Writer, path: str, opinion: str) -> None:
    is_doubtful = opinion in NAMED_OPINIONS
    radius, order = (2.0, 34.0) if is_doubtful else (0.75, 33.0)
    style = rr.LineStrips2D.from_fields(
        colors=[OPINION_COLORS[opinion]], radii=rr.Radius.ui_points(radius), draw_order=order
    )
    to.static(path, style)
    if is_doubtful:
        log_name_style(to, path, order + 1)


# --- in space ----------------------------------------------------------------------------------


def outline_colors(result: FrameResult, colors: Sequence[Color]) -> list[Color]:
    """Return the colours of the objects' outlines. Doubtful objects have a colour of their own."""
    if result.opinions is None:
        return [*colors]
    opinions = map(Opinion, result.opinions.opinion.tolist())
    return [_DOUBT_COLORS.get(opinion, color) for opinion, color in zip(opinions, colors, strict=True)]


def _dim(color: Color) -> Color:
    red, green, blue = (round(SHARED_OBJECT_BRIGHTNESS * value) for value in color)
    return red, green, blue
