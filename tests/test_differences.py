"""Changes of objects between two results, and which configuration is better."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bevviz.evaluate import Truth
from bevviz.evaluate.differences import before_after
from bevviz.evaluate.f1_change import f1_change
from bevviz.model.frame import Boxes3D
from bevviz.model.results import Objects

# --- before and after --------------------------------------------------------------------------


def boxes(*places: float) -> Boxes3D:
    center = np.array([(x, 0, 0) for x in places], np.float32).reshape(-1, 3)
    return Boxes3D(center, np.ones_like(center), np.zeros(len(center), np.float32))


def cars(*places: float) -> Objects:
    none = np.zeros(len(places), np.int32)
    score = np.ones(len(places), np.float32)
    return Objects(boxes(*places), ("car",) * len(places), score, none, ("",) * len(places), none)


def test_fixed_broken_new_false_and_false_gone_are_told_apart() -> None:
    places, must = (10, 20, 30, 40), np.array([True, True, True, False])
    labels = Truth(boxes(*places), ("car",) * 4, (frozenset({"car"}),) * 4, must)
    # 60 stays false, 70 goes, 80 comes. The car at 40 need not be found.
    change = before_after(cars(10, 20, 60, 70), cars(10, 30, 60.5, 80, 40), labels)
    assert (change.fixed, change.broken) == ([2], [1])
    assert (change.new_false, change.false_gone) == ([3], [3])
    assert change.found == (3, 2, 2) and change.changed == 1
    unknown = before_after(cars(10, 20, 60, 70), cars(10, 30, 60.5, 80, 40), None)
    assert (unknown.new_false, unknown.false_gone) == ([1, 3, 4], [1, 3])
    assert unknown.fixed == unknown.broken == []


def test_the_names_of_changed_objects() -> None:
    labels = Truth(boxes(5, 20), ("car",) * 2, (frozenset({"car"}),) * 2, np.ones(2, bool))
    change = before_after(cars(5, 9), None, labels)
    assert change.names.lost == change.names.right == ("car at 5.0 m",)
    assert (change.good, change.harm) == (1, 1)
    assert change.text == "broken car at 5.0 m, false gone car at 9.0 m"
    assert before_after(cars(5, 9), None, None).names.lost == ("car at 5.0 m", "car at 9.0 m")
    found = before_after(cars(9), cars(20, 5, 40), labels, asked=1)
    assert found.names.fixed == ("car at 20.0 m", "car at 5.0 m")
    assert found.names.added == found.names.false == ("car at 40.0 m",)
    assert before_after(None, cars(30, 40), None, own=1).names.fixed == ("car at 40.0 m",)


def test_a_name_that_no_label_accepts_is_not_false() -> None:
    labels = Truth(boxes(10), ("car",), (frozenset({"car"}),), np.array([True]))
    benches = replace(cars(50), names=("bench",))
    assert before_after(None, benches, labels).new_false == []
    assert before_after(None, cars(50), labels).new_false == [0]


# --- which one is better -----------------------------------------------------------------------


def test_a_gain_in_all_parts_is_more_than_noise() -> None:
    before, after = np.tile([6.0, 4, 2], (40, 1)), np.tile([8.0, 2, 2], (40, 1))
    change = f1_change(before, after)
    assert (change.before, change.after) == pytest.approx((12 / 18, 16 / 20))
    assert change.low == pytest.approx(change.high) == pytest.approx(16 / 20 - 12 / 18)
    assert change.is_better and not f1_change(after, before).is_better


def test_a_gain_in_one_part_alone_may_be_chance() -> None:
    before = np.tile([6.0, 4, 2], (40, 1))
    after = before.copy()
    after[:2] = 10, 0, 2
    change = f1_change(before, after)
    assert change.after > change.before and change.low == 0 and not change.is_better
    assert not f1_change(before, before).is_better


def test_frames_of_one_drive_are_drawn_together() -> None:
    """One drive gains and one loses: 20 frames of each are no evidence."""
    before = np.tile([6.0, 4, 2], (40, 1))
    after = before + np.repeat([[3.0, -3, 0], [-2, 2, 0]], 20, axis=0)
    names = ["a"] * 20 + ["b"] * 20
    assert f1_change(before, after, names).low < 0 < f1_change(before, after, names).high
