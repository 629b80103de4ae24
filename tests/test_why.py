"""What ``bevviz why`` answers: the planted faults, KITTI object by object, and what cannot be asked."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from bevviz.bags.source import BagSource
from bevviz.cli import main
from bevviz.config import Config, load
from bevviz.errors import UserError
from bevviz.extras.demo.bag import BagWriter
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.model import geometry
from bevviz.model.frame import Boxes3D, LabelledBoxes3D
from bevviz.model.reasons import Limit, ReasonKind
from bevviz.model.results import DetectionState, FrameResult
from bevviz.pipeline.session import Session
from bevviz.why import Answer, FrameExplainer, Selection
from bevviz.why.answer_results import AnswerResult
from bevviz.why.answer_text import summary_line
from bevviz.why.collect import collect_evidence
from bevviz.why.frame_index import Fate, FrameIndex
from bevviz.why.subject import projected_box
from bevviz.why.verdict import likely_reasons
from tests.support import bags, documented_json
from tests.support.commands import error_of
from tests.support.planted_faults import at, drive, planted, run
from tests.support.recordings import Recording

CLASSES = ("car", "person", "cyclist")
Capture = pytest.CaptureFixture[str]
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


def why(
    result: FrameResult,
    selection: Selection,
    classes: Sequence[str] = (),
    hints: int = 5,
    *,
    everything: bool = False,
) -> list[Answer]:
    return FrameExplainer(result, classes=classes).explain(selection, hints, everything=everything)


def config_of(preset: str, *settings: str) -> Config:
    return load(None, ["detector.model=demo", *settings], "reference" if preset == "reference" else "default")


@cache
def asked(name: str, preset: str, label: str = "") -> list[Answer]:
    return why(run(name, preset), Selection(label=label), CLASSES, hints=0, everything=True)


def of_truth(answers: list[Answer], row: int) -> Answer:
    return next(a for a in answers if a.subject.kind == "truth" and a.subject.row == row)


def about(name: str, preset: str, row: int) -> Answer:
    """Return the answer about one object, with hints. The question is the object's box in the image."""
    result = run(name, preset)
    place = FrameIndex(result).truth[row].box
    box = projected_box(place, result.frame.cameras[0]) if place is not None else None
    assert box is not None
    (answer,) = why(result, Selection(box=tuple(box.tolist())), CLASSES, hints=1)
    assert (answer.subject.kind, answer.subject.row) == ("truth", row)
    return answer


def numbers(answer: Answer, stage: str) -> dict[str, object]:
    return dict(next(step for step in answer.steps if step.stage == stage).numbers)


# --- planted faults ----------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("preset", ["default", "reference"])
def test_a_hidden_person_is_explained(preset: str) -> None:
    (row,) = planted("hidden_person", "person", 16.3)
    answer = of_truth(asked("hidden_person", preset, "person"), row)
    assert answer.verdict.kind is ReasonKind.HIDDEN and not answer.verdict.reported
    evidence, occlusion = answer.evidence, numbers(answer, "occlusion")
    assert evidence.raw == 0 and evidence.in_front == evidence.aimed > 0 and evidence.front >= 0
    assert occlusion["in_front"] == occlusion["aimed"] == evidence.aimed
    returns = f"no points on it, and {evidence.aimed} of the {evidence.aimed} returns in its direction"
    assert f"{returns} end in front of it, most of them on cluster" in answer.verdict.text
    van = at("hidden_person").point_object[answer.fate == Fate.IN_FRONT]
    (car,) = planted("hidden_person", "car", 11.9)
    assert np.mean(van == at("hidden_person").truth_object[car]) > 0.9


def test_a_flat_car_removed_as_ground_is_explained() -> None:
    (row,) = planted("flat_car", "car", 10.0)
    assert of_truth(asked("flat_car", "default", "car"), row).verdict.kind is ReasonKind.REPORTED
    answer = about("flat_car", "reference", row)
    assert answer.verdict.kind is ReasonKind.GROUND
    assert answer.verdict.reason.limit == Limit("ground.distance_threshold", 0.5, "m")
    voxels = answer.evidence.voxels
    assert voxels > 300 and f"{voxels} of its {voxels} voxels, up to 0." in answer.verdict.text
    assert answer.hints[0].settings[0].startswith("ground.distance_threshold=")
    ground = numbers(answer, "ground")
    assert ground["threshold"] == 0.5 and 0.25 < float(str(ground["highest"])) < 0.5
    assert (answer.fate == Fate.GROUND).sum() > 300
    # The hint is true: with that setting the very car is an object.
    config = config_of("reference", *answer.hints[0].settings)
    session = Session(config)
    again = why(session.run(at("flat_car").frame), Selection(label="car"), CLASSES, hints=0)
    assert of_truth(again, row).verdict.reported


