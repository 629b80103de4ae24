"""The judge of ``benchmarks.ideal``: ideal stages restore an object if they are its cause, and only then."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from benchmarks import ideal, ideal_data
from benchmarks.ideal_stages import STAGES, MissedObject, missed_rows
from bevviz.config import changed_config
from bevviz.model.reasons import ReasonKind
from bevviz.model.results import ClusterState
from bevviz.pipeline.perceive import perceive
from bevviz.pipeline.stage_log import Memo

pytestmark = pytest.mark.long
ASKED = ideal_data.ASKED[0]


@cache
def drive() -> ideal_data.DataSet:
    """Return a synthetic drive."""
    return ideal_data.drives([7003])


def newly_missed(*settings: str) -> list[MissedObject]:
    """Return the objects of a frame that are missed with some settings only."""
    data, memo = drive(), Memo()
    labelled = data.frames[ASKED]
    default = ideal.configuration("default", ())
    config = changed_config(default, settings)
    before, result = (
        perceive(labelled.frame, some, data.loader.load(some), memo) for some in (default, config)
    )
    rows = set(missed_rows(result, labelled)) - set(missed_rows(before, labelled))
    stages = data.loader.load(config)
    return [MissedObject(labelled, row, result, stages, data.classes, memo) for row in sorted(rows)]


@pytest.mark.parametrize(
    ("setting", "stage"),
    [
        ("clustering.min_cluster_points=60", "clustering"),
        ("detector.conf_threshold=0.9", "detection"),
        ("fusion.max_depth=10", "fusion"),
    ],
)
def test_only_the_mistuned_stage_restores_an_object(setting: str, stage: str) -> None:
    missed = newly_missed(setting)
    assert len(missed) >= 2
    for one in missed:
        assert one.restored_by() == ([stage], [])


def test_two_mistuned_stages_need_both_ideals() -> None:
    both = newly_missed("detector.conf_threshold=0.9", "fusion.max_depth=10")
    alone = {one.row for one in newly_missed("detector.conf_threshold=0.9")}
    alone &= {one.row for one in newly_missed("fusion.max_depth=10")}
    found = [one.restored_by() for one in both if one.row in alone]
    assert len(found) >= 2
    assert all(answer == ([], [("detection", "fusion")]) for answer in found)


def test_all_ideal_stages_restore_an_object_of_near_points() -> None:
    data, memo = drive(), Memo()
    labelled, config = data.frames[ASKED], ideal.configuration("reference", ())
    stages = data.loader.load(config)
    result = perceive(labelled.frame, config, stages, memo)
    rows = missed_rows(result, labelled)
    assert len(rows) >= 5 and result.voxels is not None
    restored = 0
    for row in rows:
        missed = MissedObject(labelled, row, result, stages, data.classes, memo)
        points = result.voxels.points[missed.holds(result.voxels.points)]
        middle = (points.min(axis=0) + points.max(axis=0)) / 2  # `reference` knows no sizes of classes
        away = np.hypot(*(middle - labelled.truth.boxes.center[row])[:2])
        restored += missed.is_found_with(set(STAGES))
        assert away > 1.9 or missed.is_found_with(set(STAGES))
        assert not missed.is_found_with(set())
    assert restored >= len(rows) - 2


def test_an_ideal_cluster_is_the_object_and_is_kept() -> None:
    missed = newly_missed("clustering.min_cluster_points=60")[0]
    result = missed.result
    assert result.obstacles is not None and result.clusters is not None
    made = missed.ideal_clusters(result.obstacles, result.clusters, result.config.clustering)
    own = missed.holds(result.obstacles)
    assert set(made.labels[own].tolist()) == {len(made) - 1}
    assert not (made.labels[~own] == len(made) - 1).any()
    assert made.state[-1] == ClusterState.KEPT
    assert np.array_equal(np.unique(made.labels[made.labels >= 0]), np.arange(len(made)))


def test_alternatives_are_read_from_words_and_lists() -> None:
    assert ideal.alternatives(None) == []
    assert ideal.alternatives("fusion") == [["fusion"]]
    assert ideal.alternatives(["detector", "ground and clustering"]) == [
        ["detection"],
        ["ground", "clustering"],
    ]
    assert ideal.alternatives([("clusters", "fusion"), {"stages": ["detection"]}]) == [
        ["clustering", "fusion"],
        ["detection"],
    ]


def test_a_planted_value_set_back_cures_an_object() -> None:
    data, memo = drive(), Memo()
    frame = ideal.FrameBenchmark(data, ASKED, "depth+nms", memo)
    cured = [miss for miss in frame.misses(3) if miss.cured]
    assert len(cured) == 2
    for miss in cured:
        assert miss.planted == ["fusion.max_depth", "detector.iou_threshold"]
        hint = frame.tried(["fusion.max_depth=120", "detector.iou_threshold=0.45"], miss.row)
        assert hint.restores and hint.gain >= 2 and len(hint.beside) == 2 and min(hint.beside) >= 1
        same = frame.tried(["fusion.max_depth=14"], miss.row)
        assert not same.restores and same.gain <= 0


def answered(**values: Any) -> ideal.Miss:
    """Return an answer about a missed object."""
    verdict: dict[str, Any] = {
        "reason": "noise",
        "blamed": "clustering",
        "text": "",
        "named": [],
        "planted": ["a.b"],
    }
    about: dict[str, Any] = {
        "data": "drives",
        "drive": "1",
        "frame": 1,
        "half": "seen",
        "configuration": "conf",
        "row": 0,
    }
    known = {**about, **verdict, "label": "car", "alone": [], "pairs": [], "cured": True}
    return ideal.Miss(**(known | values))


def test_a_cause_holds_if_one_named_alternative_does() -> None:
    assert answered(alone=["clustering"]).cause_holds
    assert not answered(alone=["fusion"]).cause_holds
    assert answered(alone=["fusion"], named=[["detection"], ["fusion"]]).named_hold == [False, True]
    pair = answered(pairs=[("clustering", "fusion")])
    assert pair.curable and not pair.cause_holds
    assert replace(pair, named=[["fusion", "clustering"]]).cause_holds
    assert not replace(pair, named=[["fusion"]]).cause_holds
    assert not answered().curable


def test_shares_count_cases_and_draw_whole_drives() -> None:
    right = ideal.TriedHint(["a.b=1"], True, 1, [1, -2])
    misses = [
        answered(alone=["clustering"], hints=[right]),
        answered(drive="2"),
        answered(drive="2", cured=False),
    ]
    found = ideal.figures(misses)["all"]
    assert (found["misses"], found["restorable"]) == (3, 1)
    assert {name: found[name][:2] for name in ideal.SHARES} == {
        "cause": (1, 3),
        "cause, restorable": (1, 1),
        "reason": (1, 3),
        "named": (0, 0),
        "planted": (1, 2),
        "planted, hinted": (1, 1),
        "hint": (1, 3),
        "first hint": (1, 3),
        "beside": (0, 1),
        "beside, no loss": (0, 1),
    }
    assert found["cause"][2:] == (0.0, 1.0)  # A draw may have one drive twice.
    assert "| all | 3 | 1 | 33 % of 3 (0-100) |" in ideal.table(misses)


def test_every_reason_of_a_loss_has_a_stage() -> None:
    stageless = {"reported", "failed", "out of view", "hidden", "no points"}
    others = {
        "contradicted",
        "detector's own error",
        "not among the objects",
        "lost in the fusion",
        "second name",
    }
    losses = {kind.value for kind in list(ReasonKind)[: list(ReasonKind).index(ReasonKind.KEPT)]}
    assert losses - stageless - others == set(ideal.STAGE_OF)


def test_halves_are_apart_and_together_all_frames() -> None:
    data = drive()
    seen, unseen = data.asked("seen"), data.asked("unseen")
    assert not set(seen) & set(unseen)
    assert sorted(seen + unseen) == data.asked() == list(ideal_data.ASKED)
