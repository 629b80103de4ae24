"""Count how often the interval of the recall that is estimated without ground truth holds the true one.

``python -m benchmarks.recall_estimate [--seed N] [--drives N]`` simulates drives with a LiDAR of few beams,
and takes boxes around the visible pixels as detections. Each object has its own chance to be detected, which
falls with its distance; each drive has its own level of these chances, doubles, boxes of nothing, and in
every second drive one or two parameters are mis-tuned. Development used seeds below 100.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from typing import Any

import numpy as np

from benchmarks.fix import draw_case, mistuned, noisy
from bevviz.config import load
from bevviz.evaluate.evaluation import Evaluation
from bevviz.evaluate.ground_truth import truth_of
from bevviz.evaluate.recall_estimate import RecallEstimate, RecallEstimator
from bevviz.pipeline.session import Session
from tests.support import small_drives


def judged(number: int, frames: int) -> tuple[list[RecallEstimate], dict[str, float]]:
    """Return the estimates and the true metrics of a simulated drive."""
    rng = np.random.default_rng(number)
    case: dict[str, Any] = draw_case(rng, int(rng.integers(1, 3))) if number % 2 else {}
    config, loader = mistuned(case) if case else load(), small_drives.KnownDetections()
    session = Session(config, loader=loader)
    estimator = RecallEstimator()
    evaluation = Evaluation(lambda frame: None if frame.truth is None else truth_of(frame, frame.truth))
    level, fall = rng.uniform(0.3, 1.0), rng.uniform(10, 60)
    chances: dict[str, float] = {}
    for snapshot in small_drives.snapshots(small_drives.source(number, frames), frames):
        truth, image = snapshot.frame.truth, snapshot.frame.cameras[0].image
        assert truth is not None and image is not None
        dropped = set()
        for id_, distance in zip(map(str, snapshot.truth_object.tolist()), truth.boxes.distance, strict=True):
            chance = chances.setdefault(id_, float(rng.beta(4 * level + 0.1, 4 * (1 - level) + 0.1)))
            if rng.random() > chance * np.exp(-distance / fall / 2):
                dropped.add(id_)
        loader.add(image.stamp, noisy(small_drives.candidates(snapshot, dropped=dropped), rng))
        result = session.run(snapshot.frame)
        estimator.observe(result)
        evaluation.observe(result)
    return estimator.estimates(), dict(evaluation.metrics)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--drives", type=int, default=100)
    parser.add_argument("--frames", type=int, default=24, help="of each drive, 0.3 s apart")
    options = parser.parse_args()
    start, counts, widths = time.perf_counter(), Counter[tuple[str, str]](), []
    for k in range(options.drives):
        estimates, metrics = judged(1000 * options.seed + k, options.frames)
        for estimate in estimates:
            group = estimate.name if estimate.name == "recall" else "parts"
            if estimate.name not in metrics or np.isnan(metrics[estimate.name]):
                outcome = "no such object"
            elif not estimate.known:
                outcome = "unknown"
            else:
                outcome = "held" if estimate.low <= metrics[estimate.name] <= estimate.high else "not held"
            counts[group, outcome] += 1
            if group == "recall":
                widths += [estimate.high - estimate.low] if estimate.known else []
                print(
                    f"{k}: {estimate.recall:.3f} [{estimate.low:.3f}, {estimate.high:.3f}], "
                    f"true {metrics.get('recall', np.nan):.3f}, {estimate.objects} tracks: {outcome}",
                    flush=True,
                )
    for group in ("recall", "parts"):
        print(group, {outcome: number for (name, outcome), number in sorted(counts.items()) if name == group})
    print(f"median width {np.median(widths):.2f}; {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