@cache
def merged_people(preset: str) -> FrameResult:
    """Two people in one cluster, which the camera is not asked to split."""
    settings = ["fusion.split=false"] if preset == "default" else []
    return Session(config_of(preset, *settings)).run(at("merged_people").frame)


@pytest.mark.parametrize("preset", ["default", "reference"])
def test_two_people_in_one_cluster_are_explained(preset: str) -> None:
    asked_of = why(merged_people(preset), Selection(label="person"), CLASSES, hints=0)
    answers = [of_truth(asked_of, r) for r in planted("merged_people", "person", 9.9)]
    assert [a.verdict.kind for a in answers] == [ReasonKind.MERGED] * 2
    assert sorted(a.verdict.reported for a in answers) == [False, True]
    lost = next(a for a in answers if not a.verdict.reported)
    merged = numbers(lost, "merged")
    assert 0.1 < float(str(merged["gap"])) < 0.5
    assert 0.1 < float(str(merged["eps_that_parts"])) < 0.5
    reason = lost.verdict.reason
    assert reason.limit == Limit("clustering.eps", 0.5, "m")
    assert f"the gap between them is {lost.evidence.gap:.2f} m and clustering.eps is 0.5 m" in reason.text


def test_two_people_split_by_the_camera_are_explained() -> None:
    answers = asked("merged_people", "default", "person")
    both = [of_truth(answers, row) for row in planted("merged_people", "person", 9.9)]
    assert [a.verdict.kind for a in both] == [ReasonKind.REPORTED] * 2
    texts = [e.text for e in run("merged_people", "default").explanations if e.state == "split"]
    assert any(re.fullmatch(r"cluster \d+ split by person 0.\d+: \d+ of [\d,]+ points.*", t) for t in texts)
    assert any("which split it off " in a.verdict.text for a in both)


def test_the_hint_that_splits_two_people_is_proved() -> None:
    result = merged_people("default")
    answers = why(result, Selection(label="person"), CLASSES, hints=1)
    lost = next(a for a in answers if a.verdict.kind is ReasonKind.MERGED and not a.verdict.reported)
    assert lost is answers[0]
    assert lost.hints[0].settings == ("fusion.split=true",)
    assert "; change fusion.split=true: it is cluster " in lost.verdict.text
    session = Session(config_of("default", *lost.hints[0].settings))
    again = why(session.run(result.frame), Selection(label="person"), CLASSES, hints=0)
    assert all(
        of_truth(again, row).verdict.kind is ReasonKind.REPORTED
        for row in planted("merged_people", "person", 9.9)
    )


def test_two_people_are_explained_without_truth() -> None:
    result = merged_people("default")
    blind = replace(result, frame=replace(result.frame, truth=None))
    answers = why(blind, Selection(label="person"), CLASSES, hints=0)
    merged = [a for a in answers if a.verdict.kind is ReasonKind.MERGED]
    assert merged and all(a.subject.kind == "detection" for a in merged)
    assert any(not a.verdict.reported and a.evidence.mates for a in merged)


def test_two_losses_without_truth_are_both_named() -> None:
    """Ground and noise took about as much of it, and no ideal result can tell which one mattered."""
    result = run("flat_car", "reference")
    blind = replace(result, frame=replace(result.frame, truth=None))
    explainer = FrameExplainer(blind, classes=CLASSES)
    subject = next(a.subject for a in explainer.ask(Selection()) if a.subject.kind == "detection")
    evidence = collect_evidence(subject, explainer.traces)
    lost = replace(evidence, ground=np.full(30, 0.3, np.float32), noise=25, main=-1, parts=())
    reasons = likely_reasons(subject, lost, explainer.traces, ReasonKind.GROUND)
    assert reasons == (ReasonKind.GROUND, ReasonKind.NOISE)
    few = replace(lost, noise=5)
    assert likely_reasons(subject, few, explainer.traces, ReasonKind.GROUND) == ()
    known = FrameIndex(result)
    assert likely_reasons(subject, lost, known, ReasonKind.GROUND) == (), "ground truth tells"


