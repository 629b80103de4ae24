"""Objects on labels of types that are not judged, in regions without labels, and inside labelled objects."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import bevviz
from bevviz.config import load
from bevviz.evaluate import Truth, judge, truth_of
from bevviz.findings.frame_findings import find_findings
from bevviz.model.class_names import rule_of
from bevviz.model.frame import Boxes3D, Camera, Frame, LabelledBoxes3D
from bevviz.model.reasons import ReasonKind
from bevviz.model.results import Detections, FrameResult
from bevviz.pipeline.perceive import add_explanations, perceive
from bevviz.pipeline.stage_loader import StageLoader
from bevviz.why import FrameExplainer, Selection
from bevviz.why.false_objects import false_reasons
from bevviz.why.frame_index import FrameIndex

MISC = (804.79, 167.34, 995.43, 327.94)  # image box of the label of frame 2
REGION = (5.0, 229.89, 214.12, 367.61)  # image box of a DontCare region of frame 3
CAR = (614.24, 181.78, 727.31, 284.77)  # image box of a label of frame 3


def run_kitti(shared: Path, number: int, *boxes: tuple[float, float, float, float]) -> FrameResult:
    """Run a frame of KITTI's object benchmark with a detector that sees cars in image boxes."""
    count = len(boxes)
    zeros, none = np.zeros(count, np.int32), np.full(count, -1, np.int32)
    score = np.linspace(0.9, 0.6, count, dtype=np.float32)
    xyxy = np.array(boxes, np.float32)
    detections = Detections(xyxy, score, zeros, ("car",) * count, zeros, none, np.zeros(count, np.float32))

    def detect(camera: Camera) -> Detections:
        return detections

    with bevviz.open(shared / "kitti") as drive:
        frame = drive.raw(number)
    config = load()
    return add_explanations(perceive(frame, config, StageLoader().load(config, detect)), seen=False)


def truth_in(result: FrameResult) -> Truth:
    """Return the ground truth of a result."""
    assert result.frame.truth is not None
    return truth_of(result.frame, result.frame.truth)


@pytest.mark.parametrize(
    ("number", "box", "words"),
    [
        (2, MISC, "on a label of the type Misc, which is not judged: neither right nor wrong"),
        (3, REGION, "in a DontCare region, where nothing is labelled: neither right nor wrong"),
    ],
)
def test_what_kitti_does_not_judge_is_not_false(
    shared: Path, number: int, box: tuple[float, float, float, float], words: str
) -> None:
    result = run_kitti(shared, number, box)
    assert result.objects is not None and result.objects.names == ("car",)
    truth = truth_in(result)
    matches = judge(result.objects, truth, result.cameras)
    assert not matches.false.any() and not matches.true.any()
    assert not false_reasons(FrameIndex(result))
    explainer = FrameExplainer(result)
    assert not [finding for finding in find_findings(explainer) if finding.what == "false"]
    (answer,) = explainer.ask(Selection(object=0))
    assert answer.verdict.kind is ReasonKind.REPORTED and words in answer.verdict.text


def test_the_user_states_what_is_judged(shared: Path) -> None:
    """With ``source.labels`` a Misc is a car that has to be found, and the same object is wrong."""
    settings = ["source.labels={Misc: [Car]}"]
    with bevviz.open(shared / "kitti", set=settings) as drive:
        frame = drive.raw(2)
    assert frame.truth is not None
    truth, row = truth_of(frame, frame.truth), frame.truth.labels.index("Misc")
    assert truth.must[row] and truth.accepted[row] == {"car"}
    result = run_kitti(shared, 2, MISC)
    assert result.objects is not None
    matches = judge(result.objects, truth, result.cameras)
    assert matches.false.tolist() == [True] and matches.missed[row], "it is 2.3 m off"


def test_a_second_box_in_a_labelled_car_is_called_so(shared: Path) -> None:
    result = run_kitti(shared, 3, CAR)
    objects = result.objects
    assert objects is not None and objects.names == ("car",)
    size = objects.boxes.size * np.float32(0.6)
    boxes = Boxes3D.joined([objects.boxes, Boxes3D(objects.boxes.center, size, objects.boxes.yaw)])
    twice = replace(
        objects,
        boxes=boxes,
        names=("car", "car"),
        score=np.array([0.9, 0.4], np.float32),
        cluster=np.append(objects.cluster, np.int32(-1)),
        camera=(*objects.camera, ""),
        detection=np.append(objects.detection, np.int32(-1)),
        measured=None,
        seen=None,
    )
    result = replace(result, objects=twice)
    (row,) = false_reasons(FrameIndex(result))
    assert row == 1
    (answer,) = FrameExplainer(result).ask(Selection(object=1))
    assert answer.verdict.kind is ReasonKind.DUPLICATE
    assert "it is inside the box of the car at 13." in answer.verdict.text
    assert "a second box of it, which car 0.90 is already" in answer.verdict.text


@pytest.mark.parametrize(
    ("label", "accepted", "judged"),
    [
        ("Misc", {"misc"}, False),
        ("misc", {"misc"}, False),
        ("bicycle_rack", {"bicycle_rack"}, False),
        ("Car", {"car"}, True),
        ("crate", {"crate"}, True),
    ],
)
def test_rules_of_labels(label: str, accepted: set[str], judged: bool) -> None:
    rule = rule_of(label)
    assert rule.names == accepted and rule.judged == judged


def test_stated_names_replace_the_table() -> None:
    stated = {"Car": ("Car", "SUV"), "crate": ()}
    assert rule_of("Car", stated).names == {"car", "suv"}
    assert rule_of("crate", stated) == (frozenset({"crate"}), False, "")
    center = np.array([[5, 0, 0]], np.float32)
    boxes = Boxes3D(center, np.ones((1, 3), np.float32), np.zeros(1, np.float32))
    labelled = LabelledBoxes3D("/truth", 0, "lidar", boxes, ("crate",), np.ones(1, np.float32))
    frame = Frame(
        0, 0, 0, "lidar", np.repeat(center, 20, axis=0), "lidar", truth=labelled, label_names=stated
    )
    assert not truth_of(frame, labelled).must.any()
