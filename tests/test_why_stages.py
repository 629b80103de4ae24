"""What ``bevviz why`` says where stages are somebody's function or the robot's: whose it was, and no more."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from bevviz.config import load
from bevviz.model.frame import Boxes3D, Frame, LabelledBoxes2D, LabelledBoxes3D
from bevviz.model.reasons import ReasonKind
from bevviz.model.results import FrameResult
from bevviz.pipeline.session import Session
from bevviz.why import Answer, FrameExplainer, Selection
from tests.support.modules import forget_modules
from tests.support.planted_faults import at

CLASSES = ("car", "person", "cyclist")
MODULE = '''
import numpy as np
from pydantic import BaseModel


class Params(BaseModel):
    cell: float = 0.8


def cells(points, params):
    """A cluster is a cell seen from above; the even ones are dropped."""
    cell = np.floor(points[:, :2] / params.cell).astype(np.int64)
    _, label = np.unique(cell, axis=0, return_inverse=True)
    label = label.ravel()
    return np.where(cell.sum(axis=1) % 2, label, -1)


def flat(points):
    return np.ones(len(points), bool)


def blind(bgr):
    return np.zeros((0, 4)), np.zeros(0), []


def pillars(points):
    return np.array([[10.0, 0, 0, 4, 2, 1.5, 0.3]]), [0.9], ["car"]
'''


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Where somebody's module is found."""
    (tmp_path / "somebody.py").write_text(textwrap.dedent(MODULE))
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    forget_modules("somebody")


@cache
def frame() -> Frame:
    return at("merged_people").frame


@cache
def ours() -> FrameResult:
    return Session(load(settings=["detector.model=demo"])).run(frame())


def ask(result: FrameResult, hints: bool = False) -> list[Answer]:
    questioner = FrameExplainer(result, classes=CLASSES)
    answers = [a for a in questioner.ask(Selection()) if a.subject.kind == "truth"]
    return [questioner.with_hints(a) for a in answers[:5]] if hints else answers


def of(answers: Sequence[Answer], reason: ReasonKind) -> list[Answer]:
    return [a for a in answers if a.verdict.kind is reason]


def parameters_in(answer: Answer, *sections: str) -> list[str]:
    """Parameters of ours that the verdict or the chain names."""
    said = " ".join([answer.verdict.text, *(step.text for step in answer.steps)])
    return [word for word in said.split() if word.lstrip("(").startswith(sections)]


# --- somebody's functions ----------------------------------------------------------------------


def test_losses_of_a_user_clustering_name_it(here: Path) -> None:
    result = Session(load(settings=["detector.model=demo", "clustering.method=somebody:cells"])).run(frame())
    assert result.failures == ()
    lost = of(ask(result), ReasonKind.NO_CLUSTER)
    assert lost and not of(ask(result), ReasonKind.NOISE)
    for answer in lost:
        assert answer.verdict.reason.by == "somebody:cells" and "robot" not in answer.verdict.text
        assert not parameters_in(answer, "clustering.eps", "clustering.min_points")


def test_a_hint_may_be_a_parameter_of_a_user_stage(here: Path) -> None:
    """Of ours only those that still have a say."""
    theirs = ("clustering.method=somebody:cells", "clustering.cell=1.5")
    result = Session(load(settings=["detector.model=demo", *theirs])).run(frame())
    questioner = FrameExplainer(result, classes=CLASSES)
    hints = [hint for answer in questioner.missed() for hint in questioner.search(answer).hints]
    keys = {setting.partition("=")[0] for hint in hints for setting in hint.settings}
    assert "clustering.params.cell" in keys
    assert not keys & {"clustering.eps", "clustering.min_points"}


def test_user_ground_and_detector_are_named(here: Path) -> None:
    flat = Session(load(settings=["detector.model=demo", "ground.method=somebody:flat"])).run(frame())
    ground = of(ask(flat), ReasonKind.GROUND)
    assert ground and all(a.verdict.reason.by == "somebody:flat" for a in ground)
    assert all(a.verdict.reason.limit is None for a in ground)
    assert not any(parameters_in(a, "ground.") for a in ground)
    blind = Session(load(settings=["detector.model=somebody:blind"])).run(frame())
    unseen = of(ask(blind), ReasonKind.NOT_DETECTED)
    assert unseen and all(a.verdict.reason.by == "somebody:blind" for a in unseen)


def test_a_detector_of_objects_is_not_asked_for_its_clusters(here: Path) -> None:
    result = Session(load(settings=["objects.method=somebody:pillars"])).run(frame())
    answers = ask(result, hints=True)
    missed = of(answers, ReasonKind.NOT_AMONG)
    assert missed and all(a.verdict.reason.by == "somebody:pillars" for a in missed)
    assert not any(parameters_in(a, "fusion.") or a.hints for a in missed)


