"""Grid cells of points: packed keys, their numbering, and sorting by key."""

from __future__ import annotations

import numpy as np

from bevviz.model.frame import F32, F64, I32, I64
from bevviz.support.numba_kernel import kernel

DIGIT_BITS = 11  # bits per pass of the radix sort; the counters of one pass fit into the first cache


def cell_keys(points: F32, size: float, shift: float = 0.0, reach: int = 0) -> tuple[I64, I64]:
    """Pack the integer cell of each point into one int64.

    The longest axis varies slowest and the shortest fastest, so that a row of neighbouring cells is short.

    Args:
        points: (N, 3) float32 finite points, N > 0.
        size: edge of a cell in metres.
        shift: cells by which the grid begins before the lowest corner of the cloud, in [0, 1).
        reach: largest offset in cells that the caller will add to a key.

    Returns:
        keys: (N,) the packed cells, not negative. Different cells have different keys.
        strides: (3,) for x, y, z. ``keys + offset @ strides`` are the keys at an offset of up to ``reach``
            cells.
    """
    keys, strides = _pack_cells(points, size, shift, reach)
    if strides.any():
        return keys, strides
    # The points are too scattered for 64 bits. Shorten the gaps along each axis to just beyond the reach.
    low = points.min(axis=0).astype(np.float64)
    columns = []
    for axis in range(3):
        cells = np.floor((points[:, axis] - (low[axis] - shift * size)) / size)
        layers, layer = np.unique(cells, return_inverse=True)
        steps = np.minimum(np.diff(layers, prepend=layers[0]), reach + 1)
        columns.append(np.cumsum(steps).astype(np.int64)[layer])
    strides = _strides(np.array([column.max() + 1.0 + 2 * reach for column in columns]))
    return np.stack(columns, axis=1) @ strides, strides


@kernel
def _pack_cells(points: F32, size: float, shift: float, reach: int) -> tuple[I64, I64]:
    """Return the keys and the strides. The strides are zero if the keys do not fit into 64 bits.

    It is one kernel of scalars: array expressions and further kernels double the time to compile it.
    """
    x0, y0, z0 = np.float64(points[0, 0]), np.float64(points[0, 1]), np.float64(points[0, 2])
    x1, y1, z1 = x0, y0, z0
    for i in range(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        x0, y0, z0 = min(x, x0), min(y, y0), min(z, z0)
        x1, y1, z1 = max(x, x1), max(y, y1), max(z, z1)
    x0, y0, z0 = x0 - shift * size, y0 - shift * size, z0 - shift * size
    counts = np.empty(3)
    counts[0] = np.floor((x1 - x0) / size) + 1 + 2 * reach
    counts[1] = np.floor((y1 - y0) / size) + 1 + 2 * reach
    counts[2] = np.floor((z1 - z0) / size) + 1 + 2 * reach
    keys = np.empty(len(points), np.int64)
    if counts[0] * counts[1] * counts[2] >= 2.0**62:
        return keys, np.zeros(3, np.int64)
    strides = _strides(counts)
    for i in range(len(points)):
        # The coordinates are not negative, so truncation equals the floor.
        keys[i] = (
            np.int64((points[i, 0] - x0) / size) * strides[0]
            + np.int64((points[i, 1] - y0) / size) * strides[1]
            + np.int64((points[i, 2] - z0) / size) * strides[2]
        )
    return keys, strides


@kernel
def _strides(counts: F64) -> I64:
    """Return the strides of x, y, z for a grid with these numbers of cells."""
    slow, fast = 0, 2
    for axis in range(1, 3):
        if counts[axis] > counts[slow]:
            slow = axis
    for axis in range(1, -1, -1):
        if counts[axis] < counts[fast]:
            fast = axis
    if slow == fast:  # all three counts are equal
        slow, fast = 0, 2
    middle = 3 - slow - fast
    strides = np.ones(3, np.int64)
    strides[middle] = np.int64(counts[fast])
    strides[slow] = np.int64(counts[fast]) * np.int64(counts[middle])
    return strides


@kernel
def group(keys: I64) -> tuple[I32, I32]:
    """Return consecutive numbers for distinct keys, in the order of their first appearance, by hashing.

    Returns:
        number: (N,) int32 number of each key.
        first: (M,) int32 index at which each number appears first.
    """
    n = len(keys)
    bits = 4
    while (1 << bits) < 2 * n:
        bits += 1
    table = np.full(1 << bits, -1, np.int32)
    number = np.empty(n, np.int32)
    first = np.empty(n, np.int32)
    seen = np.empty(n, np.int64)
    count = 0
    for i in range(n):
        key = keys[i]
        if i > 0 and key == keys[i - 1]:
            number[i] = number[i - 1]
            continue
        slot = np.int64((np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(64 - bits))
        while table[slot] >= 0 and seen[table[slot]] != key:
            slot = (slot + 1) & ((1 << bits) - 1)
        if table[slot] < 0:
            table[slot] = count
            seen[count] = key
            first[count] = i
            count += 1
        number[i] = table[slot]
    return number, first[:count].copy()


@kernel
def sort_by_key(keys: I64) -> tuple[I32, I32]:
    """Sort indices by keys that are not negative, with a stable radix sort.

    Returns:
        order: (N,) int32 indices, equal keys side by side.
        start: (M + 1,) int32. ``order[start[k]:start[k + 1]]`` are the indices with the k-th distinct key.
    """
    n = len(keys)
    order, other = np.arange(n).astype(np.int32), np.empty(n, np.int32)
    highest, shift = 0, 0
    for key in keys:
        highest = max(highest, key)
    while highest >> shift > 0:
        end = np.zeros((1 << DIGIT_BITS) + 1, np.int32)
        for i in range(n):
            end[((keys[i] >> shift) & ((1 << DIGIT_BITS) - 1)) + 1] += 1
        for k in range(1 << DIGIT_BITS):
            end[k + 1] += end[k]
        for point in order:
            digit = (keys[point] >> shift) & ((1 << DIGIT_BITS) - 1)
            other[end[digit]] = point
            end[digit] += 1
        order, other = other, order
        shift += DIGIT_BITS
    start = np.empty(n + 1, np.int32)
    groups = 0
    for k in range(n):
        if k == 0 or keys[order[k]] != keys[order[k - 1]]:
            start[groups] = k
            groups += 1
    start[groups] = n
    return order, start[: groups + 1].copy()


@kernel
def sort_by(number: I32, count: int) -> tuple[I32, I32]:
    """Sort indices by the number of each, with a stable counting sort. Numbers are in [0, count).

    Returns:
        order: (N,) int32. ``order[start[k]:start[k + 1]]`` are the indices with number k.
        start: (count + 1,) int32.
    """
    start = np.zeros(count + 1, np.int32)
    for i in range(len(number)):
        start[number[i] + 1] += 1
    for k in range(count):
        start[k + 1] += start[k]
    end = start[:-1].copy()
    order = np.empty(len(number), np.int32)
    for i in range(len(number)):
        order[end[number[i]]] = i
        end[number[i]] += 1
    return order, start
