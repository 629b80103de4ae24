"""Mis-tune one to four parameters, and count how often ``bevviz fix`` repairs them on unseen drives.

``python -m benchmarks.fix [--seed N] [--cases N] [--drives N] [--without-defaults]`` simulates drives with a
LiDAR of few beams, and takes boxes around the visible pixels as detections: with scores that grow with the
object's size, doubles, and boxes of nothing. A third of the drives chooses, a third confirms, and the last
third, which the search never sees, judges.
A case is repaired if F1 there is at most 0.01 below the best F1 that is known there: that of
the default parameters or of any fix of this run. Development used seeds below 100.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from bevviz.config import Config, load
from bevviz.evaluate.ground_truth import truth_of
from bevviz.pipeline.session import Variants
from bevviz.why.fix import Sample, SampleFrame, find_fix, keys_for, text_of
from tests.support import small_drives

FRAMES = 5
REPAIRED = 0.01
WORSE = 0.03  # F1 that a mis-tuning has to cost, at least
VALUES: dict[str, Sequence[Any]] = {
    "clustering.eps": (0.2, 0.25, 0.9, 1.2, 1.5),
    "clustering.min_points": (3, 20, 25, 30),
    "clustering.min_cluster_points": (20, 30, 40, 60),
    "clustering.max_cluster_points": (60, 100, 150),
    "detector.conf_threshold": (0.5, 0.6, 0.7, 0.05),
    "detector.iou_threshold": (0.05, 0.9),
    "fusion.min_iou": (0.3, 0.4, 0.5),
    "fusion.min_points": (15, 20, 30),
    "fusion.min_rating": (0.3, 0.4, 0.5),
    "fusion.max_depth": (10.0, 15.0, 20.0),
    "ground.distance_threshold": (0.5, 0.7, 0.9),
    "voxel.size": (0.25, 0.3, 0.4),
    "ground.method": ("plane",),
    "fusion.method": ("centroid",),
}


def noisy(found: small_drives.Candidates, rng: np.random.Generator) -> small_drives.Candidates:
    """Return candidates as a network makes them: weak on small objects, with doubles and boxes of nothing."""
    boxes, _, names = found
    height = boxes[:, 3] - boxes[:, 1]
    score = np.clip(0.25 + 0.02 * height + rng.normal(0, 0.08, len(boxes)), 0.02, 0.98)
    doubles = boxes + rng.normal(0, 0.08, boxes.shape) * height[:, None]
    number = int(rng.integers(1, 4))
    corner = rng.uniform([0, 50], [230, 80], (number, 2))
    nothing = np.hstack([corner, corner + rng.uniform([4, 8], [12, 28], (number, 2))])
    return (
        np.vstack([boxes, doubles, nothing]).astype(np.float32),
        np.concatenate([score, 0.8 * score, rng.uniform(0.02, 0.3, number)]).astype(np.float32),
        [*names, *names, *rng.choice(["person", "car"], number).tolist()],
    )


def simulate(numbers: Sequence[int], loader: small_drives.KnownDetections) -> list[SampleFrame]:
    """Simulate drives. Their detections go to the loader."""
    frames: list[SampleFrame] = []
    for number in numbers:
        rng = np.random.default_rng(number)
        drive = small_drives.source(number, FRAMES)
        # Stamps tell the loader which image is asked about.
        for snapshot in small_drives.snapshots(drive, FRAMES, start=number * 10**12):
            image = snapshot.frame.cameras[0].image
            assert image is not None and snapshot.frame.truth is not None
            loader.add(image.stamp, noisy(small_drives.candidates(snapshot), rng))
            truth = truth_of(snapshot.frame, snapshot.frame.truth)
            frames.append(SampleFrame(snapshot.frame, truth, str(number), False, 1.0))
    return frames


def draw_case(rng: np.random.Generator, number: int) -> dict[str, Any]:
    keys = rng.choice(list(VALUES), number, replace=False).tolist()
    return {key: VALUES[key][int(rng.integers(len(VALUES[key])))] for key in keys}


def mistuned(case: dict[str, Any]) -> Config:
    return load(settings=[f"{key}={text_of(value)}" for key, value in case.items()])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cases", type=int, default=20)
    parser.add_argument("--drives", type=int, default=8, help="of each third")
    parser.add_argument("--trials", type=int, default=72)
    parser.add_argument("--without-defaults", action="store_true", help="do not try the default values first")
    options = parser.parse_args()
    start = time.perf_counter()
    loader = small_drives.KnownDetections()
    thirds = [
        simulate(range(first, first + options.drives), loader)
        for first in (1000 * options.seed + k * options.drives for k in range(3))
    ]
    choosing, confirming, judging = (Sample(frames, Variants(loader)) for frames in thirds)
    print(f"{3 * options.drives} drives simulated in {time.perf_counter() - start:.0f} s", flush=True)

    def judged(config: Config) -> float:
        return judging.f1([config])[0]

    default = judged(load())
    print(f"default: F1 {default:.3f}", flush=True)
    rng, cases = np.random.default_rng(options.seed), list[tuple[dict[str, Any], float, float]]()
    confirmed = 0
    while len(cases) < options.cases:
        case = draw_case(rng, 1 + len(cases) % 4)
        config = mistuned(case)
        before = judged(config)
        if before > default - WORSE:
            continue
        start = time.perf_counter()
        keys = keys_for(choosing.reasons(config), config)
        fix = find_fix(
            config, keys, choosing, confirming, options.trials, defaults=not options.without_defaults
        )
        settings = {**case, **fix.settings}
        after = judged(mistuned(settings))
        confirmed += fix.confirmed
        cases.append((case, before, after))
        seconds = time.perf_counter() - start
        print(f"{before:.3f} -> {after:.3f}  {case}: {dict(fix.settings)} ({seconds:.0f} s)", flush=True)
    best = max(default, *(after for _, _, after in cases))
    repaired = sum(after >= best - REPAIRED for _, _, after in cases)
    as_default = sum(after >= default - REPAIRED for _, _, after in cases)
    print(
        f"best F1 {best:.3f}; repaired {repaired} of {len(cases)}; {as_default} within 0.01 of the default's"
    )
    print(f"confirmed {confirmed} of {len(cases)}")


if __name__ == "__main__":
    main()
