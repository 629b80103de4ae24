"""Search of several parameters at a time for the best value of an objective.

The sampler is a tree-structured Parzen estimator over lists of values (Bergstra et al., "Algorithms for
hyper-parameter optimization", NeurIPS 2011): it draws values that are frequent among the better trials and
rare among the others. Trials come in generations, so that all of a generation share the frames' results.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from bevviz.config import Config, load, parameters, values

Settings = Mapping[str, Any]  # dotted key -> value, of the parameters that differ from the start

GENERATION = 12  # trials that run on each frame at once
GOOD = 0.2  # share of the trials that count as the better ones
SMOOTH = 0.5  # weight of the neighbours of a value, and of a value that was never tried
DRAWN = 24  # candidates of which the most promising one is tried
FACTORS = (0.25, 0.4, 0.6, 0.8, 1.0, 1.25, 1.6, 2.5, 4.0)
WORDS: Mapping[str, Sequence[Any]] = {  # parameters that are no numbers
    "ground.method": ("polar", "plane"),
    "fusion.method": ("frustum", "centroid"),
    "fusion.split": (True, False),
    "clustering.max_cluster_points": (None, 500, 1000, 2000, 4000, 8000),
}


def choices_of(present: Any, default: Any, key: str) -> list[Any]:
    """Return the values of a parameter to try, in order: around its present and its default value."""
    if key in WORDS:
        listed = [*WORDS[key]]
        return listed + [value for value in (present,) if value not in listed]
    declared = parameters()[key]
    low, high = declared.low, declared.high
    whole = isinstance(present, int)
    tried = {present, default}
    for start in {present, default}:
        for factor in FACTORS:
            value = round(start * factor) if whole else float(f"{start * factor:.2g}")
            if (low is None or value >= low) and (high is None or value <= high) and value > 0:
                tried.add(value)
    return sorted(tried)


def search(
    config: Config,
    keys: Sequence[str],
    objective: Callable[[Sequence[Settings]], Sequence[float]],
    trials: int,
    seed: int = 0,
    *,
    defaults: bool = True,
) -> Iterator[tuple[Settings, float]]:
    """Yield each tried setting with its objective, the present configuration first.

    Args:
        config: present configuration.
        keys: dotted keys of the parameters.
        objective: returns the objective of each of several settings, the higher the better.
        trials: number of settings to try.
        seed: seed of the draws.
        defaults: whether the default values of the preset are among the values and the first to be tried.
    """
    present = values(config)
    default = values(load(preset=config.preset)) if defaults else present
    choices = {key: choices_of(present[key], default[key], key) for key in keys}
    rng = np.random.default_rng(seed)
    tried: dict[tuple[Any, ...], float] = {}

    def settings(point: tuple[Any, ...]) -> Settings:
        return {k: v for k, v in zip(keys, point, strict=True) if v != present[k]}

    def first() -> Iterator[tuple[Any, ...]]:
        """Yield the present values, the defaults, and each parameter's default and neighbours alone."""
        start = tuple(present[key] for key in keys)
        yield start
        yield tuple(default[key] for key in keys)
        for distance in (0, -2, 2, -4, 4):
            for i, key in enumerate(keys):
                at = choices[key].index(present[key]) + distance
                value = default[key] if not distance else choices[key][min(max(at, 0), len(choices[key]) - 1)]
                yield (*start[:i], value, *start[i + 1 :])

    queue = [*dict.fromkeys(first())][: max(GENERATION, trials // 2)]
    while len(tried) < trials:
        batch, queue = queue[:GENERATION], queue[GENERATION:]
        batch = batch or _drawn(tried, [choices[key] for key in keys], rng)
        batch = batch[: trials - len(tried)]
        if not batch:
            return
        for point, value in zip(batch, objective([settings(p) for p in batch]), strict=True):
            tried[point] = value
            yield settings(point), value


def _drawn(
    tried: Mapping[tuple[Any, ...], float], choices: Sequence[list[Any]], rng: np.random.Generator
) -> list[tuple[Any, ...]]:
    """Return a generation of new points, each the most promising of some that the better trials suggest."""
    ranked = sorted(tried, key=lambda point: -tried[point])
    number = max(3, round(GOOD * len(ranked)))
    good, others = (
        [_density(part, i, c) for i, c in enumerate(choices)] for part in (ranked[:number], ranked[number:])
    )
    points: dict[tuple[Any, ...], None] = {}
    for _ in range(4 * GENERATION):
        drawn = [[int(rng.choice(len(p), p=p)) for p in good] for _ in range(DRAWN)]
        promise = [sum(np.log(g[i] / o[i]) for g, o, i in zip(good, others, d, strict=True)) for d in drawn]
        for place in np.argsort(promise)[::-1].tolist():
            point = tuple(c[i] for c, i in zip(choices, drawn[place], strict=True))
            if point not in tried and point not in points:
                points[point] = None
                break
        if len(points) == GENERATION:
            break
    return list(points)


def _density(points: Sequence[tuple[Any, ...]], column: int, choices: list[Any]) -> np.ndarray[Any, Any]:
    """Return the smoothed frequency of each value of a parameter."""
    density = np.full(len(choices), SMOOTH)
    ordered = all(isinstance(value, int | float) and not isinstance(value, bool) for value in choices)
    for point in points:
        at = choices.index(point[column])
        density[at] += 1
        if ordered:
            density[max(at - 1, 0)] += SMOOTH
            density[min(at + 1, len(choices) - 1)] += SMOOTH
    return np.asarray(density / density.sum())
