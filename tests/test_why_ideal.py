"""Ideal results of single stages: a planted fault is found by what brings the missed object back."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from bevviz.config import load
from bevviz.evaluate import MAX_DISTANCE, judge
from bevviz.evaluate.matching import image_boxes_of
from bevviz.findings.frame_findings import find_findings
from bevviz.model.reasons import ReasonKind
from bevviz.pipeline.notes import Note
from bevviz.pipeline.perceive import perceive
from bevviz.pipeline.session import Session
from bevviz.pipeline.stage_loader import StageLoader
from bevviz.pipeline.stage_log import Memo
from bevviz.why import FrameExplainer, Selection
from bevviz.why.assumed_truth import assumed_truth
from bevviz.why.changes import changes_for, other_methods
from bevviz.why.collect import collect_evidence
from bevviz.why.ideal import IdealStages
from bevviz.why.kept_labels import kept_truth
from bevviz.why.verdict import ground_lost
from tests.support.planted_faults import at

CLASSES = ("car", "person", "cyclist")


@cache
def explained(*settings: str) -> FrameExplainer:
    config = load(None, ["detector.model=demo", *settings])
    return FrameExplainer(Session(config).run_explained(at("flat_car").frame), classes=CLASSES)


PLANTED = [
    ("ground.distance_threshold=2.5", "ground"),
    ("clustering.min_cluster_points=400", "clustering"),
    ("detector.conf_threshold=0.97", "detector"),
    ("fusion.min_rating=0.97", "fusion"),
]


@pytest.mark.long
@pytest.mark.parametrize(("planted", "stage"), PLANTED)
def test_the_stage_of_a_planted_value_brings_objects_back(planted: str, stage: str) -> None:
    sound = explained()
    assert sound.traces.matches is not None
    found = set(np.flatnonzero(~sound.traces.matches.missed).tolist())
    asked = explained(planted)
    assert asked.traces.matches is not None
    lost = [row for row in np.flatnonzero(asked.traces.matches.missed).tolist() if row in found]
    assert lost, "the planted value loses an object that is found without it"
    answers = [asked.with_restoring_stages(asked.about(Selection(truth=row))) for row in lost]
    right = [answer for answer in answers if (stage,) in answer.restored_by]
    assert len(right) >= 0.8 * len(answers)


def test_pairs_are_named_where_no_stage_alone_restores() -> None:
    asked = explained("detector.conf_threshold=0.97", "clustering.min_cluster_points=400")
    sets = [answer.restored_by for answer in asked.missed()]
    both = [one for one in sets if ("clustering", "detector") in one]
    assert both
    assert all(len(stages) == 2 for one in both for stages in one), "no single stage restores them"
    answer = next(a for a in asked.missed() if ("clustering", "detector") in a.restored_by)
    assert "a cluster of its own and a right detection" in answer.verdict.cause


def test_ideal_results_leave_the_other_objects_alone() -> None:
    asked = explained("fusion.min_rating=0.97")
    traces, result = asked.traces, asked.traces.result
    assert traces.matches is not None and traces.labels_in_evaluate is not None
    row = int(np.flatnonzero(traces.matches.missed)[0])
    memo = Memo()
    stages = StageLoader().load(result.config, lambda camera: result.cameras[0].detections)
    edits = IdealStages(traces, (row,), ("fusion",), memo)
    after = perceive(result.frame, result.config, stages, memo, edits=edits)
    assert after.objects is not None
    new = judge(after.objects, traces.labels_in_evaluate)
    assert np.flatnonzero(new.missed != traces.matches.missed).tolist() == [row]


def test_the_road_in_an_image_box_is_no_loss_to_the_ground() -> None:
    """Nine voxels of the road, and one of the feet: an image box that is wider than its person holds both."""
    asked = explained()
    subject = next(a.subject for a in asked.ask(Selection()) if a.subject.kind != "detection")
    evidence = collect_evidence(subject, asked.traces)
    heights = np.array([0.02] * 5 + [-0.04] * 4 + [0.15], np.float32)
    lost = replace(evidence, ground=heights)
    assert ground_lost(replace(subject, kind="detection"), lost) == 1
    assert ground_lost(subject, lost) == 10


def without_truth(asked: FrameExplainer) -> FrameExplainer:
    result = asked.traces.result
    return FrameExplainer(replace(result, frame=replace(result.frame, truth=None)), classes=CLASSES)


def box_of(asked: FrameExplainer, row: int) -> Selection:
    """Return the selection of the image box of an object of the ground truth."""
    truth, camera = asked.traces.labels_in_evaluate, asked.traces.result.cameras[0].camera
    assert truth is not None
    return Selection(box=tuple(image_boxes_of(truth, camera)[row].tolist()), camera=camera.name)


@pytest.mark.parametrize(("planted", "stage"), PLANTED)
def test_an_image_box_tells_the_cause_without_truth(planted: str, stage: str) -> None:
    sound, asked = explained(), explained(planted)
    assert sound.traces.matches is not None and asked.traces.matches is not None
    lost = np.flatnonzero(asked.traces.matches.missed & ~sound.traces.matches.missed).tolist()
    assert lost
    blind = without_truth(asked)
    answers = [blind.with_restoring_stages(blind.ask(box_of(asked, row))[0]) for row in lost[:5]]
    right = [a for a in answers if any(stage in stages for stages in a.verdict.restored_by)]
    assert len(right) >= 0.8 * len(answers)


def test_an_image_box_of_a_found_object_has_no_cause() -> None:
    asked = explained()
    assert asked.traces.matches is not None and asked.traces.labels_in_evaluate is not None
    found = np.flatnonzero(asked.traces.labels_in_evaluate.must & ~asked.traces.matches.missed).tolist()
    blind = without_truth(asked)
    answers = [blind.with_restoring_stages(blind.ask(box_of(asked, row))[0]) for row in found]
    assert found and [answer.restored_by for answer in answers] == [()] * len(found)


def test_an_assumed_object_is_where_its_label_is() -> None:
    asked = explained()
    truth, blind = asked.traces.labels_in_evaluate, without_truth(asked)
    assert truth is not None
    rows, right = np.flatnonzero(truth.must).tolist(), 0
    for row in rows:
        assumed = assumed_truth(blind.ask(box_of(asked, row))[0].subject, blind.traces)
        assert assumed is not None
        away = np.linalg.norm(assumed.boxes.center[0, :2] - truth.boxes.center[row, :2])
        right += bool(away < MAX_DISTANCE) and assumed.labels[0] in truth.accepted[row]
    assert right >= 0.8 * len(rows), "the boxes of a few objects are mostly of others before them"


def labelled(asked: FrameExplainer, row: int) -> FrameExplainer:
    """Return the explainer without ground truth, but with the label of one object that a user keeps."""
    truth, frame = asked.traces.labels_in_evaluate, asked.traces.result.frame
    assert truth is not None
    box = truth.boxes.chosen([row])
    values = (*box.center[0].tolist(), *box.size[0].tolist(), float(box.yaw[0]))
    note = Note(
        frame.stamp,
        0,
        "kept",
        "",
        '{"kind": "point", "label": "", "frame": 0}',
        0,
        truth.labels[row],
        values,
        frame.points_frame,
    )
    blind = without_truth(asked).traces.result
    return FrameExplainer(blind, classes=CLASSES, labels=kept_truth([note], blind.frame, CLASSES))


@pytest.mark.parametrize(("planted", "stage"), PLANTED[1:2])
def test_a_kept_label_makes_the_answer_exact(planted: str, stage: str) -> None:
    """It is the answer with ground truth, at the image box and at the place."""
    sound, asked = explained(), explained(planted)
    assert sound.traces.matches is not None and asked.traces.matches is not None
    row = int(np.flatnonzero(asked.traces.matches.missed & ~sound.traces.matches.missed)[0])
    known, blind = asked.about(Selection(truth=row)), labelled(asked, row)
    assert known.center is not None
    for selection in (box_of(asked, row), Selection(point=known.center)):
        answer = blind.ask(selection)[0]
        assert answer.text == known.text and answer.points == known.points and not answer.likely
        assert answer.restored_by == known.restored_by and (stage,) in answer.restored_by
        assert [step.text for step in answer.steps[1:]] == [step.text for step in known.steps]
        assert answer.steps[0].stage == "label"


def test_a_kept_label_says_nothing_about_other_objects() -> None:
    asked = explained()
    blind = labelled(asked, row=0)
    before, after = find_findings(without_truth(asked)), find_findings(blind)
    assert [(one.what, one.selection) for one in before] == [(one.what, one.selection) for one in after]
    assert blind._labelled is not None and (matches := blind._labelled.traces.matches) is not None
    assert (matches.partner < 0).any() and not matches.false.any()


def test_other_methods_of_the_stages_that_lost_it_are_offered() -> None:
    asked = explained("clustering.min_cluster_points=400")
    answer = next(one for one in asked.missed() if ("clustering",) in one.restored_by)
    assert answer.lost_in[0] == "clustering"
    config = asked.traces.result.config
    assert other_methods(answer.lost_in[:1], config) == (), "there is one alone"
    stages = ("fusion", "detector", "ground", "fusion")
    assert other_methods(stages, config) == ("fusion.method=centroid", "ground.method=plane")
    plane = load(None, ["ground.method=plane"])
    assert other_methods(("ground",), plane) == ("ground.method=polar",)


def test_a_height_of_the_sensor_is_tried_against_a_roof() -> None:
    """It is that of the lowest points, so that no ceiling or roof is the ground."""
    asked = explained("ground.distance_threshold=2.5")
    answer = next(a for a in asked.missed() if a.verdict.kind is ReasonKind.GROUND)
    changes = list(changes_for(answer.evidence, answer.verdict.kind, asked.traces))
    heights = [change["ground.sensor_height"] for change in changes if "ground.sensor_height" in change]
    assert len(heights) == 1 and heights[0] == pytest.approx(1.8, abs=0.4)