@pytest.mark.long
def test_a_box_that_names_two_clusters_is_explained() -> None:
    (row,) = planted("shared_box", "person", 8.7)
    assert of_truth(asked("shared_box", "default", "person"), row).verdict.kind is ReasonKind.REPORTED
    answer = about("shared_box", "reference", row)
    assert answer.verdict.kind is ReasonKind.SHARED_BOX and answer.verdict.reported
    assert "its box also names cluster" in answer.verdict.text
    assert answer.hints[0].settings == ("fusion.method=frustum",)
    cabinet = Selection(point=(10.0, -3.9, -0.8))
    (other,) = why(run("shared_box", "reference"), cabinet, CLASSES)
    assert other.verdict.kind is ReasonKind.BORROWED
    assert "is named person by a box that also names cluster" in other.verdict.text
    assert other.hints[0].text == "it is not named any more"
    (rightly,) = why(run("shared_box", "default"), cabinet, CLASSES, hints=0)
    assert not rightly.verdict.reported


# --- selections --------------------------------------------------------------------------------


def test_without_a_selection_what_went_wrong_comes_worst_first() -> None:
    everything = asked("merged_people", "default")
    folded = [a.folded for a in everything]
    assert folded == sorted(folded) and any(folded) and not folded[0]
    open_ = why(run("merged_people", "default"), Selection(), CLASSES, hints=0)
    wrong = [a for a in everything if not a.folded and a.verdict.kind is not ReasonKind.REPORTED]
    assert [a.subject.name for a in open_] == [a.subject.name for a in wrong]
    reported = [a.verdict.reported for a in open_]
    assert reported == sorted(reported) and not reported[0]
    for near in (True, False):
        lost = [a.distance for a in open_ if not a.verdict.reported and a.near is near]
        assert lost and np.isfinite(lost[:-1]).all() and lost == sorted(lost)
    assert [a.near for a in open_[: len(lost)]] == sorted([a.near for a in open_[: len(lost)]], reverse=True)


def test_a_pixel_is_the_detection_there() -> None:
    result = run("merged_people", "default")
    seen = result.cameras[0].detections
    assert seen is not None
    person = next(d for d, name in enumerate(seen.names) if name == "person" and seen.score[d] > 0.6)
    u, v = (seen.xyxy[person, :2] + seen.xyxy[person, 2:]) / 2
    (known,) = why(result, Selection(box=(float(u), float(v))), CLASSES, hints=0)
    assert known.subject.kind == "truth", "what is known of it says more than the detection"
    result = replace(result, frame=replace(result.frame, truth=None))
    detections = result.cameras[0].detections
    assert detections is not None
    best = int(np.flatnonzero(detections.state == DetectionState.KEPT)[0])
    u, v = (detections.xyxy[best, :2] + detections.xyxy[best, 2:]) / 2
    (answer,) = why(result, Selection(box=(float(u), float(v))), CLASSES, hints=0)
    assert (answer.subject.kind, answer.subject.row) == ("detection", best)
    (same,) = why(result, Selection(box=tuple(detections.xyxy[best].tolist())), CLASSES, hints=0)
    assert same.subject.row == best
    (sky,) = why(result, Selection(box=(320.0, 5.0)), CLASSES, hints=0)
    assert sky.subject.kind == "pixel"
    assert sky.verdict.kind is ReasonKind.NO_POINTS


def test_the_outcomes_of_all_points_add_up() -> None:
    """Every raw point at the place has one fate, and nothing else has any but what hides it."""
    shot = at("merged_people")
    for answer in asked("merged_people", "default", "person"):
        there = np.zeros(len(shot.frame.points), bool)
        there[answer.evidence.points] = True
        others = answer.fate[~there]
        assert set(np.unique(others)) <= {Fate.ELSEWHERE, Fate.IN_FRONT}
        assert not np.isin(answer.fate[there], [Fate.ELSEWHERE, Fate.IN_FRONT]).any()
        assert numbers(answer, "raw cloud")["points"] == there.sum()


