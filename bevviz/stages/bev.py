"""Bird's-eye view: a raster of the points seen from above, with boxes and labels on top."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bevviz.config import BevConfig
from bevviz.model.frame import F32, I32, U8, Bool, Boxes3D
from bevviz.model.geometry import corners
from bevviz.model.results import Bev, Clusters, Objects
from bevviz.support.colors import class_color, turbo
from bevviz.support.numba_kernel import kernel

UNKNOWN, FREE, OCCUPIED = -1, 0, 100  # values of the occupancy channel, as in nav_msgs/OccupancyGrid

# Colours are BGR.
_POINT = (200, 200, 200)
_RED, _GREEN = (0, 0, 255), (0, 255, 0)
_BACKGROUND, _RING, _CAPTION = (26, 20, 18), (58, 48, 44), (130, 118, 110)
_GROUND, _UNNAMED = (120, 106, 92), (150, 150, 150)
_HEIGHT_SPAN = 3.0  # metres above the ground that the colour map of the rich style spans


def bev(
    points: F32,
    intensity: NDArray[Any] | None,
    ground: Bool | None,
    objects: Objects | None,
    clusters: Clusters | None,
    config: BevConfig,
) -> Bev:
    """Raster the points from above: row 0 is ``range_x`` ahead, column 0 is ``range_y`` to the left.

    A point falls into column ``floor((range_y - y) / resolution)`` and row
    ``floor((range_x - x) / resolution)``, computed in float32 like the points. Points outside the raster are
    dropped.

    Styles: ``reference`` paints the points grey on black, the axis-aligned box of each object red and its
    label green. ``rich`` shades ground by density and obstacles by height above it. It adds range rings, the
    oriented boxes of the clusters in grey and those of the objects in the colour of their class, with heading
    and label.

    Only channels that are configured and whose input is given are made:

    - density: int32, points in the cell;
    - height: float32, metres, highest z in the cell, NaN if it is empty;
    - intensity: float32, mean in the cell, NaN if it is empty;
    - occupancy: int8, 100 with an obstacle point, 0 with ground points only, -1 unknown.

    Args:
        points: (N, 3) metres, x forward, y left, z up.
        intensity: (N,) of any number type, or None.
        ground: (N,) True where the point is ground, or None.
        objects: named boxes.
        clusters: boxes to draw in the rich style.
        config: ranges, resolution, style and channels.

    Raises:
        ValueError: intensity or ground do not have the length of points.
    """
    for name, array in (("intensity", intensity), ("ground", ground)):
        if array is not None and len(array) != len(points):
            raise ValueError(f"{name} has {len(array)} values for {len(points)} points")
    shape = int(2 * config.range_x / config.resolution), int(2 * config.range_y / config.resolution)
    scale = np.array([config.range_x, config.range_y, config.resolution], np.float32)
    points = np.ascontiguousarray(points, np.float32)
    cell = _cells(points, scale, *shape)

    missing = {"intensity"} if intensity is None else set()
    if ground is None:
        missing.add("occupancy")
    channels = [name for name in config.channels if name not in missing]
    if config.style == "reference":
        image = np.zeros((*shape, 3), np.uint8)
        _paint(cell, image, np.array(_POINT, np.uint8))
        if objects is not None:
            _draw_reference(image, objects, scale)
    else:
        image = _background(*shape, config.range_x, config.range_y, config.resolution).copy()
    grids: dict[str, NDArray[Any]] = {}
    if channels or config.style == "rich":
        known = np.zeros(0, np.bool_) if ground is None else ground
        wanted = {"density", "height", "occupancy"} if config.style == "rich" else set(channels)
        count, top = bool(wanted & {"density", "intensity"}), "height" in wanted
        density, height, occupancy, seen = _raster(
            cell, points, known, *shape, count, top, "occupancy" in wanted
        )
        grids = {"density": density, "height": height, "occupancy": occupancy}
        if intensity is not None and "intensity" in channels:
            grids["intensity"] = _mean(cell, np.ascontiguousarray(intensity, np.float32), density)
        if config.style == "rich":
            shades, level = (_obstacle_shades(), _ground_shades()), _ground_level(points, known)
            _shade(seen, density, height, occupancy, *shades, level, _HEIGHT_SPAN, image)
            _draw_rich(image, objects, clusters, config)

    return Bev(
        resolution=config.resolution,
        range_x=config.range_x,
        range_y=config.range_y,
        image=image,
        channels={name: grids[name] for name in channels},
    )


# --- raster ------------------------------------------------------------------------------------


@kernel
def _cells(points: F32, scale: F32, rows: int, columns: int) -> I32:
    """Return the (N,) row * columns + column of each point, -1 outside the raster."""
    cell = np.empty(len(points), np.int32)
    for i in range(len(points)):
        row = np.floor((scale[0] - points[i, 0]) / scale[2])
        column = np.floor((scale[1] - points[i, 1]) / scale[2])
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        cell[i] = np.int32(row) * columns + np.int32(column) if inside else -1
    return cell


@kernel
def _paint(cell: I32, image: U8, color: U8) -> None:
    pixels = image.reshape(-1, 3)
    for i in range(len(cell)):
        if cell[i] >= 0:
            for channel in range(3):
                pixels[cell[i], channel] = color[channel]


@kernel
def _raster(
    cell: I32, points: F32, ground: Bool, rows: int, columns: int, count: bool, top: bool, state: bool
) -> tuple[I32, F32, NDArray[np.int8], I32]:
    """Compute density, height and occupancy as requested. With ``count``, also list the occupied cells.

    Without ``ground`` every point is an obstacle.
    """
    cells = rows * columns
    density, seen = np.zeros(cells if count else 0, np.int32), np.empty(len(cell), np.int32)
    height = np.full(cells if top else 0, np.nan, np.float32)
    occupancy = np.full(cells if state else 0, UNKNOWN, np.int8)
    occupied = _count(cell, density, seen) if count else 0
    if top:
        _highest(cell, points, height)
    if state:
        _occupy(cell, ground if len(ground) else np.zeros(len(cell), np.bool_), occupancy)
    shape = -1, columns
    return density.reshape(shape), height.reshape(shape), occupancy.reshape(shape), seen[:occupied]


@kernel
def _count(cell: I32, density: I32, seen: I32) -> int:
    """Count the points of each cell. Write the occupied cells to ``seen`` and return their number."""
    occupied = 0
    for i in range(len(cell)):
        if cell[i] >= 0:
            # The cell is always written. There is no branch to mispredict.
            seen[occupied] = cell[i]
            occupied += density[cell[i]] == 0
            density[cell[i]] += 1
    return occupied


@kernel
def _highest(cell: I32, points: F32, height: F32) -> None:
    """Write the highest z of each cell."""
    for i in range(len(cell)):
        if cell[i] >= 0:
            z, highest = points[i, 2], height[cell[i]]
            height[cell[i]] = highest if z <= highest else z


@kernel
def _occupy(cell: I32, ground: Bool, occupancy: NDArray[np.int8]) -> None:
    """Write the occupancy of each cell."""
    for i in range(len(cell)):
        if cell[i] >= 0:
            occupancy[cell[i]] = max(occupancy[cell[i]], FREE if ground[i] else OCCUPIED)


@kernel
def _mean(cell: I32, intensity: F32, density: I32) -> F32:
    """Return the mean intensity of each cell."""
    total, count = np.zeros(density.size, np.float32), density.ravel()
    for i in range(len(cell)):
        if cell[i] >= 0:
            total[cell[i]] += intensity[i]
    for c in range(len(total)):
        total[c] /= np.float32(count[c])
    return total.reshape(density.shape)


@kernel
def _shade(
    seen: I32,
    density: I32,
    height: F32,
    occupancy: NDArray[np.int8],
    heights: U8,
    ground: U8,
    bottom: float,
    span: float,
    image: U8,
) -> None:
    """Colour ground cells by density and obstacle cells by their height above ``bottom``."""
    points, top, state = density.ravel(), height.ravel(), occupancy.ravel()
    pixels = image.reshape(-1, 3)
    for cell in seen:
        if state[cell] == OCCUPIED:
            level = (top[cell] - bottom) / span * len(heights)
            color = heights[max(0, min(len(heights) - 1, int(level)))]
        else:
            color = ground[min(points[cell], len(ground)) - 1]
        for channel in range(3):
            pixels[cell, channel] = color[channel]


def _ground_level(points: F32, ground: Bool) -> float:
    """Return the median z of the ground. Without ground points return -1.7 m, for a sensor on a car roof."""
    # This is not compiled, because a median takes longer to compile than the whole raster.
    sample = slice(None, len(ground), 1 + len(points) // 2_000)
    below = points[sample, 2][ground[sample]]
    return float(np.median(below)) if len(below) else -1.7


# --- drawing -----------------------------------------------------------------------------------


def _draw_reference(image: U8, objects: Objects, scale: F32) -> None:
    """Draw axis-aligned boxes and labels of the reference style."""
    center = np.floor((scale[:2] - objects.boxes.center[:, :2]) / scale[2]).astype(int)
    half = (objects.boxes.size[:, :2] / scale[2]).astype(int) // 2
    for name, (v, u), (h, w) in zip(objects.names, center.tolist(), half.tolist(), strict=True):
        cv2.rectangle(image, (u - w, v - h), (u + w, v + h), _RED, 2)
        cv2.putText(image, f"ID:{name}", (u - w, v - h - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.4, _GREEN, 1)


def _draw_rich(image: U8, objects: Objects | None, clusters: Clusters | None, config: BevConfig) -> None:
    """Draw oriented boxes, headings and labels of the rich style."""
    named = set() if objects is None else set(objects.cluster.tolist())
    if clusters is not None:
        rows = [k for k in np.flatnonzero(clusters.kept).tolist() if k not in named]
        outlines = _pixels(corners(clusters.obb)[rows, :4, :2], config)
        cv2.polylines(image, list(outlines), True, _UNNAMED, 1, cv2.LINE_AA, _SHIFT)
    if objects is None:
        return
    colors = [class_color(name)[::-1] for name in objects.names]
    outlines = _pixels(corners(objects.boxes)[:, :4, :2], config)
    for color, outline, front in zip(
        colors, outlines, _pixels(_headings(objects.boxes), config), strict=True
    ):
        cv2.polylines(image, [outline], True, color, 2, cv2.LINE_AA, _SHIFT)
        cv2.polylines(image, [front], False, color, 2, cv2.LINE_AA, _SHIFT)
    _write_names(image, objects, outlines >> _SHIFT, colors)


def _write_names(image: U8, objects: Objects, outlines: I32, colors: Sequence[Sequence[int]]) -> None:
    """Write each name at a corner of its box, nearest box first. Omit names without free space."""
    rows, columns = image.shape[:2]
    occupied = np.zeros((0, 4), np.int64)
    for k in np.argsort(objects.boxes.distance, kind="stable").tolist():
        text = f"{objects.names[k]} {objects.score[k]:.2f}"
        (wide, high), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, _SIZE, 1)
        (left, top), (right, bottom) = outlines[k].min(axis=0).tolist(), outlines[k].max(axis=0).tolist()
        for u, v in product((right + 4, left - 4 - wide), (top + 4, bottom + high)):
            area = np.array([u, v - high, u + wide, v + below])
            inside = area.min() >= 0 and area[2] <= columns and area[3] <= rows
            if inside and not ((area[:2] < occupied[:, 2:]) & (occupied[:, :2] < area[2:])).all(axis=1).any():
                occupied = np.vstack([occupied, area])
                _caption(image, text, (u, v), colors[k])
                break


def _headings(boxes: Boxes3D) -> F32:
    """Return (K, 2, 2) lines from each centre to the middle of the front side."""
    ahead = np.stack([np.cos(boxes.yaw), np.sin(boxes.yaw)], 1) * (boxes.size[:, :1] / 2)
    center = boxes.center[:, :2]
    return np.asarray(np.stack([center, center + ahead], 1), np.float32)


_SIZE = 0.45  # font scale of OpenCV for the names
_SHIFT = 3  # fractional bits of the pixel coordinates passed to OpenCV


def _pixels(xy: F32, config: BevConfig) -> I32:
    """Convert (..., 2) metres to (..., 2) u, v in fixed point, for OpenCV's ``shift``."""
    uv = (np.array([config.range_y, config.range_x]) - xy[..., ::-1]) / config.resolution - 0.5
    fixed: I32 = np.round(np.clip(uv, -4e4, 4e4) * (1 << _SHIFT)).astype(np.int32)
    return fixed


