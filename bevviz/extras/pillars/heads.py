"""Decode a network's maps to boxes, relative to anchors (PointPillars) or to centres (CenterPoint).

The names that exporters use and the numbers of channels that follow from the parameters identify each output.
A network that fits in no way or in two ways is refused, because boxes read from the wrong channels look like
a bad detector.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from bevviz.extras.pillars.params import PillarParams
from bevviz.model.frame import F32, F64, I64
from bevviz.stages.detector.session import list_tensors

MAX_LOG_SIZE = 10.0  # largest logarithm of a size; larger values would overflow


class Candidates(NamedTuple):
    """Boxes before suppression.

    Attributes:
        boxes: (K, 7) x, y, z of the centre, length, width, height, yaw, in the network's frame.
        score: (K,).
        class_id: (K,) rows of the class names.
        group: (K,) head that each box comes from.
    """

    boxes: F64
    score: F32
    class_id: I64
    group: I64


class Head(Protocol):
    """Reader of a network's outputs for one cloud."""

    @property
    def wanted(self) -> tuple[str, ...]:
        """Names of the outputs to read."""

    def candidates(self, outputs: Mapping[str, Any]) -> Candidates:
        """Return the boxes with a sufficient score.

        Raises:
            ValueError: the numbers contradict the parameters.
        """


def find_head(outputs: Mapping[str, Any], params: PillarParams) -> Head:
    """Find out how to read the outputs.

    Args:
        outputs: name -> array, for any cloud.
        params: parameters of the network.

    Raises:
        ValueError: the outputs cannot be read. The message says why and which outputs were expected.
    """
    try:
        return _find_anchors(outputs, params) if params.anchors else _find_centers(outputs, params)
    except ValueError as error:
        shapes = list_tensors((name, np.shape(output)) for name, output in outputs.items())
        raise ValueError(f"{error}; its outputs: {shapes}") from None


# --- maps --------------------------------------------------------------------------------------


class OutputMap(NamedTuple):
    """Output with C channels on a grid."""

    name: str
    last: bool  # the channels are the last axis, otherwise the second

    def at(self, outputs: Mapping[str, Any], cells: I64 | slice = slice(None)) -> F32:
        """Return the (K, C) channels of these cells. Cells are counted along x first."""
        array = outputs[self.name][0]
        if self.last:
            return np.asarray(array.reshape(-1, array.shape[-1])[cells], np.float32)
        return np.ascontiguousarray(array.reshape(len(array), -1)[:, cells].T, np.float32)


def _check_map(
    outputs: Mapping[str, Any], name: str, channels: tuple[int, ...], params: PillarParams
) -> OutputMap:
    """Check that an output is a map with one of these numbers of channels."""
    shape = np.shape(outputs[name])
    wanted = " or ".join(map(str, channels))
    if len(shape) != 4 or shape[0] != 1:
        raise ValueError(f"output {name} is no map of one cloud, [1, {wanted}, y, x]")
    fits = [
        last
        for last in (False, True)
        if shape[3 if last else 1] in channels and _stride(shape[1:3] if last else shape[2:], params)
    ]
    if not fits:
        nx, ny = params.grid
        raise ValueError(
            f"output {name} should be [1, {wanted}, {ny} / s, {nx} / s] or the same with the channels last, "
            f"by classes, anchors and the {nx} x {ny} pillars of point_range and voxel_size"
        )
    if len(fits) == 2:
        raise ValueError(f"output {name} can be read with its channels second or last")
    return OutputMap(name, fits[0])


def _stride(cells: tuple[int, ...], params: PillarParams) -> int:
    """Return the number of pillars along the edge of a map's cell, 0 if the map does not fit the grid."""
    (nx, ny), (height, width) = params.grid, cells
    if height < 1 or width < 1 or nx % width or ny % height or nx // width != ny // height:
        return 0
    return nx // width


def _grid(outputs: Mapping[str, Any], output_map: OutputMap) -> tuple[int, int]:
    """Return the number of cells along y and x."""
    shape = outputs[output_map.name].shape
    return (shape[1], shape[2]) if output_map.last else (shape[2], shape[3])


