"""The sentence of each kind of reason, as it stands in ``references/why_sentences.txt``."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bevviz.config import Config, load
from bevviz.model.reasons import Limit, Reason, ReasonKind, Scored, limit_of
from bevviz.model.results import Decision, Pair
from bevviz.why.sentences import FALSE_SENTENCES, SENTENCES, make_verdict
from bevviz.why.subject import Subject
from bevviz.why.subject_matches import first_name
from bevviz.why.verdict import FALSE as FALSE_KINDS

REFERENCE = Path(__file__).parent / "references/why_sentences.txt"
CAR = Subject("truth", "the car at 10.1 m", "Car", frozenset({"car"}), 3)
DETECTION = Subject("detection", "the car 0.46 in zed", "car", frozenset({"car"}), 1, "zed")
POINT = Subject("point", "what is at 1, 2, 3 m")
NAN = float("nan")
OBJECT: dict[str, Any] = {
    "object": Scored("car", 0.814),
    "cluster": 7,
    "by": "",
    "opinion": "",
    "camera": "zed",
    "own": True,
    "also": (8, 9),
    "away": 2.96,
    "box_owner": "the van at 12.0 m",
    "split_off": (),
}
PAIR: dict[str, Any] = {
    "detection": Scored("car", 0.46),
    "cluster": 7,
    "matched": 4,
    "compared": True,
    "pair": Pair(12, 10.2, 0.07, 66.4, 1.0),
    "centroid": False,
    "mask": "",
}
SEEN: dict[str, Any] = {
    "detection": Scored("car", 0.0125),
    "by": "",
    "robot": False,
    "shared": None,
    "nearest": None,
}
SHARED: dict[str, Any] = {
    "shared": Scored("car", 0.38),
    "overlap": 0.44,
    "shared_owner": "the car at 18.0 m",
}
MERGED: dict[str, Any] = {
    "cluster": 7,
    "others": ("the van at 12.0 m",),
    "rest": 0,
    "gap": 0.31,
    "by": "",
    "joined_by": None,
    "eps": 0.5,
}
ASIDE: dict[str, Any] = {
    "cluster": 7,
    "count": 5,
    "clusters": 1,
    "points": 5,
    "taker": None,
    "taker_owner": "",
}
GROUND = {"points": 540, "ground_points": 540, "removed": 429, "voxels": 430, "lowest": -0.1, "highest": 0.4}
NOISE = {"obstacles": 9, "noise": 6, "neighbours": 4, "eps": 0.5, "by": "", "robot": False}
K = ReasonKind
CASES: list[tuple[ReasonKind, bool, dict[str, Any], Subject]] = [
    (K.REPORTED, True, OBJECT, CAR),
    (K.REPORTED, True, {**OBJECT, "split_off": ((3, 120, 1500), (-1, 12, 80))}, CAR),
    (K.REPORTED, True, {**OBJECT, "by": "/fused", "camera": ""}, CAR),
    (K.REPORTED, True, {**OBJECT, "by": "/fused", "opinion": "confirmed by car 0.5 of zed"}, CAR),
    (K.REPORTED, True, SEEN, DETECTION),
    (K.SHARED_BOX, True, OBJECT, CAR),
    (K.BORROWED, True, OBJECT, CAR),
    (K.BORROWED, True, {**OBJECT, "box_owner": ""}, CAR),
    (K.SPLIT, True, {"clusters": (1, 2, 3, 4, 5), "apart": 0.61, "by": ""}, CAR),
    (K.SPLIT, False, {"clusters": (1, 2), "apart": NAN, "by": "/clusters"}, CAR),
    (K.MERGED, False, MERGED, CAR),
    (K.MERGED, False, {**MERGED, "gap": 1.36}, CAR),
    (K.MERGED, False, {**MERGED, "gap": 1.36, "joined_by": Scored("car", 0.46)}, CAR),
    (K.MERGED, False, {**MERGED, "by": "/clusters"}, CAR),
    (K.MERGED, True, {**MERGED, "others": (), "rest": 31, "gap": NAN}, CAR),
    (K.MISPLACED, False, OBJECT, CAR),
    (K.MISNAMED, False, {**OBJECT, "own": False, "object": Scored("truck", 0.6)}, CAR),
    (K.FAILED, False, {"failures": (("ground", "no plane fits"),)}, CAR),
    (K.FAILED, False, {"failures": ()}, CAR),
    (K.OUT_OF_VIEW, False, {}, CAR),
    (K.HIDDEN, False, {"points": 1, "in_front": 40, "aimed": 44, "front": 2, "front_name": "van"}, CAR),
    (K.NO_POINTS, False, {"points": 0, "radius": None, "nearest": NAN}, CAR),
    (K.NO_POINTS, False, {"points": 0, "radius": 0.5, "nearest": 3.14}, POINT),
    (K.GROUND, False, {**GROUND, "by": ""}, CAR),
    (K.GROUND, False, {**GROUND, "by": ""}, POINT),
    (K.GROUND, False, {**GROUND, "ground_points": 400, "by": "my:ground"}, POINT),
    (K.NOISE, False, NOISE, CAR),
    (K.NO_CLUSTER, False, {**NOISE, "by": "my:cells"}, CAR),
    (K.NO_CLUSTER, False, {**NOISE, **PAIR, "by": "/clusters", "robot": True}, CAR),
    (K.TOO_SMALL, False, ASIDE, CAR),
    (K.TOO_SMALL, False, {**ASIDE, "clusters": 2, "points": 11}, CAR),
    (K.TOO_SMALL, False, {**ASIDE, "taker": Scored("car", 0.81), "taker_owner": "the van at 12.0 m"}, CAR),
    (K.TOO_LARGE, False, {**ASIDE, "count": 90_000}, CAR),
    (K.NOT_RUN, False, {"problems": ("detector.model is not set",)}, CAR),
    (K.NOT_DETECTED, False, {**SEEN, "detection": None}, CAR),
    (K.NOT_DETECTED, False, {**SEEN, "detection": None, **SHARED}, CAR),
    (
        K.NOT_DETECTED,
        False,
        {**SEEN, "detection": None, "nearest": Scored("car", 0.142), "overlap": 0.22},
        CAR,
    ),
    (K.NOT_DETECTED, False, {**SEEN, "by": "/camera_2d", "robot": True}, CAR),
    (K.BELOW_THRESHOLD, False, SEEN, CAR),
    (K.BELOW_THRESHOLD, False, SEEN, DETECTION),
    (
        K.SUPPRESSED,
        False,
        {**SEEN, "rival": Scored("truck", 0.6), "iou": 0.7, "rival_owner": "the van at 12.0 m"},
        CAR,
    ),
    (K.SECOND_NAME, False, {"first": Scored("truck", 0.29), "cluster": 68}, DETECTION),
    (K.NOT_FUSED, False, {"cameras": ("zed", "left"), "problems": ("no transform",)}, CAR),
    (K.LOW_OVERLAP, False, PAIR, CAR),
    (K.TOO_FEW_POINTS, False, {**PAIR, "pair": None}, CAR),
    (K.TOO_FEW_POINTS, False, {**PAIR, "cluster": -1}, DETECTION),
    (K.TOO_FAR, False, {**PAIR, "centroid": True}, CAR),
    (K.TAKEN, False, {**PAIR, "taker": Scored("person", 0.57), "taker_owner": ""}, CAR),
    (K.TAKEN, False, {**PAIR, "taker": None}, CAR),
    (K.MISFIT, False, PAIR, CAR),
    (K.OTHER_CLUSTER, False, {**PAIR, "mask": ", 9 of 12 points in the frustum lie in the mask"}, CAR),
    (K.CONTRADICTED, True, {**OBJECT, "opinion": "contradicted by zed: no detection there"}, CAR),
    (
        K.NOT_AMONG,
        False,
        {
            "by": "net.onnx",
            "fused": None,
            "cluster": -1,
            "points": 3,
            "detector_known": True,
            "detection": None,
        },
        CAR,
    ),
    (
        K.NOT_AMONG,
        False,
        {
            "by": "net.onnx",
            "fused": Scored("car", 0.7),
            "camera": "zed",
            "cluster": 7,
            "points": 300,
            "partner": Scored("truck", 0.4),
        },
        CAR,
    ),
    (
        K.LOST_IN_FUSION,
        False,
        {
            **PAIR,
            "clustering": "/clusters",
            "detector": "/camera_2d",
            "objects": "/fused",
            "ours": Reason(K.MATCHED),
        },
        CAR,
    ),
]
FALSE: dict[str, Any] = {
    "object": Scored("car", 0.31),
    "cluster": 7,
    "truth": "the car at 38.6 m",
    "away": 3.04,
    "other": Scored("car", 0.9),
    "off": -18.0,
    "size": (12.3, 3.4),
    "opinion": "",
}
FALSE_CASES = [
    (K.DUPLICATE, FALSE),
    (K.DUPLICATE, {**FALSE, "truth": ""}),
    (K.SPLIT, FALSE),
    (K.MISNAMED, FALSE),
    (K.MISPLACED, FALSE),
    (K.WRONG_DEPTH, FALSE),
    (K.WRONG_DEPTH, {**FALSE, "truth": "", "off": 4.2}),
    (K.WALL, FALSE),
    (K.DETECTOR_ERROR, FALSE),
]
OBJECT_SUBJECT = Subject("object", "the car 0.31 at 20.4 m", "car", frozenset({"car"}), 2)
NOT_OURS = ("my:", "/")  # names of stages whose parameters are not ours


def sentence(
    kind: ReasonKind, reported: bool, values: dict[str, Any], subject: Subject, config: Config
) -> str:
    ours = not str(values.get("by", "")).startswith(NOT_OURS)
    limit = limit_of(kind, config) if ours else None
    if kind is K.SHARED_BOX:
        limit = Limit("fusion.method", "centroid")
    if kind is K.REPORTED and subject is DETECTION:
        limit = limit_of(K.BELOW_THRESHOLD, config)
    return make_verdict(subject, Reason(kind, limit, values), reported).text


def test_each_kind_has_its_sentence() -> None:
    config = load(settings=["clustering.max_cluster_points=50000"])
    made = [f"{case[0].value}: {sentence(*case, config)}" for case in CASES]
    for kind, values in FALSE_CASES:
        made.append(
            f"false, {kind.value}: {make_verdict(OBJECT_SUBJECT, Reason(kind, None, values), True).text}"
        )
    assert made == REFERENCE.read_text(encoding="utf-8").splitlines()
    assert {case[0] for case in CASES} == SENTENCES.keys()
    assert {case[0] for case in FALSE_CASES} == FALSE_SENTENCES.keys() == FALSE_KINDS


@pytest.mark.parametrize(
    ("name", "box", "cluster", "is_second"),
    [
        ("car", (102, 104, 200, 198), 68, True),
        ("car", (102, 104, 200, 198), 67, False),  # its points are another thing's
        ("car", (110, 110, 180, 190), 68, False),  # a car before a truck
        ("person", (110, 110, 130, 190), 68, False),  # a person before a truck
        ("car", (180, 110, 260, 190), 68, False),  # beside the reported box
    ],
)
def test_a_second_name_has_the_box_of_the_first(
    name: str, box: tuple[int, ...], cluster: int, is_second: bool
) -> None:
    boxes = np.array([(100, 100, 200, 200), box], np.float32)
    detections = SimpleNamespace(xyxy=boxes, names=("truck", name), score=np.array([0.29, 0.59]))
    decisions = np.array([Decision.MATCHED, Decision.TAKEN])
    fusion = SimpleNamespace(detection_decision=decisions, detection_cluster=np.array([68, cluster]))
    camera = SimpleNamespace(detections=detections, fusion=fusion)
    traces: Any = SimpleNamespace(camera=lambda _: camera, result=SimpleNamespace(config=load()))
    subject = Subject("detection", f"the {name} 0.59", name, frozenset({name}), 1, "zed", boxes[1])
    evidence: Any = SimpleNamespace(main=cluster)
    assert first_name(subject, evidence, traces) == (Scored("truck", 0.29) if is_second else None)


def test_a_score_is_told_from_its_limit() -> None:
    assert Scored("person", 0.2496).beside(0.25) == "0.2496"
    assert Scored("person", 0.12).beside(0.25) == "0.12"
    assert Scored("person", 0.0125).beside(0.25) == "0.01"
