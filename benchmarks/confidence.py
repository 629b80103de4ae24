"""Fit how probable the outcomes of answers without ground truth are, and check it on other drives.

``python -m benchmarks.confidence fit`` writes bevviz/why/confidence_table.py. ``check`` asks on drives and
with mis-tunings that the fit has not seen. Both print how often the answers are right, with 95 % intervals by
drawing whole drives. For ``fit`` each drive is judged by a fit to other drives.
"""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from benchmarks.truth import Rule, scene_of
from benchmarks.why import CLASSES, MIN_HEIGHT, MISTUNED
from bevviz.config import Config, load
from bevviz.evaluate import MIN_HITS, RANGE
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.model.frame import F64, I64, Bool
from bevviz.pipeline.perceive import perceive
from bevviz.pipeline.stage_loader import StageLoader
from bevviz.pipeline.stage_log import Memo
from bevviz.why import FrameExplainer, Selection
from bevviz.why.confidence import LIMIT, features_of, outcome_key
from bevviz.why.confidence_table import COEFFICIENTS

TABLE = Path(__file__).parents[1] / "bevviz/why/confidence_table.py"
PENALTY = 10.0  # weight of the squared coefficients of standardised features
FOLDS = 5
MODEL = "detector.model=demo"
Settings = tuple[str, ...]

LISTED: tuple[Settings, ...] = (
    (),
    MISTUNED,
    *((setting,) for setting in MISTUNED),
    ("ground.distance_threshold=0.5",),
    ("clustering.max_cluster_points=150",),
    ("detector.iou_threshold=0.15",),
)
DRAWN = {  # values of which one, two or three parameters get one
    "clustering.eps": (0.3, 0.35, 0.4, 0.65, 0.8, 0.9, 1.0),
    "clustering.min_points": (12, 15, 18),
    "clustering.min_cluster_points": (15, 20, 30, 50),
    "clustering.max_cluster_points": (100, 150, 300, 500),
    "detector.conf_threshold": (0.3, 0.45, 0.5, 0.6, 0.7),
    "detector.iou_threshold": (0.1, 0.15, 0.25, 0.85),
    "fusion.min_iou": (0.05, 0.25, 0.35, 0.5),
    "fusion.min_points": (10, 15, 20, 50),
    "fusion.max_depth": (10, 20, 25, 30),
    "ground.distance_threshold": (0.35, 0.5, 0.7),
    "voxel.size": (0.15, 0.2, 0.3),
    "fusion.min_rating": (0.2, 0.35, 0.5),
    "ground.method": ("plane",),
    "fusion.split": ("false",),
    "fusion.method": ("centroid",),
}
UNSEEN: tuple[Settings, ...] = (
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
)


def drawn(seed: int, index: int) -> tuple[Settings, ...]:
    """Return the default and seven mis-tunings of one frame."""
    rng, keys = np.random.default_rng([seed, index]), [*DRAWN]

    def draw() -> Settings:
        number = int(rng.choice([1, 1, 2, 2, 3]))
        return tuple(
            f"{keys[i]}={DRAWN[keys[i]][int(rng.integers(len(DRAWN[keys[i]])))]}"
            for i in rng.choice(len(keys), number, replace=False)
        )

    return ((), *(draw() for _ in range(7)))


def shots(part: str) -> Iterator[tuple[int, int, list[Config]]]:
    """Yield the drive and the number of each frame, and the configurations that it is run with."""
    if part == "check":
        yield from ((seed, 20, mistuned(UNSEEN)) for seed in range(1050, 1058))
        return
    reference = load(settings=[MODEL], preset="reference")
    for seed in range(1020, 1030):
        for index in (5, 45, 85) if seed < 1025 else (5,):
            yield seed, index, [*mistuned(LISTED), reference]
    yield from ((seed, 30, mistuned(drawn(seed, 30))) for seed in range(1100, 1111))


def mistuned(settings: Sequence[Settings]) -> list[Config]:
    """Return the default configuration with each of the settings."""
    return [load(settings=[MODEL, *some]) for some in settings]


@dataclass(frozen=True, slots=True)
class Observation:
    """One answer without ground truth, held against the rule of ``benchmarks.truth``."""

    seed: int
    named: str  # outcome that the answer names
    right: str  # outcome by the rule
    confidence: float
    features: dict[str, float]


