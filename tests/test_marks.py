"""Marks of missed, false and unexplained objects in recordings of a run."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import rerun as rr

from bevviz.config import load
from bevviz.evaluate import judge, truth_of
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.findings.marks import MarkRecorder
from bevviz.model.decisions import unmatched_detections
from bevviz.model.results import FrameResult
from bevviz.pipeline.session import Session
from bevviz.recording.recorder import Recorder
from tests.support.recordings import Recording

SEED = 5


@cache
def source() -> SyntheticSource:
    return SyntheticSource(20, SEED)


@cache
def result() -> FrameResult:
    return Session(load(settings=["detector.model=demo"])).run(source().snapshot(10).frame)


def recorded(path: Path, shown: FrameResult) -> Recording:
    with rr.RecordingStream("test") as recording:
        recording.save(path)
        for observer in (Recorder(recording, shown.config), MarkRecorder(recording)):
            observer.begin(source())
            observer.observe(shown)
            observer.end()
    return Recording(path)


def says(recording: Recording, path: str) -> list[str]:
    return list(dict.fromkeys(recording.at[path]["says"].get(10, [])))


@pytest.mark.long
def test_missed_and_false_objects_are_marked_everywhere(tmp_path: Path) -> None:
    objects, frame = result().objects, result().frame
    assert objects is not None and frame.truth is not None
    boxes = replace(objects.boxes, center=objects.boxes.center.copy())
    boxes.center[0, :2] += 5.0  # so that one object is missed, and one is false
    shown = replace(result(), objects=replace(objects, boxes=boxes))
    truth = truth_of(frame, frame.truth)
    matches = judge(shown.objects or objects, truth)
    recording = recorded(tmp_path / "a.rrd", shown)
    missed = np.flatnonzero(matches.missed)
    assert len(missed)
    for path in ("/world/missed", "/bev/overlay/missed"):
        assert len(says(recording, path)) == len(missed), path
    assert says(recording, "/world/zed/image/missed")
    assert any(text.startswith(f"false: {objects.names[0]}") for text in says(recording, "/world/false"))
    names = recording.column("/world/missed/names", "Points3D:labels")[0]
    assert all(name.startswith("missed: ") for name in names)
    assert not recording.at["/world/unexplained"]
    # The missed objects alone have names.
    assert not recording.at["/world/zed/image/detections/names"]


def test_missed_is_dashed_and_false_is_crossed_out(tmp_path: Path) -> None:
    objects = result().objects
    assert objects is not None
    boxes = replace(objects.boxes, center=objects.boxes.center + np.float32(5.0))
    recording = recorded(tmp_path / "a.rrd", replace(result(), objects=replace(objects, boxes=boxes)))
    missed, false = (
        recording.column(f"/bev/overlay/{state}", "LineStrips2D:strips")[0] for state in ("missed", "false")
    )
    assert len(missed) % 16 == 0  # four dashes on each of four sides
    assert len(false) % 6 == 0  # four sides and two diagonals


def test_without_a_detector_one_line_says_so(tmp_path: Path) -> None:
    shown = Session(load()).run(source().snapshot(10).frame)
    assert shown.clusters is not None
    recording = recorded(tmp_path / "a.rrd", shown)
    [text] = recording.text("/explain")
    count = int(shown.clusters.kept.sum())
    assert f"- {count} clusters, not compared with detections: no camera has any." in text
    assert "--model FILE.onnx" in text and "kept" not in text
    assert recording.column("/explain/states/pipeline", "StateChange:state") == [["no detector"]]
    assert not recording.at["/world/missed"]  # every object would be


def test_without_truth_unexplained_things_are_marked(tmp_path: Path) -> None:
    camera = result().cameras[0]
    assert camera.detections is not None and camera.fusion is not None
    decisions = camera.fusion.detection_decision.copy()
    lost = int(np.flatnonzero(camera.detections.kept & (decisions == 0))[0])
    decisions[lost] = 1
    blind = replace(camera, fusion=replace(camera.fusion, detection_decision=decisions))
    assert lost in unmatched_detections(blind)
    frame = replace(result().frame, truth=None)
    recording = recorded(tmp_path / "a.rrd", replace(result(), frame=frame, cameras=(blind,)))
    assert says(recording, "/world/unexplained") and says(recording, "/bev/overlay/unexplained")
    assert not recording.at["/world/missed"] and not recording.at["/world/false"]
    label = f"{camera.detections.names[lost]} {camera.detections.score[lost]:.2f}"
    assert label in recording.column("/world/zed/image/detections/names", "Points2D:labels")[0]
