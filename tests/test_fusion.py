"""Fusion on scenes whose answer is known, and on KITTI."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bevviz.config import ClusteringConfig, Config, FusionConfig, load
from bevviz.model.frame import F32, F64, Camera, Intrinsics
from bevviz.model.geometry import apply, inverse, iou, project
from bevviz.model.results import (
    CameraResult,
    Clusters,
    ClusterState,
    Decision,
    Detections,
    DetectionState,
    Fusion,
)
from bevviz.stages.clustering import cluster
from bevviz.stages.detector import Detector
from bevviz.stages.fusion import assign, fuse, merge
from bevviz.stages.ground import segment_ground
from bevviz.stages.voxel import voxel_grid
from tests.support.fusion_scenes import (
    CAMERA,
    CAMERA_FROM_LIDAR,
    PERSON,
    clusters_of,
    detections_of,
    silhouette,
    slab,
)

DEFAULT, REFERENCE = FusionConfig(), FusionConfig(method="centroid")


def run(points: F32, clusters: Clusters, detections: Detections, config: FusionConfig = DEFAULT) -> Fusion:
    uv, depth = project(apply(CAMERA_FROM_LIDAR, points), CAMERA)
    fusion = fuse(uv, depth, clusters, detections, CAMERA, CAMERA_FROM_LIDAR, config)
    check(fusion, clusters, detections, config)
    return fusion


def check(fusion: Fusion, clusters: Clusters, detections: Detections, config: FusionConfig) -> None:
    """Check the properties of every fusion."""
    pairs = {(int(d), int(k)) for d, k in zip(fusion.pairs.detection, fusion.pairs.cluster, strict=True)}
    assert len(pairs) == len(fusion.pairs.detection)
    named = np.flatnonzero(fusion.cluster_decision == Decision.MATCHED)
    if config.method == "frustum":
        boxes = fusion.cluster_detection[named]
        assert len(set(boxes.tolist())) == len(named), "one box names one object"
        np.testing.assert_array_equal(fusion.detection_cluster[boxes], named)
    of_detections: list[int] = fusion.detection_cluster.tolist()
    for d, k in enumerate(of_detections):
        decision = fusion.detection_decision[d]
        assert (decision == Decision.NOT_KEPT) == (detections.state[d] != DetectionState.KEPT)
        assert (k < 0) == (decision in (Decision.NOT_KEPT, Decision.NO_CLUSTER))
        assert k < 0 or (d, k) in pairs
        if decision == Decision.MATCHED:
            assert fusion.cluster_decision[k] == Decision.MATCHED
            assert fusion.cluster_detection[k] == d
    of_clusters: list[int] = fusion.cluster_detection.tolist()
    for k, d in enumerate(of_clusters):
        assert (fusion.cluster_decision[k] == Decision.NOT_KEPT) == (clusters.state[k] != ClusterState.KEPT)
        assert d < 0 or (d, k) in pairs
    assert fusion.detection_decision.dtype == fusion.cluster_detection.dtype == np.int32
    assert fusion.pairs.cost.dtype == fusion.pairs.depth.dtype == fusion.cluster_uv.dtype == np.float32


def test_a_pedestrian_before_a_wall_is_the_pedestrian() -> None:
    wall = slab(15, 0, 0, 20, 4)
    points, clusters = clusters_of([wall, PERSON])
    fusion = run(points, clusters, detections_of([silhouette(PERSON)]))
    assert fusion.detection_cluster.tolist() == [1]
    assert fusion.detection_decision.tolist() == [Decision.MATCHED]
    assert fusion.cluster_decision.tolist() == [Decision.LOW_OVERLAP, Decision.MATCHED]
    assert fusion.detection_points[0] > len(PERSON), "those of the wall count too"
    row = fusion.pairs.cluster == 1
    assert fusion.pairs.points[row] == len(PERSON)
    assert fusion.pairs.depth[row] == pytest.approx(8)
    assert fusion.pairs.iou[row] > 0.8
    assert np.isinf(fusion.pairs.cost[~row]).all()


def test_the_reference_names_everything_near_the_centre() -> None:
    wall = slab(15, 0.2, -0.5, 6, 2)
    points, clusters = clusters_of([wall, PERSON, slab(-8, 0, 0, 1, 1), slab(8, 6, 0, 1, 1)])
    fusion = run(points, clusters, detections_of([silhouette(PERSON)]), REFERENCE)
    matched, unseen, far = Decision.MATCHED, Decision.OUT_OF_VIEW, Decision.TOO_FAR
    assert fusion.cluster_decision.tolist() == [matched, matched, unseen, far]
    assert fusion.cluster_detection.tolist() == [0, 0, -1, 0]
    assert fusion.detection_cluster.tolist() == [1], "of those that take it, the nearest in the image"
    assert fusion.pairs.distance[fusion.pairs.cluster == 3] == pytest.approx(6 / 8 * 300, abs=3)


@pytest.mark.parametrize("order", [1, -1])
def test_the_nearer_of_two_clusters_is_taken(order: int) -> None:
    near, far = slab(8, 0, -0.5, 0.6, 1.8), slab(16, 0, -1, 1.2, 3.6)
    points, clusters = clusters_of([near, far][::order])
    fusion = run(points, clusters, detections_of([silhouette(near)]))
    k = int(fusion.detection_cluster[0])
    assert clusters.centroid[k, 0] == 8
    assert fusion.cluster_decision[1 - k] == Decision.TAKEN


def test_a_truck_is_not_the_pedestrian_before_it() -> None:
    truck = slab(20, 0, 0, 6, 3.5)
    points, clusters = clusters_of([PERSON, truck])
    fusion = run(points, clusters, detections_of([silhouette(truck)]))
    assert fusion.detection_cluster.tolist() == [1]
    both = run(points, clusters, detections_of([silhouette(truck), silhouette(PERSON)]))
    assert both.detection_cluster.tolist() == [1, 0]


def test_the_surer_of_two_boxes_gets_the_cluster() -> None:
    box = silhouette(PERSON)
    points, clusters = clusters_of([PERSON])
    # The weak one fits a little better.
    fusion = run(points, clusters, detections_of([silhouette(PERSON, 5, 5), box], [0.8, 0.4]))
    assert fusion.detection_decision.tolist() == [Decision.MATCHED, Decision.TAKEN]
    assert fusion.detection_cluster.tolist() == [0, 0]
    assert fusion.cluster_detection.tolist() == [0]


def test_every_rule_has_its_decision() -> None:
    points, clusters = clusters_of([PERSON])
    people = detections_of([silhouette(PERSON)])
    cases = [
        (people, FusionConfig(min_points=1000), Decision.TOO_FEW_POINTS),
        (detections_of([silhouette(PERSON, 200, 100)]), FusionConfig(min_iou=0.5), Decision.LOW_OVERLAP),
        (people, FusionConfig(max_depth=7), Decision.TOO_FAR),
        (people, FusionConfig(max_depth=9), Decision.MATCHED),
    ]
    for detections, config, expected in cases:
        fusion = run(points, clusters, detections, config)
        assert fusion.detection_decision.tolist() == [expected]
        assert fusion.cluster_decision.tolist() == [expected]
        assert fusion.detection_cluster.tolist() == [0]


@pytest.mark.parametrize("config", [DEFAULT, REFERENCE], ids=["frustum", "centroid"])
def test_dropped_detections_take_no_cluster(config: FusionConfig) -> None:
    points, clusters = clusters_of([PERSON, slab(8, 3, 0, 1, 1)], noise=slab(8, -3, 0, 0.1, 0.1))
    box = silhouette(PERSON)
    small = replace(clusters, state=np.array([ClusterState.TOO_SMALL, 0], np.int32))
    fusion = run(points, small, detections_of([box]), replace_radius(config))
    assert fusion.cluster_decision[0] == Decision.NOT_KEPT
    assert fusion.cluster_detection[0] == -1
    assert fusion.detection_points[0] == len(PERSON)
    weak = replace(detections_of([box]), state=np.array([DetectionState.BELOW_THRESHOLD], np.int32))
    fusion = run(points, clusters, weak, config)
    assert fusion.detection_decision.tolist() == [Decision.NOT_KEPT]
    assert fusion.detection_points[0] == len(PERSON)
    assert fusion.cluster_decision.tolist() == [Decision.NO_DETECTION] * 2


def replace_radius(config: FusionConfig) -> FusionConfig:
    return config.model_copy(update={"match_radius": 10.0})


def test_noise_in_the_frustum_is_no_cluster() -> None:
    points, clusters = clusters_of([slab(8, 3, 0, 1, 1)], noise=PERSON)
    fusion = run(points, clusters, detections_of([silhouette(PERSON)]))
    assert fusion.detection_decision.tolist() == [Decision.NO_CLUSTER]
    assert fusion.detection_points.tolist() == [len(PERSON)]


def test_a_cluster_cut_by_the_image_border_still_matches() -> None:
    car = slab(6, 6, 0, 4, 1.5)
    points, clusters = clusters_of([car, slab(-6, 0, 0, 1, 1)])
    fusion = run(points, clusters, detections_of([silhouette(car)]))
    assert fusion.detection_cluster.tolist() == [0]
    assert fusion.pairs.iou[0] > 0.7
    assert (fusion.cluster_uv[0] >= -0.5).all()
    assert np.isnan(fusion.cluster_uv[1]).all()
    assert fusion.cluster_decision[1] == Decision.OUT_OF_VIEW


@pytest.mark.parametrize("config", [DEFAULT, REFERENCE], ids=["frustum", "centroid"])
def test_empty_inputs_are_fused(config: FusionConfig) -> None:
    nothing = clusters_of([])
    something = clusters_of([PERSON])
    assert run(*nothing, Detections.empty(), config).cluster_uv.shape == (0, 4)
    alone = run(*something, Detections.empty(), config)
    assert alone.cluster_decision.tolist() == [Decision.NO_DETECTION]
    lonely = run(*nothing, detections_of([silhouette(PERSON)]), config)
    assert lonely.detection_decision.tolist() == [Decision.NO_CLUSTER]
    assert lonely.detection_cluster.tolist() == [-1]


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([DEFAULT, REFERENCE]))
def test_random_scenes_keep_the_rules(seed: int, config: FusionConfig) -> None:
    rng = np.random.default_rng(seed)
    parts = [
        slab(rng.uniform(-5, 40), rng.uniform(-15, 15), 0, rng.uniform(0.2, 6), rng.uniform(0.2, 3), 0.3)
        for _ in range(rng.integers(0, 8))
    ]
    points, clusters = clusters_of(parts, noise=rng.uniform(-10, 30, (20, 3)).astype(np.float32))
    clusters = replace(clusters, state=rng.choice([0, 0, 0, 1, 2], len(parts)).astype(np.int32))
    low = rng.uniform(0, [600, 320], (rng.integers(0, 6), 2))
    boxes = np.hstack([low, np.minimum(low + rng.uniform(5, 200, low.shape), [639, 359])]).astype(np.float32)
    detections = detections_of(list(boxes))
    detections = replace(detections, state=rng.choice([0, 0, 0, 1, 2], len(boxes)).astype(np.int32))
    order = rng.permutation(len(points))
    fusion = run(points, clusters, detections, config)
    again = run(points[order], replace(clusters, labels=clusters.labels[order]), detections, config)
    np.testing.assert_array_equal(fusion.detection_cluster, again.detection_cluster)
    np.testing.assert_array_equal(fusion.cluster_decision, again.cluster_decision)
    uv, _ = project(apply(CAMERA_FROM_LIDAR, points), CAMERA)
    for d, (x0, y0, x1, y1) in enumerate(boxes):
        inside = (uv[:, 0] >= x0) & (uv[:, 0] <= x1) & (uv[:, 1] >= y0) & (uv[:, 1] <= y1)
        assert fusion.detection_points[d] == inside.sum()
        if config.method == "frustum":
            mine = fusion.pairs.detection == d
            counts = [np.count_nonzero(inside & (clusters.labels == k)) for k in fusion.pairs.cluster[mine]]
            assert fusion.pairs.points[mine].tolist() == counts


# --- assignment --------------------------------------------------------------------------------


@st.composite
def costs(draw: st.DrawFn) -> F64:
    rows, columns = draw(st.integers(0, 5)), draw(st.integers(0, 5))
    value = st.floats(0, 2) | st.just(np.inf) | st.sampled_from([0.0, 0.5, 1.0])
    flat = draw(st.lists(value, min_size=rows * columns, max_size=rows * columns))
    return np.array(flat, np.float64).reshape(rows, columns)


@settings(deadline=None)
@given(costs())
def test_the_assignment_has_the_least_cost(cost: F64) -> None:
    rows, columns = cost.shape

    def total(choice: tuple[int, ...]) -> float:
        return sum(1.0 if k < 0 else float(cost[d, k]) for d, k in enumerate(choice))

    choices = (
        c
        for c in itertools.product(range(-1, columns), repeat=rows)
        if len({k for k in c if k >= 0}) == sum(k >= 0 for k in c)
    )
    found = tuple(assign(cost, unmatched=1.0).tolist())
    taken = [k for k in found if k >= 0]
    assert len(set(taken)) == len(taken)
    assert total(found) == pytest.approx(min(map(total, choices)))


# --- merge -------------------------------------------------------------------------------------


def result(name: str, detections: Detections, fusion: Fusion) -> CameraResult:
    return CameraResult(Camera(name, None, CAMERA, CAMERA_FROM_LIDAR, None), detections, fusion)


def test_the_surer_camera_names_the_object() -> None:
    other = slab(10, 2.5, 0, 1, 1)
    points, clusters = clusters_of([PERSON, other])
    clusters = replace(clusters, obb=replace(clusters.obb, yaw=np.ones(2, np.float32)))
    left = detections_of([silhouette(PERSON), silhouette(other)], [0.6, 0.5], "person car")
    right = detections_of([silhouette(PERSON)], [0.8], "cyclist")
    cameras = [
        result("left", left, run(points, clusters, left)),
        result("right", right, run(points, clusters, right)),
    ]
    cameras.append(CameraResult(cameras[0].camera, None, None))
    objects = merge(clusters, cameras, ClusteringConfig())
    assert objects.names == ("cyclist", "car")
    assert objects.camera == ("right", "left")
    assert objects.cluster.tolist() == [0, 1]
    assert objects.detection.tolist() == [0, 1]
    np.testing.assert_allclose(objects.score, [0.8, 0.5])
    np.testing.assert_array_equal(objects.boxes.yaw, [1, 1])
    flat = merge(clusters, cameras, ClusteringConfig(boxes="axis_aligned"))
    np.testing.assert_array_equal(flat.boxes.yaw, [0, 0])
    assert len(merge(clusters, [], ClusteringConfig())) == 0


# --- real --------------------------------------------------------------------------------------


class Kitti:
    """A frame of the KITTI object benchmark, fused as the pipeline does it."""

    def __init__(self, root: Path, frame: str, config: Config) -> None:
        calib = dict(
            line.split(": ") for line in (root / f"calib/{frame}.txt").read_text().splitlines() if line
        )
        p2 = np.array(calib["P2"].split(), float).reshape(3, 4)
        shift, rectify, lidar = np.eye(4), np.eye(4), np.eye(4)
        shift[:3, 3] = np.linalg.solve(p2[:, :3], p2[:, 3])
        rectify[:3, :3] = np.array(calib["R0_rect"].split(), float).reshape(3, 3)
        lidar[:3] = np.array(calib["Tr_velo_to_cam"].split(), float).reshape(3, 4)
        self.rectified_from_lidar = rectify @ lidar
        self.camera_from_lidar = shift @ self.rectified_from_lidar
        self.p2 = p2
        image = cv2.imread(str(root / f"image_2/{frame}.png"))
        assert image is not None
        self.intrinsics = Intrinsics(image.shape[1], image.shape[0], p2[:, :3])
        self.points = np.fromfile(root / f"velodyne/{frame}.bin", np.float32).reshape(-1, 4)[:, :3].copy()
        voxels = voxel_grid(self.points, config.voxel).points
        obstacles = voxels[~segment_ground(voxels, config.ground).mask]
        self.clusters = cluster(obstacles, config.clustering)
        self.image = np.asarray(image, np.uint8)
        self.uv, self.depth = project(apply(self.camera_from_lidar, obstacles), self.intrinsics)
        self.config = config
        rows = [line.split() for line in (root / f"label_2/{frame}.txt").read_text().splitlines()]
        self.labels = [
            (
                row[0],
                np.array(row[4:8], np.float32),
                apply(inverse(self.rectified_from_lidar), np.array([row[11:14]], float))[0],
            )
            for row in rows
            if row[0] != "DontCare"
        ]
        self.lengths = [float(row[10]) for row in rows if row[0] != "DontCare"]

    def detect(self) -> Detections:
        return Detector(self.config.detector)(self.image)

    def fuse(self, detections: Detections) -> CameraResult:
        args = self.clusters, detections, self.intrinsics, self.camera_from_lidar, self.config.fusion
        fusion = fuse(self.uv, self.depth, *args)
        check(fusion, self.clusters, detections, self.config.fusion)
        camera = Camera("camera", None, self.intrinsics, self.camera_from_lidar, None)
        return CameraResult(camera, detections, fusion, self.uv, self.depth)


def settings_for(shared: Path, *more: str, preset: str = "default") -> Config:
    model = f"detector.model={shared / 'models/yolox_nano.onnx'}"
    return load(
        None, [model, "detector.threads=1", *more], "reference" if preset == "reference" else "default"
    )


def test_kitti_projection_is_that_of_its_calibration(shared: Path) -> None:
    frame = Kitti(shared / "kitti", "000000", settings_for(shared))
    uv, depth = project(apply(frame.camera_from_lidar, frame.points), frame.intrinsics)
    ahead = depth > 1
    homogeneous = np.column_stack([frame.points[ahead], np.ones(ahead.sum())]).astype(np.float64)
    pixel = (frame.p2 @ frame.rectified_from_lidar @ homogeneous.T).T
    expected = pixel[:, :2] / pixel[:, 2:]
    near = np.all(np.abs(expected) < 2000, axis=1)
    np.testing.assert_allclose(uv[ahead][near], expected[near], atol=0.01)


def test_kitti_pedestrian_is_matched_with_its_own_cluster(shared: Path) -> None:
    frame = Kitti(shared / "kitti", "000000", settings_for(shared))
    (kind, box, center) = frame.labels[0]
    assert kind == "Pedestrian"
    result = frame.fuse(frame.detect())
    objects = merge(frame.clusters, [result], frame.config.clustering)
    assert objects.names == ("person",)
    assert result.detections is not None
    assert iou(result.detections.xyxy[objects.detection], box[None])[0, 0] > 0.5
    assert np.linalg.norm(objects.boxes.center[0, :2] - center[:2]) < 0.5
    assert result.fusion is not None
    assert objects.cluster.tolist() == [np.argmax(iou(result.fusion.cluster_uv, box[None]))]


def test_kitti_reference_names_the_walls_too(shared: Path) -> None:
    frame = Kitti(shared / "kitti", "000000", settings_for(shared, preset="reference"))
    objects = merge(frame.clusters, [frame.fuse(frame.detect())], frame.config.clustering)
    assert len(objects) > 1, "the tutorial's flaw: one box, several objects"
    assert set(objects.names) == {"person"}
    assert len(set(objects.detection.tolist())) == 1


@pytest.mark.parametrize(("name", "seen"), [("000000", {"Pedestrian"}), ("000001", {"Truck", "Cyclist"})])
def test_kitti_labels_as_detections_find_their_own_clusters(name: str, seen: set[str], shared: Path) -> None:
    frame = Kitti(shared / "kitti", name, settings_for(shared))
    detections = detections_of([box for _, box, _ in frame.labels])
    result = frame.fuse(replace(detections, names=tuple(kind for kind, _, _ in frame.labels)))
    objects = merge(frame.clusters, [result], frame.config.clustering)
    assert set(objects.names) == seen
    for d, center in zip(objects.detection, objects.boxes.center, strict=True):
        away = np.linalg.norm(center[:2] - frame.labels[d][2][:2])
        assert away < 0.5 + frame.lengths[d] / 2, "of a long truck, its rear is all that is seen"


def test_kitti_far_objects_are_neither_seen_nor_invented(shared: Path) -> None:
    frame = Kitti(shared / "kitti", "000001", settings_for(shared, "detector.explain_threshold=0.02"))
    detections = frame.detect()
    assert len(detections) > 0
    assert (detections.state != DetectionState.KEPT).all()
    assert len(merge(frame.clusters, [frame.fuse(detections)], frame.config.clustering)) == 0
