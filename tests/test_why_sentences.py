"""The sentence of each kind of reason, as it stands in ``references/why_sentences.txt``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bevviz.config import load
from bevviz.model.reasons import ReasonKind, Scored, StageOwner, scored
from bevviz.model.results import ClusterState, Decision, Detections, DetectionState, Failure, Pair
from bevviz.why.evidence import Candidate, ClusterPart, Evidence, ReportedObject
from bevviz.why.frame_index import Fate
from bevviz.why.reason_text import reason_of
from bevviz.why.sentences import make_verdict
from bevviz.why.subject import Subject
from bevviz.why.subject_matches import first_name

REFERENCE = Path(__file__).parent / "references/why_sentences.txt"
CAR = Subject("truth", "the car at 10.1 m", "Car", frozenset({"car"}), 0)
VAN = Subject("truth", "the van at 12.0 m", "Van", frozenset({"van"}), 1)
BOX: Any = SimpleNamespace(center=np.array([[1.0, 2, 3]]), size=np.ones((1, 3)))
BOXES = np.array([(0, 0, 9, 9)] * 2, np.float32)
# The subject's own detection, and a better one of the van.
DETECTIONS = Detections(
    BOXES,
    np.array([0.46, 0.6], np.float32),
    np.zeros(2, np.int32),
    ("car", "truck"),
    np.full(2, DetectionState.KEPT, np.int32),
    np.array([1, -1], np.int32),
    np.array([0.7, 0], np.float32),
)
DETECTION = Subject("detection", "the car 0.46 in zed", "car", frozenset({"car"}), 0, "zed", BOXES[0])
POINT = Subject("point", "what is at 1, 2, 3 m", box=BOX)
NAN = float("nan")
K = ReasonKind
BEST = Candidate("zed", 0, "car", 0.46, DetectionState.KEPT, 0.9, Decision.TAKEN, 4, True, 0)
WEAK = replace(BEST, score=0.0125, state=DetectionState.BELOW_THRESHOLD)
SHARED = replace(BEST, score=0.38, overlap=0.44, own=False, owner=1)
OWN = ReportedObject(0, "car", 7, "zed", 0, True, (8, 9), True, 2.96, -1)
THEIRS = replace(OWN, detection=1, own=False)
PART = ClusterPart(7, 5, 5, ClusterState.TOO_SMALL)
EVIDENCE = Evidence(
    points=np.arange(540),
    fate=np.zeros(540, np.uint8),
    center=None,
    distance=10.1,
    voxels=430,
    ground=np.append(np.full(428, -0.1), 0.4).astype(np.float32),
    noise=6,
    neighbours=4,
    parts=(),
    main=7,
    aimed=44,
    in_front=40,
    front=2,
    candidates=(BEST,),
    named=OWN,
    mates=((VAN, 300),),
    gap=0.31,
    finer=0.0,
    joined_by=None,
    apart=0.61,
    in_view=True,
)
FEW = {"points": np.arange(0), "voxels": 438, "ground": np.zeros(429, np.float32)}
OPINION = SimpleNamespace(subject="object", camera="zed", row=0, text="car 0.81: confirmed by car 0.5 of zed")
DENIED = SimpleNamespace(**{**vars(OPINION), "text": "car 0.81: contradicted by zed: no detection there"})


def splits(*rows: tuple[int, int, int, int, int]) -> Any:
    """Return splits: part, rest, points, whole and detection each."""
    cluster, rest, points, of, detection = np.array(rows).T
    return SimpleNamespace(
        cluster=cluster, rest=rest, points=points, of=of, detection=detection, camera=("zed",) * len(rows)
    )


def sentence(
    kind: ReasonKind, subject: Subject = CAR, reported: bool = False, by: str = "", **changes: Any
) -> str:
    """Return the sentence about a subject of a frame with these changes of the evidence and of the result."""
    of_result = {name: changes.pop(name) for name in list(changes) if not hasattr(EVIDENCE, name)}
    camera = SimpleNamespace(
        camera=SimpleNamespace(name="zed", problems=("no transform",), image=None),
        detections=of_result.get("detections", DETECTIONS),
        fusion=SimpleNamespace(
            pair=lambda *_: of_result.get("pair", Pair(12, 10.2, 0.07, 66.4, 1.0)),
            detection_covered=of_result.get("covered"),
            detection_points=np.array([12, 12]),
            detection_decision=np.array([Decision.MATCHED, Decision.MATCHED]),
            detection_cluster=np.array([7, 7]),
            cluster_decision=np.full(10, Decision.MATCHED),
            cluster_detection=np.full(10, of_result.get("taker", 1)),
        ),
    )
    settings = ["clustering.max_cluster_points=50000", *of_result.get("settings", ())]
    result: Any = SimpleNamespace(
        frame=SimpleNamespace(lidar=of_result.get("lidar", "lidar"), points=np.array([[1.0, 2, 6.14]])),
        config=load(settings=settings),
        objects=SimpleNamespace(names=("car",), score=np.array([0.814]), cluster=np.array([2])),
        opinions=of_result.get("opinions"),
        explanations=of_result.get("explanations", ()),
        splits=of_result.get("splits"),
        clusters=SimpleNamespace(count=np.full(10, 300)),
        failures=of_result.get("failures", ()),
        cameras=(camera,),
        camera=lambda name: camera if name == "zed" else None,
        fusion=lambda name: camera.fusion if name == "zed" else None,
    )
    overlap = of_result.get("overlap", 0.0)
    traces: Any = SimpleNamespace(
        result=result,
        origin=lambda section: StageOwner(section, **{"topic" if by.startswith("/") else "function": by}),
        owner_of=lambda name, row: (0, 1)[row] if name == "zed" else -1,
        scored=lambda _, row: scored(camera.detections, row),
        truth=(CAR, VAN),
        fate=of_result.get("fates", np.full(540, Fate.GROUND)),
        fits=lambda _: SimpleNamespace(overlap=np.array([[overlap], [0]])),
        exemption=lambda _: "",
    )
    reason = reason_of(kind, subject, replace(EVIDENCE, **changes), traces)
    return f"{kind.value}: {make_verdict(subject, reason, reported).text}"


FUSED = SimpleNamespace(
    fused=SimpleNamespace(names=("car",), score=np.array([0.7]), cluster=np.array([7]), camera=("zed",)),
    partner=np.array([0]),
)
THREE = {"points": np.arange(3), "main": -1}
JOINED = {"gap": 1.36, "joined_by": Scored("car", 0.46)}
CENTROID = {"settings": ("fusion.method=centroid",)}
PARTS = tuple(ClusterPart(number, 90, 90, ClusterState.KEPT) for number in range(1, 6))
LIKE_CAR = {"candidates": (WEAK,)}
CASES: list[tuple[ReasonKind, dict[str, Any]]] = [
    (K.REPORTED, {"reported": True}),
    (K.REPORTED, {"reported": True, "splits": splits((7, 3, 120, 1500, 0), (7, -1, 12, 80, 0))}),
    (K.REPORTED, {"reported": True, "by": "/fused", "named": replace(OWN, camera="", detection=-1)}),
    (K.REPORTED, {"reported": True, "by": "/fused", "explanations": (OPINION,)}),
    (K.REPORTED, {"reported": True, "subject": DETECTION, "lidar": "", **LIKE_CAR}),
    (K.SHARED_BOX, {"reported": True, **CENTROID}),
    (K.BORROWED, {"reported": True, "named": THEIRS}),
    (K.BORROWED, {"reported": True}),
    (K.BORROWED, {"reported": True, **CENTROID}),
    (K.SPLIT, {"reported": True, "parts": PARTS}),
    (K.SPLIT, {"parts": PARTS[:2], "apart": NAN, "by": "/clusters"}),
    (K.MERGED, {}),
    (K.MERGED, {"gap": 1.36}),
    (K.MERGED, JOINED),
    (K.MERGED, {"by": "/clusters"}),
    (K.MERGED, {"reported": True, "mates": (), "gap": NAN, "parts": (replace(PART, points=269),)}),
    (K.MISPLACED, {}),
    (K.MISNAMED, {"named": replace(THEIRS, name="truck")}),
    (K.FAILED, {"failures": (Failure("ground", "no plane fits", ""),)}),
    (K.FAILED, {}),
    (K.OUT_OF_VIEW, {}),
    (K.HIDDEN, {"points": np.arange(1)}),
    (K.NO_POINTS, {"points": np.arange(0)}),
    (K.NO_POINTS, {"points": np.arange(0), "subject": POINT}),
    (K.GROUND, {}),
    (K.GROUND, {"subject": POINT}),
    (K.GROUND, {"subject": POINT, "fates": np.arange(540) < 400, "by": "my:ground"}),
    (K.NOISE, FEW),
    (K.NO_CLUSTER, {**FEW, "by": "my:cells"}),
    (K.NO_CLUSTER, {"by": "/clusters"}),
    (K.TOO_SMALL, {"parts": (PART,)}),
    (K.TOO_SMALL, {"parts": (PART, replace(PART, cluster=8, points=6))}),
    (K.TOO_SMALL, {"parts": (PART,), "splits": splits((2, 7, 300, 305, 1))}),
    (K.TOO_LARGE, {"parts": (replace(PART, count=90_000, state=ClusterState.TOO_LARGE),)}),
    (K.NOT_RUN, {"detections": None}),
    (K.NOT_DETECTED, {"candidates": ()}),
    (K.NOT_DETECTED, {"candidates": (SHARED,)}),
    (K.NOT_DETECTED, {"candidates": (), "overlap": 0.22}),
    (K.NOT_DETECTED, {"by": "/camera_2d", **LIKE_CAR}),
    (K.BELOW_THRESHOLD, LIKE_CAR),
    (K.BELOW_THRESHOLD, {"subject": DETECTION, **LIKE_CAR}),
    (K.SUPPRESSED, {}),
    (K.SECOND_NAME, {"subject": DETECTION}),
    (K.NOT_FUSED, {}),
    (K.LOW_OVERLAP, {}),
    (K.TOO_FEW_POINTS, {"pair": None}),
    (K.TOO_FEW_POINTS, {"subject": DETECTION, "candidates": (replace(BEST, cluster=-1),)}),
    (K.TOO_FAR, CENTROID),
    (K.TAKEN, {}),
    (K.TAKEN, {"taker": -1}),
    (K.MISFIT, {}),
    (K.OTHER_CLUSTER, {"covered": np.array([11, 11])}),
    (K.CONTRADICTED, {"reported": True, "explanations": (DENIED,)}),
    (K.NOT_AMONG, {"by": "net.onnx", "candidates": (), **THREE}),
    (K.NOT_AMONG, {"by": "net.onnx", "opinions": FUSED}),
    (K.LOST_IN_FUSION, {"by": "/fused", "pair": Pair(12, 10.2, 0.5, 66.4, 1.0)}),
]


def test_each_kind_has_its_sentence() -> None:
    made = [sentence(kind, **changes) for kind, changes in CASES]
    assert made == REFERENCE.read_text(encoding="utf-8").splitlines()


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
    traces: Any = SimpleNamespace(result=SimpleNamespace(camera=lambda _: camera, config=load()))
    subject = Subject("detection", f"the {name} 0.59", name, frozenset({name}), 1, "zed", boxes[1])
    evidence: Any = SimpleNamespace(main=cluster)
    assert first_name(subject, evidence, traces) == (Scored("truck", 0.29) if is_second else None)


def test_a_score_is_told_from_its_limit() -> None:
    assert Scored("person", 0.2496).beside(0.25) == "0.2496"
    assert Scored("person", 0.12).beside(0.25) == "0.12"
    assert Scored("person", 0.0125).beside(0.25) == "0.01"