def _caption(image: U8, text: str, at: tuple[int, int], color: Sequence[int]) -> None:
    """Write text with a dark outline."""
    for width, shade in ((3, _BACKGROUND), (1, color)):
        cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, _SIZE, shade, width, cv2.LINE_AA)


@lru_cache(maxsize=2)
def _background(rows: int, columns: int, range_x: float, range_y: float, resolution: float) -> U8:
    """Draw range rings with their metres, the axes, and the robot as an arrow head."""
    image = np.full((rows, columns, 3), _BACKGROUND, np.uint8)
    u, v = range_y / resolution, range_x / resolution
    center = (int(u), int(v))
    longest = min(range_x, range_y)
    step = next(s for s in (1, 2, 5, 10, 20, 50, 100) if longest / s <= 6)
    cv2.line(image, (center[0], 0), (center[0], rows - 1), _RING, 1)
    cv2.line(image, (0, center[1]), (columns - 1, center[1]), _RING, 1)
    for metres in range(step, int(longest) + 1, step):
        radius = metres / resolution
        cv2.circle(image, center, round(radius), _RING, 1, cv2.LINE_AA)
        cv2.putText(
            image,
            f"{metres} m",
            (round(u + radius * 0.7071) + 3, round(v - radius * 0.7071) - 3),
            cv2.FONT_HERSHEY_SIMPLEX,
            0.4,
            _CAPTION,
            1,
            cv2.LINE_AA,
        )
    arrow = np.array([[0, -9], [6, 7], [0, 3], [-6, 7]]) + center
    cv2.fillPoly(image, [arrow.astype(np.int32)], (255, 255, 255), cv2.LINE_AA)
    image.flags.writeable = False
    return image


@lru_cache(maxsize=1)
def _ground_shades(steps: int = 16) -> U8:
    """Return (steps, 3) BGR colours by the number of points in a cell, on a logarithmic scale."""
    share = np.log1p(np.arange(1, steps + 1)) / np.log1p(steps)
    shades: U8 = np.round(np.array(_GROUND) * (0.45 + 0.55 * share[:, None])).astype(np.uint8)
    return shades


@lru_cache(maxsize=1)
def _obstacle_shades() -> U8:
    """Return (256, 3) BGR colours by height, without the near-black end of the map."""
    return np.ascontiguousarray(turbo(300)[44:, ::-1])
