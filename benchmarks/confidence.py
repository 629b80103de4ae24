"""Fit how sure answers without ground truth are, and check it on other drives and other mis-tunings.

``python -m benchmarks.confidence fit`` writes bevviz/why/confidence_table.py. ``check`` prints how often the
answers are right, with 95 % intervals by drawing whole drives.
"""

from __future__ import annotations

import argparse
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.truth import Rule, scene_of
from benchmarks.why import CLASSES, MIN_HEIGHT, MISTUNED
from bevviz.config import load
from bevviz.evaluate import MIN_HITS, RANGE
from bevviz.model.frame import F64
from bevviz.pipeline.session import Session
from bevviz.pipeline.stage_loader import StageLoader
from bevviz.synthetic import SyntheticSource
from bevviz.why import FrameExplainer, Selection
from bevviz.why.confidence import LIMIT, features_of, stage_of

TABLE = Path(__file__).parents[1] / "bevviz/why/confidence_table.py"
DRIVES = {"fit": range(1020, 1030), "check": range(1050, 1058)}
FRAMES = {"fit": (5, 45, 85), "check": (20, 70)}
MISTUNINGS: dict[str, tuple[tuple[str, ...], ...]] = {
    "fit": (
        (),
        MISTUNED,
        *((setting,) for setting in MISTUNED),
        ("ground.distance_threshold=0.5",),
        ("clustering.max_cluster_points=150",),
        ("detector.iou_threshold=0.15",),
    ),
    "check": (
        ("clustering.min_points=25",),
        ("clustering.eps=0.25",),
        ("clustering.eps=1.2",),
        ("detector.conf_threshold=0.4", "clustering.min_cluster_points=40"),
        ("fusion.min_points=30",),
        ("fusion.max_depth=15",),
        ("ground.method=plane", "ground.distance_threshold=0.4"),
        ("voxel.size=0.25",),
        ("fusion.split=false",),
        ("fusion.method=centroid", "fusion.match_radius=40"),
    ),
}


@dataclass(frozen=True, slots=True)
class Observation:
    """One answer without ground truth, held against the rule."""

    seed: int
    kind: str
    stage: str
    features: F64
    truth: str
    right: bool
    confidence: float


def observe(part: str) -> Iterator[Observation]:
    """Ask about each visible object of the drives by the box around it, labels hidden."""
    loader, model = StageLoader(), "detector.model=demo"
    configs = [load(settings=[model, *settings]) for settings in MISTUNINGS[part]]
    if part == "fit":
        configs.append(load(settings=[model], preset="reference"))
    sessions = [Session(config, loader=loader) for config in configs]
    for seed in DRIVES[part]:
        source = SyntheticSource(100, seed)
        for index in FRAMES[part]:
            shot = source.snapshot(index)
            scene = scene_of(source, shot)
            for session in sessions:
                result = session.run(shot.frame)
                rule = Rule(shot, scene, result)
                known = FrameExplainer(result, loader, CLASSES).traces
                blind = FrameExplainer(
                    replace(result, frame=replace(result.frame, truth=None)), loader, CLASSES
                )
                for row, subject in enumerate(known.truth):
                    box = tuple(scene.pixels[row].tolist())
                    assert subject.box is not None
                    near = np.hypot(*subject.box.center[0, :2]) <= RANGE
                    near &= len(known.place(subject)) >= MIN_HITS
                    if not near or not box[3] - box[1] >= MIN_HEIGHT:
                        continue
                    answer, cause = blind.ask(Selection(box=box))[0], rule.cause(row)
                    kind, reported = answer.verdict.kind, answer.verdict.reported
                    features = features_of(answer.subject, answer.evidence, blind.traces)
                    right = (kind, reported) == (cause.reason, cause.reported)
                    sure = answer.confidence if answer.confidence is not None else np.nan
                    yield Observation(
                        seed, kind.value, stage_of(kind), features, cause.reason.value, right, sure
                    )


def logistic(X: F64, y: F64, weight: float = 1.0) -> F64:
    """Fit a logistic regression with squared coefficients as penalty, by Newton's method."""
    w, penalty = np.zeros(X.shape[1]), weight * np.eye(X.shape[1])
    for _ in range(30):
        p = 1 / (1 + np.exp(-X @ w))
        w += np.linalg.solve((X * (p * (1 - p))[:, None]).T @ X + penalty, X.T @ (y - p) - penalty @ w)
    return w


def table_of(observations: Sequence[Observation]) -> str:
    """Return the module with the coefficients of each stage and the second reason of each kind."""
    seeds = DRIVES["fit"]
    lines = [
        '"""Coefficients of ``confidence``, written by ``python -m benchmarks.confidence fit``.',
        "",
        f"They are fitted to {len(observations)} answers on the drives {seeds[0]} to {seeds[-1]}.",
        '"""',
        "",
        "COEFFICIENTS: dict[str, tuple[float, ...]] = {  # in the order of FEATURES",
    ]
    by_stage: dict[str, list[Observation]] = defaultdict(list)
    wrong: dict[str, Counter[str]] = defaultdict(Counter)
    for seen in observations:
        by_stage[seen.stage].append(seen)
        if seen.truth != seen.kind:
            wrong[seen.kind].update([seen.truth])
    for stage, group in sorted(by_stage.items()):
        X, y = np.array([seen.features for seen in group]), np.array([float(seen.right) for seen in group])
        values = ", ".join(f"{value:.2f}" for value in logistic(X, y))
        lines.append(f'    "{stage}": ({values}),')
    lines += ["}", "SECOND: dict[str, str] = {  # the right reason most often where this one was wrong"]
    lines += [f'    "{kind}": "{counts.most_common(1)[0][0]}",' for kind, counts in sorted(wrong.items())]
    return "\n".join([*lines, "}"]) + "\n"


def report(observations: Sequence[Observation]) -> str:
    """Format the shares with their intervals."""
    seeds = np.array([seen.seed for seen in observations])
    right = np.array([seen.right for seen in observations])
    sure = np.array([seen.confidence for seen in observations])
    answered = ~(sure < LIMIT)
    shares = {
        "right without a limit": (right, np.ones_like(right)),
        "answered": (answered, np.ones_like(right)),
        "right, of answered": (right, answered),
        "stated, of answered": (np.nan_to_num(sure), answered),
        "right or cannot tell": (right | ~answered, np.ones_like(right)),
    }
    rng, drives = np.random.default_rng(0), np.unique(seeds)
    draws = [rng.choice(drives, len(drives)) for _ in range(1000)]
    lines = [f"{len(right)} answers on {len(drives)} drives"]
    for name, (value, mask) in shares.items():
        parts = np.array([[(value * mask)[seeds == s].sum(), mask[seeds == s].sum()] for s in drives])
        sums = np.array([parts[np.searchsorted(drives, draw)].sum(0) for draw in draws])
        low, high = np.quantile(sums[:, 0] / sums[:, 1], (0.025, 0.975))
        lines.append(f"{name}: {100 * value[mask].mean():.1f} % ({100 * low:.1f}-{100 * high:.1f} %)")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=("fit", "check"))
    part = parser.parse_args().part
    observations = list(observe(part))
    if part == "fit":
        TABLE.write_text(table_of(observations))
    else:
        print(report(observations))


if __name__ == "__main__":
    main()