def test_a_pixel_lists_its_objects_with_the_visible_one_first() -> None:
    """A cyclist that is missed before a car: neither the pixel nor the box is answered for the car."""
    shot, questioner = at("merged_people"), FrameExplainer(run("merged_people", "default"), classes=CLASSES)
    asked_for = 0
    for row, number in enumerate(shot.truth_object.tolist()):
        ys, xs = np.nonzero(shot.pixel_object == number)
        if len(xs) < 400 or xs.min() == 0:  # of what is cut off no box fits the rest
            continue
        middle = np.argmin((xs - xs.mean()) ** 2 + (ys - ys.mean()) ** 2)
        pixel = Selection(box=(float(xs[middle]), float(ys[middle])))
        around = Selection(box=(float(xs.min()), float(ys.min()), float(xs.max()), float(ys.max())))
        for selection in (pixel, around):
            found = questioner.candidates(selection)
            assert questioner.ask(selection)[0].subject is found[0].subject
            assert (found[0].subject.kind, found[0].subject.row) == ("truth", row), found[0].subject.name
        assert len({a.subject.key for a in questioner.candidates(pixel)}) == len(questioner.candidates(pixel))
        asked_for += 1
    assert asked_for >= 4


def test_an_empty_place_is_described() -> None:
    questioner = FrameExplainer(run("flat_car", "default"), classes=CLASSES)
    (road,) = questioner.ask(Selection(point=(-5.0, 1.0, -1.9)))
    assert road.verdict.text.startswith("There is only ground at -5, 1, -1.9 m: ")
    assert f"{road.evidence.raw} points, all ground, -0.0" in road.verdict.text
    (air,) = questioner.ask(Selection(point=(-5.0, 1.0, 5.0)))
    assert air.verdict.kind is ReasonKind.NO_POINTS
    assert ": the LiDAR has no points within 0.5 m, the nearest is " in air.verdict.text
    assert not questioner.candidates(Selection(point=(-5.0, 1.0, 5.0)))
    (pixel,) = questioner.ask(Selection(box=(60.0, 350.0)))
    assert pixel.verdict.text.startswith("There is only ground at pixel 60, 350: ")