def _same_grid(outputs: Mapping[str, Any], maps: list[OutputMap]) -> tuple[int, int]:
    """Return the grid of the maps, or raise a ValueError if they differ."""
    grids = {_grid(outputs, output_map) for output_map in maps}
    if len(grids) != 1:
        raise ValueError("its maps have different grids")
    return grids.pop()


def _scores(values: F32, params: PillarParams) -> F32:
    """Return scores from 0 to 1 from a map of logits or probabilities."""
    if not values.size:
        return values
    low, high = float(values.min()), float(values.max())
    if not np.isfinite([low, high]).all():
        raise ValueError("its scores are not finite")
    if params.scores == "logits":
        if low >= 0 and high <= 1:
            raise ValueError(
                "its scores all are from 0 to 1, which logits are not: set objects.scores to probabilities"
            )
        with np.errstate(over="ignore"):
            return np.asarray(1 / (1 + np.exp(-values)), np.float32)
    if low < 0 or high > 1:
        raise ValueError(
            f"it scores {low:.3g} to {high:.3g}, which are no probabilities: set objects.scores to logits"
        )
    return values


def _thresholds(params: PillarParams) -> F32:
    """Return the score threshold of each class."""
    thresholds = [params.score_thresholds.get(name, params.score_threshold) for name in params.classes]
    return np.array(thresholds, np.float32)


def _best(score: F32, count: int) -> I64:
    """Return the rows of the ``count`` best scores, best first. Equal scores keep their order."""
    if len(score) > count:
        rows = np.flatnonzero(score >= np.partition(score, -count)[-count])
    else:
        rows = np.arange(len(score))
    return rows[np.argsort(-score[rows], kind="stable")][:count]


def _select_scores(score: F32, params: PillarParams) -> tuple[I64, I64]:
    """Return rows and classes of sufficient scores among the best ``nms_candidates`` rows.

    ``score`` is (N, C).
    """
    rows = _best(score.max(axis=1), params.nms_candidates)
    enough = score[rows] >= _thresholds(params)
    if params.labels == "best":
        best = score[rows].argmax(axis=1)
        kept = enough[np.arange(len(rows)), best]
        return rows[kept], best[kept]
    row, class_id = np.nonzero(enough)
    return rows[row], class_id


