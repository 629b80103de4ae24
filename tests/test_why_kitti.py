"""Answers about labelled KITTI frames, checked against the arrays of the stages and against ``evaluate``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import bevviz
from bevviz.config import load
from bevviz.evaluate import exemptions, match, truth_of
from bevviz.findings.frame_findings import find_findings, findings_of
from bevviz.model.frame import Camera, Frame
from bevviz.model.reasons import ReasonKind
from bevviz.model.results import Detections, FrameResult
from bevviz.pipeline.perceive import add_explanations, perceive
from bevviz.pipeline.stage_loader import DetectFunction, StageLoader
from bevviz.stages.clustering import dbscan
from bevviz.support.json_form import json_tree
from bevviz.why import Answer, FrameExplainer, Selection
from bevviz.why.answer_results import AnswerResult
from bevviz.why.false_objects import false_reasons
from bevviz.why.frame_index import Fate

NAMES = {"Car": "car", "Van": "car", "Truck": "truck", "Tram": "train"}  # any other label is a person


@dataclass
class Asked:
    """A frame with the answers about each of its labels and about its false objects."""

    name: str
    result: FrameResult
    explainer: FrameExplainer
    labels: list[Answer]
    false: list[Answer]


def of_labels(frame: Frame) -> DetectFunction:
    """Return a detector that detects the image boxes of the labels."""
    assert frame.truth is not None and frame.truth.image is not None
    boxes, names = frame.truth.image.xyxy, tuple(NAMES.get(label, "person") for label in frame.truth.labels)
    number, zeros = len(names), np.zeros(len(names), np.int32)
    detections = Detections(
        boxes.astype(np.float32),
        np.full(number, 0.9, np.float32),
        zeros,
        names,
        zeros,
        np.full(number, -1, np.int32),
        np.zeros(number, np.float32),
    )

    def detect(camera: Camera) -> Detections:
        return detections

    return detect


@pytest.fixture(scope="module")
def asked(shared: Path) -> dict[str, Asked]:
    """Answers by data set, frame and detector, such as ``kitti/11/network``."""
    model = str(shared / "models/yolox_nano.onnx")
    config, loader, frames = load(settings=[f"detector.model={model}"]), StageLoader(), {}
    for folder in ("kitti", "kitti_more"):
        with bevviz.open(shared / folder, model=model) as drive:
            for index in range(len(drive)):
                frame = drive.frames.frame(index)
                assert frame is not None and frame.truth is not None
                for detector in ("network", "labels"):
                    stages = loader.load(config, of_labels(frame) if detector == "labels" else None)
                    result = add_explanations(perceive(frame, config, stages), seen=False)
                    known = stages.class_names or ("car", "truck", "train", "person")
                    explainer = FrameExplainer(result, loader, known)
                    rows = range(len(frame.truth.labels))
                    labels = [explainer.ask(Selection(truth=row))[0] for row in rows]
                    name = f"{folder}/{index}/{detector}"
                    false = [
                        explainer.about(Selection(object=row)) for row in false_reasons(explainer.traces)
                    ]
                    frames[name] = Asked(name, result, explainer, labels, false)
    return frames


def partner_of(frame: Asked) -> list[int]:
    """Return the row of the label of each object, by the rule of ``evaluate``."""
    objects, labelled = frame.result.objects, frame.result.frame.truth
    assert objects is not None and labelled is not None
    partner, _ = match(objects, truth_of(frame.result.frame, labelled))
    return [int(row) for row in partner]


def test_reported_is_what_evaluate_counts(asked: dict[str, Asked]) -> None:
    for frame in asked.values():
        partner = partner_of(frame)
        for answer in frame.labels:
            assert answer.verdict.reported == (answer.subject.row in partner), (
                frame.name,
                answer.verdict.text,
            )


def test_noise_and_merged_agree_with_the_clustering_alone(asked: dict[str, Asked]) -> None:
    checked = {ReasonKind.NOISE: 0, ReasonKind.MERGED: 0}
    for frame in asked.values():
        config, obstacles = frame.result.config.clustering, frame.result.obstacles
        assert obstacles is not None
        first = dbscan(obstacles, config.eps, config.min_points)
        index = frame.explainer.traces
        for answer in frame.labels:
            kind, evidence = answer.verdict.kind, answer.evidence
            voxels = frame.result.voxels
            assert voxels is not None
            rows = index.obstacle[np.unique(voxels.inverse[evidence.points])]
            mine = first[rows[rows >= 0]]
            if kind is ReasonKind.NOISE:
                assert evidence.noise <= (mine < 0).sum() and evidence.neighbours < config.min_points
                assert evidence.noise >= max(evidence.aside_points, len(evidence.ground))
            elif kind is ReasonKind.MERGED and evidence.joined_by is None and evidence.mates:
                places = [index.place(mate) for mate, _ in evidence.mates]
                theirs = [index.obstacle[np.unique(voxels.inverse[place])] for place in places]
                shared = [np.intersect1d(mine[mine >= 0], first[rows[rows >= 0]]) for rows in theirs]
                assert any(len(labels) for labels in shared), (frame.name, answer.verdict.text)
            else:
                continue
            checked[kind] += 1
    assert checked[ReasonKind.NOISE] >= 8 and checked[ReasonKind.MERGED] >= 1


def test_the_fusion_is_named_where_it_joined_two_people(asked: dict[str, Asked]) -> None:
    first, second = asked["kitti/11/network"].labels[:2]
    assert first.verdict.reported and not second.verdict.reported
    assert {first.verdict.kind, second.verdict.kind} == {ReasonKind.MERGED}
    for answer in (first, second):
        assert answer.evidence.gap > 0.5 and " apart for person 0." in answer.verdict.text


def test_a_detection_may_fit_two_cars(asked: dict[str, Asked]) -> None:
    """Boxes of the car in front fit the hidden car, too; each is a candidate, and says whose box it is."""
    answer = asked["kitti/10/network"].labels[4]
    assert max(candidate.overlap for candidate in answer.evidence.candidates) > 0.3
    assert "not even with a score" not in answer.verdict.text


def test_a_detection_in_the_verdict_fits_the_object(asked: dict[str, Asked]) -> None:
    quoted = 0
    for frame in asked.values():
        for answer in frame.labels:
            best = answer.evidence.best
            if answer.verdict.kind in (ReasonKind.BELOW_THRESHOLD, ReasonKind.SUPPRESSED):
                assert best is not None and best.own and best.overlap >= 0.3 and not best.kept
                assert f"its detection {best.name} " in answer.verdict.text.replace("is too weak: ", "")
                quoted += 1
    assert quoted >= 10


def test_each_false_object_has_a_cause(asked: dict[str, Asked]) -> None:
    kinds = set()
    for frame in asked.values():
        labelled, objects = frame.result.frame.truth, frame.result.objects
        assert labelled is not None and objects is not None
        truth = truth_of(frame.result.frame, labelled)
        judged = frozenset().union(*truth.accepted)
        partner, ignored = partner_of(frame), exemptions(objects, truth, frame.result.cameras)
        false = {
            row
            for row, label in enumerate(partner)
            if label < 0 and not ignored[row] and objects.names[row] in judged
        }
        assert false <= {answer.subject.row for answer in frame.false}
        whole = [answer.subject.row for answer in frame.explainer.ask(Selection()) if answer.false]
        assert sorted(whole) == sorted(answer.subject.row for answer in frame.false)
        assert all(answer.false and answer.verdict.reported for answer in frame.false)
        kinds |= {answer.verdict.kind for answer in frame.false}
    assert {ReasonKind.DETECTOR_ERROR, ReasonKind.MISPLACED, ReasonKind.WRONG_DEPTH} <= kinds | {
        ReasonKind.WALL
    }


def test_without_ground_truth_doubtful_objects_are_false_ones(asked: dict[str, Asked]) -> None:
    doubtful, right = 0, 0
    for name, frame in asked.items():
        if name.endswith("network"):
            partner, result = partner_of(frame), frame.result
            blind = FrameExplainer(replace(result, frame=replace(result.frame, truth=None)))
            rows = [*false_reasons(blind.traces)]
            doubtful += len(rows)
            right += sum(partner[row] >= 0 for row in rows)
    assert doubtful >= 3 and right <= 1


@pytest.mark.long
def test_rows_of_lists_agree_with_their_answers(asked: dict[str, Asked]) -> None:
    """With ground truth and without, the list has the kind, subject, distance and reason of the answer."""
    rows = 0
    for frame in asked.values():
        unlabelled = replace(frame.result, frame=replace(frame.result.frame, truth=None))
        for result in (frame.result, unlabelled):
            listed = find_findings(FrameExplainer(result, classes=frame.explainer.traces.classes))
            again = FrameExplainer(result, classes=frame.explainer.traces.classes)
            marked = {finding.selection: finding.distance for finding in findings_of(again.traces)}
            for finding in listed:
                answer = again.ask(Selection.parse(str(finding.selection)))[0]
                assert (answer.selection, answer.subject.label.lower() or "cluster") == (
                    finding.selection,
                    finding.name.lower(),
                )
                assert answer.verdict.kind == finding.reason
                assert answer.distance == pytest.approx(finding.distance, nan_ok=True)
                assert answer.distance == pytest.approx(marked[finding.selection], nan_ok=True)
                assert answer.false == (finding.what in ("false", "doubtful"))
                assert answer.verdict.reported == answer.false, (frame.name, answer.verdict.text)
            if result is frame.result:
                false = [f.selection.row for f in listed if f.what == "false" and f.selection is not None]
                assert sorted(false) == sorted(answer.subject.row for answer in frame.false)
            rows += len(listed)
    assert rows > 200


def test_clicks_on_road_and_sky_are_no_alarm(asked: dict[str, Asked]) -> None:
    """Without ground truth, weak detections whose boxes cover the road or the sky are not the answer."""
    road, sky = 0, 0
    for name in ("kitti/0/network", "kitti/10/network", "kitti_more/3/network", "kitti_more/9/network"):
        result = asked[name].result
        explainer = FrameExplainer(replace(result, frame=replace(result.frame, truth=None)))
        camera, traces = result.cameras[0], explainer.traces
        assert camera.detections is not None
        boxes, uv = camera.detections.xyxy[camera.detections.kept], traces.uv(camera)
        on_image = np.isfinite(uv).all(axis=1) & (uv > 10).all(axis=1) & (uv < [1200, 360]).all(axis=1)
        others = uv[on_image & (traces.fate != Fate.GROUND)]
        pixels = uv[on_image & (traces.fate == Fate.GROUND)][::150].tolist()
        pixels += [(u, 15.0) for u in range(20, 1200, 60)]
        for u, v in pixels:
            in_box = ((boxes[:, :2] - 10 < (u, v)) & (boxes[:, 2:] + 10 > (u, v))).all(axis=1).any()
            if in_box or (np.abs(others - (u, v)).max(axis=1) < 12).any():
                continue
            answer = explainer.ask(Selection(box=(u, v)))[0]
            assert answer.verdict.text.startswith("There is "), (name, answer.verdict.text)
            assert answer.empty and not explainer.with_hints(answer).remark, answer.verdict.text
            road, sky = road + (v != 15), sky + (v == 15)
    assert road > 50 and sky > 20


def test_a_change_with_the_objects_own_detection_is_a_hint(asked: dict[str, Asked]) -> None:
    """The answers about misses name a change, or the result of each change that was tried."""
    helped = 0
    for name in ("kitti/2/network", "kitti_more/9/network", "kitti/11/network"):
        frame = asked[name]
        for answer in frame.labels:
            if answer.verdict.reported or answer.folded or not answer.near:
                continue
            after = frame.explainer.with_hints(answer)
            helped += len(after.hints)
            if not after.hints and after.tried:
                assert all(change.text in after.verdict.text for change in after.tried)
                tried = json_tree(AnswerResult.of(after))["tried"]
                assert [change["text"] for change in tried] == [change.text for change in after.tried]
    assert helped >= 2


def test_a_change_that_finds_it_is_not_called_useless(asked: dict[str, Asked]) -> None:
    """Lower thresholds find the pedestrian, merged with something else, but they break more."""
    frame = asked["kitti_more/3/network"]
    answer = frame.explainer.with_hints(frame.labels[2])
    assert answer.verdict.kind is ReasonKind.BELOW_THRESHOLD and not answer.hints
    found = [change.text for change in answer.tried if "reported" in change.text]
    assert {*found} == {"it is reported then, but 'merged', and it breaks as much"}
