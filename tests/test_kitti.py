"""The whole path on real data: two KITTI frames as a bag, a COCO detector, a recording read back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bevviz.bags.source import BagSource
from bevviz.config import load
from bevviz.model import geometry
from bevviz.model.results import Decision, DetectionState, FrameResult
from bevviz.pipeline.session import Session
from tests.support import bags
from tests.support.kitti_labels import CLASSES, labels
from tests.support.recordings import Recording


@pytest.fixture(scope="module")
def bag(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bags.write(tmp_path_factory.mktemp("kitti") / "kitti", bags.kitti_items(shared))


@pytest.fixture(scope="module")
def model(shared: Path) -> Path:
    return shared / "models/yolox_nano.onnx"


@pytest.fixture(scope="module", params=["default", "reference"])
def preset(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def results(bag: Path, model: Path) -> list[FrameResult]:
    # The two frames are of different streets, so that no motion leads from one to the other.
    config = load(settings=[f"detector.model={model}", "odometry.method=none"])
    with BagSource([bag], config) as source:
        session = Session(config)
        return [session.run(frame) for frame in source]


def test_every_frame_is_whole(results: list[FrameResult]) -> None:
    assert len(results) == 2
    for result in results:
        assert result.failures == ()
        assert result.frame.cameras[0].camera_from_points is not None
        assert len(result.frame.points) > 110_000


def test_projection_agrees_with_the_calibration(shared: Path, results: list[FrameResult]) -> None:
    for name, result in zip(("000000", "000001"), results, strict=True):
        kitti = bags.kitti(shared, name)
        points = kitti.points[:, :3].astype(np.float64)
        homogeneous = np.column_stack([points, np.ones(len(points))]) @ kitti.pixels_from_lidar.T
        ahead = homogeneous[:, 2] > 1.0
        expected = homogeneous[ahead, :2] / homogeneous[ahead, 2:]
        camera = result.frame.cameras[0]
        assert camera.intrinsics is not None
        assert camera.camera_from_points is not None
        moved = geometry.apply(camera.camera_from_points, kitti.points[ahead, :3])
        uv, _ = geometry.project(moved, camera.intrinsics)
        seen = ((expected >= 0) & (expected < [1242, 375])).all(axis=1)
        assert seen.sum() > 15_000
        assert np.abs(uv[seen] - expected[seen]).max() < 0.01


def test_the_pedestrian_is_detected_matched_and_placed(shared: Path, results: list[FrameResult]) -> None:
    ((_, centre),) = labels(shared, "000000")
    objects = results[0].objects
    assert objects is not None
    people = [j for j, name in enumerate(objects.names) if name == "person"]
    assert people
    away = [float(np.hypot(*(objects.boxes.center[j, :2] - centre[:2]))) for j in people]
    assert min(away) < 0.5
    person = people[int(np.argmin(away))]
    clusters, camera = results[0].clusters, results[0].cameras[0]
    assert clusters is not None
    assert camera.fusion is not None
    # Its own cluster: as large as a person, not the wall behind.
    size = clusters.obb.size[objects.cluster[person]]
    assert 1.2 < size[2] < 2.2
    assert size[:2].max() < 1.5
    said = [e.text for e in results[0].explanations if e.subject == "detection" and e.state == "matched"]
    assert any(text.startswith("person") and "matched" in text for text in said)


def test_nothing_is_matched_far_from_a_label(shared: Path, results: list[FrameResult]) -> None:
    truth = labels(shared, "000001")
    objects, camera = results[1].objects, results[1].cameras[0]
    assert objects is not None
    for j, name in enumerate(objects.names):
        away = [
            np.hypot(*(objects.boxes.center[j, :2] - centre[:2]))
            for kind, centre in truth
            if name in CLASSES[kind]
        ]
        assert away
        assert min(away) < 3.0
    assert camera.detections is not None
    said = [e for e in results[1].explanations if e.subject == "detection"]
    assert len(said) == len(camera.detections) > 0


def test_no_threshold_matches_objects_far_from_a_label(shared: Path, bag: Path, model: Path) -> None:
    """The small objects of 000001 do appear as weak detections: those that match must match rightly."""
    truth = labels(shared, "000001")
    config = load(settings=[f"detector.model={model}", "detector.conf_threshold=0.1"])
    with BagSource([bag], config, frames=(1, 2)) as source:
        session = Session(config)
        (result,) = [session.run(frame) for frame in source]
    assert result.objects is not None
    for j, name in enumerate(result.objects.names):
        away = [
            np.hypot(*(result.objects.boxes.center[j, :2] - centre[:2]))
            for kind, centre in truth
            if name in CLASSES[kind]
        ]
        assert away, f"{name} where the labels have none"
        assert min(away) < 3.0
    fusion = result.cameras[0].fusion
    assert fusion is not None
    matched = int((fusion.detection_decision == Decision.MATCHED).sum())
    assert matched == len(result.objects)


def test_the_recording_holds_what_was_decided(
    bag: Path, model: Path, tmp_path: Path, results: list[FrameResult]
) -> None:
    from bevviz.cli import main

    saved = tmp_path / "kitti.rrd"
    assert main(["bag", str(bag), "--model", str(model), "--save", str(saved)]) == 0
    recording = Recording(saved)
    texts = recording.text("/explain")
    assert len(texts) == 2
    for text, result in zip(texts, results, strict=True):
        for explanation in result.explanations:
            if explanation.subject == "detection" and explanation.state != "suppressed":
                assert explanation.text.split(": ", 1)[1] in text
        (found,) = (c.detections for c in result.cameras if c.detections is not None)
        for d in set(found.suppressed_by[found.state == DetectionState.SUPPRESSED].tolist()):
            assert f" suppressed by {found.names[d]} {found.score[d]:.2f}" in text
    points = recording.column("/world/velodyne/points", "Points3D:positions")
    np.testing.assert_array_equal(np.array(points[0], np.float32), results[0].frame.points)
