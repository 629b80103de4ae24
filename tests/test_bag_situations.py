"""Bags as users and drivers record them, rebuilt from public reports; see the table in tests/README.md."""

from __future__ import annotations

from pathlib import Path

import pytest

from bevviz.bags.source import BagSource
from bevviz.config import load
from tests.support import bags


@pytest.mark.parametrize("row_step", [16 * 200, 16 * 53, 0])
def test_a_cloud_with_a_wrong_row_step_has_all_its_points(tmp_path: Path, row_step: int) -> None:
    items = bags.small_items(scans=2)
    for item in items:
        if item.topic == bags.CLOUD:
            item.message.height, item.message.width, item.message.row_step = 4, 50, row_step
    with BagSource([bags.write(tmp_path / "drive", items)], load()) as source:
        assert [len(frame.points) for frame in source] == [200, 200]
        assert not source.warnings


def test_points_that_the_data_lack_are_said(tmp_path: Path) -> None:
    items = bags.small_items(scans=3)
    for item in items:
        if item.topic == bags.CLOUD:
            item.message.height, item.message.width, item.message.row_step = 4, 60, 16 * 60
    with BagSource([bags.write(tmp_path / "drive", items)], load()) as source:
        assert [len(frame.points) for frame in source] == [200, 200, 200]
        (said,) = source.doubts
    assert said.startswith(f"{bags.CLOUD}: a cloud states 60 x 4 points of 16 bytes and a row_step of 960")
    assert said.endswith("40 of 240 points are missing")