def observe(part: str) -> Iterator[Observation]:
    """Ask about each visible object of the drives by the box around it, labels hidden."""
    loader = StageLoader()
    sources: dict[int, SyntheticSource] = {}
    for seed, index, configs in shots(part):
        source = sources.setdefault(seed, SyntheticSource(100, seed))
        shot, memo = source.snapshot(index), Memo()
        scene = scene_of(source, shot)
        for config in configs:
            result = perceive(shot.frame, config, loader.load(config), memo)
            rule = Rule(shot, scene, result)
            known = FrameExplainer(result, loader, CLASSES).traces
            unlabelled = replace(result, frame=replace(result.frame, truth=None))
            blind = FrameExplainer(unlabelled, loader, CLASSES)
            for row, subject in enumerate(known.truth):
                box = tuple(scene.pixels[row].tolist())
                assert subject.box is not None
                near = np.hypot(*subject.box.center[0, :2]) <= RANGE
                near &= len(known.place(subject)) >= MIN_HITS
                if near and box[3] - box[1] >= MIN_HEIGHT:
                    answer, cause = blind.ask(Selection(box=box))[0], rule.cause(row)
                    features = features_of(answer.subject, answer.evidence, blind.traces)
                    assert features is not None
                    yield Observation(
                        seed,
                        outcome_key(answer.verdict.kind, answer.verdict.reported),
                        outcome_key(cause.reason, cause.reported),
                        answer.confidence or 0.0,
                        features,
                    )


@dataclass(frozen=True, slots=True)
class Model:
    """Coefficients of each outcome: a row of the table for each one, that of the rules' outcome first."""

    outcomes: tuple[str, ...]
    table: F64  # (outcomes, 1 + features)

    def exponents(self, observations: Sequence[Observation]) -> F64:
        """Return the (N, outcomes) exponents."""
        X, named, _ = arrays(observations, self.outcomes)
        return np.asarray(X @ self.table[:, 1:].T + named * self.table[:, 0])

    def probabilities(self, observations: Sequence[Observation]) -> F64:
        """Return the (N, outcomes) probabilities."""
        return softmax(self.exponents(observations))


def softmax(exponents: F64) -> F64:
    weights = np.exp(exponents - exponents.max(axis=1, keepdims=True))
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def arrays(observations: Sequence[Observation], outcomes: Sequence[str]) -> tuple[F64, F64, I64]:
    """Return features, one-hot outcomes of the rules, and the column of the right outcome."""
    X = np.array([[*seen.features.values()] for seen in observations])
    named = np.array([[float(seen.named == key) for key in outcomes] for seen in observations])
    return X, named, np.array([outcomes.index(seen.right) for seen in observations])


def fit(observations: Sequence[Observation], outcomes: tuple[str, ...]) -> Model:
    """Fit a multinomial logistic regression with squared coefficients as penalty."""
    X, named, right = arrays(observations, outcomes)
    mean, spread = X.mean(axis=0), X.std(axis=0) + 1e-6
    mean[0], spread[0] = 0.0, 1.0  # of the constant
    Z, onehot = (X - mean) / spread, np.eye(len(outcomes))[right]

    def loss(flat: F64) -> tuple[float, F64]:
        table = flat.reshape(len(outcomes), -1)
        p = softmax(Z @ table[:, 1:].T + named * table[:, 0])
        off = p - onehot
        slope = np.column_stack([(named * off).sum(axis=0), off.T @ Z]) + PENALTY * table
        chosen = p[np.arange(len(right)), right]
        return float(-np.log(chosen + 1e-12).sum() + PENALTY * (table**2).sum() / 2), slope.ravel()

    start = np.zeros(len(outcomes) * (1 + X.shape[1]))
    table = minimize(loss, start, jac=True, method="L-BFGS-B", options={"maxiter": 300}).x.reshape(
        len(outcomes), -1
    )
    table[:, 1:] /= spread
    table[:, 1] -= table[:, 2:] @ mean[1:]
    return Model(outcomes, table)


def cross_validated(observations: Sequence[Observation], outcomes: tuple[str, ...]) -> F64:
    """Return the (N, outcomes) exponents of each drive, by a fit to the other drives."""
    seeds = np.array([seen.seed for seen in observations])
    exponents = np.zeros((len(observations), len(outcomes)))
    for fold in range(FOLDS):
        out = np.isin(seeds, np.unique(seeds)[fold::FOLDS])
        model = fit([seen for seen, left in zip(observations, out, strict=True) if not left], outcomes)
        exponents[out] = model.exponents([seen for seen, left in zip(observations, out, strict=True) if left])
    return exponents


