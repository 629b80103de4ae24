"""Log the opinions of cameras on external objects, and the objects of our fusion for comparison."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bevviz.model.frame import F32, I64, Boxes3D, Camera
from bevviz.model.results import FrameResult, Objects, Opinion, texts_by_row
from bevviz.recording import entities
from bevviz.recording.addresses import Rows
from bevviz.recording.labels import NameRoom, choose_named_in_3d, shown, under
from bevviz.recording.layers import Layer, Style, callouts, draw, name_layers
from bevviz.recording.primitives import CORNER, scored, transform
from bevviz.recording.projection import bev_outlines, bounds_of, image_outlines
from bevviz.recording.writer import Writer
from bevviz.support.colors import OPINION_COLORS, Color, StateColor, class_color

SHARED_OBJECT_BRIGHTNESS = 0.65  # factor on the class colour of objects that both methods have
MISSED = "missed"
NAMED_OPINIONS = ("contradicted", "named otherwise", MISSED)  # opinions whose objects get a name

_DOUBT_COLORS = {
    opinion: OPINION_COLORS[opinion.word] for opinion in (Opinion.CONTRADICTED, Opinion.NAMED_OTHERWISE)
}


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
    has_name = choose_named_in_3d(fused.boxes.center, missed) & missed
    addresses = Rows("detection", fused.detection, fused.camera)
    draw(
        to,
        Layer(
            entities.FUSION,
            fused.boxes,
            Style(width=0.5, labels=False, wire=True),
            labels=labels,
            colors=colors,
            values={
                "class_name": list(fused.names),
                "score": fused.score,
                "cluster": fused.cluster,
                "camera": list(fused.camera),
                "missed": missed,
                "reason": [reasons.get(row, "") for row in range(len(fused))],
            },
            frame=transform(result.frame.pose),
            rows=addresses,
        ),
        *callouts(
            entities.FUSION,
            fused.boxes,
            [reasons.get(row, label) for row, label in enumerate(labels)],
            shown([f"{label}, missed" for label in labels], has_name),
            colors,
            Style(width=1.0),
            name_color=StateColor.DOUBTFUL.value,
            rows=addresses,
        ),
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
    outlines_by_entity = {}
    for opinion, boxes, rows in _by_opinion(result):
        inside, strokes = bev_outlines(result.config.bev, boxes.chosen(rows))
        if len(inside):
            outlines = OpinionOutlines(opinion, rows[inside].tolist(), [*strokes])
            outlines_by_entity[entities.OVERLAY_OPINION.path(opinion)] = outlines
    return outlines_by_entity


def log_opinions_in_images(to: Writer, result: FrameResult) -> None:
    """Log object outlines over each image, in the colour of the cameras' opinion."""
    for camera_result in result.cameras if result.opinions is not None else ():
        camera = camera_result.camera
        if camera.intrinsics is not None:
            outlines = opinion_outlines_in_image(result, camera)
            _log_outlines(to, result, outlines, NameRoom.in_image(camera.intrinsics.width), camera.name)


def log_opinions_in_bev(to: Writer, result: FrameResult) -> None:
    """Log object outlines over the bird's-eye image, which has the names of the method's objects already."""
    if result.opinions is not None:
        room = NameRoom.from_above(result.config.bev.resolution)
        _log_outlines(to, result, opinion_outlines_in_bev(result), room, None)


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


def _log_outlines(
    to: Writer,
    result: FrameResult,
    outlines_by_entity: Mapping[str, OpinionOutlines],
    room: NameRoom,
    camera: str | None,
) -> None:
    """Log outlines, and names of doubtful objects as long as names do not overlap.

    Missed objects come last, because their detection has a name already. Among the others the nearest comes
    first. Names in an image are above the outlines, because detections have theirs below.
    """

    def places(outlines: OpinionOutlines) -> F32:
        bounds = bounds_of(outlines.strokes)
        return under(bounds) if camera is None else room.over(bounds)

    doubtful = [outlines for outlines in outlines_by_entity.values() if outlines.opinion in NAMED_OPINIONS]
    named = iter(())
    if doubtful:
        boxes = [
            _indexed_objects(result, outlines.opinion).boxes.chosen(outlines.rows) for outlines in doubtful
        ]
        is_first = [outlines.opinion != MISSED for outlines in doubtful for _ in outlines.rows]
        named = iter(
            room.choose(
                np.concatenate([places(outlines) for outlines in doubtful]),
                [name for outlines in doubtful for name in _outline_names(result, outlines)],
                Boxes3D.joined(boxes).distance,
                np.array(is_first, np.bool_),
            ).tolist()
        )
    for path, outlines in outlines_by_entity.items():
        names, opinion = _outline_names(result, outlines), outlines.opinion
        sentences = texts_by_row(result.explanations, "fused" if opinion == MISSED else "object")
        says = [sentences.get(row, name) for row, name in zip(outlines.rows, names, strict=True)]
        is_doubtful = opinion in NAMED_OPINIONS
        width, order = (2.0, 34.0) if is_doubtful else (0.75, 33.0)
        style = Style(OPINION_COLORS[opinion], width, order=order)
        strokes = outlines.strokes
        if camera is not None:
            strokes = [stroke + np.float32(CORNER) for stroke in strokes]
        chosen = [name if is_doubtful and next(named) else "" for name in names]
        addresses = _addresses(result, outlines)
        draw(
            to,
            Layer(path, strokes, style, says=says, frame=camera, rows=addresses),
            *name_layers(path, places(outlines), chosen, says, order, frame=camera, rows=addresses),
        )


def _addresses(result: FrameResult, outlines: OpinionOutlines) -> Rows:
    """Return the rows that outlines show: objects, and for missed ones the detections of our fusion."""
    if outlines.opinion != MISSED:
        return Rows("object", outlines.rows)
    fused = _indexed_objects(result, MISSED)
    return Rows("detection", fused.detection[outlines.rows], [fused.camera[row] for row in outlines.rows])


def _outline_names(result: FrameResult, outlines: OpinionOutlines) -> list[str]:
    objects = _indexed_objects(result, outlines.opinion)
    return [f"{objects.names[row]} {outlines.opinion}" for row in outlines.rows]


def _indexed_objects(result: FrameResult, opinion: str) -> Objects:
    """Return the ``Objects`` that the rows of this opinion index."""
    assert result.opinions is not None and result.objects is not None
    return result.opinions.fused if opinion == MISSED else result.objects


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
