from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bevviz.config import load
from bevviz.model.frame import Frame
from bevviz.pipeline.session import Session
from tests.support import kept_drives


@pytest.fixture(scope="module")
def frame() -> Frame:
    return kept_drives.frame()


@pytest.mark.parametrize("preset", ["default", "reference"])
def test_every_stage_runs_on_a_whole_frame(frame: Frame, preset: str) -> None:
    session = Session(load(settings=["detector.model=demo"], preset=preset))  # type: ignore[arg-type]
    result = session.run(frame)
    assert result.failures == ()
    assert result.voxels is not None
    assert result.ground is not None
    assert result.obstacles is not None
    assert result.clusters is not None
    assert result.objects is not None
    assert result.bev is not None
    assert len(result.voxels.inverse) == len(frame.points)
    assert len(result.obstacles) == (~result.ground.mask).sum() == len(result.clusters.labels)
    (camera,) = result.cameras
    assert camera.detections is not None
    assert camera.fusion is not None
    assert len(result.objects) > 0
    subjects = [e.subject for e in result.explanations]
    assert subjects.count("detection") == len(camera.detections)
    assert subjects.count("cluster") == len(result.clusters)
    assert {"voxel", "ground", "clustering", "detector", "fusion", "bev", "total"} <= set(result.timings)


def test_the_pipeline_is_deterministic(frame: Frame) -> None:
    results = []
    for _ in range(2):
        session = Session(load(settings=["detector.model=demo"]))
        results.append(session.run(frame))
    a, b = results
    assert a.explanations == b.explanations
    assert a.clusters is not None
    assert b.clusters is not None
    np.testing.assert_array_equal(a.clusters.labels, b.clusters.labels)


def test_without_points_the_detector_still_runs(frame: Frame) -> None:
    empty = replace(frame, points=np.zeros((0, 3), np.float32), fields={})
    session = Session(load(settings=["detector.model=demo"]))
    result = session.run(empty)
    assert [f.stage for f in result.failures] == ["cloud"]
    assert result.cameras[0].detections is not None
    assert len(result.cameras[0].detections) > 0
    assert result.clusters is None


def test_an_uncalibrated_camera_does_not_stop_other_stages(frame: Frame) -> None:
    lost = replace(frame.cameras[0], camera_from_points=None, problems=("no transform",))
    session = Session(load(settings=["detector.model=demo"]))
    result = session.run(replace(frame, cameras=(lost,)))
    assert result.clusters is not None
    assert result.cameras[0].detections is not None
    assert result.cameras[0].fusion is None
    assert result.objects is not None
    assert len(result.objects) == 0


def test_a_failing_stage_is_a_reason_and_not_the_end(frame: Frame, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*args: object) -> None:
        raise ZeroDivisionError("planted")

    monkeypatch.setattr("bevviz.pipeline.perceive.cluster", broken)
    session = Session(load(settings=["detector.model=demo"]))
    result = session.run(frame)
    assert [(f.stage, f.reason) for f in result.failures] == [("clustering", "ZeroDivisionError: planted")]
    assert result.ground is not None
    assert result.bev is not None
    assert result.cameras[0].detections is not None
