"""Grid maps with layers (grid_map_msgs) as surfaces."""

from __future__ import annotations

from typing import Any

import numpy as np

from bevviz.messages.decoding import MessageError
from bevviz.model import geometry
from bevviz.model.frame import F32, F64, HeightMap

HEIGHT = "elevation"  # name of the layer with heights
LARGEST = 250_000  # cells that are shown; larger maps are reduced to every n-th row and column


def decode_grid_map(msg: Any, pose: F64, topic: str) -> HeightMap | None:
    """Decode a layer of a map: ``elevation`` as heights, or the first layer as colours of a plane.

    Rows of a layer run against x and columns against y, from the corner where both are greatest. The map is a
    ring buffer in both directions, because it moves with the robot (https://github.com/ANYbotics/grid_map).

    Args:
        msg: a grid_map_msgs/GridMap.
        pose: (4, 4) frame of the map from its centre.
        topic: topic of the message, for errors.

    Returns:
        The surface; None if no cell is known.

    Raises:
        MessageError: the message contradicts itself.
    """
    if not msg.layers or len(msg.layers) != len(msg.data):
        raise MessageError(f"{topic}: {len(msg.layers)} names of {len(msg.data)} layers")
    name = HEIGHT if HEIGHT in msg.layers else next(iter([*msg.basic_layers, *msg.layers]))
    if name not in msg.layers:
        raise MessageError(f"{topic}: its basic layer '{name}' is not among its layers")
    step = float(msg.info.resolution)
    if not (np.isfinite(step) and step > 0):
        raise MessageError(f"{topic}: a resolution of {step} m")
    values = _layer(msg.data[list(msg.layers).index(name)], f"{topic}: layer '{name}'")
    values = np.roll(values, (-msg.outer_start_index, -msg.inner_start_index), axis=(0, 1))
    rows, columns = values.shape
    every = int(np.ceil(np.sqrt(values.size / LARGEST))) if values.size > LARGEST else 1
    x = (rows / 2 - 0.5 - np.arange(0, rows, every)) * step
    y = (columns / 2 - 0.5 - np.arange(0, columns, every)) * step
    return _surface(values[::every, ::every], x, y, pose, flat=name != HEIGHT)


def _layer(array: Any, what: str) -> F32:
    """Return the (rows, columns) of a layer. Eigen stores them by columns unless the layer says otherwise."""
    values, dims = np.asarray(array.data, np.float32), array.layout.dim
    if len(dims) != 2 or dims[0].size * dims[1].size != len(values) - array.layout.data_offset:
        sizes = " x ".join(str(dim.size) for dim in dims)
        raise MessageError(f"{what}: {len(values)} values in {sizes or 'no'} cells")
    cells = values[array.layout.data_offset :].reshape(dims[0].size, dims[1].size)
    return cells if dims[0].label == "row_index" else cells.T


def _surface(values: F32, x: F64, y: F64, pose: F64, *, flat: bool) -> HeightMap | None:
    known = np.isfinite(values)
    if not known.any():
        return None
    number = np.full(values.shape, -1, np.int64)
    number[known] = np.arange(known.sum())
    grid_x, grid_y = np.meshgrid(x, y, indexing="ij")
    heights = np.zeros(int(known.sum())) if flat else values[known]
    local = np.column_stack([grid_x[known], grid_y[known], heights])
    a, b, c, d = (
        part.ravel() for part in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:])
    )
    both = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    triangles = both[(both >= 0).all(axis=1)].astype(np.uint32)
    vertices = geometry.apply(pose, local.astype(np.float32))
    return HeightMap(vertices, triangles, values[known])