def test_a_cell_of_the_birds_eye_view_is_the_column_over_it() -> None:
    result = run("merged_people", "default")
    questioner, clusters = FrameExplainer(result, classes=CLASSES), result.clusters
    assert clusters is not None and result.bev is not None
    for k in np.flatnonzero(clusters.kept)[:10].tolist():
        inside = result.frame.points[questioner.traces.cluster == k]
        x, y = inside[len(inside) // 2, :2].tolist()
        reach, step = result.config.bev.range_x, result.config.bev.resolution
        cell = Selection(cell=(int((reach - x) / step), int((reach - y) / step)))
        (answer,) = questioner.ask(cell)
        assert answer.subject.kind == "cell" and k in {part.cluster for part in answer.evidence.parts}
        there = result.frame.points[answer.evidence.points]
        assert np.abs(there[:, :2] - (x, y)).max() <= 0.5 + 0.1 + 0.02
        names = {a.subject.row for a in questioner.candidates(cell) if a.subject.kind == "cluster"}
        assert k in names or any(a.subject.kind == "truth" for a in questioner.candidates(cell))
    with pytest.raises(UserError, match="cell 900, 3: outside the bird's-eye view, which has 800 rows"):
        questioner.ask(Selection(cell=(900, 3)))


@pytest.mark.long
def test_a_track_is_its_cluster_or_its_expected_place() -> None:
    source, session = SyntheticSource(20, seed=3), Session(config_of("default"))
    for index in range(6):
        result = session.run(source.frame(index))
    tracks = result.tracks
    assert tracks is not None
    questioner = FrameExplainer(result, classes=CLASSES)
    seen = int(np.flatnonzero((tracks.cluster >= 0) & (tracks.object >= 0))[0])
    (answer,) = questioner.ask(Selection(track=int(tracks.id[seen])))
    assert answer.verdict.reported and answer.subject.label == tracks.names[seen]
    assert answer.evidence.main == tracks.cluster[seen]
    expected = np.flatnonzero(tracks.cluster < 0)
    assert len(expected)
    (lost,) = questioner.ask(Selection(track=int(tracks.id[expected[0]])))
    assert not lost.verdict.reported and lost.subject.box is not None
    with pytest.raises(UserError, match="there is no track 9999 in this frame; there are "):
        questioner.ask(Selection(track=9999))
    with pytest.raises(UserError, match="tracks are known in a run over the drive only"):
        FrameExplainer(session.run_single(source.frame(6))).ask(Selection(track=1))


def test_a_row_number_selects_that_row_of_the_result() -> None:
    result = run("merged_people", "default")
    questioner = FrameExplainer(result, classes=CLASSES)
    assert result.objects is not None and result.clusters is not None
    (thing,) = questioner.ask(Selection(object=0))
    assert thing.verdict.reported and thing.subject.label == result.objects.names[0]
    (cluster,) = questioner.ask(Selection(cluster=int(result.objects.cluster[0])))
    assert cluster.verdict.reported and f" is named {result.objects.names[0]} by " in cluster.verdict.text
    (detection,) = questioner.ask(Selection(detection=int(result.objects.detection[0]), camera="zed"))
    assert detection.verdict.reported and detection.subject.kind == "detection"
    for wrong in (
        Selection(object=99),
        Selection(cluster=999),
        Selection(detection=999),
        Selection(truth=999),
    ):
        with pytest.raises(UserError, match=r"there is no .*99"):
            questioner.ask(wrong)


def test_the_nearest_missed_is_near_and_missed() -> None:
    missed = FrameExplainer(run("merged_people", "default"), classes=CLASSES).missed()
    assert len(missed) >= 2
    assert not any(a.verdict.reported or a.folded for a in missed)
    assert all(a.distance <= 40 and a.points >= 10 for a in missed)
    assert [a.distance for a in missed] == sorted(a.distance for a in missed)


def test_weak_detections_are_told_only_on_request() -> None:
    result = run("merged_people", "default")
    blind = FrameExplainer(replace(result, frame=replace(result.frame, truth=None)), classes=CLASSES)
    told, everything = (blind.explain(Selection(), 0, everything=flag) for flag in (False, True))
    weak = [a for a in everything if a.weak]
    scores = [a.evidence.best.score for a in weak if a.evidence.best is not None]
    assert len(scores) == len(weak) > 20 and scores == sorted(scores, reverse=True)
    assert everything[-len(weak) :] == weak and not any(a.folded for a in told)
    assert f"{len(weak)} weak detections (folded: --all)" in summary_line(blind.ask(Selection()))
    for answer in everything:  # what is missed has a place, too: where the middle of its box has most points
        assert np.isfinite(answer.distance) or answer.points == 0


# --- stages that did not run -------------------------------------------------------------------


@pytest.mark.long
def test_without_a_model_no_detector_is_said_to_have_looked() -> None:
    frame = at("merged_people").frame
    lens = replace(frame.cameras[0], image=None, problems=("no image within 0.1 s",))
    no_model = Session(load()).run(frame)
    no_image = Session(config_of("default")).run(replace(frame, cameras=(lens,)))
    no_camera = Session(config_of("default")).run(replace(frame, cameras=()))
    for result, what in (
        (no_model, "detector.model is not set"),
        (no_image, "no image within 0.1 s"),
        (no_camera, "there is no camera"),
    ):
        answers = why(result, Selection(label="person"), CLASSES, hints=1)
        never = [a for a in answers if a.verdict.kind is ReasonKind.NOT_RUN]
        assert len(never) >= 2 and all(
            a.verdict.reason.text == f"the detector never ran: {what}" for a in never
        )
        assert not any(a.tried for a in never), "no value of a stage gives it an image or a model"
        assert not any(a.verdict.reported or "no candidate" in str(AnswerResult.of(a)) for a in answers)
        assert "the detector never ran" in summary_line(answers)
        box = never[0].subject.box
        assert box is not None
        (there,) = why(result, Selection(point=tuple(box.center[0].tolist())), CLASSES)
        assert there.verdict.kind is ReasonKind.NOT_RUN


def test_a_camera_without_a_place_compares_nothing() -> None:
    frame = at("merged_people").frame
    lens = replace(frame.cameras[0], camera_from_points=None, problems=("no transform to zed",))
    result = Session(config_of("default")).run(replace(frame, cameras=(lens,)))
    answers = why(result, Selection(label="person"), CLASSES, hints=0)
    clustered = [a for a in answers if a.subject.kind == "truth" and a.evidence.main >= 0]
    assert clustered and {a.verdict.kind for a in clustered} == {ReasonKind.NOT_FUSED}
    text = clustered[0].verdict.reason.text
    assert text == "zed could not be compared with clusters: no transform to zed"


def test_weak_detections_are_not_called_suppressed() -> None:
    """A rival is not to blame for what would have been dropped without it."""
    result = Session(config_of("default", "detector.conf_threshold=0.5")).run(at("merged_people").frame)
    questioner, detections = FrameExplainer(result, classes=CLASSES), result.cameras[0].detections
    assert detections is not None
    suppressed = np.flatnonzero(detections.state == DetectionState.SUPPRESSED)
    weak = suppressed[detections.score[suppressed] < 0.5]
    assert len(weak) and len(weak) < len(suppressed)
    for row in suppressed.tolist():
        (answer,) = questioner.ask(Selection(detection=row))
        right = ReasonKind.BELOW_THRESHOLD if row in weak else ReasonKind.SUPPRESSED
        assert answer.verdict.kind is right


def test_a_hint_names_its_side_effects() -> None:
    (row,) = planted("flat_car", "car", 10.0)
    answer = about("flat_car", "reference", row)
    effects = answer.hints[0].effects
    assert any(name.startswith("car at 10.") for name in effects.names.fixed)
    assert f"(in this frame: {effects.text})" in answer.verdict.text
    before = run("flat_car", "reference").objects
    after = Session(config_of("reference", *answer.hints[0].settings)).run(at("flat_car").frame).objects
    assert before is not None and after is not None
    names = effects.names
    assert not names.false_gone
    assert len(after) - len(before) == len(names.fixed) + len(names.added) - len(names.lost)


@pytest.mark.parametrize(
    ("selection", "message"),
    [
        (Selection(label="preson"), "--class preson: no such class; did you mean 'person'"),
        (Selection(label="zebra"), "no such class; there are car, cyclist, person"),
        (Selection(box=(700.0, 10.0)), "outside the image of zed, which has 640 x 360 pixels"),
        (Selection(box=(50.0, 50.0, 40.0, 60.0)), "outside the image of zed"),
        (
            Selection(box=(5.0, 5.0), camera="left"),
            "--camera left: there is none of that name; there are zed",
        ),
        (Selection(camera="left"), "--camera left: there is none"),
    ],
)
def test_wrong_subjects_are_one_line(selection: Selection, message: str) -> None:
    with pytest.raises(UserError, match=message) as caught:
        why(run("merged_people", "default"), selection, CLASSES, hints=0)
    assert "\n" not in str(caught.value)


def test_the_camera_is_chosen_or_reported_missing() -> None:
    result = run("merged_people", "default")
    other = replace(result.cameras[0], camera=replace(result.cameras[0].camera, name="left"))
    both = replace(result, cameras=(*result.cameras, other))
    with pytest.raises(UserError, match="several cameras: say which with --camera, one of zed, left"):
        why(both, Selection(box=(5.0, 5.0)), CLASSES, hints=0)
    with pytest.raises(UserError, match="no camera: ask with --point"):
        why(replace(result, cameras=()), Selection(box=(5.0, 5.0)), CLASSES, hints=0)


def test_a_failed_stage_is_the_reason() -> None:
    config = config_of("default")
    session = Session(config)
    result = session.run(replace(at("flat_car").frame, points=np.zeros((0, 3), np.float32)))
    answers = why(result, Selection(label="car"), CLASSES, hints=0)
    assert answers and {a.verdict.kind for a in answers} == {ReasonKind.FAILED}
    assert "cloud failed: the cloud holds no finite point" in answers[0].verdict.text


# --- KITTI -------------------------------------------------------------------------------------


def kitti_truth(shared: Path, result: FrameResult, name: str) -> FrameResult:
    """Return the result with the label file as ground truth."""
    kitti = bags.kitti(shared, name)
    lidar_from_camera = geometry.inverse(kitti.camera_from_lidar)
    p2 = kitti.pixels_from_lidar @ lidar_from_camera
    assert np.allclose(p2[:, 3], 0, atol=1e-3)  # camera_from_lidar goes to image_2's own centre
    rows = (shared / "kitti/calib" / f"{name}.txt").read_text().splitlines()
    values = np.array(next(r for r in rows if r.startswith("P2:")).split()[1:], float).reshape(3, 4)
    shift = np.linalg.solve(values[:, :3], values[:, 3])
    labels, centers, sizes, yaws = [], [], [], []
    for line in (shared / "kitti/label_2" / f"{name}.txt").read_text().splitlines():
        kind, *rest = line.split()
        if kind == "DontCare":
            continue
        height, width, length, x, y, z, turn = np.array(rest, float)[7:14]
        centre = np.array([x, y - height / 2, z]) + shift
        labels.append(kind)
        centers.append((lidar_from_camera @ [*centre, 1])[:3])
        sizes.append((length, width, height))
        yaws.append(-turn - np.pi / 2)
    boxes = Boxes3D(np.array(centers, np.float32), np.array(sizes, np.float32), np.array(yaws, np.float32))
    truth = LabelledBoxes3D(
        "labels",
        result.frame.stamp,
        result.frame.points_frame,
        boxes,
        tuple(labels),
        np.ones(len(labels), np.float32),
    )
    return replace(result, frame=replace(result.frame, truth=truth))


@pytest.fixture(scope="module")
def kitti(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Answer]]:
    bag = bags.write(tmp_path_factory.mktemp("kitti") / "kitti", bags.kitti_items(shared))
    config = load(settings=[f"detector.model={shared / 'models/yolox_nano.onnx'}"])
    with BagSource([bag], config) as source:
        session = Session(config)
        names, found = session.stages.class_names, {}
        for name, frame in zip(("000000", "000001"), source, strict=True):
            result = kitti_truth(shared, session.run(frame), name)
            wrong = why(result, Selection(), names, hints=8)
            found[name] = wrong + why(result, Selection(label="person"), names, hints=0)
        return found