# --- boxes relative to anchors -----------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Anchors:
    """Reader of maps of scores, boxes and optional directions relative to anchors.

    It follows ``DeltaXYZWLHRBBoxCoder`` and ``Anchor3DHead`` of mmdetection3d, and ``ResidualCoder`` and
    ``AnchorHeadSingle`` of OpenPCDet.
    """

    score: OutputMap
    box: OutputMap
    direction: OutputMap | None
    anchors: F64  # (A, 7) x, y, z of the centre, length, width, height, yaw
    params: PillarParams

    @property
    def wanted(self) -> tuple[str, ...]:
        """Names of the outputs to read."""
        return tuple(
            output_map.name for output_map in (self.score, self.box, self.direction) if output_map is not None
        )

    def candidates(self, outputs: Mapping[str, Any]) -> Candidates:
        """Return the boxes with a sufficient score. See ``Head.candidates``."""
        params, each = self.params, len(self.params.anchors) * len(self.params.rotations)
        score = _scores(self.score.at(outputs).reshape(len(self.anchors), len(params.classes)), params)
        rows, class_id = _select_scores(score, params)
        cells, which = rows // each, (np.arange(len(rows)), rows % each)
        columns = self.box.at(outputs, cells)
        deltas = columns.reshape(len(rows), each, columns.shape[1] // each)[which][:, :7]
        boxes = decode_boxes(deltas.astype(np.float64), self.anchors[rows])
        if self.direction is not None:
            facing = self.direction.at(outputs, cells).reshape(len(rows), each, 2)[which].argmax(axis=1)
            boxes[:, 6] = resolve_direction(boxes[:, 6], facing, params)
        return Candidates(boxes, score[rows, class_id], class_id, np.zeros(len(rows), np.int64))


def anchor_boxes(shape: tuple[int, int], params: PillarParams) -> F64:
    """Return the anchors of a map with (ny, nx) cells as (ny * nx * anchors * rotations, 7).

    Rotations vary fastest.
    """
    low_x, low_y, high_x, high_y = params.anchor_range or (*params.point_range[:2], *params.point_range[3:5])

    def along(low: float, high: float, count: int) -> F64:
        if params.anchor_places == "edge_to_edge":
            return np.linspace(low, high, count)
        return low + (np.arange(count) + 0.5) * (high - low) / count

    grid = np.empty((*shape, len(params.anchors), len(params.rotations), 7))
    grid[..., 0] = along(low_x, high_x, shape[1])[None, :, None, None]
    grid[..., 1] = along(low_y, high_y, shape[0])[:, None, None, None]
    size = np.array(params.anchors)
    grid[..., 2] = (size[:, 3] + size[:, 2] / 2)[:, None]
    grid[..., 3:6] = size[:, None, :3]
    grid[..., 6] = params.rotations
    return grid.reshape(-1, 7)


def decode_boxes(deltas: F64, anchors: F64) -> F64:
    """Return the (K, 7) boxes of offsets relative to these anchors (Yan et al. 2018, SECOND)."""
    diagonal = np.hypot(anchors[:, 3], anchors[:, 4])[:, None]
    boxes = np.empty_like(anchors)
    boxes[:, :2] = deltas[:, :2] * diagonal + anchors[:, :2]
    boxes[:, 2] = deltas[:, 2] * anchors[:, 5] + anchors[:, 2]
    boxes[:, 3:6] = np.exp(np.minimum(deltas[:, 3:6], MAX_LOG_SIZE)) * anchors[:, 3:6]
    boxes[:, 6] = deltas[:, 6] + anchors[:, 6]
    return boxes


def resolve_direction(yaw: F64, facing: I64, params: PillarParams) -> F64:
    """Resolve a yaw that is known up to half a turn by the direction that the network chose."""
    offset = params.direction_offset or 0.0
    half = yaw - offset
    half = half - np.floor(half / np.pi + params.direction_limit_offset) * np.pi
    return np.asarray(half + offset + np.pi * facing)


ROLES: dict[str, Callable[[str], object]] = {
    "score": re.compile(r"^(?!.*dir).*(cls|score|conf|heatmap)").search,
    "box": re.compile(r"^(?!.*(dir|cls)).*(box|reg|loc)").search,
    "direction": re.compile(r"dir").search,
}


def _roles(outputs: Mapping[str, Any], channels: Mapping[str, tuple[int, ...]]) -> dict[str, str]:
    """Return role -> output, by the names or else by the numbers of channels."""
    named = {role: [o for o in outputs if matches_role(o.lower())] for role, matches_role in ROLES.items()}
    if len(named["score"]) == 1 and len(named["box"]) == 1 and len(named["direction"]) <= 1:
        return {role: matches[0] for role, matches in named.items() if matches}
    matches: dict[str, str] = {}
    for role, counts in channels.items():
        fits = [o for o, a in outputs.items() if np.ndim(a) == 4 and set(np.shape(a)[1:]) & set(counts)]
        if len(fits) == 1 and fits[0] not in matches.values():
            matches[role] = fits[0]
    if {"score", "box"} <= set(matches) and len(matches) == len(outputs):
        return matches
    raise ValueError("neither names nor shapes tell which output has scores, boxes and directions")


def _find_anchors(outputs: Mapping[str, Any], params: PillarParams) -> Anchors:
    """Make the reader of a network with anchors."""
    if params.anchor_places is None:
        raise ValueError(
            "it works with anchors, and objects.anchor_places is not set: cell_centers or edge_to_edge"
        )
    each = len(params.anchors) * len(params.rotations)
    channels = {
        "score": (each * len(params.classes),),
        "box": (each * 7, each * 9),  # 9 channels include a velocity
        "direction": (each * 2,),
    }
    roles = _roles(outputs, channels)
    maps = {role: _check_map(outputs, name, channels[role], params) for role, name in roles.items()}
    shape = _same_grid(outputs, list(maps.values()))
    if "direction" in maps and params.direction_offset is None:
        raise ValueError(
            f"output {roles['direction']} tells front from back, and objects.direction_offset is not set"
        )
    return Anchors(maps["score"], maps["box"], maps.get("direction"), anchor_boxes(shape, params), params)


# --- boxes relative to centres -----------------------------------------------------------------

BOX_CHANNELS = {  # property of a box -> number of channels, and the names that exporters use
    "score": (0, ("heatmap", "hm")),
    "offset": (2, ("reg", "center")),
    "z": (1, ("height", "center_z", "z")),
    "size": (3, ("dim",)),
    "rotation": (2, ("rot",)),
}


@dataclass(frozen=True, slots=True)
class MapChannels:
    """Range of channels of a map."""

    map: OutputMap
    first: int
    count: int

    def at(self, outputs: Mapping[str, Any], cells: I64 | slice = slice(None)) -> F32:
        """Return the (K, count) channels of these cells."""
        return self.map.at(outputs, cells)[:, self.first : self.first + self.count]


@dataclass(frozen=True, slots=True, eq=False)
class Centers:
    """Reader of maps of centre scores and boxes, of one or several heads.

    It follows ``CenterHead`` of mmdetection3d and of OpenPCDet, and Autoware's ``generateBoxes3D_kernel``.
    """

    parts: tuple[Mapping[str, MapChannels], ...]  # for each head, by the keys of BOX_CHANNELS
    shape: tuple[int, int]  # cells along y and x
    params: PillarParams

    @property
    def wanted(self) -> tuple[str, ...]:
        """Names of the outputs to read."""
        return tuple(dict.fromkeys(part.map.name for head in self.parts for part in head.values()))

    def candidates(self, outputs: Mapping[str, Any]) -> Candidates:
        """Return the boxes with a sufficient score. See ``Head.candidates``."""
        candidates, first = [], 0
        for number, head in enumerate(self.parts):
            candidates.append(self._head_candidates(outputs, head, number, first))
            first += head["score"].count
        return Candidates(*(np.concatenate(column) for column in zip(*candidates, strict=True)))

    def _head_candidates(
        self, outputs: Mapping[str, Any], head: Mapping[str, MapChannels], number: int, first: int
    ) -> Candidates:
        """Return the boxes of one head. ``first`` is the class of its first channel."""
        params = self.params
        score = _scores(head["score"].at(outputs), params)
        least = _thresholds(params)[first : first + score.shape[1]]
        if params.labels == "best":
            best = score.argmax(axis=1)
            highest = score[np.arange(len(score)), best]
            rows = np.flatnonzero(highest >= least[best])
            rows = rows[_best(highest[rows], params.nms_candidates)]
            class_id = best[rows]
        else:
            rows, class_id = np.nonzero(score >= least)
            chosen = _best(score[rows, class_id], params.nms_candidates)
            rows, class_id = rows[chosen], class_id[chosen]
        boxes, norm = self._boxes(outputs, head, rows)
        lengths = np.array([params.min_rotation.get(name, 0.0) for name in params.classes])
        clear = norm >= lengths[class_id + first]
        chosen = score[rows, class_id][clear]
        return Candidates(
            boxes[clear], chosen, class_id[clear] + first, np.full(len(chosen), number, np.int64)
        )

    def _boxes(
        self, outputs: Mapping[str, Any], head: Mapping[str, MapChannels], rows: I64
    ) -> tuple[F64, F64]:
        """Return (K, 7) boxes at these cells, and the (K,) lengths of their (sin, cos)."""
        params, (height, width) = self.params, self.shape
        offset, z, size, rotation = (
            head[key].at(outputs, rows).astype(np.float64) for key in ("offset", "z", "size", "rotation")
        )
        low_x, low_y, _, high_x, high_y, _ = params.point_range
        boxes = np.empty((len(rows), 7))
        boxes[:, 0] = (rows % width + offset[:, 0]) * (high_x - low_x) / width + low_x
        boxes[:, 1] = (rows // width + offset[:, 1]) * (high_y - low_y) / height + low_y
        boxes[:, 2] = z[:, 0]
        boxes[:, 3:6] = np.exp(np.minimum(size, MAX_LOG_SIZE))
        sine, cosine = rotation.T if params.rotation == "sin_cos" else rotation.T[::-1]
        boxes[:, 6] = np.arctan2(sine, cosine)
        if params.boxes == "wlh":
            boxes[:, 3:5] = boxes[:, 4:2:-1].copy()
            boxes[:, 6] = -boxes[:, 6] - np.pi / 2
        return boxes, np.hypot(sine, cosine)


def _find_centers(outputs: Mapping[str, Any], params: PillarParams) -> Centers:
    """Make the reader of a network with centres."""
    groups = params.groups or (params.classes,)
    counts = [len(group) for group in groups]
    heads = _find_joined_maps(outputs, counts, params) or _find_separate_maps(outputs, counts, params)
    for key, choices in (("boxes", "lwh or wlh"), ("rotation", "sin_cos or cos_sin")):
        if getattr(params, key) is None:
            raise ValueError(f"it works with centres, and objects.{key} is not set: {choices}")
    maps = [part.map for head in heads for part in head.values()]
    return Centers(tuple(heads), _same_grid(outputs, maps), params)


def _find_separate_maps(
    outputs: Mapping[str, Any], counts: list[int], params: PillarParams
) -> list[dict[str, MapChannels]]:
    """Find a map for each property of each head by name. A number after the name is that of the head."""
    heads = []
    for number, classes in enumerate(counts):
        head = {}
        for key, (channels, names) in BOX_CHANNELS.items():
            count = channels or classes
            name = _find_output(outputs, names, number, len(counts))
            if name is None:
                several = f" of head {number}" if len(counts) > 1 else ""
                raise ValueError(
                    f"no output{several} is called {' or '.join(names)}, as a network of centres has it "
                    "(one of anchors needs objects.anchors)"
                )
            # Some maps have as many uncertainties after the values.
            head[key] = MapChannels(
                _check_map(outputs, name, (count, 2 * count) if channels else (count,), params), 0, count
            )
        heads.append(head)
    return heads


def _find_output(outputs: Mapping[str, Any], names: tuple[str, ...], number: int, of: int) -> str | None:
    """Return the output with one of these names, between an optional graph name and head number."""
    matches = []
    for output in outputs:
        match = re.fullmatch(r"(?:.*[./])?(.+?)(?:[_.]?(\d+))?", output)
        if match is None or match[1].lower() not in names:
            continue
        if (match[2] is None and of == 1) or (match[2] is not None and (of == 1 or int(match[2]) == number)):
            matches.append(output)
    if len(matches) > 1:
        raise ValueError(
            f"{' and '.join(matches)} may both be {names[0]}: set objects.groups, if it has several heads"
        )
    return matches[0] if matches else None


def _find_joined_maps(
    outputs: Mapping[str, Any], counts: list[int], params: PillarParams
) -> list[dict[str, MapChannels]] | None:
    """Find three maps with the channels of all heads one after the other, as mmdeploy exports them."""
    names = {
        role: [o for o in outputs if re.fullmatch(rf"{role}\d*", o)]
        for role in ("cls_score", "bbox_pred", "dir_cls_pred")
    }
    if any(len(parts) != 1 for parts in names.values()):
        return None
    heads = len(counts)
    score = _check_map(outputs, names["cls_score"][0], (sum(counts),), params)
    box = _check_map(outputs, names["bbox_pred"][0], (6 * heads, 8 * heads), params)
    turn = _check_map(outputs, names["dir_cls_pred"][0], (2 * heads,), params)
    each = np.shape(outputs[box.name])[3 if box.last else 1] // heads  # 8 channels include a velocity
    parts = []
    for number, count in enumerate(counts):
        first = number * each
        parts.append(
            {
                "score": MapChannels(score, sum(counts[:number]), count),
                "offset": MapChannels(box, first, 2),
                "z": MapChannels(box, first + 2, 1),
                "size": MapChannels(box, first + 3, 3),
                "rotation": MapChannels(turn, 2 * number, 2),
            }
        )
    return parts