# --- the robot's -------------------------------------------------------------------------------


def published(drop_cluster: int = -1, drop_detection: int = -1, drop_object: int = -1) -> Frame:
    """Return the frame with the outputs of a robot that runs our stages, except for the dropped ones."""
    result = ours()
    clusters, objects, detections = result.clusters, result.objects, result.cameras[0].detections
    assert clusters is not None and objects is not None and detections is not None
    head = frame().stamp, frame().points_frame
    kept = np.array([k for k in np.flatnonzero(clusters.kept).tolist() if k != drop_cluster])
    sure = [d for d in np.flatnonzero(detections.kept).tolist() if d != drop_detection]
    rows = [j for j in range(len(objects)) if j != drop_object]

    def boxes(of: Boxes3D, which: Sequence[int]) -> Boxes3D:
        chosen = list(which)
        return Boxes3D(of.center[chosen], of.size[chosen], of.yaw[chosen])

    stated = LabelledBoxes3D(
        "/clusters",
        *head,
        boxes(clusters.obb, kept.tolist()),
        ("cluster",) * len(kept),
        np.ones(len(kept), "f4"),
    )
    names = tuple(objects.names[j] for j in rows)
    fused = LabelledBoxes3D("/fused", *head, boxes(objects.boxes, rows), names, objects.score[rows])
    labels = tuple(detections.names[d] for d in sure)
    seen = LabelledBoxes2D(
        "/camera_2d", frame().stamp, "zed", detections.xyxy[sure], labels, detections.score[sure], "zed"
    )
    return replace(frame(), robot_boxes=(stated, fused), robot_detections=(seen,))


ROBOT = (
    "clustering.method=topic:/clusters",
    "detector.model=topic:/camera_2d",
    "objects.method=topic:/fused",
)


def reported_object() -> tuple[int, int]:
    """Row of the truth and of the object of the one that went well and stands the most alone."""
    clusters = ours().clusters
    assert clusters is not None
    centre, radius = clusters.obb.center[:, :2], np.linalg.norm(clusters.obb.size[:, :2], axis=1) / 2
    gaps = {}
    for answer in ask(ours()):
        named = answer.evidence.named
        if answer.verdict.kind is ReasonKind.REPORTED and named is not None and answer.distance < 25:
            others = clusters.kept & (np.arange(len(clusters)) != named.cluster)
            away = np.linalg.norm(centre - centre[named.cluster], axis=1) - radius
            gaps[answer.subject.row, named.row] = np.min(away[others]) - radius[named.cluster]
    return max(gaps, key=lambda rows: gaps[rows])


def robots_answer(robot: Frame, row: int, *settings: str) -> Answer:
    result = Session(load(settings=settings)).run(robot)
    assert result.failures == ()
    return next(a for a in ask(result) if a.subject.row == row)


def test_each_of_the_robots_stages_is_blamed_for_what_it_lost() -> None:
    row, j = reported_object()
    objects = ours().objects
    assert objects is not None
    k, d = int(objects.cluster[j]), int(objects.detection[j])
    well = robots_answer(published(), row, *ROBOT)
    assert well.verdict.reported and well.verdict.reason.by == "/fused"
    fusion = robots_answer(published(drop_object=j), row, *ROBOT)
    assert fusion.verdict.kind is ReasonKind.LOST_IN_FUSION
    assert re.search(
        r"cluster \d+ of /clusters and \w+ 0.\d+ of /camera_2d are there, but no object of /fused; ours ",
        fusion.verdict.text,
    )
    clustering = robots_answer(published(drop_cluster=k, drop_object=j), row, *ROBOT)
    assert clustering.verdict.kind is ReasonKind.NO_CLUSTER
    assert "the robot's clustering lost it: " in clustering.verdict.text
    detector = robots_answer(published(drop_detection=d, drop_object=j), row, *ROBOT)
    assert detector.verdict.kind is ReasonKind.NOT_DETECTED
    assert "the robot's detector lost it: /camera_2d has no detection" in detector.verdict.text
    for answer in (well, fusion, clustering, detector):
        assert not parameters_in(answer, "detector.", "fusion."), answer.steps
        assert not parameters_in(answer, "clustering.eps", "clustering.min_points")


def test_our_fusion_of_the_robots_clusters_and_detections() -> None:
    """Parameters of the fusion are ours, those of the robot's clusters are not."""
    row, j = reported_object()
    objects = ours().objects
    assert objects is not None
    answer = robots_answer(published(drop_cluster=int(objects.cluster[j])), row, *ROBOT[:2])
    assert answer.verdict.kind is ReasonKind.NO_CLUSTER and not answer.hints
    assert "the robot's clustering lost it: " in answer.verdict.text
    assert not parameters_in(answer, "clustering.eps", "clustering.min_points")
