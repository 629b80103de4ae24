"""Estimate of the recall without ground truth: of known populations, and of drives without their labels."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import bevviz
from bevviz.cli import main
from bevviz.evaluate.evaluation import Evaluation
from bevviz.evaluate.ground_truth import truth_of
from bevviz.evaluate.matching import judge
from bevviz.evaluate.recall_estimate import RecallEstimator, estimate_recall
from bevviz.fleet.findings import FindingCollector
from bevviz.pipeline.session import Session
from bevviz.synthetic.bag import TOPICS
from bevviz.synthetic.drive import TRUTH_TOPIC
from bevviz.why import FrameExplainer
from tests.support import documented_json, small_drives


def population(rng: np.random.Generator, objects: int, mean: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the frames and the reports of objects, whose chances differ."""
    number = rng.integers(5, 40, objects)
    return number, rng.binomial(number, rng.beta(3 * mean, 3 * (1 - mean), objects))


@pytest.mark.parametrize("mean", [0.3, 0.6, 0.9])
def test_the_interval_holds_the_recall_of_a_known_population(mean: float) -> None:
    """Objects that are never reported are not known to the estimate."""
    held, rng = 0, np.random.default_rng(0)
    for _ in range(40):
        number, reported = population(rng, 30, mean)
        known = reported > 0
        value, low, high = estimate_recall(number[known], reported[known], np.ones(known.sum(), np.int64))
        assert 0 <= low <= value <= high <= 1
        held += low <= reported.sum() / number.sum() <= high
    assert held >= 36


def test_detections_without_an_object_lower_the_recall() -> None:
    number, reported = population(np.random.default_rng(1), 30, 0.9)
    least = np.ones(30, np.int64)
    assert (reported > 0).all()
    before = estimate_recall(number, reported, least)
    after = estimate_recall(number, reported, least, [0.9] * 200)
    assert after[0] < before[0] - 0.1


def test_a_drive_is_estimated_as_its_labels_tell() -> None:
    loader, frames = small_drives.KnownDetections(), 16
    session, estimator = Session(bevviz.config.load(), loader=loader), RecallEstimator()
    evaluation = Evaluation(lambda frame: None if frame.truth is None else truth_of(frame, frame.truth))
    for snapshot in small_drives.snapshots(small_drives.source(4, frames), frames):
        image = snapshot.frame.cameras[0].image
        assert image is not None
        loader.add(image.stamp, small_drives.candidates(snapshot))
        result = session.run(snapshot.frame)
        estimator.observe(result)
        evaluation.observe(result)
    estimates = {estimate.name: estimate for estimate in estimator.estimates()}
    estimate = estimates["recall"]
    assert estimate.objects >= 10
    assert estimate.low <= evaluation.metrics["recall"] <= estimate.high
    assert estimates["recall.car"].sightings == sum(
        e.sightings for name, e in estimates.items() if name.startswith("recall.car@")
    )


def test_a_track_without_its_detection_is_a_finding_of_a_batch() -> None:
    """The farthest object within 30 m that is found in the seventh frame loses its detections."""
    loader, frames, victim, name = small_drives.KnownDetections(), 10, "", ""
    session, collector = Session(bevviz.config.load(), loader=loader), FindingCollector(None)
    told = 0
    for snapshot in small_drives.snapshots(small_drives.source(4, frames), frames):
        image, labels = snapshot.frame.cameras[0].image, snapshot.frame.truth
        assert image is not None and labels is not None
        loader.add(image.stamp, small_drives.candidates(snapshot, dropped={victim} if victim else set()))
        result = session.run(snapshot.frame)
        findings, truth = collector.of_frame(FrameExplainer(result)), truth_of(snapshot.frame, labels)
        place = dict(zip(map(str, snapshot.truth_object.tolist()), truth.boxes.distance, strict=True))
        for finding in findings if victim else []:
            is_track = finding["outcome"] == "unexplained" and finding.get("object", "").startswith("track")
            if is_track and finding["class"] == name and abs(finding["range_m"] - place[victim]) < 1.5:
                assert finding["reason"] and "was not reported because" in finding["text"]
                told += 1
        if snapshot.frame.index == 6:
            assert result.objects is not None
            found = truth.must & ~judge(result.objects, truth).missed
            row = int(np.argmax(np.where(found & (truth.boxes.distance < 30), truth.boxes.distance, -1)))
            victim, name = str(snapshot.truth_object[row]), truth.labels[row].lower()
    assert told >= 1


def test_nothing_is_known_without_a_track() -> None:
    config = bevviz.config.load(settings=["clustering.min_cluster_points=1_000_000"])
    session, estimator = Session(config, loader=small_drives.KnownDetections()), RecallEstimator()
    assert [estimate.known for estimate in estimator.estimates()] == [False] * 5
    for snapshot in small_drives.snapshots(small_drives.source(4, 2), 2):
        estimator.observe(session.run(snapshot.frame))
    assert estimator.frames == 2
    assert [estimate.known for estimate in estimator.estimates()] == [False] * 5
    assert "unknown" not in estimator.table()  # no objects, no rows


def test_a_bag_without_labels_is_estimated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole, bag = tmp_path / "whole.mcap", tmp_path / "unlabelled.mcap"
    assert main(["demo", "--frames", "8", "-o", str(whole)]) == 0
    assert main(["cut", str(whole), "-o", str(bag), "--topics", *(TOPICS.keys() - {TRUTH_TOPIC})]) == 0
    capsys.readouterr()
    assert main(["evaluate", str(bag), "--model", "demo", "--json"]) == 0
    tree = json.loads(capsys.readouterr().out)
    documented_json.check(tree, "bevviz.evaluate/1")
    assert (tree["frames"], tree["frames_without_truth"]) == (0, 8)
    assert tree["estimated_recall"]["recall"]["objects"] > 0
    assert main(["evaluate", str(bag), "--model", "demo"]) == 0
    said = capsys.readouterr()
    assert "no ground truth: the recall is estimated from tracks" in said.err
    assert "all" in said.out and "95 % interval" in said.out
    with bevviz.open(bag, model="demo") as drive:
        assert drive.estimate_recall()[0].objects == tree["estimated_recall"]["recall"]["objects"]
