"""Search of parameters: it repairs a mis-tuning on drives that it has not seen, and admits when it cannot."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from bevviz.cli import main
from bevviz.config import load
from bevviz.evaluate.ground_truth import truth_of
from bevviz.pipeline.session import Variants
from bevviz.why.fix import Fix, Sample, SampleFrame, find_fix, keys_for
from bevviz.why.parameter_search import Settings, choices_of, search
from tests.support import small_drives

FRAMES = 2
DRIVES = 3  # of each sample


def sample(first: int, loader: small_drives.KnownDetections) -> Sample:
    frames = []
    for seed in range(first, first + DRIVES):
        drive = small_drives.source(seed, FRAMES)
        for snapshot in small_drives.snapshots(drive, FRAMES, start=seed * 10**12):
            image, truth = snapshot.frame.cameras[0].image, snapshot.frame.truth
            assert image is not None and truth is not None
            loader.add(image.stamp, small_drives.candidates(snapshot))
            frames.append(SampleFrame(snapshot.frame, truth_of(snapshot.frame, truth), str(seed), True, 1.0))
    return Sample(frames, Variants(loader))


@pytest.fixture(scope="module")
def samples() -> tuple[Sample, Sample]:
    loader = small_drives.KnownDetections()
    return sample(10, loader), sample(10 + DRIVES, loader)


@pytest.mark.long
def test_two_wrong_parameters_are_repaired(samples: tuple[Sample, Sample]) -> None:
    choosing, confirming = samples
    config = load(settings=["detector.conf_threshold=0.9", "fusion.min_iou=0.6"])
    reasons = choosing.reasons(config)
    assert reasons["below threshold"] > 0
    keys = ["detector.conf_threshold", "fusion.min_iou"]
    fix = find_fix(config, keys, choosing, confirming, trials=24)
    assert set(fix.settings) == set(keys)
    default = confirming.f1([load()])[0]
    assert fix.f1_after >= default - 0.01 and fix.f1_before < default - 0.1
    assert fix.confirmed and fix.f1_change[0] > 0
    assert 0 < fix.fixed <= fix.missed and fix.cause_fixed == fix.fixed
    assert f"fixes {fix.fixed} of {fix.missed} missed objects" in "\n".join(fix.lines())


@pytest.mark.long
def test_the_file_repeats_what_was_measured(samples: tuple[Sample, Sample], tmp_path: Path) -> None:
    choosing, confirming = samples
    config = load(settings=["fusion.min_rating=0.6"])
    fix = find_fix(config, ["fusion.min_rating", "fusion.split"], choosing, confirming, trials=16)
    file = tmp_path / "fix.yaml"
    file.write_text(fix.yaml())
    repeated = confirming.f1([load(file)])[0]
    assert repeated == pytest.approx(fix.f1_after)


@pytest.mark.long
def test_good_parameters_stay(samples: tuple[Sample, Sample]) -> None:
    """A change that helps fewer than one object is left out."""
    choosing, confirming = samples
    fix = find_fix(load(), ["fusion.max_depth", "clustering.max_cluster_points"], choosing, confirming, 16)
    assert not fix.settings and not fix.confirmed
    assert "none is better than the present ones" in "\n".join(fix.lines())


def test_a_gain_that_may_be_chance_is_not_confirmed() -> None:
    def text(confirmed: bool) -> str:
        change = (0.01 if confirmed else -0.01, 0.2)
        counts = (1, 2, 0, 9, 0, 0, 1, 1, 6, 3)
        return "\n".join(Fix({"a.b": 1}, confirmed, ["a.b"], 9, 0.5, 0.6, change, *counts, True).lines())

    assert "not confirmed: it may as well be chance" in text(confirmed=False)
    assert "parts of drives" in text(confirmed=True) and "not confirmed" not in text(confirmed=True)


def test_the_search_finds_values_that_only_help_together() -> None:
    keys = ["clustering.eps", "clustering.min_points", "fusion.min_iou"]
    config = load(settings=["clustering.eps=2", "clustering.min_points=40", "fusion.min_iou=0.4"])
    wanted = {"clustering.eps": 0.8, "clustering.min_points": 16, "fusion.min_iou": 0.16}
    present = {"clustering.eps": 2.0, "clustering.min_points": 40, "fusion.min_iou": 0.4}
    calls: list[int] = []

    def objective(settings: Sequence[Settings]) -> list[float]:
        calls.append(len(settings))
        away = [[abs(np.log({**present, **s}[key] / wanted[key])) for key in keys] for s in settings]
        return [-max(distances) for distances in away]

    tried = list(search(config, keys, objective, trials=90, defaults=False))
    assert tried[0][0] == {} and len(tried) == sum(calls) <= 90
    points = [tuple(sorted(settings.items())) for settings, _ in tried]
    assert len(set(points)) == len(points)
    assert max(value for _, value in tried) > -0.3 > tried[0][1]


def test_values_to_try_are_valid_and_ordered() -> None:
    for key, present, default in (("detector.conf_threshold", 0.6, 0.25), ("clustering.min_points", 25, 10)):
        values = choices_of(present, default, key)
        assert values == sorted(set(values)) and {present, default} <= set(values)
        assert all(load(settings=[f"{key}={value}"]) for value in values)
    assert choices_of(700, None, "clustering.max_cluster_points")[0] is None


def test_frequent_reasons_name_the_parameters() -> None:
    assert keys_for({"suppressed": 90, "too far": 2, "hidden": 8}) == ["detector.iou_threshold"]
    assert keys_for({"hidden": 3}) == []
    wrong = load(settings=["fusion.min_points=30", "voxel.size=0.2", "bev.range_x=40"])
    assert keys_for({"hidden": 3}, wrong) == []
    assert keys_for({"suppressed": 3}, wrong) == ["detector.iou_threshold", "voxel.size", "fusion.min_points"]
    assert keys_for(Counter({"ground": 5, "below threshold": 9}))[0] == "detector.conf_threshold"


@pytest.mark.long
def test_wrong_arguments_are_explained(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = tmp_path / "drive.mcap"
    assert main(["demo", "--frames", "1", "-o", str(bag)]) == 0
    for arguments, text in (
        (["--cause", "1"], "--cause N: PATH has to be the folder of a batch"),
        (["--parameter", "clustering.epsilon", "--model", "demo"], "--parameter clustering.epsilon: unknown"),
    ):
        capsys.readouterr()
        assert main(["fix", str(bag), *arguments]) == 2
        assert text in capsys.readouterr().err