def test_kitti_000000_the_pedestrian_is_reported(kitti: dict[str, list[Answer]]) -> None:
    answer = next(a for a in kitti["000000"] if a.subject.label == "Pedestrian")
    assert answer.verdict.kind is ReasonKind.REPORTED
    assert " is named person by person " in answer.verdict.text
    assert int(str(numbers(answer, "raw cloud")["points"])) > 300


def test_kitti_000001_each_object_has_its_reason(kitti: dict[str, list[Answer]]) -> None:
    by_label = {a.subject.label: a for a in kitti["000001"] if a.subject.kind == "truth"}
    assert {label: a.verdict.kind for label, a in by_label.items()} == {
        "Cyclist": ReasonKind.NOT_DETECTED,  # 46 m away: it has a cluster and no detection
        "Car": ReasonKind.GROUND,  # 61 m: 9 points, of which more than half are on the road's level
        "Truck": ReasonKind.BELOW_THRESHOLD,  # 70 m: it has a cluster, and a detection of 0.01
    }
    assert not any(a.verdict.reported for a in by_label.values())
    reasons = {label: a.verdict.reason for label, a in by_label.items()}
    assert "it was taken for ground: 5 of its 9 voxels" in reasons["Car"].text
    assert reasons["Truck"].text.startswith("its detection is too weak: car 0.01, ")
    assert reasons["Truck"].limit == Limit("detector.conf_threshold", 0.25)
    raw = {label: numbers(a, "raw cloud")["points"] for label, a in by_label.items()}
    assert raw == {"Cyclist": 18, "Car": 9, "Truck": 73}


