"""Packed cells and the sorts by them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from bevviz.model.frame import F32, I64
from bevviz.stages.cells import cell_keys, group, sort_by_key

near = hnp.arrays(np.float32, st.tuples(st.integers(1, 60), st.just(3)), elements=st.floats(-9, 9, width=32))
far = hnp.arrays(
    np.float32, st.tuples(st.integers(1, 9), st.just(3)), elements=st.floats(-1e9, 1e9, width=32)
)
keys = hnp.arrays(np.int64, st.integers(1, 300), elements=st.integers(0, 2**40) | st.integers(0, 9))


@settings(deadline=None)
@given(near, st.sampled_from([0.3, 1.0, 20.0]), st.sampled_from([0.0, 0.5]), st.integers(0, 2))
def test_keys_identify_cells_and_neighbours(points: F32, size: float, shift: float, reach: int) -> None:
    packed, strides = cell_keys(points, size, shift, reach)
    low = points.min(axis=0).astype(np.float64)
    cells = np.floor((points - (low - shift * size)) / size).astype(np.int64)
    np.testing.assert_array_equal(packed, cells @ strides)
    assert np.unique(packed).size == len(np.unique(cells, axis=0))
    around: Any = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 3), -1).reshape(-1, 3)
    everywhere = np.unique((cells[:, None] + around).reshape(-1, 3), axis=0)
    assert np.unique(everywhere @ strides).size == len(everywhere)


@settings(deadline=None)
@given(far)
def test_a_cloud_scattered_over_worlds_has_keys_all_the_same(points: F32) -> None:
    packed, _ = cell_keys(points, 0.01)
    cells = np.floor((points - points.min(axis=0).astype(np.float64)) / 0.01)
    for i, key in enumerate(packed):
        np.testing.assert_array_equal(packed == key, (cells == cells[i]).all(axis=1))


@pytest.mark.parametrize("extent", [(9, 1, 1), (1, 9, 1), (1, 1, 9), (9, 9, 1), (5, 5, 5), (1, 5, 9)])
def test_the_longest_axis_is_the_slowest(extent: tuple[int, int, int]) -> None:
    corners = np.array([(0, 0, 0), extent], np.float32)
    _, strides = cell_keys(corners, 1.0)
    assert strides[np.argmax(extent)] == strides.max()
    assert sorted(strides)[0] == 1
    assert [extent[axis] for axis in np.argsort(strides, kind="stable")] == sorted(extent)


@settings(deadline=None)
@given(keys)
def test_points_are_sorted_by_key(keys: I64) -> None:
    order, start = sort_by_key(keys)
    np.testing.assert_array_equal(order, np.argsort(keys, kind="stable"))
    values, counts = np.unique(keys, return_counts=True)
    np.testing.assert_array_equal(keys[order[start[:-1]]], values)
    np.testing.assert_array_equal(np.diff(start), counts)


@settings(deadline=None)
@given(keys)
def test_groups_are_in_order_of_appearance(keys: I64) -> None:
    number, first = group(keys)
    np.testing.assert_array_equal(keys[first][number], keys)
    assert first.tolist() == sorted(first.tolist())
    assert len(first) == np.unique(keys).size