def temperature(exponents: F64, right: I64) -> float:
    """Return the factor on the exponents with which unseen drives are least surprising."""
    factors = np.linspace(0.3, 1.2, 46)
    surprise = [-np.log(softmax(f * exponents)[np.arange(len(right)), right]).mean() for f in factors]
    return float(factors[int(np.argmin(surprise))])


def table_of(model: Model, features: Sequence[str], number: int) -> str:
    """Return the module with the coefficients of each outcome."""
    lines = [
        '"""Coefficients of ``confidence``, written by ``python -m benchmarks.confidence fit``.',
        "",
        f"They are fitted to {number} answers. A row is an outcome, with * where the subject is reported.",
        "Its first number counts where the rules name the outcome, the others are in the order of FEATURES.",
        '"""',
        "",
        "FEATURES = (",
        *(f'    "{name}",' for name in features),
        ")",
        "# fmt: off",
        "COEFFICIENTS: dict[str, tuple[float, ...]] = {",
    ]
    for key, row in zip(model.outcomes, model.table, strict=True):
        numbers = textwrap.wrap(", ".join(f"{value:.2f}" for value in row), 100)
        lines += [f'    "{key}": (', *(f"        {line}" for line in numbers), "    ),"]
    return "\n".join([*lines, "}"]) + "\n"


def report(seeds: I64, right: Bool, sure: F64) -> str:
    """Format the shares with their intervals, and the observed share of each band of probability."""
    answered = sure >= LIMIT
    everything = np.ones_like(right)
    shares = {
        "right without a limit": (right, everything),
        "answered": (answered, everything),
        "right, of answered": (right, answered),
        "stated, of answered": (sure, answered),
        "right or cannot tell": (right | ~answered, everything),
    }
    rng, drives = np.random.default_rng(0), np.unique(seeds)
    draws = [rng.choice(drives, len(drives)) for _ in range(1000)]
    lines = [f"{len(right)} answers on {len(drives)} drives"]
    for name, (value, mask) in shares.items():
        parts = np.array([[(value * mask)[seeds == s].sum(), mask[seeds == s].sum()] for s in drives])
        sums = np.array([parts[np.searchsorted(drives, draw)].sum(0) for draw in draws])
        low, high = np.quantile(sums[:, 0] / sums[:, 1], (0.025, 0.975))
        lines.append(f"{name}: {100 * value[mask].mean():.1f} % ({100 * low:.1f}-{100 * high:.1f} %)")
    for low, high in ((0.0, 0.5), (0.5, LIMIT), (LIMIT, 0.8), (0.8, 0.9), (0.9, 0.95), (0.95, 1.01)):
        band = (sure >= low) & (sure < high)
        if band.any():
            shown = f"{100 * sure[band].mean():.0f} % stated, {100 * right[band].mean():.0f} % right"
            lines.append(f"{100 * low:.0f} to {min(100 * high, 100):.0f} %: {shown}, of {band.sum()}")
    return "\n".join(lines)


def refit(observations: Sequence[Observation]) -> tuple[str, str]:
    """Return the new table, and the report on drives that each fit has not seen."""
    outcomes = tuple(sorted({seen.right for seen in observations}))
    exponents = cross_validated(observations, outcomes)
    _, _, right = arrays(observations, outcomes)
    factor = temperature(exponents, right)
    model = fit(observations, outcomes)
    model = Model(outcomes, factor * model.table)
    p, seeds = softmax(factor * exponents), np.array([seen.seed for seen in observations])
    text = report(seeds, np.equal(p.argmax(axis=1), right), p.max(axis=1))
    return table_of(model, [*observations[0].features], len(observations)), text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=("fit", "check"))
    part = parser.parse_args().part
    if part == "fit":
        COEFFICIENTS.clear()  # The rules' own outcomes are a feature.
    observations = list(observe(part))
    if part == "fit":
        table, text = refit(observations)
        TABLE.write_text(table)
    else:
        right = np.array([seen.named == seen.right for seen in observations])
        sure = np.array([seen.confidence for seen in observations])
        text = report(np.array([seen.seed for seen in observations]), right, sure)
    print(text)


if __name__ == "__main__":
    main()