# --- the command -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("why") / "drive.mcap"
    with BagWriter(drive(), path) as writer:
        writer.write(at("flat_car").frame)
        writer.write(drive().snapshot(31).frame)
    return path


def test_the_command_answers_and_draws(bag: Path, tmp_path: Path, capsys: Capture) -> None:
    saved = tmp_path / "why.rrd"
    command = ["why", str(bag), "--at", "0", "--class", "car", "--model", "demo", "--preset", "reference"]
    assert main([*command, "--limit", "1", "--save", str(saved)]) == 0
    said = capsys.readouterr().out
    assert "The car at 10.1 m was not reported because it was taken for ground" in said
    assert "  ground       " in said and "more, without their chains" in said
    recording = Recording(saved)
    (text,) = recording.text("/explain/why")
    assert "it was taken for ground" in text
    (points,) = recording.column("/explain/why/points", "Points3D:positions")
    assert len(points) > 300
    assert recording.column("/explain/why/place", "LineStrips3D:strips")
    for entity in ("/explain/why/place", "/explain/why/points", "/explain/why/legend"):
        assert recording.static[entity]["CoordinateFrame:frame"] == ["tf#/world/rslidar"]
        assert not recording.column(entity, "Transform3D:translation"), "Rerun drops it at a clear"
    assert recording.column("/explain/why/zed/place", "Boxes2D:half_sizes")
    assert recording.column("/explain", "TextDocument:text"), "the frame itself is there, too"
    (lines,) = recording.column("/explain/why/legend", "Points3D:labels")
    assert lines[0] == f"{len(points)} taken for ground" and lines[1] == "the car at 10.1 m"
    assert recording.column("/bev/overlay/why", "LineStrips2D:strips")


