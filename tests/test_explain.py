"""Sentences of decisions, word for word."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bevviz.config import Config, load
from bevviz.model.decisions import explain
from bevviz.model.frame import F32, Camera, Image
from bevviz.model.geometry import apply, project
from bevviz.model.results import (
    CameraResult,
    Clusters,
    ClusterState,
    Detections,
    DetectionState,
    Explanation,
    Splits,
)
from bevviz.stages.fusion import fuse
from tests.support.fusion_scenes import (
    CAMERA,
    CAMERA_FROM_LIDAR,
    PERSON,
    clusters_of,
    detections_of,
    silhouette,
    slab,
)

DEFAULT = load(None, ["detector.model=model.onnx"])


def camera(name: str, problems: tuple[str, ...] = (), image: bool = True) -> Camera:
    picture = Image(0, "", np.zeros((360, 640, 3), np.uint8)) if image else None
    return Camera(name, picture, CAMERA, CAMERA_FROM_LIDAR, None, problems=problems)


def run(
    points: F32, clusters: Clusters, detections: Detections, config: Config, name: str = "zed"
) -> CameraResult:
    uv, depth = project(apply(CAMERA_FROM_LIDAR, points), CAMERA)
    fusion = fuse(uv, depth, clusters, detections, CAMERA, CAMERA_FROM_LIDAR, config.fusion)
    return CameraResult(camera(name), detections, fusion, uv, depth)


def texts(explanations: tuple[Explanation, ...]) -> list[str]:
    return [e.text for e in explanations]


def test_matches_and_refusals_are_explained() -> None:
    wall, behind = slab(15, 0, 0, 20, 4), slab(-12, 5, 0, 1, 1)
    points, clusters = clusters_of([wall, PERSON, behind])
    result = run(points, clusters, detections_of([silhouette(PERSON)]), DEFAULT)
    found = explain([result], clusters, DEFAULT)
    assert texts(found) == [
        "person 0.90: 133 points of cluster 1 in its frustum at 8.0 m, IoU 0.80, matched",
        "cluster 0: 8241 points at 15.0 m: in view of zed, 377 points in the frustum of person 0.90, "
        "IoU 0.05, fusion.min_iou is 0.1",
        "cluster 1: 133 points at 8.0 m: matched with person 0.90",
        "cluster 2: 121 points at 13.0 m: out of view of zed",
    ]
    assert [(e.subject, e.camera, e.row, e.state) for e in found] == [
        ("detection", "zed", 0, "matched"),
        ("cluster", "zed", 0, "low_overlap"),
        ("cluster", "zed", 1, "matched"),
        ("cluster", "", 2, "out_of_view"),
    ]


def test_splits_and_merges_by_the_camera_are_explained() -> None:
    points, clusters = clusters_of([slab(15, 0, 0, 20, 4), PERSON, slab(9, 5, 0, 1, 1)])
    result = run(points, clusters, detections_of([silhouette(PERSON)] * 2), DEFAULT)
    i32 = np.int32
    splits = Splits(
        camera=("zed",) * 6,
        detection=np.array([0, 0, 0, 1, 1, 1], i32),
        cluster=np.array([1, 1, 1, 2, 2, 2], i32),
        rest=np.array([0, -1, -1, -1, -1, -1], i32),
        is_noise=np.array([False, False, True, False, False, True]),
        points=np.array([1377, 60, 3, 40, 50, 31], i32),
        of=np.array([8241, 130, 3, 40, 50, 31], i32),
    )
    found = [e for e in explain([result], clusters, DEFAULT, splits) if e.subject == "split"]
    assert [(e.camera, e.row, e.state, e.text) for e in found] == [
        ("zed", 0, "split", "cluster 0 split by person 0.90: 1,377 of 8,241 points are cluster 1"),
        (
            "zed",
            1,
            "split",
            "cluster 1 split by person 0.90: 60 of 130 points of a cluster that others have the rest of",
        ),
        (
            "zed",
            2,
            "merged",
            "cluster 2 made by person 0.89 of clusters of 40 and 50 points and 31 points of noise",
        ),
    ]


def test_dropped_detections_are_explained() -> None:
    points, clusters = clusters_of([slab(8, 4, 0, 1, 1)])
    detections = replace(
        detections_of([silhouette(PERSON)] * 3, [0.83, 0.44, 0.21]),
        state=np.array(
            [DetectionState.KEPT, DetectionState.SUPPRESSED, DetectionState.BELOW_THRESHOLD], np.int32
        ),
        suppressed_by=np.array([-1, 0, -1], np.int32),
        overlap=np.array([0, 0.72, 0], np.float32),
    )
    found = explain([run(points, clusters, detections, DEFAULT)], clusters, DEFAULT)
    assert texts(found) == [
        "person 0.83: no cluster, no obstacle point in its frustum",
        "person 0.44: suppressed by person 0.83, IoU 0.72 > detector.iou_threshold 0.45",
        "person 0.21: below detector.conf_threshold 0.25",
        "cluster 0: 121 points at 8.9 m: in view of zed, under no detection",
    ]
    assert [e.state for e in found] == ["no_cluster", "suppressed", "below_threshold", "no_detection"]


def test_points_that_belong_to_no_candidate_are_named() -> None:
    config = load(None, ["detector.model=m", "clustering.min_points=50", "clustering.min_cluster_points=60"])
    points, clusters = clusters_of(
        [slab(8, 0, -1, 0.4, 0.4), slab(20, 9, 0, 5, 2)], noise=slab(8, 0, 0, 0.2, 0)
    )
    states = np.array([ClusterState.TOO_SMALL, ClusterState.TOO_LARGE], np.int32)
    config = config.model_copy(
        update={"clustering": config.clustering.model_copy(update={"max_cluster_points": 1000})}
    )
    clusters = replace(clusters, state=states)
    found = explain([run(points, clusters, detections_of([silhouette(PERSON)]), config)], clusters, config)
    assert texts(found) == [
        "person 0.90: no cluster, 28 points in its frustum: 3 noise (clustering.min_points is 50), "
        "25 of cluster 0 (set aside, clustering.min_cluster_points is 60)",
        "cluster 0: 25 points at 8.0 m: set aside, clustering.min_cluster_points is 60",
        "cluster 1: 1071 points at 21.9 m: set aside, clustering.max_cluster_points is 1000",
    ]
    assert [e.state for e in found] == ["no_cluster", "too_small", "too_large"]


@pytest.mark.parametrize(
    ("setting", "rule"),
    [
        ("fusion.min_points=200", "fusion.min_points is 200"),
        ("fusion.min_iou=0.95", "fusion.min_iou is 0.95"),
        ("fusion.max_depth=7.5", "fusion.max_depth is 7.5 m"),
    ],
)
def test_the_refusing_rule_is_named(setting: str, rule: str) -> None:
    config = load(None, ["detector.model=m", setting])
    points, clusters = clusters_of([PERSON])
    found = explain([run(points, clusters, detections_of([silhouette(PERSON)]), config)], clusters, config)
    pair = "133 points of cluster 0 in its frustum at 8.0 m, IoU 0.80"
    assert texts(found) == [
        f"person 0.90: no match: {pair}, {rule}",
        "cluster 0: 133 points at 8.0 m: in view of zed, 133 points in the frustum of person 0.90, "
        f"IoU 0.80, {rule}",
    ]


def test_the_winner_of_a_cluster_is_named() -> None:
    points, clusters = clusters_of([PERSON])
    box = silhouette(PERSON)
    result = run(points, clusters, detections_of([box, box], [0.8, 0.4], "person bicycle"), DEFAULT)
    assert texts(explain([result], clusters, DEFAULT))[1] == (
        "bicycle 0.40: no match: 133 points of cluster 0 in its frustum at 8.0 m, IoU 0.80, "
        "taken by person 0.80"
    )
    points, clusters = clusters_of([PERSON, slab(16, 0, -1, 1.2, 3.6)])
    result = run(points, clusters, detections_of([box]), DEFAULT)
    last = explain([result], clusters, DEFAULT)[-1]
    assert last.state == "taken"
    assert last.text.endswith("in the frustum of person 0.90, IoU 0.80, taken by cluster 0")


def test_the_reference_says_that_one_box_names_several() -> None:
    config = load(None, ["detector.model=m"], "reference")
    parts = [PERSON, slab(15, 0.2, -0.5, 6, 2), slab(8, 6, 0, 1, 1)]
    points, clusters = clusters_of(parts)
    boxes = [silhouette(PERSON), np.array([0, 300, 20, 350], np.float32)]
    found = explain([run(points, clusters, detections_of(boxes), config)], clusters, config)
    assert texts(found) == [
        "person 0.90: centre of cluster 0 at 8.0 m is 0 px from its own, "
        "matched; cluster 1 takes the same box",
        "person 0.89: no match: centre of cluster 2 at 8.0 m is 168 px from its own, "
        "fusion.match_radius is 150 px",
        "cluster 0: 133 points at 8.0 m: matched with person 0.90",
        "cluster 1: 1281 points at 15.0 m: matched with person 0.90",
        "cluster 2: 121 points at 10.0 m: in view of zed, its centre 168 px from that of person 0.89, "
        "fusion.match_radius is 150 px",
    ]


def test_several_cameras_are_named() -> None:
    points, clusters = clusters_of([PERSON, slab(-12, 5, 0, 1, 1)])
    left = run(points, clusters, detections_of([silhouette(PERSON)]), DEFAULT, "left")
    right = run(points, clusters, Detections.empty(), DEFAULT, "right")
    found = explain([left, right], clusters, DEFAULT)
    assert texts(found)[1:] == [
        "cluster 0: 133 points at 8.0 m: matched with person 0.90",
        "cluster 0: 133 points at 8.0 m: in view of right, under no detection",
        "cluster 1: 121 points at 13.0 m: out of view of left and right",
    ]
    assert [e.camera for e in found[1:]] == ["left", "right", ""]


def test_missing_inputs_are_named() -> None:
    points, clusters = clusters_of([PERSON])
    unseen = CameraResult(camera("left", ("no image within sync.tolerance 0.1 s",), image=False), None, None)
    lost = CameraResult(camera("right", ("no transform",)), detections_of([silhouette(PERSON)]), None)
    plain = CameraResult(camera("rear"), None, None)
    assert texts(explain([unseen, lost, plain], clusters, DEFAULT)) == [
        "left: no image within sync.tolerance 0.1 s",
        "right: no transform",
        "person 0.90: not compared with clusters: no transform",
        "rear: no detections, the detector failed",
        "cluster 0: 133 points at 8.0 m: not compared with detections, as no camera has any",
    ]
    assert texts(explain([plain], None, Config())) == ["rear: no detections, detector.model is not set"]
    seen = run(points, clusters, detections_of([silhouette(PERSON)]), DEFAULT)
    assert texts(explain([replace(seen, fusion=None)], None, DEFAULT)) == [
        "person 0.90: not compared with clusters: no clusters in this frame"
    ]
    assert explain([], None, DEFAULT) == ()