def test_a_class_that_the_model_lacks_is_named(bag: Path, capsys: Capture) -> None:
    command = ("why", bag, "--at", "0", "--model", "demo", "--class")
    for name, wanted in (("bicycle", "the model has no such class"), ("dog", "no such class")):
        assert wanted in (said := error_of(capsys, *command, name))
        assert all(known in said for known in ("car", "cyclist", "person"))


def test_the_command_prints_json(bag: Path, capsys: Capture) -> None:
    command = ["why", str(bag), "--at", "0", "--model", "demo", "--json", "--point", "10,-2.7,-1.6"]
    assert main(command) == 0
    found = json.loads(capsys.readouterr().out)
    documented_json.check(found, "bevviz.why/1")
    (answer,) = found["answers"]
    assert found["preset"] == "default" and answer["kind"] == "point"
    assert answer["reported"] and answer["reason"] == "reported"
    assert [step["stage"] for step in answer["chain"]][:3] == ["camera zed", "raw cloud", "occlusion"]


@pytest.mark.long
def test_frames_are_chosen_by_negative_or_scan_numbers(bag: Path, capsys: Capture) -> None:
    command = ["why", str(bag), "--model", "demo"]
    assert main([*command, "--at-frame", "0", "--point", "-5,1,-1.9"]) == 0
    said = capsys.readouterr().out
    assert said.startswith("frame 0, preset default: what is at -5, 1, -1.9 m\n")
    assert "There is only ground at -5, 1, -1.9 m" in said
    assert main([*command, "--at-frame", "1", "--limit", "1"]) == 0
    said = capsys.readouterr().out
    first, _, rest = said.partition("\n")
    counts = re.fullmatch(r"frame 1, preset default: (\d+) objects: (\d+) reported.*, (\d+) hidden.*", first)
    assert counts is not None and first.endswith("(folded: --all)")
    assert "is hidden" not in rest and "no camera has it in view" not in rest
    assert main([*command, "--at-frame", "1", "--all", "--limit", "1"]) == 0
    everything = capsys.readouterr().out
    assert len(everything.splitlines()) >= len(said.splitlines()) + int(counts[2]) - 3 + int(counts[3])
    assert everything.count("is hidden: ") + everything.count("no camera has it") > 0
    assert main([*command, "--at-frame", "99"]) == 2
    assert "frame 99: " in capsys.readouterr().err


def test_other_objects_at_a_place_are_listed(bag: Path, capsys: Capture) -> None:
    assert main(["why", str(bag), "--model", "demo", "--at-frame", "0", "--point", "10,-2.7,-1.6"]) == 0
    said = capsys.readouterr().out
    assert "also there:\n- The car at 10.1 m was reported" in said


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--at", "100"], "100 is outside the recording"),
        (["--at", "noon"], "'noon' is no time"),
        (["--at", "0", "--class", "zebra", "--model", "demo"], "--class zebra: no such class"),
        (["--at", "0", "--box", "1000,1000"], "outside the image of zed"),
        (["--at-frame", "0", "--cluster", "999"], "there is no cluster 999 in this frame: it has "),
    ],
)
def test_wrong_questions_are_one_line(bag: Path, capsys: Capture, arguments: list[str], message: str) -> None:
    assert main(["why", str(bag), *arguments]) == 2
    said = capsys.readouterr().err
    assert said.count("bevviz: error: ") == 1 and message in said


@pytest.mark.parametrize(
    "arguments",
    [["--box", "1,2,3"], ["--point", "a,b,c"], ["--radius", "-1"], ["--class", "a", "--box", "1,2"]],
)
def test_numbers_out_of_range_are_refused(bag: Path, capsys: Capture, arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["why", str(bag), "--at", "0", *arguments])
    assert ended.value.code == 2
    assert "error: argument" in capsys.readouterr().err
